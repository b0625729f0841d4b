/** How finely to draw so that frames come in time: no WebGL. */

import { LEVEL_NAMES, LEVELS, type Level } from './quality.js';

/** A quality level and a scale: the side of the raster over that of the picture, besides what the level takes off. */
export interface Setting {
  level: Level;
  scale: number;
}

/** Sides of rasters over that of the picture. */
const SIDES = Array.from({ length: 15 }, (_, i) => 2 ** ((i - 14) / 4));
/**
 * Where a pixel of the raster spans so many texels, longer steps cost the picture less than a coarser raster would;
 * the second number is where they cost more. Figures: docs/benchmarks.md, "Drawing in a browser".
 */
const COARSE_TEXELS = [1.7, 2];
/**
 * A raster whose pixels span more than so many texels shows too little; but slow devices may always go to this side.
 */
const MOST_TEXELS = 3.5;
const LEAST_SIDE = 0.35;

/** Return the settings for pictures whose pixels span so many texels of the finest scale, from the fastest on. */
export function settingsOf(texelsPerPixel: number): Setting[] {
  const [least, most] = COARSE_TEXELS;
  const sides = SIDES.filter((side) => texelsPerPixel <= MOST_TEXELS * side || side >= LEAST_SIDE);
  const settings = (level: Level, chosen: number[]) =>
    chosen.map((side) => ({ level, scale: side / LEVELS[level].resolution }));
  return [
    ...settings(
      'fastest',
      sides.filter((side) => texelsPerPixel >= least * side),
    ),
    ...settings(
      'faster',
      sides.filter((side) => side < 1 && texelsPerPixel <= most * side),
    ),
    ...settings('balanced', [1]),
    ...settings('fine', [1]),
  ];
}

// Share of the time of a frame that drawing may take, and above which it is too slow.
const IN_TIME = 0.8;
const TOO_SLOW = 1.05;
// Frames of one cost before a coarser or, by default, a finer one: slow frames disturb at once, a finer picture can wait.
const DOWN_AFTER = 3;
const UP_AFTER = 8;
// Frames for which the time of other costs is remembered, and seconds for which that is which proved too slow.
const REMEMBERED = 300;
const AVOIDED_S = 10;
// Share of the time of a frame below which the next finer setting is tried, whatever is expected of it, and its cost
// over that of the one before.
const ROOMY = 0.7;
const NEXT_COST = 1.5;
// A raster has whole pixels: its cost may be off that of its setting by this factor.
const ROUNDING = 1.05;
// Weight of the fictitious frame without rays that takes no time, so that one known time suffices.
const ORIGIN_WEIGHT = 0.5;

/** Return the rays that are marched for each pixel that spans so many texels, those of longer steps counting less. */
export function costOf({ level, scale }: Setting, texelsPerPixel: number): number {
  const { resolution, step, raysAcross } = LEVELS[level];
  const rays = Math.max(1, Math.min(Math.floor(texelsPerPixel), raysAcross));
  return (rays * resolution * scale) ** 2 / step;
}

/** What a `Pace` chooses from, and when: by default among all levels, a finer one after UP_AFTER frames. */
interface Choice {
  levels?: readonly Level[];
  /** Frames of one cost before a finer one, and the share of them that must have left time for it. */
  upAfter?: number;
  share?: number;
}

/**
 * Chooses a setting by how long frames took: fixed + perRay cost seconds, fitted to the times of the costs that were
 * tried, as kpc.player.app.resolution_controller does. If the time of one of them changes, those of all do, by the same
 * factor.
 */
export class Pace {
  /** In which a frame is to be drawn. */
  secondsPerFrame: number;
  /** Rays for each pixel that there is time for, as far as is known. */
  #affordable: number;
  #isSettled = false;
  #recent: number[] = [];
  #lastCost = 0;
  #frames = 0;
  #elapsed = 0;
  #coarsest = 0;
  readonly #times = new Map<number, { seconds: number; frame: number }>();
  #tooMuch = { cost: Number.POSITIVE_INFINITY, until: 0 };

  /** @param affordable rays for each pixel of the first pictures. */
  constructor(
    secondsPerFrame: number,
    affordable: number,
    readonly choice: Choice = {},
  ) {
    this.secondsPerFrame = secondsPerFrame;
    this.#affordable = affordable;
  }

