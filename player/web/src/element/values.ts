/** What a page sets, converted as browsers convert the values of `<video>` (WebIDL). */

/** Return a number; throw a TypeError for what is none, or not finite. */
export function finite(value: unknown, name: string): number {
  const number = Number(value);
  if (!Number.isFinite(number)) throw new TypeError(`${name} must be a finite number`);
  return number;
}

/**
 * Return what the property `camera` is set to as text. Frameworks bind arrays of numbers; null, undefined and an empty
 * text mean what no attribute means.
 */
export function cameraText(value: unknown): string {
  const text = Array.isArray(value) ? value.join(' ') : String(value ?? '');
  return text.trim() === '' ? 'opening' : text;
}
