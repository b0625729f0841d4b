/** <kpc-player> in an emulated headset: part of element_browser.mjs. */

import assert from 'node:assert/strict';

/** Before the page: a headset is there, and what the player is shown in it can be read. */
function install() {
  const device = new globalThis.IWER.XRDevice(globalThis.IWER.metaQuest3);
  device.installRuntime({ forceInstall: true });
  device.stereoEnabled = true;
  device.position.set(0, 0, 0);
  globalThis.device = device;
  const request = navigator.xr.requestSession.bind(navigator.xr);
  navigator.xr.requestSession = async (...args) => {
    globalThis.session = await request(...args);
    globalThis.session.addEventListener('end', () => {
      globalThis.session.ended = true;
    });
    return globalThis.session;
  };
}

/** In the page: return what the next frame but some shows, as a PNG in base64. */
async function frame(count) {
  const { session } = globalThis;
  for (let i = 0; i < count; i++) await new Promise((resolve) => session.requestAnimationFrame(resolve));
  return new Promise((resolve) => {
    // After the player's, which asks first.
    session.requestAnimationFrame(() => {
      const canvas = session.renderState.baseLayer.context.canvas;
      resolve(canvas.toDataURL().split(',')[1]);
    });
  });
}

export function headsetScenarios(scenario, { open, shown, player, button, inside, close, tag }) {
  scenario('shows the clip in a headset', async () => {
    const context = { viewport: { width: 320, height: 160 } };
    const before = async (page) => {
      await page.addInitScript({ path: 'node_modules/iwer/build/iwer.min.js' });
      await page.addInitScript(install);
    };
    const page = await open(tag, { context, before });
    await shown(page);
    const enter = button(page, 'Watch in the headset');
    await enter.click();
    await page.waitForFunction(() => globalThis.session?.renderState.baseLayer);
    const take = (count) => page.evaluate(`(${frame})(${count})`);
    const opening = await take(3);
    await page.evaluate(() => globalThis.device.controllers.right.updateAxes('thumbstick', 1, 0));
    await take(2);
    await page.evaluate(() => globalThis.device.controllers.right.updateAxes('thumbstick', 0, 0));
    const turned = await take(1);
    await page.evaluate(() => globalThis.device.controllers.right.updateButtonValue('squeeze', 1));
    await take(1);
    await page.evaluate(() => {
      globalThis.device.controllers.right.position.y += 0.3;
    });
    const dragged = await take(2);
    await page.evaluate(() => globalThis.device.controllers.right.updateButtonValue('squeeze', 0));
    await player(page, (it) => it.toggleHeadset()); // leaves it
    await page.waitForFunction(() => globalThis.session.ended);
    const bytes = await player(page, async (it) => (await it.toBlob()).size);
    assert.ok(bytes > 5000); // the page shows it again
    await page.evaluate(() => {
      navigator.xr.requestSession = async () => {
        throw new DOMException('it is in use', 'InvalidStateError');
      };
    });
    await enter.click();
    await inside(page, '.notice').getByText('The headset cannot show the scene: it is in use.').waitFor();
    await close(page);
    return { opening, turned, dragged };
  });
}
