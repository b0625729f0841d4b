/**
 * A clip that is arriving: a scene, or groups of which the one that is shown and the next one are held.
 *
 * The next group is opened well before it is shown; others are released, so that memory stays under the budget however
 * long the clip is.
 */

import { HEADER_LENGTH } from '../container/container.js';
import { asKpcError, BudgetError, FormatError, KpcError } from '../container/errors.js';
import { checkGroup } from '../container/groups.js';
import type { Metadata } from '../container/metadata.js';
import type { Camera, SceneHead } from '../container/scene_chunks.js';
import { sharedPlanes } from '../container/shared_planes.js';
import { groupChunks, groupSpans, type Part, Timeline } from '../container/timeline.js';
import { DecoderPool, type PoolOptions } from '../decoder/pool.js';
import { addressOf } from './address.js';
import { type HttpOptions, HttpSource } from './http.js';
import { openContainer } from './opening.js';
import type { Playhead } from './prefetch.js';
import { SceneStream } from './scene_stream.js';
import { SharedPlanes } from './shared_source.js';
import { BlobSource, BytesSource, SlicedSource, type Source } from './source.js';

/** The memory that a clip may take where the page does not say. */
export const DEFAULT_MEMORY = 2 ** 29;
/** The next group is opened so many seconds before it is shown, even if the one that is shown is still arriving. */
const OPEN_AHEAD_S = 5;
/** Seconds over which the rate of arriving bytes is averaged. */
const RATE_OVER_S = 1;

export interface ClipOptions extends Pick<HttpOptions, 'fetch' | 'timeoutMs' | 'firstPauseMs'> {
  /** Bytes that the clip may take, on the graphics card, too. */
  memory?: number;
  /** Where to begin; null: planes wait for `setPlayhead`. */
  position?: ClipPosition | null;
  /** Ends opening. */
  signal?: AbortSignal;
  /** Workers that other clips use, too, or what to start workers with. */
  pool?: DecoderPool | PoolOptions;
}

/** A position in seconds, the speed at which the clip is played (0 while it is paused), and whether it begins again. */
export interface ClipPosition {
  time: number;
  rate?: number;
  loop?: boolean;
  /** Whether a coarse picture at that time is all that is wanted. */
  isPreview?: boolean;
}

/** A scene in the picture, its own time in [0, 1], and its share of colour and opacity. */
export interface ScenePart {
  scene: SceneStream;
  time: number;
  share: number;
}

export class SceneEvent extends Event {
  constructor(
    type: string,
    readonly scene: SceneStream,
  ) {
    super(type);
  }
}

/** What does not change while a clip is open. */
interface Opened {
  source: Source;
  /** Bytes that the source has if it is whole. */
  fileLength: number;
  pool: DecoderPool;
  ownsPool: boolean;
  timeline: Timeline;
  /** The file of each group. */
  files: Source[];
  /** The planes that groups share; null of a single scene. */
  shared: SharedPlanes | null;
  /** Checks what a group holds. */
  check: (group: number, head: SceneHead) => void;
  memory: number;
}

/**
 * See README.md. Events: `arrived`, something has come; `open` and `release` with a `scene`, a group is held from now
 * on, or not any more; `error`, nothing more will come.
 */
export class Clip extends EventTarget {
  readonly fps: number;
  readonly frameCount: number;
  /** Seconds from the first frame to the last. */
  readonly duration: number;
  readonly timeline: Timeline;
  readonly cameras: Camera[];
  readonly metadata: Metadata;
  readonly #opened: Opened;
  #shown: SceneStream;
  #next: SceneStream | null = null;
  #opening: { group: number; control: AbortController } | null = null;
  #position: Playhead = { time: 0, rate: 0, loop: true };
  #trouble: string | null = null;
  /** Groups of which the file, which is cut off, has nothing to show. */
  readonly #missing = new Set<number>();
  #error: KpcError | null = null;
  #earlierVersions = 0;
  #history: { at: number; received: number }[] = [];
  #isClosed = false;
  #hasReported = false;
  #hasWarned = false;

