/**
 * Watches <kpc-player> in headless Chromium: `node element_browser.mjs ADDRESS CHROMIUM FOLDER [NAME ...]`.
 *
 * The server at ADDRESS has the files and faults of tests/player/test_web_player.py, and page.html is what its query
 * says. Writes a JSON object on one line: for each scenario {error, value}. Pictures of pages go to FOLDER.
 */

import assert from 'node:assert/strict';
import { join } from 'node:path';
import { chromium } from 'playwright-core';
import { FLAGS } from './browser_flags.mjs';
import { headsetScenarios } from './headset_browser.mjs';
import { scrollingScenarios } from './scrolling_browser.mjs';
import { threeScenarios } from './three_browser.mjs';

const EVENTS = [
  ...['loadstart', 'loadedmetadata', 'progress', 'canplay', 'play', 'playing', 'pause', 'waiting', 'timeupdate'],
  ...['seeking', 'seeked', 'ended', 'error', 'camera-change', 'ratechange', 'volumechange'],
];
const [address, executablePath, folder, ...chosen] = process.argv.slice(2);
const scenarios = new Map();
const scenario = (name, run) => scenarios.set(name, run);
/** The same server as another site. */
const otherSite = address.replace('127.0.0.1', 'localhost');
const browser = await chromium.launch({ executablePath, args: FLAGS });

function noteErrors(page) {
  page.errors = [];
  page.on('pageerror', (error) => page.errors.push(error.message));
}

/**
 * Open a page with players, at little cost.
 * @param body HTML, in which `kpc-player` gets a size and a level unless `isPlain`.
 */
async function open(body, { hash = '', context = {}, isPlain = false, csp = '', before = () => {} } = {}) {
  const viewport = { width: 420, height: 300 };
  const browserContext = await browser.newContext({ viewport, ...context });
  await browserContext.grantPermissions(['clipboard-read', 'clipboard-write']);
  const page = await browserContext.newPage();
  noteErrors(page);
  const style = isPlain ? '' : '<style>kpc-player { width: 240px; height: 180px }</style>';
  const policy = csp && `<meta http-equiv="Content-Security-Policy" content="${csp}">`;
  const html = `<!doctype html><html lang="en"><meta charset="utf-8"><title>Test</title>${policy}
    <meta name="viewport" content="width=device-width">${style}
    <script type="module" src="kpc-player.js"></script><body>${body}</body></html>`;
  await page.addInitScript((names) => {
    globalThis.events = [];
    for (const name of names) document.addEventListener(name, () => globalThis.events.push(name), true);
  }, EVENTS);
  await before(page);
  await page.goto(`${address}/page.html?${encodeURIComponent(html)}${hash}`);
  return page;
}

/** Return what a function of the page's first player returns. */
const player = (page, run, ...args) =>
  page.evaluate(`(${run})(document.querySelector('kpc-player'), ...${JSON.stringify(args)})`);
/** Wait until a function of the page's first player returns true. */
async function until(page, run, ...args) {
  const due = performance.now() + 40_000;
  while (!(await player(page, run, ...args))) {
    assert.ok(
      performance.now() < due,
      `${run} is still false; ${await player(page, (it) => JSON.stringify(it.error))}`,
    );
    await page.waitForTimeout(50);
  }
}
const shown = (page) => until(page, (it) => it.readyState >= 2);
const inside = (page, selector) => page.locator('kpc-player').first().locator(selector);
const button = (page, label) => inside(page, `.bar button[aria-label="${label}"]`);
const events = (page) => page.evaluate(() => globalThis.events);
const numbers = (text) => text.split(' ').map(Number);

async function close(page) {
  assert.deepEqual(page.errors, []);
  await page.context().close();
}

const TAG = '<kpc-player src="scene.kpc" quality="fastest" controls muted></kpc-player>';
const WIDE = TAG.replace('src', 'style="width: 400px" src');

scenario('plays as a video does', async () => {
  const page = await open(TAG.replace('muted', 'muted autoplay loop'));
  await until(page, (it) => it.readyState === 4 && it.currentTime > 0.1);
  const names = (await events(page)).filter((name) => name !== 'timeupdate' && name !== 'progress');
  assert.deepEqual(names.slice(0, 5), ['loadstart', 'loadedmetadata', 'play', 'canplay', 'playing']);
  assert.ok((await events(page)).includes('progress'));
  await player(page, (it) => {
    it.playbackRate = 4;
    globalThis.times = [];
    it.addEventListener('timeupdate', () => globalThis.times.push(it.currentTime));
  });
  await page.waitForFunction(() => globalThis.times.some((time, i) => time < globalThis.times[i - 1]), null, {
    timeout: 40_000,
  });
  const state = await player(page, (it) => ({
    ...{ paused: it.paused, ended: it.ended, duration: it.duration, rate: it.playbackRate, error: it.error },
    buffered: [it.buffered.length, it.buffered.start(0), it.buffered.end(0)],
  }));
  assert.deepEqual(state, {
    ...{ paused: false, ended: false, duration: 29 / 12, rate: 4, error: null },
    buffered: [1, 0, 29 / 12],
  });
  await player(page, (it) => {
    it.loop = false;
  });
  await until(page, (it) => it.ended && it.paused);
  assert.deepEqual((await events(page)).slice(-3), ['timeupdate', 'pause', 'ended']);
  assert.equal(await player(page, (it) => it.currentTime), 29 / 12);
  const replayed = await player(page, async (it) => {
    await it.play();
    const time = it.currentTime;
    const rejected = it.play().then(
      () => 'resolved',
      (error) => error.name,
    );
    it.pause();
    return [time < 1, await rejected];
  });
  assert.deepEqual(replayed, [true, 'resolved']);
  await close(page);
});

