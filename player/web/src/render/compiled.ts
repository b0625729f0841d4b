/** Programs that are compiled while the page goes on. */

import type { Compilation, Device, Program } from './device.js';

export class CompiledPrograms {
  readonly #compilations = new Map<string, Compilation>();
  readonly #programs = new Map<string, Program>();

  constructor(readonly device: Device) {}

  /**
   * Whether a program is there, so that `get` does not wait. It is taken while nothing is being compiled or
   * drawn, which the page would wait for, too. As many are taken as a frame has time for.
   * @param begin begins to compile it, if that has not been done.
   */
  isReady(key: string, begin: () => Compilation, made?: (program: Program) => void): boolean {
    if (this.#programs.has(key)) return true;
    this.#begun(key, begin);
    if (this.device.isCompiling || performance.now() > this.device.takesUntil) return false;
    this.get(key, begin, made);
    return true;
  }

  /** Return a program, and wait for it if necessary; `made` is called once it is there. */
  get(key: string, begin: () => Compilation, made: (program: Program) => void = () => {}): Program {
    const known = this.#programs.get(key);
    if (known !== undefined) return known;
    const compilation = this.#begun(key, begin);
    this.#compilations.delete(key);
    const program = this.device.program(compilation);
    this.#programs.set(key, program);
    made(program);
    return program;
  }

  /** Delete a program, or give up compiling it. */
  forget(key: string): void {
    const [compilation, program] = [this.#compilations.get(key), this.#programs.get(key)];
    if (compilation) this.device.abandon(compilation);
    if (program) this.device.release(program);
    this.#compilations.delete(key);
    this.#programs.delete(key);
  }

  release(): void {
    for (const compilation of this.#compilations.values()) this.device.abandon(compilation);
    for (const program of this.#programs.values()) this.device.release(program);
    this.#compilations.clear();
    this.#programs.clear();
  }

  #begun(key: string, begin: () => Compilation): Compilation {
    const known = this.#compilations.get(key);
    if (known !== undefined) return known;
    const compilation = begin();
    this.#compilations.set(key, compilation);
    return compilation;
  }
}
