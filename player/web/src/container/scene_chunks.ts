/** The content of the scene chunks, under RAW (section 6 of spec/kpc-format.md). */

import { FormatError } from './errors.js';

export const LIMIT = {
  SCALE: 16,
  CHANNEL: 256,
  AXIS: 16384,
  MOTION: 256,
  DISPLACEMENT: 1024,
  HIDDEN: 256,
  CAMERA: 4096,
  APPEARANCE: 16384,
  NAME: 255,
  FRAME: 1 << 24,
  BOX: 2 ** 30,
  SAMPLE: 65536,
  VALUE: 2048,
};
export const PLANES = ['xy', 'xz', 'yz', 'xt', 'yt', 'zt'] as const;
export type PlaneName = (typeof PLANES)[number];
export const isTimePlane = (name: PlaneName): boolean => name.endsWith('t');

/** What SCNE says of a plane; `step` and `offset` have a number for each channel. */
export interface PlaneHead {
  rows: number;
  columns: number;
  channels: number;
  step: Float32Array;
  offset: Float32Array;
}

/** The planes of a scale: six, or the three space planes of a static scene. */
export type Scale<T> = Partial<Record<PlaneName, T>>;

/** The content of SCNE; `aabb` is the lower corner and the upper one, `features` the channels of all scales. */
export interface SceneHead {
  aabb: number[];
  frameCount: number;
  fps: number;
  rayStep: number;
  background: number[];
  isDynamic: boolean;
  scales: Scale<PlaneHead>[];
  valueCount: number;
  features: number;
}

/** The content of WARP: contracted space (1) or device coordinates (2). */
export type Mapping =
  | { mapping: 1; uniformDistance: number }
  | { mapping: 2; referencePose: number[]; near: number; baseline: number };

/** The content of MOVE: displacements [t][z][y][x][3]; `sizes` are those of t, z, y and x. */
export interface MotionGrid {
  sizes: number[];
  displacements: Float32Array;
}

/** The content of OCCU: one byte for each slot and cell; `sizes` are slots and cells along z, y and x. */
export interface OccupancyGrid {
  sizes: number[];
  occupied: Uint8Array;
  /** Its content under RAW, for `Core.project`. */
  content: Uint8Array;
}

/** The content of DECO or HYBR: arrays of weights, row-major, by their names in section 6.5. */
export interface DecoderWeights {
  isHybrid: boolean;
  features: number;
  width: number;
  hidden: number;
  densityBias: number;
  weights: Record<string, Float32Array>;
}

/** A camera of came; `pose` has three rows of four numbers, from the camera to the world. */
export interface Camera {
  width: number;
  height: number;
  focal: number[];
  centre: number[];
  pose: number[];
}

export interface Appearance {
  name: string;
  embedding: Float32Array;
}

/** Reads the content of a chunk from its start to its end, never beyond. */
export class Cursor {
  readonly bytes: Uint8Array;
  readonly kind: string;
  readonly view: DataView;
  position = 0;

  constructor(bytes: Uint8Array, kind: string) {
    this.bytes = bytes;
    this.kind = kind;
    this.view = new DataView(bytes.buffer, bytes.byteOffset, bytes.length);
  }

  /** Return the position of the next `length` bytes, and move beyond them. */
  take(length: number) {
    const start = this.position;
    if (start + length > this.bytes.length) {
      throw new FormatError(`${this.kind}: ends after ${this.bytes.length} bytes, ${start + length} needed`);
    }
    this.position += length;
    return start;
  }

  u8 = () => this.view.getUint8(this.take(1));
  u16 = () => this.view.getUint16(this.take(2), true);
  u32 = () => this.view.getUint32(this.take(4), true);
  f32 = () => this.view.getFloat32(this.take(4), true);
  f64 = () => this.view.getFloat64(this.take(8), true);

