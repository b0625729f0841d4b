/** A scene's planes as one texture, and what of them depends on the time: the twin of kpc.player.atlas. */

import type { MotionGrid } from '../container/scene_chunks.js';
import { headOf, type SceneSource, SPACE_PLANES, type SpacePlane, TIME_PLANES } from './scene_source.js';

/** The axis of each space plane along which a time row is folded into it. */
const FOLDING_AXIS = { xy: 'x', xz: 'z', yz: 'y' } as const;
const FARTHEST = 255;

/** Where a plane of a scale lies: its first texel, and the size of one layer of four channels. */
export interface Block {
  scale: number;
  plane: SpacePlane;
  x: number;
  y: number;
  width: number;
  height: number;
}

/** Whether the row that is folded into a plane has one value for each of its rows, else one for each column. */
export const isFoldedAlongRows = (plane: SpacePlane): boolean => FOLDING_AXIS[plane] === plane[1];

/** How a scene's space planes share one texture. */
export class Layout {
  /** Layers of four channels that the features of each scale fill, and the number of the first among all. */
  readonly layers: readonly number[];
  readonly firstLayers: readonly number[];
  /** Layers of all scales. */
  readonly features: number;
  readonly width: number;
  readonly height: number;
  /** Scale by scale, in the order of SPACE_PLANES. */
  readonly blocks: readonly Block[];
  readonly upsampling: number;

  /** Pack the blocks on shelves, tallest first; `upsampling` texels to one of the scene's along the folded axis. */
  constructor(scene: SceneSource, upsampling = 1) {
    const { scales } = scene.head;
    this.upsampling = upsampling;
    this.layers = scales.map((scale) => Math.ceil(headOf(scale, 'xy').channels / 4));
    this.features = this.layers.reduce((a, b) => a + b);
    this.firstLayers = this.layers.map((_, s) => this.layers.slice(0, s).reduce((a, b) => a + b, 0));
    const blocks = scales.flatMap((scale, number) =>
      SPACE_PLANES.map((plane): Block => {
        const sized = (size: number, axis: string) =>
          FOLDING_AXIS[plane] === axis ? upsampling * (size - 1) + 1 : size;
        const { columns, rows } = headOf(scale, plane);
        return { scale: number, plane, x: 0, y: 0, width: sized(columns, plane[0]), height: sized(rows, plane[1]) };
      }),
    );
    const across = (block: Block) => block.width * this.layers[block.scale];
    const area = blocks.reduce((sum, block) => sum + across(block) * block.height, 0);
    this.width = Math.max(Math.ceil(Math.sqrt(area)), ...blocks.map(across));
    let [x, y, shelf] = [0, 0, 0];
    for (const block of [...blocks].sort((a, b) => b.height - a.height)) {
      if (x + across(block) > this.width) [x, y, shelf] = [0, y + shelf, 0];
      [block.x, block.y] = [x, y];
      [x, shelf] = [x + across(block), Math.max(shelf, block.height)];
    }
    this.height = y + shelf;
    this.blocks = blocks;
  }

  get scales(): number {
    return this.layers.length;
  }

  /** Lines of `timeRows`: one for each axis, scale and layer. */
  get lineCount(): number {
    return 3 * this.features;
  }

  block(scale: number, plane: SpacePlane): Block {
    return this.blocks[3 * scale + SPACE_PLANES.indexOf(plane)];
  }

  /** Return, as shares of the texture, the middle of a block's first texel and the way from it to a layer's last. */
  textureRectangle({ x, y, width, height }: Block): [number, number, number, number] {
    return [(x + 0.5) / this.width, (y + 0.5) / this.height, (width - 1) / this.width, (height - 1) / this.height];
  }

  /** Return the first line that is folded into a block; the block has as many as layers. */
  firstLine(block: Block): number {
    return 'xyz'.indexOf(FOLDING_AXIS[block.plane]) * this.features + this.firstLayers[block.scale];
  }
}

/** Return the columns of the widest time plane, `upsampling` to one. */
export function rowWidth({ head: { scales } }: SceneSource, upsampling = 1): number {
  const columns = scales.flatMap((scale) => TIME_PLANES.map((name) => headOf(scale, name).columns));
  return upsampling * (Math.max(...columns) - 1) + 1;
}

