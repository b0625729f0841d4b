/** The conformance vectors through the decoder core and the readers of player/web (section 14 of the spec). */

import assert from 'node:assert/strict';
import { createHash } from 'node:crypto';
import test from 'node:test';

import { Groups } from '../src/container/groups.js';
import { Scene } from '../src/container/scene.js';
import { Core } from '../src/decoder/core.js';
import { parsed, read } from './files.js';

// biome-ignore lint/suspicious/noExplicitAny: the manifest is JSON, whose form section 14 of the spec says
type Json = any;
const MANIFEST = parsed('spec/vectors/manifest.json') as { valid: Record<string, Json>; invalid: Record<string, Json> };

const [core, scalarCore] = ['kpc_core.wasm', 'kpc_core_scalar.wasm'].map((file) => {
  const module = new WebAssembly.Module(read(`format/core/${file}`));
  assert.deepEqual(WebAssembly.Module.imports(module), []);
  return new Core(module);
}) as [Core, Core];

function sha256(...arrays: ArrayBufferView[]): string {
  const hash = createHash('sha256');
  for (const array of arrays) hash.update(new Uint8Array(array.buffer, array.byteOffset, array.byteLength));
  return hash.digest('hex');
}

/** Return what a scene holds, in the form of an entry of the manifest, without rays. */
function described(scene: Scene): Json {
  const { head, mapping, motion, occupancy, decoder, cameras, appearances, metadata } = scene;
  const bias = Float32Array.of(decoder.densityBias);
  const { density_weight: density, ...weights } = decoder.weights;
  const { v, v_bias: vBias, ...others } = weights;
  const arrays = decoder.isHybrid
    ? [v, vBias, density, bias, ...Object.values(others)]
    : [density, bias, ...Object.values(weights)];
  const found: Json = {
    frame_count: head.frameCount,
    fps: head.fps,
    ray_step: head.rayStep,
    aabb: [head.aabb.slice(0, 3), head.aabb.slice(3)],
    background: head.background,
    occupancy: { shape: occupancy.sizes, sha256: sha256(occupancy.occupied) },
    decoder: { features: decoder.features, hidden: decoder.hidden, sha256: sha256(...arrays) },
    cameras: {
      count: cameras.length,
      sha256: sha256(...cameras.map((c) => Float64Array.of(c.width, c.height, ...c.focal, ...c.centre, ...c.pose))),
    },
    planes: scene.planes().flatMap((scale, number) =>
      Object.entries(scale).map(([name, plane]) => ({
        scale: number,
        plane: name,
        shape: [plane.head.rows, plane.head.columns, plane.head.channels],
        symbols_sha256: sha256(plane.symbols),
        coded_sha256: sha256(plane.coded),
        values_sha256: sha256(scene.core.dequantise(plane.symbols, plane.head.step, plane.offset)),
      })),
    ),
  };
  if (decoder.isHybrid) found.decoder.width = decoder.width;
  if (mapping?.mapping === 1) found.uniform_distance = mapping.uniformDistance;
  if (mapping?.mapping === 2) {
    const rows = [0, 4, 8].map((start) => mapping.referencePose.slice(start, start + 4));
    Object.assign(found, { reference_pose: rows, near: mapping.near, baseline: mapping.baseline });
  }
  if (motion) found.motion = { shape: [...motion.sizes, 3], sha256: sha256(motion.displacements) };
  if (appearances.length) {
    const names = appearances.map((one) => new TextEncoder().encode(one.name));
    const sums = { names_sha256: sha256(...names), sha256: sha256(...appearances.map((one) => one.embedding)) };
    found.appearances = { count: appearances.length, ...sums };
  }
  if (Object.keys(metadata).length) found.metadata = metadata;
  const { sound } = scene;
  if (sound) {
    const lengths = Uint16Array.from(sound.packets, (packet) => packet.length);
    const { channels, preSkip, sampleCount, packets } = sound;
    const head = { channels, pre_skip: preSkip, sample_count: sampleCount, packets: packets.length };
    found.sound = { ...head, sha256: sha256(lengths, ...packets) };
  }
  return found;
}

for (const [name, expected] of Object.entries(MANIFEST.valid)) {
  const bytes = read(`spec/vectors/valid/${name}.kpc`);
  const options = { allowPartial: expected.partial };
  if (expected.groups) {
    test(`valid ${name}`, () => {
      const groups = new Groups(bytes, core, options);
      assert.deepEqual(
        groups.timeline.spans.map(({ first, last }) => [first, last - first + 1]),
        expected.groups.map((group: Json) => [group.row_start, group.row_count]),
      );
      assert.deepEqual(groups.metadata, expected.metadata ?? {});
      for (const [number, { scene }] of (expected.groups as Json[]).entries()) {
        if (scene === null) continue;
        const { sha256: _, partial, zstd, rays, ...whole } = MANIFEST.valid[scene];
        assert.deepEqual(described(groups.open(number)), whole);
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
      test(`valid ${name}${one === scalarCore ? ', scalar' : ''}`, () => {
        const { sha256: digest, partial, zstd, rays, ...whole } = expected;
        assert.equal(sha256(bytes), digest);
        assert.deepEqual(described(new Scene(bytes, one, options)), whole);
      });
    }
  }
}

for (const [name, expected] of Object.entries(MANIFEST.invalid)) {
  test(`invalid ${name}`, () => {
    const bytes = read(`spec/vectors/invalid/${name}.kpc`);
    const decode = () => {
      const groups = new Groups(bytes, core);
      for (const number of groups.timeline.spans.keys()) described(groups.open(number));
    };
    assert.throws(decode, (error: Error) => error.name === expected.error && error.message.includes(expected.message));
  });
}