  /** Return `count` numbers that `read` reads. */
  many(read: () => number, count: number) {
    return Array.from({ length: count }, read);
  }

  /** Return `count` f16 as float32. */
  halves(count: number) {
    const start = this.take(2 * count);
    return Float32Array.from({ length: count }, (_, k) => fromHalf(this.view.getUint16(start + 2 * k, true)));
  }

  finish() {
    const more = this.bytes.length - this.position;
    if (more) throw new FormatError(`${this.kind}: ${more} bytes too long`);
  }
}

/** Return the number of the bits of an IEEE 754 binary16. */
export function fromHalf(bits: number) {
  const sign = bits & 0x8000 ? -1 : 1;
  const exponent = (bits >> 10) & 31;
  const fraction = bits & 1023;
  if (exponent === 31) return fraction ? NaN : sign * Infinity;
  return sign * (exponent ? (1024 + fraction) * 2 ** (exponent - 25) : fraction * 2 ** -24);
}

let halves: Float32Array | null = null;

/** Return many halves as float32; they are looked up, ten times as fast as computed. */
export function fromHalves(bits: Uint16Array): Float32Array<ArrayBuffer> {
  halves ??= allHalves();
  const out = new Float32Array(bits.length);
  for (let i = 0; i < bits.length; i++) out[i] = halves[bits[i]];
  return out;
}

function allHalves(): Float32Array {
  const found = new Float32Array(1 << 16);
  for (let half = 0; half < found.length; half++) found[half] = fromHalf(half);
  return found;
}

/** SCNE (section 6.1). */
export function parseHead(bytes: Uint8Array): SceneHead {
  const cursor = new Cursor(bytes, 'SCNE');
  const aabb = cursor.many(cursor.f32, 6);
  const frameCount = cursor.u32();
  const [fps, rayStep] = [cursor.f64(), cursor.f64()];
  const background = cursor.many(cursor.f32, 3);
  const [scaleCount, dynamic] = [cursor.u8(), cursor.u8()];
  const edges = [0, 1, 2].map((axis) => aabb[axis + 3] - aabb[axis]);
  if (!aabb.every((x) => Math.abs(x) <= LIMIT.BOX) || !edges.every((edge) => edge >= 1 / LIMIT.BOX)) {
    throw new FormatError('SCNE: the box is empty, not finite or absurdly large');
  }
  if (!(Number.isFinite(fps) && fps > 0 && frameCount > 0 && frameCount <= LIMIT.FRAME)) {
    throw new FormatError(`SCNE: a clip of ${frameCount} frames at ${fps} fps makes no sense`);
  }
  const diagonal = Math.hypot(...edges);
  if (!(Number.isFinite(rayStep) && rayStep > 0 && diagonal / rayStep <= LIMIT.SAMPLE)) {
    throw new FormatError(`SCNE: a ray step of ${rayStep} in a box of diagonal ${diagonal} makes no sense`);
  }
  if (!background.every((c) => c >= 0 && c <= 1)) throw new FormatError('SCNE: the background lies outside [0, 1]');
  if (scaleCount < 1 || scaleCount > LIMIT.SCALE || dynamic > 1) {
    throw new FormatError(`SCNE: ${scaleCount} scales (1 to ${LIMIT.SCALE} allowed), dynamic flag ${dynamic}`);
  }
  const scales = Array.from({ length: scaleCount }, (_, number) => parseScale(cursor, number, dynamic === 1));
  cursor.finish();
  const all = scales.flatMap((scale) => Object.values(scale));
  return {
    aabb,
    frameCount,
    fps,
    rayStep,
    background,
    isDynamic: dynamic === 1,
    scales,
    valueCount: all.reduce((sum, plane) => sum + plane.rows * plane.columns * plane.channels, 0),
    features: scales.reduce((sum, scale) => sum + (scale.xy?.channels ?? 0), 0),
  };
}

