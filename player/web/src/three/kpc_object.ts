/**
 * A clip in a scene of three.js, hidden by what is before it and hiding what is behind it.
 *
 *     const actor = new KpcObject('scene.kpc', { loop: true });
 *     scene.add(actor);
 *     actor.play();
 *
 * It is drawn among the transparent things of three's WebGLRenderer, when the depths of all opaque ones are there.
 */

import {
  Box3,
  BoxGeometry,
  type Camera,
  Mesh,
  MeshBasicMaterial,
  type Object3DEventMap,
  type Scene,
  Vector3,
  Vector4,
  type WebGLRenderer,
} from 'three';
import {
  appearanceOf,
  Clip,
  ClipScenes,
  Clock,
  type ClockEvent,
  LEVEL_NAMES,
  type Level,
  Renderer,
  type SceneEvent,
} from '../index.js';
import { seenFrom } from './seen_from.js';

export interface KpcObjectOptions {
  loop?: boolean;
  /** A level, or `auto`, which holds `fps`. */
  quality?: Level | 'auto';
  /** Frames a second that `auto` holds; by default what suits the device. */
  fps?: number;
  /** Bytes that the clip may take, on the graphics card, too. */
  memory?: number;
  /** Name of an appearance; an empty one is the average. */
  appearance?: string;
  /** Where `kpc-worker.js` lies, for pages that forbid workers from blobs. */
  workerUrl?: string;
}

/** What is drawn with, once a renderer of three.js shows the object. */
interface Drawing {
  gl: WebGL2RenderingContext;
  scenes: ClipScenes;
}

type Events = ClockEvent | 'loadedmetadata' | 'canplay' | 'error';

/** What may be listened for; events hold nothing but their names. */
export type KpcObjectEventMap = Object3DEventMap & Record<Events, object>;

export class KpcObject extends Mesh<BoxGeometry, MeshBasicMaterial, KpcObjectEventMap> {
  appearance: string;
  /** The clip, once its header has arrived. */
  clip: Clip | null = null;
  /** Why it cannot be shown; null if it can. */
  error: (Error & { code?: string }) | null = null;
  /** The box that the scene fills; what lies around it, if anything, is shown, too. */
  readonly box = new Box3();
  readonly #src: string | URL | Blob;
  readonly #options: KpcObjectOptions;
  #quality: Level | 'auto' = 'auto';
  readonly #clock = new Clock((event) => this.#emit(event));
  readonly #opening = new AbortController();
  #drawing: Drawing | null = null;
  #isShown = false;
  /** Where to begin once the duration is known. */
  #startTime = 0;
  #lastFrame = -1;
  #lastTime = 0;

