/** Where a file's bytes come from. */

import { KpcError } from '../container/errors.js';

export interface ReadOptions {
  /** Ends the read, which then throws a KpcError `aborted`. */
  signal?: AbortSignal;
  /** Called as bytes come, with all that are there from the start of the read on. */
  arrived?: (bytes: Uint8Array) => void;
  /** Whether to ask the server although a cache holds the bytes, which came damaged. */
  fresh?: boolean;
}

/** Return the error of a file without a byte. */
export const emptyError = (name: string): KpcError => new KpcError(`${name} is empty; upload the file again`, 'empty');

export interface Source {
  /** For messages: no secrets. */
  readonly name: string;
  /** Bytes; null as long as nobody says. */
  readonly size: number | null;
  /** Bytes that have been received so far. */
  readonly receivedBytes: number;
  /** Bytes of memory that the source takes. */
  readonly memoryBytes: number;
  /** Whether the bytes of a chunk that ends at `end` are there, as far as is known; without it, `size` says that. */
  reaches?(end: number): boolean;
  /** Return the bytes from `start` to before `end`, fewer only at the end of the file. */
  read(start: number, end: number, options?: ReadOptions): Promise<Uint8Array>;
  close(): void;
}

/** Whether a source has a chunk that ends at `end`, as far as is known. */
export const reaches = (source: Source, end: number): boolean =>
  source.reaches?.(end) ?? (source.size === null || end <= source.size);

/** A source that hands on what it is asked to another one; others change some of that. */
export class ForwardingSource implements Source {
  /** Take the source that is asked, and another name for messages, if it has one. */
  constructor(
    protected readonly inner: Source,
    readonly name = inner.name,
  ) {}

  get size(): number | null {
    return this.inner.size;
  }

  get receivedBytes(): number {
    return this.inner.receivedBytes;
  }

  get memoryBytes(): number {
    return this.inner.memoryBytes;
  }

  read(start: number, end: number, options?: ReadOptions): Promise<Uint8Array> {
    return this.inner.read(start, end, options);
  }

  close(): void {
    this.inner.close();
  }
}

/** A file that the page has: chosen by its user, or dropped. */
export class BlobSource implements Source {
  readonly name: string;
  readonly size: number;
  receivedBytes = 0;
  readonly memoryBytes = 0;
  readonly #blob: Blob;

  constructor(blob: Blob) {
    this.#blob = blob;
    this.size = blob.size;
    this.name = 'name' in blob ? String(blob.name) : 'the file';
  }

  async read(start: number, end: number, { arrived }: ReadOptions = {}): Promise<Uint8Array> {
    const bytes = new Uint8Array(await this.#blob.slice(start, end).arrayBuffer());
    this.receivedBytes += bytes.length;
    arrived?.(bytes);
    return bytes;
  }

  close(): void {}
}

/** A file in memory. */
export class BytesSource implements Source {
  readonly name = 'the file';
  readonly size: number;
  readonly receivedBytes: number;
  readonly memoryBytes: number;
  readonly #bytes: Uint8Array;

  constructor(bytes: Uint8Array) {
    this.#bytes = bytes;
    this.size = this.receivedBytes = this.memoryBytes = bytes.length;
  }

  async read(start: number, end: number, { arrived }: ReadOptions = {}): Promise<Uint8Array> {
    const bytes = this.#bytes.subarray(start, end);
    arrived?.(bytes);
    return bytes;
  }

  close(): void {}
}

/** A file within a file: a group of a clip. */
export class SlicedSource extends ForwardingSource {
  readonly #offset: number;
  readonly #length: number;

  constructor(whole: Source, offset: number, length: number, name: string) {
    super(whole, name);
    [this.#offset, this.#length] = [offset, length];
  }

  override get size(): number {
    const { size } = this.inner;
    return size === null ? this.#length : Math.max(0, Math.min(this.#length, size - this.#offset));
  }

  override read(start: number, end: number, options?: ReadOptions): Promise<Uint8Array> {
    return this.inner.read(this.#offset + start, this.#offset + Math.min(end, this.size), options);
  }

  /** Leave the file open for other groups. */
  override close(): void {}
}
