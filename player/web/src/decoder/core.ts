/**
 * The decoder core, format/core/kpc_core.wasm: what its functions take and return, as typed arrays. A call holds the
 * memory of the module only while it runs; all results are copies.
 */

import { BudgetError, FormatError } from '../container/errors.js';

/** Memory that the core takes for itself, at most: its tables, and rows of what it keeps of a segment. */
const CORE_BYTES = 32 << 20;
const ADDRESSES = 0xffff0000;
const NO_MEMORY = 1;

/** What the values of `Status` in kpc_core.h mean, with the details that callers give. */
type Details = Record<string, number>;
const MESSAGES: Record<number, (details: Details) => string> = {
  2: () => 'its sizes are beyond the limits of the format',
  3: () => 'cut off within its words',
  4: () => 'its first state is too small',
  5: () => 'its words do not end where they should',
  6: () => 'its map follows from an occupancy that is not known',
  7: () => 'unknown map mode',
  8: () => 'too short for its map',
  9: () => 'the unused bits of its map are not 0',
  10: (d) => `holds ${d.length} bytes, which is not what its map implies`,
  11: () => 'unknown number of sets of weights or flag',
  12: () => 'cut off within its weights',
  13: () => 'a symbol leaves its 8 bits',
  14: () => 'unknown side of blocks or flag, or a step of 0',
  15: (d) => `blocks of ${d.side}, more than twice its ${d.shorter} rows or columns`,
  16: () => 'a symbol leaves its 16 bits',
  17: () => "a power of two is not one of float16's",
  18: () => 'one is no number of float16',
  19: (d) => `claims ${d.rawLength} bytes, not those of its sizes`,
  20: () => 'cut off within its head',
  21: (d) => `${d.count} cameras (1 to 4096 allowed)`,
  22: (d) => `${d.lenses} lenses of ${d.count} cameras, or positions in multiples of 2^${d.exponent}, make no sense`,
  23: (d) => `${d.length} bytes are not those of ${d.count} cameras and ${d.lenses} lenses`,
  24: () => 'a rotation or a position is out of range',
};

interface Exports {
  memory: WebAssembly.Memory;
  kpc_begin(most: number, bytes: number): number;
  [name: string]: unknown;
}

/**
 * The numbers of a plane segment: symbols [rows][columns][channels], and a byte for each texel, whether it is coded.
 */
export interface SegmentSymbols {
  symbols: Int8Array<ArrayBuffer>;
  coded: Uint8Array<ArrayBuffer>;
}

export class Core {
  readonly limit: number;
  readonly #exports: Exports;

  /** Make an instance of a module, of whose calls each may take `memoryLimit` bytes beside CORE_BYTES. */
  constructor(module: WebAssembly.Module, memoryLimit = 2 ** 31) {
    this.limit = Math.min(memoryLimit + CORE_BYTES, ADDRESSES);
    this.#exports = new WebAssembly.Instance(module).exports as unknown as Exports;
  }

  /** Bytes that the instance's memory takes; it never shrinks. */
  get memoryBytes(): number {
    return this.#exports.memory.buffer.byteLength;
  }

