/** The order of prefetch: the cases that a test in Python writes are those of the desktop player. */

import assert from 'node:assert/strict';
import { readFileSync } from 'node:fs';
import test from 'node:test';

import { Container } from '../src/container/container.js';
import { Scene } from '../src/container/scene.js';
import { loadCore } from '../src/decoder/module.js';
import { adjacentRuns } from '../src/streaming/opening.js';
import {
  fetchOrder,
  minSegmentBytes,
  type Playhead,
  type Segment,
  segmentsOf,
  segmentsToKeep,
} from '../src/streaming/prefetch.js';
import { scene } from './writing.js';

const scales: [number, number, number, number, number][] = [
  [4, 16, 16, 16, 128],
  [4, 24, 24, 24, 128],
];
const FILE = scene({ scales, frameCount: 100, segmentRows: 32 });
const core = await loadCore();

function segments(bytes: Uint8Array): Segment[] {
  const { container, head } = new Scene(bytes, core);
  return segmentsOf(container.index, head);
}

test('the coarse picture comes first, then finer ones, then what is ahead', () => {
  const found = segments(FILE);
  const order = fetchOrder(found, { time: 0.5, rate: 0, loop: true }).map((position) => found[position]);
  const now = order.filter(({ since, until }) => since < 0.5 && 0.5 < until);
  assert.deepEqual(order.slice(0, now.length), now);
  assert.deepEqual(
    now.map((one) => one.scale),
    now.map((one) => one.scale).sort(),
  );
  const later = order.slice(now.length);
  assert.ok(later[0].since > 0.5 && later[later.length - 1].until < 0.5);
  const playing = fetchOrder(found, { time: 0, rate: 0.4, loop: false }).map((position) => found[position]);
  const finer = playing.findIndex((one) => one.scale === 1);
  assert.deepEqual(
    playing.slice(6, finer).map((one) => one.since > 0 && one.since < 0.4),
    [true, true, true],
  );
});

test('chunks that lie side by side are one request, of at most so many bytes', () => {
  const { index } = new Container(FILE);
  assert.deepEqual(adjacentRuns(index, [3, 4, 5, 7, 6]), [[3, 4, 5], [7], [6]]);
  const most = index[3].storedLength + index[4].storedLength;
  assert.deepEqual(adjacentRuns(index, [3, 4, 5], most), [[3, 4], [5]]);
});

interface Case {
  head: Playhead;
  shown: number;
  available: number;
  order: number[];
  keep: boolean[];
}

const path = process.env.KPC_PREFETCH_CASES;
test('the order is that of the desktop player', { skip: path ? false : 'run by tests/test_node.py' }, () => {
  const { file, least, cases } = JSON.parse(readFileSync(String(path), 'utf-8'));
  const found = segments(new Uint8Array(readFileSync(file)));
  assert.equal(minSegmentBytes(found), least);
  assert.ok(cases.length > 0);
  for (const { head, shown, available, order, keep } of cases as Case[]) {
    assert.deepEqual(fetchOrder(found, head, shown), order);
    assert.deepEqual(segmentsToKeep(found, head, available), keep);
  }
});
