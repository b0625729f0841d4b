/** How fast a device is, as far as pictures have shown, and what it has time for: no WebGL. */

import { costOf, Pace, type Setting } from './pace.js';
import { BLOCK, FOLLOWING_LEVELS } from './quality.js';

/** Frames a second that `auto` holds, unless others are asked for. */
const FPS = { card: 30, processor: 10 };
/** Seconds for a ray, until it is known: of a card, and of a processor in its place. */
const ASSUMED_SECONDS = { card: 2e-7, processor: 1e-5 };
/** Rays for a pixel of the first pictures on a card, before it is known how fast it is. */
export const FIRST_RAYS = 0.1;
/** Weight of a new measurement in what is known. */
const NEW_WEIGHT = 0.5;
/** A picture that follows another is never expected to take less than a whole one divided by this. */
const MOST_SAVED = 4;
/** While the camera has rested for so many seconds, pictures are as fine as those that follow others come in time. */
const REST_S = 0.5;
/** A whole picture that others are to follow may take so many frames, and twice as many for each PATIENCE_S of rest. */
const MOST_FRAMES = 3;
const PATIENCE_S = 10;
/** Frames, and the share of them, that must leave time for finer pictures: how much of them changes varies. */
const FOLLOWING = { levels: FOLLOWING_LEVELS, upAfter: 20, share: 0.9 };
/** Seconds that the sample pixels of a picture may take. */
const MOST_SAMPLING_S = 0.1;

/** Pictures that are marched whole, and those that follow another. */
type Kind = 'whole' | 'following';

/** What is measured of a picture in the making. */
export interface Work {
  readonly raysPerRow: number;
  readonly raysPerPixel: number;
  readonly rowsLeft: number;
  /** How it follows another picture; null: it is whole. */
  readonly follows: object | null;
}

export class Speed {
  readonly usualFps: number;
  readonly #paces: Record<Kind, Pace>;
  readonly #secondsPerRay: Record<Kind, number>;

  constructor(isSoftware: boolean, fps?: number) {
    const device = isSoftware ? 'processor' : 'card';
    this.usualFps = FPS[device];
    const seconds = 1 / (fps ?? this.usualFps);
    this.#paces = {
      whole: new Pace(seconds, isSoftware ? 0 : FIRST_RAYS),
      following: new Pace(seconds, 0, FOLLOWING),
    };
    this.#secondsPerRay = { whole: ASSUMED_SECONDS[device], following: ASSUMED_SECONDS[device] };
  }

  get secondsPerFrame(): number {
    return this.#paces.whole.secondsPerFrame;
  }

  /** Frames a second that settings hold. */
  set fps(fps: number) {
    for (const pace of Object.values(this.#paces)) pace.secondsPerFrame = 1 / fps;
  }

  /** Whether it is known how long whole pictures take, so that others may follow one. */
  get isSettled(): boolean {
    return this.#paces.whole.isSettled;
  }

  /** Return the finest setting for which there is time, given for how many seconds the camera has rested. */
  setting(texelsPerPixel: number, restedS: number): Setting {
    const { whole, following } = this.#paces;
    const setting = whole.setting(texelsPerPixel);
    if (!this.isResting(restedS)) return setting;
    const mostCost = MOST_FRAMES * 2 ** (restedS / PATIENCE_S) * whole.affordable;
    const finer = following.setting(texelsPerPixel, mostCost);
    return costOf(finer, texelsPerPixel) > costOf(setting, texelsPerPixel) ? finer : setting;
  }

  /** Whether the camera has rested for so long that settings are for pictures that follow one another. */
  isResting(restedS: number): boolean {
    return restedS > REST_S && this.isSettled;
  }

  /** Whether there is time to march the sample pixels of a picture at once. */
  canSample({ raysPerRow, rowsLeft }: Work): boolean {
    return (raysPerRow * rowsLeft * this.#secondsPerRay.whole) / BLOCK ** 2 < MOST_SAMPLING_S;
  }

  /** Return how many rows of a picture take about so many seconds, of those that are left. */
  rows({ raysPerRow, rowsLeft, follows }: Work, seconds: number): number {
    const { whole, following } = this.#secondsPerRay;
    const perRay = follows ? Math.max(following, whole / MOST_SAVED) : whole;
    return Math.min(Math.max(1, Math.floor(seconds / perRay / raysPerRow)), rowsLeft);
  }

  /** Take the time of some rows. */
  recordRows({ raysPerRow, follows }: Work, rows: number, seconds: number): void {
    const kind = follows ? 'following' : 'whole';
    const known = this.#secondsPerRay[kind];
    this.#secondsPerRay[kind] = known + NEW_WEIGHT * (seconds / (rows * raysPerRow) - known);
  }

  /** Take the time of a picture; `isAlone`: others are to follow it, so that no more like it come soon. */
  record({ raysPerPixel, follows }: Work, seconds: number, isAlone = false): void {
    if (follows) this.#paces.following.record(raysPerPixel, seconds);
    else if (isAlone) this.#paces.whole.recordOne(raysPerPixel, seconds);
    else this.#paces.whole.record(raysPerPixel, seconds);
  }
}
