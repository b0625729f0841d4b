/** Files of the repository; tests run in player/web. */

import { readFileSync } from 'node:fs';
import { resolve } from 'node:path';

const ROOT = resolve('..', '..');

/** Return the bytes of a file. */
export function read(path: string): Uint8Array<ArrayBuffer> {
  return new Uint8Array(readFileSync(resolve(ROOT, path)));
}

/** Return the content of a JSON file. */
export function parsed(path: string): unknown {
  return JSON.parse(readFileSync(resolve(ROOT, path), 'utf-8'));
}
