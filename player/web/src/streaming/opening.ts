/** Opening a scene: header and index, and all chunks but planes. */

import type { Entry } from '../container/chunk.js';
import { Container, HEADER_LENGTH, readHeader } from '../container/container.js';
import { BudgetError, FormatError } from '../container/errors.js';
import { KNOWN_KINDS } from '../container/scene.js';
import { PLANES, type PlaneHead } from '../container/scene_chunks.js';
import type { DecoderPool } from '../decoder/pool.js';
import type { SceneContent } from '../decoder/tasks.js';
import { layerCount } from '../decoder/texels.js';
import { emptyError, reaches, type Source } from './source.js';

/** Read header and index of a file; the index, which is compressed, in a worker, whose time is limited. */
export async function openContainer(source: Source, pool: DecoderPool, signal?: AbortSignal): Promise<Container> {
  const header = await source.read(0, HEADER_LENGTH, { signal });
  if (header.length === 0) throw emptyError(source.name);
  const { indexLength, fileLength } = readHeader(header, true);
  if (source.size !== null && source.size > fileLength) {
    throw new FormatError(`${source.size - fileLength} bytes follow the end of the file`);
  }
  const bytes = await source.read(0, HEADER_LENGTH + indexLength, { signal });
  const index = await pool.run({ kind: 'index', start: bytes }, { signal });
  return new Container(bytes, { allowPartial: true, index });
}

/** Split chunks, in the order given, into runs that lie side by side in the file and take at most so many bytes. */
export function adjacentRuns(index: readonly Entry[], numbers: readonly number[], mostBytes = Infinity): number[][] {
  const found: number[][] = [];
  let [end, size] = [-1, 0];
  for (const number of numbers) {
    const { offset, storedLength } = index[number];
    const run = found[found.length - 1];
    if (run !== undefined && offset === end && size + storedLength <= mostBytes) run.push(number);
    else {
      found.push([number]);
      size = 0;
    }
    end = offset + storedLength;
    size += storedLength;
  }
  return found;
}

/** Whether a chunk is there, as far as is known. */
export const isThere = (entry: Entry, source: Source): boolean => reaches(source, entry.offset + entry.storedLength);

/** Read everything that is in a scene but planes and sound. */
export async function readContent(
  source: Source,
  { header, index, bytes }: Container,
  pool: DecoderPool,
  memory: number,
  signal?: AbortSignal,
): Promise<SceneContent> {
  const numbers = [...index.keys()].filter((number) => {
    const { kind } = index[number];
    const isStreamed = kind === 'PLNE' || kind === 'soun';
    return !isStreamed && KNOWN_KINDS.includes(kind) && isThere(index[number], source);
  });
  const bodies = new Map<number, Uint8Array>();
  for (const run of adjacentRuns(index, numbers)) {
    const [first, last] = [index[run[0]], index[run[run.length - 1]]];
    const end = last.offset + last.storedLength;
    if (end - first.offset > memory) throw new BudgetError(`${source.name}: takes more memory than the budget`);
    const read = await source.read(first.offset, end, { signal });
    for (const number of run) {
      const { offset, storedLength } = index[number];
      const body = read.slice(offset - first.offset, offset - first.offset + storedLength);
      if (body.length === storedLength) bodies.set(number, body);
    }
  }
  const start = bytes.slice(0, HEADER_LENGTH + header.indexLength);
  const isSharing = index.some(({ offset }) => offset > header.fileLength);
  const task = { kind: 'scene', start, index: isSharing ? index : undefined, bodies, memoryBudget: memory } as const;
  return pool.run(task, { signal });
}

/** Bytes that a scene takes whatever is shown of it: textures of planes, and grids. */
export function contentBytes({ head, occupancy, motion }: SceneContent): number {
  const copies = head.isDynamic ? 2 : 1; // space planes as halves, and once more with time rows folded in
  let planes = 0;
  for (const scale of head.scales) {
    for (const name of PLANES.slice(0, 3)) {
      const { rows, columns, channels } = scale[name] as PlaneHead;
      planes += 8 * rows * columns * layerCount(channels) * copies;
    }
  }
  const cells = occupancy.occupied.length * (2 + 1 / occupancy.sizes[0]) + occupancy.content.length;
  const grid = motion ? 4 * motion.displacements.length * (1 + 4 / 3 / motion.sizes[0]) : 0;
  return planes + cells + grid;
}
