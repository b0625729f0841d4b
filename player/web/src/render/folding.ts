/** Folding: once a frame, the time rows are multiplied into the space planes, as kpc.player.gl.folding explains. */

import { type Block, isFoldedAlongRows, Layout, rowWidth, timeRows } from './atlas.js';
import { bytesOf, type Device, type Framebuffer, type Texture } from './device.js';
import { type Programs, type SceneTextures, UNIT } from './scene_textures.js';

/** The shaders that fold. */
export const FOLDING = ['upsample_plane.glsl', 'fold.glsl'] as const;
const UPSAMPLING = 2;
const LARGEST_HALF = 65504;

/** The planes of a dynamic scene at one time. */
export class FoldedPlanes {
  readonly layout: Layout;
  readonly #device: Device;
  readonly #upsampled: Texture;
  readonly #rows: Texture;
  readonly #planes: Texture;
  readonly #upsampleInto: Framebuffer;
  readonly #foldInto: Framebuffer;
  /** Time and version of the folded planes. */
  #folded = '';
  /** Blocks of the scene that are upsampled as they are. */
  readonly #upsampledBlocks = new Set<Block>();
  /** The rows that are folded. */
  #foldedRows: Float32Array = new Float32Array(0);

  constructor(
    readonly textures: SceneTextures,
    readonly programs: Programs,
  ) {
    const { device, scene } = textures;
    const finer = new Layout(scene, UPSAMPLING);
    const fits = Math.max(finer.width, finer.height) <= device.maxTextureSize && !device.isSparing;
    this.layout = fits ? finer : textures.layout;
    const size = [this.layout.width, this.layout.height];
    const isFloat32 = device.drawsFloat32 && !device.isSparing;
    this.#device = device;
    this.#upsampled = device.texture(isFloat32 ? 'rgba32f' : 'rgba16f', size, false);
    this.#rows = device.texture('rgba32f', [rowWidth(scene, this.layout.upsampling), this.layout.lineCount], false);
    this.#planes = device.texture(device.planeFormat, size, true);
    this.#upsampleInto = device.framebuffer([this.#upsampled]);
    this.#foldInto = device.framebuffer([this.#planes]);
  }

  /** Texels that folding at another time looks up and writes. */
  get foldedTexels(): number {
    const { blocks, layers } = this.layout;
    return blocks.reduce((sum, block) => sum + block.width * layers[block.scale] * block.height, 0);
  }

  get memoryBytes(): number {
    return [this.#upsampled, this.#rows, this.#planes].reduce((sum, texture) => sum + bytesOf(texture), 0);
  }

  planeChanged(block: Block): void {
    this.#upsampledBlocks.delete(block);
    this.#folded = '';
  }

  /** Return the planes at a time in [0, 1]. Scales that lack a plane stay 0, as textures are made. */
  at(time: number): Texture {
    const { scene, layout } = this.textures;
    const key = `${time} ${scene.version}`;
    if (key !== this.#folded) {
      const blocks = this.textures.featured;
      const changed = blocks.filter((block) => !this.#upsampledBlocks.has(block));
      if (changed.length > 0) {
        this.#device.use(this.textures.planes, UNIT.planes);
        this.#drawBlocks(FOLDING[0], this.#upsampleInto, changed);
        for (const block of changed) this.#upsampledBlocks.add(block);
      }
      const rows = timeRows(scene, layout, time, this.layout.upsampling);
      const stale = blocks.filter((block) => changed.includes(block) || this.#haveChanged(rows, block));
      this.#device.write(this.#rows, rows);
      this.#device.use(this.#upsampled, UNIT.planes);
      this.#device.use(this.#rows, UNIT.rows);
      this.#drawBlocks(FOLDING[1], this.#foldInto, stale);
      this.#foldedRows = rows;
      this.#folded = key;
    }
    return this.#planes;
  }

  /** Whether the rows for a block are other than those that are folded; they never are where nothing moves. */
  #haveChanged(rows: Float32Array, block: Block): boolean {
    const { layout } = this.textures;
    const line = 4 * this.#rows.size[0];
    const [first, end] = [0, layout.layers[block.scale]].map((layer) => line * (layout.firstLine(block) + layer));
    const before = this.#foldedRows.subarray(first, end);
    return rows.subarray(first, end).some((number, at) => number !== before[at]);
  }

  /** Draw planes by a shader that takes as uniforms where each lies and which rows go with it. */
  #drawBlocks(name: string, into: Framebuffer, blocks: readonly Block[]): void {
    const source = this.textures.layout;
    const program = this.programs.get(name, source);
    this.#device.set(program, {
      upsampled: UNIT.planes,
      upsampled_texel: [1 / into.width, 1 / into.height],
      folded_rows_texel: this.#rows.size.map((side) => 1 / side),
      largest: LARGEST_HALF,
    });
    for (const block of blocks) {
      const written = this.layout.block(block.scale, block.plane);
      this.#device.set(program, {
        source: source.textureRectangle(block),
        source_width: block.width / source.width,
        origin: [written.x, written.y],
        width: written.width,
        per_texel: [1 / Math.max(written.width - 1, 1), 1 / Math.max(written.height - 1, 1)],
        along_rows: isFoldedAlongRows(written.plane),
        line: this.layout.firstLine(written),
      });
      const columns = this.layout.layers[written.scale] * written.width;
      this.#device.draw(program, into.handle, [written.x, written.y, columns, written.height]);
    }
  }

  release(): void {
    for (const object of [this.#upsampleInto, this.#foldInto, this.#upsampled, this.#rows, this.#planes]) {
      this.#device.release(object);
    }
  }
}
