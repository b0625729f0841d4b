/** The sound of a clip that is being shown: whether it is heard, and how loud. */

import { ClipSamples } from '../sound/clip_samples.js';
import { canDecode, decode } from '../sound/opus.js';
import { AudioOutput } from '../sound/output.js';
import { SoundPlayback } from '../sound/playback.js';
import type { Clip } from '../streaming/clip.js';
import type { Clock } from './clock.js';

const NO_DECODER = 'No sound: this browser does not decode it here';

export class SessionSound {
  readonly #clip: Clip;
  readonly #clock: Clock;
  readonly #volume: () => number;
  readonly #tell: (message: string) => void;
  #hasSound = false;
  readonly #output = new AudioOutput();
  readonly #playback: SoundPlayback;
  #isOver = false;

  /**
   * @param volume from 0 to 1, 0 while it is off.
   * @param tell shows the user why nothing is heard; called once.
   */
  constructor(clip: Clip, clock: Clock, volume: () => number, tell: (message: string) => void) {
    [this.#clip, this.#clock, this.#volume, this.#tell] = [clip, clock, volume, tell];
    const failed = (error: unknown) => this.#fail(`The sound has ended: ${(error as Error).message}`);
    this.#playback = new SoundPlayback(new ClipSamples(clip, decode), clip.duration, this.#output, failed);
    document.addEventListener('visibilitychange', this.#hidden);
  }

  /** Whether the clip has sound, as far as is known. */
  get isThere(): boolean {
    this.#hasSound ||= this.#clip.scenes.some(({ sound }) => sound.numbers.length > 0);
    return this.#hasSound;
  }

  /** Whether there would be sound if the browser did not wait for a gesture of the user. */
  get isBlocked(): boolean {
    return this.#isWanted && this.#output.isBlocked;
  }

  /** Return by how many seconds the clip is to advance, so that it follows what is heard. */
  advance(seconds: number): number {
    const { time, loop } = this.#clock;
    return this.#plays ? this.#playback.advance(seconds, time, loop) : seconds;
  }

  /** Take over where the clip is now; what it begins with is decoded before it plays. */
  follow(): void {
    const { time, loop, paused } = this.#clock;
    if (this.#plays) {
      if (!this.#wake(false)) return;
      this.#output.volume = this.#volume();
      this.#playback.follow(time, loop);
      return;
    }
    this.#playback.hold();
    this.#output.rest();
    if (paused && this.#isWanted && canDecode()) this.#playback.prepare(time);
  }

  /** Let the browser play sound: called while it handles something that the user has done. */
  unlock(): void {
    if (this.#isWanted) this.#wake(true);
  }

  close(): void {
    document.removeEventListener('visibilitychange', this.#hidden);
    this.#isOver = true;
    this.#playback.close();
    this.#output.close();
  }

  get #isWanted(): boolean {
    return !this.#isOver && this.#volume() > 0 && this.isThere;
  }

  /** Whether the clip moves as its sound does: at its own speed. */
  get #plays(): boolean {
    const { speed, isWaiting, isSeeking, isHeld } = this.#clock;
    return this.#isWanted && speed === 1 && !isWaiting && !isSeeking && !isHeld && !document.hidden;
  }

  /** Have the device play; return whether it does, or will once the browser permits it. */
  #wake(isGesture: boolean): boolean {
    if (!canDecode()) return this.#fail(NO_DECODER);
    try {
      this.#output.wake(isGesture);
      return true;
    } catch (error) {
      return this.#fail(`No sound: ${(error as Error).message}`);
    }
  }

  #fail(message: string): false {
    if (!this.#isOver) this.#tell(message);
    this.#isOver = true;
    return false;
  }

  readonly #hidden = (): void => {
    if (document.hidden) this.follow();
  };
}
