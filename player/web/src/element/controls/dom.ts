/** Small helpers to build the player's own elements; no text is ever parsed as markup. */

type Properties = Record<string, string | number | boolean | ((event: never) => void)>;

/**
 * Make an element. Properties that begin with `on` are listeners, all others are attributes; `false` leaves one out.
 */
export function make<K extends keyof HTMLElementTagNameMap>(
  tag: K,
  properties: Properties = {},
  ...children: (Node | string)[]
): HTMLElementTagNameMap[K] {
  const element = document.createElement(tag);
  for (const [name, value] of Object.entries(properties)) {
    if (typeof value === 'function') element.addEventListener(name.slice(2), value as EventListener);
    else if (value !== false) element.setAttribute(name, value === true ? '' : String(value));
  }
  element.append(...children);
  return element;
}

/** Outlines of pictograms in a square of 24 units; strokes, but for those that are filled. */
const ICONS = {
  play: 'M7 4.5v15l12.5-7.5z',
  pause: 'M6.5 4.5h4v15h-4zM13.5 4.5h4v15h-4z',
  replay: 'M5 12a7 7 0 1 0 2.3-5.2M7.5 2.5v4.6h4.6',
  loud: 'M4 9.5v5h3.5l5 4v-13l-5 4zM16 9a4.2 4.2 0 0 1 0 6M18.6 6.2a8.2 8.2 0 0 1 0 11.6',
  silent: 'M4 9.5v5h3.5l5 4v-13l-5 4zM16.5 9.5l5 5M21.5 9.5l-5 5',
  view: 'M3.5 8h3.2l1.6-2.5h7.4L17.3 8h3.2v11h-17zM12 16.6a3.4 3.4 0 1 0 0-6.8 3.4 3.4 0 0 0 0 6.8z',
  link: 'M10 14.2a4 4 0 0 0 5.7 0l3.4-3.4a4 4 0 0 0-5.7-5.7l-1.2 1.2M14 9.8a4 4 0 0 0-5.7 0l-3.4 3.4a4 4 0 0 0 5.7 5.7l1.2-1.2',
  settings:
    'M4 7h9M18 7h2M4 17h2M11 17h9M15.5 9.5a2.5 2.5 0 1 0 0-5 2.5 2.5 0 0 0 0 5zM8.5 19.5a2.5 2.5 0 1 0 0-5 2.5 2.5 0 0 0 0 5z',
  fill: 'M4 9V4h5M20 9V4h-5M4 15v5h5M20 15v5h-5',
  headset: 'M3 8h18v9h-5.5L13.5 14.5h-3L8.5 17H3zM7 8V6h10v2',
  leave: 'M9 4v5H4M15 4v5h5M9 20v-5H4M15 20v-5h5',
} as const;
export type IconName = keyof typeof ICONS;
const FILLED: readonly IconName[] = ['play', 'pause'];
const SVG = 'http://www.w3.org/2000/svg';

export function icon(name: IconName): SVGSVGElement {
  const svg = document.createElementNS(SVG, 'svg');
  for (const [key, value] of Object.entries({ viewBox: '0 0 24 24', 'aria-hidden': 'true', class: 'icon' })) {
    svg.setAttribute(key, value);
  }
  const path = document.createElementNS(SVG, 'path');
  path.setAttribute('d', ICONS[name]);
  if (FILLED.includes(name)) path.setAttribute('class', 'filled');
  svg.append(path);
  return svg;
}

/** A round button with a pictogram, and words for those who cannot see it. */
export class IconButton {
  readonly element: HTMLButtonElement;
  #shown = '';

  constructor(name: IconName, label: string, pressed: () => void, properties: Properties = {}) {
    this.element = make('button', { type: 'button', class: 'button', onclick: pressed, ...properties });
    this.show(name, label);
  }

  show(name: IconName, label: string): void {
    if (this.#shown === name + label) return;
    this.#shown = name + label;
    this.element.replaceChildren(icon(name));
    this.element.ariaLabel = label;
    this.element.title = label;
  }
}

/** A button that opens a panel above the bar; Esc, another panel or a press elsewhere closes it. */
export class Popup {
  readonly button: IconButton;
  readonly panel: HTMLElement;

  /** @param opened fills the panel. */
  constructor(name: IconName, label: string, opened: (panel: HTMLElement) => void) {
    this.panel = make('div', { class: 'panel', role: 'dialog', 'aria-label': label, hidden: true });
    this.button = new IconButton(name, label, () => (this.isOpen ? this.close() : this.#open(opened)), {
      'aria-haspopup': 'dialog',
      'aria-expanded': 'false',
    });
  }

  get isOpen(): boolean {
    return !this.panel.hidden;
  }

  close(): void {
    if (!this.isOpen) return;
    const hadFocus = this.panel.matches(':focus-within');
    this.panel.hidden = true;
    this.button.element.ariaExpanded = 'false';
    if (hadFocus) this.button.element.focus();
  }

  #open(opened: (panel: HTMLElement) => void): void {
    opened(this.panel);
    this.panel.hidden = false;
    this.button.element.ariaExpanded = 'true';
    this.panel.querySelector<HTMLElement>('button, select, input')?.focus();
  }
}
