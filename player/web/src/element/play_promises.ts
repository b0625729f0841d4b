/** The promises of `play()`, which are kept once the clip moves. */

export class PlayPromises {
  #waiting: { resolve(): void; reject(error: unknown): void }[] = [];

  add(): Promise<void> {
    return new Promise<void>((resolve, reject) => this.#waiting.push({ resolve, reject }));
  }

  /** Keep all promises, or break them with an error. */
  settle(error?: DOMException): void {
    const waiting = this.#waiting;
    this.#waiting = [];
    for (const { resolve, reject } of waiting) {
      if (error) reject(error);
      else resolve();
    }
  }
}
