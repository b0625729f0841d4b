/** Attributes that properties reflect, as HTML does it. */

export const string = (element: HTMLElement, name: string, missing = ''): string =>
  element.getAttribute(name) ?? missing;

/** Values of attributes that have been warned of, by elements. */
const warned = new WeakMap<HTMLElement, Set<string>>();

/** Return the value of an attribute if it is one of some words, else the first of them, with a warning. */
export function word<T extends string>(element: HTMLElement, name: string, words: readonly T[]): T {
  const value = element.getAttribute(name)?.toLowerCase();
  const found = words.find((known) => known === value);
  if (found === undefined && value) warnOnce(element, `${name}="${value}" is not known; use ${words.join(', ')}`);
  return found ?? words[0];
}

function warnOnce(element: HTMLElement, message: string): void {
  const known = warned.get(element) ?? new Set();
  warned.set(element, known);
  if (!known.has(message)) console.warn(`kpc-player: ${message}`);
  known.add(message);
}

/** Return a positive number; what is missing or no such number counts as `missing`. */
export function positive(element: HTMLElement, name: string, missing: number): number {
  const value = Number.parseFloat(element.getAttribute(name) ?? '');
  return value > 0 && Number.isFinite(value) ? value : missing;
}

/** Set an attribute, or take it away: null and undefined, by which frameworks say that there is no value. */
export function set(element: HTMLElement, name: string, value: string | number | null | undefined): void {
  if (value === null || value === undefined) element.removeAttribute(name);
  else element.setAttribute(name, String(value));
}

/** Set an attribute that is there or not; any value counts as true or false, as for HTML's own elements. */
export function setFlag(element: HTMLElement, name: string, value: unknown): void {
  element.toggleAttribute(name, Boolean(value));
}

/**
 * What a page set before the element was defined is set again, now that it has setters. One that is refused must not
 * keep the scene from being loaded.
 */
export function upgrade(element: HTMLElement): void {
  const values = element as unknown as Record<string, unknown>;
  for (const name of Object.getOwnPropertyNames(element)) {
    if (!(name in Object.getPrototypeOf(element))) continue;
    const value = values[name];
    delete values[name];
    try {
      values[name] = value;
    } catch (error) {
      console.error(`kpc-player: ${(error as Error).message}`);
    }
  }
}