scenario('draws what the reference draws', async () => {
  const page = await open(TAG.replace('fastest', 'reference').replace('src', 'style="width: 96px; height: 72px" src'));
  await shown(page);
  const value = await player(page, async (it) => {
    it.currentTime = 1.3;
    await new Promise((resolve) => it.addEventListener('seeked', resolve, { once: true }));
    const bytes = new Uint8Array(await (await it.toBlob()).arrayBuffer());
    return { camera: it.camera, picture: btoa(Array.from(bytes, (byte) => String.fromCharCode(byte)).join('')) };
  });
  await close(page);
  return value;
});

scenario('makes a file of what was asked for just before, in sight or not', async () => {
  const page = await open(TAG);
  await shown(page);
  const pictures = await player(page, async (it) => {
    const drawn = async (change) => {
      change();
      return new Uint8Array(await (await it.toBlob()).arrayBuffer()).join();
    };
    const found = [await drawn(() => {})];
    found.push(await drawn(() => Object.assign(it, { camera: it.cameras[3] })));
    found.push(await drawn(() => Object.assign(it, { currentTime: 1.5 })));
    it.style.marginTop = '4000px';
    await new Promise((resolve) => setTimeout(resolve, 300));
    found.push(await drawn(() => Object.assign(it, { camera: it.cameras[5] })));
    return found;
  });
  assert.equal(new Set(pictures).size, 4);
  await close(page);
});

scenario('knows the viewpoints of the desktop player', async () => {
  const page = await open(TAG);
  await shown(page);
  const value = await player(page, (it) => {
    const views = {};
    const seen = [];
    for (const value of [[1, -3, 1, 0, 0, 0, 50], null, ' 1,-3,1,0,0,0,50', undefined, [1, -3, 1, 0, 0, 0, 50], '']) {
      it.camera = value;
      seen.push(it.camera);
    }
    it.camera = 'opening';
    const expected = ['1 -3 1 0 0 0 50', it.camera];
    it.setAttribute('camera', expected[0]);
    it.removeAttribute('camera');
    if (it.camera !== expected[1]) throw new Error(`without a camera: ${it.camera}`);
    if (seen.some((view, i) => view !== expected[i % 2])) throw new Error(seen.join('; '));
    for (const name of ['opening', ...it.presets, ...it.cameras]) {
      it.camera = name;
      views[name] = it.camera;
    }
    return views;
  });
  await close(page);
  return value;
});

scenario('reflects attributes and properties', async () => {
  const page = await open('<kpc-player></kpc-player>');
  const got = await player(page, (it) => {
    Object.assign(it, { controls: true, loop: true, autoplay: true, playsInline: true, poster: 'a.jpg' });
    Object.assign(it, { preload: 'none', quality: 'fine', targetFps: 50, part: 'static', memory: 1e8, volume: 0.5 });
    it.muted = true;
    const html = it.outerHTML;
    it.setAttribute('quality', 'odd');
    it.setAttribute('target-fps', '-3');
    it.setAttribute('preload', 'NONE');
    const late = document.createElement('kpc-player');
    const odd = Object.assign(document.createElement('kpc-player'), { currentTime: '1.5', playbackRate: '2' });
    return {
      html,
      odd: [odd.currentTime, odd.playbackRate],
      now: [it.quality, it.targetFps, it.preload, it.muted, it.volume, it.shownPart, it.cameraControls],
      fresh: [
        late.duration,
        late.readyState,
        late.buffered.length,
        late.paused,
        late.currentTime,
        late.error,
        late.src,
      ],
    };
  });
  assert.match(got.html, /controls="" loop="" autoplay="" playsinline="" poster="a.jpg" preload="none" quality="fine"/);
  assert.match(got.html, /target-fps="50" part="static" memory="100000000"/);
  assert.deepEqual(got.now, ['auto', 0, 'none', true, 0.5, 'static', true]);
  assert.deepEqual(got.odd, [1.5, 2]);
  assert.deepEqual(got.fresh, [Number.NaN, 0, 0, true, 0, null, '']);
  assert.deepEqual(await events(page), ['volumechange', 'volumechange']);
  await close(page);
});

scenario('takes every property that was set before it was defined', async () => {
  const page = await open('<kpc-player></kpc-player>');
  const got = await player(page, (it) => {
    // Elements of such documents are defined once they are in a page.
    const early = document.implementation.createHTMLDocument('').createElement('kpc-player');
    const names = [];
    for (let type = Object.getPrototypeOf(it); type !== HTMLElement.prototype; type = Object.getPrototypeOf(type)) {
      for (const [name, { set }] of Object.entries(Object.getOwnPropertyDescriptors(type))) if (set) names.push(name);
    }
    for (const name of names) early[name] = it[name];
    Object.assign(early, { shownPart: 'static', keepsLimits: false, unknown: 1 });
    document.body.append(early);
    return { names, own: Object.getOwnPropertyNames(early), set: [early.shownPart, early.keepsLimits] };
  });
  assert.ok(got.names.length >= 20 && got.names.includes('srcObject'));
  assert.deepEqual([got.own, got.set], [['unknown'], ['static', false]]);
  await close(page);
});

scenario('seeks in a long clip, where nothing has arrived', async () => {
  const page = await open(TAG.replace('scene.kpc', 'slow/long.kpc'));
  await shown(page);
  // Nothing is buffered for a moment where a finer scale has come before its time planes.
  await until(page, ({ buffered, duration }) => {
    globalThis.hasGap = buffered.length > 0 && buffered.end(buffered.length - 1) < 0.8 * duration;
    return buffered.length > 0;
  });
  const gap = await page.evaluate(() => globalThis.hasGap);
  await player(page, (it) => {
    it.currentTime = 0.9 * it.duration;
  });
  await until(page, (it) => !it.seeking);
  const names = await events(page);
  assert.ok(names.indexOf('seeked') > names.indexOf('seeking'));
  assert.ok(gap && (await player(page, (it) => it.readyState >= 2 && it.buffered.length > 0)));
  await close(page);
});

