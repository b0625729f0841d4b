/**
 * A scene that is arriving: it chooses segments (prefetch.ts), fetches and decodes them, and hands them to a renderer.
 *
 * Segments of time planes stay in memory as symbols and are dropped when the playhead has passed them and the memory is
 * needed; space planes are texels until the renderer takes them, and not held after that.
 */

import type { Container } from '../container/container.js';
import { asKpcError, BudgetError, KpcError } from '../container/errors.js';
import { axisOf } from '../container/scene.js';
import { isTimePlane, PLANES, type PlaneHead, type PlaneName, type Scale } from '../container/scene_chunks.js';
import type { DecoderPool } from '../decoder/pool.js';
import { needsOccupancy, type Projection } from '../decoder/segment.js';
import type { SceneContent } from '../decoder/tasks.js';
import { layerCount } from '../decoder/texels.js';
import { occupancySlot } from '../render/scene_source.js';
import { BegunSource } from './begun.js';
import { CellDistances } from './cell_distances.js';
import { FIRST_BYTES } from './http.js';
import { adjacentRuns, contentBytes, isThere, openContainer, readContent } from './opening.js';
import {
  fetchOrder,
  isNeeded,
  isWanted,
  minSegmentBytes,
  type Playhead,
  type Segment,
  segmentsOf,
  segmentsToKeep,
  timesWithout,
} from './prefetch.js';
import type { SharedPlanes } from './shared_source.js';
import { SoundStream } from './sound_stream.js';
import type { Source } from './source.js';
import { TexelQueue, type TexelRows } from './texel_queue.js';
import { TimePlane } from './time_plane.js';

/** The most that is fetched with one request, so that a jump of the playhead does not wait long. */
const RUN_BYTES = 1 << 18;
const RUN_CHUNKS = 256;
/** The next request is sent when so many bytes of the one before are still to come, so that the line is never idle. */
const OVERLAP_BYTES = 1 << 16;
/** Texels that wait for the renderer, or are being decoded, in bytes; one plane may exceed it. */
const WAITING_BYTES = 1 << 23;
/** Seconds of the clip that must have arrived before playback continues after it had to wait. */
const RESUME_S = 0.5;

export interface SceneStreamOptions {
  /** The group of the clip. */
  group?: number;
  /** The planes that the groups of the clip share; without them, the scene is no group. */
  shared?: SharedPlanes | null;
  /** Bytes that the scene may take, on the graphics card, too. */
  memory: number;
  /** Called when something has come, or has failed. */
  changed?: () => void;
  /** Ends opening. */
  signal?: AbortSignal;
  /** Called with what the scene holds before anything is fetched of it; may throw. */
  check?: (content: SceneContent, container: Container) => void;
}

enum State {
  Wanted,
  Coming,
  Waiting,
  Held,
}

interface Request {
  positions: Set<number>;
  control: AbortController;
  remaining: number;
}

export class SceneStream {
  /** The group of the clip. */
  readonly group: number;
  /** Grows whenever the picture may have changed. */
  version = 0;
  /** Why nothing more will come; null if it will. */
  error: KpcError | null = null;
  readonly sound: SoundStream;
  readonly #source: Source;
  readonly #pool: DecoderPool;
  readonly #container: Container;
  readonly #content: SceneContent;
  readonly #changed: () => void;
  readonly #segments: Segment[];
  readonly #state: Uint8Array;
  readonly #isMissing: boolean[]; // beyond the end of a file that is cut off
  readonly #segmentMemory: number;
  readonly #exceedsMemory: boolean;
  readonly #timePlanes: Scale<TimePlane>[];
  readonly #projections = new Map<PlaneName, Promise<Projection>>();
  readonly #distances: CellDistances;
  readonly #requests = new Set<Request>();
  #keep: boolean[];
  #head: Playhead = { time: 0, rate: 0, loop: true };
  readonly #texels = new TexelQueue();
  #isStalled = true;
  readonly #ending = new AbortController();
  #isResting = false;

