/** WebGL2: what it can do, and the objects made of it, which are counted so that nothing is left behind. */

import { fromHalves } from '../container/scene_chunks.js';
import { RenderError } from './context.js';
import { compose, type Defines, firstError, type Written } from './shader.js';

const SOFTWARE = /swiftshader|llvmpipe|softpipe|software|basic render/i;

/** How numbers of a texture are kept. */
export type Format = 'rgba32f' | 'rgba16f' | 'rgba8' | 'rg32f' | 'rg16f' | 'r8ui' | DepthFormat;
export const DEPTH_FORMATS = ['depth24stencil8', 'depth24', 'depth32f', 'depth32fstencil8', 'depth16'] as const;
export type DepthFormat = (typeof DEPTH_FORMATS)[number];

/** How what is drawn joins what is there; by default it replaces it. */
export interface Blending {
  /** `opacity`: alpha is its share; `premultiplied`: colours are multiplied by alpha already. */
  blend?: 'opacity' | 'premultiplied';
  /** Only what is nearer than what is there, or as near, is drawn; that depths are `rising`: 0 is near. */
  depths?: 'rising' | 'falling';
  /** Keep depths, and no colours. */
  isDepth?: boolean;
  /** The rectangle to draw, x, y, width and height; all if left out. */
  scissor?: readonly [number, number, number, number];
}

export interface Texture {
  readonly handle: WebGLTexture;
  readonly format: Format;
  readonly size: readonly number[]; // width, height and, of a volume, depth
}

/** Numbers that shaders hold in a uniform block. */
export interface UniformBuffer {
  readonly handle: WebGLBuffer;
  readonly bytes: number;
}

export interface Framebuffer {
  readonly handle: WebGLFramebuffer;
  readonly width: number;
  readonly height: number;
}

export interface Program {
  readonly handle: WebGLProgram;
  /** Where uniforms are, by their names; compilers drop unused ones. */
  readonly uniforms: ReadonlyMap<string, { type: number; location: WebGLUniformLocation }>;
}

/** A program that is being compiled. */
export interface Compilation {
  readonly handle: WebGLProgram;
  readonly stages: readonly { shader: WebGLShader; files: string[] }[];
  /** Signalled once it is compiled, where the browser does not tell otherwise. */
  readonly fence: WebGLSync | null;
}

/** The name of the uniform block that shaders may have. */
export const BLOCK = 'SceneNumbers';

const BYTES: Record<Format, number> = {
  ...{ rgba32f: 16, rgba16f: 8, rgba8: 4, rg32f: 8, rg16f: 4, r8ui: 1 },
  ...{ depth24stencil8: 4, depth24: 4, depth32f: 4, depth32fstencil8: 8, depth16: 2 },
};

export const bytesOf = ({ format, size }: Texture): number => BYTES[format] * size.reduce((a, b) => a * b);

export class Device {
  readonly maxTextureSize: number;
  readonly maxVolumeSize: number;
  /** Bytes of a uniform block. */
  readonly maxBlockSize: number;
  /** Where a buffer is bound to BLOCK; other code on the page begins with 0. */
  readonly #blockBinding: number;
  /** Whether float32 textures can be filtered; many telephones filter float16 only. */
  readonly filtersFloat32: boolean;
  /** Whether float32 textures can be drawn to; otherwise float16. */
  readonly drawsFloat32: boolean;
  /** What draws: the name of the card and its driver, as far as the browser reports it. */
  readonly name: string;
  /** Whether a processor stands in for a graphics card. */
  readonly isSoftware: boolean;
  /** How planes are kept: cards look up float16 at twice the rate of float32, SwiftShader at two thirds. */
  readonly planeFormat: 'rgba16f' | 'rgba32f';
  /** Whether textures are to take little memory, since there was not enough for the usual ones. */
  readonly isSparing: boolean;
  #objects = 0;
  #hasNewTextures = false;
  /** Signalled once the card has made the textures that `hasMemory` asks for. */
  #question: WebGLSync | null = null;
  readonly #vertices: WebGLVertexArrayObject;
  /** Until when programs may be taken in this frame: each waits a little for the card. */
  takesUntil = 0;
  readonly #compiling = new Set<Compilation>();
  readonly #parallel: KHR_parallel_shader_compile | null;

