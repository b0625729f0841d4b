/** What ends when a signal aborts: one listener for each signal, since platforms warn of many. */
export class Endings {
  readonly #ends = new Map<AbortSignal, Set<() => void>>();

  /** Call a function if a signal aborts; return what takes that back. */
  add(signal: AbortSignal, end: () => void): () => void {
    const ends = this.#ends.get(signal) ?? new Set();
    if (ends.size === 0) {
      this.#ends.set(signal, ends);
      signal.addEventListener('abort', this.#end);
    }
    ends.add(end);
    return () => {
      ends.delete(end);
      if (ends.size === 0) this.#forget(signal);
    };
  }

  readonly #end = ({ target }: Event): void => {
    const signal = target as AbortSignal;
    const ends = [...(this.#ends.get(signal) ?? [])];
    this.#forget(signal);
    for (const end of ends) end();
  };

  #forget(signal: AbortSignal): void {
    this.#ends.delete(signal);
    signal.removeEventListener('abort', this.#end);
  }
}