scenario('says why the picture is waited for, once that takes long', async () => {
  const page = await open(TAG.replace('scene.kpc', 'slow/long.kpc'));
  await shown(page);
  await page.context().setOffline(true);
  await player(page, (it) => {
    it.play().catch(() => {});
    it.currentTime = 0.9 * it.duration;
  });
  await until(page, (it) => it.shadowRoot.querySelector('.waiting').checkVisibility());
  assert.equal(await inside(page, '.waiting').textContent(), '');
  await until(page, (it) => /^The .*; trying again$/.test(it.shadowRoot.querySelector('.waiting').textContent));
  await page.screenshot({ path: join(folder, 'waiting.png') });
  await page.context().setOffline(false);
  await until(page, (it) => !it.seeking);
  assert.equal(await inside(page, '.waiting').isVisible(), false);
  await close(page);
});

scenario('says that a server does not answer, and takes the focus', async () => {
  const before = (page) => page.route('**/scene.kpc', () => {});
  const page = await open(TAG, { before });
  await until(page, (it) => /^Waiting for the begin/.test(it.shadowRoot.querySelector('.waiting').textContent));
  assert.equal(await player(page, (it) => it.readyState), 0);
  await player(page, (it) => it.focus());
  assert.ok(await player(page, (it) => document.activeElement === it && it.shadowRoot.activeElement !== null));
  await close(page);
});

scenario('shows its switches in forced colours', async () => {
  const page = await open(TAG, { context: { forcedColors: 'active' } });
  await shown(page);
  await button(page, 'Settings').click();
  const looks = await player(page, (it) =>
    [...it.shadowRoot.querySelectorAll('input[type="checkbox"]')].map((one) => getComputedStyle(one).appearance),
  );
  assert.ok(looks.length > 0 && looks.every((look) => look === 'auto'), looks.join());
  await page.screenshot({ path: join(folder, 'forced.png') });
  await close(page);
});

scenario('is turned by the mouse, and goes on for a moment', async () => {
  const page = await open(`${TAG}<div style="height: 2000px"></div>`);
  await shown(page);
  const opening = await player(page, (it) => it.camera);
  await page.mouse.move(40, 50);
  await page.mouse.wheel(0, 300);
  assert.equal(await player(page, (it) => it.camera), opening); // the wheel is the page's
  await until(page, () => scrollY > 0);
  await page.evaluate(() => window.scrollTo({ top: 0, behavior: 'instant' }));
  await player(page, (it) => {
    it.keepsLimits = false; // which move the view, too
    it.addEventListener('pointerup', () => {
      globalThis.released = it.camera;
    });
  });
  // A hand that pauses before it lets go throws nothing, and the machine may pause.
  for (let tries = 0, isGoing = false; !isGoing; tries++) {
    assert.ok(tries < 8, 'the view never goes on');
    await page.mouse.move(40, 50);
    await page.mouse.down();
    for (let x = 44; x <= 64; x += 4) await page.mouse.move(x, 50);
    await page.mouse.up();
    await page.waitForTimeout(300);
    isGoing = await player(page, (it) => it.camera !== globalThis.released);
  }
  assert.notEqual(await page.evaluate(() => globalThis.released), opening);
  const rested = numbers(
    await player(page, async (it) => {
      for (let [same, last] = [0, '']; same < 5; last = it.camera) {
        await new Promise(requestAnimationFrame);
        same = it.camera === last ? same + 1 : 0;
      }
      return it.camera;
    }),
  );
  await page.mouse.wheel(0, -100);
  await until(page, (it, before) => it.camera !== before, rested.join(' '));
  const zoomed = numbers(await player(page, (it) => it.camera));
  const distance = (view) => Math.hypot(...[0, 1, 2].map((i) => view[i] - view[i + 3]));
  assert.ok(Math.abs(distance(zoomed) / distance(rested) - 0.9) < 0.01);
  assert.ok((await events(page)).includes('camera-change'));
  await page.mouse.move(60, 50);
  await page.mouse.down({ button: 'right' });
  await page.mouse.move(61, 50, { steps: 2 });
  await page.mouse.up({ button: 'right' });
  const panned = numbers(await player(page, (it) => it.camera));
  assert.notDeepEqual(panned.slice(3, 6), zoomed.slice(3, 6));
  await close(page);
});

scenario('comes back to where the scene holds', async () => {
  const page = await open(TAG);
  await shown(page);
  await player(page, (it) => {
    it.camera = 'middle';
  });
  await inside(page, '.stage').focus();
  // The file holds 0.2902 around this point; a view that is moved further comes back once the key is up.
  const focus = [0.02, 0.1, 0.56];
  const isWithin = (it, centre, radius) => {
    const view = it.camera.split(' ').map(Number);
    return Math.hypot(...centre.map((x, i) => view[i + 3] - x)) < radius;
  };
  await page.keyboard.down('d');
  while (await player(page, isWithin, focus, 0.32)) await page.waitForTimeout(20);
  await page.keyboard.up('d');
  await until(page, isWithin, focus, 0.2903);
  await close(page);
});

