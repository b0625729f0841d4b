/** Where the features of each scale may be other than 0, found from the texels alone: the twin of kpc.player.areas. */

import type { Layout } from './atlas.js';
import { headOf, type PlaneRows, type SceneSource, SPACE_PLANES, type SpacePlane } from './scene_source.js';

/** Beyond all positions in [0, 1], on either side. */
const [BELOW, ABOVE] = [-1, 2];
const WHOLE = [BELOW, BELOW, BELOW, ABOVE, ABOVE, ABOVE];
const EMPTY = [ABOVE, ABOVE, ABOVE, BELOW, BELOW, BELOW];

/** The areas of a scene's scales, as far as its space planes have been put; those made for the whole box have that. */
export class FeatureAreas {
  readonly #bounds: Float32Array;
  /** Scales whose planes have changed since their bounds were found. */
  readonly #changed = new Set<number>();
  /** Whether a texel [row][column] is other than 0 in a channel, of the scales that may be parts. */
  readonly #used: (Record<SpacePlane, Uint8Array> | null)[];
  readonly #layout: Layout;

  constructor(scene: SceneSource, layout: Layout) {
    this.#layout = layout;
    this.#used = mayBeParts(scene).map((isPart, scale) => {
      const used = SPACE_PLANES.map((plane) => {
        const { width, height } = layout.block(scale, plane);
        return [plane, new Uint8Array(width * height)];
      });
      return isPart ? Object.fromEntries(used) : null;
    });
    this.#bounds = Float32Array.from(this.#used.flatMap((used) => (used === null ? WHOLE : EMPTY)));
  }

  /** Take note of rows of a space plane. */
  put({ scale, plane, firstRow, rowCount, texels }: PlaneRows): void {
    const used = this.#used[scale];
    if (used === null) return;
    const { width } = this.#layout.block(scale, plane as SpacePlane);
    const layers = this.#layout.layers[scale];
    const marks = used[plane as SpacePlane];
    for (let row = 0, at = 0; row < rowCount; row++) {
      const first = (firstRow + row) * width;
      marks.fill(0, first, first + width);
      for (let layer = 0; layer < layers; layer++) {
        for (let column = 0; column < width; column++, at += 4) {
          for (let c = at; c < at + 4; c++) if (texels[c] !== 0) marks[first + column] = 1;
        }
      }
    }
    this.#changed.add(scale);
  }

  /** Positions along x, y, z in [0, 1] between which features may be other than 0: 6 numbers for each scale. */
  get bounds(): Float32Array {
    for (const scale of this.#changed) {
      const used = this.#used[scale];
      if (used !== null) this.#bounds.set(this.#area(scale, used), 6 * scale);
    }
    this.#changed.clear();
    return this.#bounds;
  }

  /** Return between which positions the product of a scale's space planes may be other than 0. */
  #area(scale: number, used: Record<SpacePlane, Uint8Array>): number[] {
    const area = [...EMPTY];
    for (const [k, axis] of [...'xyz'].entries()) {
      const planes = SPACE_PLANES.filter((plane) => plane.includes(axis));
      const lines = planes.map((plane) => this.#lines(scale, plane, used[plane], plane[0] === axis));
      const isUsed = lines[0].map((mark, n) => mark & lines[1][n]);
      const [first, end, last] = [isUsed.indexOf(1), isUsed.lastIndexOf(1), isUsed.length - 1];
      if (first < 0) continue;
      area[k] = first === 0 ? BELOW : (first - 1) / last;
      area[3 + k] = end === last ? ABOVE : (end + 1) / last;
    }
    return area;
  }

  /** Return which columns, or rows, of a plane have a texel that is marked. */
  #lines(scale: number, plane: SpacePlane, marks: Uint8Array, isColumns: boolean): Uint8Array {
    const { width, height } = this.#layout.block(scale, plane);
    const lines = new Uint8Array(isColumns ? width : height);
    for (let at = 0; at < marks.length; at++) lines[isColumns ? at % width : Math.floor(at / width)] |= marks[at];
    return lines;
  }
}

/** Return for each scale whether it may be a part: scales for what moves have more time rows than others. */
export function mayBeParts({ head: { scales, isDynamic } }: Pick<SceneSource, 'head'>): boolean[] {
  const rows = scales.map((scale) => (isDynamic ? headOf(scale, 'xt').rows : 0));
  return rows.map((count) => count > Math.min(...rows));
}