  private constructor(
    source: Source,
    pool: DecoderPool,
    container: Container,
    content: SceneContent,
    options: SceneStreamOptions,
  ) {
    const { group = 0, memory, changed = () => {} } = options;
    this.group = group;
    [this.#source, this.#pool, this.#container, this.#content] = [source, pool, container, content];
    this.#changed = changed;
    this.sound = new SoundStream(source, pool, container.index);
    this.#segments = segmentsOf(container.index, content.head);
    this.#state = new Uint8Array(this.#segments.length);
    this.#isMissing = this.#segments.map((segment) => !isThere(container.index[segment.number], source));
    const [fixed, least] = [this.fixedBytes, minSegmentBytes(this.#segments)];
    if (fixed + least > memory) {
      throw new BudgetError(`${source.name}: playing takes ${fixed + least} bytes, more than the budget of ${memory}`);
    }
    this.#segmentMemory = memory - fixed;
    this.#distances = new CellDistances(content, pool, (error) => {
      if (error) return this.#fail(error);
      this.version++;
      this.#changed();
    });
    const fitting = segmentsToKeep(this.#segments, this.#head, this.#segmentMemory);
    this.#exceedsMemory = fitting.includes(false);
    this.#keep = fitting.map((fits, position) => fits && !this.#isMissing[position]);
    this.#timePlanes = content.head.scales.map((scale) => {
      const planes: Scale<TimePlane> = {};
      for (const name of PLANES) {
        const head = scale[name];
        if (head && isTimePlane(name)) planes[name] = new TimePlane(head);
      }
      return planes;
    });
    for (const { number, isTime } of this.#segments) {
      const { rowStart, rowCount } = container.index[number];
      if (isTime) this.#timePlane(number).list(rowStart, rowCount);
    }
  }

  /** Open a scene: wait for its header, its index and all chunks but planes, which `setPlayhead` lets come. */
  static async open(source: Source, pool: DecoderPool, options: SceneStreamOptions): Promise<SceneStream> {
    const { group = 0, shared, signal } = options;
    const begun = new BegunSource(source, FIRST_BYTES);
    try {
      const own = await openContainer(begun, pool, signal);
      const { source: whole, container } = shared?.join(begun, own, group) ?? { source: begun, container: own };
      const content = await readContent(whole, container, pool, options.memory, signal);
      options.check?.(content, container);
      return new SceneStream(whole, pool, container, content, options);
    } catch (error) {
      begun.close();
      throw error;
    }
  }

  get head(): SceneContent['head'] {
    return this.#content.head;
  }
  get mapping(): SceneContent['mapping'] {
    return this.#content.mapping;
  }
  get motion(): SceneContent['motion'] {
    return this.#content.motion;
  }
  get occupancy(): SceneContent['occupancy'] {
    return this.#content.occupancy;
  }
  get decoder(): SceneContent['decoder'] {
    return this.#content.decoder;
  }
  get cameras(): SceneContent['cameras'] {
    return this.#content.cameras;
  }
  get appearances(): SceneContent['appearances'] {
    return this.#content.appearances;
  }
  get metadata(): SceneContent['metadata'] {
    return this.#content.metadata;
  }