  constructor(
    readonly gl: WebGL2RenderingContext,
    { halfFloat = false, isSparing = false }: { halfFloat?: boolean; isSparing?: boolean } = {},
  ) {
    const drawsFloat32 = gl.getExtension('EXT_color_buffer_float') !== null;
    if (!drawsFloat32 && gl.getExtension('EXT_color_buffer_half_float') === null) {
      throw new RenderError('WebGL2 of this browser cannot draw to textures of float numbers; use another', 'no-webgl');
    }
    this.isSparing = isSparing;
    this.drawsFloat32 = drawsFloat32 && !halfFloat;
    this.filtersFloat32 = gl.getExtension('OES_texture_float_linear') !== null && !halfFloat;
    const info = gl.getExtension('WEBGL_debug_renderer_info');
    this.name = String(gl.getParameter(info ? info.UNMASKED_RENDERER_WEBGL : gl.RENDERER));
    this.isSoftware = SOFTWARE.test(this.name);
    const isFloat32Fast = this.isSoftware && this.filtersFloat32 && this.drawsFloat32;
    this.planeFormat = isFloat32Fast && !isSparing ? 'rgba32f' : 'rgba16f';
    this.#parallel = gl.getExtension('KHR_parallel_shader_compile');
    this.maxTextureSize = gl.getParameter(gl.MAX_TEXTURE_SIZE);
    this.maxVolumeSize = gl.getParameter(gl.MAX_3D_TEXTURE_SIZE);
    this.maxBlockSize = gl.getParameter(gl.MAX_UNIFORM_BLOCK_SIZE);
    this.#blockBinding = gl.getParameter(gl.MAX_UNIFORM_BUFFER_BINDINGS) - 1;
    this.#vertices = this.#made(gl.createVertexArray());
  }

  /** The objects that are there at present. */
  get objects(): number {
    return this.#objects;
  }

  texture(format: Format, size: readonly number[], isFiltered: boolean): Texture {
    const { gl } = this;
    const handle = this.#made(gl.createTexture());
    this.#hasNewTextures = true;
    const target = size.length === 3 ? gl.TEXTURE_3D : gl.TEXTURE_2D;
    gl.bindTexture(target, handle);
    const [width, height, depth] = size;
    const kept = this.#formats(format)[0];
    if (target === gl.TEXTURE_3D) gl.texStorage3D(target, 1, kept, width, height, depth);
    else gl.texStorage2D(target, 1, kept, width, height);
    const filter = isFiltered ? gl.LINEAR : gl.NEAREST;
    gl.texParameteri(target, gl.TEXTURE_MIN_FILTER, filter);
    gl.texParameteri(target, gl.TEXTURE_MAG_FILTER, filter);
    for (const side of [gl.TEXTURE_WRAP_S, gl.TEXTURE_WRAP_T, gl.TEXTURE_WRAP_R]) {
      gl.texParameteri(target, side, gl.CLAMP_TO_EDGE);
    }
    return { handle, format, size };
  }

  /** Whether `hasMemory` is waiting for the card; it answers without holding up the page if nothing is given to it. */
  get isAsked(): boolean {
    return this.#question !== null;
  }