  /**
   * Decode a plane segment (section 7) under any codec; `body` is of ZSTD what the frame holds, and `implied` the
   * implied map where the body needs it.
   */
  segment(
    codec: number,
    body: Uint8Array,
    rows: number,
    columns: number,
    channels: number,
    implied: Uint8Array | null = null,
  ): SegmentSymbols {
    const texels = rows * columns;
    const values = texels * channels;
    const coded = this.#begin(texels + values + body.length);
    const at = coded + texels + values;
    this.#put(at, body);
    if (implied) this.#put(coded, implied);
    const details = { length: body.length, side: body[0], shorter: Math.min(rows, columns) };
    const sizes = [rows, columns, channels, implied ? 1 : 0];
    this.#run('kpc_segment', [codec, at, body.length, ...sizes, coded, coded + texels], 'plane segment', details);
    return { symbols: new Int8Array(this.#get(coded + texels, values).buffer), coded: this.#get(coded, texels) };
  }

  /** Decode MOVE under MOTION (section 8.1) to its content under RAW. */
  motion(body: Uint8Array, rawLength: number): Uint8Array {
    return this.#content('kpc_motion', [], body, rawLength, 'motion');
  }

  /** Decode OCCU under OCCUPANCY (section 8.2) to its content under RAW. */
  occupancy(body: Uint8Array, rawLength: number): Uint8Array {
    return this.#content('kpc_occupancy', [], body, rawLength, 'occupancy');
  }

  /** Decode DECO, or HYBR, under WEIGHTS (section 8.3) to its content under RAW. */
  weights(isHybrid: boolean, body: Uint8Array, rawLength: number): Uint8Array {
    return this.#content('kpc_weights', [isHybrid ? 1 : 0], body, rawLength, 'weights');
  }

  /** Decode came under POSES (section 8.4) to its content under RAW. */
  poses(body: Uint8Array, rawLength: number): Uint8Array {
    const [count, lenses] = [0, 2].map((at) => body[at] | (body[at + 1] << 8));
    const details = { count, lenses, exponent: (body[4] << 24) >> 24 };
    return this.#content('kpc_poses', [], body, rawLength, 'came', details);
  }

  /** Project an occupancy grid, the content of OCCU under RAW, onto a plane (section 7.2): one byte for each cell. */
  project(occupancy: Uint8Array, plane: number, cells: number): Uint8Array {
    const projected = this.#begin(cells + occupancy.length);
    this.#put(projected + cells, occupancy);
    this.#run('kpc_project', [projected + cells, occupancy.length, plane, projected], 'occupancy', {});
    return this.#get(projected, cells);
  }

  /**
   * Return rows of the implied map (section 7.2) of a plane of `rows` and `columns`: one byte for each texel.
   * `projected` is what `project` returns, `cells` how many there are along rows and columns.
   */
  impliedMap(
    projected: Uint8Array,
    cells: readonly number[],
    rows: number,
    columns: number,
    rowStart: number,
    rowCount: number,
  ): Uint8Array {
    const texels = rowCount * columns;
    const coded = this.#begin(texels + projected.length);
    this.#put(coded + texels, projected);
    this.#run('kpc_implied_map', [coded + texels, ...cells, rows, columns, rowStart, rowCount, coded], 'map', {});
    return this.#get(coded, texels);
  }

  /** Return the float32 values of symbols (section 7.6); `step` and `offset` have a number for each channel. */
  dequantise(symbols: Int8Array, step: Float32Array, offset: Float32Array): Float32Array {
    const channels = step.length;
    const values = this.#begin(5 * symbols.length + 8 * channels);
    const steps = values + 4 * symbols.length;
    const at = steps + 8 * channels;
    this.#put(steps, new Uint8Array(step.buffer, step.byteOffset, step.byteLength));
    this.#put(steps + 4 * channels, new Uint8Array(offset.buffer, offset.byteOffset, offset.byteLength));
    this.#put(at, new Uint8Array(symbols.buffer, symbols.byteOffset, symbols.length));
    const sizes = [symbols.length / channels, channels];
    this.#run('kpc_dequantise', [at, ...sizes, steps, steps + 4 * channels, values], 'plane', {});
    return new Float32Array(this.#get(values, 4 * symbols.length).buffer);
  }

  #content(
    name: string,
    options: number[],
    body: Uint8Array,
    rawLength: number,
    what: string,
    details: Details = {},
  ): Uint8Array {
    const raw = this.#begin(rawLength + body.length);
    this.#put(raw + rawLength, body);
    const named = { ...details, length: body.length, rawLength };
    this.#run(name, [...options, raw + rawLength, body.length, raw, rawLength], what, named);
    return this.#get(raw, rawLength);
  }

  /** Return the address of `length` bytes for the arguments and results of one call. */
  #begin(length: number): number {
    const address = length < ADDRESSES ? this.#exports.kpc_begin(this.limit, length) >>> 0 : 0;
    if (address === 0) throw new BudgetError('decoding takes more memory than the budget allows');
    return address;
  }

  #put(address: number, bytes: Uint8Array): void {
    new Uint8Array(this.#exports.memory.buffer).set(bytes, address);
  }

  #get(address: number, length: number): Uint8Array<ArrayBuffer> {
    return new Uint8Array(this.#exports.memory.buffer).slice(address, address + length);
  }

  #run(name: string, values: number[], what: string, details: Details): void {
    const status = (this.#exports[name] as (...values: number[]) => number)(...values);
    if (status === NO_MEMORY) throw new BudgetError(`${what}: decoding takes more memory than the budget allows`);
    if (status !== 0) throw new FormatError(`${what}: ${(MESSAGES[status] as (details: Details) => string)(details)}`);
  }
}
