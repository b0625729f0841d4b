/** Clips in groups (section 4.7 of spec/kpc-format.md). */

import type { Core } from '../decoder/core.js';
import type { Entry } from './chunk.js';
import { Container, HEADER_LENGTH } from './container.js';
import { FormatError } from './errors.js';
import { META_LIMIT, type Metadata, parseMetadata } from './metadata.js';
import { Scene, type SceneOptions } from './scene.js';
import type { SceneHead } from './scene_chunks.js';
import { sharedPlanes, sharedStart, usablePlanes, withShared } from './shared_planes.js';
import { groupChunks, groupSpans, Timeline } from './timeline.js';

/** The groups of a file. A file without GRUP chunks counts as one group. */
export class Groups {
  readonly container: Container;
  readonly timeline: Timeline;
  readonly first: Scene;
  readonly metadata: Metadata;
  readonly chunks: number[];
  #sharedPlanes: readonly Entry[] = [];

  constructor(
    bytes: Uint8Array,
    readonly core: Core,
    readonly options: SceneOptions = {},
  ) {
    this.container = new Container(bytes, options);
    const { index } = this.container;
    this.chunks = groupChunks(index);
    if (this.chunks.length === 0) {
      this.first = new Scene(bytes, core, options);
      this.timeline = new Timeline([{ first: 0, last: this.first.head.frameCount - 1 }]);
    } else {
      this.#sharedPlanes = sharedPlanes(index, this.chunks.length);
      this.timeline = new Timeline(groupSpans(index, this.chunks));
      this.first = this.#open(0);
    }
    this.metadata = this.#metadata();
  }

  /** Whether a group is complete, and all planes are there that it may share. */
  available(number: number): boolean {
    if (this.chunks.length === 0) return true;
    const shared = [...usablePlanes(this.#sharedPlanes, number).values()];
    const areThere = shared.every(({ offset, storedLength }) => offset + storedLength <= this.container.bytes.length);
    return areThere && this.container.available(this.chunks[number]);
  }

  /** Open the scene of a group. */
  open(number: number): Scene {
    return number === 0 ? this.first : this.#open(number);
  }

  #open(number: number): Scene {
    const entry = this.container.index[this.chunks[number]];
    const bytes = this.container.bytes.subarray(entry.offset, entry.offset + entry.storedLength);
    const allowPartial = !this.container.available(this.chunks[number]);
    if (allowPartial && bytes.length < HEADER_LENGTH)
      throw new FormatError(`cut off: group ${number} is not there`, 'cut-off');
    const scene = new Scene(bytes, this.core, {
      ...this.options,
      allowPartial,
      ...this.#shared(number, bytes, allowPartial),
    });
    checkGroup(
      number,
      scene.head,
      entry.rowCount,
      this.container.header.valueCount,
      number === 0 ? scene.head.fps : this.first.head.fps,
    );
    return scene;
  }

  /** Return the index of a group with the planes that it shares, and those of them that are there. */
  #shared(number: number, bytes: Uint8Array, allowPartial: boolean) {
    const { header, index: own } = new Container(bytes, { allowPartial });
    const index = withShared(own, number, this.#sharedPlanes, header.fileLength);
    const bodies = new Map<number, Uint8Array>();
    for (const [chunk, { offset, storedLength }] of index.entries()) {
      const start = offset - sharedStart(header.fileLength);
      const body = start < 0 ? null : this.container.bytes.subarray(start, start + storedLength);
      if (body?.length === storedLength) bodies.set(chunk, body);
    }
    return { index, bodies };
  }

  #metadata(): Metadata {
    if (this.chunks.length === 0) return this.first.metadata;
    const { index } = this.container;
    const found = [...index.keys()].filter((number) => index[number].kind === 'meta');
    if (found.length > 1) throw new FormatError(`holds ${found.length} meta chunks, not one`);
    if (found.length === 0 || !this.container.available(found[0])) return this.first.metadata;
    return parseMetadata(this.container.chunk(found[0]).content(META_LIMIT));
  }
}

/** Check that the scene of a group is what the index of the file and the rate of the first group say. */
export function checkGroup(number: number, head: SceneHead, rowCount: number, most: number, fps: number): void {
  if (head.frameCount !== rowCount || head.fps !== fps) {
    throw new FormatError(
      `group ${number}: holds ${head.frameCount} frames at ${head.fps} fps, not ${rowCount} at ${fps}`,
    );
  }
  if (head.valueCount > most) {
    throw new FormatError(`group ${number}: holds ${head.valueCount} values, more than the header's ${most}`);
  }
}
