/**
 * Playing the sound of a clip in step with its pictures: the clock of the clip follows the device's.
 *
 * In each frame the caller asks `advance` by how much the clip is to go on, and passes its position to `follow`. Sound
 * is decoded in blocks ahead of the playhead and scheduled on the device's clock, one after the other. A sound that
 * is elsewhere than the clip, after a seek or a pause, begins anew there. No page, no timers.
 */

import { SAMPLE_RATE } from '../container/sound.js';

/** Seconds in which the clip follows a difference from the sound, but for 1 / e of it. */
const FOLLOW_S = 0.5;
/** A sound that is farther than this from the clip begins anew at the clip's time, seconds. */
const APART_S = 0.2;
/** A sound begins late against the clip by so many seconds at most; what the device's latency exceeds is cut. */
const LATE_S = 0.1;
/** Seconds of a block, and how many are scheduled ahead. */
const BLOCK_S = 1;
const AHEAD_S = 2;
/** Decoded blocks that are held: those ahead, the one that is heard, and the one before. */
const HELD_BLOCKS = 5;

const BLOCK = BLOCK_S * SAMPLE_RATE;

/** Samples of the left and the right side. */
export type Stereo = [Float32Array<ArrayBuffer>, Float32Array<ArrayBuffer>];

/** Where samples come from. */
export interface Samples {
  /** Return samples from `first` on; null if they cannot be had yet. */
  read(first: number, count: number): Promise<Stereo | null>;
}

/** What plays samples, with a clock of its own. */
export interface Output {
  /** What its clock says of the sound that is heard now, seconds; null while it stands. */
  readonly heardTime: number | null;
  /** From when on samples can be scheduled. */
  readonly nextTime: number;
  /** Play samples from the one with number `offset` on at a time of its clock. */
  schedule(samples: Stereo, offset: number, at: number): void;
  /** Drop everything that is scheduled. */
  clear(): void;
}

/** Samples that are scheduled: those from `position` of the clip on, at a time of the output. */
interface Scheduled {
  position: number;
  count: number;
  at: number;
}

export class SoundPlayback {
  readonly #samples: Samples;
  readonly #output: Output;
  readonly #length: number;
  readonly #failed: (error: unknown) => void;
  readonly #blocks = new Map<number, Stereo>();
  #scheduled: Scheduled[] = [];
  #isReading = false;
  #isOver = false;

  /**
   * @param duration seconds from the first frame to the last, after which a clip that loops begins again.
   * @param failed is called once if the sound cannot be read or decoded; the clip then plays without.
   */
  constructor(samples: Samples, duration: number, output: Output, failed: (error: unknown) => void) {
    [this.#samples, this.#output, this.#failed] = [samples, output, failed];
    this.#length = Math.round(duration * SAMPLE_RATE);
  }

  /** Return by how many seconds the clip is to advance, so that it follows what is heard. */
  advance(seconds: number, time: number, loops: boolean): number {
    const heard = this.#heard();
    if (heard === null) return seconds;
    const error = this.#apart(heard, time + seconds, loops);
    if (Math.abs(error) > APART_S) return seconds;
    return Math.max(seconds + error * (1 - Math.exp(-seconds / FOLLOW_S)), 0);
  }

  /** Take over where the clip is, in seconds, while it plays at its own speed. */
  follow(time: number, loops: boolean): void {
    const { heardTime } = this.#output;
    if (heardTime === null || this.#isOver || this.#length === 0) return;
    const heard = this.#heard();
    if (heard === null || Math.abs(this.#apart(heard, time, loops)) > APART_S) this.#begin(time, heardTime, loops);
    else this.#goOn(heardTime, loops);
  }

  /** Decode what will be heard first if the clip plays from here. */
  prepare(time: number): void {
    const position = Math.min(Math.round(time * SAMPLE_RATE), this.#length - 1);
    if (!this.#isOver && this.#length > 0) this.#block(Math.floor(position / BLOCK));
  }

  /** Be silent until the next `follow`. */
  hold(): void {
    if (this.#scheduled.length > 0) this.#output.clear();
    this.#scheduled = [];
  }

  /** End for good. */
  close(): void {
    this.hold();
    this.#isOver = true;
    this.#blocks.clear();
  }

  /** Begin anew at the clip's time, or fetch what is needed for that. */
  #begin(time: number, heardTime: number, loops: boolean): void {
    this.hold();
    const at = this.#output.nextTime;
    const cut = Math.max(at - heardTime - LATE_S, 0);
    let position = Math.round((time + cut) * SAMPLE_RATE);
    if (loops) position %= this.#length;
    if (position < this.#length && this.#schedule(position, at)) this.#goOn(heardTime, loops);
  }

  /** Schedule what follows, as far as it is there. */
  #goOn(heardTime: number, loops: boolean): void {
    for (;;) {
      const { position, count, at } = this.#scheduled[this.#scheduled.length - 1];
      const [next, nextAt] = [position + count, at + count / SAMPLE_RATE];
      if (nextAt > heardTime + AHEAD_S || (next >= this.#length && !loops)) return;
      // What has come too late for its turn begins anew, once the clip has passed it.
      if (nextAt < this.#output.nextTime || !this.#schedule(next % this.#length, nextAt)) return;
    }
  }

  /** Schedule the rest of the block that a sample is in; return whether it is there. */
  #schedule(position: number, at: number): boolean {
    const number = Math.floor(position / BLOCK);
    const block = this.#block(number);
    if (block === null) return false;
    const offset = position - number * BLOCK;
    this.#output.schedule(block, offset, at);
    this.#scheduled.push({ position, count: block[0].length - offset, at });
    return true;
  }

  /** Return a block; null if it is not there yet, and then begin to fetch it. */
  #block(number: number): Stereo | null {
    const found = this.#blocks.get(number);
    if (found) {
      this.#blocks.delete(number); // what was used last is dropped last
      this.#blocks.set(number, found);
      return found;
    }
    if (!this.#isReading) this.#read(number);
    return null;
  }

  async #read(number: number): Promise<void> {
    this.#isReading = true;
    const first = number * BLOCK;
    try {
      const samples = await this.#samples.read(first, Math.min(BLOCK, this.#length - first));
      if (samples && !this.#isOver) this.#blocks.set(number, samples);
      for (const old of [...this.#blocks.keys()].slice(0, -HELD_BLOCKS)) this.#blocks.delete(old);
    } catch (error) {
      if (!this.#isOver) {
        this.close();
        this.#failed(error);
      }
    }
    this.#isReading = false;
  }

  /** The sample of the clip that is heard now, below 0 before the first one is; null without any. */
  #heard(): number | null {
    const now = this.#output.heardTime;
    if (now === null) return null;
    while (this.#scheduled.length > 0) {
      const { position, count, at } = this.#scheduled[0];
      if (now < at + count / SAMPLE_RATE) return position + (now - at) * SAMPLE_RATE;
      this.#scheduled.shift();
    }
    return null;
  }

  /** How many seconds a sample is ahead of the clip; across the end of a clip that loops, the shorter way. */
  #apart(heard: number, time: number, loops: boolean): number {
    const apart = heard / SAMPLE_RATE - time;
    const length = this.#length / SAMPLE_RATE;
    return loops ? apart - length * Math.round(apart / length) : apart;
  }
}
