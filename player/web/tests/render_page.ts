/** A page that draws scenes on demand, for tests and benches in a real browser; `browser.mjs` drives it. */

import { Scene } from '../src/container/scene.js';
import { loadCore } from '../src/decoder/module.js';
import { Layout } from '../src/render/atlas.js';
import { type Camera, texelsPerPixel } from '../src/render/camera.js';
import type { DrawnScene } from '../src/render/drawn_scene.js';
import { costOf, Pace, type Setting, settingsOf } from '../src/render/pace.js';
import type { Moment, ShownPart } from '../src/render/picture_job.js';
import { LEVELS, type Level } from '../src/render/quality.js';
import { type DrawnPicture, Renderer } from '../src/render/renderer.js';
import { sceneDefines } from '../src/render/scene_textures.js';
import { type Composed, compose, constants, type Defines } from '../src/render/shader.js';
import { blockArrays, decoderArrays } from '../src/render/shader_constants.js';
import { FIRST_RAYS } from '../src/render/speed.js';
import { Clip, type SceneEvent } from '../src/streaming/clip.js';
import type { SceneStream } from '../src/streaming/scene_stream.js';

/** A picture to draw. */
interface Job {
  file: string;
  camera: Camera;
  time: number; // in [0, 1] of the clip
  level: Level | Setting | 'auto';
  part?: ShownPart;
  appearance?: string | null;
  halfFloat?: boolean;
}

interface Opened {
  clip: Clip;
  renderer: Renderer;
  scenes: Map<SceneStream, DrawnScene>;
}

/** Frames after which a choice on a device of constant speed no longer changes. */
const CHOOSING_FRAMES = 500;

const opened = new Map<string, Opened>();
const pause = (ms: number) => new Promise((resolve) => setTimeout(resolve, ms));

async function open({ file, camera, halfFloat = false }: Job): Promise<Opened> {
  const known = opened.get(file);
  if (known) return known;
  const clip = await Clip.open(await (await fetch(`/${file}`)).arrayBuffer(), { pool: { size: 1 } });
  const renderer = new Renderer(new OffscreenCanvas(camera.width, camera.height), { halfFloat });
  const scenes = new Map(clip.scenes.map((scene) => [scene, renderer.addScene(scene)]));
  clip.addEventListener('open', (event) => {
    const { scene } = event as SceneEvent;
    scenes.set(scene, renderer.addScene(scene));
  });
  clip.addEventListener('release', (event) => {
    const drawn = scenes.get((event as SceneEvent).scene);
    if (drawn) renderer.removeScene(drawn);
  });
  const found = { clip, renderer, scenes };
  opened.set(file, found);
  return found;
}

/** Open what a job needs, and return how to draw it. */
async function prepared(job: Job) {
  const { clip, renderer, scenes } = await open(job);
  const { canvas } = renderer.gl;
  if (canvas.width !== job.camera.width || canvas.height !== job.camera.height) {
    [canvas.width, canvas.height] = [job.camera.width, job.camera.height];
  }
  const time = job.time * clip.duration;
  clip.setPlayhead({ time });
  const moments = (): Moment[] =>
    clip.parts(time).map((part) => ({ ...part, scene: scenes.get(part.scene) as DrawnScene }));
  const appearance = clip.scenes[0].appearances.find(({ name }) => name === job.appearance)?.embedding ?? null;
  const options = { level: job.level, part: job.part, appearance };
  return { clip, renderer, moments, options, parts: clip.timeline.blendAt(job.time).length };
}

/** Draw until all has arrived and the picture is sharp. */
async function drawn(job: Job) {
  const { clip, renderer, moments, options, parts } = await prepared(job);
  for (let isDone = false; !isDone; await pause(1)) {
    clip.setPlayhead({ time: job.time * clip.duration });
    const { isSharp } = renderer.draw(job.camera, moments(), options);
    isDone = isSharp && clip.isSettled && moments().length === parts;
  }
  return renderer;
}