/** Return the time planes at a time in [0, 1] as lines of texels, `rowWidth` wide; beyond the end of a row anything. */
export function timeRows(scene: SceneSource, layout: Layout, time: number, upsampling = 1): Float32Array {
  const width = rowWidth(scene, upsampling);
  const out = new Float32Array(4 * width * layout.lineCount).fill(1);
  for (const [scale, first] of layout.firstLayers.entries()) {
    for (const [axis, name] of TIME_PLANES.entries()) {
      const { columns, channels } = headOf(scene.head.scales[scale], name);
      const row = scene.row(scale, name, time);
      const line = axis * layout.features + first;
      for (let column = 0, at = 0; column < columns; column++) {
        for (let c = 0; c < channels; c++, at++) {
          const texel = 4 * (width * (line + (c >> 2)) + upsampling * column) + (c & 3);
          out[texel] = row[at];
          if (column > 0 && upsampling > 1) fillBetween(out, texel, upsampling);
        }
      }
    }
  }
  return out;
}

/** Interpolate one channel between a texel and the one `upsampling` before it. */
function fillBetween(out: Float32Array, texel: number, upsampling: number): void {
  const first = texel - 4 * upsampling;
  for (let i = 1; i < upsampling; i++) {
    out[first + 4 * i] = (1 - i / upsampling) * out[first] + (i / upsampling) * out[texel];
  }
}

/** Return the displacements at a time in [0, 1], [z][y][x][4]; the fourth number means nothing. */
export function displacementsAt({ sizes, displacements }: MotionGrid, time: number): Float32Array {
  const [times, depth, height, width] = sizes;
  const nodes = depth * height * width;
  const position = time * (times - 1);
  const lower = Math.min(Math.floor(position), times - 2);
  const f = position - lower;
  const out = new Float32Array(4 * nodes);
  for (let node = 0; node < nodes; node++) {
    for (let axis = 0; axis < 3; axis++) {
      const at = 3 * (nodes * lower + node) + axis;
      out[4 * node + axis] = displacements[at] * (1 - f) + displacements[at + 3 * nodes] * f;
    }
  }
  return out;
}

/** A row of a padded grid: its first cell, and the way to the next cell, row and layer in the direction of a pass. */
interface GridRow {
  first: number;
  width: number;
  by: number;
  row: number;
  layer: number;
}

/** Make no cell of a row farther than one of the 13 neighbours that a pass has left behind, and one step. */
function relaxRow(padded: Uint8Array, least: Uint8Array, { first, width, by, row, layer }: GridRow): void {
  const end = first + by * width;
  for (let at = first; at !== end; at += by) {
    const behind = Math.min(least[at - layer - row], least[at - layer], least[at - layer + row]);
    padded[at] = Math.min(padded[at], 1 + Math.min(padded[at - by], least[at - row], behind));
  }
  for (let at = first; at !== end; at += by) least[at] = Math.min(padded[at - 1], padded[at], padded[at + 1]);
}

/**
 * Return the Chebyshev distance of each cell [z][y][x] to the nearest occupied one, at most 255.
 *
 * Two passes over the grid, one from each end, are exact: a shortest way never turns back (A. Rosenfeld and J. Pfaltz,
 * Distance functions on digital pictures, Pattern Recognition 1, 1968).
 */
export function emptyDistances(occupied: Uint8Array, sizes: readonly number[]): Uint8Array<ArrayBuffer> {
  const [depth, height, width] = sizes;
  // With a border of cells that are far from everything, so that each cell has all its neighbours.
  const row = width + 2;
  const layer = row * (height + 2);
  const padded = new Uint8Array(layer * (depth + 2)).fill(FARTHEST);
  const least = padded.slice(); // of each cell and its two neighbours in the row, for rows that a pass is done with
  const cells: number[] = []; // the first cell of each row, in the padded grid
  for (let z = 0; z < depth; z++) {
    for (let y = 0; y < height; y++) cells.push((z + 1) * layer + (y + 1) * row + 1);
  }
  for (const [number, first] of cells.entries()) {
    for (let x = 0; x < width; x++) if (occupied[number * width + x]) padded[first + x] = 0;
  }
  for (const first of cells) relaxRow(padded, least, { first, width, by: 1, row, layer });
  for (const first of cells.reverse()) {
    relaxRow(padded, least, { first: first + width - 1, width, by: -1, row: -row, layer: -layer });
  }
  cells.reverse();
  const out = new Uint8Array(depth * height * width);
  for (const [number, first] of cells.entries()) out.set(padded.subarray(first, first + width), number * width);
  return out;
}
