/** Whether the page scrolls, which leaves it the wheel and strokes of one finger. */

/** Milliseconds after which it is found out anew. */
const LASTS_MS = 1000;

export class PageScroll {
  #until = 0;
  #isNone = false;

  /** Whether there is nothing to scroll. */
  get isNone(): boolean {
    const now = performance.now();
    if (now >= this.#until) {
      this.#until = now + LASTS_MS;
      const page = document.scrollingElement;
      this.#isNone = page !== null && page.scrollHeight <= page.clientHeight;
    }
    return this.#isNone;
  }
}
