/** What the renderer needs of a scene; `SceneStream` of src/streaming has it all. */

import {
  type Appearance,
  type DecoderWeights,
  type Mapping,
  type MotionGrid,
  type OccupancyGrid,
  PLANES,
  type PlaneHead,
  type PlaneName,
  type Scale,
  type SceneHead,
} from '../container/scene_chunks.js';

export type SpacePlane = 'xy' | 'xz' | 'yz';
export type TimePlane = 'xt' | 'yt' | 'zt';
export const SPACE_PLANES = PLANES.slice(0, 3) as SpacePlane[];
export const TIME_PLANES = PLANES.slice(3) as TimePlane[];

/** Rows of a space plane: texels [row][layer][column][4], halves or float32. */
export interface PlaneRows {
  scale: number;
  plane: PlaneName;
  firstRow: number;
  rowCount: number;
  texels: Uint16Array | Float32Array;
}

export interface SceneSource {
  readonly head: Pick<SceneHead, 'aabb' | 'background' | 'rayStep' | 'isDynamic' | 'scales'>;
  readonly mapping: Mapping | null;
  readonly motion: MotionGrid | null;
  readonly occupancy: Pick<OccupancyGrid, 'sizes' | 'occupied'>;
  readonly decoder: DecoderWeights;
  readonly appearances: readonly Appearance[];
  /** Grows whenever the picture may have changed: rows have arrived or have been taken. */
  readonly version: number;
  /** Hand out rows of space planes that have arrived, about so many bytes of them, each once. */
  take(bytes: number): Iterable<PlaneRows>;
  /** Return a time plane at a time in [0, 1]: [column][channel], 1 where it has not arrived. */
  row(scale: number, plane: TimePlane, time: number): Float32Array;
  /**
   * Return the distances of the cells [z][y][x] of a slot of the occupancy grid to occupied ones, 255 at most; null as
   * long as they are not known, when `version` will grow.
   */
  distances(slot: number): Uint8Array | null;
  /** Hand out all rows once more. */
  restore(): void;
}

/** Return what a scale says of a plane. */
export function headOf(scale: Scale<PlaneHead>, plane: PlaneName): PlaneHead {
  const head = scale[plane];
  if (head === undefined) throw new RangeError(`the scene has no plane ${plane}`);
  return head;
}

/** Return the longest edge of the box. */
export function extentOf({ head: { aabb } }: SceneSource): number {
  return Math.max(aabb[3] - aabb[0], aabb[4] - aabb[1], aabb[5] - aabb[2]);
}

/** Return which cells [z][y][x] are occupied in a slot of the occupancy grid. */
export function occupiedIn({ occupancy }: Pick<SceneSource, 'occupancy'>, slot: number): Uint8Array {
  const [, depth, height, width] = occupancy.sizes;
  const cells = depth * height * width;
  return occupancy.occupied.subarray(slot * cells, (slot + 1) * cells);
}

/** Return the slot of the occupancy grid that holds at a time in [0, 1]. */
export function occupancySlot({ occupancy }: Pick<SceneSource, 'occupancy'>, time: number): number {
  const [slots] = occupancy.sizes;
  return Math.min(Math.floor(time * slots), slots - 1);
}
