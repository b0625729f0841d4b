/** Which group of a clip is shown when (section 4.7 of spec/kpc-format.md). */

import { CODEC, type Entry, isCritical } from './chunk.js';
import { FormatError } from './errors.js';
import { LIMIT } from './scene_chunks.js';

/** The first and the last frame of a group. */
export interface Span {
  first: number;
  last: number;
}

/** A group in the picture at a time of the clip, with its own time and its share. */
export interface Part {
  group: number;
  localTime: number;
  share: number;
}

/** The frames of all groups. Times of the clip and those of groups lie in [0, 1]. */
export class Timeline {
  readonly spans: readonly Span[];
  /** Frames of the clip. */
  readonly frameCount: number;

  constructor(spans: readonly Span[]) {
    this.spans = spans;
    this.frameCount = spans[spans.length - 1].last - spans[0].first + 1;
  }

  /** Return the group shown at a time, and the group's own time. */
  at(time: number): { group: number; localTime: number } {
    const current = this.#frame(time);
    let group = 0;
    for (let i = 1; i < this.spans.length; i++) if (current >= this.#takeover(i)) group = i;
    return { group, localTime: this.localTime(group, time) };
  }

  /** Return the groups in the picture at a time. */
  blendAt(time: number): Part[] {
    const current = this.#frame(time);
    for (let i = 1; i < this.spans.length; i++) {
      const [first, last] = [this.spans[i].first, this.spans[i - 1].last];
      if (first < current && current < last) {
        const share = (current - first) / (last - first);
        return [
          { group: i - 1, localTime: this.localTime(i - 1, time), share: 1 - share },
          { group: i, localTime: this.localTime(i, time), share },
        ];
      }
    }
    return [{ ...this.at(time), share: 1 }];
  }

  /** Return a group's own time at a time of the clip. */
  localTime(group: number, time: number): number {
    const { first, last } = this.spans[group];
    return last === first ? 0 : Math.min(Math.max((this.#frame(time) - first) / (last - first), 0), 1);
  }

  /** Return the time of the clip at a group's own time. */
  clipTime(group: number, localTime: number): number {
    const { first, last } = this.spans[group];
    const frame = first + localTime * (last - first) - this.spans[0].first;
    return Math.min(Math.max(frame / Math.max(this.frameCount - 1, 1), 0), 1);
  }

  /** Return from when to when a group is the one shown. */
  displaySpan(group: number): [number, number] {
    const share = (frame: number) => (frame - this.spans[0].first) / Math.max(this.frameCount - 1, 1);
    return [
      group === 0 ? 0 : share(this.#takeover(group)),
      group + 1 === this.spans.length ? 1 : share(this.#takeover(group + 1)),
    ];
  }

  #frame(time: number): number {
    return this.spans[0].first + time * (this.frameCount - 1);
  }

  #takeover(group: number): number {
    return (this.spans[group - 1].last + this.spans[group].first) / 2;
  }
}

/** Return the numbers of the GRUP chunks in the order of the groups, checked; none of a file that is one scene. */
export function groupChunks(index: readonly Entry[]): number[] {
  const chunks = [...index.keys()].filter((number) => index[number].kind === 'GRUP');
  if (chunks.length === 0) return [];
  for (const [number, entry] of index.entries()) {
    if (entry.kind !== 'GRUP') {
      // PLNE chunks there are shared planes.
      if (isCritical(entry) && entry.kind !== 'PLNE') {
        throw new FormatError(`chunk ${number} (${entry.kind}) lies outside the groups; update kpc`);
      }
    } else if (
      entry.codec !== CODEC.RAW ||
      entry.rawLength !== entry.storedLength ||
      entry.scale ||
      entry.plane ||
      !entry.rowCount
    ) {
      throw new FormatError(`chunk ${number} (GRUP) has a codec, a plane position or no frames`);
    }
  }
  chunks.sort((a, b) => index[a].group - index[b].group);
  if (chunks.some((chunk, number) => index[chunk].group !== number)) {
    throw new FormatError('its groups are not numbered consecutively from 0; join them again');
  }
  return chunks;
}

/** Return the frames that GRUP chunks say that they hold, checked. */
export function groupSpans(index: readonly Entry[], chunks: readonly number[]): Span[] {
  const spans = chunks.map((chunk) => {
    const { rowStart, rowCount } = index[chunk];
    return { first: rowStart, last: rowStart + rowCount - 1 };
  });
  checkSpans(spans);
  return spans;
}

function checkSpans(spans: Span[]): void {
  for (let g = 0; g + 1 < spans.length; g++) {
    const [before, after] = [spans[g], spans[g + 1]];
    if (!(before.first < after.first && after.first <= before.last + 1 && before.last < after.last)) {
      throw new FormatError(
        `groups ${g} and ${g + 1}: each must begin and end later than the one before, without a gap`,
      );
    }
  }
  for (let g = 0; g + 2 < spans.length; g++) {
    if (spans[g].last >= spans[g + 2].first) {
      throw new FormatError(`group ${g + 2}: a frame may be in two groups at most`);
    }
  }
  const frames = spans[spans.length - 1].last - spans[0].first + 1;
  if (frames > LIMIT.FRAME)
    throw new FormatError(`${frames} frames exceed the limit of ${LIMIT.FRAME}; split the clip`);
}