function parseScale(cursor: Cursor, number: number, dynamic: boolean): Scale<PlaneHead> {
  const [channels, x, y, z, t] = cursor.many(cursor.u16, 5);
  const fits = channels > 0 && channels <= LIMIT.CHANNEL && [x, y, z].every((n) => n > 0 && n <= LIMIT.AXIS);
  if (!fits || dynamic !== t > 0 || t > LIMIT.AXIS) {
    throw new FormatError(
      `SCNE: scale ${number} claims ${channels} channels on a grid of ${x}x${y}x${z}, ${t} rows in time`,
    );
  }
  const size: Record<string, number> = { x, y, z, t };
  const planes: Scale<PlaneHead> = {};
  for (const name of dynamic ? PLANES : PLANES.slice(0, 3)) {
    const step = Float32Array.from(cursor.many(cursor.f32, channels));
    const offset = new Float32Array(channels).fill(1);
    if (!isTimePlane(name)) offset.set(cursor.many(cursor.f32, channels));
    const inRange = step.every(
      (s, c) => s > 0 && Math.fround(Math.fround(s * 128) + Math.abs(offset[c])) <= LIMIT.VALUE,
    );
    if (!inRange) {
      throw new FormatError(`SCNE: scale ${number}, plane ${name}: a step or an offset lies outside its range`);
    }
    planes[name] = { rows: size[name[1]], columns: size[name[0]], channels, step, offset };
  }
  return planes;
}

/** WARP (section 6.2). */
export function parseMapping(bytes: Uint8Array, head: SceneHead): Mapping {
  const cursor = new Cursor(bytes, 'WARP');
  const mapping = bytes.length < 4 ? 0 : cursor.u32();
  if (mapping === 2) return parseDeviceCoordinates(cursor, head);
  if (mapping !== 1)
    throw new FormatError(`WARP: mapping ${mapping} of space, unknown to this reader; update kpc`, 'newer');
  const uniformDistance = cursor.f64();
  cursor.finish();
  const inRange = uniformDistance >= 1 / LIMIT.BOX && uniformDistance <= LIMIT.BOX;
  if (!(inRange && (2 * uniformDistance) / head.rayStep <= LIMIT.SAMPLE)) {
    throw new FormatError(`WARP: even steps up to a distance of ${uniformDistance} make no sense`);
  }
  return { mapping: 1, uniformDistance };
}

function parseDeviceCoordinates(cursor: Cursor, head: SceneHead): Mapping {
  const referencePose = cursor.many(cursor.f64, 12);
  const [near, baseline] = [cursor.f64(), cursor.f64()];
  cursor.finish();
  const product = (i: number, j: number) =>
    [0, 4, 8].reduce((sum, row) => sum + referencePose[row + i] * referencePose[row + j], 0);
  const pairs = [0, 1, 2].flatMap((i) => [0, 1, 2].map((j) => product(i, j) - (i === j ? 1 : 0)));
  if (
    ![near, baseline].every((x) => x >= 1 / LIMIT.BOX && x <= LIMIT.BOX) ||
    !referencePose.every((x) => Math.abs(x) <= LIMIT.BOX) ||
    !pairs.every((x) => Math.abs(x) < 1e-4) ||
    !(head.aabb[5] < baseline / near)
  ) {
    throw new FormatError(`WARP: device coordinates of near ${near} and baseline ${baseline} make no sense`);
  }
  return { mapping: 2, referencePose, near, baseline };
}

/** The head of MOVE (section 6.3). */
export function parseMotionHead(cursor: Cursor, isDynamic: boolean) {
  const sizes = cursor.many(cursor.u16, 4);
  const step = cursor.f32();
  const fits = sizes.every((n, axis) => n >= 2 && n <= (axis ? LIMIT.MOTION : LIMIT.AXIS));
  if (!isDynamic || !fits) {
    const scene = isDynamic ? 'moving' : 'static';
    throw new FormatError(`MOVE: a motion grid of ${sizes} nodes in a ${scene} scene makes no sense`);
  }
  if (!(step > 0 && 32768 * step <= LIMIT.DISPLACEMENT)) {
    throw new FormatError(`MOVE: a step of ${step} lies outside its range`);
  }
  return { sizes, step, count: 3 * sizes.reduce((a, b) => a * b) };
}

