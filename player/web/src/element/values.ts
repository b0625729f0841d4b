/** What a page sets, converted as browsers convert the values of `<video>` (WebIDL). */

/** Return a number; throw a TypeError for what is none, or not finite. */
export function finite(value: unknown, name: string): number {
  const number = Number(value);
  if (!Number.isFinite(number)) throw new TypeError(`${name} must be a finite number`);
  return number;
}

/** Return a file that the page has, or null for none; throw a TypeError for anything else. */
export function blobOrNull(value: unknown, name: string): Blob | null {
  if (value === null || value === undefined) return null;
  if (!(value instanceof Blob)) throw new TypeError(`${name} must be a Blob, a File or null`);
  return value;
}

/**
 * Return what the property `camera` is set to as text. Frameworks bind arrays of numbers; null, undefined and an empty
 * text mean what no attribute means.
 */
export function cameraText(value: unknown): string {
  const text = Array.isArray(value) ? value.join(' ') : String(value ?? '');
  return text.trim() === '' ? 'opening' : text;
}

/** Return the bytes that a size such as "300000", "300KB" (1 KB = 1,000 bytes), "2MB" or "1.5GB" says; null if none. */
export function byteCount(text: string): number | null {
  const [, number, unit] = /^\s*([+]?(?:\d+\.?\d*|\.\d+)(?:e[+-]?\d+)?)\s*([KMG]?)B?\s*$/i.exec(text) ?? [];
  const bytes = Number(number) * 1000 ** ' KMG'.indexOf(unit?.toUpperCase() || ' ');
  return bytes >= 1 && bytes < 1e12 ? Math.floor(bytes) : null;
}
