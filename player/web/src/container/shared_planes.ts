/** Planes that groups of a clip share: PLNE chunks beside the groups (section 4.7 of spec/kpc-format.md). */

import { CODEC, type Entry } from './chunk.js';
import { FormatError } from './errors.js';
import { LIMIT, PLANES } from './scene_chunks.js';

const PLANE_CODECS: readonly number[] = [CODEC.RAW, CODEC.ZSTD, CODEC.PREDICTIVE, CODEC.TRANSFORM, CODEC.SHARED];

/** Return the shared planes of a clip of so many groups, checked. */
export function sharedPlanes(index: readonly Entry[], groupCount: number): Entry[] {
  const known = new Set<string>();
  const found: Entry[] = [];
  for (const [number, entry] of index.entries()) {
    if (entry.kind !== 'PLNE') continue;
    const { group, scale, plane, rowStart, rowCount, codec } = entry;
    const label = `chunk ${number} (PLNE), the shared plane ${PLANES[plane] ?? plane} of scale ${scale},`;
    if (!PLANE_CODECS.includes(codec)) {
      throw new FormatError(`${label} uses codec ${codec}, unknown to this reader; update kpc`, 'newer');
    }
    const isPlace = group < groupCount && scale < LIMIT.SCALE && plane < PLANES.length;
    if (codec === CODEC.SHARED || !isPlace || rowStart || !rowCount) {
      throw new FormatError(
        `${label} has no rows or no bytes of its own, or a place that no group has: rows from ${rowStart}, ` +
          `${rowCount} of them, for groups from ${group} on; join the clip again`,
      );
    }
    const key = `${group} ${scale} ${plane}`;
    if (known.has(key)) throw new FormatError(`${label} is there twice for group ${group}; join the clip again`);
    known.add(key);
    found.push(entry);
  }
  return found;
}

/** Return the shared plane of each scale and plane that a group may use, by `SCALE PLANE`. */
export function usablePlanes(shared: readonly Entry[], group: number): Map<string, Entry> {
  const usable = new Map<string, Entry>();
  for (const entry of shared) {
    const key = `${entry.scale} ${entry.plane}`;
    if (entry.group <= group && entry.group >= (usable.get(key)?.group ?? 0)) usable.set(key, entry);
  }
  return usable;
}

/** Return where, behind a group of so many bytes, the file of the clip begins for the shared planes of the group. */
export const sharedStart = (groupLength: number): number => groupLength + 1; // not adjacent to chunks of the group

/** Return the index of a group of so many bytes; what is under SHARED has become the shared plane it stands for. */
export function withShared(
  index: readonly Entry[],
  group: number,
  shared: readonly Entry[],
  groupLength: number,
): readonly Entry[] {
  if (!index.some(isShared)) return index;
  const usable = usablePlanes(shared, group);
  return index.map((entry, number) => {
    if (!isShared(entry)) return entry;
    const { scale, plane, rowStart, rowCount, rawLength, storedLength, crc } = entry;
    const label = `chunk ${number} (PLNE)`;
    if (storedLength || rowStart || crc) {
      throw new FormatError(`${label} is shared and has bytes or a first row of its own; join the clip again`);
    }
    const found = usable.get(`${scale} ${plane}`);
    if (found === undefined) {
      throw new FormatError(
        `${label} stands for a shared plane ${plane} of scale ${scale}, which the clip does not have; join the clip again`,
      );
    }
    if (found.rowCount !== rowCount || found.rawLength !== rawLength) {
      throw new FormatError(
        `${label} stands for ${rowCount} rows and a length of ${rawLength}, the shared plane of the clip has ` +
          `${found.rowCount} and ${found.rawLength}; join the clip again`,
      );
    }
    return { ...found, group: entry.group, offset: sharedStart(groupLength) + found.offset };
  });
}

/** Whether a chunk stands for a shared plane. */
export const isShared = ({ kind, codec }: Entry): boolean => kind === 'PLNE' && codec === CODEC.SHARED;
