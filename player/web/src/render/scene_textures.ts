/** The textures of a scene, and the programs that read them. */

import { displacementsAt, Layout, rowWidth, timeRows } from './atlas.js';
import { columnsOf } from './camera.js';
import { CompiledPrograms } from './compiled.js';
import { RenderError } from './context.js';
import { bytesOf, type Compilation, type Device, type Program, type Texture } from './device.js';
import { occupancySlot, occupiedIn, type PlaneRows, type SceneSource, type SpacePlane } from './scene_source.js';
import { constants, type Defines } from './shader.js';
import { blockArrays, decoderArrays, decoderShape, planesShape } from './shader_constants.js';

/** Texture units. */
export const UNIT = {
  planes: 0,
  rows: 1,
  cells: 2,
  motion: 3,
  rgba: 0,
  sums: 1,
  staticRgba: 2,
  otherRgba: 2,
  otherSums: 3,
  limits: 4,
} as const;
// vec4s of decoder weights that a shader may hold, as on the desktop; compilers choke on more.
const MOST_CONSTANTS = 8192;

/** What shaders look up of a scene: planes, time rows, displacements and distances to occupied cells. */
export class SceneTextures {
  readonly layout: Layout;
  readonly planes: Texture;
  readonly rows: Texture;
  readonly cells: Texture;
  readonly motion: Texture | null = null;
  /** The slot whose cells are there, and whether with their distances. */
  #slot = '';
  /** Time and version of the rows. */
  #rows = '';
  #motionTime = Number.NaN;

  constructor(
    readonly device: Device,
    readonly scene: SceneSource,
  ) {
    const { occupancy, motion, head } = scene;
    this.layout = new Layout(scene);
    this.#refuseTooLarge();
    this.planes = device.texture(device.planeFormat, [this.layout.width, this.layout.height], true);
    const filtered = device.filtersFloat32 ? 'rgba32f' : 'rgba16f';
    this.rows = device.texture(filtered, [head.isDynamic ? rowWidth(scene) : 1, this.layout.lineCount], true);
    this.cells = device.texture('r8ui', occupancy.sizes.slice(1).reverse(), false);
    if (motion) this.motion = device.texture(filtered, motion.sizes.slice(1).reverse(), true);
  }

  /** Replace rows of a space plane. */
  put({ scale, plane, firstRow, rowCount, texels }: PlaneRows): void {
    const { x, y, width } = this.layout.block(scale, plane as SpacePlane);
    this.device.write(this.planes, texels, x, y + firstRow, [width * this.layout.layers[scale], rowCount]);
  }

