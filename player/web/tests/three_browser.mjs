/** KpcObject in scenes of three.js: part of element_browser.mjs. */

import assert from 'node:assert/strict';
import { join } from 'node:path';

const IMPORTS = { three: './three.module.js', 'kpc-player/three': './kpc-three.js' };
/** The cameras of pictures, what they are made with, and what is called of them; options of what draws. */
const CAMERAS = {
  perspective: ['PerspectiveCamera', [40, 4 / 3, 0.3, 6], ['setViewOffset', [80, 60, 6, -4, 80, 60]]],
  reversed: ['PerspectiveCamera', [40, 4 / 3, 0.3, 6], null, { reversedDepthBuffer: true }],
  target: ['PerspectiveCamera', [40, 4 / 3, 0.3, 6], null, { samples: 4 }],
  orthographic: ['OrthographicCamera', [-0.8, 0.8, 0.6, -0.6, 0.1, 9], null],
};

/** In the page: draw a clip, moved, turned and scaled, among meshes; return pictures and all that is in them. */
async function pictures(cameras) {
  const THREE = await import('three');
  const { KpcObject } = await import('kpc-player/three');
  const [width, height] = [80, 60];
  const actor = new KpcObject('scene.kpc', { quality: 'reference' });
  const events = [];
  for (const name of ['loadedmetadata', 'canplay', 'error']) actor.addEventListener(name, () => events.push(name));
  actor.currentTime = 0.75;
  let begun = null;
  actor.addEventListener('loadedmetadata', () => {
    begun = actor.currentTime;
  });
  actor.position.set(1, 0.3, -0.5);
  actor.rotation.set(-1.5, 0.1, 0.2);
  actor.scale.setScalar(0.5);
  actor.updateMatrixWorld();
  const scene = new THREE.Scene().add(actor);
  scene.background = new THREE.Color(0x204060);
  // Squares across y in the space of the clip: before all, through its middle, behind, and one to be seen through.
  const squares = [
    { colour: [1, 0, 0], at: [-0.2, -1, 0.9], size: 0.5, opacity: 1 },
    { colour: [0, 1, 0], at: [0.6, 0.1, 0.4], size: 1, opacity: 1 },
    { colour: [1, 1, 0], at: [-0.5, 1.2, 0.4], size: 1.6, opacity: 1 },
    { colour: [0, 0, 1], at: [-0.4, 0.8, 1.2], size: 1.4, opacity: 0.5 },
  ].map(({ colour, at, size, opacity }) => {
    const material = new THREE.MeshBasicMaterial({ color: new THREE.Color(...colour), side: THREE.DoubleSide });
    Object.assign(material, { opacity, transparent: opacity < 1, depthWrite: opacity === 1 });
    const mesh = new THREE.Mesh(new THREE.PlaneGeometry(size, size), material);
    mesh.position.set(...at);
    mesh.rotation.x = Math.PI / 2;
    mesh.renderOrder = opacity < 1 ? 1 : 0; // after the clip
    actor.add(mesh);
    return { colour, size, opacity, mesh };
  });
  const frame = () => new Promise(requestAnimationFrame);
  const drawn = {};
  for (const [name, [kind, made, call, options = {}]] of Object.entries(cameras)) {
    const renderer = new THREE.WebGLRenderer(options);
    const camera = new THREE[kind](...made);
    camera.position.copy(actor.localToWorld(new THREE.Vector3(0.8, -3.2, 1.3)));
    camera.up.set(0, 1, 0);
    camera.lookAt(actor.localToWorld(new THREE.Vector3(0, 0, 0.6)));
    if (call) camera[call[0]](...call[1]);
    const { samples } = options;
    const target = samples && new THREE.WebGLRenderTarget(width, height, { samples, type: THREE.HalfFloatType });
    const shown = new THREE.Mesh(new THREE.PlaneGeometry(2, 2), new THREE.MeshBasicMaterial({ map: target?.texture }));
    /** Draw, by way of linear light if there is a target. */
    const draw = () => {
      if (target) renderer.setRenderTarget(target);
      renderer.render(scene, camera);
      if (!target) return;
      renderer.setRenderTarget(null);
      renderer.render(shown, new THREE.OrthographicCamera(-1, 1, 1, -1, -1, 1));
    };
    let version = -1;
    for (let same = 0; same < 3 && !actor.error; await frame()) {
      const isWhole = actor.clip?.isSettled;
      renderer.setSize(...(isWhole ? [width, height] : [4, 3]), false);
      actor.currentTime = 1.3;
      draw();
      same =
        isWhole &&
        events.filter((name) => name === 'canplay').length > Object.keys(drawn).length &&
        actor.clip.version === version
          ? same + 1
          : 0;
      version = actor.clip?.version ?? -1;
    }
    draw();
    const inverse = camera.projectionMatrix.clone().invert();
    drawn[name] = {
      picture: renderer.domElement.toDataURL().split(',')[1],
      camera: camera.matrixWorld.elements,
      inverse: inverse.elements,
      isReversed: camera.reversedDepth ?? false,
      error: renderer.getContext().getError(),
    };
    renderer.dispose();
  }
  const hit = new THREE.Raycaster(new THREE.Vector3(1, 0.3, 9), new THREE.Vector3(0, 0, -1)).intersectObject(
    actor,
    false,
  );
  const found = {
    width,
    height,
    drawn,
    events,
    hits: hit.length,
    message: actor.error?.message ?? null,
    begun,
    object: actor.matrixWorld.elements,
    squares: squares.map(({ mesh, ...square }) => ({ ...square, matrix: mesh.matrixWorld.elements })),
  };
  actor.dispose();
  return found;
}

