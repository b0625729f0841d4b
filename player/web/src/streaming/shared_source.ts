/** The planes that groups share (section 4.7 of spec/kpc-format.md) as they arrive: each is fetched once. */

import type { Entry } from '../container/chunk.js';
import { Container } from '../container/container.js';
import { KpcError } from '../container/errors.js';
import { sharedStart, withShared } from '../container/shared_planes.js';
import { ForwardingSource, type ReadOptions, reaches, type Source } from './source.js';

/** A read of shared planes that is under way. */
interface Reading {
  start: number;
  end: number;
  /** Resolves when it has ended, however. */
  over: Promise<void>;
}

/** The shared planes of a clip. Those that have come are kept for the groups to come, as far as the memory allows. */
export class SharedPlanes {
  readonly #source: Source;
  readonly #entries: readonly Entry[];
  readonly #limit: number;
  readonly #held = new Map<Entry, Uint8Array>();
  readonly #readings = new Set<Reading>();
  /** Positions of the planes that the group uses which was opened last. */
  #used = new Set<number>();

  /** Take the entries of all shared planes of a file; at most `limit` bytes of them are kept, 0 of a file in memory. */
  constructor(source: Source, entries: readonly Entry[], limit: number) {
    this.#source = source;
    this.#entries = [...entries].sort((a, b) => a.offset - b.offset);
    this.#limit = limit;
  }

  /** Bytes that may be kept in the end. */
  get mostBytes(): number {
    return Math.min(
      this.#entries.reduce((sum, { storedLength }) => sum + storedLength, 0),
      this.#limit,
    );
  }

  /** Bytes that are kept. */
  get memoryBytes(): number {
    return [...this.#held.values()].reduce((sum, bytes) => sum + bytes.length, 0);
  }

  /** Return a group with the shared planes that it uses, which its index then lists behind its end. */
  join(own: Source, container: Container, group: number): { source: Source; container: Container } {
    const { bytes, header, index: listed } = container;
    const index = withShared(listed, group, this.#entries, header.fileLength);
    if (index === listed) return { source: own, container };
    const start = sharedStart(header.fileLength);
    this.#used = new Set(index.map(({ offset }) => offset - start));
    return {
      source: new SharingSource(own, this, start),
      container: new Container(bytes, { allowPartial: true, index }),
    };
  }

  /** Whether a shared plane that ends at `end` is there, as far as is known. */
  reaches(end: number): boolean {
    return reaches(this.#source, end);
  }

  /** Return the bytes of shared planes that lie side by side, from `start` to before `end` in the file of the clip. */
  async read(start: number, end: number, options: ReadOptions = {}): Promise<Uint8Array> {
    if (this.#limit === 0) return this.#source.read(start, end, options);
    for (let other = this.#reading(start, end); other; other = this.#reading(start, end)) {
      await this.#wait(other, options.signal); // what comes of it is kept
    }
    let finish = () => {};
    const reading = { start, end, over: new Promise<void>((resolve) => (finish = resolve)) };
    this.#readings.add(reading);
    try {
      return await this.#collect(start, end, options);
    } finally {
      this.#readings.delete(reading);
      finish();
    }
  }

  #reading(start: number, end: number): Reading | undefined {
    return [...this.#readings].find((other) => other.start < end && start < other.end);
  }

  async #wait({ over }: Reading, signal?: AbortSignal): Promise<void> {
    await new Promise<void>((resolve) => {
      const wake = () => {
        signal?.removeEventListener('abort', wake);
        resolve();
      };
      signal?.addEventListener('abort', wake);
      over.then(wake);
      if (signal?.aborted) wake();
    });
    if (signal?.aborted) throw new KpcError(`${this.#source.name}: ended`, 'aborted');
  }

  /** Put together what is kept and what is fetched now. */
  async #collect(start: number, end: number, { signal, arrived, fresh }: ReadOptions): Promise<Uint8Array> {
    const planes = this.#entries.filter(({ offset, storedLength }) => offset >= start && offset + storedLength <= end);
    if (fresh) for (const plane of planes) this.#held.delete(plane);
    const bytes = new Uint8Array(end - start);
    let reached = start;
    while (reached < end) {
      const next = planes.find((plane) => plane.offset === reached && this.#held.has(plane));
      const held = next && this.#held.get(next);
      if (held?.length) {
        bytes.set(held, reached - start);
        reached += held.length;
        arrived?.(bytes.subarray(0, reached - start));
        continue;
      }
      const from = reached;
      const until = Math.min(end, ...planes.filter((one) => this.#held.has(one) && one.offset > from).map(offsetOf));
      const take = (piece: Uint8Array) => {
        bytes.set(piece.subarray(reached - from), reached - start);
        reached = from + piece.length;
        for (const plane of planes) {
          const [first, last] = [plane.offset - start, plane.offset + plane.storedLength - start];
          if (first >= from - start && last <= reached - start) this.#keep(plane, bytes.subarray(first, last));
        }
        arrived?.(bytes.subarray(0, reached - start));
      };
      const piece = await this.#source.read(from, until, { signal, fresh, arrived: take });
      if (reached < from + piece.length) take(piece);
      if (reached < until) break; // the file ends before
    }
    return bytes.subarray(0, reached - start);
  }

  /** Keep a plane. If the memory is short, those are let go that the group does not use which was opened last. */
  #keep(plane: Entry, bytes: Uint8Array): void {
    if (this.#held.has(plane) || bytes.length > this.#limit) return;
    const fits = () => this.memoryBytes + bytes.length <= this.#limit;
    for (const other of [...this.#held.keys()]) if (!fits() && !this.#used.has(other.offset)) this.#held.delete(other);
    if (fits()) this.#held.set(plane, bytes.slice());
  }
}

/** A group, and the shared planes behind it. */
class SharingSource extends ForwardingSource {
  readonly #shared: SharedPlanes;
  readonly #start: number;

  /** Take a group, and the position in it at which the file of the clip begins for shared planes. */
  constructor(own: Source, shared: SharedPlanes, start: number) {
    super(own);
    [this.#shared, this.#start] = [shared, start];
  }

  reaches(end: number): boolean {
    return end > this.#start ? this.#shared.reaches(end - this.#start) : reaches(this.inner, end);
  }

  override read(start: number, end: number, options?: ReadOptions): Promise<Uint8Array> {
    if (start < this.#start) return this.inner.read(start, end, options);
    return this.#shared.read(start - this.#start, end - this.#start, options);
  }
}

const offsetOf = ({ offset }: Entry): number => offset;
