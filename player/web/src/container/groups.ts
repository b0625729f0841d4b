/** Clips in groups (section 4.7 of spec/kpc-format.md). */

import type { Core } from '../decoder/core.js';
import { CODEC, Container, type Entry, HEADER_LENGTH, isCritical } from './container.js';
import { FormatError } from './errors.js';
import { META_LIMIT, type Metadata, parseMetadata } from './metadata.js';
import { Scene, type SceneOptions } from './scene.js';
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

/** The groups of a file. A file without GRUP chunks counts as one group. */
export class Groups {
  readonly container: Container;
  /** The frames of each group. */
  readonly spans: Span[];
  readonly first: Scene;
  readonly metadata: Metadata;
  readonly chunks: number[];

  constructor(
    bytes: Uint8Array,
    readonly core: Core,
    readonly options: SceneOptions = {},
  ) {
    this.container = new Container(bytes, options);
    const { index } = this.container;
    const chunks = [...index.keys()].filter((number) => index[number].kind === 'GRUP');
    this.chunks = chunks.sort((a, b) => index[a].group - index[b].group);
    if (this.chunks.length === 0) {
      this.first = new Scene(bytes, core, options);
      this.spans = [{ first: 0, last: this.first.head.frameCount - 1 }];
    } else {
      this.#checkGroups();
      this.spans = this.chunks.map((chunk) => spanOf(index[chunk]));
      checkSpans(this.spans);
      this.first = this.#open(0);
    }
    this.metadata = this.#metadata();
  }

  /** Whether a group is complete. */
  available(number: number): boolean {
    return this.chunks.length === 0 || this.container.available(this.chunks[number]);
  }

  /** Open the scene of a group. */
  open(number: number): Scene {
    return number === 0 ? this.first : this.#open(number);
  }

  /** Return the group shown at a time in [0, 1] of the clip, and the group's own time. */
  at(time: number): { group: number; localTime: number } {
    const current = this.#frame(time);
    let group = 0;
    for (let i = 1; i < this.spans.length; i++) {
      if (current >= (this.spans[i - 1].last + this.spans[i].first) / 2) group = i;
    }
    return { group, localTime: this.#localTime(group, current) };
  }

  /** Return the groups in the picture at a time of the clip, with their own times and shares. */
  blendAt(time: number): Part[] {
    const current = this.#frame(time);
    for (let i = 1; i < this.spans.length; i++) {
      const [first, last] = [this.spans[i].first, this.spans[i - 1].last];
      if (first < current && current < last) {
        const share = (current - first) / (last - first);
        return [
          { group: i - 1, localTime: this.#localTime(i - 1, current), share: 1 - share },
          { group: i, localTime: this.#localTime(i, current), share },
        ];
      }
    }
    return [{ ...this.at(time), share: 1 }];
  }

  #frame(time: number): number {
    const [first, last] = [this.spans[0].first, this.spans[this.spans.length - 1].last];
    return first + time * (last - first);
  }

  #localTime(group: number, current: number): number {
    const { first, last } = this.spans[group];
    return last === first ? 0 : Math.min(Math.max((current - first) / (last - first), 0), 1);
  }

  #open(number: number): Scene {
    const entry = this.container.index[this.chunks[number]];
    const bytes = this.container.bytes.subarray(entry.offset, entry.offset + entry.storedLength);
    const allowPartial = !this.available(number);
    if (allowPartial && bytes.length < HEADER_LENGTH) throw new FormatError(`cut off: group ${number} is not there`);
    const scene = new Scene(bytes, this.core, { ...this.options, allowPartial });
    const { frameCount, fps, valueCount } = scene.head;
    const expected = number === 0 ? fps : this.first.head.fps;
    if (frameCount !== entry.rowCount || fps !== expected) {
      throw new FormatError(
        `group ${number}: holds ${frameCount} frames at ${fps} fps, not ${entry.rowCount} at ${expected}`,
      );
    }
    const most = this.container.header.valueCount;
    if (valueCount > most) {
      throw new FormatError(`group ${number}: holds ${valueCount} values, more than the header's ${most}`);
    }
    return scene;
  }

  #checkGroups() {
    const { index } = this.container;
    for (const [number, entry] of index.entries()) {
      if (entry.kind !== 'GRUP') {
        if (isCritical(entry))
          throw new FormatError(`chunk ${number} (${entry.kind}) lies outside the groups; update kpc`);
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
    if (this.chunks.some((chunk, number) => index[chunk].group !== number)) {
      throw new FormatError('its groups are not numbered consecutively from 0; join them again');
    }
  }

  #metadata(): Metadata {
    if (this.chunks.length === 0) return this.first.metadata;
    const { index } = this.container;
    const found = [...index.keys()].filter((number) => index[number].kind === 'meta');
    if (found.length > 1) throw new FormatError(`holds ${found.length} meta chunks, not one`);
    if (found.length === 0 || !this.container.available(found[0])) return this.first.metadata;
    return parseMetadata(this.container.content(found[0], META_LIMIT));
  }
}

const spanOf = (entry: Entry): Span => ({ first: entry.rowStart, last: entry.rowStart + entry.rowCount - 1 });

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