  private constructor(opened: Opened, first: SceneStream, metadata: Metadata | null) {
    super();
    this.#opened = opened;
    this.#shown = first;
    this.timeline = opened.timeline;
    this.fps = first.head.fps;
    this.frameCount = opened.timeline.frameCount;
    this.duration = (this.frameCount - 1) / this.fps;
    this.cameras = first.cameras;
    this.metadata = metadata ?? first.metadata;
    if (opened.source instanceof HttpSource) {
      opened.source.attempts = Number.POSITIVE_INFINITY;
      opened.source.report = (message) => {
        this.#trouble = message;
        this.#arrived();
      };
    }
  }

  /** Open a clip: an address, or a file that the page has. */
  static async open(src: string | URL | Blob | ArrayBuffer, options: ClipOptions = {}): Promise<Clip> {
    const { memory = DEFAULT_MEMORY, signal } = options;
    const ownsPool = !(options.pool instanceof DecoderPool);
    const pool =
      options.pool instanceof DecoderPool
        ? options.pool
        : new DecoderPool({ memory: Math.floor(memory / 4), ...options.pool });
    pool.warm();
    let source: Source | null = null;
    try {
      source = await sourceOf(src, { ...options, limit: Math.floor(memory / 2) });
      const clip = await Clip.#open(source, pool, ownsPool, memory, signal);
      const { position = { time: 0 } } = options;
      if (position) clip.setPlayhead(position);
      return clip;
    } catch (error) {
      if (ownsPool) pool.close();
      source?.close();
      throw asKpcError(error);
    }
  }