  setTimeRows(time: number): void {
    const key = `${time} ${this.scene.version}`;
    if (key === this.#rows) return;
    this.device.write(this.rows, timeRows(this.scene, this.layout, time));
    this.#rows = key;
  }

  setMotion(time: number): void {
    if (time === this.#motionTime || this.motion === null || this.scene.motion === null) return;
    this.device.write(this.motion, displacementsAt(this.scene.motion, time));
    this.#motionTime = time;
  }

  setOccupancy(time: number): void {
    const slot = occupancySlot(this.scene, time);
    const distances = this.scene.distances(slot);
    const key = `${slot} ${distances !== null}`;
    if (key === this.#slot) return;
    // Until distances are known, empty cells count as next to occupied ones: rays take more steps.
    this.device.write(this.cells, distances ?? occupiedIn(this.scene, slot).map((isOccupied) => 1 - isOccupied));
    this.#slot = key;
  }

  /** Bind all textures to their units, `planes` being the scene's or planes that rows are folded into. */
  bind(planes: Texture): void {
    this.device.use(planes, UNIT.planes);
    this.device.use(this.rows, UNIT.rows);
    this.device.use(this.cells, UNIT.cells);
    if (this.motion) this.device.use(this.motion, UNIT.motion);
  }

  get #textures(): Texture[] {
    return [this.planes, this.rows, this.cells, ...(this.motion ? [this.motion] : [])];
  }

  get memoryBytes(): number {
    return this.#textures.reduce((sum, texture) => sum + bytesOf(texture), 0);
  }

  release(): void {
    for (const texture of this.#textures) this.device.release(texture);
  }

  #refuseTooLarge(): void {
    const { maxTextureSize, maxVolumeSize, name } = this.device;
    const { occupancy, motion } = this.scene;
    const needs: [string, readonly number[], number][] = [
      ['all planes need', [this.layout.width, this.layout.height], maxTextureSize],
      ['the occupancy grid needs', occupancy.sizes.slice(1).reverse(), maxVolumeSize],
      ['the motion grid needs', motion?.sizes.slice(1).reverse() ?? [], maxVolumeSize],
    ];
    for (const [what, size, most] of needs) {
      if (size.some((side) => side > most)) {
        throw new RenderError(`${what} a texture of ${size.join('x')}, ${name} takes ${most} a side`);
      }
    }
  }
}

const keyOf = (name: string, { upsampling }: Layout, defines: Defines) =>
  [name, upsampling, ...Object.entries(defines).flat()].join(' ');

/** Return the macros that describe a scene whose planes lie in a layout. */
export function sceneDefines(scene: SceneSource, layout: Layout): Defines {
  return {
    ...planesShape(layout),
    ...decoderShape(scene.decoder),
    APPEARANCE: Number(scene.appearances.length > 0),
    CONTRACTED: Number(scene.mapping?.mapping === 1),
    NDC: Number(scene.mapping?.mapping === 2),
  };
}

/** The programs of a scene, compiled when they are first needed, with all uniforms set that never change. */
export class Programs {
  readonly #decoderWeights: string;
  readonly #compiled: CompiledPrograms;

  constructor(
    readonly device: Device,
    readonly textures: SceneTextures,
  ) {
    const { scene, layout } = textures;
    const arrays = decoderArrays(scene.decoder, scene, layout);
    const count = Object.values(arrays).reduce((sum, { values }) => sum + values.length, 0);
    if (count > 4 * MOST_CONSTANTS) {
      throw new RenderError(`the decoder has ${count} weights, a shader takes ${4 * MOST_CONSTANTS}`);
    }
    this.#decoderWeights = constants(arrays);
    this.#compiled = new CompiledPrograms(device);
  }

  /** Whether a program is compiled; begin with it if not. */
  isReady(name: string, layout: Layout, defines: Defines): boolean {
    return this.#compiled.isReady(
      keyOf(name, layout, defines),
      () => this.#begin(name, layout, defines),
      (program) => this.#setConstant(program),
    );
  }

  /** Return a program that reads planes in a layout; `defines` besides those that describe the scene. */
  get(name: string, layout: Layout, defines: Defines = {}): Program {
    return this.#compiled.get(
      keyOf(name, layout, defines),
      () => this.#begin(name, layout, defines),
      (program) => this.#setConstant(program),
    );
  }

  #begin(name: string, layout: Layout, defines: Defines): Compilation {
    const { scene } = this.textures;
    const macros = { ...sceneDefines(scene, layout), COMPUTE: 0, COUNTED: 0, DEPTH_LIMIT: 0, ...defines };
    const written = { decoder_weights: this.#decoderWeights, plane_blocks: constants(blockArrays(scene, layout)) };
    return this.device.compile(name, macros, written);
  }

  #setConstant(program: Program): void {
    const { scene, rows, motion } = this.textures;
    const { aabb } = scene.head;
    this.device.set(program, {
      rgba_picture: UNIT.rgba,
      planes: UNIT.planes,
      rows: UNIT.rows,
      cells: UNIT.cells,
      motion: UNIT.motion,
      limits: UNIT.limits,
      nodes: motion?.size ?? [1, 1, 1],
      rows_texel: rows.size.map((side) => 1 / side),
      cell_count: scene.occupancy.sizes.slice(1).reverse(),
      box_low: [aabb[0], aabb[1], aabb[2]],
      box_high: [aabb[3], aabb[4], aabb[5]],
    });
    if (scene.mapping?.mapping === 1) this.device.set(program, { uniform_distance: scene.mapping.uniformDistance });
    if (scene.mapping?.mapping === 2) {
      const { referencePose, near, baseline } = scene.mapping;
      this.device.set(program, { frame: columnsOf(referencePose), near, baseline });
    }
  }

  release(): void {
    this.#compiled.release();
  }
}
