/** Plane segments: from a chunk to symbols (section 7 of spec/kpc-format.md). */

import { type Chunk, CODEC } from '../container/chunk.js';
import { FormatError } from '../container/errors.js';
import type { PlaneHead } from '../container/scene_chunks.js';
import type { Core, SegmentSymbols } from './core.js';

/** The occupancy grid projected onto a plane: a byte for each cell, and how many there are along rows and columns. */
export interface Projection {
  projected: Uint8Array;
  cells: [number, number];
}

/** Whether the texel map of a segment follows from the occupancy (map_mode 2 of section 7.2). */
export function needsOccupancy(codec: number, body: Uint8Array): boolean {
  return (codec === CODEC.PREDICTIVE || codec === CODEC.TRANSFORM) && body.length > 1 && (body[1] & 3) === 2;
}

/** Decode a PLNE chunk of a plane; `project` is called for a segment that needs the occupancy. */
export function decodeSegment(core: Core, chunk: Chunk, plane: PlaneHead, project: () => Projection): SegmentSymbols {
  const { codec, rowStart, rowCount, rawLength } = chunk.entry;
  const { rows, columns, channels } = plane;
  const texels = rowCount * columns;
  if (codec !== CODEC.PREDICTIVE && codec !== CODEC.TRANSFORM) {
    const content = chunk.content(1 + Math.ceil(texels / 8) + channels * texels);
    return core.segment(CODEC.RAW, content, rowCount, columns, channels);
  }
  if (rawLength !== texels * channels) {
    throw new FormatError(`${chunk.label} claims ${rawLength} symbols, not the ${texels * channels} of its rows`);
  }
  const body = chunk.coded();
  let map: Uint8Array | null = null;
  if (needsOccupancy(codec, body)) {
    const { projected, cells } = project();
    map = core.impliedMap(projected, cells, rows, columns, rowStart, rowCount);
  }
  return core.segment(codec, body, rowCount, columns, channels, map);
}

/** Return the value of a symbol (section 7.6). */
export const dequantised = (symbol: number, step: number, offset: number): number =>
  Math.fround(Math.fround(symbol * step) + offset);
