/** Constants that other languages have, too: those of the page of the format. */

import assert from 'node:assert/strict';
import test from 'node:test';

import { CODEC, EXPANSION_LIMIT } from '../src/container/chunk.js';
import { CHUNK_LIMIT } from '../src/container/container.js';
import { LIMIT } from '../src/container/scene_chunks.js';
import { read } from './files.js';

const PAGE = new TextDecoder().decode(read('spec/kpc-format.md'));

test('limits are those of section 11.1', () => {
  const limits = new Map([...PAGE.matchAll(/^\| (\w+)_LIMIT \| (\d+) \|/gm)].map((row) => [row[1], Number(row[2])]));
  assert.ok(limits.size > 15);
  for (const [name, value] of Object.entries({ ...LIMIT, EXPANSION: EXPANSION_LIMIT, CHUNK: CHUNK_LIMIT })) {
    assert.equal(value, limits.get(name), name);
  }
});

test('codecs are those of section 4.4', () => {
  const codecs = [...PAGE.matchAll(/^\| (\d) \| ([A-Z]+) \| [\w, ]+ \| .* \| .* \|$/gm)];
  assert.deepEqual(Object.fromEntries(codecs.map((row) => [row[2], Number(row[1])])), CODEC);
});
