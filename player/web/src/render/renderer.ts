/**
 * Draws scenes on a canvas, or into a framebuffer of someone else's WebGL2.
 *
 *     const renderer = new Renderer(canvas);
 *     const scene = renderer.addScene(source);                          // planes are taken from it as they arrive
 *     const { isSharp } = renderer.draw(camera, [{ scene, time: 0.5, share: 1 }]);
 *     renderer.dispose();
 */

import { type Camera, isSameView, resized, texelsPerPixel } from './camera.js';
import { Device, RenderError } from './device.js';
import { DrawnScene, type Shot } from './drawn_scene.js';
import { Pace, type Rung } from './pace.js';
import { Presentation, type Screen, type Target } from './presentation.js';
import { LEVELS, type Level, type Quality } from './quality.js';
import type { SceneSource } from './scene_source.js';
import { Timer } from './timer.js';

export type ShownPart = 'all' | 'static' | 'dynamic';

/** A scene at a time in [0, 1] of its own, and its share of the picture: 1, or two groups' that make 1 together. */
export interface Moment {
  scene: DrawnScene;
  time: number;
  share: number;
}

export interface DrawOptions {
  /** `auto` takes the finest level at which frames come in time, and draws finely once all stands still. */
  level?: Level | 'auto';
  /** `dynamic` shows the difference between all and the static part. */
  part?: ShownPart;
  /** An embedding of the scene, or between two of them; null is the average appearance. */
  appearance?: Float32Array | null;
  /** In place of the scene's. */
  background?: ArrayLike<number> | null;
  /** Where to draw, if not over the whole canvas. The camera's size is taken for the size of the picture. */
  screen?: Screen | null;
}

export interface DrawnPicture {
  level: Level;
  /** Side of the raster that was marched over that of the picture. */
  scale: number;
  /** Whether the picture will not become finer while nothing changes: no further call is needed. */
  isSharp: boolean;
}

export interface RendererOptions {
  /** Frames a second that `auto` holds. */
  fps?: number;
  onLost?: () => void;
  onRestored?: () => void;
  /** Use float16 as a telephone would that knows no more; for tests. */
  halfFloat?: boolean;
}

/** What is drawn once all stands still. */
const STILL: Rung = { level: 'fine', scale: 1 };
/** Pixels of a raster with several rays a pixel, at most. */
const MOST_PIXELS = 1 << 22;
const SOFTWARE = /swiftshader|llvmpipe|softpipe|software|basic render/i;

/** A picture that is marched in strips over several calls. */
interface Sharpening {
  nextRow: number;
  rowsAtOnce: number;
}

/** What decides what a picture shows. */
interface Request {
  camera: Camera;
  moments: readonly Moment[];
  options: DrawOptions;
  /** Of the scenes' planes. */
  version: string;
}

export class Renderer {
  readonly gl: WebGL2RenderingContext;
  readonly pace: Pace;
  readonly #options: RendererOptions;
  readonly #scenes = new Set<DrawnScene>();
  #device: Device;
  #presentation: Presentation;
  #timer: Timer;
  #last: { request: Request; rung: Rung } | null = null;
  #sharpening: Sharpening | null = null;
  #isDisposed = false;

