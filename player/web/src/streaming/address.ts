/** Addresses of files. */

/** Schemes that every browser fetches; a page of another one, as in an app, fetches that, too. */
const FETCHED = ['http:', 'https:', 'blob:', 'data:', 'file:'];

/** Return the address that a text names on this page; null if it names none: an empty one would be the page itself. */
export function addressOf(text: string | URL): URL | null {
  if (text === '') return null;
  try {
    return new URL(text, globalThis.document?.baseURI);
  } catch {
    return null;
  }
}

/** Return how an address begins, if neither browsers nor this page can fetch such ones, as "ftp:"; else null. */
export function strangeScheme(address: string): string | null {
  const { location } = globalThis as { location?: Location };
  const scheme = addressOf(address)?.protocol ?? null;
  return scheme === null || FETCHED.includes(scheme) || scheme === location?.protocol ? null : scheme;
}
