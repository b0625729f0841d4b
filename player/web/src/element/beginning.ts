/** Where a clip begins, before that can be shown: by the page's link, by what a script has set, or where it was. */

import type { Moment } from './link.js';

export class Beginning {
  /** Seconds, and a view as the attribute `camera`, that a script has set. */
  time: number | null = null;
  view: string | null = null;
  /** What an element that was removed showed. */
  #left: { time: number; view: string; wasPlaying: boolean } | null = null;
  /** The address of the clip that the page's link is about: the one that the element showed first. */
  #linked: string | null = null;

  /** Note what is shown, since the element is removed; it goes on there when it is put back. */
  leave(time: number, view: string, wasPlaying: boolean): void {
    this.#left = { time, view, wasPlaying };
  }

  /** Another clip is to be shown. */
  forget(): void {
    this.#left = null;
  }

  /** Where playback would begin, seconds; null if nothing says so. */
  get known(): number | null {
    return this.time ?? this.#left?.time ?? null;
  }

  /**
   * Return where the clip of an address begins, and whether it was playing; what was set holds only once.
   * @param link what the page's link says.
   */
  take(address: string, link: Moment | null): Moment & { wasPlaying: boolean | null } {
    const left = this.#left;
    this.#linked ??= address;
    const linked = left === null && address === this.#linked ? link : null;
    const time = linked?.time ?? this.known;
    const camera = linked?.camera ?? this.view ?? left?.view ?? null;
    [this.#left, this.time, this.view] = [null, null, null];
    return { time, camera, wasPlaying: left?.wasPlaying ?? null };
  }
}