scenario('heeds the keys of the desktop player', async () => {
  const page = await open(TAG);
  await shown(page);
  await inside(page, '.stage').focus();
  const press = async (...keys) => {
    for (const key of keys) await page.keyboard.press(key);
  };
  await press('ArrowRight', 'ArrowRight');
  assert.ok(Math.abs((await player(page, (it) => it.currentTime)) - 2 / 12) < 1e-6);
  await press('End');
  assert.equal(await player(page, (it) => it.currentTime), 29 / 12);
  assert.equal(await player(page, (it) => it.ended), true);
  await button(page, 'Play again').waitFor();
  await press(' ');
  await until(page, (it) => !it.paused && it.currentTime > 0 && it.currentTime < 2);
  await press(' ');
  await press('Home', ']', 'l', 'c', '-');
  const state = await player(page, (it) => [it.currentTime, it.playbackRate, it.loop, it.shownPart, it.quality]);
  assert.deepEqual(state, [0, 2, true, 'static', 'fastest']);
  await press(' ');
  await until(page, (it) => !it.paused);
  await press(' ', 'n');
  await until(page, (it) => it.paused);
  const cameras = await player(page, (it) => {
    const now = it.camera;
    it.camera = it.cameras[1];
    return [now, it.camera];
  });
  assert.equal(cameras[0], cameras[1]);
  await press('h');
  assert.equal(await inside(page, '.panel.keys').isVisible(), true);
  await press('End'); // scrolls the list
  assert.equal(await player(page, (it) => it.ended), false);
  await press('Escape');
  assert.equal(await inside(page, '.panel.keys').isVisible(), false);
  // Panels close if something else gets the focus, but not for what is in the player.
  await button(page, 'Settings').click();
  const panel = inside(page, '.panel:not([hidden])');
  await panel.locator('select').first().focus();
  assert.equal(await panel.count(), 1);
  await page.evaluate(() => document.body.append(Object.assign(document.createElement('button'), { id: 'outside' })));
  await page.locator('#outside').focus();
  assert.equal(await panel.count(), 0);
  // Open settings show what keys and scripts change, and a click sets what it shows.
  await player(page, (it) => {
    it.playbackRate = 1.5;
  });
  await button(page, 'Settings').click();
  const showSettings = (...expected) =>
    until(
      page,
      (it, expected) => {
        const fields = [...it.shadowRoot.querySelectorAll('.panel:not([hidden]) :is(select, input)')];
        return fields.map((field) => (field.type === 'checkbox' ? field.checked : field.value)).join() === expected;
      },
      expected.join(),
    );
  await showSettings('1.5', 'fastest', 'static', true, true);
  await inside(page, '.stage').focus();
  await press('l', 'x', '=', 'c', ']');
  await showSettings('2', 'faster', 'dynamic', false, false);
  const loops = inside(page, '.panel:not([hidden]) label').filter({ hasText: 'Loop' }).locator('input');
  await loops.evaluate((it) => it.click());
  assert.deepEqual([await player(page, (it) => it.loop), await loops.isChecked()], [true, true]);
  await player(page, (it) => Object.assign(it, { playbackRate: 3, loop: 0, quality: 'fastest', keepsLimits: true }));
  await showSettings('3', 'fastest', 'dynamic', false, true);
  await player(page, (it) => Object.assign(it, { loop: true }));
  await inside(page, '.stage').focus();
  await press('Escape');
  // Where hands may not move the view, all other keys work.
  await player(page, (it) => it.setAttribute('camera-controls', 'none'));
  assert.equal(await inside(page, '.stage').getAttribute('aria-label'), 'A corner of a room. H lists all keys.');
  const still = await player(page, (it) => it.camera);
  await press('Home', 'ArrowRight', 'l', 'r', 'w', 'h');
  const kept = await player(page, (it) => [Math.round(12 * it.currentTime), it.loop, it.camera]);
  assert.deepEqual(kept, [1, false, still]);
  assert.doesNotMatch(await inside(page, '.panel.keys').textContent(), /orbit|fly|next camera/);
  await press('Escape', ' ');
  await until(page, (it) => !it.paused);
  await inside(page, 'input[aria-label="Time"]').focus();
  await press(' ');
  assert.equal(await player(page, (it) => it.paused), true);
  await close(page);
});

scenario('copies a link to a view at a time, which restores both', async () => {
  const page = await open(WIDE);
  await shown(page);
  await player(page, (it) => {
    it.currentTime = 1.25;
    it.camera = 'left';
  });
  const camera = await player(page, (it) => it.camera);
  await button(page, 'Copy link here and now').click();
  await page.waitForFunction(() => navigator.clipboard.readText().then((text) => text.includes('#')));
  const link = await page.evaluate(() => navigator.clipboard.readText());
  assert.equal(new URL(link).hash, `#t=1.25&camera=${camera.replaceAll(' ', ',')}`);
  const other = await open(TAG, { hash: new URL(link).hash });
  await shown(other);
  assert.deepEqual(await player(other, (it) => [it.currentTime, it.camera]), [1.25, camera]);
  await other.evaluate(() => {
    location.hash = '#t=0.5';
  });
  await until(other, (it) => it.currentTime === 0.5);
  await close(page);
  await close(other);
});

scenario('works twice on a page, in a shadow root, and put back', async () => {
  const page = await open(`<div id="host"></div>${TAG.replace('src', 'id="b" src')}`, { hash: '#t=1&player=b' });
  await page.evaluate((tag) => {
    const root = document.querySelector('#host').attachShadow({ mode: 'open' });
    root.innerHTML = `<style>kpc-player { width: 96px; height: 96px }</style>${tag}`;
  }, TAG);
  await page.waitForFunction(
    () => document.querySelector('#host').shadowRoot.querySelector('kpc-player').readyState === 4,
    null,
    { timeout: 40_000 },
  );
  await shown(page);
  const other = await page.evaluate(
    () => document.querySelector('#host').shadowRoot.querySelector('kpc-player').currentTime,
  );
  assert.deepEqual([other, await player(page, (it) => it.currentTime)], [0, 1]);
  const put = await player(page, async (it) => {
    it.camera = 'left';
    const { camera } = it;
    const canvas = it.shadowRoot.querySelector('canvas');
    document.body.prepend(it); // moved at once: goes on
    const isSame = it.shadowRoot.querySelector('canvas') === canvas;
    it.remove();
    await new Promise((resolve) => setTimeout(resolve, 50));
    const gone = [it.shadowRoot.querySelector('canvas'), it.readyState];
    document.body.append(it);
    await new Promise((resolve) => it.addEventListener('canplay', resolve, { once: true }));
    return { isSame, gone, isKept: it.camera === camera && it.currentTime === 1 };
  });
  assert.deepEqual(put, { isSame: true, gone: [null, 0], isKept: true });
  await close(page);
});

