/** How finely to draw so that frames come in time: no WebGL. */

import { LEVELS, type Level } from './quality.js';

/** A level, and the side of the raster over that of the picture, besides what the level itself takes off. */
export interface Rung {
  level: Level;
  scale: number;
}

/** From the fastest to the finest; below full size the fastest level alone. What each is worth: docs/benchmarks.md. */
export const RUNGS: readonly Rung[] = [
  ...[0.35, 0.42, 0.5, 0.6, 0.7, 0.84].map((scale) => ({ level: 'fastest' as const, scale })),
  ...(['fastest', 'faster', 'fast', 'balanced', 'fine', 'finer'] as const).map((level) => ({ level, scale: 1 })),
];

// Share of the time of a frame that drawing may take, and above which it is too slow.
const IN_TIME = 0.8;
const TOO_SLOW = 1.05;
// Frames on a rung before a coarser or a finer one: slow frames disturb at once, a finer picture can wait.
const DOWN_AFTER = 2;
const UP_AFTER = 8;
// Frames for which the time of a rung is remembered that proved too slow.
const REMEMBERED = 300;

/** Return the pixels that are marched for each of the picture's, times samples for each of the scene's steps. */
export function costOf({ level, scale }: Rung): number {
  const { resolution, step } = LEVELS[level];
  return (resolution * scale) ** 2 / step;
}

/** Chooses a rung by how long frames took. */
export class Pace {
  #at: number;
  #recent: number[] = [];
  #frames = 0;
  readonly #tooSlow = new Map<number, number>(); // rung to the frame until which it counts as too slow

  /** @param secondsPerFrame in which a frame is to be drawn. */
  constructor(
    public secondsPerFrame: number,
    first = 0,
  ) {
    this.#at = first;
  }

  get rung(): Rung {
    return RUNGS[this.#at];
  }

  /** Take the time that a frame of the present rung took, and choose the next one. */
  record(seconds: number): void {
    this.#frames++;
    this.#recent.push(seconds);
    const typical = median(this.#recent.slice(-DOWN_AFTER));
    const expected = (rung: number) => (typical * costOf(RUNGS[rung])) / costOf(this.rung);
    if (this.#recent.length >= DOWN_AFTER && typical > TOO_SLOW * this.secondsPerFrame && this.#at > 0) {
      this.#tooSlow.set(this.#at, this.#frames + REMEMBERED);
      let next = this.#at - 1;
      while (next > 0 && expected(next) > IN_TIME * this.secondsPerFrame) next--;
      this.#move(next);
    } else if (this.#recent.length >= UP_AFTER) {
      let next = this.#at;
      while (next + 1 < RUNGS.length && this.#isAffordable(next + 1, expected(next + 1))) next++;
      this.#move(next);
    }
  }

  #isAffordable(rung: number, seconds: number): boolean {
    return seconds < IN_TIME * this.secondsPerFrame && (this.#tooSlow.get(rung) ?? 0) < this.#frames;
  }

  #move(rung: number): void {
    this.#at = rung;
    this.#recent = [];
  }
}

function median(values: readonly number[]): number {
  const sorted = [...values].sort((a, b) => a - b);
  return sorted[Math.floor(sorted.length / 2)];
}