/** MOVE: displacements [t][z][y][x][3]. */
export function parseMotion(bytes: Uint8Array, isDynamic: boolean): MotionGrid {
  const cursor = new Cursor(bytes, 'MOVE');
  const { sizes, step, count } = parseMotionHead(cursor, isDynamic);
  const start = cursor.take(2 * count);
  cursor.finish();
  const displacements = new Float32Array(count);
  for (let k = 0; k < count; k++) displacements[k] = cursor.view.getInt16(start + 2 * k, true) * step;
  return { sizes, displacements };
}

/** The head of OCCU (section 6.4): slots and cells along z, y, x. */
export function parseOccupancyHead(cursor: Cursor) {
  const sizes = cursor.many(cursor.u16, 4);
  if (!sizes.every((n) => n > 0 && n <= LIMIT.AXIS)) {
    throw new FormatError(`OCCU: a grid of ${sizes} cells makes no sense`);
  }
  return { sizes, cells: sizes.reduce((a, b) => a * b) };
}

/** OCCU: one byte for each slot and cell; `content` is for `Core.project`. */
export function parseOccupancy(content: Uint8Array): OccupancyGrid {
  const cursor = new Cursor(content, 'OCCU');
  const { sizes, cells } = parseOccupancyHead(cursor);
  const start = cursor.take(Math.ceil(cells / 8));
  cursor.finish();
  if (cells % 8 && content[content.length - 1] >> (cells % 8)) {
    throw new FormatError('OCCU: the unused bits of its last byte are not 0');
  }
  const occupied = new Uint8Array(cells);
  for (let i = 0; i < cells; i++) occupied[i] = (content[start + (i >> 3)] >> (i & 7)) & 1;
  return { sizes, occupied, content };
}

/** The arrays of DECO or HYBR (section 6.5) by their names, in order, with their lengths. */
function arrayLengths(isHybrid: boolean, features: number, width: number, hidden: number): Record<string, number> {
  return isHybrid
    ? {
        ...{ v: width * features, v_bias: width, density_weight: width, w1: 9 * hidden, b1: hidden },
        ...{ u: hidden * width, w2: 3 * hidden, b2: 3 },
      }
    : { density_weight: features, w1: 9 * hidden, b1: hidden, w2: 3 * features * hidden, b2: 3 * features };
}

/** The head of DECO or HYBR. */
export function parseDecoderHead(cursor: Cursor, expected: number) {
  const isHybrid = cursor.kind === 'HYBR';
  const features = cursor.u16();
  const width = isHybrid ? cursor.u16() : 0;
  const hidden = cursor.u16();
  const densityBias = cursor.f32();
  const units = isHybrid ? [width, hidden] : [hidden];
  const fits = units.every((n) => n > 0 && n <= LIMIT.HIDDEN);
  if (features !== expected || !fits || !Number.isFinite(densityBias)) {
    const bias = `density bias ${Number.isNaN(densityBias) ? 'nan' : densityBias}`;
    throw new FormatError(
      `${cursor.kind}: ${features} features (the planes give ${expected}), ${units.join(' and ')} hidden units ` +
        `(1 to ${LIMIT.HIDDEN} allowed), ${bias}`,
    );
  }
  const lengths = arrayLengths(isHybrid, features, width, hidden);
  const rawLength = cursor.position + 2 * Object.values(lengths).reduce((a, b) => a + b);
  return { isHybrid, features, width, hidden, densityBias, lengths, rawLength };
}

