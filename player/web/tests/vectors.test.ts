/** The conformance vectors through the decoder core and the readers of player/web (section 14 of the spec). */

import assert from 'node:assert/strict';
import test from 'node:test';

import { Groups } from '../src/container/groups.js';
import { Scene } from '../src/container/scene.js';
import { Core } from '../src/decoder/core.js';
import { described, type Json, sha256 } from './described.js';
import { parsed, read } from './files.js';

const MANIFEST = parsed('spec/vectors/manifest.json') as { valid: Record<string, Json>; invalid: Record<string, Json> };

const [core, scalarCore] = ['kpc_core.wasm', 'kpc_core_scalar.wasm'].map((file) => {
  const module = new WebAssembly.Module(read(`format/core/${file}`));
  assert.deepEqual(WebAssembly.Module.imports(module), []);
  return new Core(module);
}) as [Core, Core];

for (const [name, expected] of Object.entries(MANIFEST.valid)) {
  const bytes = read(`spec/vectors/valid/${name}.kpc`);
  const options = { allowPartial: expected.partial };
  if (expected.groups) {
    test(`valid ${name}`, async () => {
      const groups = new Groups(bytes, core, options);
      assert.deepEqual(
        groups.timeline.spans.map(({ first, last }) => [first, last - first + 1]),
        expected.groups.map((group: Json) => [group.row_start, group.row_count]),
      );
      assert.deepEqual(groups.metadata, expected.metadata ?? {});
      for (const [number, { scene }] of (expected.groups as Json[]).entries()) {
        if (scene === null) continue;
        const { sha256: _, partial, zstd, rays, ...whole } = MANIFEST.valid[scene];
        assert.deepEqual(await described(groups.open(number)), whole);
      }
      for (const moment of expected.times) {
        const { group, localTime } = groups.timeline.at(moment.time);
        assert.equal(group, moment.group);
        assert.ok(Math.abs(localTime - moment.local_time) < 1e-6);
        const blend = groups.timeline.blendAt(moment.time);
        assert.deepEqual(
          blend.map((part) => String(part.group)),
          Object.keys(moment.blend),
        );
        for (const { group: part, share } of blend) assert.ok(Math.abs(share - moment.blend[part]) < 1e-6);
      }
    });
  } else {
    for (const one of [core, scalarCore]) {
      test(`valid ${name}${one === scalarCore ? ', scalar' : ''}`, async () => {
        const { sha256: digest, partial, zstd, rays, ...whole } = expected;
        assert.equal(await sha256(bytes), digest);
        assert.deepEqual(await described(new Scene(bytes, one, options)), whole);
      });
    }
  }
}

for (const [name, expected] of Object.entries(MANIFEST.invalid)) {
  test(`invalid ${name}`, async () => {
    const bytes = read(`spec/vectors/invalid/${name}.kpc`);
    const decode = async () => {
      const groups = new Groups(bytes, core);
      for (const number of groups.timeline.spans.keys()) await described(groups.open(number));
    };
    await assert.rejects(
      decode,
      (error: Error) => error.name === expected.error && error.message.includes(expected.message),
    );
  });
}
