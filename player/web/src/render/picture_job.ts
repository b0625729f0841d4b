/** A picture in the making: its rays are marched in strips of rows, so that no single call takes long. */

import { type Camera, resized, texelsPerPixel } from './camera.js';
import type { Device, Framebuffer } from './device.js';
import type { DrawnScene, Shot } from './drawn_scene.js';
import { ALL_PIXELS, type Following, type Pixels } from './following.js';
import type { Limits } from './merging.js';
import type { Setting } from './pace.js';
import type { Presentation, Target } from './presentation.js';
import { LEVELS, type Quality } from './quality.js';
import type { SceneSource } from './scene_source.js';

export type ShownPart = 'all' | 'static' | 'dynamic';

/** A scene at a time in [0, 1] of its own, and its share of the picture: 1, or two groups' that make 1 together. */
export interface Moment {
  scene: DrawnScene;
  time: number;
  share: number;
}

/** What a picture shows. */
export interface View {
  camera: Camera;
  moments: readonly Moment[];
  part: ShownPart;
  appearance: Float32Array | null;
  background: ArrayLike<number> | null;
}

/** How a picture is kept: its role distinguishes it from others of the same size. */
export interface Keeping {
  role: string;
  isExact: boolean; // with float32 numbers and depths
  isCounted?: boolean; // with the number of cells that were looked up
  limits?: Limits | null; // with depths, rays seeing so far only
}

/** How a picture follows the one before, which shows the same at another time. */
export interface Follows {
  following: Following;
  /** What was marched for the picture before, by the names of its shots. */
  before: ReadonlyMap<string, Target>;
  /** How many pictures it has followed without a break. */
  turn: number;
}

/** A finished picture of a moment, at the camera's size or smaller, and the static part to subtract from it. */
export interface Picture {
  share: number;
  target: Target;
  still: Target | null;
}

/** Pixels of a raster with several rays a pixel, at most. */
const MOST_PIXELS = 1 << 22;

/** A shot, where it is drawn, and a name for it among those of a picture. */
type PlacedShot = Shot & { name: string; scene: DrawnScene; target: Target; raysAcross: number; share: number };

export class PictureJob {
  readonly view: View;
  readonly setting: Setting;
  readonly role: string;
  /** Seconds that the card has spent on it. */
  seconds = 0;
  readonly #shots: PlacedShot[];
  readonly #keeping: Keeping;
  /** Which pixels of each shot are marched, once that is known. */
  readonly #pixels = new Map<Shot, Pixels>();
  #follows: Follows | null = null;
  #nextRow = 0;

  constructor(view: View, setting: Setting, presentation: Presentation, keeping: Keeping) {
    this.view = view;
    this.setting = setting;
    this.role = keeping.role;
    this.#keeping = keeping;
    const quality = LEVELS[setting.level];
    const parts = { all: [true], static: [false], dynamic: [true, false] }[view.part];
    this.#shots = view.moments.flatMap(({ scene, time, share }, number) => {
      const raysAcross = raysAcrossOf(scene.source, view.camera, quality);
      const camera = rasterOf(view.camera, raysAcross * quality.resolution * setting.scale);
      const { appearance } = view;
      const background = view.background ?? scene.source.head.background;
      return parts.map((isMoving) => {
        const name = `${number} ${isMoving}`;
        const target = presentation.target(`${keeping.role} ${name}`, camera.width, camera.height, keeping);
        return { name, scene, camera, time, share, quality, isMoving, appearance, background, target, raysAcross };
      });
    });
  }

  /** Rays of a row of the picture, those of longer steps counting less. */
  get raysPerRow(): number {
    const { camera, quality } = this.#shots[0];
    return camera.width / quality.step;
  }

  /** Rays for each pixel, those of longer steps counting less. */
  get raysPerPixel(): number {
    const { width, height } = this.view.camera;
    return (this.raysPerRow * this.#shots[0].target.height) / (width * height);
  }

  get rowsLeft(): number {
    return this.#shots.reduce((sum, { target }) => sum + target.height, 0) - this.#nextRow;
  }

  /** What is marched, by names of shots: for each moment the whole scene, its static part, or both. */
  get targets(): ReadonlyMap<string, Target> {
    return new Map(this.#shots.map(({ name, target }) => [name, target]));
  }

  /** How it follows another picture; null: it is whole. */
  get follows(): Follows | null {
    return this.#follows;
  }

  /** March only what has changed, as far as there is a picture before; called before `march`. */
  follow(follows: Follows): void {
    if (this.#shots.some(({ name }) => follows.before.has(name))) this.#follows = follows;
  }

  /** March some rows. */
  march(device: Device, rows: number): void {
    let first = this.#nextRow;
    let more = rows;
    for (const shot of this.#shots) {
      const count = Math.min(more, shot.target.height - first);
      if (count > 0) {
        const pixels = this.#pixelsOf(device, shot);
        shot.scene.march(device, shot.target, { ...shot, ...this.#keeping, pixels }, first, count);
        more -= count;
      }
      first = Math.max(0, first - shot.target.height);
    }
    this.#nextRow += rows - more;
  }

  #pixelsOf(device: Device, shot: PlacedShot): Pixels {
    const before = this.#follows?.before.get(shot.name);
    if (!this.#follows || before?.width !== shot.target.width || before.height !== shot.target.height) {
      return ALL_PIXELS;
    }
    const known = this.#pixels.get(shot);
    if (known) return known;
    const { following, turn } = this.#follows;
    const march = (into: Framebuffer, pixels: Pixels) => shot.scene.march(device, into, { ...shot, pixels });
    const found = following.findChanges(shot.name, before, turn, LEVELS[this.setting.level].tolerance, march);
    this.#pixels.set(shot, found);
    return found;
  }

  /** Return the pictures of the moments, once all rows are marched. */
  finish(presentation: Presentation): Picture[] {
    const { camera, moments } = this.view;
    const targets = this.#shots.map(({ target, raysAcross, isMoving }, number) => {
      if (raysAcross === 1) return target;
      const name = `mean ${this.role} ${number} ${isMoving}`;
      const mean = presentation.target(name, camera.width, camera.height, this.#keeping);
      return presentation.average(target, mean, raysAcross);
    });
    const parts = targets.length / moments.length;
    return moments.map(({ share }, number) => ({
      share,
      target: targets[number * parts],
      still: parts === 2 ? targets[number * parts + 1] : null,
    }));
  }
}

/** Return how many rays go across a pixel: as many as it spans texels, as far as level and memory allow. */
function raysAcrossOf(scene: SceneSource, camera: Camera, { raysAcross }: Quality): number {
  if (scene.mapping !== null || raysAcross === 1) return 1; // texels differ where space is mapped
  const most = Math.floor(Math.sqrt(Math.max(1, MOST_PIXELS / (camera.width * camera.height))));
  return Math.max(1, Math.min(Math.floor(texelsPerPixel(scene, camera)), raysAcross, most));
}

/** Return the camera with the raster of rays that is marched. */
function rasterOf(camera: Camera, factor: number): Camera {
  if (factor === 1) return camera;
  const [width, height] = [camera.width, camera.height].map((side) => Math.max(1, Math.round(side * factor)));
  return resized(camera, width, height);
}
