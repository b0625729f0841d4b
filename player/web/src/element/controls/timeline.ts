/** The timeline: a range to drag, over what is buffered and what was played. */

import { make } from './dom.js';

export interface TimelineState {
  time: number;
  duration: number;
  buffered: readonly (readonly [number, number])[];
}

export interface TimelineActions {
  seek(seconds: number): void;
  /** Dragging begins or ends; the clip stands still meanwhile. */
  hold(isHeld: boolean): void;
}

export class Timeline {
  readonly element: HTMLElement;
  readonly #range: HTMLInputElement;
  readonly #track: HTMLElement;
  #shown = '';

  constructor(actions: TimelineActions) {
    this.#range = make('input', {
      type: 'range',
      min: 0,
      step: 'any',
      value: 0,
      'aria-label': 'Time',
      oninput: () => actions.seek(this.#range.valueAsNumber),
      onpointerdown: () => actions.hold(true),
      onpointerup: () => actions.hold(false),
      onpointercancel: () => actions.hold(false),
    });
    this.#track = make('div', { class: 'track' });
    this.element = make('div', { class: 'timeline', part: 'timeline' }, this.#track, this.#range);
  }

  update({ time, duration, buffered }: TimelineState): void {
    const shown = [time, duration, ...buffered.flat()].map((x) => x.toFixed(3)).join();
    if (shown === this.#shown) return;
    this.#shown = shown;
    const percent = (seconds: number) => `${(100 * Math.min(seconds / (duration || 1), 1)).toFixed(2)}%`;
    this.element.hidden = duration === 0;
    this.#range.max = String(duration || 1);
    this.#range.valueAsNumber = time;
    this.#range.ariaValueText = `${clockText(time)} of ${clockText(duration)}`;
    const stops = buffered.map(([from, to]) => {
      const [a, b] = [percent(from), percent(to)];
      return `transparent ${a}, var(--buffered) ${a} ${b}, transparent ${b}`;
    });
    this.#track.style.setProperty('--played', percent(time));
    const gradient = stops.length > 0 ? `linear-gradient(to right, ${stops.join(', ')})` : 'none';
    this.#track.style.setProperty('--arrived', gradient);
  }
}

/** Return seconds as minutes and seconds; of short clips with tenths. */
export function clockText(seconds: number, withTenths = false): string {
  const tenths = Math.floor(seconds * 10 + 1e-6);
  const [minutes, rest] = [Math.floor(tenths / 600), tenths % 600];
  const text = `${minutes}:${String(Math.floor(rest / 10)).padStart(2, '0')}`;
  return withTenths ? `${text}.${rest % 10}` : text;
}
