/** How loud a `<kpc-player>` is, by the properties of HTMLMediaElement. */

import { ReflectedElement } from './reflected_element.js';
import { finite } from './values.js';

export abstract class AudibleElement extends ReflectedElement {
  #volume = 1;
  #muted: boolean | null = null;

  get volume(): number {
    return this.#volume;
  }

  set volume(value: number) {
    const volume = finite(value, 'volume');
    if (volume < 0 || volume > 1) throw new DOMException('volume must be from 0 to 1', 'IndexSizeError');
    if (volume === this.#volume) return;
    this.#volume = volume;
    this.loudnessChanged();
  }

  /** Whether the sound is off; as the attribute says until it is set. */
  get muted(): boolean {
    return this.#muted ?? this.hasAttribute('muted');
  }

  set muted(value: boolean) {
    const isMuted = Boolean(value);
    if (isMuted === this.muted) return;
    this.#muted = isMuted;
    this.loudnessChanged();
  }

  /** The volume, 0 while the sound is off. */
  protected get loudness(): number {
    return this.muted ? 0 : this.#volume;
  }

  /** Called when `volume` or `muted` has changed. */
  protected abstract loudnessChanged(): void;
}