  /**
   * @throws RenderError: WebGL2 is not to be had, or cannot draw float numbers.
   */
  constructor(canvasOrGl: HTMLCanvasElement | OffscreenCanvas | WebGL2RenderingContext, options: RendererOptions = {}) {
    this.gl = 'getContext' in canvasOrGl ? contextOf(canvasOrGl) : canvasOrGl;
    this.#options = options;
    this.pace = new Pace(1 / (options.fps ?? 30));
    this.#device = new Device(this.gl, options);
    this.#presentation = new Presentation(this.#device);
    this.#timer = new Timer(this.gl, this.isSoftware);
    this.gl.canvas.addEventListener('webglcontextlost', this.#onLost);
    this.gl.canvas.addEventListener('webglcontextrestored', this.#onRestored);
  }

  /** What draws, for people to read. */
  get name(): string {
    return this.#device.name;
  }

  /** Whether a processor stands in for a graphics card. */
  get isSoftware(): boolean {
    return SOFTWARE.test(this.#device.name);
  }

  /** Whether the browser has taken the card away; it gives it back by itself, and the renderer goes on then. */
  get isLost(): boolean {
    return this.gl.isContextLost();
  }

  /** Whether the card is not done yet with the picture before; until then `draw` does nothing. */
  get isBusy(): boolean {
    return this.#timer.isBusy;
  }

  /** Objects on the card; 0 once all scenes are removed and the renderer is disposed of. */
  get objects(): number {
    return this.#device.objects;
  }

  /** Bytes of the textures of scenes. */
  get memoryBytes(): number {
    return [...this.#scenes].reduce((sum, scene) => sum + scene.memoryBytes, 0);
  }

  addScene(source: SceneSource): DrawnScene {
    const scene = new DrawnScene(source);
    this.#scenes.add(scene);
    return scene;
  }

  removeScene(scene: DrawnScene): void {
    if (this.#scenes.delete(scene)) scene.release();
  }

  /** Draw what a camera sees. While the card is still busy with the picture before, or is lost, nothing is drawn. */
  draw(camera: Camera, moments: readonly Moment[], options: DrawOptions = {}): DrawnPicture {
    if (!this.isLost) for (const { scene } of moments) scene.upload(this.#device);
    const request = { camera, moments, options, version: versionOf(moments) };
    const isSame = this.#last !== null && isSameRequest(this.#last.request, request);
    const isAuto = (options.level ?? 'auto') === 'auto';
    const chosen: Rung = isAuto ? this.pace.rung : { level: options.level as Level, scale: 1 };
    if (this.isLost || this.#timer.isBusy) return { ...(this.#last?.rung ?? chosen), isSharp: false };
    if (isSame && this.#last !== null) {
      const isDone = !isAuto || this.#last.rung === STILL;
      if (!isDone) this.#sharpen(request);
      else if (options.screen) this.present();
      return { ...this.#last.rung, isSharp: isDone || this.#last.rung === STILL };
    }
    this.#sharpening = null;
    this.#timer.start();
    for (const shot of this.#shots(request, chosen)) shot.scene.march(this.#device, shot.target, shot);
    this.#show(request, chosen);
    this.#timer.finish((seconds) => {
      if (isAuto) this.pace.record(seconds);
    });
    this.#last = { request, rung: chosen };
    return { ...chosen, isSharp: !isAuto };
  }

  /** Show the last picture again: a browser clears a canvas once it has shown it, so do this to read pixels. */
  present(): void {
    if (this.#last !== null && !this.isLost) this.#show(this.#last.request, this.#last.rung);
  }

  /**
   * Draw a picture of the camera's size, at once and by itself.
   * @returns float32 RGBA (opacity in A), and the mean distance, number of samples and of cells looked up in RGB, rows
   *   from below.
   */
  read(camera: Camera, moments: readonly Moment[], options: DrawOptions & { isCounted?: boolean } = {}) {
    if (this.isLost) throw new RenderError('the card is lost for the moment');
    const level = options.level === undefined || options.level === 'auto' ? STILL.level : options.level;
    const request = { camera, moments, options, version: versionOf(moments) };
    const shots = this.#shots(request, { level, scale: 1 }, 'read ');
    const pictures = shots.map((shot) => {
      shot.scene.march(this.#device, shot.target, { ...shot, isCounted: options.isCounted });
      return [0, 1].map((attachment) => this.#device.read(shot.target, attachment));
    });
    const { width, height } = shots[0].target;
    return { width, height, pictures };
  }

  /** Give back everything on the card. */
  dispose(): void {
    if (this.#isDisposed) return;
    this.#isDisposed = true;
    this.gl.canvas.removeEventListener('webglcontextlost', this.#onLost);
    this.gl.canvas.removeEventListener('webglcontextrestored', this.#onRestored);
    for (const scene of this.#scenes) scene.release();
    this.#scenes.clear();
    this.#timer.dispose();
    this.#presentation.release();
    this.#device.dispose();
  }

  /** March some rows of the still picture, and show it once all are there. */
  #sharpen(request: Request): void {
    const shots = this.#shots(request, STILL);
    const state = this.#sharpening ?? { nextRow: 0, rowsAtOnce: 8 };
    this.#sharpening = state;
    const rows = shots.reduce((sum, { target }) => sum + target.height, 0);
    let [first, more] = [state.nextRow, state.rowsAtOnce];
    this.#timer.start();
    for (const shot of shots) {
      const count = Math.max(0, Math.min(more, shot.target.height - first));
      if (first < shot.target.height && count > 0) shot.scene.march(this.#device, shot.target, shot, first, count);
      more -= count;
      first = Math.max(0, first - shot.target.height);
    }
    state.nextRow += state.rowsAtOnce;
    if (state.nextRow >= rows) {
      this.#show(request, STILL);
      this.#last = { request, rung: STILL };
      this.#sharpening = null;
    }
    this.#timer.finish((seconds) => {
      const factor = this.pace.secondsPerFrame / seconds;
      state.rowsAtOnce = Math.max(1, Math.round(state.rowsAtOnce * Math.min(Math.max(factor, 0.5), 4)));
    });
  }

  /** Return what has to be marched for a picture: for each moment the whole scene, its static part, or both. */
  #shots(
    { camera, moments, options }: Request,
    rung: Rung,
    role = roleOf(rung),
  ): (Shot & { scene: DrawnScene; target: Target })[] {
    const { part = 'all', appearance = null, background } = options;
    const quality = LEVELS[rung.level];
    const parts = { all: [true], static: [false], dynamic: [true, false] }[part];
    return moments.flatMap(({ scene, time }, number) => {
      const raster = rasterOf(scene.source, camera, quality, rung.scale);
      return parts.map((isMoving) => {
        const target = this.#presentation.target(`${role}${number} ${isMoving}`, raster.width, raster.height);
        const colour = background ?? scene.source.head.background;
        return { scene, camera: raster, time, quality, isMoving, appearance, background: colour, target };
      });
    });
  }

  /** Bring marched pictures to the screen, those of two groups mixed. */
  #show(request: Request, rung: Rung): void {
    const { camera, options } = request;
    const { width, height } = camera;
    const screen = options.screen ?? {
      framebuffer: null,
      x: 0,
      y: 0,
      width: this.gl.drawingBufferWidth,
      height: this.gl.drawingBufferHeight,
    };
    const across = this.#raysAcross(request, rung);
    const targets = this.#shots(request, rung).map(({ target, isMoving }, number) => {
      const rays = across[Math.floor((number * request.moments.length) / this.#shotCount(request))];
      if (rays === 1) return target;
      return this.#presentation.average(
        target,
        this.#presentation.target(`mean ${number} ${isMoving}`, width, height),
        rays,
      );
    });
    const perMoment = targets.length / request.moments.length;
    request.moments.forEach(({ share }, number) => {
      const [picture, still = null] = targets.slice(number * perMoment, (number + 1) * perMoment);
      this.#presentation.show(screen, picture, still, number === 0 ? 1 : share);
    });
  }

  #shotCount({ moments, options }: Request): number {
    return moments.length * (options.part === 'dynamic' ? 2 : 1);
  }

  #raysAcross({ camera, moments }: Request, rung: Rung): number[] {
    return moments.map(({ scene }) => raysAcrossOf(scene.source, camera, LEVELS[rung.level]));
  }

  readonly #onLost = (event: Event): void => {
    event.preventDefault(); // or it is not given back
    this.#timer.dispose();
    this.#options.onLost?.();
  };

  readonly #onRestored = (): void => {
    this.#device = new Device(this.gl, this.#options);
    this.#presentation = new Presentation(this.#device);
    this.#timer = new Timer(this.gl, this.isSoftware);
    this.#last = this.#sharpening = null;
    this.#options.onRestored?.();
  };
}

function contextOf(canvas: HTMLCanvasElement | OffscreenCanvas): WebGL2RenderingContext {
  const wanted = { alpha: false, antialias: false, depth: false, stencil: false, powerPreference: 'high-performance' };
  const gl = canvas.getContext('webgl2', wanted as WebGLContextAttributes) as WebGL2RenderingContext | null;
  if (gl === null)
    throw new RenderError('this browser has no WebGL2; update it, or allow it to use the graphics card', 'no-webgl');
  return gl;
}

/** Return how many rays go across a pixel: as many as it spans texels, as far as level and memory allow. */
function raysAcrossOf(scene: SceneSource, camera: Camera, { raysAcross }: Quality): number {
  if (scene.mapping !== null || raysAcross === 1) return 1; // texels differ where space is mapped
  const most = Math.floor(Math.sqrt(Math.max(1, MOST_PIXELS / (camera.width * camera.height))));
  return Math.max(1, Math.min(Math.floor(texelsPerPixel(scene, camera)), raysAcross, most));
}

/** Return the camera with the raster of rays that is marched. */
function rasterOf(scene: SceneSource, camera: Camera, quality: Quality, scale: number): Camera {
  const side = raysAcrossOf(scene, camera, quality) * quality.resolution * scale;
  if (side === 1) return camera;
  return resized(
    camera,
    ...([camera.width, camera.height].map((n) => Math.max(1, Math.round(n * side))) as [number, number]),
  );
}

const versionOf = (moments: readonly Moment[]) => moments.map(({ scene }) => scene.version).join();

/** What targets of still pictures are called, so that others do not take their place. */
const roleOf = (rung: Rung) => (rung === STILL ? 'still ' : '');

function isSameRequest(a: Request, b: Request): boolean {
  const [x, y] = [a.options, b.options];
  return (
    a.version === b.version &&
    isSameView(a.camera, b.camera) &&
    a.moments.length === b.moments.length &&
    a.moments.every((moment, i) => moment.scene === b.moments[i].scene && moment.time === b.moments[i].time) &&
    x.level === y.level &&
    x.part === y.part &&
    x.appearance === y.appearance &&
    x.background === y.background
  );
}
