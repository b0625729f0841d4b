/** Texels of space planes that have been decoded and wait for the renderer, which takes some rows of them at a time. */

import type { PlaneName } from '../container/scene_chunks.js';

/** Rows of a space plane: halves [row][layer][column][4]. */
export interface TexelRows {
  scale: number;
  plane: PlaneName;
  firstRow: number;
  rowCount: number;
  columns: number;
  layers: number;
  texels: Uint16Array;
}

/** The plane that texels belong to. */
export type PlaneShape = Pick<TexelRows, 'scale' | 'plane' | 'columns' | 'layers'>;

export class TexelQueue {
  #pieces: { position: number; shape: PlaneShape; texels: Uint16Array; takenRows: number }[] = [];

  /** Add all texels of the segment at a position. */
  add(position: number, shape: PlaneShape, texels: Uint16Array): void {
    this.#pieces.push({ position, shape, texels, takenRows: 0 });
  }

  /**
   * Take rows, at most so many bytes or one row, up to a segment that is early.
   * @param finished called with the position of each segment of which these were the last.
   */
  take(mostBytes: number, finished: (position: number) => void, isEarly: (position: number) => boolean): TexelRows[] {
    const taken: TexelRows[] = [];
    let left = mostBytes;
    while (left > 0 && this.#pieces.length && !isEarly(this.#pieces[0].position)) {
      const piece = this.#pieces[0];
      const { shape, texels, takenRows: firstRow } = piece;
      const length = shape.layers * shape.columns * 4; // halves of a row
      const rows = texels.length / length;
      const rowCount = Math.min(rows - firstRow, Math.max(1, Math.floor(left / (2 * length))));
      piece.takenRows += rowCount;
      left -= 2 * length * rowCount;
      taken.push({
        ...shape,
        firstRow,
        rowCount,
        texels: texels.subarray(firstRow * length, piece.takenRows * length),
      });
      if (piece.takenRows === rows) {
        this.#pieces.shift();
        finished(piece.position);
      }
    }
    return taken;
  }

  /** Hand out all that waits from its first row on. */
  rewind(): void {
    for (const piece of this.#pieces) piece.takenRows = 0;
  }

  clear(): void {
    this.#pieces = [];
  }
}
