/** Writes files for tests: all chunks under RAW, whatever they hold (sections 4, 6 and 7 of spec/kpc-format.md). */

import { CODEC } from '../src/container/chunk.js';
import { ENTRY_LENGTH, HEADER_LENGTH, MAGIC } from '../src/container/container.js';
import { crc32c } from '../src/container/crc32c.js';

export interface Part {
  kind: string;
  body: Uint8Array;
  group?: number;
  scale?: number;
  plane?: number;
  rowStart?: number;
  rowCount?: number;
  codec?: number;
  rawLength?: number;
  /** Another checksum than that of the body. */
  crc?: number;
}

/** Return a file of chunks. */
export function file(parts: Part[], valueCount: number): Uint8Array<ArrayBuffer> {
  const table = new Uint8Array(ENTRY_LENGTH * parts.length);
  for (const [number, part] of parts.entries()) {
    const row = new Writer();
    for (const letter of part.kind) row.u8(letter.charCodeAt(0));
    row
      .u16(part.group ?? 0)
      .u8(part.scale ?? 0)
      .u8(part.plane ?? 0)
      .u32(part.rowStart ?? 0)
      .u32(part.rowCount ?? 0);
    row
      .u16(part.codec ?? CODEC.RAW)
      .u32(part.body.length)
      .u32(part.rawLength ?? part.body.length)
      .u32(part.crc ?? crc32c(part.body));
    for (const [k, byte] of row.bytes().entries()) table[k * parts.length + number] = byte;
  }
  const index = rawFrame(table);
  const bodies = parts.reduce((sum, part) => sum + part.body.length, 0);
  const header = new Writer();
  for (const byte of MAGIC) header.u8(byte);
  header.u16(1).u16(HEADER_LENGTH).u32(parts.length).u32(index.length).u32(crc32c(index));
  header.u64(HEADER_LENGTH + index.length + bodies).u64(valueCount);
  header.u32(Math.max(...parts.map((part) => part.rawLength ?? part.body.length)));
  header.u32(crc32c(header.bytes()));
  return joined([header.bytes(), index, ...parts.map((part) => part.body)]);
}

/** Return a Zstandard frame of raw blocks. */
export function rawFrame(content: Uint8Array): Uint8Array {
  const frame = new Writer().u32(0xfd2fb528).u8(0xa0).u32(content.length);
  const blocks: Uint8Array[] = [];
  for (let at = 0; at < content.length || at === 0; at += 1 << 17) {
    const block = content.subarray(at, at + (1 << 17));
    const isLast = at + (1 << 17) >= content.length ? 1 : 0;
    const header = (block.length << 3) | isLast;
    blocks.push(Uint8Array.of(header & 255, (header >> 8) & 255, header >> 16), block);
  }
  return joined([frame.bytes(), ...blocks]);
}

export interface SceneSizes {
  /** Channels, texels along x, y, z and rows in time of each scale; 0 rows of a static scene. */
  scales: [number, number, number, number, number][];
  frameCount: number;
  /** Rows of a segment of a time plane. */
  segmentRows: number;
  /** Chunks behind all others. */
  others?: Part[];
  /** What the symbols of time planes depend on. */
  seed?: number;
}

/** Return a scene of symbols that look random. */
export function scene(sizes: SceneSizes): Uint8Array<ArrayBuffer> {
  const { parts, valueCount } = sceneParts(sizes);
  return file(parts, valueCount);
}

