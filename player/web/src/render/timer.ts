/** How long the card takes to draw. */

const POLL_MS = 2;

/** The part of EXT_disjoint_timer_query_webgl2 that is used; TypeScript does not know it. */
interface TimerExtension {
  readonly TIME_ELAPSED_EXT: number;
  readonly GPU_DISJOINT_EXT: number;
}

/**
 * Measures one piece of work at a time: by a timer of the card where the browser has one, else by the clock until the
 * work is done.
 */
export class Timer {
  readonly #extension: TimerExtension | null;
  #fence: WebGLSync | null = null;
  #query: WebGLQuery | null = null;
  #started = 0;
  #done: (seconds: number) => void = () => {};
  #poll: ReturnType<typeof setTimeout> | undefined;

  constructor(
    readonly gl: WebGL2RenderingContext,
    isSoftware: boolean,
  ) {
    // A processor in place of a card works when it likes, not between the two ends of a query.
    this.#extension = isSoftware ? null : gl.getExtension('EXT_disjoint_timer_query_webgl2');
  }

  /** Whether the work that was measured last is not done yet. */
  get isBusy(): boolean {
    return this.#fence !== null;
  }

  /** Begin with a piece of work; `done` gets its seconds once it is done, unless nothing can be said of it. */
  start(done: (seconds: number) => void): void {
    const { gl } = this;
    this.#done = done;
    this.#started = performance.now();
    if (this.#extension) {
      this.#query = gl.createQuery();
      if (this.#query) gl.beginQuery(this.#extension.TIME_ELAPSED_EXT, this.#query);
    }
  }

  /** End the work. */
  finish(): void {
    const { gl } = this;
    if (this.#extension && this.#query) gl.endQuery(this.#extension.TIME_ELAPSED_EXT);
    this.#fence = gl.fenceSync(gl.SYNC_GPU_COMMANDS_COMPLETE, 0);
    gl.flush();
    this.#look();
  }

  #look(): void {
    this.#poll = setTimeout(() => {
      const { gl } = this;
      if (this.#fence === null) return;
      if (gl.getSyncParameter(this.#fence, gl.SYNC_STATUS) !== gl.SIGNALED && !gl.isContextLost()) {
        this.#look();
        return;
      }
      const seconds = this.#seconds();
      this.#forget();
      if (seconds > 0) this.#done(seconds);
    }, POLL_MS);
  }

  #seconds(): number {
    const { gl } = this;
    if (this.#extension && this.#query) {
      const isKnown = gl.getQueryParameter(this.#query, gl.QUERY_RESULT_AVAILABLE);
      if (isKnown && !gl.getParameter(this.#extension.GPU_DISJOINT_EXT)) {
        return gl.getQueryParameter(this.#query, gl.QUERY_RESULT) / 1e9;
      }
    }
    return (performance.now() - this.#started) / 1e3;
  }

  #forget(): void {
    this.gl.deleteSync(this.#fence);
    this.gl.deleteQuery(this.#query);
    this.#fence = this.#query = null;
  }

  dispose(): void {
    clearTimeout(this.#poll);
    this.#forget();
  }
}