  /** Set the position in the scene. A jump cancels requests that the picture does not wait for. */
  setPlayhead(head: Playhead): void {
    this.#head = head;
    this.#isResting = false;
    this.distances(occupancySlot(this, head.time)); // before there are planes for workers to decode
    if (this.#exceedsMemory) {
      const fitting = segmentsToKeep(this.#segments, head, this.#segmentMemory);
      this.#keep = fitting.map((fits, position) => fits && !this.#isMissing[position]);
      this.#drop();
    }
    const shown = Math.max(this.completeScales, 1);
    const isUrgent = (position: number) => {
      const segment = this.#segments[position];
      return this.#keep[position] && segment.scale < shown && isNeeded(segment, head.time, head.time);
    };
    const waits = (position: number) => this.#state[position] === State.Wanted && isUrgent(position);
    const requests = [...this.#requests];
    if (requests.length && [...this.#segments.keys()].some(waits)) {
      if (!requests.some((request) => [...request.positions].some(isUrgent))) {
        for (const request of requests) request.control.abort();
      }
    }
    this.#schedule();
  }

  /** Ask for nothing more until the next `setPlayhead`: the line is for another scene. */
  rest(): void {
    this.#isResting = true;
    for (const request of this.#requests) request.control.abort();
  }

  /** Take finished rows of space planes, at most so many bytes or one row. */
  take(mostBytes: number): TexelRows[] {
    const finished = (position: number) => {
      this.#state[position] = State.Held;
    };
    const taken = this.#texels.take(mostBytes, finished, (position) => this.#isEarly(position));
    if (taken.length) {
      this.version++;
      this.#schedule();
    }
    return taken;
  }

  /** Return a time plane at a time in [0, 1], interpolated, as [column][channel]; where it is missing, 1. */
  row(scale: number, plane: PlaneName, time: number, out?: Float32Array): Float32Array {
    const found = this.#timePlanes[scale]?.[plane];
    if (found === undefined) throw new RangeError(`scale ${scale} has no time plane ${plane}`);
    return found.sample(time, out);
  }

  /** Return the distances of a slot's cells to occupied ones, or null while a worker finds them. */
  distances(slot: number): Uint8Array | null {
    return this.#distances.of(slot);
  }

  /** Hand out all space planes again: the renderer has lost them. */
  restore(): void {
    this.#texels.rewind();
    for (const [position, segment] of this.#segments.entries()) {
      if (!segment.isTime && this.#state[position] === State.Held) this.#state[position] = State.Wanted;
    }
    this.version++;
    this.#schedule();
  }

  /** The number of scales, from the coarsest on, whose space planes have been taken. */
  get completeScales(): number {
    let least = this.head.scales.length;
    for (const [position, { isTime, scale }] of this.#segments.entries()) {
      if (!isTime && this.#state[position] !== State.Held) least = Math.min(least, scale);
    }
    return least;
  }

  /** Whether all is held that the scales on the screen, and scale 0 at least, need from `start` to `end`. */
  holds(start: number, end: number): boolean {
    const shown = Math.max(this.completeScales, 1);
    return !this.#lacking(start, end).some(({ scale }) => scale < shown);
  }

  /** Whether the picture at a time can be drawn; after a wait, only once the next RESUME_S are there, too. */
  canShow(time: number, rate = 0): boolean {
    this.#isStalled = !this.holds(time, this.#isStalled ? Math.min(time + rate * RESUME_S, 1) : time);
    return !this.#isStalled;
  }

  /** Whether everything that fits the memory is held, or nothing more will come. */
  get isSettled(): boolean {
    if (this.error !== null) return true;
    const isHeld = this.#keep.every((keep, position) => !keep || this.#state[position] === State.Held);
    return isHeld && !this.#distances.arePending;
  }

  /** Whether the file ends before the coarsest scale does, so that nothing is there to be seen. */
  get lacksPicture(): boolean {
    return this.#segments.some(({ isTime, scale }, position) => !isTime && scale === 0 && this.#isMissing[position]);
  }

  /** The share of the bytes of all planes that is held. */
  get loadedFraction(): number {
    let [held, all] = [0, 0];
    for (const [position, { number }] of this.#segments.entries()) {
      const { storedLength } = this.#container.index[number];
      all += storedLength;
      if (this.#state[position] === State.Held) held += storedLength;
    }
    return all ? held / all : 1;
  }

  /** The times, as pairs in [0, 1], for which all is held that the scales on the screen need. */
  get buffered(): [number, number][] {
    const complete = this.completeScales;
    if (complete === 0) return [];
    const isGap = (position: number) => this.#state[position] !== State.Held;
    return timesWithout(this.#segments.filter((one, position) => one.scale < complete && isGap(position)));
  }

  /** Bytes of the segments of time planes that are held or coming. */
  get heldBytes(): number {
    return this.#segments.reduce((sum, { isTime, bytes }, position) => {
      return isTime && this.#state[position] !== State.Wanted ? sum + bytes : sum;
    }, 0);
  }

  /** Bytes that the scene takes beside segments of time planes: textures, grids, sound, texels that wait, requests. */
  get fixedBytes(): number {
    const largest = Math.max(...this.#segments.map(({ number }) => this.#texelBytes(number)));
    const stored = Math.max(...this.#container.index.map((entry) => (entry.kind === 'PLNE' ? entry.storedLength : 0)));
    const coming = WAITING_BYTES + largest + FIRST_BYTES + 2 * (RUN_BYTES + stored);
    return contentBytes(this.#content) + this.sound.memoryBytes + coming;
  }

  /** End all requests and let go of everything. */
  close(): void {
    this.#ending.abort();
    this.sound.close();
    this.#source.close();
    for (const request of this.#requests) request.control.abort();
    for (const scale of this.#timePlanes) for (const plane of Object.values(scale)) plane.clear();
    this.#texels.clear();
  }

  /** Return the segments that are needed from `start` to `end` and still to come. */
  #lacking(start: number, end: number): Segment[] {
    const isLacking = (position: number) => this.#keep[position] && this.#state[position] !== State.Held;
    return this.#segments.filter((one, position) => isLacking(position) && isNeeded(one, start, end));
  }

  /** Whether a segment is the last space plane of a finer scale, for whose time planes playing would have to wait. */
  #isEarly(position: number): boolean {
    const { scale } = this.#segments[position];
    const { time, rate } = this.#head;
    const lacking = this.#lacking(time, Math.min(time + rate * RESUME_S, 1)).filter((one) => one.scale === scale);
    return scale > 0 && lacking.length > 1 && lacking.filter(({ isTime }) => !isTime).length === 1;
  }

  #planeOf(number: number): { name: PlaneName; plane: PlaneHead } {
    const { scale, plane } = this.#container.index[number];
    const name = PLANES[plane];
    return { name, plane: this.head.scales[scale][name] as PlaneHead };
  }

  #timePlane(number: number): TimePlane {
    const { name } = this.#planeOf(number);
    return this.#timePlanes[this.#container.index[number].scale][name] as TimePlane;
  }

  #texelBytes(number: number): number {
    const { plane } = this.#planeOf(number);
    return 8 * plane.columns * layerCount(plane.channels) * this.#container.index[number].rowCount;
  }

  /** Drop segments of time planes that are not to be kept. */
  #drop(): void {
    for (const [position, { isTime, number }] of this.#segments.entries()) {
      if (!isTime || this.#keep[position] || this.#state[position] !== State.Held) continue;
      this.#timePlane(number).drop(this.#container.index[number].rowStart);
      this.#state[position] = State.Wanted;
    }
  }

  /** Begin the requests that there is room for. */
  #schedule(): void {
    while (!this.#ending.signal.aborted && !this.#isResting && this.error === null) {
      const requests = [...this.#requests];
      const remaining = requests.reduce((sum, request) => sum + request.remaining, 0);
      if (requests.length > 1 || remaining > OVERLAP_BYTES) return;
      const run = this.#nextRun();
      if (run.length === 0) return;
      this.#request(run);
    }
  }

  /** Return the positions of segments to fetch with one request, as far as there is memory for them. */
  #nextRun(): number[] {
    if (!this.#keep.some((keep, position) => keep && this.#state[position] === State.Wanted)) return [];
    const wanted = fetchOrder(this.#segments, this.#head, this.completeScales)
      .filter((position) => this.#keep[position] && this.#state[position] === State.Wanted)
      .filter((position) => isWanted(this.#segments[position], this.#head))
      .slice(0, RUN_CHUNKS);
    const positions = new Map(wanted.map((position) => [this.#segments[position].number, position]));
    const [run = []] = adjacentRuns(this.#container.index, [...positions.keys()], RUN_BYTES);
    let [texels, symbols] = [0, 0];
    for (const [position, { isTime, number, bytes }] of this.#segments.entries()) {
      if (isTime && this.#state[position] !== State.Wanted) symbols += bytes;
      if (!isTime && (this.#state[position] === State.Coming || this.#state[position] === State.Waiting)) {
        texels += this.#texelBytes(number);
      }
    }
    const fitting: number[] = [];
    for (const number of run) {
      const position = positions.get(number) as number;
      const { isTime, bytes } = this.#segments[position];
      if (isTime ? symbols + bytes > this.#segmentMemory : texels > 0 && texels >= WAITING_BYTES) break;
      if (isTime) symbols += bytes;
      else texels += this.#texelBytes(number);
      fitting.push(position);
    }
    return fitting;
  }

  /** Fetch segments that lie side by side, and decode each as soon as it is there. */
  async #request(run: number[]): Promise<void> {
    const entries = run.map((position) => this.#container.index[this.#segments[position].number]);
    const start = entries[0].offset;
    const ends = entries.map((entry) => entry.offset + entry.storedLength - start);
    const length = ends[ends.length - 1];
    const request: Request = { positions: new Set(run), control: new AbortController(), remaining: length };
    this.#requests.add(request);
    for (const position of run) this.#state[position] = State.Coming;
    let done = 0;
    const arrived = (bytes: Uint8Array) => {
      request.remaining = length - bytes.length;
      for (; done < run.length && ends[done] <= bytes.length; done++) {
        request.positions.delete(run[done]);
        this.#decode(run[done], bytes.slice(entries[done].offset - start, ends[done]));
      }
      if (request.remaining <= OVERLAP_BYTES) this.#schedule();
    };
    try {
      await this.#source.read(start, start + length, { signal: request.control.signal, arrived });
      // The server has said meanwhile that the file ends before.
      for (const position of run.slice(done)) this.#isMissing[position] = true;
      if (done < run.length) this.#changed();
    } catch (error) {
      if (!request.control.signal.aborted) this.#fail(error);
    }
    this.#requests.delete(request);
    for (const position of run.slice(done)) {
      this.#state[position] = State.Wanted;
      this.#keep[position] &&= !this.#isMissing[position];
    }
    this.#schedule();
  }

  /** Decode a segment; one that came damaged is fetched a second time. */
  async #decode(position: number, body: Uint8Array<ArrayBuffer>, isSecond = false): Promise<void> {
    const { number, isTime, scale } = this.#segments[position];
    const entry = this.#container.index[number];
    const { name, plane } = this.#planeOf(number);
    try {
      const projection = needsOccupancy(entry.codec, body) ? await this.#projection(name) : null;
      const task = { kind: 'segment', number, entry, body, plane, projection, asTexels: !isTime } as const;
      const numbers = entry.rowCount * plane.columns * plane.channels;
      // Coarse scales first, also of those that waited for a projection.
      const options = { numbers, rank: scale, moved: [body.buffer], signal: this.#ending.signal };
      const result = await this.#pool.run(task, options);
      if (this.#ending.signal.aborted) return;
      if (result instanceof Uint16Array) {
        const { columns, channels } = plane;
        this.#texels.add(position, { scale, plane: name, columns, layers: layerCount(channels) }, result);
        this.#state[position] = State.Waiting;
      } else {
        this.#timePlane(number).put(entry.rowStart, result);
        this.#state[position] = State.Held;
        this.#drop();
      }
      this.version++;
      this.#changed();
      this.#schedule();
    } catch (error) {
      if (this.#ending.signal.aborted) return;
      if (isSecond || !(error instanceof KpcError) || error.code !== 'damaged') return this.#fail(error);
      const { offset, storedLength } = entry;
      try {
        const again = await this.#source.read(offset, offset + storedLength, { fresh: true });
        await this.#decode(position, again.slice(), true);
      } catch (failure) {
        this.#fail(failure);
      }
    }
  }

  #projection(name: PlaneName): Promise<Projection> {
    let found = this.#projections.get(name);
    if (found === undefined) {
      const { sizes, content } = this.occupancy;
      const cells: [number, number] = [sizes[axisOf(name[1])], sizes[axisOf(name[0])]];
      const task = { kind: 'project', content, plane: PLANES.indexOf(name), cells } as const;
      found = this.#pool.run(task, { signal: this.#ending.signal });
      this.#projections.set(name, found);
    }
    return found;
  }

  #fail(error: unknown): void {
    if (this.#ending.signal.aborted || this.error !== null) return;
    this.error = asKpcError(error);
    this.#changed();
  }
}