  /** Rays for each pixel that there is time for, as far as is known. */
  get affordable(): number {
    return this.#affordable;
  }

  /** Whether it was once found that there is no time for more. */
  get isSettled(): boolean {
    return this.#isSettled;
  }

  /** Return the finest setting for which there is time, of those that cost so much at most. */
  setting(texelsPerPixel: number, mostCost = Number.POSITIVE_INFINITY): Setting {
    const { levels = LEVEL_NAMES } = this.choice;
    const [fastest, ...finer] = settingsOf(texelsPerPixel).filter(({ level }) => levels.includes(level));
    this.#coarsest = costOf(fastest, texelsPerPixel);
    return finer.reduce((best, setting) => {
      const cost = costOf(setting, texelsPerPixel);
      return cost <= mostCost && this.#isAffordable(cost) ? setting : best;
    }, fastest);
  }

  /** Take the time of a picture, and how many rays were marched for each of its pixels. */
  record(cost: number, seconds: number): void {
    this.#frames++;
    this.#elapsed += Math.max(seconds, this.secondsPerFrame);
    if (cost !== this.#lastCost) this.#recent = [];
    this.#lastCost = cost;
    this.#recent.push(seconds);
    const lately = median(this.#recent.slice(-DOWN_AFTER));
    const isTooSlow = lately > TOO_SLOW * this.secondsPerFrame;
    const { upAfter = UP_AFTER, share = 0.5 } = this.choice;
    if (this.#recent.length < (isTooSlow ? DOWN_AFTER : upAfter)) return;
    const typical = isTooSlow ? lately : quantile(this.#recent, share);
    this.#learn(cost, typical);
    this.#recent = [];
    const { fixed, perRay } = this.#fit();
    // If most of the time does not depend on the rays, fewer of them do more harm than good.
    const [spare, least] = [IN_TIME * this.secondsPerFrame - fixed, fixed / 2];
    const affordable = Math.max(spare, least) / perRay;
    if (least > spare) this.#tooMuch.until = 0;
    else if (isTooSlow && affordable < cost && cost > this.#coarsest) {
      this.#tooMuch = { cost, until: this.#elapsed + AVOIDED_S };
    }
    const isRoomy = Math.max(lately, typical) < ROOMY * this.secondsPerFrame;
    const before = this.#affordable;
    this.#affordable = isTooSlow ? affordable : Math.max(affordable, isRoomy ? NEXT_COST * cost : cost);
    this.#isSettled ||= this.#affordable <= before;
  }

  /** Take the time of a single picture: it may show that there is time for more, since few are faster than usual. */
  recordOne(cost: number, seconds: number): void {
    this.#affordable = Math.max(this.#affordable, (IN_TIME * this.secondsPerFrame * cost) / seconds);
  }

  #isAffordable(cost: number): boolean {
    const isTooMuch = ROUNDING * cost >= this.#tooMuch.cost && this.#elapsed < this.#tooMuch.until;
    return cost <= ROUNDING * this.#affordable && !isTooMuch;
  }

  #learn(cost: number, seconds: number): void {
    const factor = seconds / (this.#times.get(cost)?.seconds ?? seconds);
    for (const [other, time] of this.#times) {
      time.seconds *= factor;
      if (time.frame < this.#frames - REMEMBERED) this.#times.delete(other);
    }
    this.#times.set(cost, { seconds, frame: this.#frames });
  }

  #fit(): { fixed: number; perRay: number } {
    const known = [...this.#times].map(([cost, { seconds }]) => [cost, seconds]);
    const sum = (term: (cost: number, seconds: number) => number) => known.reduce((all, [x, y]) => all + term(x, y), 0);
    const n = known.length + ORIGIN_WEIGHT;
    const [x, y, xx, xy] = [sum((cost) => cost), sum((_, s) => s), sum((cost) => cost * cost), sum((c, s) => c * s)];
    const slope = (n * xy - x * y) / (n * xx - x * x);
    const fixed = (y - slope * x) / n;
    if (known.length < 2 || fixed < 0) return { fixed: 0, perRay: xy / xx };
    return { fixed, perRay: Math.max(slope, 1e-9) };
  }
}

const median = (values: readonly number[]): number => quantile(values, 0.5);

function quantile(values: readonly number[], share: number): number {
  const sorted = [...values].sort((a, b) => a - b);
  return sorted[Math.floor(sorted.length * share)];
}
