/** What a page sets, converted as browsers convert the values of `<video>` (WebIDL). */

/** Return a number; throw a TypeError for what is none, or not finite. */
export function finite(value: unknown, name: string): number {
  const number = Number(value);
  if (!Number.isFinite(number)) throw new TypeError(`${name} must be a finite number`);
  return number;
}
