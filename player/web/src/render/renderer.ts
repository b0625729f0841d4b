/**
 * Draws scenes on a canvas, or into a framebuffer of someone else's WebGL2.
 *
 *     const renderer = new Renderer(canvas);
 *     const scene = renderer.addScene(source);                          // planes are taken from it as they arrive
 *     const { isSharp } = renderer.draw(camera, [{ scene, time: 0.5, share: 1 }]);
 *     renderer.dispose();
 */

import { type Camera, isSameView, texelsPerPixel } from './camera.js';
import { contextOf, RenderError } from './context.js';
import { Device } from './device.js';
import { DrawnScene } from './drawn_scene.js';
import { Following } from './following.js';
import { Merging, type Projection } from './merging.js';
import type { Setting } from './pace.js';
import { type Moment, type Picture, PictureJob, type ShownPart, type View } from './picture_job.js';
import { Presentation, type Screen, type Target } from './presentation.js';
import { FOLLOWING_LEVELS, LEVEL_NAMES, LEVELS, type Level } from './quality.js';
import type { SceneSource } from './scene_source.js';
import { SharedPrograms } from './shared_programs.js';
import { Speed } from './speed.js';
import { Timer } from './timer.js';

export interface DrawOptions {
  /** `auto` takes the finest level at which frames come in time, and draws finely once all stands still. */
  level?: Level | Setting | 'auto';
  /** `dynamic` shows the difference between all and the static part. */
  part?: ShownPart;
  /** An embedding of the scene, or between two of them; null is the average appearance. */
  appearance?: Float32Array | null;
  /** In place of the scene's. */
  background?: ArrayLike<number> | null;
  /** Whether another time has been sought since the last call: what is there is to be seen soon, however coarsely. */
  hasSought?: boolean;
  /** Where to draw, if not over the whole canvas. The camera's size is taken for the size of the picture. */
  screen?: Screen | null;
}

/** What another renderer or a headset shows, of which a picture becomes a part. */
export interface Frame {
  /** Of the screen's size. */
  camera: Camera;
  screen: Screen;
  /** How it is seen, where it has depths, which hide and are hidden; null: the picture covers the screen. */
  projection: Projection | null;
}

export interface DrawnPicture {
  level: Level;
  /** Side of the raster that was marched over that of the picture. */
  scale: number;
  /** Whether the picture will not become finer while nothing changes: no further call is needed. */
  isSharp: boolean;
  /** Pictures that have been shown so far, whole ones. */
  pictures: number;
}

export interface RendererOptions {
  /** Frames a second that `auto` holds; `usualFps` if it is not given. */
  fps?: number;
  onLost?: () => void;
  onRestored?: () => void;
  /** Use float16 as a telephone would that knows no more; for tests. */
  halfFloat?: boolean;
}

/** What is drawn once all stands still. */
const STILL: Setting = { level: 'fine', scale: 1 };
/** The finest that is drawn where memory is short: fine levels march many rays for a pixel. */
const SPARING: Setting = { level: 'fast', scale: 1 };
/** Seconds that a part of a picture may take, so that the page stays alive and drivers do not think that all hangs. */
const MOST_SECONDS = 0.25;
/** Milliseconds of a frame after which programs that are compiled wait for the next one. */
const TAKING_MS = 4;
const LIVE = ['live', 'other live'];
const STILL_ROLE = 'still';

/** A finished picture, what it shows, and of what versions of the scenes' planes. */
interface Shown {
  view: View;
  versions: string;
  setting: Setting;
  role: string;
  pictures: Picture[];
  /** What was marched for them. */
  rasters: ReadonlyMap<string, Target>;
  /** How many pictures it has followed without a break; 0: it is whole. */
  followed: number;
}

/** A picture in the making, of what versions of the scenes' planes, and whether others are to follow it at rest. */
type StartedJob = PictureJob & { versions?: string; isForRest?: boolean };

export class Renderer {
  readonly gl: WebGL2RenderingContext;
  readonly #speed: Speed;
  readonly #options: RendererOptions;
  readonly #scenes = new Set<DrawnScene>();
  #device: Device;
  #presentation: Presentation;
  #following: Following;
  #merging: Merging | null = null;
  #timer: Timer;
  #shown: Shown | null = null;
  #job: StartedJob | null = null;
  /** When the camera came to rest, milliseconds of the clock. */
  #restsSince = 0;
  #pictures = 0;
  #isDisposed = false;

