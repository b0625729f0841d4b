/** How finely to draw so that frames come in time: no WebGL. */

import { LEVELS, type Level } from './quality.js';

/** A level, and the side of the raster over that of the picture, besides what the level itself takes off. */
export interface Rung {
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

/** Return the rungs for pictures whose pixels span so many texels of the finest scale, from the fastest on. */
export function rungsOf(texelsPerPixel: number): Rung[] {
  const [least, most] = COARSE_TEXELS;
  const rungs = (level: Level, sides: number[]) =>
    sides.map((side) => ({ level, scale: side / LEVELS[level].resolution }));
  return [
    ...rungs(
      'fastest',
      SIDES.filter((side) => texelsPerPixel >= least * side),
    ),
    ...rungs(
      'faster',
      SIDES.filter((side) => side < 1 && texelsPerPixel <= most * side),
    ),
    ...rungs('balanced', [1]),
    ...rungs('fine', [1]),
  ];
}

// Share of the time of a frame that drawing may take, and above which it is too slow.
const IN_TIME = 0.8;
const TOO_SLOW = 1.05;
// Frames on a rung before a coarser or a finer one: slow frames disturb at once, a finer picture can wait.
const DOWN_AFTER = 2;
const UP_AFTER = 8;
// Frames for which the cost of what proved too slow is remembered.
const REMEMBERED = 300;

/** Return the rays that are marched for each pixel that spans so many texels, those of longer steps counting less. */
export function costOf({ level, scale }: Rung, texelsPerPixel: number): number {
  const { resolution, step, raysAcross } = LEVELS[level];
  const rays = Math.max(1, Math.min(Math.floor(texelsPerPixel), raysAcross));
  return (rays * resolution * scale) ** 2 / step;
}

/** Chooses a rung by how long frames took. */
export class Pace {
  /** In which a frame is to be drawn. */
  secondsPerFrame: number;
  /** Rays for each pixel that there is time for, as far as is known. */
  #affordable: number;
  #recent: number[] = [];
  #frames = 0;
  #tooMuch = { cost: Number.POSITIVE_INFINITY, until: 0 };

  /** @param affordable rays for each pixel of the first pictures. */
  constructor(secondsPerFrame: number, affordable: number) {
    this.secondsPerFrame = secondsPerFrame;
    this.#affordable = affordable;
  }

  /** Return the finest rung for which there is time. */
  rung(texelsPerPixel: number): Rung {
    const [fastest, ...finer] = rungsOf(texelsPerPixel);
    return finer.reduce((best, rung) => (this.#isAffordable(costOf(rung, texelsPerPixel)) ? rung : best), fastest);
  }

  /** Take the time of a picture, and how many rays were marched for each of its pixels. */
  record(cost: number, seconds: number): void {
    this.#frames++;
    this.#recent.push(seconds / cost);
    const typical = median(this.#recent.slice(-DOWN_AFTER));
    const isTooSlow = typical * cost > TOO_SLOW * this.secondsPerFrame;
    if (this.#recent.length >= DOWN_AFTER && isTooSlow) {
      this.#tooMuch = { cost, until: this.#frames + REMEMBERED };
      this.#settle((IN_TIME * this.secondsPerFrame) / typical);
    } else if (this.#recent.length >= UP_AFTER) {
      const affordable = (IN_TIME * this.secondsPerFrame) / median(this.#recent);
      this.#settle(Math.max(affordable, cost));
    }
  }

  #isAffordable(cost: number): boolean {
    const isTooMuch = cost >= this.#tooMuch.cost && this.#frames < this.#tooMuch.until;
    return cost <= this.#affordable && !isTooMuch;
  }

  #settle(affordable: number): void {
    this.#affordable = affordable;
    this.#recent = [];
  }
}

function median(values: readonly number[]): number {
  const sorted = [...values].sort((a, b) => a - b);
  return sorted[Math.floor(sorted.length / 2)];
}
