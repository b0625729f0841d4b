/** Files whose beginning is requested once. */

import assert from 'node:assert/strict';
import test from 'node:test';

import { KpcError } from '../src/container/errors.js';
import { BegunSource } from '../src/streaming/begun.js';
import { BytesSource, type ReadOptions } from '../src/streaming/source.js';

const FILE = Uint8Array.from({ length: 100 }, (_, k) => k);

/** A source whose reads wait until they are let go on. */
class SlowSource extends BytesSource {
  readonly asked: string[] = [];
  readonly #waiting: ((error?: Error) => void)[] = [];

  constructor() {
    super(FILE);
  }

  override read(start: number, end: number, { arrived, signal }: ReadOptions = {}): Promise<Uint8Array> {
    this.asked.push(`${start}-${end}`);
    return new Promise((resolve, reject) => {
      signal?.addEventListener('abort', () => reject(new KpcError('ended', 'aborted')));
      arrived?.(FILE.subarray(start, Math.min(end, start + 10)));
      this.#waiting.push((error) => {
        if (error) return reject(error);
        arrived?.(FILE.subarray(start, end));
        resolve(FILE.subarray(start, end));
      });
    });
  }

  /** Let a read go on, by its number. */
  answer(number: number, error?: Error): void {
    this.#waiting[number](error);
  }
}

test('what has come of the beginning is read without another request', async () => {
  const slow = new SlowSource();
  const begun = new BegunSource(slow, 40);
  assert.deepEqual(await begun.read(2, 9), FILE.subarray(2, 9));
  const lengths: number[] = [];
  const later = begun.read(5, 35, { arrived: (bytes) => lengths.push(bytes.length) });
  await new Promise(setImmediate);
  assert.deepEqual(lengths, [5]);
  slow.answer(0);
  assert.deepEqual(await later, FILE.subarray(5, 35));
  assert.deepEqual([lengths, slow.asked], [[5, 30], ['0-40']]);
});

test('what lies behind the beginning is requested at once, and handed on in order', async () => {
  const slow = new SlowSource();
  const begun = new BegunSource(slow, 40);
  const seen: Uint8Array[] = [];
  const read = begun.read(20, 70, { arrived: (bytes) => seen.push(bytes.slice()) });
  assert.deepEqual(slow.asked, ['0-40', '40-70']);
  slow.answer(1);
  await new Promise(setImmediate);
  assert.deepEqual(seen, []);
  slow.answer(0);
  assert.deepEqual(await read, FILE.subarray(20, 70));
  assert.deepEqual(seen.at(-1), FILE.subarray(20, 70));
  const behind = begun.read(50, 60);
  slow.answer(2);
  assert.deepEqual(await behind, FILE.subarray(50, 60));
});

test('a file may end within the beginning', async () => {
  const begun = new BegunSource(new BytesSource(FILE), 4000);
  assert.deepEqual(await begun.read(90, 120), FILE.subarray(90));
  assert.deepEqual(await begun.read(0, 100), FILE);
});

test('a read ends when its caller wants, and all of them with an error or the source', async () => {
  const hasCode = (code: string) => (error: unknown) => error instanceof KpcError && error.code === code;
  const slow = new SlowSource();
  const begun = new BegunSource(slow, 40);
  const control = new AbortController();
  const one = begun.read(0, 30, { signal: control.signal });
  const other = begun.read(0, 60);
  control.abort();
  await assert.rejects(one, hasCode('aborted'));
  slow.answer(0, new KpcError('gone', 'network'));
  await assert.rejects(other, hasCode('network'));
  const closed = new BegunSource(new SlowSource(), 40);
  const open = closed.read(0, 30);
  closed.close();
  await assert.rejects(open, hasCode('aborted'));
});

test('a chunk that came damaged is requested again', async () => {
  const slow = new SlowSource();
  const begun = new BegunSource(slow, 40);
  const again = begun.read(5, 9, { fresh: true });
  slow.answer(1);
  assert.deepEqual([await again, slow.asked], [FILE.subarray(5, 9), ['0-40', '5-9']]);
});
