/**
 * Programs of scenes: those of the same text are compiled once for all scenes of a device, as for groups of a clip.
 *
 * Some that nobody needs are kept: after a jump in a clip the next group comes when the one before is gone.
 */

import { CompiledPrograms } from './compiled.js';
import type { Compilation, Device, Program } from './device.js';

/** Programs that are kept although no scene needs them, the last ones. */
const MOST_UNUSED = 8;

const ofDevices = new WeakMap<Device, SharedPrograms>();

export class SharedPrograms {
  readonly #compiled: CompiledPrograms;
  /** By keys: who needs a program, those lately needed behind others, and who used it last. */
  readonly #users = new Map<string, Set<object>>();
  readonly #last = new Map<string, object>();

  private constructor(device: Device) {
    this.#compiled = new CompiledPrograms(device);
  }

  static on(device: Device): SharedPrograms {
    const known = ofDevices.get(device);
    if (known) return known;
    const made = new SharedPrograms(device);
    ofDevices.set(device, made);
    return made;
  }

  /** Whether a program is there, so that `get` does not wait; if not, it is being compiled for a user. */
  isReady(user: object, key: string, begin: () => Compilation): boolean {
    this.#note(user, key);
    return this.#compiled.isReady(key, begin);
  }

  /** Return a program, and whether its uniforms are another user's. */
  get(user: object, key: string, begin: () => Compilation): [Program, boolean] {
    this.#note(user, key);
    const isOthers = this.#last.get(key) !== user;
    this.#last.set(key, user);
    return [this.#compiled.get(key, begin), isOthers];
  }

  /** Let go of the programs of a user, which others may still need. */
  release(user: object): void {
    for (const [key, users] of this.#users) {
      users.delete(user);
      if (this.#last.get(key) === user) this.#last.delete(key);
    }
    this.#forgetUnused(MOST_UNUSED);
  }

  /** Let go of all programs that no scene needs. */
  dispose(): void {
    this.#forgetUnused(0);
  }

  #forgetUnused(most: number): void {
    const unused = [...this.#users].flatMap(([key, users]) => (users.size === 0 ? [key] : []));
    for (const key of unused.slice(0, Math.max(0, unused.length - most))) {
      this.#compiled.forget(key);
      this.#users.delete(key);
    }
  }

  #note(user: object, key: string): void {
    const users = this.#users.get(key) ?? new Set();
    this.#users.delete(key); // and put it last
    this.#users.set(key, users.add(user));
  }
}