scenario('leaves nothing behind over 50 mounts', async () => {
  const page = await open('', {
    before: (it) =>
      it.addInitScript(() => {
        globalThis.counts = { workers: 0, listeners: 0, contexts: [] };
        const { counts } = globalThis;
        globalThis.Worker = class extends Worker {
          constructor(...args) {
            super(...args);
            counts.workers++;
          }
          terminate() {
            counts.workers--;
            super.terminate();
          }
        };
        const { getContext } = HTMLCanvasElement.prototype;
        HTMLCanvasElement.prototype.getContext = function (...args) {
          const context = getContext.apply(this, args);
          counts.contexts.push(context);
          return context;
        };
        for (const target of [window, document]) {
          const { addEventListener, removeEventListener } = target;
          target.addEventListener = function (...args) {
            counts.listeners++;
            addEventListener.apply(this, args);
          };
          target.removeEventListener = function (...args) {
            counts.listeners--;
            removeEventListener.apply(this, args);
          };
        }
      }),
  });
  const value = await page.evaluate(async (tag) => {
    const { counts } = globalThis;
    const [listeners, workers] = [counts.listeners, counts.workers];
    for (let mount = 0; mount < 50; mount++) {
      document.body.innerHTML = tag;
      const player = document.querySelector('kpc-player');
      // Most are removed before they draw, some before they have a context, some before they have opened the file.
      const event = mount % 25 === 24 ? 'canplay' : mount % 3 === 0 ? 'loadstart' : 'loadedmetadata';
      await (event === 'loadstart'
        ? new Promise((resolve) => setTimeout(resolve, 5))
        : new Promise((resolve) => player.addEventListener(event, resolve, { once: true })));
      while (mount % 3 === 2 && !player.shadowRoot.querySelector('canvas')) await new Promise(requestAnimationFrame);
      player.remove();
      await new Promise((resolve) => setTimeout(resolve, 0));
    }
    await new Promise((resolve) => setTimeout(resolve, 300));
    const alive = counts.contexts.filter((context) => !context.isContextLost()).length;
    return {
      workers: counts.workers - workers,
      listeners: counts.listeners - listeners,
      alive,
      made: counts.contexts.length,
    };
  }, TAG);
  assert.ok(value.made >= 18);
  assert.deepEqual([value.workers, value.listeners, value.alive], [0, 0, 0]);
  await close(page);
});

scenario('plays the sound once the user has done something', async () => {
  const page = await open(TAG.replace('scene.kpc', 'sound.kpc').replace('muted', 'autoplay loop'), {
    before: (it) =>
      it.addInitScript(() => {
        globalThis.started = [];
        globalThis.AudioContext = class extends AudioContext {
          constructor(...args) {
            super(...args);
            globalThis.context = this;
            // As where a page plays by itself; the player resumes after a gesture.
            this.onstatechange = () => this.isPermitted || this.suspend();
          }
          resume() {
            this.isPermitted = true;
            return super.resume();
          }
        };
        const { start } = AudioBufferSourceNode.prototype;
        AudioBufferSourceNode.prototype.start = function (at, offset) {
          const { currentTime } = document.querySelector('kpc-player');
          globalThis.started.push({ at, offset, currentTime, buffer: this.buffer });
          start.call(this, at, offset);
        };
      }),
  });
  await until(page, (it) => it.currentTime > 0.1 && globalThis.context?.state === 'suspended');
  await button(page, 'Sound on').click();
  await button(page, 'Sound off').waitFor();
  await page.waitForFunction(() => globalThis.started.length > 4, null, { timeout: 40_000 });
  const value = await page.evaluate(() =>
    globalThis.started.map(({ at, offset, currentTime, buffer }) => {
      const bytes = [0, 1].flatMap((side) => [...new Uint8Array(buffer.getChannelData(side).slice().buffer)]);
      const samples = btoa(bytes.map((byte) => String.fromCharCode(byte)).join(''));
      return { at: at * 48000, offset: offset * 48000, currentTime, samples };
    }),
  );
  await inside(page, '.stage').press('m');
  assert.equal(await player(page, (it) => it.muted), true);
  await button(page, 'Sound on').waitFor();
  await player(page, (it) => {
    it.volume = 0.5;
    it.muted = false;
  });
  await button(page, 'Sound off').waitFor();
  await until(page, (it) => it.shadowRoot.querySelector('.volume').ariaValueText === '50 %');
  await close(page);
  return value;
});

const WRONG = {
  'no-such.kpc': ['not-found', /no such file/],
  'text.kpc': ['foreign', /not a \.kpc file/],
  'draft.kpc': ['draft', /draft version/],
  'half.kpc': ['damaged', /^The file is damaged\. Its owner/],
  'stub.kpc': ['cut-off', /incomplete/],
  'refused/scene.kpc': ['blocked', /^The server localhost:\d+ .* Access-Control-Allow-Origin: http:\/\/127/],
  'away/scene.kpc': ['blocked', /^The address leads to another server, .* Access-Control-Allow-Origin: http:\/\/127/],
};

for (const [src, [code, words]] of Object.entries(WRONG)) {
  scenario(`says what is wrong of ${src}: ${code}`, async () => {
    // The refusing server is another site.
    const full = src.startsWith('refused') ? `${otherSite}/${src}` : src;
    const page = await open(TAG.replace('scene.kpc', full));
    await until(page, (it) => it.error !== null);
    const { error, isRejected } = await player(page, async (it) => {
      const isRejected = await it.play().then(
        () => false,
        (thrown) => thrown.name === 'NotSupportedError',
      );
      return { error: it.error, isRejected };
    });
    assert.equal(error.code, code, error.detail);
    assert.match(error.message, words);
    assert.ok(isRejected);
    assert.equal(await inside(page, '.error p').textContent(), error.message);
    assert.ok((await events(page)).includes('error'));
    await inside(page, '.error button').click({ trial: true, timeout: 5000 }); // nothing lies above it
    if (code === 'not-found') {
      for (const odd of ['http://[', 'https://h:99999/x.kpc', '']) {
        const loading = await player(
          page,
          (it, odd) => {
            it.src = odd;
            return [it.src, it.error];
          },
          odd,
        );
        assert.deepEqual(loading, [odd, null]);
        await until(page, (it) => it.error?.code === 'not-found' && / is no address$/.test(it.error.detail));
      }
      for (const [odd, sentence] of [
        ['ftp://a.example/b.kpc', 'A page cannot fetch addresses that begin with "ftp:". Use one'],
        ['javascript:0', 'A page cannot fetch addresses that begin with "javascript:". Use one'],
        ['about:blank', 'A page cannot fetch addresses that begin with "about:". Use one'],
        ['file:///a.kpc', 'A page cannot read files of a disk.'],
      ]) {
        await page.evaluate(`document.querySelector('kpc-player').src = ${JSON.stringify(odd)}`);
        await until(page, (it, sentence) => it.error?.message.startsWith(sentence), sentence);
      }
      await player(page, (it) => {
        it.src = 'scene.kpc';
      });
      await shown(page);
      assert.equal(await inside(page, '.error').isVisible(), false);
    }
    await close(page);
  });
}

