/** The driver of the graphics card is loaded beside the page, which would wait for it. */

import { DecoderPool, type PoolOptions } from '../decoder/pool.js';

let loading: Promise<void> | null = null;

/** Have a worker load the driver, once for all players of a page; resolves, too, where that cannot be done. */
export function loadDriver({ workerUrl }: PoolOptions): Promise<void> {
  loading ??= load({ workerUrl, size: 1 });
  return loading;
}

async function load(options: PoolOptions): Promise<void> {
  const pool = new DecoderPool(options);
  try {
    await pool.run({ kind: 'driver' });
  } catch {
    // The page's own context reports what is wrong.
  }
  pool.close();
}