  /**
   * Return whether there was memory for all textures that have been made, and for framebuffers.
   * @returns null: the card has not come to them yet; ask again.
   */
  hasMemory(): boolean | null {
    const { gl } = this;
    if (this.#question === null) {
      if (!this.#hasNewTextures) return true;
      this.#hasNewTextures = false;
      this.#question = gl.fenceSync(gl.SYNC_GPU_COMMANDS_COMPLETE, 0);
      gl.flush();
    }
    const isAnswered = this.#question === null || gl.getSyncParameter(this.#question, gl.SYNC_STATUS) === gl.SIGNALED;
    if (!isAnswered && !gl.isContextLost()) return null;
    gl.deleteSync(this.#question);
    this.#question = null;
    let isLacking = false;
    for (let error = gl.getError(); error !== gl.NO_ERROR; error = gl.getError()) {
      if (error === gl.CONTEXT_LOST_WEBGL) return true;
      isLacking ||= error === gl.OUT_OF_MEMORY;
    }
    return !isLacking;
  }

  /** Replace a part of a texture, all of it or the rectangle of `size` texels at (x, y); Uint16 are halves. */
  write(
    texture: Texture,
    given: Uint8Array | Uint16Array | Float32Array,
    x = 0,
    y = 0,
    size: readonly number[] = texture.size,
  ): void {
    const { gl } = this;
    const [, layout] = this.#formats(texture.format);
    // WebGL does not turn halves into float32 by itself.
    const isWidened = given instanceof Uint16Array && texture.format === 'rgba32f';
    const values = isWidened ? fromHalves(given) : given;
    const isHalf = values instanceof Uint16Array;
    const type = isHalf ? gl.HALF_FLOAT : values instanceof Uint8Array ? gl.UNSIGNED_BYTE : gl.FLOAT;
    this.#resetUnpacking();
    if (texture.size.length === 3) {
      gl.bindTexture(gl.TEXTURE_3D, texture.handle);
      gl.texSubImage3D(gl.TEXTURE_3D, 0, 0, 0, 0, size[0], size[1], size[2], layout, type, values);
    } else {
      gl.bindTexture(gl.TEXTURE_2D, texture.handle);
      gl.texSubImage2D(gl.TEXTURE_2D, 0, x, y, size[0], size[1], layout, type, values);
    }
  }

  use(texture: Texture, unit: number): void {
    const { gl } = this;
    gl.activeTexture(gl.TEXTURE0 + unit);
    gl.bindTexture(texture.size.length === 3 ? gl.TEXTURE_3D : gl.TEXTURE_2D, texture.handle);
  }

  uniformBuffer(values: Float32Array<ArrayBuffer>): UniformBuffer {
    const { gl } = this;
    const handle = this.#made(gl.createBuffer());
    gl.bindBuffer(gl.UNIFORM_BUFFER, handle);
    gl.bufferData(gl.UNIFORM_BUFFER, values, gl.STATIC_DRAW);
    return { handle, bytes: values.byteLength };
  }

  useBlock({ handle }: UniformBuffer): void {
    this.gl.bindBufferBase(this.gl.UNIFORM_BUFFER, this.#blockBinding, handle);
  }

  framebuffer(textures: readonly Texture[]): Framebuffer {
    const { gl } = this;
    const handle = this.#made(gl.createFramebuffer());
    const [width, height] = textures[0].size;
    gl.bindFramebuffer(gl.FRAMEBUFFER, handle);
    const places = textures.map(({ format }, i) => {
      if (!format.startsWith('depth')) return gl.COLOR_ATTACHMENT0 + i;
      return format.includes('stencil') ? gl.DEPTH_STENCIL_ATTACHMENT : gl.DEPTH_ATTACHMENT;
    });
    textures.forEach((texture, i) => {
      gl.framebufferTexture2D(gl.FRAMEBUFFER, places[i], gl.TEXTURE_2D, texture.handle, 0);
    });
    gl.drawBuffers(places.map((place, i) => (place === gl.COLOR_ATTACHMENT0 + i ? place : gl.NONE)));
    return { handle, width, height };
  }

  /** Begin to compile a fragment shader that is drawn over a whole viewport. */
  compile(name: string, defines: Defines, written: Written): Compilation {
    const { gl } = this;
    const handle = this.#made(gl.createProgram());
    const stages = [
      { type: gl.VERTEX_SHADER, ...compose('fullscreen.glsl') },
      { type: gl.FRAGMENT_SHADER, ...compose(name, defines, written) },
    ].map(({ type, text, files }) => {
      const shader = gl.createShader(type) as WebGLShader;
      gl.shaderSource(shader, text);
      gl.compileShader(shader);
      gl.attachShader(handle, shader);
      return { shader, files };
    });
    gl.linkProgram(handle);
    if (!this.#parallel) gl.validateProgram(handle); // has the card link now, not when the result is asked for
    const fence = this.#parallel ? null : gl.fenceSync(gl.SYNC_GPU_COMMANDS_COMPLETE, 0);
    gl.flush();
    const compilation = { handle, stages, fence };
    this.#compiling.add(compilation);
    return compilation;
  }

  /** Whether programs are being compiled; as long as they are, `program` would wait, whichever is asked for. */
  get isCompiling(): boolean {
    for (const compilation of this.#compiling) {
      if (!this.#isCompiled(compilation)) return true;
      this.#compiling.delete(compilation);
    }
    return false;
  }

  /** Return what has been compiled; wait for it if necessary. */
  program(compilation: Compilation): Program {
    const { gl } = this;
    const { handle, stages, fence } = compilation;
    gl.deleteSync(fence);
    this.#compiling.delete(compilation);
    const isLinked = gl.getProgramParameter(handle, gl.LINK_STATUS) || gl.isContextLost();
    const error = isLinked ? null : this.#errorOf(compilation);
    for (const { shader } of stages) gl.deleteShader(shader);
    if (error !== null) {
      this.release({ handle, uniforms: new Map() });
      throw error;
    }
    const block = gl.getUniformBlockIndex(handle, BLOCK);
    if (block !== gl.INVALID_INDEX) gl.uniformBlockBinding(handle, block, this.#blockBinding);
    return { handle, uniforms: this.#uniforms(handle) };
  }

  /** Delete a program that is being compiled. */
  abandon(compilation: Compilation): void {
    const { gl } = this;
    const { handle, stages, fence } = compilation;
    gl.deleteSync(fence);
    this.#compiling.delete(compilation);
    for (const { shader } of stages) gl.deleteShader(shader);
    this.release({ handle, uniforms: new Map() });
  }

  #isCompiled({ handle, fence }: Compilation): boolean {
    const { gl } = this;
    if (this.#parallel) return gl.getProgramParameter(handle, this.#parallel.COMPLETION_STATUS_KHR);
    return fence === null || gl.getSyncParameter(fence, gl.SYNC_STATUS) === gl.SIGNALED;
  }

  /** Return why a program does not link; each question waits for the card, so none is asked of one that does. */
  #errorOf({ handle, stages }: Compilation): RenderError {
    const { gl } = this;
    const failed = stages.find(({ shader }) => !gl.getShaderParameter(shader, gl.COMPILE_STATUS)) ?? stages[1];
    const log = gl.getShaderInfoLog(failed.shader) || gl.getProgramInfoLog(handle) || 'does not link';
    return new RenderError(`${firstError(log, failed.files)} (driver: ${this.name}); update it`);
  }

  /** Set the uniforms that a program has: whole numbers and samplers by number, all else by the length of its array. */
  set(program: Program, values: Readonly<Record<string, number | boolean | ArrayLike<number>>>): void {
    const { gl } = this;
    gl.useProgram(program.handle);
    for (const [name, value] of Object.entries(values)) {
      const found = program.uniforms.get(name);
      if (found === undefined) continue;
      const { type, location } = found;
      const numbers = typeof value === 'object' ? Float32Array.from(value) : Float32Array.of(Number(value));
      if (type === gl.FLOAT) gl.uniform1fv(location, numbers);
      else if (type === gl.FLOAT_VEC2) gl.uniform2fv(location, numbers);
      else if (type === gl.FLOAT_VEC3) gl.uniform3fv(location, numbers);
      else if (type === gl.FLOAT_VEC4) gl.uniform4fv(location, numbers);
      else if (type === gl.FLOAT_MAT4) gl.uniformMatrix4fv(location, false, numbers);
      else if (type === gl.FLOAT_MAT3) gl.uniformMatrix3fv(location, false, numbers);
      else if (type === gl.FLOAT_MAT4x3) gl.uniformMatrix4x3fv(location, false, numbers);
      else gl.uniform1i(location, Number(value));
    }
  }

  /** Draw over a viewport of a framebuffer, null being the canvas. */
  draw(
    program: Program,
    into: WebGLFramebuffer | null,
    viewport: readonly [number, number, number, number],
    { blend, depths, isDepth = false, scissor }: Blending = {},
  ): void {
    const { gl } = this;
    gl.bindFramebuffer(gl.FRAMEBUFFER, into);
    gl.viewport(...viewport);
    for (const test of [gl.DEPTH_TEST, gl.STENCIL_TEST, gl.CULL_FACE, gl.BLEND, gl.SCISSOR_TEST]) gl.disable(test);
    gl.colorMask(!isDepth, !isDepth, !isDepth, !isDepth);
    if (blend) {
      gl.enable(gl.BLEND);
      gl.blendEquation(gl.FUNC_ADD);
      const factor = blend === 'opacity' ? gl.SRC_ALPHA : gl.ONE;
      gl.blendFuncSeparate(factor, gl.ONE_MINUS_SRC_ALPHA, gl.ONE, gl.ONE_MINUS_SRC_ALPHA);
    }
    if (depths) {
      gl.enable(gl.DEPTH_TEST);
      gl.depthFunc(depths === 'rising' ? gl.LEQUAL : gl.GEQUAL);
      gl.depthMask(isDepth);
      gl.depthRange(0, 1);
    }
    if (scissor !== undefined) {
      gl.enable(gl.SCISSOR_TEST);
      gl.scissor(...scissor);
    }
    gl.useProgram(program.handle);
    gl.bindVertexArray(this.#vertices);
    gl.drawArrays(gl.TRIANGLES, 0, 3);
    gl.bindVertexArray(null);
    for (const test of [gl.BLEND, gl.DEPTH_TEST, gl.SCISSOR_TEST]) gl.disable(test);
  }

  /** Read what a framebuffer holds of one of its textures: float RGBA, rows from below. */
  read({ handle, width, height }: Framebuffer, attachment: number): Float32Array {
    const { gl } = this;
    const out = new Float32Array(4 * width * height);
    gl.bindFramebuffer(gl.FRAMEBUFFER, handle);
    gl.readBuffer(gl.COLOR_ATTACHMENT0 + attachment);
    gl.readPixels(0, 0, width, height, gl.RGBA, gl.FLOAT, out);
    gl.readBuffer(gl.COLOR_ATTACHMENT0);
    return out;
  }

  /** Delete an object. */
  release(object: Texture | Framebuffer | Program | UniformBuffer): void {
    const { gl } = this;
    if ('format' in object) gl.deleteTexture(object.handle);
    else if ('uniforms' in object) gl.deleteProgram(object.handle);
    else if ('bytes' in object) gl.deleteBuffer(object.handle);
    else gl.deleteFramebuffer(object.handle);
    this.#objects--;
  }

  /** Delete what the device itself has made. */
  dispose(): void {
    this.gl.deleteSync(this.#question);
    this.#question = null;
    this.gl.deleteVertexArray(this.#vertices);
    this.#objects--;
  }

  #made<T>(object: T | null): T {
    if (object === null) throw new RenderError('this browser has no more room for graphics; close other pages');
    this.#objects++;
    return object;
  }

  #uniforms(program: WebGLProgram): Map<string, { type: number; location: WebGLUniformLocation }> {
    const { gl } = this;
    const found = new Map<string, { type: number; location: WebGLUniformLocation }>();
    const count = gl.getProgramParameter(program, gl.ACTIVE_UNIFORMS) ?? 0;
    for (let i = 0; i < count; i++) {
      const uniform = gl.getActiveUniform(program, i);
      const location = uniform && gl.getUniformLocation(program, uniform.name);
      if (uniform && location) found.set(uniform.name.replace(/\[0\]$/, ''), { type: uniform.type, location });
    }
    return found;
  }

  /** Undo what other code on the page may have set for uploads. */
  #resetUnpacking(): void {
    const { gl } = this;
    gl.bindBuffer(gl.PIXEL_UNPACK_BUFFER, null);
    for (const name of [gl.UNPACK_ROW_LENGTH, gl.UNPACK_IMAGE_HEIGHT, gl.UNPACK_SKIP_ROWS, gl.UNPACK_SKIP_PIXELS]) {
      gl.pixelStorei(name, 0);
    }
    gl.pixelStorei(gl.UNPACK_ALIGNMENT, 1);
    gl.pixelStorei(gl.UNPACK_FLIP_Y_WEBGL, false);
    gl.pixelStorei(gl.UNPACK_PREMULTIPLY_ALPHA_WEBGL, false);
  }

  /** Return the internal format of a texture, and the layout of what is written to it. */
  #formats(format: Format): [number, number] {
    const { gl } = this;
    const known: Record<Format, [number, number]> = {
      rgba32f: [gl.RGBA32F, gl.RGBA],
      rgba16f: [gl.RGBA16F, gl.RGBA],
      rgba8: [gl.RGBA8, gl.RGBA],
      rg32f: [gl.RG32F, gl.RG],
      rg16f: [gl.RG16F, gl.RG],
      r8ui: [gl.R8UI, gl.RED_INTEGER],
      depth24stencil8: [gl.DEPTH24_STENCIL8, gl.DEPTH_STENCIL],
      depth24: [gl.DEPTH_COMPONENT24, gl.DEPTH_COMPONENT],
      depth32f: [gl.DEPTH_COMPONENT32F, gl.DEPTH_COMPONENT],
      depth32fstencil8: [gl.DEPTH32F_STENCIL8, gl.DEPTH_STENCIL],
      depth16: [gl.DEPTH_COMPONENT16, gl.DEPTH_COMPONENT],
    };
    return known[format];
  }
}
