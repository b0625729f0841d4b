/** The pool of workers: what it decodes, and what it does about workers that hang or break down. */

import assert from 'node:assert/strict';
import { getEventListeners } from 'node:events';
import test from 'node:test';

import { Container } from '../src/container/container.js';
import { type ErrorCode, KpcError } from '../src/container/errors.js';
import { Scene } from '../src/container/scene.js';
import type { Core } from '../src/decoder/core.js';
import { loadCore } from '../src/decoder/module.js';
import type { DecoderPool } from '../src/decoder/pool.js';
import { dequantised, needsOccupancy } from '../src/decoder/segment.js';
import type { Spawn } from '../src/decoder/spawn.js';
import type { SegmentTask } from '../src/decoder/tasks.js';
import { layerTexels, toHalf } from '../src/decoder/texels.js';
import { read } from './files.js';
import { spawnNode, spawnScript, withPool } from './node_worker.js';

const bytes = read('samples/default.kpc');
const core: Core = await loadCore();
const scene = new Scene(bytes, core);
const PLANES = [...scene.container.index.keys()].filter((number) => scene.container.index[number].kind === 'PLNE');

/** Return the task of a chunk of the sample. */
function segmentTask(number: number, asTexels = false): SegmentTask {
  const entry = scene.container.index[number];
  const body = bytes.slice(entry.offset, entry.offset + entry.storedLength);
  const { name, plane } = scene.planeOf(entry);
  const projection = needsOccupancy(entry.codec, body) ? scene.projection(name) : null;
  return { kind: 'segment', number, entry, body, plane, projection, asTexels };
}

const hasCode =
  (code: ErrorCode, words = '') =>
  (error: unknown) =>
    error instanceof KpcError && error.code === code && error.message.includes(words);

/** Decode something, which shows that the pool is in order. */
async function works(pool: DecoderPool): Promise<void> {
  assert.deepEqual(await pool.run(segmentTask(PLANES[0])), scene.segment(PLANES[0]).symbols);
}

test('decodes all segments as one core does', async () => {
  await withPool({}, async (pool) => {
    const found = await Promise.all(PLANES.map((number) => pool.run(segmentTask(number))));
    for (const [k, number] of PLANES.entries()) assert.deepEqual(found[k], scene.segment(number).symbols);
  });
});

test('coarse scales are decoded before finer ones that came sooner', async () => {
  await withPool({ size: 1 }, async (pool) => {
    const done: number[] = [];
    const ranks = [1, 2, 1, 0, 2, 0];
    const runs = ranks.map(async (rank, k) => {
      await pool.run(segmentTask(PLANES[0]), { rank });
      done.push(k);
    });
    await Promise.all(runs);
    assert.deepEqual(done, [3, 5, 0, 2, 1, 4]);
  });
});

test('reads all of a scene but its planes', async () => {
  const { index, header } = new Container(bytes);
  const bodies = new Map<number, Uint8Array>();
  for (const [number, entry] of index.entries()) {
    if (entry.kind !== 'PLNE') bodies.set(number, bytes.slice(entry.offset, entry.offset + entry.storedLength));
  }
  const start = bytes.slice(0, 48 + header.indexLength);
  await withPool({}, async (pool) => {
    const found = await pool.run({ kind: 'scene', start, bodies, memoryBudget: 2 ** 30 });
    const { head, mapping, motion, occupancy, decoder, cameras, appearances, metadata } = scene;
    assert.deepEqual(found, { head, mapping, motion, occupancy, decoder, cameras, appearances, metadata });
    bodies.delete(index.findIndex((entry) => entry.kind === 'OCCU'));
    await assert.rejects(pool.run({ kind: 'scene', start, bodies, memoryBudget: 2 ** 30 }), hasCode('cut-off'));
    await assert.rejects(pool.run({ kind: 'scene', start, bodies, memoryBudget: 1000 }), hasCode('budget'));
  });
});

test('texels are the dequantised values, layer beside layer', async () => {
  const number = PLANES.find((n) => scene.planeOf(scene.container.index[n]).name === 'xz') as number;
  const { plane } = scene.planeOf(scene.container.index[number]);
  const { symbols } = scene.segment(number);
  const values = core.dequantise(symbols, plane.step, plane.offset);
  const { columns, channels } = plane;
  await withPool({}, async (pool) => {
    const texels = await pool.run(segmentTask(number, true));
    const layers = Math.ceil(channels / 4);
    assert.equal(texels.length, (values.length / channels) * layers * 4);
    for (const [k, value] of values.entries()) {
      const [row, column, channel] = [
        Math.floor(k / channels / columns),
        Math.floor(k / channels) % columns,
        k % channels,
      ];
      const at = ((row * layers + Math.floor(channel / 4)) * columns + column) * 4 + (channel % 4);
      assert.equal(texels[at], toHalf(value));
      assert.equal(value, dequantised(symbols[k], plane.step[channel], plane.offset[channel]));
    }
  });
  const odd = { rows: 1, columns: 2, channels: 5, step: new Float32Array(5).fill(1), offset: new Float32Array(5) };
  const texels = layerTexels(Int8Array.of(1, 2, 3, 4, 5, 6, 7, 8, 9, 10), odd);
  assert.deepEqual([...texels], [1, 2, 3, 4, 6, 7, 8, 9, 5, 0, 0, 0, 10, 0, 0, 0].map(toHalf));
});

