/** Fingers and the wheel, which the player shares with the page: part of element_browser.mjs. */

import assert from 'node:assert/strict';

const PHONE = { hasTouch: true, isMobile: true };
const LONG = '<div style="height: 2000px"></div>';

/** Return a function that sends touches of so many points. */
async function touchesOf(page) {
  const client = await page.context().newCDPSession(page);
  return (type, ...points) =>
    client.send('Input.dispatchTouchEvent', { type, touchPoints: points.map(([x, y], id) => ({ x, y, id })) });
}

/** Stroke upwards with one finger, as to scroll down. */
async function strokeUp(page, [x, y]) {
  const touch = await touchesOf(page);
  await touch('touchStart', [x, y]);
  for (let by = 4; by <= 72; by += 4) {
    await touch('touchMove', [x, y - by]);
    await page.waitForTimeout(16);
  }
  await touch('touchEnd');
}

/** Wait until the page, or the part of it that scrolls, has been scrolled beyond a place; return where it is. */
async function scrolledBeyond(page, top) {
  const found = await page.waitForFunction(
    (top) => {
      const part = document.querySelector('body > div')?.shadowRoot?.firstElementChild;
      const { scrollTop } = part ?? document.scrollingElement;
      return scrollTop > top && scrollTop;
    },
    top,
    { timeout: 10_000 },
  );
  return found.jsonValue();
}

export function scrollingScenarios(scenario, { open, shown, player, inside, close, numbers, tag }) {
  scenario('is turned by one finger, moved and pinched by two', async () => {
    const page = await open(tag, { context: PHONE });
    await shown(page);
    const touch = await touchesOf(page);
    const before = numbers(await player(page, (it) => it.camera));
    const box = await inside(page, '.stage').boundingBox();
    const at = (x, y) => [box.x + x, box.y + y];
    await touch('touchStart', at(30, 40));
    for (let x = 34; x <= 60; x += 4) await touch('touchMove', at(x, 40));
    await touch('touchEnd');
    await page.waitForTimeout(800);
    const turned = numbers(await player(page, (it) => it.camera));
    assert.ok(Math.hypot(...[0, 1, 2].map((i) => turned[i] - before[i])) > 0.1);
    await touch('touchStart', at(50, 40), at(70, 40));
    for (let by = 1; by <= 10; by++) await touch('touchMove', at(50 - by, 40), at(70 + by, 40));
    await touch('touchEnd');
    const pinched = numbers(await player(page, (it) => it.camera));
    const distance = (view) => Math.hypot(...[0, 1, 2].map((i) => view[i] - view[i + 3]));
    assert.ok(distance(pinched) < 0.7 * distance(turned));
    await close(page);
  });

  const inner = (html) =>
    `<iframe style="width: 300px; height: 200px; border: 0" src="page.html?${encodeURIComponent(html)}"></iframe>`;
  const script = '<script type="module" src="kpc-player.js"></script>';
  /** Pages that scroll: by themselves, in a part whose scroller is in a shadow root, and around a frame. */
  const pages = {
    'that scrolls': tag + LONG,
    'with a part that scrolls': `<style>html, body { margin: 0; height: 100%; overflow: hidden }</style>
      <div><template shadowrootmode="open"><main style="height: 100vh; overflow: auto"><slot></slot></main></template>
      ${tag}${LONG}</div>`,
    'around a frame': `${inner(`<!doctype html><style>body { margin: 0 }</style>${script}${tag}`)}${LONG}`,
  };

  for (const [name, body] of Object.entries(pages)) {
    scenario(`leaves the wheel and strokes to a page ${name}`, async () => {
      const page = await open(body, { context: PHONE });
      const frame = page.frames().at(-1);
      await frame.waitForFunction(() => document.querySelector('kpc-player')?.readyState >= 2, null, {
        timeout: 40_000,
      });
      const camera = () =>
        frame.evaluate(() => Object.assign(document.querySelector('kpc-player'), { keepsLimits: false }).camera);
      const before = await camera();
      await strokeUp(page, [60, 80]);
      await scrolledBeyond(page, 0);
      await page.waitForTimeout(500); // inertia would go on so long
      const at = await scrolledBeyond(page, 0);
      await page.mouse.move(60, 20);
      await page.mouse.wheel(0, 40);
      await scrolledBeyond(page, at);
      assert.equal(await camera(), before);
      await close(page);
    });
  }
}
