/**
 * A file on a web server, read by HTTP range requests. Any static host will do.
 *
 * Bytes are handed on as they arrive. A connection that breaks off is resumed behind the last byte received, after a
 * pause that doubles each time; only then does an error reach the caller. A server without range requests, or one that
 * compresses, sends the whole file, which is kept in memory as far as it has come.
 *
 * No request has an If-Range header: on another site it would need a server that permits it (CORS), and browsers would
 * bypass their caches. Instead the answers' ETag, date and size are compared, as far as the other site shows them, and
 * every chunk has a checksum.
 */

import { BudgetError, KpcError } from '../container/errors.js';
import { strangeScheme } from './address.js';
import { Connection, TemporaryFailure } from './connection.js';
import { lengthOf, nameOf, rangeOf, retryAfter, validatorOf } from './http_headers.js';
import { emptyError, type ReadOptions, type Source } from './source.js';

/** Requested on opening: header and index of 1600 chunks, or the first coarse picture of a short clip. */
export const FIRST_BYTES = 1 << 16;
/**
 * Bytes of the beginning by which a file is recognised where its ETag or date differs, as between nodes of a server.
 */
const BEGINNING_BYTES = 512;
/** Requests that may fail in a row, until `attempts` is set. */
const MAX_ATTEMPTS = 5;
/** Failures without an answer after which the whole file is asked for, since the server may have no ranges. */
const WHOLE_AFTER = 2;
/** The pause before the second request, and the longest pause. Each is multiplied by a random number in [1/2, 3/2]. */
const FIRST_PAUSE_MS = 250;
const MAX_PAUSE_MS = 8000;
/** Answers after which a request is repeated, and those that end a redirection that was followed before. */
const TEMPORARY_STATUS = [408, 425, 429, 500, 502, 503, 504];
const EXPIRED_STATUS = [401, 403, 404, 410];

export interface HttpOptions {
  fetch?: typeof fetch;
  /** The most bytes that the file may take if the server has no range requests. */
  limit?: number;
  /** Ends opening. */
  signal?: AbortSignal;
  /** Milliseconds without a byte after which a connection counts as broken off. */
  timeoutMs?: number;
  firstPauseMs?: number;
}

/** The file of a server without range requests, as far as it has come. */
interface Whole {
  bytes: Uint8Array;
  reached: number;
  isDone: boolean;
  error: unknown;
  waiting: Set<() => void>;
}

export class HttpSource implements Source {
  readonly name: string;
  size: number | null = null;
  receivedBytes = 0;
  /** Requests that may fail in a row. */
  attempts = MAX_ATTEMPTS;
  /** Called with a line about trouble with the connection, and with null once it works again. */
  report: (message: string | null) => void = () => {};
  readonly #given: string;
  #address: string;
  readonly #options: HttpOptions;
  readonly #closing = new AbortController();
  #validator: [string, string] | null = null;
  #beginning = new Uint8Array(0);
  #whole: Whole | null = null;
  #isRetrying = false;
  /** Where an answer ended that was shorter than was asked for: the end of the file, unless there is more. */
  #shortAt = -1;
  /** Requests that failed without an answer before there was any. */
  #refusals = 0;

  private constructor(url: string, options: HttpOptions) {
    this.#given = this.#address = url;
    this.name = nameOf(url);
    this.#options = options;
  }