test('halves are rounded to nearest, ties to even', () => {
  for (let bits = 0; bits < 0x7c00; bits++) {
    const value = bits < 1024 ? bits * 2 ** -24 : (1024 + (bits & 1023)) * 2 ** ((bits >> 10) - 25);
    assert.equal(toHalf(value), bits);
    assert.equal(toHalf(-value), bits | 0x8000);
    if (bits === 0) continue;
    const ulp = bits < 1024 ? 2 ** -24 : 2 ** ((bits >> 10) - 25);
    assert.equal(toHalf(value + ulp / 2), Math.min(bits + (bits & 1), 0x7bff));
    assert.equal(toHalf(value + ulp / 4), bits);
  }
});

test('errors of the data arrive as such, and the worker goes on', async () => {
  await withPool({ size: 1 }, async (pool) => {
    const task = segmentTask(PLANES[0]);
    task.body[task.body.length - 1] ^= 1;
    await assert.rejects(pool.run(task), hasCode('damaged', `chunk ${PLANES[0]} (PLNE)`));
    await works(pool);
  });
});

test('what takes more than the budget is refused, and what fits runs alone', async () => {
  const numbers = 1000;
  await withPool({ memory: 5 * numbers }, async (pool) => {
    await assert.rejects(pool.run(segmentTask(PLANES[0]), { numbers: numbers + 1 }), hasCode('budget'));
  });
  for (const [share, expected] of [
    [0.9, 1],
    [0.3, 3],
  ] as const) {
    const running: (() => void)[] = [];
    const spawn: Spawn = (listener) => ({
      post: (message) => {
        const { id } = message as { id?: number };
        if (id === undefined) queueMicrotask(() => listener.message({ ready: true }));
        else running.push(() => listener.message({ id, result: null }));
      },
      terminate: () => {},
    });
    await withPool({ size: 4, spawn, memory: 5 * numbers }, async (pool) => {
      const jobs = [1, 2, 3, 4].map(() => pool.run(segmentTask(PLANES[0]), { numbers: share * numbers }));
      for (let left = 4; left > 0; left--) {
        while (running.length < Math.min(left, expected)) await new Promise(setImmediate);
        await new Promise(setImmediate);
        assert.equal(running.length, Math.min(left, expected));
        running.shift()?.();
      }
      await Promise.all(jobs);
    });
  }
});

test('a worker that hangs is ended, its chunk reported, and another takes its place', async () => {
  const hanging = spawnScript(
    `onmessage = ({ data }) => { if (data.module) postMessage({ ready: true }); else for (;;); }`,
  );
  let started = 0;
  let ended = 0;
  const spawn: typeof hanging = (listener) => {
    const port = (started++ === 0 ? hanging : spawnNode)(listener);
    return {
      ...port,
      terminate: () => {
        ended++;
        port.terminate();
      },
    };
  };
  await withPool({ size: 1, spawn, deadlineMs: 300 }, async (pool) => {
    await assert.rejects(
      pool.run(segmentTask(PLANES[1])),
      hasCode('invalid', `chunk ${PLANES[1]} takes longer than 0.3 s`),
    );
    assert.equal(ended, 1);
  });
  await withPool({ size: 1, spawn }, works);
});

test('the time that a worker takes to start is not that of its first task', async () => {
  const spawn: Spawn = (listener) => ({
    post: (message) => {
      const { id } = message as { id?: number };
      if (id === undefined) setTimeout(() => listener.message({ ready: true }), 150);
      else listener.message({ id, result: null });
    },
    terminate: () => {},
  });
  await withPool({ size: 1, spawn, deadlineMs: 20 }, async (pool) => {
    assert.equal(await pool.run(segmentTask(PLANES[0])), null);
  });
});

test('a worker that does not start, or breaks down, is reported', async () => {
  await withPool({ size: 1, spawn: spawnScript('throw new Error("no such thing")') }, async (pool) => {
    await assert.rejects(pool.run(segmentTask(PLANES[0])), hasCode('worker', 'no such thing'));
  });
  const breaking = spawnScript(
    `onmessage = ({ data }) => { if (data.module) postMessage({ ready: true }); else throw new Error('broken'); }`,
  );
  await withPool({ size: 1, spawn: breaking }, async (pool) => {
    await assert.rejects(pool.run(segmentTask(PLANES[0])), hasCode('worker', 'broken'));
  });
});

test('a signal has one listener, however many tasks wait, and none once they are done', async () => {
  const { signal } = new AbortController();
  await withPool({ size: 1 }, async (pool) => {
    const runs = PLANES.slice(0, 12).map((number) => pool.run(segmentTask(number), { signal }));
    assert.equal(getEventListeners(signal, 'abort').length, 1);
    await Promise.all(runs);
    assert.equal(getEventListeners(signal, 'abort').length, 0);
  });
});

test('what is not wanted any more is not waited for', async () => {
  await withPool({ size: 1 }, async (pool) => {
    const control = new AbortController();
    const [first, second] = [0, 1].map((k) => pool.run(segmentTask(PLANES[k]), { signal: control.signal }));
    control.abort();
    await assert.rejects(first, hasCode('aborted'));
    await assert.rejects(second, hasCode('aborted'));
    await works(pool);
    const last = pool.run(segmentTask(PLANES[0]));
    pool.close();
    await assert.rejects(last, hasCode('aborted'));
    await assert.rejects(pool.run(segmentTask(PLANES[0])), hasCode('aborted'));
  });
});