/** Wait until the card has drawn all. */
async function finished(renderer: Renderer): Promise<void> {
  const { gl } = renderer;
  const fence = gl.fenceSync(gl.SYNC_GPU_COMMANDS_COMPLETE, 0) as WebGLSync;
  gl.flush();
  while (gl.getSyncParameter(fence, gl.SYNC_STATUS) !== gl.SIGNALED) await pause(0);
  gl.deleteSync(fence);
  while (renderer.isBusy) await pause(0);
}

/** Draw one picture, all that it needs being there. */
async function drawnOnce(job: Job): Promise<Renderer> {
  const { renderer, moments, options } = await prepared(job);
  const before = renderer.pictures;
  for (let isSharp = false; renderer.pictures === before && !isSharp; await finished(renderer)) {
    isSharp = renderer.draw(job.camera, moments(), options).isSharp;
  }
  return renderer;
}

/** Return the bytes RGBA of the last picture, rows from below, in base64. */
function pixelsOf(renderer: Renderer, { width, height }: Camera): string {
  const { gl } = renderer;
  const pixels = new Uint8Array(4 * width * height);
  renderer.present();
  gl.bindFramebuffer(gl.FRAMEBUFFER, null);
  gl.readPixels(0, 0, width, height, gl.RGBA, gl.UNSIGNED_BYTE, pixels);
  return base64(pixels);
}

function base64(bytes: Uint8Array): string {
  let text = '';
  for (let i = 0; i < bytes.length; i += 8192) text += String.fromCharCode(...bytes.subarray(i, i + 8192));
  return btoa(text);
}

