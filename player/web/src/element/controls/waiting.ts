/** The sign that the picture is waited for, and why, once that takes long. */

import { make } from './dom.js';

/** Milliseconds after which the reason is shown. */
const LATE_MS = 3000;

export class Waiting {
  readonly #text = make('p', {});
  readonly element = make('div', { class: 'waiting', hidden: true }, make('div', { class: 'spinner' }), this.#text);
  #reason = '';
  #isLate = false;
  #timer = 0;

  /** Show the sign or not; a reason is a line without capitals, or null. */
  update(isWaiting: boolean, reason: string | null): void {
    if (this.element.hidden === isWaiting) {
      this.element.hidden = !isWaiting;
      this.#isLate = false;
      clearTimeout(this.#timer);
      if (isWaiting) this.#timer = window.setTimeout(this.#late, LATE_MS);
    }
    this.#reason = reason ? `${reason[0].toUpperCase()}${reason.slice(1)}` : '';
    this.#explain();
  }

  readonly #late = (): void => {
    this.#isLate = true;
    this.#explain();
  };

  #explain(): void {
    const text = this.#isLate ? this.#reason : '';
    if (this.#text.textContent !== text) this.#text.textContent = text;
  }
}
