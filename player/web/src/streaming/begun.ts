/** A file whose beginning is requested once: what is read of it is handed on as it arrives. */

import { KpcError } from '../container/errors.js';
import { ForwardingSource, type ReadOptions, type Source } from './source.js';

export class BegunSource extends ForwardingSource {
  readonly #ending = new AbortController();
  readonly #waiting = new Set<() => void>();
  /** Where the beginning ends, and what has come of it. */
  #end: number;
  #bytes = new Uint8Array(0);
  #error: unknown = null;

  /** Request the first `length` bytes of a source. */
  constructor(source: Source, length: number) {
    super(source);
    this.#end = length;
    this.#begin();
  }

  override get memoryBytes(): number {
    return super.memoryBytes + this.#bytes.length;
  }

  override async read(start: number, end: number, options: ReadOptions = {}): Promise<Uint8Array> {
    const { arrived = () => {}, signal, fresh = false } = options;
    if (fresh || start >= this.#end) return this.inner.read(start, end, options);
    const bytes = new Uint8Array(Math.max(0, end - start));
    const border = this.#end;
    let [known, later] = [0, 0]; // bytes of the beginning, and those behind it
    const noteLater = (more: Uint8Array) => {
      bytes.set(more.subarray(later), border - start + later);
      later = more.length;
      if (known === border - start) arrived(bytes.subarray(0, known + later));
    };
    // What lies behind the beginning is requested now, so that it follows without a pause.
    const rest = end > border ? this.inner.read(border, end, { signal, arrived: noteLater }) : null;
    rest?.catch(() => {}); // until it is awaited
    for (let isOver = false; !isOver; ) {
      if (signal?.aborted) throw new KpcError(`${this.name}: ended`, 'aborted');
      const there = this.#bytes.subarray(start, end);
      const isMore = there.length > known;
      bytes.set(there.subarray(known), known);
      known = there.length;
      if (isMore) arrived(bytes.subarray(0, known < border - start ? known : known + later));
      isOver = this.#bytes.length >= Math.min(end, this.#end);
      if (!isOver && this.#error !== null) throw this.#error;
      if (!isOver) await this.#more(signal);
    }
    await rest;
    return bytes.subarray(0, known + later);
  }

  /** End the request of the beginning; the source itself stays open. */
  override close(): void {
    this.#ending.abort();
  }

  async #begin(): Promise<void> {
    const take = (bytes: Uint8Array) => {
      this.#bytes = bytes as Uint8Array<ArrayBuffer>;
      this.#wake();
    };
    try {
      take(await this.inner.read(0, this.#end, { signal: this.#ending.signal, arrived: take }));
      this.#end = this.#bytes.length; // or less, at the end of the file
    } catch (error) {
      this.#error = error;
    }
    this.#wake();
  }

  #wake(): void {
    for (const wake of [...this.#waiting]) wake();
  }

  /** Wait for more of the beginning. */
  #more(signal?: AbortSignal): Promise<void> {
    return new Promise((resolve) => {
      const wake = () => {
        this.#waiting.delete(wake);
        signal?.removeEventListener('abort', wake);
        resolve();
      };
      this.#waiting.add(wake);
      signal?.addEventListener('abort', wake);
    });
  }
}