const page = {
  /** Draw a picture until it is sharp; return its bytes RGBA, rows from below, in base64. */
  async picture(job: Job) {
    const renderer = await drawn(job);
    return { pixels: pixelsOf(renderer, job.camera), error: renderer.gl.getError(), name: renderer.name };
  },

  /**
   * Draw the rays of a picture; return how many texels and cells they look up, and the colours if none is resampled.
   */
  async counted(job: Job) {
    const renderer = await drawn({ ...job, level: { level: 'fastest', scale: 0.1 } });
    const { moments, options } = await prepared(job);
    const rasters = await renderer.read(job.camera, moments(), { ...options, isCounted: true });
    const [{ width, height, rgba, sums }] = rasters;
    const sum = (channel: number) => sums.reduce((all, x, i) => (i % 4 === channel ? all + x : all), 0);
    const isWhole = width === job.camera.width && height === job.camera.height;
    const pixels = isWhole ? base64(Uint8Array.from(rgba, (x) => Math.round(255 * Math.min(Math.max(x, 0), 1)))) : null;
    const { perSample, folding } = moments()[0].scene.lookUps(job.level === 'reference');
    return { width, height, samples: sum(1), cells: sum(2), perSample, folding, pixels };
  },

  /** Return what `auto` chooses from. */
  async settings(job: Job): Promise<(Setting & { cost: number })[]> {
    const texels = texelsPerPixel((await open(job)).clip.scenes[0], job.camera);
    return settingsOf(texels).map((setting) => ({ ...setting, cost: costOf(setting, texels) }));
  },

  /** Return which of the settings `auto` chooses on a device that takes so many seconds for each. */
  async chosen(job: Job, seconds: number[], fps: number): Promise<number> {
    const texels = texelsPerPixel((await open(job)).clip.scenes[0], job.camera);
    const names = settingsOf(texels).map((setting) => JSON.stringify(setting));
    const pace = new Pace(1 / fps, FIRST_RAYS);
    for (let i = 0; i < CHOOSING_FRAMES; i++) {
      const setting = pace.setting(texels);
      pace.record(costOf(setting, texels), seconds[names.indexOf(JSON.stringify(setting))]);
    }
    return names.indexOf(JSON.stringify(pace.setting(texels)));
  },

  /**
   * Play for some seconds as fast as it goes, from one camera after the other; return the milliseconds between
   * pictures, and what was drawn last.
   */
  async play(job: Job, seconds: number, cameras: Camera[]) {
    const renderer = await drawn(job);
    const clip = (await open(job)).clip;
    const began = performance.now();
    const shown: number[] = [];
    let state: DrawnPicture | null = null;
    while (performance.now() < began + 1000 * seconds) {
      const time = ((performance.now() - began) / 1000 / clip.duration) % 1;
      const { moments, options } = await prepared({ ...job, time });
      const before: number = state?.pictures ?? 0;
      const camera = cameras[shown.length % cameras.length];
      do {
        state = renderer.draw(camera, moments(), options);
        await finished(renderer);
      } while (state.pictures === before && !state.isSharp);
      shown.push(performance.now());
    }
    return { ms: shown.slice(1).map((at, i) => at - shown[i]), level: state?.level, scale: state?.scale };
  },

  /** Decode all segments of a scene on one core; return the milliseconds of the second time, when all is compiled. */
  async decode(file: string): Promise<number> {
    const bytes = new Uint8Array(await (await fetch(`/${file}`)).arrayBuffer());
    const core = await loadCore();
    let took = 0;
    for (let turn = 0; turn < 2; turn++) {
      const scene = new Scene(bytes, core);
      const started = performance.now();
      for (const [number, { kind }] of scene.container.index.entries()) if (kind === 'PLNE') scene.segment(number);
      took = performance.now() - started;
    }
    return took;
  },

  /** Draw pictures one after the other, all that they need being there; return the milliseconds that each took. */
  async frames(jobs: Job[]): Promise<number[]> {
    const took: number[] = [];
    for (const job of jobs) {
      const started = performance.now();
      await drawnOnce(job);
      took.push(performance.now() - started);
    }
    return took;
  },

  /** Draw pictures one after the other, the first whole, as they come while the clip plays; return each. */
  async played(jobs: Job[]): Promise<{ pixels: string; error: number }[]> {
    for (let turn = 0; turn < 10; turn++) await drawnOnce(jobs[turn % 2]); // until all is compiled
    await drawn(jobs[0]);
    const pictures: { pixels: string; error: number }[] = [];
    for (const job of jobs) {
      const renderer = await drawnOnce(job);
      pictures.push({ pixels: pixelsOf(renderer, job.camera), error: renderer.gl.getError() });
    }
    return pictures;
  },

  /** Take the context away and give it back; return the picture of a job before, and the one after. */
  async lost(job: Job) {
    const before = await page.picture(job);
    const { gl } = (await open(job)).renderer;
    const extension = gl.getExtension('WEBGL_lose_context') as WEBGL_lose_context;
    extension.loseContext();
    while (!gl.isContextLost()) await pause(1);
    await pause(10);
    extension.restoreContext();
    while (gl.isContextLost()) await pause(1);
    return [before, await page.picture(job)];
  },

  /** Return the text of shader files for the first scene of a file, with macros besides the scene's. */
  async shaders(job: Job, names: string[], defines: Defines): Promise<Composed[]> {
    const [scene] = (await open(job)).clip.scenes;
    const layout = new Layout(scene);
    const written = {
      decoder_weights: constants(decoderArrays(scene.decoder, scene, layout)),
      plane_blocks: constants(blockArrays(scene, layout)),
    };
    return names.map((name) => compose(name, { ...sceneDefines(scene, layout), ...defines }, written));
  },

  levels: () => LEVELS,

  /** Close everything; return the objects that are left on cards. */
  close(): number {
    const all = [...opened.values()];
    opened.clear();
    for (const { clip, renderer } of all) {
      clip.close();
      renderer.dispose();
    }
    return all.reduce((sum, { renderer }) => sum + renderer.objects, 0);
  },
};

Object.assign(globalThis, { page });
