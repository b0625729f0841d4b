/** What a worker does for the page: each task says all that is needed, so that any worker can do any task. */

import { Chunk, type Entry } from '../container/chunk.js';
import { readHeader, readIndex } from '../container/container.js';
import { META_LIMIT, type Metadata, parseMetadata } from '../container/metadata.js';
import { Scene } from '../container/scene.js';
import type {
  Appearance,
  Camera,
  DecoderWeights,
  Mapping,
  MotionGrid,
  OccupancyGrid,
  PlaneHead,
  SceneHead,
} from '../container/scene_chunks.js';
import { parseSound, SOUND_LIMIT, type SoundSegment } from '../container/sound.js';
import { emptyDistances } from '../render/atlas.js';
import { loadDriver } from '../render/context.js';
import type { Core } from './core.js';
import { decodeSegment, type Projection } from './segment.js';
import { layerTexels } from './texels.js';

/** Everything that is in a scene but planes. */
export interface SceneContent {
  head: SceneHead;
  mapping: Mapping | null;
  motion: MotionGrid | null;
  occupancy: OccupancyGrid;
  decoder: DecoderWeights;
  cameras: Camera[];
  appearances: Appearance[];
  metadata: Metadata;
}

/** Read the index of a file from its header and index, `start`. */
export interface IndexTask {
  kind: 'index';
  start: Uint8Array;
}

/** Read all of a scene but its planes from header and index, `start`, and stored chunks. */
export interface SceneTask {
  kind: 'scene';
  start: Uint8Array;
  /** The index if it is another than that of `start`, in which planes that groups share are under SHARED. */
  index?: readonly Entry[];
  bodies: ReadonlyMap<number, Uint8Array>;
  memoryBudget: number;
}

/** Read a meta chunk beside groups. */
export interface MetadataTask {
  kind: 'metadata';
  number: number;
  entry: Entry;
  body: Uint8Array;
}

/** Project the occupancy grid, its content under RAW, onto the plane of this number. */
export interface ProjectTask {
  kind: 'project';
  content: Uint8Array;
  plane: number;
  cells: [number, number];
}

/** Decode a segment of a plane: to texels for a texture if `asTexels`, else to symbols. */
export interface SegmentTask {
  kind: 'segment';
  number: number;
  entry: Entry;
  body: Uint8Array;
  plane: PlaneHead;
  projection: Projection | null;
  asTexels: boolean;
}

/** Read a soun chunk of a sound of so many samples in all. */
export interface SoundTask {
  kind: 'sound';
  number: number;
  entry: Entry;
  body: Uint8Array;
  total: number;
}

/** Find how far the cells [z][y][x] of an occupancy grid are from occupied ones. */
export interface DistancesTask {
  kind: 'distances';
  occupied: Uint8Array;
  sizes: readonly number[];
}

/** Load the driver of the graphics card. */
export interface DriverTask {
  kind: 'driver';
}

/** The tasks by their kinds, and what each results in. */
interface Tasks {
  index: [IndexTask, Entry[]];
  scene: [SceneTask, SceneContent];
  metadata: [MetadataTask, Metadata];
  project: [ProjectTask, Projection];
  segment: [SegmentTask, Int8Array<ArrayBuffer> | Uint16Array<ArrayBuffer>];
  sound: [SoundTask, SoundSegment];
  distances: [DistancesTask, Uint8Array<ArrayBuffer>];
  driver: [DriverTask, undefined];
}
export type Task = Tasks[keyof Tasks][0];
export type Result<T extends Task> = Tasks[T['kind']][1];

/** Do a task; return its result, and the buffers of it that are moved to the page instead of being copied. */
export function perform(core: Core, task: Task): { result: Result<Task>; moved: ArrayBuffer[] } {
  switch (task.kind) {
    case 'index':
      return { result: readIndex(task.start, readHeader(task.start, true)), moved: [] };
    case 'scene':
      return readScene(core, task);
    case 'metadata': {
      const chunk = new Chunk(task.number, task.entry, task.body);
      return { result: parseMetadata(chunk.content(META_LIMIT)), moved: [] };
    }
    case 'sound': {
      const content = new Chunk(task.number, task.entry, task.body).content(SOUND_LIMIT);
      return { result: parseSound(content, task.entry.rowCount, task.total), moved: [] };
    }
    case 'distances': {
      const result = emptyDistances(task.occupied, task.sizes);
      return { result, moved: [result.buffer] };
    }
    case 'driver':
      loadDriver();
      return { result: undefined, moved: [] };
    case 'project': {
      const [rows, columns] = task.cells;
      const projected = core.project(task.content, task.plane, rows * columns);
      return { result: { projected, cells: task.cells }, moved: [] };
    }
    case 'segment': {
      const { plane, asTexels } = task;
      const chunk = new Chunk(task.number, task.entry, task.body);
      const { symbols } = decodeSegment(core, chunk, plane, () => task.projection as Projection);
      const result = asTexels ? layerTexels(symbols, plane) : symbols;
      return { result, moved: [result.buffer] };
    }
  }
}

function readScene(core: Core, { start, index, bodies, memoryBudget }: SceneTask) {
  const scene = new Scene(start, core, { allowPartial: true, inParts: true, index, bodies, memoryBudget });
  const { head, mapping, motion, occupancy, decoder, cameras, appearances, metadata } = scene;
  const result = { head, mapping, motion, occupancy, decoder, cameras, appearances, metadata };
  const moved = [occupancy.occupied.buffer as ArrayBuffer];
  if (motion) moved.push(motion.displacements.buffer as ArrayBuffer);
  return { result, moved };
}