  static async #open(
    source: Source,
    pool: DecoderPool,
    ownsPool: boolean,
    memory: number,
    signal?: AbortSignal,
  ): Promise<Clip> {
    const container = await openContainer(source, pool, signal);
    const { index, header } = container;
    const chunks = groupChunks(index);
    const isSingle = chunks.length === 0;
    const isWhole = source instanceof HttpSource && !source.hasRanges;
    // What the page has, or has received as a whole, is not kept twice.
    const sharedLimit = source instanceof HttpSource && !isWhole ? Math.floor(memory / 8) : 0;
    const shared = isSingle ? null : new SharedPlanes(source, sharedPlanes(index, chunks.length), sharedLimit);
    const kept = pool.memory + (isWhole ? header.fileLength : source.memoryBytes) + (shared?.mostBytes ?? 0);
    const opened: Opened = {
      source,
      fileLength: header.fileLength,
      pool,
      ownsPool,
      timeline: new Timeline(isSingle ? [{ first: 0, last: 0 }] : groupSpans(index, chunks)),
      files: isSingle
        ? [source]
        : chunks.map((chunk, group) => {
            const { offset, storedLength } = index[chunk];
            return new SlicedSource(source, offset, storedLength, `${source.name}, group ${group}`);
          }),
      shared,
      check: (group, head) => {
        if (isSingle) return;
        checkGroup(group, head, index[chunks[group]].rowCount, header.valueCount, clip?.fps ?? head.fps);
      },
      memory: (memory - kept) / (isSingle ? 1 : 2),
    };
    if (opened.memory <= 0) throw new BudgetError(`${source.name}: takes more than the budget of ${memory} bytes`);
    let clip: Clip | null = null;
    const beside = isSingle ? null : await metadataBeside(source, container, pool, signal);
    const first = await openGroup(
      opened,
      0,
      () => {
        if (clip) clip.#arrived();
      },
      signal,
    );
    if (isSingle) opened.timeline = new Timeline([{ first: 0, last: first.head.frameCount - 1 }]);
    clip = new Clip(opened, first, beside);
    return clip;
  }

  /** The scenes that are held: the one that is shown, and the next one, whose texels a renderer should take, too. */
  get scenes(): SceneStream[] {
    return this.#next ? [this.#shown, this.#next] : [this.#shown];
  }

  /** Set the position: what is fetched, shown and released follows from it. */
  setPlayhead({ time, rate = 0, loop = true, isPreview = false }: ClipPosition): void {
    if (this.#isClosed) return;
    const share = this.#shareAt(time);
    this.#position = { time: share, rate: this.duration > 0 ? rate / this.duration : 0, loop, isPreview };
    const { group } = this.#partAt(share);
    if (this.#next?.group === group && this.#canSwitchTo(this.#next)) this.#switch();
    const blended = this.#blendAt(share).find((part) => part.group !== this.#shown.group)?.group;
    const isWaiting = group !== this.#shown.group;
    const wanted = isWaiting ? group : (blended ?? this.#groupAfter());
    if (this.#next && this.#next.group !== wanted) this.#release();
    if (this.#opening && this.#opening.group !== wanted) {
      this.#opening.control.abort();
      this.#opening = null;
    }
    const isUrgent = isWaiting || blended !== undefined || (!isPreview && rate > 0 && this.#isNearEnd());
    if (wanted !== undefined && !this.#next && (isUrgent || this.#shown.isSettled)) this.#begin(wanted);
    if (isWaiting) this.#shown.rest();
    else this.#shown.setPlayhead(this.#headIn(this.#shown.group));
    this.#next?.setPlayhead(this.#headIn(this.#next.group));
  }

  /** Return what makes the picture at a time in seconds, as far as it is held. */
  parts(time: number): ScenePart[] {
    const share = this.#shareAt(time);
    const parts: ScenePart[] = [];
    for (const part of this.#blendAt(share)) {
      const scene = this.scenes.find(({ group }) => group === part.group);
      if (scene && (scene === this.#shown || scene.holds(part.localTime, part.localTime))) {
        parts.push({ scene, time: part.localTime, share: part.share });
      }
    }
    const whole = parts.reduce((sum, part) => sum + part.share, 0);
    if (whole > 1 - 1e-9) return parts;
    return [{ scene: this.#shown, time: this.timeline.localTime(this.#shown.group, share), share: 1 }];
  }

  /** Whether the picture at a time in seconds can be drawn; after a wait, only once the next half second is there. */
  canShow(time: number): boolean {
    const share = this.#shareAt(time);
    const { group, localTime } = this.#partAt(share);
    if (group !== this.#shown.group || !this.#shown.canShow(localTime, this.#headIn(group).rate)) return false;
    return this.error !== null || this.parts(time).length === this.#blendAt(share).length;
  }

  /** The times that can be drawn, as pairs of seconds. */
  get buffered(): [number, number][] {
    const found: [number, number][] = [];
    for (const scene of this.scenes.sort((a, b) => a.group - b.group)) {
      const [from, until] = this.timeline.displaySpan(scene.group);
      for (const [first, last] of scene.buffered) {
        // A group is shown until the next one begins, which may be after its last frame.
        const start = first > 0 ? Math.max(this.timeline.clipTime(scene.group, first), from) : from;
        const end = last < 1 ? Math.min(this.timeline.clipTime(scene.group, last), until) : until;
        const seconds: [number, number] = [start * this.duration, end * this.duration];
        const before = found[found.length - 1];
        if (seconds[0] > seconds[1]) continue;
        if (before && seconds[0] <= before[1] + 1e-6) before[1] = seconds[1];
        else found.push(seconds);
      }
    }
    return found;
  }

  /** Grows whenever the picture may have changed. */
  get version(): number {
    return this.#earlierVersions + this.scenes.reduce((sum, scene) => sum + scene.version, 0);
  }

  /** Whether everything of the scenes that are held has come, or nothing more will. */
  get isSettled(): boolean {
    return this.error !== null || this.scenes.every((scene) => scene.isSettled);
  }

  /** Why nothing more will come; null if it will. */
  get error(): KpcError | null {
    return this.#error ?? this.#shown.error ?? this.#next?.error ?? null;
  }

  /** A line about trouble with the connection, or about what the picture waits for; null without. */
  get message(): string | null {
    if (this.error) return `loading stopped: ${this.error.message}`;
    if (this.#trouble) return this.#trouble;
    const { group, localTime } = this.#partAt(this.#position.time);
    const isWaiting = group !== this.#shown.group || !this.#shown.holds(localTime, localTime);
    return isWaiting ? `loading, ${Math.round(this.bytesPerSecond / 1000)} KB/s` : null;
  }

  /** A line about a file whose end is missing; null if it is whole. */
  get notice(): string | null {
    const { source, fileLength } = this.#opened;
    if (source.size === null || source.size >= fileLength) return null;
    return `cut off at ${counted(source.size)} of ${counted(fileLength)} bytes; what is there is played`;
  }

  /** Bytes that have come. */
  get receivedBytes(): number {
    return this.#opened.source.receivedBytes;
  }

  /** Bytes that came in the last second. */
  get bytesPerSecond(): number {
    const now = performance.now() / 1000;
    this.#history.push({ at: now, received: this.receivedBytes });
    while (this.#history[0].at < now - RATE_OVER_S) this.#history.shift();
    const { at, received } = this.#history[0];
    return now > at ? (this.receivedBytes - received) / (now - at) : 0;
  }

  /** Bytes that the clip takes, as far as the budget counts them. */
  get memoryBytes(): number {
    const { pool, source, shared } = this.#opened;
    const kept = pool.memory + source.memoryBytes + (shared?.memoryBytes ?? 0);
    return this.scenes.reduce((sum, scene) => sum + scene.fixedBytes + scene.heldBytes, kept);
  }

  /** End requests and workers. */
  close(): void {
    if (this.#isClosed) return;
    this.#isClosed = true;
    this.#opening?.control.abort();
    for (const scene of this.scenes) {
      scene.close();
      this.dispatchEvent(new SceneEvent('release', scene));
    }
    this.#opened.source.close();
    if (this.#opened.ownsPool) this.#opened.pool.close();
  }

  /** Return a time in seconds as a share of the clip, whose rate may be anything above 0. */
  #shareAt(seconds: number): number {
    const share = seconds / this.duration;
    return Number.isFinite(share) ? Math.min(Math.max(share, 0), 1) : 0;
  }

  #arrived(): void {
    if (this.#isClosed) return;
    if (this.#next?.lacksPicture) this.#lose(this.#next.group);
    if (this.#shown.lacksPicture) this.#error ??= pictureError();
    if (this.notice !== null && !this.#hasWarned) {
      this.#hasWarned = true;
      console.warn(`kpc-player: ${this.#opened.source.name}: ${this.notice}`);
    }
    this.dispatchEvent(new Event('arrived'));
    if (this.error && !this.#hasReported) {
      this.#hasReported = true;
      this.dispatchEvent(new Event('error'));
    }
  }

  /** Return the group shown at a share of the clip, with its own time; the one before, if the file has it not. */
  #partAt(share: number): Part {
    let { group } = this.timeline.at(share);
    while (group > 0 && this.#missing.has(group)) group--;
    return { group, localTime: this.timeline.localTime(group, share), share: 1 };
  }

  /** Return the groups in the picture at a share of the clip, as far as the file has them. */
  #blendAt(share: number): Part[] {
    const parts = this.timeline.blendAt(share);
    return parts.some(({ group }) => this.#missing.has(group)) ? [this.#partAt(share)] : parts;
  }

  /** The group after the one that is shown; undefined after the last. */
  #groupAfter(): number | undefined {
    const { group } = this.#shown;
    for (let after = group + 1; after < this.timeline.spans.length; after++) {
      if (!this.#missing.has(after)) return after;
    }
    return this.#position.loop && group > 0 ? 0 : undefined;
  }

  /** Play without a group that the file has not. */
  #lose(group: number): void {
    this.#missing.add(group);
    this.#earlierVersions++;
    if (this.#next?.group === group) this.#release();
  }

  #isNearEnd(): boolean {
    const [, until] = this.timeline.displaySpan(this.#shown.group);
    return (until - this.#position.time) * this.duration < OPEN_AHEAD_S;
  }

  #canSwitchTo(scene: SceneStream): boolean {
    const { time, rate } = this.#headIn(scene.group);
    return scene.completeScales > 0 && scene.canShow(time, rate);
  }

  #switch(): void {
    [this.#shown, this.#next] = [this.#next as SceneStream, this.#shown];
    this.#earlierVersions++;
  }

  #headIn(group: number): Playhead {
    const { time, rate, loop, isPreview } = this.#position;
    const { first, last } = this.timeline.spans[group];
    const localRate = (rate * Math.max(this.frameCount - 1, 1)) / Math.max(last - first, 1);
    const isSingle = this.timeline.spans.length === 1;
    return { time: this.timeline.localTime(group, time), rate: localRate, loop: loop && isSingle, isPreview };
  }

  #release(): void {
    const scene = this.#next as SceneStream;
    this.#earlierVersions += scene.version + 1;
    this.#next = null;
    scene.close();
    this.dispatchEvent(new SceneEvent('release', scene));
  }

  /** Open a group, unless one is being opened or loading has stopped. */
  async #begin(group: number): Promise<void> {
    if (this.#opening || this.error) return;
    const opening = { group, control: new AbortController() };
    this.#opening = opening;
    try {
      const scene = await openGroup(this.#opened, group, () => this.#arrived(), opening.control.signal);
      if (opening.control.signal.aborted || this.#isClosed) scene.close();
      else {
        this.#next = scene;
        scene.setPlayhead(this.#headIn(group));
        this.dispatchEvent(new SceneEvent('open', scene));
      }
    } catch (error) {
      if (!opening.control.signal.aborted && !this.#isClosed) {
        const known = asKpcError(error);
        const isMissing = known.code === 'cut-off' || known.code === 'empty';
        if (isMissing && group > 0 && this.notice !== null) this.#lose(group);
        else this.#error = known;
      }
    }
    if (this.#opening === opening) this.#opening = null;
    this.#arrived();
  }
}

async function sourceOf(src: string | URL | Blob | ArrayBuffer, options: HttpOptions): Promise<Source> {
  if (src instanceof Blob) return new BlobSource(src);
  if (src instanceof ArrayBuffer) return new BytesSource(new Uint8Array(src));
  const url = addressOf(src);
  if (url === null) throw new KpcError(`${String(src).slice(0, 200) || 'an empty text'} is no address`, 'not-found');
  return HttpSource.open(url.href, options);
}

async function openGroup(
  { files, shared, pool, check, memory }: Opened,
  group: number,
  changed: () => void,
  signal?: AbortSignal,
): Promise<SceneStream> {
  const file = files[group];
  if (file.size === 0 && shared) throw pictureError();
  const options = { group, shared, memory, changed, signal };
  const opening = SceneStream.open(file, pool, { ...options, check: ({ head }) => check(group, head) });
  const scene = await opening.catch(async (error) => {
    // A server may hide that the file was replaced, until it is asked once more.
    if (error instanceof FormatError) await file.read(0, HEADER_LENGTH, { signal, fresh: true });
    throw error;
  });
  if (!scene.lacksPicture) return scene;
  scene.close();
  throw pictureError();
}

const pictureError = (): FormatError => new FormatError('cut off before there is anything to show', 'cut-off');

const counted = (bytes: number): string => bytes.toLocaleString('en');

/** Return the metadata beside groups; null if there are none, or not yet. */
async function metadataBeside(
  source: Source,
  { index }: Awaited<ReturnType<typeof openContainer>>,
  pool: DecoderPool,
  signal?: AbortSignal,
): Promise<Metadata | null> {
  const found = [...index.keys()].filter((number) => index[number].kind === 'meta');
  if (found.length > 1) throw new FormatError(`holds ${found.length} meta chunks, not one`);
  if (found.length === 0) return null;
  const entry = index[found[0]];
  const body = await source.read(entry.offset, entry.offset + entry.storedLength, { signal });
  if (body.length < entry.storedLength) return null;
  return pool.run({ kind: 'metadata', number: found[0], entry, body }, { signal });
}