scenario('plays what is there of a file that is cut off, and says so', async () => {
  const warnings = [];
  const before = (it) => it.on('console', (message) => message.type() === 'warning' && warnings.push(message.text()));
  for (const src of ['cut.kpc', 'cut-clip.kpc']) {
    const page = await open(TAG.replace('scene.kpc', src), { before });
    await shown(page);
    await until(page, (it) =>
      it.shadowRoot.querySelector('.notice').textContent.startsWith('This file is incomplete.'),
    );
    await player(page, (it) => {
      it.currentTime = it.duration - 0.1;
      it.play();
    });
    await until(page, (it) => it.ended);
    assert.equal(await player(page, (it) => it.error), null);
    assert.match(warnings.pop(), new RegExp(`/${src}: cut off at [0-9,]+ of [0-9,]+ bytes; what is there is played$`));
    assert.equal(await inside(page, '.notice').isVisible(), true);
    await close(page);
  }
});

scenario('is opened by a gallery in a folder of its host', async () => {
  const page = await browser.newPage({ viewport: { width: 800, height: 500 } });
  noteErrors(page);
  page.on('response', (response) => response.ok() || page.errors.push(`${response.url()}: ${response.status()}`));
  await page.goto(`${address}/gallery/index.html`);
  await page.waitForFunction(() => [...document.images].every(({ naturalWidth }) => naturalWidth === 16));
  assert.equal(await page.locator('img').count(), 2);
  await page.screenshot({ path: join(folder, 'gallery.png') });
  await page.locator('a[href^="two"]').click();
  await shown(page);
  assert.match(await player(page, (it) => it.src), /\/gallery\/two[^/]*\/two[^/]*\.kpc$/);
  assert.equal(await player(page, (it) => it.error), null);
  await close(page);
});

scenario('says that there is no WebGL2', async () => {
  const page = await open(TAG, {
    before: (it) =>
      it.addInitScript(() => {
        HTMLCanvasElement.prototype.getContext = () => null;
      }),
  });
  await until(page, (it) => it.error?.code === 'no-webgl');
  assert.match(await inside(page, '.error p').textContent(), /WebGL2/);
  await close(page);
});

scenario('draws with less memory where the card has little, and says so where it has none', async () => {
  const page = await open(TAG, {
    before: (it) =>
      it.addInitScript(() => {
        const { prototype } = WebGL2RenderingContext;
        const { texStorage2D, getError } = prototype;
        const sizes = new Map([
          [prototype.RGBA32F, 16],
          [prototype.RGBA16F, 8],
        ]);
        Object.assign(globalThis, { limit: Number.POSITIVE_INFINITY, largest: 0, refused: 0 });
        prototype.texStorage2D = function (target, levels, format, width, height) {
          const bytes = (sizes.get(format) ?? 4) * width * height;
          globalThis.largest = Math.max(globalThis.largest, bytes);
          if (bytes < globalThis.limit) texStorage2D.call(this, target, levels, format, width, height);
          else this.isFull = ++globalThis.refused > 0;
        };
        prototype.getError = function () {
          const error = this.isFull ? this.OUT_OF_MEMORY : getError.call(this);
          this.isFull = false;
          return error;
        };
      }),
  });
  const reload = (limit) =>
    player(
      page,
      (it, limit) => {
        globalThis.limit = limit;
        it.src = `scene.kpc?${limit}`;
      },
      limit,
    );
  await shown(page);
  await reload(await page.evaluate(() => globalThis.largest / 2));
  await shown(page);
  await player(page, (it) => it.toBlob());
  assert.equal(await player(page, (it) => it.error), null);
  assert.ok((await page.evaluate(() => globalThis.refused)) > 0);
  await reload(0);
  await until(page, (it) => it.error?.code === 'budget');
  await close(page);
});

scenario('plays from servers that are slow, cut files short, know no ranges, compress and redirect', async () => {
  const page = await open('<kpc-player quality="fastest" muted></kpc-player>');
  for (const fault of ['slow', 'cut', 'whole', 'packed', `${otherSite}/packed`, 'moved']) {
    const state = await player(
      page,
      (it, src) => {
        it.src = src;
        return [it.readyState, it.currentTime];
      },
      `${fault}/long.kpc`,
    );
    assert.deepEqual(state, [0, 0], fault);
    await until(page, (it) => it.readyState >= 3);
    await player(page, (it) => it.play());
    await until(page, (it) => it.currentTime > 0.2);
    assert.equal(await player(page, (it) => it.error), null, fault);
  }
  await close(page);
});

scenario('notices that the file was replaced', async () => {
  const page = await open(TAG.replace('scene.kpc', 'replaced/long.kpc'));
  await until(page, (it) => it.error !== null);
  assert.equal(await player(page, (it) => it.error.code), 'replaced');
  await close(page);
});

