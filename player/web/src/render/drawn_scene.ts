/** A scene that is ready to be drawn. */

import { type Camera, columnsOf } from './camera.js';
import type { Device, Framebuffer } from './device.js';
import { FOLDING, FoldedPlanes } from './folding.js';
import { ALL_PIXELS, type Pixels } from './following.js';
import type { Limits } from './merging.js';
import type { Quality } from './quality.js';
import { extentOf, type SceneSource } from './scene_source.js';
import { Programs, SceneTextures, UNIT } from './scene_textures.js';

/** What of a scene to draw into a target. */
export interface Shot {
  camera: Camera; // of the target's size
  time: number; // in [0, 1] over the scene
  quality: Quality;
  isMoving: boolean; // else the static part
  appearance: Float32Array | null; // an embedding; null is the average appearance
  background: ArrayLike<number>;
  isCounted?: boolean; // whether look-ups of cells are counted, too
  limits?: Limits | null; // how far rays see
  pixels?: Pixels; // which are marched; all if left out
}

/** Bytes of texels that are uploaded at once: to a card, and to a processor, for which they are made float32 before. */
const BYTES_AT_ONCE = { card: 1 << 18, processor: 1 << 16 };
/** Bytes that are uploaded before a frame at most: a hundredth of a second on a slow telephone. */
const BYTES_A_FRAME = 4 << 20;
/** Milliseconds of a frame after which the rest of the texels waits for the next one. */
const UPLOAD_MS = 6;

interface Parts {
  device: Device;
  textures: SceneTextures;
  programs: Programs;
  folded: FoldedPlanes | null;
}

export class DrawnScene {
  readonly source: SceneSource;
  #parts: Parts | null = null;
  #wasMade = false;

  constructor(source: SceneSource) {
    this.source = source;
  }

  /** Changes whenever the picture may have changed. */
  get version(): number {
    return this.source.version;
  }

  /** Upload rows of planes that have arrived, as many as a frame has time for. */
  upload(device: Device): void {
    const { textures, folded } = this.#on(device);
    const due = performance.now() + UPLOAD_MS;
    const atOnce = device.isSoftware ? BYTES_AT_ONCE.processor : BYTES_AT_ONCE.card;
    for (let bytes = 0; bytes < BYTES_A_FRAME; bytes += atOnce) {
      const taken = [...this.source.take(atOnce)];
      for (const rows of taken) {
        const block = textures.put(rows);
        folded?.planeChanged(block);
      }
      if (taken.length === 0 || performance.now() > due) break;
    }
  }

  /** Make what drawing needs on a device, unless it is there. */
  #on(device: Device): Parts {
    if (this.#parts?.device === device) return this.#parts;
    if (this.#wasMade) this.source.restore(); // what was made for a device before went with it
    this.#wasMade = true;
    const textures = new SceneTextures(device, this.source);
    this.#parts = { device, textures, programs: new Programs(device, textures), folded: null };
    return this.#parts;
  }

  /** Whether a picture can be drawn without waiting for compilers; have them begin if not. */
  isReady(device: Device, quality: Quality, isMoving: boolean, isLimited = false): boolean {
    const parts = this.#on(device);
    const { folded, layout, defines } = this.#way(parts, quality, { isMoving, isLimited });
    const areReady = [
      parts.programs.isReady('march.glsl', layout, defines),
      ...(folded ? FOLDING : []).map((name) => parts.programs.isReady(name, parts.textures.layout, {})),
    ];
    return areReady.every((isReady) => isReady);
  }

  /** Return how to march: through folded planes or not, their layout, and the macros of march.glsl. */
  #way(parts: Parts, quality: Quality, shot: { isMoving: boolean; isCounted?: boolean; isLimited: boolean }) {
    const { textures, programs } = parts;
    const isMoving = shot.isMoving && this.source.head.isDynamic;
    if (isMoving && quality.folded) parts.folded ??= new FoldedPlanes(textures, programs);
    const folded = isMoving && quality.folded ? parts.folded : null;
    const defines = {
      ROWS: Number(isMoving && !folded),
      MOTION: Number(isMoving && textures.motion !== null),
      COUNTED: Number(shot.isCounted ?? false),
      DEPTH_LIMIT: Number(shot.isLimited),
    };
    return { folded, layout: folded?.layout ?? textures.layout, defines };
  }

  /** March the rays of a target, or those of its rows from `firstRow` on, from below. */
  march(device: Device, target: Framebuffer, shot: Shot, firstRow = 0, rowCount = target.height): void {
    const parts = this.#on(device);
    const { textures, programs } = parts;
    const { head } = this.source;
    const { camera, time, quality, appearance, limits = null, pixels = ALL_PIXELS } = shot;
    const way = this.#way(parts, quality, { ...shot, isLimited: limits !== null });
    textures.setOccupancy(time);
    if (way.defines.MOTION) textures.setMotion(time);
    if (way.defines.ROWS) textures.setTimeRows(time);
    const planes = way.folded ? way.folded.at(time) : textures.planes;
    const program = programs.get('march.glsl', way.layout, way.defines);
    const stride = head.rayStep * quality.step;
    const columns = columnsOf(camera.pose);
    device.set(program, {
      stride,
      tau: stride / extentOf(this.source),
      termination: quality.termination,
      areas: textures.areas.bounds,
      background: shot.background,
      appearance: paddedCode(appearance, this.source.decoder.hidden),
      width: camera.width,
      height: camera.height,
      lens: [camera.focal[0], camera.focal[1], camera.centre[0], camera.centre[1]],
      axes: columns.slice(0, 9),
      eye: columns.slice(9),
      marched: pixels.marched,
      turn: pixels.turn,
      ...limits?.uniforms,
    });
    textures.bind(planes);
    // WebGL forbids that a texture is bound to a sampler while it is drawn into, so unused samplers get another one.
    device.use(pixels.sampled ?? planes, UNIT.sampled);
    device.use(pixels.changes ?? planes, UNIT.changes);
    device.use(pixels.before ?? planes, UNIT.before);
    if (limits) device.use(limits.depths, UNIT.limits);
    const { width, height } = target;
    device.draw(program, target.handle, [0, 0, width, height], { scissor: [0, firstRow, width, rowCount] });
  }

  /** Return the texels of planes and rows that a sample looks up, and those that folding writes for another time. */
  lookUps(isExact: boolean): { perSample: number; folding: number } {
    const features = this.#parts?.textures.layout.features ?? 0;
    const isFolded = this.source.head.isDynamic && !isExact;
    return {
      perSample: features * (isExact && this.source.head.isDynamic ? 6 : 3),
      folding: isFolded ? (this.#parts?.folded?.foldedTexels ?? 0) : 0,
    };
  }

  /** Bytes of its textures. */
  get memoryBytes(): number {
    return (this.#parts?.textures.memoryBytes ?? 0) + (this.#parts?.folded?.memoryBytes ?? 0);
  }

  release(): void {
    this.#parts?.folded?.release();
    this.#parts?.programs.release();
    this.#parts?.textures.release();
    this.#parts = null;
  }
}

/** Return an appearance's numbers as vec4s, padded with 0. */
function paddedCode(code: Float32Array | null, hidden: number): Float32Array {
  const padded = new Float32Array(4 * Math.ceil(hidden / 4));
  if (code !== null) {
    if (code.length !== hidden) throw new RangeError(`an appearance of ${code.length} numbers, not ${hidden}`);
    padded.set(code);
  }
  return padded;
}
