/** The button that switches the sound off or on, and the volume. */

import { IconButton, make } from './dom.js';

export interface SoundState {
  hasSound: boolean;
  isAudible: boolean;
  volume: number;
}

export class SoundControls {
  readonly elements: readonly HTMLElement[];
  readonly #button: IconButton;
  readonly #volume: HTMLInputElement;
  #shown = Number.NaN;

  constructor(toggle: () => void, setVolume: (volume: number) => void) {
    this.#button = new IconButton('silent', 'Sound on', toggle, { hidden: true });
    this.#volume = make('input', {
      type: 'range',
      class: 'volume',
      min: 0,
      max: 1,
      step: 0.05,
      'aria-label': 'Volume',
      hidden: true,
      oninput: () => setVolume(this.#volume.valueAsNumber),
      // Arrows change the volume, not the time.
      onkeydown: (event: KeyboardEvent) => event.key.startsWith('Arrow') && event.stopPropagation(),
    });
    this.elements = [this.#button.element, this.#volume];
  }

  update({ hasSound, isAudible, volume }: SoundState): void {
    for (const element of this.elements) element.hidden = !hasSound;
    this.#button.show(isAudible ? 'loud' : 'silent', isAudible ? 'Sound off' : 'Sound on');
    const shown = isAudible ? volume : 0;
    if (shown === this.#shown) return;
    this.#shown = shown;
    this.#volume.valueAsNumber = shown;
    this.#volume.ariaValueText = `${Math.round(100 * shown)} %`;
    this.#volume.style.setProperty('--filled', String(shown));
  }
}
