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
export const PLANES = ['xy', 'xz', 'yz', 'xt', 'yt', 'zt'];
export const isTimePlane = (/** @type {string} */ name) => name.endsWith('t');

/** Reads the content of a chunk from its start to its end, never beyond. */
export class Cursor {
  constructor(/** @type {Uint8Array} */ bytes, /** @type {string} */ kind) {
    this.bytes = bytes;
    this.kind = kind;
    this.view = new DataView(bytes.buffer, bytes.byteOffset, bytes.length);
    this.position = 0;
  }

  /** Return the position of the next `length` bytes, and move beyond them. */
  take(/** @type {number} */ length) {
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
  many(/** @type {() => number} */ read, /** @type {number} */ count) {
    return Array.from({ length: count }, read);
  }

  /** Return `count` f16 as float32. */
  halves(/** @type {number} */ count) {
    const start = this.take(2 * count);
    return Float32Array.from({ length: count }, (_, k) => half(this.view.getUint16(start + 2 * k, true)));
  }

  finish() {
    const more = this.bytes.length - this.position;
    if (more) throw new FormatError(`${this.kind}: ${more} bytes too long`);
  }
}

function half(/** @type {number} */ bits) {
  const sign = bits & 0x8000 ? -1 : 1;
  const exponent = (bits >> 10) & 31;
  const fraction = bits & 1023;
  if (exponent === 31) return fraction ? NaN : sign * Infinity;
  return sign * (exponent ? (1024 + fraction) * 2 ** (exponent - 25) : fraction * 2 ** -24);
}

/** SCNE (section 6.1). */
export function parseHead(/** @type {Uint8Array} */ bytes) {
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
    features: scales.reduce((sum, scale) => sum + scale.xy.channels, 0),
  };
}

/** @typedef {{rows: number, columns: number, channels: number, step: Float32Array, offset: Float32Array}} PlaneHead */

/** @returns {Record<string, PlaneHead>} */
function parseScale(/** @type {Cursor} */ cursor, /** @type {number} */ number, /** @type {boolean} */ dynamic) {
  const [channels, x, y, z, t] = cursor.many(cursor.u16, 5);
  const fits = channels > 0 && channels <= LIMIT.CHANNEL && [x, y, z].every((n) => n > 0 && n <= LIMIT.AXIS);
  if (!fits || dynamic !== t > 0 || t > LIMIT.AXIS) {
    throw new FormatError(
      `SCNE: scale ${number} claims ${channels} channels on a grid of ${x}x${y}x${z}, ${t} rows in time`,
    );
  }
  const size = { x, y, z, t };
  const planes = {};
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
export function parseMapping(/** @type {Uint8Array} */ bytes, /** @type {ReturnType<typeof parseHead>} */ head) {
  const cursor = new Cursor(bytes, 'WARP');
  const mapping = bytes.length < 4 ? 0 : cursor.u32();
  if (mapping === 2) return parseDeviceCoordinates(cursor, head);
  if (mapping !== 1) throw new FormatError(`WARP: mapping ${mapping} of space, unknown to this reader; update kpc`);
  const uniformDistance = cursor.f64();
  cursor.finish();
  const inRange = uniformDistance >= 1 / LIMIT.BOX && uniformDistance <= LIMIT.BOX;
  if (!(inRange && (2 * uniformDistance) / head.rayStep <= LIMIT.SAMPLE)) {
    throw new FormatError(`WARP: even steps up to a distance of ${uniformDistance} make no sense`);
  }
  return { mapping, uniformDistance };
}

function parseDeviceCoordinates(
  /** @type {Cursor} */ cursor,
  /** @type {ReturnType<typeof parseHead>} */ head,
) {
  const referencePose = cursor.many(cursor.f64, 12);
  const [near, baseline] = [cursor.f64(), cursor.f64()];
  cursor.finish();
  const product = (i, j) => [0, 4, 8].reduce((sum, row) => sum + referencePose[row + i] * referencePose[row + j], 0);
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
export function parseMotionHead(/** @type {Cursor} */ cursor, /** @type {boolean} */ isDynamic) {
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
export function parseMotion(/** @type {Uint8Array} */ bytes, /** @type {boolean} */ isDynamic) {
  const cursor = new Cursor(bytes, 'MOVE');
  const { sizes, step, count } = parseMotionHead(cursor, isDynamic);
  const start = cursor.take(2 * count);
  cursor.finish();
  const displacements = new Float32Array(count);
  for (let k = 0; k < count; k++) displacements[k] = cursor.view.getInt16(start + 2 * k, true) * step;
  return { sizes, displacements };
}

/** The head of OCCU (section 6.4): slots and cells along z, y, x. */
export function parseOccupancyHead(/** @type {Cursor} */ cursor) {
  const sizes = cursor.many(cursor.u16, 4);
  if (!sizes.every((n) => n > 0 && n <= LIMIT.AXIS)) {
    throw new FormatError(`OCCU: a grid of ${sizes} cells makes no sense`);
  }
  return { sizes, cells: sizes.reduce((a, b) => a * b) };
}

/** OCCU: one byte for each slot and cell; `content` is for `Core.project`. */
export function parseOccupancy(/** @type {Uint8Array} */ content) {
  const cursor = new Cursor(content, 'OCCU');
  const { sizes, cells } = parseOccupancyHead(cursor);
  const start = cursor.take(Math.ceil(cells / 8));
  cursor.finish();
  if (cells % 8 && content[content.length - 1] >> cells % 8) {
    throw new FormatError('OCCU: the unused bits of its last byte are not 0');
  }
  const occupied = new Uint8Array(cells);
  for (let i = 0; i < cells; i++) occupied[i] = (content[start + (i >> 3)] >> (i & 7)) & 1;
  return { sizes, occupied, content };
}

/** The arrays of DECO or HYBR (section 6.5) by their names, in order, with their lengths. */
function arrayLengths(isHybrid, features, width, hidden) {
  return isHybrid
    ? {
        ...{ v: width * features, v_bias: width, density_weight: width, w1: 9 * hidden, b1: hidden },
        ...{ u: hidden * width, w2: 3 * hidden, b2: 3 },
      }
    : { density_weight: features, w1: 9 * hidden, b1: hidden, w2: 3 * features * hidden, b2: 3 * features };
}

/** The head of DECO or HYBR. */
export function parseDecoderHead(/** @type {Cursor} */ cursor, /** @type {number} */ expected) {
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
export function parseDecoder(/** @type {Uint8Array} */ bytes, /** @type {string} */ kind, /** @type {number} */ expected) {
  const cursor = new Cursor(bytes, kind);
  const { lengths, ...head } = parseDecoderHead(cursor, expected);
  const weights = {};
  for (const [name, length] of Object.entries(lengths)) weights[name] = cursor.halves(length);
  cursor.finish();
  if (!Object.values(weights).every((array) => array.every(Number.isFinite))) {
    throw new FormatError(`${kind}: a weight is NaN or infinite`);
  }
  return { ...head, weights };
}

/** Whether the axes of a pose, rows of 4 numbers, have about the length 1, as files must have them; or NaN. */
export function hasUnitAxes(/** @type {ArrayLike<number>} */ pose) {
  const lengths = [0, 1, 2].map((axis) => Math.hypot(pose[axis], pose[axis + 4], pose[axis + 8]));
  return !(Math.min(...lengths) < 0.5 || Math.max(...lengths) > 2);
}

/** came (section 6.6). */
export function parseCameras(/** @type {Uint8Array} */ bytes) {
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
export function parseAppearances(/** @type {Uint8Array} */ bytes, /** @type {number} */ expected) {
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