scenario('draws again once a lost context is back', async () => {
  const page = await open(TAG.replace('muted', 'muted autoplay loop'), {
    before: (it) =>
      it.addInitScript(() => {
        const { getContext } = HTMLCanvasElement.prototype;
        HTMLCanvasElement.prototype.getContext = function (...args) {
          globalThis.gl = getContext.apply(this, args);
          return globalThis.gl;
        };
      }),
  });
  await until(page, (it) => it.currentTime > 0.1);
  await page.evaluate(() => {
    globalThis.extension = globalThis.gl.getExtension('WEBGL_lose_context');
    globalThis.extension.loseContext();
  });
  await until(page, (it) => it.shadowRoot.querySelector('.notice').textContent.includes('graphics card'));
  const range = await player(page, async (it) => {
    const early = it.toBlob(); // while it plays, which waits for the card
    await new Promise((resolve) => setTimeout(resolve, 200));
    globalThis.extension.restoreContext();
    const picture = await createImageBitmap(await early);
    const canvas = new OffscreenCanvas(picture.width, picture.height);
    const context = canvas.getContext('2d');
    context.drawImage(picture, 0, 0);
    const { data } = context.getImageData(0, 0, picture.width, picture.height);
    const reds = data.filter((_, i) => i % 4 === 0);
    return Math.max(...reds) - Math.min(...reds);
  });
  assert.ok(range > 100);
  await until(page, (it) => it.shadowRoot.querySelector('.notice').textContent === '');
  const rejected = await player(page, async (it) => {
    it.pause();
    globalThis.extension.loseContext();
    const picture = it.toBlob();
    await new Promise((resolve) => setTimeout(resolve, 200));
    it.remove();
    return picture.then(
      () => 'resolved',
      (error) => `${error.name}: ${error.message}`,
    );
  });
  assert.equal(rejected, 'InvalidStateError: the scene was removed before its picture was there');
  await close(page);
});

scenario('fills the screen, or the window where it may not', async () => {
  const page = await open(TAG);
  await shown(page);
  await button(page, 'Fill the screen').click();
  await until(page, (it) => document.fullscreenElement === it);
  await inside(page, '.stage').press('f');
  await until(page, () => document.fullscreenElement === null);
  await page.evaluate(() => Object.defineProperty(document, 'fullscreenEnabled', { value: false }));
  await button(page, 'Fill the screen').click();
  const size = () => player(page, (it) => [it.clientWidth, it.clientHeight]);
  assert.deepEqual(await size(), [420, 300]);
  await inside(page, '.stage').press('Escape');
  assert.deepEqual(await size(), [240, 180]);
  await button(page, 'Fill the screen').waitFor();
  await close(page);
});

scenario('draws coarsely where the card lacks memory, before it gives up', async () => {
  const page = await open(TAG.replace('fastest', 'fine'), {
    before: (it) =>
      it.addInitScript(() => {
        globalThis.failing = [240];
        const { texStorage2D } = WebGL2RenderingContext.prototype;
        WebGL2RenderingContext.prototype.texStorage2D = function (...args) {
          if (globalThis.failing.includes(args[3])) throw new RangeError('Array buffer allocation failed');
          texStorage2D.apply(this, args);
        };
      }),
  });
  await shown(page);
  const shownSize = () => player(page, (it) => it.shadowRoot.querySelector('canvas').width);
  assert.equal(await shownSize(), 120);
  await page.evaluate(() => {
    globalThis.failing = [240, 60];
    document.querySelector('kpc-player').load();
  });
  await until(page, (it) => it.error?.code === 'budget');
  await close(page);
});

scenario('shows the poster and loads nothing before it is asked to', async () => {
  const page = await open(TAG.replace('muted', 'muted preload="none" poster="poster.png"'));
  await page.waitForTimeout(200);
  await player(page, (it) => {
    it.src = 'scene.kpc?again';
  });
  await page.waitForTimeout(200);
  assert.deepEqual(await events(page), []);
  assert.equal(await inside(page, '.poster').evaluate((it) => it.naturalWidth > 0), true);
  await inside(page, '.large').click();
  await until(page, (it) => it.currentTime > 0.1);
  assert.equal(await inside(page, '.large').isVisible(), false);
  assert.ok(await inside(page, '.poster').evaluate((it) => it.classList.contains('done')));
  // Another value of preload holds at once.
  await page.evaluate(async () => {
    const it = Object.assign(document.createElement('kpc-player'), { preload: 'none', src: 'scene.kpc' });
    document.body.append(it);
    it.preload = 'metadata';
    await new Promise((resolve) => it.addEventListener('loadedmetadata', resolve, { once: true }));
  });
  await close(page);
});

scenario('shows a coarse picture or the poster with preload="metadata"', async () => {
  const tag = TAG.replace('muted', 'muted preload="metadata"').replace('scene.kpc', 'long.kpc');
  const page = await open(tag + tag.replace('muted', 'muted poster="poster.png"'));
  await shown(page);
  const other = await page.evaluate(async () => {
    const [, it] = document.querySelectorAll('kpc-player');
    await new Promise((resolve) => setTimeout(resolve, 300));
    return { readyState: it.readyState, hasPoster: it.shadowRoot.querySelector('.poster').checkVisibility() };
  });
  assert.deepEqual(other, { readyState: 1, hasPoster: true });
  await page.evaluate(() => {
    document.querySelectorAll('kpc-player')[1].preload = 'auto';
  });
  await until(page, () => document.querySelectorAll('kpc-player')[1].readyState >= 2);
  assert.ok((await player(page, (it) => it.duration)) > 7);
  assert.equal(await inside(page, '.large').isVisible(), true);
  const read = () =>
    page.evaluate(() => performance.getEntriesByType('resource').filter(({ name }) => /kpc$/.test(name)));
  const before = (await read()).length;
  await player(page, (it) => it.play());
  await until(page, (it) => it.readyState >= 3 && it.currentTime > 0);
  // A request counts once its answer has arrived whole.
  for (let tries = 0; (await read()).length <= before && tries < 200; tries++) await page.waitForTimeout(50);
  assert.ok((await read()).length > before);
  await close(page);
});

scenario('does not start by itself where motion is to be reduced', async () => {
  const page = await open(TAG.replace('muted', 'muted autoplay'), { context: { reducedMotion: 'reduce' } });
  await shown(page);
  assert.equal(await player(page, (it) => it.paused), true);
  await close(page);
});

