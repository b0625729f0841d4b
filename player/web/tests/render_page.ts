/** A page that draws scenes on demand, for tests and benches in a real browser; `browser.mjs` drives it. */

import { Groups } from '../src/container/groups.js';
import { Core } from '../src/decoder/core.js';
import { Layout } from '../src/render/atlas.js';
import type { Camera } from '../src/render/camera.js';
import type { DrawnScene } from '../src/render/drawn_scene.js';
import type { Rung } from '../src/render/pace.js';
import type { Moment, ShownPart } from '../src/render/picture_job.js';
import { LEVELS, type Level } from '../src/render/quality.js';
import { Renderer } from '../src/render/renderer.js';
import { sceneDefines } from '../src/render/scene_textures.js';
import { type Composed, compose, constants, type Defines } from '../src/render/shader.js';
import { blockArrays, decoderArrays } from '../src/render/shader_constants.js';
import { sourceOf } from './scene_source.js';

/** A picture to draw. */
export interface Job {
  file: string;
  camera: Camera;
  time: number; // in [0, 1] of the clip
  level: Level | Rung | 'auto';
  part?: ShownPart;
  appearance?: string | null;
  halfFloat?: boolean;
}

interface Opened {
  groups: Groups;
  renderer: Renderer;
  scenes: Map<number, DrawnScene>;
}

const opened = new Map<string, Opened>();
let core: Core | null = null;

async function bytesOf(path: string): Promise<Uint8Array<ArrayBuffer>> {
  return new Uint8Array(await (await fetch(path)).arrayBuffer());
}

async function open({ file, camera, halfFloat = false }: Job): Promise<Opened> {
  const known = opened.get(file);
  if (known) return known;
  core ??= new Core(await WebAssembly.compile(await bytesOf('/kpc_core.wasm')));
  const groups = new Groups(await bytesOf(`/${file}`), core);
  const canvas = new OffscreenCanvas(camera.width, camera.height);
  const found = { groups, renderer: new Renderer(canvas, { halfFloat }), scenes: new Map() };
  opened.set(file, found);
  return found;
}

function sceneOf({ groups, renderer, scenes }: Opened, number: number): DrawnScene {
  const known = scenes.get(number);
  if (known) return known;
  const drawn = renderer.addScene(sourceOf(groups.open(number)));
  scenes.set(number, drawn);
  return drawn;
}

const pause = (ms: number) => new Promise((resolve) => setTimeout(resolve, ms));

/** Wait until the card has drawn all. */
async function finished(gl: WebGL2RenderingContext): Promise<void> {
  const fence = gl.fenceSync(gl.SYNC_GPU_COMMANDS_COMPLETE, 0) as WebGLSync;
  gl.flush();
  while (gl.getSyncParameter(fence, gl.SYNC_STATUS) !== gl.SIGNALED) await pause(0);
  gl.deleteSync(fence);
}

function base64(bytes: Uint8Array): string {
  let text = '';
  for (let i = 0; i < bytes.length; i += 8192) text += String.fromCharCode(...bytes.subarray(i, i + 8192));
  return btoa(text);
}

async function prepared(job: Job) {
  const found = await open(job);
  const moments: Moment[] = found.groups.timeline.blendAt(job.time).map(({ group, localTime, share }) => ({
    scene: sceneOf(found, group),
    time: localTime,
    share,
  }));
  const { gl } = found.renderer;
  if (gl.canvas.width !== job.camera.width || gl.canvas.height !== job.camera.height) {
    [gl.canvas.width, gl.canvas.height] = [job.camera.width, job.camera.height];
  }
  const known = found.groups.first.appearances.find(({ name }) => name === job.appearance);
  return { ...found, moments, appearance: known?.embedding ?? null };
}

const page = {
  /** Draw a picture until it is sharp; return its bytes RGBA, rows from below, in base64. */
  async picture(job: Job) {
    const { renderer, moments, appearance } = await prepared(job);
    const { gl } = renderer;
    const versions = () => moments.map(({ scene }) => scene.version).join();
    const [width, height] = [job.camera.width, job.camera.height];
    const pixels = new Uint8Array(4 * width * height);
    for (let before = '', isSharp = false; !isSharp || versions() !== before; await pause(1)) {
      before = versions();
      ({ isSharp } = renderer.draw(job.camera, moments, { level: job.level, part: job.part, appearance }));
    }
    renderer.present();
    gl.bindFramebuffer(gl.FRAMEBUFFER, null);
    gl.readPixels(0, 0, width, height, gl.RGBA, gl.UNSIGNED_BYTE, pixels);
    return { pixels: base64(pixels), error: gl.getError(), name: renderer.name };
  },

  /** Draw the rays of a picture; return how much that looks up, and its colours as float32 RGBA in base64. */
  async counted(job: Job) {
    const { renderer, moments, appearance } = await prepared(job);
    const options = { level: job.level, part: job.part, appearance, isCounted: true };
    const rasters = await renderer.read(job.camera, moments, options);
    const sum = (channel: number) =>
      rasters.reduce((all, { sums }) => all + sums.reduce((s, x, i) => (i % 4 === channel ? s + x : s), 0), 0);
    const [{ width, height }] = rasters;
    return { width, height, samples: sum(1), cells: sum(2), rays: width * height * rasters.length };
  },

  /** Draw pictures one after the other; return the milliseconds that each took. */
  async frames(jobs: Job[]): Promise<number[]> {
    const took: number[] = [];
    for (const job of jobs) {
      const { renderer, moments, appearance } = await prepared(job);
      const started = performance.now();
      renderer.draw(job.camera, moments, { level: job.level, part: job.part, appearance });
      await finished(renderer.gl);
      took.push(performance.now() - started);
      while (renderer.isBusy) await pause(0);
    }
    return took;
  },

  /** Return the text of shader files for the first scene of a file, with macros besides the scene's. */
  async shaders(job: Job, names: string[], defines: Defines): Promise<Composed[]> {
    const scene = sourceOf((await open(job)).groups.first);
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
    const renderers = [...opened.values()].map(({ renderer }) => renderer);
    opened.clear();
    for (const renderer of renderers) renderer.dispose();
    return renderers.reduce((sum, renderer) => sum + renderer.objects, 0);
  },
};

Object.assign(globalThis, { page });
