/** Pictures that become part of someone else's, which has depths. */

import { CompiledPrograms } from './compiled.js';
import { DEPTH_FORMATS, type DepthFormat, type Device, type Framebuffer, type Texture } from './device.js';
import type { Picture } from './picture_job.js';
import type { Screen } from './presentation.js';
import { UNIT } from './scene_textures.js';
import type { Defines } from './shader.js';

const NAME = 'merge.glsl';
/** Opacities from which on a picture has colours, and depths that hide what is drawn after it. */
const LEAST_OPACITY = { colour: 1 / 512, depth: 0.5 };
/** Pixels around one whose samples may differ from the one that is known. */
const REACH = 0.75;
const DEFINES: Defines = { CONTRACTED: 0, NDC: 0 };

/** How the other picture is seen: 4x4 matrices, column by column. */
export interface Projection {
  /** From the scene to places in the viewport, shares of its size from below, and depths in [0, 1]. */
  projection: ArrayLike<number>;
  /** The inverse of that. */
  unprojection: ArrayLike<number>;
  eye: ArrayLike<number>;
  /** Whether a depth of 1 is near. */
  isReversed: boolean;
  /** Whether the other picture holds linear light, else what a screen takes. */
  isLinear: boolean;
}

/** How far rays see: what shaders of limits.glsl take. */
export interface Limits {
  depths: Texture;
  uniforms: Readonly<Record<string, ArrayLike<number>>>;
}

/** A copy of a framebuffer's depths. */
interface Copy {
  depths: Texture;
  framebuffer: Framebuffer;
}

export class Merging {
  readonly #compiled: CompiledPrograms;
  #copy: Copy | null = null;
  /** Depths that hide nothing, for framebuffers that let theirs not be copied. */
  readonly #nothing: Texture[];
  /** The format of the depths of framebuffers, or null where none can be copied; the canvas stands for itself. */
  readonly #formats = new WeakMap<object, { format: DepthFormat | null }>();

  constructor(readonly device: Device) {
    this.#compiled = new CompiledPrograms(device);
    this.#nothing = [1, 0].map((depth) => {
      const texture = device.texture('rgba8', [1, 1], false);
      device.write(texture, new Uint8Array(4).fill(255 * depth));
      return texture;
    });
  }

  isReady(): boolean {
    return this.#compiled.isReady(NAME, () => this.device.compile(NAME, DEFINES, {}));
  }

  /** Return how far rays of a picture see that goes to a screen, as far as its depths can be known. */
  limits(screen: Screen, { unprojection, isReversed }: Projection): Limits {
    const { x, y, width, height } = screen;
    const depths = this.#depthsOf(screen);
    const [across, along] = depths?.size ?? [1, 1];
    const part = depths ? [x / across, y / along, width / across, height / along] : [0, 0, 1, 1];
    const { gl } = this.device;
    gl.bindFramebuffer(gl.FRAMEBUFFER, screen.framebuffer);
    const reach = gl.getParameter(gl.SAMPLES) > 0 ? REACH : 0;
    return {
      depths: depths ?? this.#nothing[Number(isReversed)],
      uniforms: { unprojection, limits_part: part, limits_reach: [reach / across, reach / along] },
    };
  }

  /** Put the pictures of one or two groups into a screen. */
  show(screen: Screen, [first, second]: readonly Picture[], limits: Limits, seen: Projection): void {
    const { device } = this;
    const { x, y, width, height } = screen;
    const program = this.#compiled.get(NAME, () => device.compile(NAME, DEFINES, {}));
    const other = (second ?? first).target;
    device.set(program, {
      rgba: UNIT.rgba,
      sums: UNIT.sums,
      other_rgba: UNIT.otherRgba,
      other_sums: UNIT.otherSums,
      limits: UNIT.limits,
      other_share: second?.share ?? 0,
      viewport: [width, height],
      origin: [x, y],
      eye: seen.eye,
      projection: seen.projection,
      is_linear: seen.isLinear,
      ...limits.uniforms,
    });
    device.use(first.target.rgba, UNIT.rgba);
    device.use(first.target.sums ?? first.target.rgba, UNIT.sums);
    device.use(other.rgba, UNIT.otherRgba);
    device.use(other.sums ?? other.rgba, UNIT.otherSums);
    device.use(limits.depths, UNIT.limits);
    const depths = seen.isReversed ? 'falling' : 'rising';
    const viewport = [x, y, width, height] as const;
    device.set(program, { least_opacity: LEAST_OPACITY.colour });
    device.draw(program, screen.framebuffer, viewport, { blend: 'premultiplied', depths });
    device.set(program, { least_opacity: LEAST_OPACITY.depth });
    device.draw(program, screen.framebuffer, viewport, { isDepth: true, depths });
  }

  release(): void {
    this.#compiled.release();
    for (const texture of this.#nothing) this.device.release(texture);
    this.#releaseCopy();
  }

  /** Return a copy of a screen's depths, in the places that they have there; null if they cannot be copied. */
  #depthsOf(screen: Screen): Texture | null {
    const key = screen.framebuffer ?? this.device.gl.canvas;
    const known = this.#formats.get(key);
    if (known) return known.format && this.#copied(screen, known.format);
    const { gl } = this.device;
    while (gl.getError() !== gl.NO_ERROR); // errors of others
    const isCopied = (format: DepthFormat) => this.#copied(screen, format) && gl.getError() === gl.NO_ERROR;
    const format = (this.#hasDepths(screen) && DEPTH_FORMATS.find(isCopied)) || null;
    this.#formats.set(key, { format });
    return format && this.#copied(screen, format);
  }

  #hasDepths({ framebuffer }: Screen): boolean {
    const { gl } = this.device;
    if (framebuffer === null) return gl.getContextAttributes()?.depth ?? false;
    gl.bindFramebuffer(gl.FRAMEBUFFER, framebuffer);
    const type = gl.FRAMEBUFFER_ATTACHMENT_OBJECT_TYPE;
    return gl.getFramebufferAttachmentParameter(gl.FRAMEBUFFER, gl.DEPTH_ATTACHMENT, type) !== gl.NONE;
  }

  #copied({ framebuffer, x, y, width, height }: Screen, format: DepthFormat): Texture {
    const { gl } = this.device;
    const [right, top] = [x + width, y + height];
    const size = this.#copy?.depths.size ?? [0, 0];
    if (this.#copy?.depths.format !== format || size[0] < right || size[1] < top) {
      this.#releaseCopy();
      const depths = this.device.texture(format, [right, top], false);
      this.#copy = { depths, framebuffer: this.device.framebuffer([depths]) };
    }
    const { depths, framebuffer: into } = this.#copy as Copy;
    gl.bindFramebuffer(gl.READ_FRAMEBUFFER, framebuffer);
    gl.bindFramebuffer(gl.DRAW_FRAMEBUFFER, into.handle);
    gl.disable(gl.SCISSOR_TEST);
    gl.blitFramebuffer(x, y, right, top, x, y, right, top, gl.DEPTH_BUFFER_BIT, gl.NEAREST);
    return depths;
  }

  #releaseCopy(): void {
    if (this.#copy === null) return;
    this.device.release(this.#copy.framebuffer);
    this.device.release(this.#copy.depths);
    this.#copy = null;
  }
}