scenario('works under a strict Content-Security-Policy', async () => {
  const page = await open(TAG, {
    csp: "default-src 'none'; script-src 'self' 'wasm-unsafe-eval'; worker-src 'self'; connect-src 'self'",
    isPlain: true,
    context: { viewport: { width: 200, height: 200 } },
  });
  await until(page, (it) => it.readyState === 4);
  assert.equal(await inside(page, '.bar').evaluate((it) => getComputedStyle(it).position), 'absolute');
  await close(page);
});

const SCREENS = {
  desktop: { viewport: { width: 1280, height: 800 } },
  portrait: { viewport: { width: 390, height: 844 }, hasTouch: true, isMobile: true },
  landscape: { viewport: { width: 844, height: 390 }, hasTouch: true, isMobile: true },
};
const WHOLE =
  '<style>html, body { margin: 0; height: 100% } kpc-player { display: block; height: 100%; aspect-ratio: auto }</style>';

for (const [name, context] of Object.entries(SCREENS)) {
  scenario(`fits the screen: ${name}`, async () => {
    const direction = name === 'portrait' ? 'rtl' : 'ltr';
    const tag = TAG.replace('quality="fastest"', `dir="${direction}"`).replace(
      'scene.kpc',
      name === 'desktop' ? 'scene.kpc' : 'sound.kpc',
    );
    const page = await open(WHOLE + tag, {
      context,
      isPlain: true,
    });
    await shown(page);
    await button(page, 'Settings').click();
    const { width, height } = context.viewport;
    const boxes = await player(page, (it) => {
      const targets = [...it.shadowRoot.querySelectorAll('button, label, input[type=range]')];
      const boxOf = (target) => ({
        label: target.ariaLabel ?? target.textContent,
        ...target.getBoundingClientRect().toJSON(),
      });
      return targets.filter((target) => target.checkVisibility()).map(boxOf);
    });
    assert.ok(boxes.length >= 10);
    for (const box of boxes) {
      assert.ok(box.width >= 44 && box.height >= 44, `${box.label} is small: ${box.width}x${box.height}`);
      assert.ok(box.left >= -8 && box.right <= width + 8, `${box.label} is cut off`);
    }
    const sounds = boxes.filter(({ label }) => ['Sound on', 'Volume'].includes(label)).length;
    assert.equal(sounds, { desktop: 0, portrait: 1, landscape: 2 }[name]);
    const [play] = boxes.filter(({ label }) => label === 'Play');
    assert.ok(play.left < width / 2 && play.bottom <= height);
    assert.equal(await player(page, () => document.documentElement.scrollWidth <= innerWidth), true);
    await page.screenshot({ path: join(folder, `${name}.png`) });
    await close(page);
  });
}

scenario('can be seen in the colours that a user forces', async () => {
  const page = await open(TAG, { context: { forcedColors: 'active' } });
  await shown(page);
  await button(page, 'Settings').click();
  const colours = await inside(page, '.bar').evaluate((bar) => {
    const [play, bare] = ['.button', '.track'].map((name) => getComputedStyle(bar.querySelector(name)));
    return [play.color, getComputedStyle(bar).backgroundColor, bare.backgroundColor];
  });
  assert.equal(new Set(colours).size, 3);
  for (const colour of colours) assert.match(colour, /^rgb\(/); // none is seen through
  await page.screenshot({ path: join(folder, 'forced.png') });
  await close(page);
});

scenario('works where Trusted Types let workers pass, and says so where they do not', async () => {
  const csp = "require-trusted-types-for 'script'";
  const page = await open(TAG, { csp });
  await until(page, (it) => it.error?.code === 'worker');
  assert.match(
    await player(page, (it) => it.error.message),
    /Trusted Types, if it demands them, need a default policy/,
  );
  await close(page);
  const permitting = await open(TAG, {
    csp,
    before: (it) =>
      it.addInitScript(() => trustedTypes.createPolicy('default', { createScriptURL: (address) => address })),
  });
  await shown(permitting);
  await close(permitting);
});

scenario('can be used without a mouse', async () => {
  const page = await open(WIDE);
  await shown(page);
  const labels = [];
  for (let tab = 0; tab < 8; tab++) {
    await page.keyboard.press('Tab');
    labels.push(await player(page, (it) => it.shadowRoot.activeElement?.ariaLabel ?? 'none'));
  }
  assert.match(labels[0], /^A corner of a room\. Drag/);
  const names = ['Play the scene', 'Time', 'Play', 'Views', 'Settings', 'Copy link here and now', 'Fill the screen'];
  assert.deepEqual(labels.slice(1), names);
  await close(page);
});

headsetScenarios(scenario, { open, shown, player, button, inside, close, tag: TAG });
scrollingScenarios(scenario, { open, shown, player, inside, close, numbers, tag: TAG });
threeScenarios(scenario, browser, address, folder);

/** Milliseconds that a scenario may take. */
const LIMIT_MS = 90_000;

/** Run a scenario, and wait for it so long. */
function limited(run) {
  let timer;
  const late = new Promise((_, reject) => {
    timer = setTimeout(() => reject(new Error(`not done after ${LIMIT_MS / 1000} s`)), LIMIT_MS);
  });
  return Promise.race([run(), late]).finally(() => clearTimeout(timer));
}

const results = {};
try {
  for (const [name, run] of scenarios) {
    if (chosen.length > 0 && !chosen.some((part) => name.includes(part))) continue;
    const started = performance.now();
    try {
      results[name] = { error: null, value: await limited(run) };
    } catch (error) {
      results[name] = { error: error.stack, value: null };
      for (const context of browser.contexts()) await context.close();
    }
    console.error(`${((performance.now() - started) / 1000).toFixed(1)} s ${name}: ${results[name].error ?? 'passed'}`);
  }
} finally {
  await browser.close();
}
console.log(JSON.stringify(results));
