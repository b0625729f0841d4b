/** Pictures that follow the one before while the camera rests: what has not changed is not marched again. */

import { CompiledPrograms } from './compiled.js';
import type { Device, Format, Framebuffer, Texture } from './device.js';
import type { Target } from './presentation.js';
import { BLOCK } from './quality.js';
import { UNIT } from './scene_textures.js';
import type { Defines } from './shader.js';

const NAME = 'changes.glsl';
const DEFINES: Defines = { CONTRACTED: 0, NDC: 0 };
/** Which pixels are marched: `marched` of march.glsl. */
const MARCHED = { all: 0, sampled: 1, changed: 2 } as const;

/** Which pixels of a picture are marched. */
export interface Pixels {
  readonly marched: (typeof MARCHED)[keyof typeof MARCHED];
  /** Which of each block's pixels is its sample pixel. */
  readonly turn: number;
  /** The sample pixels, which blocks have changed, and the picture that shows the others. */
  readonly sampled: Texture | null;
  readonly changes: Texture | null;
  readonly before: Texture | null;
}

export const ALL_PIXELS: Pixels = { marched: MARCHED.all, turn: 0, sampled: null, changes: null, before: null };

/** Pictures with a pixel for each block of a larger one. */
interface Blocks {
  sampled: Target;
  changes: Target;
}

export class Following {
  readonly #compiled: CompiledPrograms;
  /** By the name of the picture that they divide. */
  readonly #blocks = new Map<string, Blocks>();

  constructor(readonly device: Device) {
    this.#compiled = new CompiledPrograms(device);
  }

  isReady(): boolean {
    return this.#compiled.isReady(NAME, () => this.device.compile(NAME, DEFINES, {}));
  }

  /**
   * Find out what has changed since a picture; return which pixels of the one that follows it to march.
   * @param name of what the picture shows, by which textures are kept for the next time.
   * @param march marches pixels of the picture that follows, here its sample pixels, into another one.
   */
  findChanges(
    name: string,
    { width, height, rgba: before }: Target,
    turn: number,
    tolerance: number,
    march: (into: Framebuffer, pixels: Pixels) => void,
  ): Pixels {
    const { device } = this;
    const { sampled, changes } = this.#blocksOf(name, [width, height], before.format);
    march(sampled, { ...ALL_PIXELS, marched: MARCHED.sampled, turn });
    const program = this.#compiled.get(NAME, () => device.compile(NAME, DEFINES, {}));
    device.set(program, { before: UNIT.before, sampled: UNIT.sampled, turn, tolerance });
    device.use(before, UNIT.before);
    device.use(sampled.rgba, UNIT.sampled);
    device.draw(program, changes.handle, [0, 0, changes.width, changes.height]);
    return { marched: MARCHED.changed, turn, sampled: sampled.rgba, changes: changes.rgba, before };
  }

  release(): void {
    this.#compiled.release();
    for (const blocks of this.#blocks.values()) this.#release(blocks);
    this.#blocks.clear();
  }

  #blocksOf(name: string, size: readonly number[], format: Format): Blocks {
    const [columns, rows] = size.map((side) => Math.ceil(side / BLOCK));
    const known = this.#blocks.get(name);
    if (known?.sampled.width === columns && known.sampled.height === rows) return known;
    if (known) this.#release(known);
    const target = (kept: Format): Target => {
      const rgba = this.device.texture(kept, [columns, rows], false);
      return { ...this.device.framebuffer([rgba]), rgba, sums: null };
    };
    const blocks = { sampled: target(format), changes: target('rgba8') };
    this.#blocks.set(name, blocks);
    return blocks;
  }

  #release(blocks: Blocks): void {
    for (const { rgba, handle, width, height } of Object.values(blocks)) {
      this.device.release(rgba);
      this.device.release({ handle, width, height });
    }
  }
}
