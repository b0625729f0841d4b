/** The textures of a scene, and the programs that read them. */

import { FeatureAreas } from './areas.js';
import { type Block, displacementsAt, Layout, rowWidth, timeRows } from './atlas.js';
import { columnsOf } from './camera.js';
import { RenderError } from './context.js';
import { bytesOf, type Device, type Program, type Texture } from './device.js';
import { SceneNumbers } from './scene_numbers.js';
import {
  occupancySlot,
  occupiedIn,
  type PlaneRows,
  type SceneSource,
  SPACE_PLANES,
  type SpacePlane,
} from './scene_source.js';
import type { Defines, Written } from './shader.js';
import { decoderShape, planesShape } from './shader_constants.js';
import { SharedPrograms } from './shared_programs.js';

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
  sampled: 5,
  changes: 6,
  before: 7,
} as const;

/** What shaders look up of a scene: planes, time rows, displacements and distances to occupied cells. */
export class SceneTextures {
  readonly layout: Layout;
  readonly planes: Texture;
  readonly rows: Texture;
  readonly cells: Texture;
  readonly motion: Texture | null = null;
  /** Areas of the scales, as far as planes have been put. */
  readonly areas: FeatureAreas;
  /** Blocks of the layout of which rows have been put; the others are 0. */
  readonly #filled = new Set<Block>();
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
    this.areas = new FeatureAreas(scene, this.layout);
    this.planes = device.texture(device.planeFormat, [this.layout.width, this.layout.height], true);
    const filtered = device.filtersFloat32 ? 'rgba32f' : 'rgba16f';
    this.rows = device.texture(filtered, [head.isDynamic ? rowWidth(scene) : 1, this.layout.lineCount], true);
    this.cells = device.texture('r8ui', occupancy.sizes.slice(1).reverse(), false);
    if (motion) this.motion = device.texture(filtered, motion.sizes.slice(1).reverse(), true);
  }

  /** Replace rows of a space plane; return its block. */
  put(rows: PlaneRows): Block {
    const { scale, plane, firstRow, rowCount, texels } = rows;
    this.areas.put(rows);
    const block = this.layout.block(scale, plane as SpacePlane);
    const { x, y, width } = block;
    this.device.write(this.planes, texels, x, y + firstRow, [width * this.layout.layers[scale], rowCount]);
    this.#filled.add(block);
    return block;
  }

  /** Blocks whose product with the others of their scale, the features, may be other than 0. */
  get featured(): Block[] {
    const { blocks } = this.layout;
    return blocks.filter(({ scale }) =>
      SPACE_PLANES.every((plane) => this.#filled.has(this.layout.block(scale, plane))),
    );
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

/** Return the macros that describe a scene whose planes lie in a layout. */
export function sceneDefines(scene: SceneSource, layout: Layout): Defines {
  return {
    ...planesShape(scene, layout),
    ...decoderShape(scene.decoder),
    APPEARANCE: Number(scene.appearances.length > 0),
    CONTRACTED: Number(scene.mapping?.mapping === 1),
    NDC: Number(scene.mapping?.mapping === 2),
  };
}

/** The programs of a scene, compiled when they are first needed for it or for a scene of the same shape. */
export class Programs {
  readonly #shared: SharedPrograms;
  readonly #numbers: SceneNumbers;
  /** What programs are known by to all scenes. */
  readonly #keys = new Map<string, string>();

  constructor(
    readonly device: Device,
    readonly textures: SceneTextures,
  ) {
    this.#shared = SharedPrograms.on(device);
    this.#numbers = new SceneNumbers(device, textures.scene, textures.layout);
  }

  /** Whether a program is compiled; begin with it if not. */
  isReady(name: string, layout: Layout, defines: Defines): boolean {
    const key = this.#keyOf(name, layout, defines);
    return this.#shared.isReady(this, key, () => this.device.compile(name, ...this.#parts(layout, defines)));
  }

  /** Return a program that reads planes in a layout; `defines` besides those that describe the scene. */
  get(name: string, layout: Layout, defines: Defines = {}): Program {
    const key = this.#keyOf(name, layout, defines);
    const begin = () => this.device.compile(name, ...this.#parts(layout, defines));
    const [program, isOthers] = this.#shared.get(this, key, begin);
    if (isOthers) this.#setConstant(program);
    this.#numbers.use(layout);
    return program;
  }

  /** Return the macros of a shader, and the files that are made for it. */
  #parts(layout: Layout, defines: Defines): [Defines, Written] {
    const macros = { ...sceneDefines(this.textures.scene, layout), COMPUTE: 0, COUNTED: 0, DEPTH_LIMIT: 0 };
    return [{ ...macros, ...this.#numbers.defines, ...defines }, this.#numbers.files(layout)];
  }

  #keyOf(name: string, layout: Layout, defines: Defines): string {
    const short = [name, layout.upsampling, ...Object.entries(defines).flat()].join(' ');
    const known = this.#keys.get(short);
    if (known !== undefined) return known;
    const key = JSON.stringify([name, ...this.#parts(layout, defines)]);
    this.#keys.set(short, key);
    return key;
  }

  /** Set all uniforms that never change for a scene. */
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
      sampled: UNIT.sampled,
      changes: UNIT.changes,
      before: UNIT.before,
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
    this.#shared.release(this);
    this.#numbers.release();
  }
}
