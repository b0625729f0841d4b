/** Addresses of files. */

/** Return the address that a text names on this page; null if it names none: an empty one would be the page itself. */
export function addressOf(text: string | URL): URL | null {
  if (text === '') return null;
  try {
    return new URL(text, globalThis.document?.baseURI);
  } catch {
    return null;
  }
}
