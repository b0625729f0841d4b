/** How loud a `<kpc-player>` is, by the properties of HTMLMediaElement. */

import { ReflectedElement } from './reflected_element.js';

export abstract class AudibleElement extends ReflectedElement {
  #volume = 1;
  #muted: boolean | null = null;

  get volume(): number {
    return this.#volume;
  }

  set volume(value: number) {
    if (!(value >= 0 && value <= 1)) throw new DOMException('volume must be from 0 to 1', 'IndexSizeError');
    if (value === this.#volume) return;
    this.#volume = value;
    this.loudnessChanged();
  }

  /** Whether the sound is off; as the attribute says until it is set. */
  get muted(): boolean {
    return this.#muted ?? this.hasAttribute('muted');
  }

  set muted(value: boolean) {
    if (value === this.muted) return;
    this.#muted = value;
    this.loudnessChanged();
  }

  /** The volume, 0 while the sound is off. */
  protected get loudness(): number {
    return this.muted ? 0 : this.#volume;
  }

  /** Called when `volume` or `muted` has changed. */
  protected abstract loudnessChanged(): void;
}
