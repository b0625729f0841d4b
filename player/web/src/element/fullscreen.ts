/** Filling the screen; on telephones that cannot, the window, which `data-fills-window` styles. */

const WINDOW = 'data-fills-window';

export class Fullscreen {
  readonly #element: HTMLElement;
  readonly #changed: () => void;

  /** @param changed is called when the element fills the screen or the window, or no longer does. */
  constructor(element: HTMLElement, changed: () => void) {
    this.#element = element;
    this.#changed = changed;
    element.addEventListener('fullscreenchange', changed);
    element.shadowRoot?.addEventListener('keydown', (event) => {
      const isFree = (event as KeyboardEvent).key === 'Escape' && !event.defaultPrevented;
      if (isFree && element.hasAttribute(WINDOW)) this.#fillWindow(false);
    });
  }

  get isOn(): boolean {
    return this.#element.matches(':fullscreen') || this.#element.hasAttribute(WINDOW);
  }

  /** @param ask asks the browser for the screen. */
  async request(ask: () => Promise<void>): Promise<void> {
    if (document.fullscreenEnabled) await ask();
    else this.#fillWindow(true);
  }

  toggle(): void {
    if (this.#element.matches(':fullscreen')) document.exitFullscreen();
    else if (this.isOn) this.#fillWindow(false);
    else this.#element.requestFullscreen().catch(() => this.#fillWindow(true));
  }

  #fillWindow(fills: boolean): void {
    this.#element.toggleAttribute(WINDOW, fills);
    this.#changed();
  }
}