/** DECO or HYBR: arrays of weights by their names in the spec. */
export function parseDecoder(bytes: Uint8Array, kind: string, expected: number): DecoderWeights {
  const cursor = new Cursor(bytes, kind);
  const { lengths, rawLength: _, ...head } = parseDecoderHead(cursor, expected);
  const weights: Record<string, Float32Array> = {};
  for (const [name, length] of Object.entries(lengths)) weights[name] = cursor.halves(length);
  cursor.finish();
  if (!Object.values(weights).every((array) => array.every(Number.isFinite))) {
    throw new FormatError(`${kind}: a weight is NaN or infinite`);
  }
  return { ...head, weights };
}

/** Whether the axes of a pose, rows of 4 numbers, have about the length 1, as files must have them; or NaN. */
export function hasUnitAxes(pose: ArrayLike<number>): boolean {
  const lengths = [0, 1, 2].map((axis) => Math.hypot(pose[axis], pose[axis + 4], pose[axis + 8]));
  return !(Math.min(...lengths) < 0.5 || Math.max(...lengths) > 2);
}

/** came (section 6.6). */
export function parseCameras(bytes: Uint8Array): Camera[] {
  const cursor = new Cursor(bytes, 'came');
  const count = cursor.u16();
  if (count < 1 || count > LIMIT.CAMERA) throw new FormatError(`came: ${count} cameras (1 to ${LIMIT.CAMERA} allowed)`);
  const cameras = Array.from({ length: count }, (_, number) => {
    const [width, height] = [cursor.u16(), cursor.u16()];
    const numbers = cursor.many(cursor.f32, 16);
    const [focal, centre, pose] = [numbers.slice(0, 2), numbers.slice(2, 4), numbers.slice(4)];
    const where = `came: camera ${number}`;
    if (numbers.some((x) => Math.abs(x) > LIMIT.BOX) || !hasUnitAxes(pose)) {
      throw new FormatError(`${where} lies absurdly far, or its axes are not of length 1`);
    }
    if (!numbers.every(Number.isFinite)) throw new FormatError(`${where}: it holds NaN or infinity`);
    if (width < 1 || height < 1) throw new FormatError(`${where}: picture size ${width}x${height} is empty`);
    if (!focal.every((f) => f > 0)) throw new FormatError(`${where}: focal length ${focal} must be positive`);
    return { width, height, focal, centre, pose };
  });
  cursor.finish();
  return cameras;
}

/** appe (section 6.7). */
export function parseAppearances(bytes: Uint8Array, expected: number): Appearance[] {
  const cursor = new Cursor(bytes, 'appe');
  const [count, hidden] = [cursor.u16(), cursor.u16()];
  if (count < 1 || count > LIMIT.APPEARANCE || hidden !== expected) {
    throw new FormatError(
      `appe: ${count} appearances (1 to ${LIMIT.APPEARANCE} allowed) of ${hidden} numbers (the decoder has ` +
        `${expected} hidden units)`,
    );
  }
  const codes = cursor.halves(count * hidden);
  if (!codes.every(Number.isFinite)) throw new FormatError('appe: a code is NaN or infinite');
  const decoder = new TextDecoder('utf-8', { fatal: true, ignoreBOM: true });
  const known = new Set();
  const appearances = Array.from({ length: count }, (_, number) => {
    const length = cursor.u8();
    const start = cursor.take(length);
    const where = `appe: the name of appearance ${number}`;
    let name = '';
    try {
      name = decoder.decode(bytes.subarray(start, start + length));
    } catch {
      throw new FormatError(`${where} is not UTF-8`);
    }
    if (length === 0 || /[\u0000-\u001f\u007f-\u009f]/.test(name) || known.has(name)) {
      throw new FormatError(`${where} is empty, holds a control character, or is there twice`);
    }
    known.add(name);
    return { name, embedding: codes.slice(number * hidden, (number + 1) * hidden) };
  });
  cursor.finish();
  return appearances;
}