  /** Open a file: request its beginning. */
  static async open(url: string, options: HttpOptions = {}): Promise<HttpSource> {
    const source = new HttpSource(url, options);
    try {
      source.#beginning = new Uint8Array(await source.read(0, FIRST_BYTES, { signal: options.signal }));
    } catch (error) {
      source.close();
      throw error;
    }
    if (source.#beginning.length === 0) throw emptyError(source.name);
    return source;
  }

  get hasRanges(): boolean {
    return this.#whole === null;
  }

  get memoryBytes(): number {
    return this.#whole?.bytes.length ?? this.#beginning.length;
  }

  close(): void {
    this.#closing.abort();
  }

  async read(start: number, end: number, options: ReadOptions = {}): Promise<Uint8Array> {
    const until = Math.min(end, this.size ?? end);
    if (until <= start) return new Uint8Array(0);
    if (until <= this.#beginning.length && !options.fresh) {
      const bytes = this.#beginning.subarray(start, until);
      options.arrived?.(bytes);
      return bytes;
    }
    return this.#whole ? this.#readWhole(start, until, options) : this.#readRange(start, until, options);
  }

  async #readRange(start: number, end: number, options: ReadOptions): Promise<Uint8Array> {
    let bytes = new Uint8Array(end - start);
    const known = options.fresh ? bytes.subarray(0, 0) : this.#beginning.subarray(start, end);
    bytes.set(known);
    if (known.length) options.arrived?.(bytes.subarray(0, known.length));
    let reached = known.length;
    let failures = 0;
    while (reached < bytes.length) {
      const before = reached;
      const connection = new Connection([options.signal, this.#closing.signal], this.#options.timeoutMs);
      let isWhole = false;
      try {
        const response = await this.#request(connection, start + reached, start + bytes.length, options.fresh ?? false);
        isWhole = response === null && this.#whole !== null;
        if (response === null && this.size !== null) bytes = bytes.subarray(0, Math.max(0, this.size - start));
        if (response !== null) {
          let skipped = start + reached - (rangeOf(response)[0] ?? start + reached);
          for await (const piece of connection.pieces(response)) {
            const wanted = piece.subarray(skipped, skipped + bytes.length - reached);
            const isMore = piece.length > skipped + wanted.length;
            skipped = Math.max(0, skipped - piece.length);
            bytes.set(wanted, reached);
            reached += wanted.length;
            this.#received(piece.length);
            if (wanted.length) options.arrived?.(bytes.subarray(0, reached));
            if (isMore) break;
          }
          const isShort = reached < bytes.length && reached - before === lengthOf(response);
          if (this.size === null && isShort) {
            if (start + reached === this.#shortAt) this.size = this.#shortAt;
            this.#shortAt = start + reached;
          }
          if (this.size !== null) bytes = bytes.subarray(0, Math.max(0, this.size - start));
          if (reached === before && reached < bytes.length) throw new TemporaryFailure('the connection breaks off');
        }
      } catch (error) {
        const isRefused = error instanceof TemporaryFailure || (error as KpcError).code === 'network';
        if (isRefused && this.size === null && start + reached === this.#shortAt) {
          this.size = this.#shortAt;
          bytes = bytes.subarray(0, reached);
        } else {
          failures = reached > before ? 1 : failures + 1;
          await this.#pause(error, failures, options.signal);
        }
      } finally {
        if (!isWhole || this.#whole?.isDone) connection.end();
      }
      if (isWhole) return this.#readWhole(start, end, options);
    }
    return bytes;
  }

  /**
   * Return the answer to a request of a range; null if it is the whole file, which then arrives by itself, or if the
   * file ends before.
   */
  async #request(connection: Connection, start: number, end: number, fresh: boolean): Promise<Response | null> {
    const range = `bytes=${start}-${Math.min(end, this.size ?? end) - 1}`;
    const response = await this.#send(connection, { Range: range }, fresh);
    if (response.status === 200) {
      if (this.size !== null && !(await this.#isSame(response))) throw this.#replaced();
      this.#keepWhole(response, connection);
      return null;
    }
    const [first, , size] = rangeOf(response);
    if (response.status === 416) {
      if (this.size !== null && start < this.size) throw this.#replaced();
      if (start === this.#shortAt) this.size ??= start;
      if (this.size !== null) return null; // it has become known since the request was sent
      if (this.#beginning.length > 0 && !(await this.#isSame(response, true))) throw this.#replaced();
      if (size === 0) throw emptyError(this.name);
      if (size !== null && size < end) {
        this.size = size;
        return this.#request(connection, start, size, fresh);
      }
      this.#keepWhole(await this.#send(connection, {}, fresh), connection);
      return null;
    }
    if ((response.headers.get('Content-Encoding') ?? 'identity') !== 'identity') {
      this.#keepWhole(await this.#send(connection, {}, fresh), connection);
      return null;
    }
    if (first !== null && first > start) {
      throw new KpcError(`${this.name}: the server sends other bytes than were requested`, 'network');
    }
    if (size !== null && this.size !== null && size !== this.size) throw this.#replaced();
    if (this.#beginning.length === 0) this.#validator = validatorOf(response);
    else if (!(await this.#isSame(response, fresh))) throw this.#replaced();
    this.size ??= size;
    return response;
  }

  /** Send a request, with all redirections; return an answer that is of use. */
  async #send(connection: Connection, headers: Record<string, string>, fresh: boolean): Promise<Response> {
    const request: RequestInit = { headers, cache: fresh ? 'reload' : 'default', signal: connection.signal };
    const send = this.#options.fetch ?? globalThis.fetch;
    let response: Response;
    try {
      response = await send(this.#address, request);
    } catch (error) {
      if (this.receivedBytes > 0 || connection.signal.aborted) throw connection.failure(null, error);
      this.#refusals++;
      // Hosts that compress whatever is asked for: browsers refuse that in answer to a range, and to nothing else.
      if (this.#refusals === WHOLE_AFTER && 'Range' in headers) return this.#send(connection, {}, fresh);
      throw connection.failure(await this.#blockade(), error);
    }
    connection.touch();
    const { status } = response;
    if (status === 200 || status === 206 || status === 416) {
      if (response.redirected) this.#address = response.url;
      return response;
    }
    await response.body?.cancel();
    if (EXPIRED_STATUS.includes(status) && this.#address !== this.#given) {
      this.#address = this.#given;
      return this.#send(connection, headers, fresh);
    }
    const answer = `the server answers ${status} ${response.statusText}`.trimEnd();
    if (TEMPORARY_STATUS.includes(status)) throw new TemporaryFailure(answer, retryAfter(response));
    const code = status === 404 || status === 410 ? 'not-found' : 'network';
    throw new KpcError(`${this.name}: ${answer}; check the address`, code);
  }

  /** Return why the page cannot read from this address, if that is why a first request fails; else null. */
  async #blockade(): Promise<KpcError | null> {
    if (strangeScheme(this.#given) !== null) {
      const reason = 'a page cannot fetch such addresses; write one as https://example.org/scene.kpc';
      return new KpcError(`${this.name}: ${reason}`, 'not-found');
    }
    const { location } = globalThis as { location?: Location };
    const url = new URL(this.#given, location?.href);
    if (location === undefined) return null;
    const blocked = (why: string) => new KpcError(`${this.name}: ${why}`, 'blocked');
    if (url.protocol === 'file:') return blocked('a page cannot read files of a disk; serve them: kpplay --web');
    if (this.#refusals < WHOLE_AFTER) return null; // it may be the connection, or that the server has no ranges
    const isOwn = url.origin === location.origin;
    try {
      const send = this.#options.fetch ?? globalThis.fetch;
      const probe = await send(url.href, {
        mode: 'no-cors',
        signal: AbortSignal.timeout(this.#options.timeoutMs ?? 5000),
      });
      await probe.body?.cancel();
      if (isOwn && probe.type !== 'opaque') return null; // it was not redirected to another site
    } catch {
      const isMixed = location.protocol === 'https:' && url.protocol === 'http:';
      return isMixed ? blocked('a page that came by https cannot read by http; serve the file by https') : null;
    }
    const origin = location.origin === 'null' ? '*' : location.origin;
    const server = isOwn ? 'the server that its address leads to' : 'its server';
    return blocked(`${server} must permit this page to read it, by the header Access-Control-Allow-Origin: ${origin}`);
  }

  /**
   * Whether an answer is of the file that was opened, as far as the server says. If bytes came damaged, which makes it
   * doubtful, a server that says nothing is asked for the beginning.
   */
  async #isSame(response: Response, isDoubtful = false): Promise<boolean> {
    const said = this.#validator && response.headers.get(this.#validator[0]);
    if (said === null ? !isDoubtful : said === this.#validator?.[1]) return true;
    // Nodes of a server may have ETags and dates of their own: then the beginning says whether it is the file.
    const known = this.#beginning.subarray(0, BEGINNING_BYTES);
    const connection = new Connection([this.#closing.signal], this.#options.timeoutMs);
    try {
      const again = await this.#send(connection, { Range: `bytes=0-${known.length - 1}` }, true);
      let at = 0;
      for await (const piece of connection.pieces(again)) {
        const compared = piece.subarray(0, known.length - at);
        if (compared.some((byte, k) => byte !== known[at + k])) return false;
        at += compared.length;
        if (at === known.length) break;
      }
      if (at < known.length) return false;
    } finally {
      connection.end();
    }
    this.#validator = null;
    return true;
  }

  #replaced(): KpcError {
    return new KpcError(`${this.name}: changed on the server while it was read; load it again`, 'replaced');
  }

  #received(count: number): void {
    this.receivedBytes += count;
    if (this.#isRetrying) this.report(null);
    this.#isRetrying = false;
  }

  /** Wait before the next request after a failure that may pass; throw any other error. */
  async #pause(error: unknown, failures: number, signal?: AbortSignal): Promise<void> {
    if (this.#closing.signal.aborted || signal?.aborted) throw new KpcError(`${this.name}: ended`, 'aborted');
    if (!(error instanceof TemporaryFailure)) throw error;
    if (failures >= this.attempts) {
      throw new KpcError(`${this.name}: ${error.message}; check the address and the connection`, 'network');
    }
    const { firstPauseMs = FIRST_PAUSE_MS } = this.#options;
    const pause = Math.min(firstPauseMs * 2 ** Math.min(failures - 1, 10), MAX_PAUSE_MS) * (0.5 + Math.random());
    this.#isRetrying = true;
    this.report(`${error.message}; trying again`);
    await new Promise<void>((resolve) => {
      const ends = [this.#closing.signal, signal];
      const wake = () => {
        clearTimeout(timer);
        for (const end of ends) end?.removeEventListener('abort', wake);
        globalThis.removeEventListener?.('online', wake);
        resolve();
      };
      const timer = setTimeout(wake, Math.max(pause, error.pauseMs));
      for (const end of ends) end?.addEventListener('abort', wake);
      globalThis.addEventListener?.('online', wake);
    });
  }

  /** Receive a whole file from now on, in the background. */
  #keepWhole(response: Response, connection: Connection): void {
    if (this.#whole !== null) {
      connection.end();
      return;
    }
    const limit = this.#options.limit ?? 2 ** 29;
    const length = response.headers.has('Content-Encoding') ? null : lengthOf(response);
    if ((length ?? 0) > limit) throw this.#tooLarge(limit);
    const bytes = new Uint8Array(length ?? FIRST_BYTES);
    this.#whole = { bytes, reached: 0, isDone: false, error: null, waiting: new Set() };
    this.#validator ??= validatorOf(response);
    connection.follow([this.#closing.signal]); // it outlives the read that began it
    this.#receiveWhole(this.#whole, response, connection, limit);
  }

  #tooLarge(limit: number): BudgetError {
    return new BudgetError(
      `${this.name}: the server has no range requests, and the whole file takes more than the budget of ${limit} bytes`,
    );
  }

  async #receiveWhole(whole: Whole, first: Response, begun: Connection, limit: number): Promise<void> {
    let [response, connection]: [Response | null, Connection] = [first, begun];
    const wake = () => {
      for (const one of [...whole.waiting]) one();
    };
    for (let failures = 0; !whole.isDone && whole.error === null; ) {
      const before = whole.reached;
      try {
        response ??= await this.#send(connection, {}, false);
        if (whole.reached > 0 && !(await this.#isSame(response))) throw this.#replaced();
        let at = 0;
        for await (const piece of connection.pieces(response)) {
          if (at + piece.length > limit) throw this.#tooLarge(limit);
          this.#append(whole, piece, at);
          at += piece.length;
          wake();
        }
        whole.isDone = true;
        this.size = whole.reached;
      } catch (error) {
        failures = whole.reached > before ? 1 : failures + 1;
        try {
          await this.#pause(error, failures);
        } catch (final) {
          whole.error = final;
        }
      } finally {
        connection.end();
        [response, connection] = [null, new Connection([this.#closing.signal], this.#options.timeoutMs)];
      }
    }
    connection.end();
    wake();
  }

  /** Take a piece that begins at a position; what it repeats must be the same as before. */
  #append(whole: Whole, piece: Uint8Array, at: number): void {
    const known = Math.max(0, Math.min(whole.reached - at, piece.length));
    for (let k = 0; k < known; k++) if (piece[k] !== whole.bytes[at + k]) throw this.#replaced();
    const end = at + piece.length;
    if (end > whole.bytes.length) {
      const wider = new Uint8Array(Math.max(end, 2 * whole.bytes.length));
      wider.set(whole.bytes.subarray(0, whole.reached));
      whole.bytes = wider;
    }
    whole.bytes.set(piece.subarray(known), at + known);
    whole.reached = Math.max(whole.reached, end);
    this.#received(piece.length - known);
  }

  async #readWhole(start: number, end: number, { signal, arrived }: ReadOptions): Promise<Uint8Array> {
    const whole = this.#whole as Whole;
    for (let before = -1; ; ) {
      if (signal?.aborted) throw new KpcError(`${this.name}: ended`, 'aborted');
      const reached = Math.max(start, Math.min(whole.reached, end));
      const bytes = whole.bytes.subarray(start, reached);
      if (bytes.length !== before) arrived?.(bytes);
      before = bytes.length;
      if (reached >= end || whole.isDone) return bytes;
      if (whole.error !== null) throw whole.error;
      await new Promise<void>((resolve) => {
        const wake = () => {
          whole.waiting.delete(wake);
          signal?.removeEventListener('abort', wake);
          resolve();
        };
        whole.waiting.add(wake);
        signal?.addEventListener('abort', wake);
      });
    }
  }
}