  /**
   * @throws RenderError: WebGL2 is not to be had, or cannot draw float numbers.
   */
  constructor(canvasOrGl: HTMLCanvasElement | OffscreenCanvas | WebGL2RenderingContext, options: RendererOptions = {}) {
    this.gl = 'getContext' in canvasOrGl ? contextOf(canvasOrGl) : canvasOrGl;
    this.#options = options;
    this.#device = new Device(this.gl, options);
    this.#presentation = new Presentation(this.#device);
    this.#following = new Following(this.#device);
    this.#timer = new Timer(this.gl, this.isSoftware);
    this.#speed = new Speed(this.isSoftware, options.fps);
    this.gl.canvas.addEventListener('webglcontextlost', this.#onLost);
    this.gl.canvas.addEventListener('webglcontextrestored', this.#onRestored);
  }

  /** What draws, for people to read. */
  get name(): string {
    return this.#device.name;
  }

  /** Whether a processor stands in for a graphics card. */
  get isSoftware(): boolean {
    return this.#device.isSoftware;
  }

  /** Frames a second that `auto` holds unless others are asked for: a processor's would be too coarse at a card's. */
  get usualFps(): number {
    return this.#speed.usualFps;
  }

  /** Set the frames a second that `auto` holds. */
  set fps(fps: number) {
    this.#speed.fps = fps;
  }

  /** Whether the browser has taken the card away; it gives it back by itself, and the renderer goes on then. */
  get isLost(): boolean {
    return this.gl.isContextLost();
  }

  /** Whether there is a picture to present: none after the card was lost, until the next one is whole. */
  get hasPicture(): boolean {
    return !this.isLost && this.#shown !== null;
  }

  /** Whole pictures that have been shown so far. */
  get pictures(): number {
    return this.#pictures;
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

  /**
   * Take rows of a scene that has arrived, as many as a frame has time for; `draw` does so for those that it shows.
   * @returns false: the card is asked whether it has memory, and gets nothing before it has answered.
   */
  upload(scene: DrawnScene): boolean {
    if (this.isLost) return true; // all is taken again once the card is back
    if (this.#device.isAsked) return false;
    scene.upload(this.#device);
    return true;
  }

  removeScene(scene: DrawnScene): void {
    if (!this.#scenes.delete(scene)) return;
    if (this.#job?.view.moments.some((moment) => moment.scene === scene)) this.#job = null;
    scene.release();
  }

  /** Have made what `draw` will need for each moment by itself, while planes are to come; return whether it is. */
  prepare(camera: Camera, moments: readonly Moment[], options: DrawOptions = {}): boolean {
    if (this.isLost) return true;
    // Nothing is given to the card while it is asked whether it has memory; then textures are made before it is asked.
    if (this.#device.isAsked && !this.#hasMemory()) return false;
    const areReady = moments.map((moment) => {
      const view = viewOf(camera, [moment], options);
      return this.#isReady(view, this.#wanted(camera, view.moments, options));
    });
    return this.#hasMemory() === true && areReady.every((isReady) => isReady);
  }

  /**
   * Draw what a camera sees, or go on with that; call it on each animation frame until the picture is sharp.
   *
   * A picture that takes long is made in several calls, and shown once it is whole. While the card is busy with what it
   * was given last, or is lost, nothing is done.
   */
  draw(camera: Camera, moments: readonly Moment[], options: DrawOptions = {}): DrawnPicture {
    const { level = 'auto' } = options;
    const isAuto = level === 'auto';
    const view = viewOf(camera, moments, options);
    const restedS = this.#restedS(camera, options.hasSought ?? false);
    const wanted = this.#wanted(camera, moments, options, restedS);
    if (this.isLost || this.#timer.isBusy || !this.#hasMemory()) return this.#state(wanted, false);
    for (const scene of this.#scenes) scene.upload(this.#device);
    const versions = moments.map(({ scene }) => scene.source.version).join();
    const isStill = this.#shown !== null && isSame(this.#shown.view, view);
    const isShown = isStill && this.#shown?.versions === versions;
    if (this.#job?.role === STILL_ROLE && !isSame(this.#job.view, view)) this.#job = null;
    if (this.#job?.isForRest && restedS === 0) this.#job = null;
    if (this.#job === null) {
      const isSharp = isShown && (isAuto ? this.#shown?.role === STILL_ROLE : isWhole(this.#shown, wanted));
      if (isSharp) {
        if (options.screen) this.present(options.screen);
        return this.#state(wanted, true);
      }
      // What was sharp stays so while more planes arrive.
      const sharpens = isAuto && (isShown || (isStill && this.#shown?.role === STILL_ROLE));
      const still = this.#device.isSparing ? SPARING : STILL;
      const setting = sharpens ? still : wanted;
      if (!this.#isReady(view, setting)) return this.#state(wanted, false);
      this.#job = this.#newJob(view, setting, sharpens ? STILL_ROLE : this.#freeRole);
      if (!isAuto || this.#speed.isSettled) this.#letFollow(this.#job);
      this.#job.versions = versions;
      this.#job.isForRest = this.#speed.isResting(restedS) && FOLLOWING_LEVELS.includes(setting.level);
    }
    this.#goOn(this.#job, isAuto, options.screen ?? null);
    return this.#state(wanted, false);
  }

  /**
   * Draw whole pictures at once, into frames that someone else shows, of the same size and about the same view: `auto`
   * draws as finely as all of them come in time. Nothing is drawn while shaders are being compiled.
   */
  drawInto(frames: readonly Frame[], moments: readonly Moment[], options: DrawOptions = {}): DrawnPicture {
    const { level = 'auto' } = options;
    const [{ camera, projection }] = frames;
    const wanted = this.#wanted(camera, moments, options);
    if (this.isLost || (!this.#timer.isBusy && this.#hasMemory() === false)) return this.#state(wanted, false);
    for (const scene of this.#scenes) this.upload(scene);
    const background = projection ? [0, 0, 0] : options.background;
    const views = frames.map(({ camera }) => viewOf(camera, moments, { ...options, background }));
    const merging = projection && this.#mergingOn(this.#device);
    if (!this.#isReady(views[0], wanted, merging)) return this.#state(wanted, false);
    const isTimed = !this.#timer.isBusy;
    let last: PictureJob | null = null;
    if (isTimed) this.#timer.start((seconds) => level === 'auto' && last && this.#speed.record(last, seconds));
    for (const [number, { screen, projection }] of frames.entries()) {
      const limits = merging && projection && merging.limits(screen, projection);
      const keeping = { role: 'frame', isExact: wanted.level === 'reference', limits };
      const job = new PictureJob(views[number], wanted, this.#presentation, keeping);
      last = job;
      job.march(this.#device, job.rowsLeft);
      const pictures = job.finish(this.#presentation);
      if (merging && projection && limits) merging.show(screen, pictures, limits, projection);
      else this.#show(screen, pictures);
    }
    if (isTimed) this.#timer.finish();
    this.#pictures++;
    return { ...wanted, isSharp: false, pictures: this.#pictures };
  }

  /** Show the last picture again: a browser clears a canvas once it has shown it, so do this to read pixels. */
  present(screen: Screen | null = null): void {
    if (this.isLost || this.#shown === null) return;
    const { drawingBufferWidth: width, drawingBufferHeight: height } = this.gl;
    const whole = screen ?? { framebuffer: null, x: 0, y: 0, width, height };
    this.#show(whole, this.#shown.pictures);
  }

  #show(screen: Screen, pictures: readonly Picture[]): void {
    for (const [number, { target, still, share }] of pictures.entries()) {
      this.#presentation.show(screen, target, still, number === 0 ? 1 : share);
    }
  }

  #mergingOn(device: Device): Merging {
    this.#merging ??= new Merging(device);
    return this.#merging;
  }

  /**
   * Draw a picture by itself, in float numbers, without showing it; `draw` does nothing meanwhile.
   * @returns for each moment, and with part `dynamic` its static part, RGBA of colour and opacity; and RGBA of the sum
   *   of weight times distance, the number of samples and, if asked for, of cells looked up. Rows from below; one for
   *   each ray, which may be more or less than pixels.
   */
  async read(camera: Camera, moments: readonly Moment[], options: DrawOptions & { isCounted?: boolean } = {}) {
    const { level = 'auto' } = options;
    const setting = level === 'auto' ? STILL : settingOf(level);
    const keeping = { role: 'read', isExact: true, isCounted: options.isCounted };
    await this.#untilIdle();
    for (const scene of this.#scenes) scene.upload(this.#device);
    const job = new PictureJob(viewOf(camera, moments, options), setting, this.#presentation, keeping);
    while (job.rowsLeft > 0) {
      this.#march(job, MOST_SECONDS, () => {});
      this.#timer.finish();
      await this.#untilIdle();
    }
    return [...job.targets.values()].map((target) => {
      const [rgba, sums] = [0, 1].map((attachment) => this.#device.read(target, attachment));
      return { width: target.width, height: target.height, rgba, sums };
    });
  }

  /** Give back everything on the card. */
  dispose(): void {
    if (this.#isDisposed) return;
    this.#isDisposed = true;
    this.gl.canvas.removeEventListener('webglcontextlost', this.#onLost);
    this.gl.canvas.removeEventListener('webglcontextrestored', this.#onRestored);
    this.#releaseAll();
    this.#scenes.clear();
  }

  /** For how many seconds pictures have been those of this camera, without jumps of the clip. */
  #restedS(camera: Camera, hasSought: boolean): number {
    const now = performance.now();
    const isSameCamera = this.#shown !== null && isSameView(this.#shown.view.camera, camera);
    if (!isSameCamera || hasSought) this.#restsSince = now;
    return (now - this.#restsSince) / 1000;
  }

  #wanted(camera: Camera, moments: readonly Moment[], { level = 'auto' }: DrawOptions, restedS = 0): Setting {
    const texels = texelsPerPixel(moments[0].scene.source, camera);
    const wanted = level === 'auto' ? this.#speed.setting(texels, restedS) : settingOf(level);
    const isTooFine = LEVEL_NAMES.indexOf(wanted.level) > LEVEL_NAMES.indexOf(SPARING.level);
    return this.#device.isSparing && isTooFine ? SPARING : wanted;
  }

  /** Whether no compiler keeps a picture waiting. */
  #isReady({ moments, part }: View, setting: Setting, merging: Merging | null = null): boolean {
    this.#device.takesUntil = performance.now() + TAKING_MS;
    const parts = { all: [true], static: [false], dynamic: [true, false] }[part];
    const areReady = moments.flatMap(({ scene }) =>
      parts.map((isMoving) => scene.isReady(this.#device, LEVELS[setting.level], isMoving, merging !== null)),
    );
    areReady.push(this.#presentation.isReady(setting, part === 'dynamic'), merging?.isReady() ?? true);
    return areReady.every((isReady) => isReady);
  }

  /** The role of pictures that are drawn beside the one that is shown. */
  get #freeRole(): string {
    return this.#shown?.role === LIVE[0] ? LIVE[1] : LIVE[0];
  }

  #newJob(view: View, setting: Setting, role: string): PictureJob {
    return new PictureJob(view, setting, this.#presentation, { role, isExact: setting.level === 'reference' });
  }

  /**
   * Let a picture follow the one that is shown, if that is the same at another time. Planes may have arrived in between,
   * and the scenes be those of another group: what differs is found, and within sixteen pictures all pixels are marched.
   */
  #letFollow(job: PictureJob): void {
    const shown = this.#shown;
    if (shown === null || job.role === STILL_ROLE || shown.role === STILL_ROLE) return;
    if (!FOLLOWING_LEVELS.includes(job.setting.level) || !isSameSetting(shown.setting, job.setting)) return;
    if (!isSameScreen(shown.view, job.view) || isSame(shown.view, job.view)) return;
    if (!this.#speed.canSample(job) || !this.#following.isReady()) return;
    const before = new Map([...shown.rasters].filter(([, target]) => this.#presentation.holds(target)));
    job.follow({ following: this.#following, before, turn: shown.followed });
  }

  /** March as many rows as there is time for, and show the picture if these were the last. */
  #goOn(job: StartedJob, isAuto: boolean, screen: Screen | null): void {
    const isStill = job.role === STILL_ROLE;
    this.#march(job, isStill ? this.#speed.secondsPerFrame : MOST_SECONDS, () => {
      if (isAuto && !isStill && job.rowsLeft === 0) this.#speed.record(job, job.seconds, job.isForRest);
    });
    if (job.rowsLeft === 0) {
      const { view, setting, role, versions = '', follows, targets: rasters } = job;
      const followed = follows ? follows.turn + 1 : 0;
      this.#shown = { view, setting, role, versions, rasters, followed, pictures: job.finish(this.#presentation) };
      this.#job = null;
      this.#pictures++;
      this.present(screen);
    } else if (screen) {
      this.present(screen);
    }
    this.#timer.finish();
  }

  /** Begin to march the rows that take about so many seconds. */
  #march(job: PictureJob, seconds: number, done: () => void): void {
    const rows = this.#speed.rows(job, seconds);
    this.#timer.start((took) => {
      job.seconds += took;
      this.#speed.recordRows(job, rows, took);
      done();
    });
    job.march(this.#device, rows);
  }

  #state(wanted: Setting, isSharp: boolean): DrawnPicture {
    return { ...(this.#shown?.setting ?? wanted), isSharp, pictures: this.#pictures };
  }

  async #untilIdle(): Promise<void> {
    while (this.#timer.isBusy) await new Promise((resolve) => setTimeout(resolve, 1));
    if (this.isLost) throw new RenderError('the browser has taken the graphics card away for the moment');
  }

  readonly #onLost = (event: Event): void => {
    event.preventDefault(); // or it is not given back
    this.#timer.dispose();
    this.#options.onLost?.();
  };

  readonly #onRestored = (): void => {
    this.#beginAnew(this.#device.isSparing);
    this.#options.onRestored?.();
  };

  /** Forget all that is on the card, and make it again as it is needed. */
  #beginAnew(isSparing: boolean): void {
    this.#device = new Device(this.gl, { ...this.#options, isSparing });
    this.#presentation = new Presentation(this.#device);
    this.#following = new Following(this.#device);
    this.#merging = null;
    this.#timer = new Timer(this.gl, this.isSoftware);
    this.#shown = this.#job = null;
  }

  /**
   * Whether the card had memory for all textures; if not, begin anew with smaller ones.
   * @returns null: the card has not come to them yet.
   * @throws RenderError: they were small already.
   */
  #hasMemory(): boolean | null {
    const hasMemory = this.#device.hasMemory();
    if (hasMemory !== false) return hasMemory;
    const { isSparing, name } = this.#device;
    this.#releaseAll();
    this.#beginAnew(true);
    if (isSparing) throw new RenderError(`${name} has no memory for the textures of the scene`, 'budget');
    return false;
  }

  #releaseAll(): void {
    for (const scene of this.#scenes) scene.release();
    SharedPrograms.on(this.#device).dispose();
    this.#timer.dispose();
    this.#presentation.release();
    this.#following.release();
    this.#merging?.release();
    this.#device.dispose();
  }
}

function viewOf(camera: Camera, moments: readonly Moment[], options: DrawOptions): View {
  const { part = 'all', appearance = null, background = null } = options;
  return { camera, moments, part, appearance, background };
}

/** Return whether two views show the same, but for planes that have arrived in between. */
function isSame(a: View, b: View): boolean {
  return (
    isSameScreen(a, b) &&
    a.moments.length === b.moments.length &&
    a.moments.every(({ scene, time }, i) => scene === b.moments[i].scene && time === b.moments[i].time) &&
    a.appearance === b.appearance
  );
}

/** Return whether two views show the same, but for what happens in the clip. */
function isSameScreen(a: View, b: View): boolean {
  return isSameView(a.camera, b.camera) && a.part === b.part && a.background === b.background;
}

const settingOf = (level: Level | Setting): Setting => (typeof level === 'string' ? { level, scale: 1 } : level);

const isSameSetting = (a: Setting, b: Setting) => a.level === b.level && a.scale === b.scale;

/** Whether a picture is as fine as a setting makes it that follows none. */
const isWhole = (shown: Shown | null, setting: Setting) =>
  shown?.followed === 0 && isSameSetting(shown.setting, setting);
