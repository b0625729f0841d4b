/**
 * Plays files that it gets by standard input, each behind its length in 4 bytes, and answers each with a line of JSON:
 * what became of it, and the seconds of computing and the memory that it took. The reader behind
 * `python -m kpc.tools.vectors.fuzz --reader web`; anything that is no error of the file is a finding.
 */

import { readFileSync } from 'node:fs';
import { Clip, DecoderPool, KpcError } from '../dist/kpc-player.js';

const MEMORY = Number(process.argv[2]);
/** Time that a file may pass without a closer look. */
const SLOW_S = 0.5;
/** Errors that no file should cause. */
const STRANGE = ['worker', 'aborted', 'network', 'not-found', 'blocked', 'replaced'];

const script = readFileSync(new URL('../dist/kpc-worker.js', import.meta.url), 'utf-8');

/** Run the worker's script in this thread: what it does with a file is the same, and its time is counted. */
function spawn(listener) {
  const scope = {
    postMessage: (message, moved) => {
      const copy = structuredClone(message, { transfer: moved });
      setImmediate(() => listener.message(copy));
    },
  };
  new Function('globalThis', script)(scope);
  const post = (message, moved) => {
    const data = 'module' in message ? message : structuredClone(message, { transfer: moved });
    setImmediate(() => scope.onmessage({ data }));
  };
  return { post, terminate: () => {} };
}

const pool = new DecoderPool({ size: 1, spawn, memory: MEMORY / 4 });

/** Play a file at some times, and take all that comes. */
async function play(bytes) {
  const clip = await Clip.open(bytes, { memory: MEMORY, pool });
  try {
    for (const share of [0, 0.4, 1]) {
      const time = Math.min(share * clip.duration, Number.MAX_VALUE);
      for (let isDone = false; !isDone; ) {
        clip.setPlayhead({ time, rate: 1, loop: false });
        for (const scene of clip.scenes) scene.take(1 << 20);
        if (clip.error) throw clip.error;
        isDone = clip.isSettled && clip.parts(time).length > 0;
        if (clip.memoryBytes > MEMORY) throw new Error(`holds ${clip.memoryBytes} bytes`);
        if (!isDone) await new Promise((resolve) => clip.addEventListener('arrived', resolve, { once: true }));
      }
      const [{ scene, time: localTime }] = clip.parts(time);
      for (const [number, scale] of scene.head.scales.entries()) {
        for (const name of Object.keys(scale).filter((one) => one.endsWith('t'))) {
          const row = scene.row(number, name, localTime);
          if (!row.every(Number.isFinite)) throw new Error('a plane holds what is no number');
        }
      }
    }
  } finally {
    clip.close();
  }
}

async function examine(bytes) {
  const start = performance.now();
  let said = 'read';
  try {
    await play(bytes);
  } catch (error) {
    const isRefusal = error instanceof KpcError && !STRANGE.includes(error.code);
    if (!isRefusal) return { finding: error.stack ?? String(error) };
    said = error.name;
  }
  const passed = (performance.now() - start) / 1000;
  return { said, seconds: passed < SLOW_S ? passed : await computed(bytes), rss: process.memoryUsage.rss() };
}

/** Play a file again; return the seconds of computing that it takes. A busy machine is no finding. */
async function computed(bytes) {
  const before = process.cpuUsage(); // slow on some systems
  await play(bytes).catch(() => {});
  const { user, system } = process.cpuUsage(before);
  return (user + system) / 1e6;
}

let received = Buffer.alloc(0);
for await (const piece of process.stdin) {
  received = Buffer.concat([received, piece]);
  while (received.length >= 4 && received.length >= 4 + received.readUInt32LE()) {
    const end = 4 + received.readUInt32LE();
    const bytes = new Uint8Array(received.subarray(4, end)).buffer;
    received = received.subarray(end);
    process.stdout.write(`${JSON.stringify(await examine(bytes))}\n`);
  }
}
pool.close();
