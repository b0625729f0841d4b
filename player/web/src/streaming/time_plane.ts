/** A time plane held as symbols in segments, any of which may be missing: then its values are 1. */

import type { PlaneHead } from '../container/scene_chunks.js';
import { dequantised } from '../decoder/segment.js';

export class TimePlane {
  readonly head: PlaneHead;
  readonly #segments = new Map<number, Int8Array>(); // by their first rows
  readonly #startOf: Int32Array; // of each row, the first row of its segment

  constructor(head: PlaneHead) {
    this.head = head;
    this.#startOf = new Int32Array(head.rows);
  }

  /** Note a segment that the index lists. */
  list(start: number, count: number): void {
    this.#startOf.fill(start, start, start + count);
  }

  put(start: number, symbols: Int8Array): void {
    this.#segments.set(start, symbols);
  }

  drop(start: number): void {
    this.#segments.delete(start);
  }

  clear(): void {
    this.#segments.clear();
  }

  /** Write the values at a time in [0, 1], interpolated between two rows, as [column][channel]; return them. */
  sample(time: number, out: Float32Array = new Float32Array(this.head.columns * this.head.channels)): Float32Array {
    const { rows, channels, step, offset } = this.head;
    const position = Math.fround(Math.fround(Math.min(Math.max(time, 0), 1)) * (rows - 1));
    const lower = Math.min(Math.floor(position), Math.max(rows - 2, 0));
    const fraction = Math.fround(position - lower);
    const first = this.#row(lower);
    const second = fraction === 0 ? first : this.#row(Math.min(lower + 1, rows - 1));
    for (let at = 0, channel = 0; at < out.length; at++) {
      const low = dequantised(first ? first[at] : 0, step[channel], offset[channel]);
      const high = second === first ? low : dequantised(second ? second[at] : 0, step[channel], offset[channel]);
      out[at] = low * (1 - fraction) + high * fraction;
      if (++channel === channels) channel = 0;
    }
    return out;
  }

  /** Return the symbols of a row; null if they are missing. Symbols 0 stand for 1, the offset of time planes. */
  #row(row: number): Int8Array | null {
    const { columns, channels } = this.head;
    const start = this.#startOf[row];
    const length = columns * channels;
    return this.#segments.get(start)?.subarray((row - start) * length, (row - start + 1) * length) ?? null;
  }
}
