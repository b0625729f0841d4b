/** How far cells of an occupancy grid are from occupied ones, found by a worker slot by slot when they are wanted. */

import type { DecoderPool } from '../decoder/pool.js';
import type { SceneContent } from '../decoder/tasks.js';
import { occupiedIn } from '../render/scene_source.js';

export class CellDistances {
  /** By slot; null while a worker finds them. */
  readonly #found = new Map<number, Uint8Array | null>();

  /** @param done is called once some are there, or with an error. */
  constructor(
    readonly content: Pick<SceneContent, 'occupancy'>,
    readonly pool: DecoderPool,
    readonly done: (error?: unknown) => void,
  ) {}

  /** Return the distances of a slot, null as long as they are not there; the next slot's are found thereafter. */
  of(slot: number): Uint8Array | null {
    this.#find(slot);
    if (this.#found.get(slot)) this.#find((slot + 1) % this.content.occupancy.sizes[0]);
    return this.#found.get(slot) ?? null;
  }

  /** Whether a worker finds some. */
  get arePending(): boolean {
    return [...this.#found.values()].includes(null);
  }

  async #find(slot: number): Promise<void> {
    if (this.#found.has(slot)) return;
    this.#found.set(slot, null);
    const occupied = occupiedIn(this.content, slot).slice();
    const task = { kind: 'distances', occupied, sizes: this.content.occupancy.sizes.slice(1) } as const;
    try {
      this.#found.set(slot, await this.pool.run(task, { numbers: occupied.length, moved: [occupied.buffer] }));
      this.done();
    } catch (error) {
      this.done(error);
    }
  }
}
