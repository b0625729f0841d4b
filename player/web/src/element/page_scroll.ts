/** Whether anything around the player scrolls, which leaves it the wheel and strokes of one finger. */

/** Milliseconds after which it is found out anew. */
const LASTS_MS = 1000;

export class PageScroll {
  readonly #element: Element;
  #until = 0;
  #isNone = false;

  constructor(element: Element) {
    this.#element = element;
  }

  /** Whether there is nothing to scroll. */
  get isNone(): boolean {
    const now = performance.now();
    if (now >= this.#until) {
      this.#until = now + LASTS_MS;
      this.#isNone = !isScrolled(this.#element);
    }
    return this.#isNone;
  }
}

/** Whether an element or one around it scrolls up and down, in the pages around its own, too. */
function isScrolled(element: Element): boolean {
  const { ownerDocument: page, scrollHeight, clientHeight } = element;
  const isScroller = () =>
    element === page.scrollingElement || ['auto', 'scroll'].includes(getComputedStyle(element).overflowY);
  if (scrollHeight > clientHeight && isScroller()) return true;
  const { host } = element.getRootNode() as Partial<ShadowRoot>;
  const view = page.defaultView as Window;
  const outer = element.assignedSlot ?? element.parentElement ?? host ?? view.frameElement;
  // A page of another site around this one cannot be looked at, and may scroll.
  return outer ? isScrolled(outer) : view.parent !== view;
}
