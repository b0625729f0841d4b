/** The attributes of `<kpc-player>` that properties reflect; docs/web.md says what they mean. */

import type { ShownPart } from '../render/picture_job.js';
import { LEVEL_NAMES, type Level } from '../render/quality.js';
import { addressOf } from '../streaming/address.js';
import { DEFAULT_MEMORY } from '../streaming/clip.js';
import { positive, set, setFlag, string, word } from './attributes.js';
import { byteCount } from './values.js';

const Base = (globalThis.HTMLElement ?? class {}) as typeof HTMLElement; // servers that render pages have none

export class ReflectedElement extends Base {
  /** A size that was refused, of which the console has been warned. */
  #warnedOf: string | null = null;

  get src(): string {
    const value = string(this, 'src');
    // The text of what is no address, as for <video>: loading then says that there is no such file.
    return addressOf(value)?.href ?? value;
  }

  set src(value: string) {
    set(this, 'src', value);
  }

  get poster(): string {
    return string(this, 'poster');
  }

  set poster(value: string) {
    set(this, 'poster', value);
  }

  get controls(): boolean {
    return this.hasAttribute('controls');
  }

  set controls(value: boolean) {
    setFlag(this, 'controls', value);
  }

  get autoplay(): boolean {
    return this.hasAttribute('autoplay');
  }

  set autoplay(value: boolean) {
    setFlag(this, 'autoplay', value);
  }

  get loop(): boolean {
    return this.hasAttribute('loop');
  }

  set loop(value: boolean) {
    setFlag(this, 'loop', value);
  }

  get playsInline(): boolean {
    return this.hasAttribute('playsinline');
  }

  set playsInline(value: boolean) {
    setFlag(this, 'playsinline', value);
  }

  get preload(): string {
    return word(this, 'preload', ['auto', 'metadata', 'none']);
  }

  set preload(value: string) {
    set(this, 'preload', value);
  }

  /** Whether hands may move the view: with `controls`, unless `camera-controls` is "none". */
  get cameraControls(): boolean {
    return string(this, 'camera-controls', this.controls ? '' : 'none').toLowerCase() !== 'none';
  }

  set cameraControls(value: boolean | 'none') {
    set(this, 'camera-controls', value && value !== 'none' ? '' : 'none');
  }

  get quality(): Level | 'auto' {
    return word(this, 'quality', ['auto', ...LEVEL_NAMES]);
  }

  set quality(value: string) {
    set(this, 'quality', value);
  }

  /** Frames a second that `quality="auto"` holds; 0 for what suits the device. */
  get targetFps(): number {
    return positive(this, 'target-fps', 0);
  }

  set targetFps(value: number) {
    set(this, 'target-fps', value);
  }

  /** What the attribute `part` says; the property of that name is every element's list of tokens. */
  get shownPart(): ShownPart {
    return word(this, 'part', ['all', 'static', 'dynamic']);
  }

  set shownPart(value: string) {
    set(this, 'part', value);
  }

  get appearance(): string {
    return string(this, 'appearance');
  }

  set appearance(value: string) {
    set(this, 'appearance', value);
  }

  /** Bytes that the clip may take; the attribute may say them in KB, MB or GB. */
  get memory(): number {
    const text = this.getAttribute('memory');
    if (text === null) return DEFAULT_MEMORY;
    const bytes = byteCount(text);
    if (bytes === null && text !== this.#warnedOf) {
      console.warn(`kpc-player: memory="${text}" is not a size; write for example 300MB or 2GB`);
      this.#warnedOf = text;
    }
    return bytes ?? DEFAULT_MEMORY;
  }

  set memory(value: number | string) {
    set(this, 'memory', value);
  }
}
