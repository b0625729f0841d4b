/**
 * The conformance vectors in a page: a script that a test in Python lets Chromium run
 * (tests/player/test_web_vectors.py).
 */

import { Groups } from '../src/container/groups.js';
import { loadCore } from '../src/decoder/module.js';
import { described, type Json } from './described.js';

const loading = loadCore();

/** Return what each group of a file holds, null for one that is cut off; or the error that the file is refused with. */
async function describe(name: string, allowPartial: boolean): Promise<Json> {
  try {
    const bytes = new Uint8Array(await (await fetch(name)).arrayBuffer());
    const groups = new Groups(bytes, await loading, { allowPartial });
    const found: Json[] = [];
    for (const number of groups.timeline.spans.keys()) {
      found.push(groups.available(number) ? await described(groups.open(number)) : null);
    }
    return found;
  } catch (error) {
    const { name: kind, message } = error as Error;
    return { error: kind, message };
  }
}

(globalThis as Json).page = { describe };
