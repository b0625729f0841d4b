/**
 * The weights of a scene's decoder, and where its planes lie, for march.glsl: numbers of a uniform block or constants.
 *
 * A block serves explicit decoders whose colours depend on the view: most of their weights are used once for a ray, so
 * a loop over them costs little, while writing them out makes most of the shader. Scenes of the same shape then share
 * programs. Other decoders use theirs at every sample, where constants are faster.
 */

import type { Layout } from './atlas.js';
import { RenderError } from './context.js';
import { BLOCK, type Device, type UniformBuffer } from './device.js';
import type { SceneSource } from './scene_source.js';
import { type ConstantArray, constants, type Defines, uniformBlock, type Written } from './shader.js';
import { blockArrays, decoderArrays, decoderShape } from './shader_constants.js';

// vec4s of decoder weights that a shader may hold, as on the desktop; compilers choke on more.
const MOST_CONSTANTS = 8192;
const VEC4_BYTES = 16;

export class SceneNumbers {
  readonly #device: Device;
  readonly #scene: SceneSource;
  readonly #isBlock: boolean;
  /** The decoder's weights as constants. */
  #weights: string | null = null;
  /** By layouts, which differ in their upsampling. */
  readonly #buffers = new Map<number, UniformBuffer>();

  constructor(device: Device, scene: SceneSource, layout: Layout) {
    this.#device = device;
    this.#scene = scene;
    const count = vectorsIn(decoderArrays(scene.decoder, scene, layout));
    if (count > MOST_CONSTANTS) {
      throw new RenderError(`the decoder has ${4 * count} weights, a shader takes ${4 * MOST_CONSTANTS}`);
    }
    const { HYBRID, HIDDEN } = decoderShape(scene.decoder);
    const bytes = VEC4_BYTES * vectorsIn(this.#arrays(layout));
    this.#isBlock = HYBRID === 0 && HIDDEN > 0 && bytes <= device.maxBlockSize;
  }

  /** Macros that say where the numbers are, and how to go through them. */
  get defines(): Defines {
    if (!this.#isBlock) return {};
    // Arrays lie in a processor's memory in any case.
    return { WEIGHTS_IN_BLOCK: 1, ...(this.#device.isSoftware ? { BASIS_IN_LOOP: 1 } : {}) };
  }

  /** Return the files that march.glsl includes. */
  files(layout: Layout): Written {
    const { first_layers, ...blocks } = blockArrays(this.#scene, layout);
    if (this.#isBlock) {
      return {
        decoder_weights: uniformBlock(BLOCK, this.#arrays(layout)).text,
        plane_blocks: constants({ first_layers }),
      };
    }
    this.#weights ??= constants(decoderArrays(this.#scene.decoder, this.#scene, layout));
    return { decoder_weights: this.#weights, plane_blocks: constants({ ...blocks, first_layers }) };
  }

  /** Have programs read the numbers for a layout. */
  use(layout: Layout): void {
    if (!this.#isBlock) return;
    let buffer = this.#buffers.get(layout.upsampling);
    if (buffer === undefined) {
      buffer = this.#device.uniformBuffer(uniformBlock(BLOCK, this.#arrays(layout)).numbers);
      this.#buffers.set(layout.upsampling, buffer);
    }
    this.#device.useBlock(buffer);
  }

  release(): void {
    for (const buffer of this.#buffers.values()) this.#device.release(buffer);
    this.#buffers.clear();
  }

  /** Return what a block holds: all that differs between scenes of the same shape. */
  #arrays(layout: Layout): Record<string, ConstantArray> {
    const { first_layers: _, ...blocks } = blockArrays(this.#scene, layout);
    return { ...decoderArrays(this.#scene.decoder, this.#scene, layout), ...blocks };
  }
}

const vectorsIn = (arrays: Readonly<Record<string, ConstantArray>>): number =>
  Object.values(arrays).reduce(
    (sum, { kind, values }) => sum + (kind === 'vec4' ? values.length / 4 : values.length),
    0,
  );
