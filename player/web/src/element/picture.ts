/** A canvas on which scenes of a clip are drawn. */

import type { Camera } from '../container/scene_chunks.js';
import { contextOf, whenIdle } from '../render/context.js';
import type { ShownPart } from '../render/picture_job.js';
import type { Level } from '../render/quality.js';
import { type Frame, Renderer } from '../render/renderer.js';
import type { Clip } from '../streaming/clip.js';
import type { SceneStream } from '../streaming/scene_stream.js';
import { appearanceOf, ClipScenes } from './clip_scenes.js';

export interface PictureOptions {
  /** Frames a second that level `auto` holds; undefined for what suits the device. */
  fps: number | undefined;
  onLost(): void;
  onRestored(): void;
}

export interface ShownOptions {
  level: Level | 'auto';
  part: ShownPart;
  /** Name of an appearance; an empty one is the average. */
  appearance: string;
}

export class Picture {
  readonly canvas: HTMLCanvasElement;
  readonly #renderer: Renderer;
  readonly #scenes: ClipScenes;

  private constructor(canvas: HTMLCanvasElement, renderer: Renderer) {
    this.canvas = canvas;
    this.#renderer = renderer;
    this.#scenes = new ClipScenes(renderer);
  }

  /**
   * Make a canvas, and wait for its context without holding up the page.
   * @param size width and height in pixels of the screen; to change it later waits for what the card does then.
   * @throws RenderError: the browser cannot draw.
   */
  static async open([width, height]: readonly [number, number], options: PictureOptions): Promise<Picture> {
    const canvas = Object.assign(document.createElement('canvas'), { width, height });
    const gl = contextOf(canvas);
    await whenIdle(gl);
    return new Picture(canvas, new Renderer(gl, options));
  }

  /** Whether there is a picture to make a file of. */
  get isThere(): boolean {
    return this.#renderer.hasPicture;
  }

  set fps(fps: number | undefined) {
    this.#renderer.fps = fps ?? this.#renderer.usualFps;
  }

  /** Set the size in pixels of the screen. */
  resize(width: number, height: number): void {
    if (this.canvas.width === width && this.canvas.height === height) return;
    Object.assign(this.canvas, { width, height });
    this.#renderer.present(); // stretched, until there is one of that size
  }

  /** Take what has arrived of scenes that are shown or will be; return whether to go on: there was some, or may be. */
  take(clip: Clip): boolean {
    return this.#scenes.take(clip);
  }

  /**
   * Draw what a camera sees of a clip at a time, or go on with that; soon rather than finely if the time was sought.
   * @returns how many pictures have been shown so far, and whether the last one will not become finer by itself.
   */
  draw(clip: Clip, time: number, camera: Camera, { level, part, appearance }: ShownOptions, hasSought: boolean) {
    return this.#renderer.draw(camera, this.#scenes.moments(clip, time), {
      level,
      part,
      hasSought,
      appearance: appearanceOf(clip, time, appearance),
    });
  }

  get gl(): WebGL2RenderingContext {
    return this.#renderer.gl;
  }

  /** Whether a processor stands in for a graphics card. */
  get isSoftware(): boolean {
    return this.#renderer.isSoftware;
  }

  /** Draw a clip at a time into the frames of a headset; return how many pictures have been shown so far. */
  drawInto(frames: readonly Frame[], clip: Clip, time: number, { level, part, appearance }: ShownOptions): number {
    const options = { level, part, appearance: appearanceOf(clip, time, appearance) };
    return this.#renderer.drawInto(frames, this.#scenes.moments(clip, time), options).pictures;
  }

  /** Have made what drawing needs for all scenes of a clip, before there is anything to draw; return whether it is. */
  prepare(clip: Clip, camera: Camera, { level, part }: ShownOptions): boolean {
    return this.#renderer.prepare(camera, this.#scenes.all(clip), { level, part });
  }

  /** Forget a scene that the clip no longer holds. */
  release(scene: SceneStream): void {
    this.#scenes.release(scene);
  }

  /** Return the picture as a file. */
  toBlob(type: string, quality?: number): Promise<Blob> {
    this.#renderer.present();
    return new Promise((resolve, reject) => {
      const done = (blob: Blob | null) =>
        blob ? resolve(blob) : reject(new Error(`cannot make a picture of ${type}`));
      this.canvas.toBlob(done, type, quality);
    });
  }

  /** Give everything back; browsers allow a page a few contexts only. */
  dispose(): void {
    this.#renderer.dispose();
    this.#renderer.gl.getExtension('WEBGL_lose_context')?.loseContext();
    this.canvas.remove();
  }
}
