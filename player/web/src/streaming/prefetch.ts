/**
 * What a player keeps of a scene, and what it fetches next: the order of the desktop player
 * (player/streaming/prefetch.py).
 *
 *     first   segments at the playhead, of the scales that are shown already
 *     0       scale 0, for a first coarse picture: its space planes, and segments of its time planes at the playhead
 *     1       while the clip plays, segments of scale 0 that will be needed within URGENT_S
 *     2, 3    the same for scale 1, and so on
 *     last    all other segments, in the order in which the playhead reaches them
 *
 * Memory is given to the segments that the playhead reaches first; those behind it are dropped first.
 */

import type { Entry } from '../container/chunk.js';
import { isTimePlane, PLANES, type PlaneHead, type SceneHead } from '../container/scene_chunks.js';

/** Segments that will be needed within so many seconds are fetched before a finer scale. */
const URGENT_S = 1;
/** Tolerance of times, as a share of the clip: renderers compute the rows that a time lies between in float32. */
const TIME_TOLERANCE = 1e-6;

/** The position in a clip, and the share of it that is played in a second; times lie in [0, 1]. */
export interface Playhead {
  time: number;
  rate: number;
  /** Whether the clip begins again after its end. */
  loop: boolean;
  /** Whether a coarse picture at that time is all that is wanted. */
  isPreview?: boolean;
}

/** A segment of a plane, and the times between which it is needed. */
export interface Segment {
  /** The number of its chunk in the index. */
  number: number;
  scale: number;
  isTime: boolean;
  since: number;
  until: number;
  /** Bytes of its symbols. */
  bytes: number;
}

/** Return the segments of a scene in the order of the file. */
export function segmentsOf(index: readonly Entry[], head: SceneHead): Segment[] {
  const found: Segment[] = [];
  for (const [number, entry] of index.entries()) {
    if (entry.kind !== 'PLNE') continue;
    const name = PLANES[entry.plane];
    const { rows, columns, channels } = head.scales[entry.scale][name] as PlaneHead;
    const isTime = isTimePlane(name);
    const last = Math.max(rows - 1, 1);
    const since = isTime ? (entry.rowStart - 1) / last : -1;
    const until = isTime ? (entry.rowStart + entry.rowCount) / last : 2;
    const bytes = entry.rowCount * columns * channels;
    const times = { since: since - TIME_TOLERANCE, until: until + TIME_TOLERANCE };
    found.push({ number, scale: entry.scale, isTime, ...times, bytes });
  }
  return found;
}

/** Whether times from `start` to `end` need a segment. */
export const isNeeded = (segment: Segment, start: number, end: number): boolean =>
  segment.since < end && start < segment.until;

/** Whether the playhead wants a segment at all. */
export const isWanted = (segment: Segment, { time, isPreview }: Playhead): boolean =>
  !isPreview || (segment.scale === 0 && isNeeded(segment, time, time));

/** Return the times, as pairs in [0, 1], that need none of some segments. */
export function timesWithout(segments: readonly Segment[]): [number, number][] {
  const found: [number, number][] = [];
  let from = 0;
  for (const { since, until } of [...segments].sort((a, b) => a.since - b.since)) {
    if (since > from) found.push([from, since]);
    from = Math.max(from, until);
  }
  if (from < 1) found.push([from, 1]);
  return found;
}

/** Return how far ahead of the playhead a segment is needed, as a share of the clip; 0 if it is needed now. */
export function distanceAhead(segment: Segment, { time, loop }: Playhead): number {
  if (isNeeded(segment, time, time)) return 0;
  if (segment.since >= time) return segment.since - time;
  return loop ? 1 + Math.max(segment.since, 0) - time : 2 + time - segment.until;
}

/** Return the positions of segments in the order in which to fetch them; `shown` scales are on the screen. */
export function fetchOrder(segments: readonly Segment[], head: Playhead, shown = 0): number[] {
  const finest = Math.max(0, ...segments.map((segment) => segment.scale));
  const keys = segments.map((segment) => {
    const distance = distanceAhead(segment, head);
    let stage = 2 * finest + 2;
    if (distance === 0) stage = segment.scale < shown ? -1 : 2 * segment.scale;
    else if (distance < head.rate * URGENT_S) stage = 2 * segment.scale + 1;
    return { stage, distance };
  });
  const order = (a: number, b: number) =>
    keys[a].stage - keys[b].stage ||
    keys[a].distance - keys[b].distance ||
    segments[a].scale - segments[b].scale ||
    segments[a].number - segments[b].number;
  return [...segments.keys()].sort(order);
}

/** Return for each segment whether to hold it: those of time planes that fit, nearest first, and all space planes. */
export function segmentsToKeep(segments: readonly Segment[], head: Playhead, availableBytes: number): boolean[] {
  const distances = segments.map((segment) => distanceAhead(segment, head));
  const order = (a: number, b: number) =>
    distances[a] - distances[b] || segments[a].scale - segments[b].scale || segments[a].number - segments[b].number;
  const keep = segments.map(() => true);
  let used = 0;
  for (const position of [...segments.keys()].sort(order)) {
    if (!segments[position].isTime) continue;
    used += segments[position].bytes;
    keep[position] = used <= availableBytes;
  }
  return keep;
}

/** Return the bytes of the segments of time planes that are needed at once, at the time that needs most. */
export function minSegmentBytes(segments: readonly Segment[]): number {
  const changes = segments
    .filter((segment) => segment.isTime)
    .flatMap(({ since, until, bytes }) => [
      { time: since, bytes },
      { time: until, bytes: -bytes },
    ])
    .sort((a, b) => a.time - b.time || b.bytes - a.bytes); // at equal times, beginnings count before ends
  let [held, most] = [0, 0];
  for (const change of changes) {
    held += change.bytes;
    most = Math.max(most, held);
  }
  return most;
}