/** In the page: return what is wrong with a clip that is treated as all meshes are. */
async function treated() {
  const THREE = await import('three');
  const { KpcObject } = await import('kpc-player/three');
  const actor = new KpcObject('scene.kpc', { quality: 'fine', loop: true });
  actor.position.set(1, 2, 3);
  actor.add(new THREE.Group());
  new THREE.Scene().add(actor).traverse((object) => Object.assign(object, { castShadow: true, receiveShadow: true }));
  actor.currentTime = 0.5;
  const clone = actor.clone();
  await new Promise((resolve) => {
    clone.addEventListener('loadedmetadata', resolve);
    clone.addEventListener('error', resolve);
  });
  const sentenceOf = (make) => {
    try {
      make();
    } catch (error) {
      return error.message;
    }
  };
  const found = {
    shadows: [actor.castShadow, actor.receiveShadow, actor.children[0].castShadow],
    clone: [clone.error?.message, clone.position.z, clone.quality, clone.loop, clone.children.length],
    isItself: clone instanceof KpcObject && clone.geometry !== actor.geometry && clone.material !== actor.material,
    time: clone.currentTime,
    odd: [() => new KpcObject('scene.kpc', { quality: 'nope' }), () => Object.assign(actor, { quality: '' })].map(
      sentenceOf,
    ),
  };
  for (const object of [actor, clone]) object.dispose();
  return found;
}

export function threeScenarios(scenario, browser, address, folder) {
  async function open(path) {
    const context = await browser.newContext({ viewport: { width: 320, height: 240 } });
    const page = await context.newPage();
    page.errors = [];
    page.on('pageerror', (error) => page.errors.push(error.message));
    await page.goto(`${address}/${path}`);
    return page;
  }

  async function close(page) {
    assert.deepEqual(page.errors, []);
    await page.context().close();
  }

  const openEmpty = () => {
    const html = `<!doctype html><title>Test</title><script type="importmap">${JSON.stringify({ imports: IMPORTS })}</script>`;
    return open(`page.html?${encodeURIComponent(html)}`);
  };

  scenario('is treated as all meshes of three.js', async () => {
    const shown = await openEmpty();
    const { odd, ...found } = await shown.evaluate(treated);
    assert.deepEqual(found, {
      shadows: [false, false, true],
      clone: [undefined, 3, 'fine', true, 1],
      isItself: true,
      time: 0.5,
    });
    for (const sentence of odd) assert.match(sentence, /^quality must be one of auto, fastest, .*reference, not /);
    await close(shown);
  });

  scenario('draws a clip among meshes of three.js', async () => {
    const shown = await openEmpty();
    const found = await shown.evaluate(`(${pictures})(${JSON.stringify(CAMERAS)})`);
    assert.equal(found.message, null);
    assert.ok(found.begun > 0, 'a time that was set before the clip was there is forgotten');
    await close(shown);
    return found;
  });

  scenario('shows the example of three.js', async () => {
    const page = await open('three.html');
    // The ring leaves the corner free, which is black until the clip is there.
    const isShown = () => {
      const context = new OffscreenCanvas(1, 1).getContext('2d');
      context.drawImage(document.querySelector('canvas'), 0, 0);
      return context.getImageData(0, 0, 1, 1).data[0] > 0;
    };
    await page.waitForFunction(isShown, null, { polling: 'raf', timeout: 40_000 });
    await page.screenshot({ path: join(folder, 'three.png') });
    await close(page);
  });
}
