/** What went wrong, in sentences for people who watch. */

import { type ErrorCode, KpcError } from '../container/errors.js';
import { strangeScheme } from '../streaming/address.js';

export type PlayerErrorCode = ErrorCode | 'unknown';

/** The value of the property `error`. */
export interface PlayerError {
  readonly code: PlayerErrorCode;
  /** A sentence for people. */
  readonly message: string;
  /** What exactly, for those who look after the page. */
  readonly detail: string;
}

export const CONTEXT_LOST =
  'The browser has taken the graphics card away. The picture comes back by itself unless the page has many players.';
export const INCOMPLETE = 'This file is incomplete. What is there of it is shown.';

/** Return what the property `error` says of something that was thrown. */
export function playerErrorOf(thrown: unknown, src: string, origin: string): PlayerError {
  const detail = thrown instanceof Error ? thrown.message : String(thrown);
  const code = codeOf(thrown);
  return { code, message: sentenceOf(code, detail, src, origin), detail };
}

function codeOf(thrown: unknown): PlayerErrorCode {
  if (thrown instanceof KpcError) return thrown.code;
  return thrown instanceof RangeError && /memory|allocation/i.test(thrown.message) ? 'budget' : 'unknown';
}

function sentenceOf(code: PlayerErrorCode, detail: string, src: string, origin: string): string {
  switch (code) {
    case 'not-found':
      return strangeScheme(src) === null
        ? 'There is no such file. The address may have changed.'
        : `A page cannot fetch addresses that begin with "${strangeScheme(src)}". Use one that begins with "https:".`;
    case 'blocked':
      if (src.startsWith('file:')) return 'A page cannot read files of a disk. Open the file by kpplay --web instead.';
      return refusalToRead(serverOf(src, origin), `Access-Control-Allow-Origin: ${origin}`);
    case 'network':
      return refusalOf(detail) ?? 'The file cannot be fetched. Check the connection, then try again.';
    case 'replaced':
      return 'The file was replaced while it was read. Try again to see the new one.';
    case 'empty':
      return 'The file is empty. Its owner should upload it again.';
    case 'foreign':
      return 'This is not a .kpc file.';
    case 'draft':
      return 'This file has a draft version of the format, which is no longer read. Encode the scene again.';
    case 'newer':
      return 'This file is newer than this player. Reload the page, or ask its owner to update the player.';
    case 'cut-off':
      return 'The file is incomplete. Its owner should upload it again.';
    case 'damaged':
    case 'invalid':
      return 'The file is damaged. Its owner should upload it again.';
    case 'budget':
      return 'This scene needs more memory than the player may use here. Close other pages, or use another device.';
    case 'worker':
      return `The decoder cannot run in this page: ${detail}.`;
    case 'no-webgl':
      return 'This browser has no WebGL2 left to draw with. Update it, allow the graphics card, or show fewer players.';
    case 'graphics':
      return `This browser cannot draw the scene: ${detail}.`;
    default:
      return `The scene cannot be shown: ${detail}.`;
  }
}

/** Return a sentence for a server that answers with an error; null where there is no answer. */
function refusalOf(detail: string): string | null {
  const status = /the server answers (\d+)/.exec(detail)?.[1];
  if (status === undefined) return null;
  if (['401', '402', '403', '407'].includes(status)) {
    return `The server does not permit everyone to read the file (${status}).`;
  }
  return `The server does not send the file; it answers with the error ${status}. Try again later.`;
}

/** Return a sentence for a server whose answers lack a header, without which the page may not read them. */
function refusalToRead(server: string, header: string): string {
  return `${server} does not let this page read the file. Its answers need the header ${header}`;
}

/** Return what refuses a page of an origin to read from an address. */
function serverOf(src: string, origin: string): string {
  try {
    const url = new URL(src);
    return url.origin === origin ? 'The address leads to another server, which' : `The server ${url.host}`;
  } catch {
    return 'The server of the file';
  }
}
