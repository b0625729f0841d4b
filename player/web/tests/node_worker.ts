/** Workers of node with the interface of those of browsers. */

import { Worker } from 'node:worker_threads';

import { DecoderPool, type PoolOptions } from '../src/decoder/pool.js';
import type { Spawn } from '../src/decoder/spawn.js';
import workerText from '../src/decoder/worker.ts?text';

const PRELUDE = `
const { parentPort } = require('node:worker_threads');
globalThis.postMessage = (message, moved) => parentPort.postMessage(message, moved);
parentPort.on('message', (data) => globalThis.onmessage({ data }));
`;

/** Start a worker that runs a script. */
export const spawnScript =
  (script: string): Spawn =>
  (listener) => {
    const worker = new Worker(PRELUDE + script, { eval: true });
    worker.on('message', listener.message);
    worker.on('error', (error) => listener.failed(error.message));
    worker.on('messageerror', () => listener.failed('its answer could not be read'));
    return {
      post: (message, moved) => worker.postMessage(message, moved as ArrayBuffer[]),
      terminate: () => void worker.terminate(),
    };
  };

export const spawnNode = spawnScript(workerText);

/** Run a test with a pool, and end the pool. */
export async function withPool(options: PoolOptions, body: (pool: DecoderPool) => Promise<void>): Promise<void> {
  const pool = new DecoderPool({ size: 2, spawn: spawnNode, ...options });
  try {
    await body(pool);
  } finally {
    pool.close();
  }
}