  /** @param src an address, or a file that the page has. */
  constructor(src: string | URL | Blob, options: KpcObjectOptions = {}) {
    const nothing = { transparent: true, colorWrite: false, depthWrite: false, depthTest: false };
    super(new BoxGeometry(), new MeshBasicMaterial(nothing));
    [this.#src, this.#options] = [src, options];
    // Its box would cast a shadow where a page has all meshes cast some.
    for (const name of ['castShadow', 'receiveShadow']) {
      Object.defineProperty(this, name, { get: () => false, set: () => {} });
    }
    this.quality = options.quality ?? 'auto';
    this.appearance = options.appearance ?? '';
    this.#clock.loop = options.loop ?? false;
    this.frustumCulled = false; // time goes on and planes arrive while it is out of sight
    this.onBeforeRender = this.#draw;
    this.#open(src);
  }

  get quality(): Level | 'auto' {
    return this.#quality;
  }

  set quality(value: Level | 'auto') {
    const names = ['auto', ...LEVEL_NAMES];
    if (!names.includes(value)) throw new TypeError(`quality must be one of ${names.join(', ')}, not ${value}`);
    this.#quality = value;
  }

  get currentTime(): number {
    return this.clip ? this.#clock.time : this.#startTime;
  }

  set currentTime(seconds: number) {
    if (!Number.isFinite(seconds)) throw new TypeError('currentTime must be a finite number');
    if (this.clip) this.#clock.seek(seconds);
    else this.#startTime = Math.max(seconds, 0);
  }

  /** Seconds from the first frame to the last; `NaN` before it is known. */
  get duration(): number {
    return this.clip?.duration ?? Number.NaN;
  }

  get paused(): boolean {
    return this.#clock.paused;
  }

  get ended(): boolean {
    return this.#clock.ended;
  }

  get loop(): boolean {
    return this.#clock.loop;
  }

  set loop(value: boolean) {
    this.#clock.loop = value;
  }

  get playbackRate(): number {
    return this.#clock.rate;
  }

  set playbackRate(rate: number) {
    this.#clock.rate = rate;
  }

  play(): void {
    this.#clock.play();
  }

  pause(): void {
    this.#clock.pause();
  }

  /** Return another object that plays the same file, from the same time on. */
  override clone(recursive?: boolean): this {
    const { quality, appearance, loop, currentTime, playbackRate } = this;
    const options = { ...this.#options, quality, appearance, loop };
    const clone = new (this.constructor as typeof KpcObject)(this.#src, options) as this;
    const { geometry, material } = clone; // each disposes of its own
    return Object.assign(clone.copy(this, recursive), { geometry, material, currentTime, playbackRate });
  }

  /** Give everything back; remove it from its scene, too. */
  dispose(): void {
    this.#opening.abort();
    this.clip?.close();
    this.clip = null;
    this.#drawing?.scenes.renderer.dispose();
    this.#drawing = null;
    this.geometry.dispose();
    this.material.dispose();
  }

  async #open(src: string | URL | Blob): Promise<void> {
    const { memory, workerUrl } = this.#options;
    try {
      const pool = workerUrl === undefined ? undefined : { workerUrl };
      const clip = await Clip.open(src, { memory, pool, signal: this.#opening.signal });
      if (this.#opening.signal.aborted) return clip.close();
      this.#opened(clip);
    } catch (error) {
      if (!this.#opening.signal.aborted) this.#failed(error as Error);
    }
  }

  #opened(clip: Clip): void {
    clip.addEventListener('release', (event) => this.#drawing?.scenes.release((event as SceneEvent).scene));
    clip.addEventListener('error', () => this.#failed(clip.error as Error));
    const { aabb } = clip.scenes[0].head;
    this.box.set(new Vector3(...aabb.slice(0, 3)), new Vector3(...aabb.slice(3, 6)));
    const [size, centre] = [this.box.getSize(new Vector3()), this.box.getCenter(new Vector3())];
    this.geometry.dispose();
    this.geometry = new BoxGeometry(...size.toArray()).translate(...centre.toArray());
    Object.assign(this.#clock, { duration: clip.duration, frameCount: clip.frameCount });
    this.#clock.begin(this.#startTime);
    this.clip = clip;
    this.#emit('loadedmetadata');
  }

  /** Draw, in three's place and at three's time. */
  #draw(renderer: WebGLRenderer, _scene: Scene, camera: Camera): void {
    const { clip } = this;
    if (clip === null) return;
    try {
      this.#advance(clip, renderer.info.render.frame);
      const { scenes } = this.#drawingOn(renderer);
      if (clip.canShow(this.currentTime) || this.#isShown) this.#drawInto(renderer, scenes, clip, camera);
      else scenes.take(clip);
    } catch (error) {
      this.#failed(error as Error);
    }
    resume(renderer, camera);
  }

  /** Let time pass, once for each frame. */
  #advance(clip: Clip, frame: number): void {
    if (frame === this.#lastFrame) return;
    const now = performance.now();
    const seconds = this.#lastFrame < 0 ? 0 : (now - this.#lastTime) / 1000;
    [this.#lastFrame, this.#lastTime] = [frame, now];
    const { time, speed, loop } = this.#clock;
    clip.setPlayhead({ time, rate: speed, loop });
    this.#clock.tick(seconds, (time) => this.#isShown && clip.canShow(time));
  }

  #drawInto(renderer: WebGLRenderer, scenes: ClipScenes, clip: Clip, camera: Camera): void {
    const { gl } = scenes.renderer;
    const time = this.currentTime;
    const [x, y, width, height] = renderer.getCurrentViewport(new Vector4()).toArray();
    const framebuffer = gl.getParameter(gl.DRAW_FRAMEBUFFER_BINDING) as WebGLFramebuffer | null;
    const frame = { ...seenFrom(this, camera, renderer, width, height), screen: { framebuffer, x, y, width, height } };
    const { pictures } = scenes.renderer.drawInto([frame], scenes.moments(clip, time), {
      level: this.quality,
      appearance: appearanceOf(clip, time, this.appearance),
    });
    if (pictures === 0 || this.#isShown) return;
    this.#isShown = true;
    this.#emit('canplay');
  }

  #drawingOn(renderer: WebGLRenderer): Drawing {
    const gl = renderer.getContext() as WebGL2RenderingContext;
    if (this.#drawing?.gl === gl) return this.#drawing;
    if (this.#drawing) {
      this.#drawing.scenes.renderer.dispose();
      for (const scene of this.clip?.scenes ?? []) scene.restore();
      this.#isShown = false;
    }
    this.#drawing = { gl, scenes: new ClipScenes(new Renderer(gl, { fps: this.#options.fps })) };
    return this.#drawing;
  }

  #failed(error: Error): void {
    if (this.error) return;
    this.error = error;
    this.clip?.close();
    this.clip = null;
    this.#emit('error');
  }

  #emit(type: Events): void {
    this.dispatchEvent({ type });
  }
}

/** Have three.js go on where it was. */
function resume(renderer: WebGLRenderer, camera: Camera): void {
  const target = renderer.getRenderTarget();
  const [face, level] = [renderer.getActiveCubeFace(), renderer.getActiveMipmapLevel()];
  const viewport = renderer.getCurrentViewport(new Vector4());
  const { depth } = renderer.state.buffers;
  const isReversed = depth.getReversed?.() ?? false;
  renderer.resetState();
  if (isReversed) {
    depth.setReversed(true); // three.js forgets both
    depth.setClear(1);
  }
  renderer.setRenderTarget(target, face, level);
  if ('viewport' in camera) renderer.state.viewport(viewport);
}
