/** Pictures on the card, and how they come to their size and to the screen. */

import { CompiledPrograms } from './compiled.js';
import { RenderError } from './context.js';
import type { Compilation, Device, Framebuffer, Program, Texture } from './device.js';
import type { Setting } from './pace.js';
import type { Keeping } from './picture_job.js';
import { LEVELS } from './quality.js';
import { UNIT } from './scene_textures.js';
import type { Defines } from './shader.js';

/** Where a picture is shown: a part of a framebuffer, null being the canvas. */
export interface Screen {
  framebuffer: WebGLFramebuffer | null;
  x: number;
  y: number;
  width: number;
  height: number;
}

/**
 * A picture, rows from below: colour and opacity; if it is exact or has limits also the sum of weight times distance,
 * the numbers of samples and of look-ups, and the limit.
 */
export interface Target extends Framebuffer {
  readonly rgba: Texture;
  readonly sums: Texture | null;
}

/** What of pictures to show; the value is MODE of present.glsl. */
export const SHOWN = { colour: 0, difference: 1 } as const;

const modeOf = (isDifference: boolean): Defines => ({ MODE: isDifference ? SHOWN.difference : SHOWN.colour });

// Targets that are kept for the next use of their size: a picture of two groups, the next one, and a still one.
const TARGETS_KEPT = 8;

export class Presentation {
  readonly #compiled: CompiledPrograms;
  readonly #targets = new Map<string, Target>();
  #canvas: { shown: Texture; framebuffer: Framebuffer } | null = null;

  constructor(readonly device: Device) {
    this.#compiled = new CompiledPrograms(device);
  }

  /** Whether a picture can be shown without waiting for compilers; have them begin if not. */
  isReady({ level, scale }: Setting, isDifference: boolean): boolean {
    const { raysAcross, resolution } = LEVELS[level];
    const areReady = [
      this.#isReady('present.glsl', modeOf(isDifference)),
      raysAcross === 1 || this.#isReady('average.glsl'),
      resolution * scale === 1 || this.#isReady('enlarge.glsl'),
    ];
    return areReady.every((isReady) => isReady);
  }

  /** Return a target of a size; the last used are kept. */
  target(name: string, width: number, height: number, { isExact, limits = null }: Keeping): Target {
    const hasSums = isExact || limits !== null;
    const key = `${name} ${width} ${height} ${isExact} ${hasSums}`;
    const target = this.#targets.get(key) ?? this.#newTarget(width, height, isExact, hasSums);
    this.#targets.delete(key);
    this.#targets.set(key, target);
    if (this.#targets.size > TARGETS_KEPT) {
      const [oldest] = this.#targets.keys();
      this.#release(this.#targets.get(oldest) as Target);
      this.#targets.delete(oldest);
    }
    return target;
  }

  /** Whether a target is kept still. */
  holds(target: Target): boolean {
    return [...this.#targets.values()].includes(target);
  }

  /** Write the mean of `raysAcross` x `raysAcross` rays to each pixel of a target. */
  average(marched: Target, target: Target, raysAcross: number): Target {
    const program = this.#program('average.glsl');
    this.device.set(program, { rgba_rays: UNIT.rgba, sums_rays: UNIT.sums, rays_across: raysAcross });
    this.device.use(marched.rgba, UNIT.rgba);
    this.device.use(marched.sums ?? marched.rgba, UNIT.sums);
    this.device.draw(program, target.handle, [0, 0, target.width, target.height]);
    return target;
  }

  /**
   * Show a picture, stretched to the size of a screen by a cubic.
   * @param still the static part of the same picture, to be subtracted; null: nothing is.
   * @param opacity of the picture over what the screen shows.
   */
  show(screen: Screen, picture: Target, still: Target | null, opacity: number): void {
    const { device } = this;
    const { x, y, width, height } = screen;
    const viewport = [x, y, width, height] as const;
    const blend = opacity < 1 ? 'opacity' : undefined;
    const isSameSize = picture.width === width && picture.height === height;
    const canvas = isSameSize ? null : this.#canvasOf(picture.width, picture.height);
    const present = this.#program('present.glsl', modeOf(still !== null));
    device.set(present, {
      rgba: UNIT.rgba,
      sums: UNIT.sums,
      static_rgba: UNIT.staticRgba,
      viewport: [picture.width, picture.height],
      origin: canvas ? [0, 0] : [x, y],
      opacity: canvas ? 1 : opacity,
    });
    device.use(picture.rgba, UNIT.rgba);
    device.use(picture.sums ?? picture.rgba, UNIT.sums);
    device.use((still ?? picture).rgba, UNIT.staticRgba);
    if (canvas === null) {
      device.draw(present, screen.framebuffer, viewport, { blend });
      return;
    }
    device.draw(present, canvas.framebuffer.handle, [0, 0, picture.width, picture.height]);
    const enlarge = this.#program('enlarge.glsl');
    device.set(enlarge, { shown_small: UNIT.rgba, viewport: [width, height], origin: [x, y], opacity });
    device.use(canvas.shown, UNIT.rgba);
    device.draw(enlarge, screen.framebuffer, viewport, { blend });
  }

  release(): void {
    this.#compiled.release();
    for (const target of this.#targets.values()) this.#release(target);
    this.#targets.clear();
    this.#releaseCanvas();
  }

  #program(name: string, defines: Defines = {}): Program {
    return this.#compiled.get(JSON.stringify([name, defines]), () => this.#begin(name, defines));
  }

  #isReady(name: string, defines: Defines = {}): boolean {
    return this.#compiled.isReady(JSON.stringify([name, defines]), () => this.#begin(name, defines));
  }

  #begin(name: string, defines: Defines): Compilation {
    return this.device.compile(name, { CONTRACTED: 0, NDC: 0, ...defines }, {});
  }

  #newTarget(width: number, height: number, isExact: boolean, hasSums: boolean): Target {
    const { device } = this;
    if (Math.max(width, height) > device.maxTextureSize) {
      throw new RenderError(`a picture of ${width}x${height} is larger than ${device.name} takes`);
    }
    const format = device.drawsFloat32 && isExact ? 'rgba32f' : 'rgba16f';
    const rgba = device.texture(format, [width, height], false);
    const sums = hasSums ? device.texture(format, [width, height], false) : null;
    return { ...device.framebuffer(sums ? [rgba, sums] : [rgba]), rgba, sums };
  }

  #release(target: Target): void {
    this.device.release(target.rgba);
    if (target.sums) this.device.release(target.sums);
    this.device.release({ handle: target.handle, width: target.width, height: target.height });
  }

  #canvasOf(width: number, height: number) {
    if (this.#canvas?.framebuffer.width !== width || this.#canvas.framebuffer.height !== height) {
      this.#releaseCanvas();
      const shown = this.device.texture('rgba8', [width, height], false);
      this.#canvas = { shown, framebuffer: this.device.framebuffer([shown]) };
    }
    return this.#canvas as { shown: Texture; framebuffer: Framebuffer };
  }

  #releaseCanvas(): void {
    if (this.#canvas === null) return;
    this.device.release(this.#canvas.framebuffer);
    this.device.release(this.#canvas.shown);
    this.#canvas = null;
  }
}