/** Return the chunks of such a scene, and how many values it has. */
function sceneParts({ scales, frameCount, segmentRows, others: more = [], seed: start = 1 }: SceneSizes) {
  const isDynamic = scales[0][4] > 0;
  const names = isDynamic ? ['xy', 'xz', 'yz', 'xt', 'yt', 'zt'] : ['xy', 'xz', 'yz'];
  const head = new Writer();
  for (const corner of [0, 0, 0, 1, 1, 1]) head.f32(corner);
  head.u32(frameCount).f64(10).f64(0.01);
  for (let k = 0; k < 3; k++) head.f32(0);
  head.u8(scales.length).u8(isDynamic ? 1 : 0);
  let [valueCount, features] = [0, 0];
  const [spaces, firsts, laters]: Part[][] = [[], [], []];
  for (const [scale, [channels, x, y, z, t]] of scales.entries()) {
    head.u16(channels).u16(x).u16(y).u16(z).u16(t);
    features += channels;
    const sizes: Record<string, number> = { x, y, z, t };
    for (const [plane, name] of names.entries()) {
      for (let k = 0; k < channels; k++) head.f32(0.01 * (k + 1));
      for (let k = 0; k < channels && plane < 3; k++) head.f32(0.5);
      const [columns, rows] = [sizes[name[0]], sizes[name[1]]];
      valueCount += rows * columns * channels;
      const most = plane < 3 ? rows : segmentRows;
      for (let rowStart = 0; rowStart < rows; rowStart += most) {
        const rowCount = Math.min(most, rows - rowStart);
        const body = new Uint8Array(1 + rowCount * columns * channels);
        let seed = 1000 * scale + 100 * plane + rowStart + (plane < 3 ? 0 : 10_000 * start);
        for (let k = 1; k < body.length; k++) {
          seed = Math.imul(seed, 1664525) + 1013904223;
          body[k] = seed >>> 24;
        }
        const part = { kind: 'PLNE', body, scale, plane, rowStart, rowCount };
        (plane < 3 ? spaces : rowStart === 0 ? firsts : laters).push(part);
      }
    }
  }
  const hidden = 1;
  const weights = new Writer().u16(features).u16(hidden).f32(0);
  for (let k = features + 10 * hidden + 3 * features * (hidden + 1); k > 0; k--) weights.u16(0);
  const occupancy = new Writer().u16(1).u16(1).u16(1).u16(1).u8(1);
  const byScale = (part: Part) => part.scale ?? 0;
  const order = [...spaces, ...firsts].sort((a, b) => byScale(a) - byScale(b));
  laters.sort((a, b) => (a.rowStart ?? 0) - (b.rowStart ?? 0));
  const others = [head, weights, occupancy].map((one, k) => ({ kind: ['SCNE', 'DECO', 'OCCU'][k], body: one.bytes() }));
  const parts: Part[] = [...others, ...order, ...laters, ...more];
  return { parts, valueCount };
}

/** Return a clip of groups, each of which has some frames in common with the one before it, between other chunks. */
export function grouped(
  scenes: Uint8Array[],
  frameCount: number,
  common: number,
  valueCount: number,
  before: Part[] = [],
  behind: Part[] = [],
) {
  const parts = scenes.map((body, group) => {
    return { kind: 'GRUP', body, group, rowStart: group * (frameCount - common), rowCount: frameCount };
  });
  return file([...before, ...parts, ...behind], valueCount);
}

/** What `sharing` writes instead: of the shared planes, and of the chunks of each group. */
export interface Changes {
  shared?: (parts: Part[]) => Part[];
  own?: (parts: Part[], group: number) => Part[];
  /** Whether a shared plane lies behind the groups. */
  isBehind?: (part: Part) => boolean;
}

/**
 * Return a clip of groups that have time planes of their own, and share their space planes, which lie before them; and
 * the same groups as files of their own.
 */
export function sharing(
  sizes: SceneSizes,
  groupCount: number,
  common: number,
  { shared = (parts) => parts, own = (parts) => parts, isBehind = () => false }: Changes = {},
) {
  const groups = Array.from({ length: groupCount }, (_, group) => sceneParts({ ...sizes, seed: group + 1 }));
  const [{ parts, valueCount }] = groups;
  const isSpace = ({ kind, plane = 0 }: Part) => kind === 'PLNE' && plane < 3;
  const standIn = (part: Part): Part =>
    isSpace(part) ? { ...part, body: new Uint8Array(0), rawLength: part.body.length, codec: CODEC.SHARED } : part;
  const planes = shared(parts.filter(isSpace));
  const [before, behind] = [planes.filter((part) => !isBehind(part)), planes.filter(isBehind)];
  const bodies = groups.map((one, group) => file(own(one.parts.map(standIn), group), valueCount));
  return {
    clip: grouped(bodies, sizes.frameCount, common, valueCount, before, behind),
    scenes: groups.map((one) => file(one.parts, valueCount)),
  };
}

class Writer {
  readonly #bytes: number[] = [];

  bytes(): Uint8Array {
    return Uint8Array.from(this.#bytes);
  }

  u8 = (value: number) => this.#put(1, (view) => view.setUint8(0, value));
  u16 = (value: number) => this.#put(2, (view) => view.setUint16(0, value, true));
  u32 = (value: number) => this.#put(4, (view) => view.setUint32(0, value, true));
  u64 = (value: number) => this.#put(8, (view) => view.setBigUint64(0, BigInt(value), true));
  f32 = (value: number) => this.#put(4, (view) => view.setFloat32(0, value, true));
  f64 = (value: number) => this.#put(8, (view) => view.setFloat64(0, value, true));

  #put(length: number, write: (view: DataView) => void): this {
    const bytes = new Uint8Array(length);
    write(new DataView(bytes.buffer));
    this.#bytes.push(...bytes);
    return this;
  }
}

function joined(parts: Uint8Array[]): Uint8Array<ArrayBuffer> {
  const all = new Uint8Array(parts.reduce((sum, part) => sum + part.length, 0));
  let at = 0;
  for (const part of parts) {
    all.set(part, at);
    at += part.length;
  }
  return all;
}
