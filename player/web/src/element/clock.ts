/** Where a clip plays, with the events of HTMLMediaElement. No page, no timers: `tick` is called for each frame. */

import { finite } from './values.js';

export type ClockEvent =
  | 'play'
  | 'pause'
  | 'playing'
  | 'waiting'
  | 'timeupdate'
  | 'seeking'
  | 'seeked'
  | 'ended'
  | 'ratechange';

/** Speeds to choose from, clip seconds per second. */
export const SPEEDS = [0.1, 0.25, 0.5, 1, 2, 4] as const;
const MAX_RATE = 16;
/** Seconds between two timeupdate events while the clip plays. */
const UPDATE_S = 0.25;
/** Time does not go on for longer than this at once: a page that was hidden continues where it stopped. */
const MAX_STEP_S = 0.5;

/** Return the next faster speed of the list, or with -1 the next slower one. */
export function nextSpeed(rate: number, steps: number): number {
  const distances = SPEEDS.map((speed) => Math.abs(speed - rate));
  const nearest = distances.indexOf(Math.min(...distances));
  return SPEEDS[Math.min(Math.max(nearest + steps, 0), SPEEDS.length - 1)];
}

export class Clock {
  loop = false;
  /** Whether time stands still although the clip plays, as while its timeline is dragged. */
  isHeld = false;
  /** Seconds; 0 for a scene in which nothing moves. */
  duration = 0;
  frameCount = 1;
  #time = 0;
  #rate = 1;
  #paused = true;
  #isSeeking = false;
  #isWaiting = false;
  #sinceUpdate = 0;

  /** @param emit is called with each event. */
  constructor(readonly emit: (event: ClockEvent) => void) {}

  get time(): number {
    return this.#time;
  }

  get paused(): boolean {
    return this.#paused;
  }

  /** Whether it is at its end, however it came there, and does not go on from there. */
  get ended(): boolean {
    return this.duration > 0 && this.#time >= this.duration && !this.loop;
  }

  get isSeeking(): boolean {
    return this.#isSeeking;
  }

  /** Whether it would play if what to show were there. */
  get isWaiting(): boolean {
    return this.#isWaiting;
  }

  get rate(): number {
    return this.#rate;
  }

  set rate(value: number) {
    const rate = finite(value, 'playbackRate');
    if (rate <= 0 || rate > MAX_RATE) {
      throw new DOMException(`playbackRate must be above 0 and at most ${MAX_RATE}`, 'NotSupportedError');
    }
    if (rate === this.#rate) return;
    this.#rate = rate;
    this.emit('ratechange');
  }

  /** Clip seconds per second at present. */
  get speed(): number {
    return this.#paused || this.ended ? 0 : this.#rate;
  }

  /** Forget the clip, without an event. */
  reset(): void {
    this.#time = this.duration = this.#sinceUpdate = 0;
    this.frameCount = 1;
    this.#paused = true;
    this.#isSeeking = this.#isWaiting = this.isHeld = false;
  }

  /** Begin a clip at a time, without an event. */
  begin(time: number): void {
    this.#time = Math.min(Math.max(finite(time, 'currentTime'), 0), this.duration);
  }

  /** Play; from the start, if the clip has ended. */
  play(): void {
    if (this.ended) this.seek(0);
    if (!this.#paused) return;
    this.#paused = false;
    this.#isWaiting = true;
    this.emit('play');
  }

  pause(): void {
    if (this.#paused) return;
    this.#paused = true;
    this.#isWaiting = false;
    this.emit('timeupdate');
    this.emit('pause');
  }

  /** Go to a time, clamped to the clip. */
  seek(time: number): void {
    this.#time = Math.min(Math.max(finite(time, 'currentTime'), 0), this.duration);
    this.#isSeeking = true;
    this.emit('seeking');
  }

  /** Pause, round to a whole frame, and go some frames forward. */
  step(frames: number): void {
    const count = Math.trunc(finite(frames, 'frames'));
    this.pause();
    const last = this.frameCount - 1;
    if (last > 0) this.seek(((Math.round((this.#time / this.duration) * last) + count) / last) * this.duration);
  }

  /** Let time pass, if what is to be shown is there: `canShow` says so of a time. */
  tick(seconds: number, canShow: (time: number) => boolean): void {
    const isShown = canShow(this.#time);
    if (this.#isSeeking && isShown) {
      this.#isSeeking = false;
      this.emit('timeupdate');
      this.emit('seeked');
      if (this.#paused && this.ended) this.emit('ended');
    }
    if (this.#paused) return;
    if (!isShown) {
      if (!this.#isWaiting) this.emit('waiting');
      this.#isWaiting = true;
      return;
    }
    if (this.#isWaiting) {
      this.#isWaiting = false;
      this.emit('playing');
      return;
    }
    if (!this.isHeld) this.#advance(Math.min(seconds, MAX_STEP_S));
  }

  #advance(seconds: number): void {
    const time = this.#time + seconds * this.#rate;
    const isOver = time >= this.duration;
    this.#time = !isOver ? time : this.loop && this.duration > 0 ? time % this.duration : this.duration;
    this.#sinceUpdate += seconds;
    if (isOver && !this.loop) {
      this.#paused = true;
      for (const event of ['timeupdate', 'pause', 'ended'] as const) this.emit(event);
    } else if (this.#sinceUpdate >= UPDATE_S) {
      this.#sinceUpdate = 0;
      this.emit('timeupdate');
    }
  }
}
