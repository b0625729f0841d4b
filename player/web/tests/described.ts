/** What a scene holds, as the manifest of the conformance vectors says it (section 14 of the spec). */

import type { Scene } from '../src/container/scene.js';

// biome-ignore lint/suspicious/noExplicitAny: the manifest is JSON, whose form the spec says
export type Json = any;

/** Return the hash of arrays, one after the other. */
export async function sha256(...arrays: ArrayBufferView[]): Promise<string> {
  const parts = arrays.map(({ buffer, byteOffset, byteLength }) => new Uint8Array(buffer, byteOffset, byteLength));
  const whole = await new Blob(parts as Uint8Array<ArrayBuffer>[]).arrayBuffer();
  const digest = new Uint8Array(await crypto.subtle.digest('SHA-256', whole));
  return Array.from(digest, (byte) => byte.toString(16).padStart(2, '0')).join('');
}

/** Return what a scene holds, in the form of an entry of the manifest, without rays. */
export async function described(scene: Scene): Promise<Json> {
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
    occupancy: { shape: occupancy.sizes, sha256: await sha256(occupancy.occupied) },
    decoder: { features: decoder.features, hidden: decoder.hidden, sha256: await sha256(...arrays) },
    cameras: {
      count: cameras.length,
      sha256: await sha256(
        ...cameras.map((c) => Float64Array.of(c.width, c.height, ...c.focal, ...c.centre, ...c.pose)),
      ),
    },
    planes: [],
  };
  for (const [number, scale] of scene.planes().entries()) {
    for (const [name, plane] of Object.entries(scale)) {
      const { rows, columns, channels, step } = plane.head;
      found.planes.push({
        scale: number,
        plane: name,
        shape: [rows, columns, channels],
        symbols_sha256: await sha256(plane.symbols),
        coded_sha256: await sha256(plane.coded),
        values_sha256: await sha256(scene.core.dequantise(plane.symbols, step, plane.offset)),
      });
    }
  }
  if (decoder.isHybrid) found.decoder.width = decoder.width;
  if (mapping?.mapping === 1) found.uniform_distance = mapping.uniformDistance;
  if (mapping?.mapping === 2) {
    const rows = [0, 4, 8].map((start) => mapping.referencePose.slice(start, start + 4));
    Object.assign(found, { reference_pose: rows, near: mapping.near, baseline: mapping.baseline });
  }
  if (motion) found.motion = { shape: [...motion.sizes, 3], sha256: await sha256(motion.displacements) };
  if (appearances.length) {
    const names = appearances.map((one) => new TextEncoder().encode(one.name));
    const sums = {
      names_sha256: await sha256(...names),
      sha256: await sha256(...appearances.map((one) => one.embedding)),
    };
    found.appearances = { count: appearances.length, ...sums };
  }
  if (Object.keys(metadata).length) found.metadata = metadata;
  const { sound } = scene;
  if (sound) {
    const lengths = Uint16Array.from(sound.packets, (packet) => packet.length);
    const { channels, preSkip, sampleCount, packets } = sound;
    const head = { channels, pre_skip: preSkip, sample_count: sampleCount, packets: packets.length };
    found.sound = { ...head, sha256: await sha256(lengths, ...packets) };
  }
  return found;
}
