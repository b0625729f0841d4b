/** What the headers of an answer say (RFC 9110). They come from a server and may say anything, or be hidden (CORS). */

/** Return the header that identifies this version of a file, and its value: a strong ETag, else the date. */
export function validatorOf({ headers }: Response): [string, string] | null {
  const etag = headers.get('ETag') ?? '';
  if (/^"[\x21\x23-\x7e]{0,200}"$/.test(etag)) return ['ETag', etag];
  const date = headers.get('Last-Modified') ?? '';
  return /^[\x20-\x7e]{1,64}$/.test(date) ? ['Last-Modified', date] : null;
}

/** Return the first and last byte that an answer holds and the size of the file; null for what it does not say. */
export function rangeOf({ headers }: Response): [number | null, number | null, number | null] {
  const said = headers.get('Content-Range')?.trim() ?? '';
  const found = /^bytes[ =]+(?:(\d{1,15})-(\d{1,15})|\*)\/(\d{1,15}|\*)$/i.exec(said);
  if (found === null) return [null, null, null];
  const number = (text: string | undefined) => (text === undefined || text === '*' ? null : Number(text));
  return [number(found[1]), number(found[2]), number(found[3])];
}

/** Return the bytes that an answer holds, if it says so. */
export function lengthOf({ headers }: Response): number | null {
  const said = headers.get('Content-Length') ?? '';
  return /^\d{1,15}$/.test(said) ? Number(said) : null;
}

/** Return the pause in milliseconds that a server asks for, at most 30 s. */
export function retryAfter({ headers }: Response): number {
  const said = headers.get('Retry-After') ?? '';
  return /^\d{1,9}$/.test(said) ? Math.min(1000 * Number(said), 30_000) : 0;
}

/** Return an address without user, password, query and fragment, which may be secret. */
export function nameOf(address: string): string {
  const url = new URL(address, globalThis.location?.href);
  return url.protocol === 'http:' || url.protocol === 'https:' ? `${url.origin}${url.pathname}` : `${url.protocol}...`;
}
