/** One HTTP request: it ends when its caller wants, or when no byte comes for too long. */

import { KpcError } from '../container/errors.js';

const TIMEOUT_MS = 10_000;

/** A request failed in a way that may pass: it is repeated, not before `pauseMs`. */
export class TemporaryFailure extends Error {
  readonly pauseMs: number;

  constructor(message: string, pauseMs = 0) {
    super(message);
    this.pauseMs = pauseMs;
  }
}

export class Connection {
  readonly #control = new AbortController();
  readonly #timeoutMs: number;
  #ends: AbortSignal[] = [];
  #timer: ReturnType<typeof setTimeout> | undefined;
  #isTooSlow = false;
  readonly #abort = () => this.#control.abort();

  constructor(ends: (AbortSignal | undefined)[], timeoutMs = TIMEOUT_MS) {
    this.#timeoutMs = timeoutMs;
    this.#listen(ends);
    this.touch();
  }

  get signal(): AbortSignal {
    return this.#control.signal;
  }

  /** Note that the server has sent something. */
  touch(): void {
    clearTimeout(this.#timer);
    this.#timer = setTimeout(() => {
      this.#isTooSlow = true;
      this.#control.abort();
    }, this.#timeoutMs);
  }

  /** Let other signals than before end the request. */
  follow(ends: AbortSignal[]): void {
    this.#unlisten();
    this.#listen(ends);
  }

  /** Release everything; a request that still runs is ended. */
  end(): void {
    clearTimeout(this.#timer);
    this.#unlisten();
    this.#control.abort();
  }

  /** Yield the body of an answer piece by piece; throw a TemporaryFailure if it breaks off. */
  async *pieces(response: Response): AsyncGenerator<Uint8Array> {
    const reader = (response.body as ReadableStream<Uint8Array>).getReader();
    try {
      for (;;) {
        this.touch();
        const { done, value } = await reader.read().catch((error) => {
          throw this.failure(null, error);
        });
        if (done) return;
        yield value;
      }
    } finally {
      clearTimeout(this.#timer);
      reader.cancel().catch(() => {});
    }
  }

  /** Return what to throw for an error of fetch, whose reason may be known. */
  failure(reason: KpcError | null, error: unknown): Error {
    if (this.#isTooSlow) return new TemporaryFailure('the server does not answer in time');
    if (this.signal.aborted) return new KpcError('ended', 'aborted');
    return reason ?? new TemporaryFailure(`the connection fails (${String((error as Error).message).slice(0, 120)})`);
  }

  #listen(ends: (AbortSignal | undefined)[]): void {
    this.#ends = ends.filter((end) => end !== undefined);
    for (const end of this.#ends) {
      if (end.aborted) this.#abort();
      end.addEventListener('abort', this.#abort);
    }
  }

  #unlisten(): void {
    for (const end of this.#ends) end.removeEventListener('abort', this.#abort);
  }
}
