/** A scene in a .kpc file: which chunks it needs, and what they hold (sections 4.3, 6, 7 and 10 of the spec). */

import type { Core, SegmentSymbols } from '../decoder/core.js';
import { decodeSegment, type Projection } from '../decoder/segment.js';
import { CODEC, type Entry, isCritical } from './chunk.js';
import { Container, type ContainerOptions } from './container.js';
import { BudgetError, FormatError } from './errors.js';
import { META_LIMIT, type Metadata, parseMetadata } from './metadata.js';
import {
  type Appearance,
  type Camera,
  Cursor,
  type DecoderWeights,
  isTimePlane,
  LIMIT,
  type Mapping,
  type MotionGrid,
  type OccupancyGrid,
  PLANES,
  type PlaneHead,
  type PlaneName,
  parseAppearances,
  parseCameras,
  parseDecoder,
  parseDecoderHead,
  parseHead,
  parseMapping,
  parseMotion,
  parseMotionHead,
  parseOccupancy,
  parseOccupancyHead,
  type Scale,
  type SceneHead,
} from './scene_chunks.js';
import { isShared } from './shared_planes.js';
import { parseSound, SOUND_LIMIT, type Sound, type SoundSegment, soundChunks, soundOf } from './sound.js';

export const KNOWN_KINDS = ['SCNE', 'WARP', 'MOVE', 'DECO', 'HYBR', 'OCCU', 'came', 'appe', 'meta', 'soun', 'PLNE'];
const HEAD_LIMIT = 58 + LIMIT.SCALE * (10 + 9 * 4 * LIMIT.CHANNEL);
/** The position of an axis, by its letter, in the sizes of OCCU. */
export const axisOf = (letter: string): number => 'tzyx'.indexOf(letter);

export interface SceneOptions extends ContainerOptions {
  /** Bytes that the scene may take. */
  memoryBudget?: number;
  /** Whether the caller never holds all planes, and accounts for the memory of those that it holds. */
  inParts?: boolean;
}

/** A plane of a file of which all or some rows are there; the values of the others come from `offset` alone. */
export interface PlaneSymbols extends SegmentSymbols {
  head: PlaneHead;
  offset: Float32Array;
}

/** Random access to the parts of a scene. Opening one checks that the index lists all that a scene needs. */
export class Scene {
  readonly container: Container;
  readonly head: SceneHead;
  readonly core: Core;
  readonly memoryBudget: number;
  /** The numbers of the soun chunks, in the order of time. */
  readonly soundNumbers: readonly number[];
  readonly #decoded = new Map<string, unknown>();
  readonly #counted = new Map<string, number>();

  constructor(bytes: Uint8Array, core: Core, options: SceneOptions = {}) {
    this.container = new Container(bytes, options);
    this.core = core;
    this.#checkKinds();
    this.head = parseHead(this.container.chunk(this.#only('SCNE')).content(HEAD_LIMIT));
    const { valueCount } = this.container.header;
    if (this.head.valueCount !== valueCount) {
      throw new FormatError(`the header claims ${valueCount} values, the scene ${this.head.valueCount}`);
    }
    this.memoryBudget = options.memoryBudget ?? 2 ** 31;
    this.#afford(options.inParts ? 0 : 5 * this.head.valueCount, 'its planes');
    this.#checkSegments();
    this.soundNumbers = soundChunks(this.container.index);
    this.#decoderNumber();
    this.#only('OCCU');
  }

  /** The mapping of space; null if the box bounds the scene. */
  get mapping(): Mapping | null {
    return this.#once('WARP', (number) => parseMapping(this.container.chunk(number).content(116), this.head));
  }

  /** The motion grid; null if there is none. */
  get motion(): MotionGrid | null {
    return this.#once('MOVE', (number, entry) => {
      this.#afford(8 * entry.rawLength, 'its motion grid');
      if (entry.codec !== CODEC.MOTION) return parseMotion(this.container.chunk(number).content(), this.head.isDynamic);
      const body = this.container.chunk(number).coded();
      const { count } = parseMotionHead(new Cursor(body, 'MOVE'), this.head.isDynamic);
      this.#checkClaim('MOVE', entry, 12 + 2 * count);
      return parseMotion(this.core.motion(body, entry.rawLength), this.head.isDynamic);
    });
  }

  /** The occupancy grid. */
  get occupancy(): OccupancyGrid {
    return this.#held('OCCU', (number, entry) => {
      this.#afford(8 * entry.rawLength, 'its occupancy grid');
      if (entry.codec !== CODEC.OCCUPANCY) return parseOccupancy(this.container.chunk(number).content());
      const body = this.container.chunk(number).coded();
      const { cells } = parseOccupancyHead(new Cursor(body, 'OCCU'));
      this.#checkClaim('OCCU', entry, 8 + Math.ceil(cells / 8));
      return parseOccupancy(this.core.occupancy(body, entry.rawLength));
    });
  }

  /** The weights of the decoder, DECO or HYBR. */
  get decoder(): DecoderWeights {
    const kind = this.container.index[this.#decoderNumber()].kind;
    return this.#held(kind, (number, entry) => {
      if (entry.codec !== CODEC.WEIGHTS) {
        const most = 10 + 2 * (LIMIT.HIDDEN + 3) * (4 * this.head.features + 2 * LIMIT.HIDDEN + 16);
        return parseDecoder(this.container.chunk(number).content(most), kind, this.head.features);
      }
      const body = this.container.chunk(number).coded();
      const { isHybrid, rawLength } = parseDecoderHead(new Cursor(body, kind), this.head.features);
      if (entry.rawLength !== rawLength) {
        throw new FormatError(`${kind}: claims ${entry.rawLength} bytes of weights, not those of its sizes`);
      }
      return parseDecoder(this.core.weights(isHybrid, body, rawLength), kind, this.head.features);
    });
  }

  /** The cameras; none if the file has, or has yet, no such chunk. */
  get cameras(): Camera[] {
    const found = this.#once('came', (number, entry) => {
      if (entry.codec !== CODEC.POSES) return parseCameras(this.container.chunk(number).content(2 + 68 * LIMIT.CAMERA));
      return parseCameras(this.core.poses(this.container.chunk(number).coded(), entry.rawLength));
    });
    return found ?? [];
  }

  /** The appearances; none if the file has, or has yet, no such chunk. */
  get appearances(): Appearance[] {
    const found = this.#once('appe', (number, entry) => {
      const { hidden } = this.decoder;
      this.#afford(4 * entry.rawLength, 'its appearances');
      const most = 4 + LIMIT.APPEARANCE * (2 * hidden + 1 + LIMIT.NAME);
      return parseAppearances(this.container.chunk(number).content(most), hidden);
    });
    return found ?? [];
  }

  /** The metadata; an empty object if the file has, or has yet, no such chunk. */
  get metadata(): Metadata {
    return this.#once('meta', (number) => parseMetadata(this.container.chunk(number).content(META_LIMIT))) ?? {};
  }

  /** The sound up to the first chunk that is not there; null if the file has, or has yet, none. */
  get sound(): Sound | null {
    const missing = this.soundNumbers.findIndex((number) => !this.container.available(number));
    const held = missing < 0 ? this.soundNumbers : this.soundNumbers.slice(0, missing);
    const bytes = held.reduce((sum, number) => sum + this.container.index[number].storedLength, 0);
    this.#afford(3 * bytes, 'its sound');
    return soundOf(held.map((number) => this.soundSegment(number)));
  }

  /** Read a soun chunk. */
  soundSegment(number: number): SoundSegment {
    const { index } = this.container;
    const total = this.soundNumbers.reduce((sum, one) => sum + index[one].rowCount, 0);
    return parseSound(this.container.chunk(number).content(SOUND_LIMIT), index[number].rowCount, total);
  }

  /** Return what SCNE says of the plane that a PLNE chunk is a segment of, and the name of the plane. */
  planeOf(entry: Entry): { name: PlaneName; plane: PlaneHead } {
    const name = PLANES[entry.plane] as PlaneName;
    return { name, plane: this.head.scales[entry.scale]?.[name] as PlaneHead };
  }

  /** Decode a PLNE chunk: symbols and coded texels of its rows. */
  segment(number: number): SegmentSymbols {
    const chunk = this.container.chunk(number);
    const { name, plane } = this.planeOf(chunk.entry);
    return decodeSegment(this.core, chunk, plane, () => this.projection(name));
  }

  /** Return the occupancy grid projected onto a plane. */
  projection(name: PlaneName): Projection {
    const { sizes, content } = this.occupancy;
    const cells: [number, number] = [sizes[axisOf(name[1])], sizes[axisOf(name[0])]];
    if (!this.#decoded.has(name)) {
      this.#afford(cells[0] * cells[1], `the projection of its occupancy onto ${name}`);
      this.#decoded.set(name, this.core.project(content, PLANES.indexOf(name), cells[0] * cells[1]));
    }
    return { projected: this.#decoded.get(name) as Uint8Array, cells };
  }

  /** Decode all planes, of which rows that are not there count as section 10 says. */
  planes(): Scale<PlaneSymbols>[] {
    const found: Scale<PlaneSymbols>[] = this.head.scales.map((scale) => {
      const planes: Scale<PlaneSymbols> = {};
      for (const name of PLANES) {
        const head = scale[name];
        if (head === undefined) continue;
        const texels = head.rows * head.columns;
        const offset = isTimePlane(name) ? head.offset : new Float32Array(head.channels);
        planes[name] = { head, symbols: new Int8Array(texels * head.channels), coded: new Uint8Array(texels), offset };
      }
      return planes;
    });
    for (const [number, entry] of this.container.index.entries()) {
      if (entry.kind !== 'PLNE' || !this.container.available(number)) continue;
      const { name, plane } = this.planeOf(entry);
      const { symbols, coded } = this.segment(number);
      const first = entry.rowStart * plane.columns;
      const into = found[entry.scale]?.[name] as PlaneSymbols;
      into.symbols.set(symbols, first * plane.channels);
      into.coded.set(coded, first);
      into.offset = plane.offset;
    }
    return found;
  }

  /** Return what `parse` makes of the one chunk of a kind, the first time; null if there is none, or not yet. */
  #once<T>(kind: string, parse: (number: number, entry: Entry) => T): T | null {
    if (!this.#decoded.has(kind)) {
      const number = this.container.index.some((entry) => entry.kind === kind) ? this.#only(kind) : -1;
      const isHeld = number >= 0 && (kind[0] < 'a' || this.container.available(number));
      this.#decoded.set(kind, isHeld ? parse(number, this.container.index[number]) : null);
    }
    return this.#decoded.get(kind) as T | null;
  }

  /** Return the same of a kind that every scene has. */
  #held<T>(kind: string, parse: (number: number, entry: Entry) => T): T {
    return this.#once(kind, parse) as T;
  }

  #checkClaim(kind: string, entry: Entry, length: number): void {
    if (entry.rawLength !== length) {
      throw new FormatError(`${kind}: claims ${entry.rawLength} bytes, not those of its sizes`);
    }
  }

  /** Count memory beside the planes against the budget, together with all that was counted before. */
  #afford(more: number, what: string): void {
    this.#counted.set(what, more);
    const needed = [...this.#counted.values()].reduce((a, b) => a + b, 0);
    if (needed > this.memoryBudget) {
      throw new BudgetError(
        `needs ${needed} bytes of memory with ${what}, more than the budget of ${this.memoryBudget}`,
      );
    }
  }

  /** Return the number of the one chunk of a kind. */
  #only(kind: string): number {
    const found = [...this.container.index.keys()].filter((number) => this.container.index[number].kind === kind);
    if (found.length !== 1) throw new FormatError(`holds ${found.length} ${kind} chunks, not one`);
    return found[0];
  }

  #decoderNumber(): number {
    const kinds = this.container.index.map((entry) => entry.kind);
    if (kinds.includes('DECO') && kinds.includes('HYBR')) throw new FormatError('holds two decoders, DECO and HYBR');
    return this.#only(kinds.includes('HYBR') ? 'HYBR' : 'DECO');
  }

  #checkKinds() {
    const { index } = this.container;
    if (index.some((entry) => entry.kind === 'GRUP')) {
      throw new FormatError('a clip in groups, where a single scene is wanted');
    }
    const shared = index.findIndex(isShared);
    if (shared >= 0) {
      throw new FormatError(
        `chunk ${shared} (PLNE) stands for a shared plane, which a group of a clip alone has; encode it again`,
      );
    }
    const unknown = index.findIndex((entry) => isCritical(entry) && !KNOWN_KINDS.includes(entry.kind));
    if (unknown >= 0) {
      const { kind } = index[unknown];
      throw new FormatError(
        `chunk ${unknown} is of the critical kind ${kind}, unknown to this reader; update kpc`,
        'newer',
      );
    }
  }

  /** Check that every plane is listed whole: its segments neither overlap nor leave a gap. */
  #checkSegments() {
    const names = this.head.isDynamic ? PLANES : PLANES.slice(0, 3);
    const found = new Map<string, Entry[]>(
      this.head.scales.flatMap((_, s) => names.map((__, p) => [`${s} ${p}`, []] as [string, Entry[]])),
    );
    for (const [number, entry] of this.container.index.entries()) {
      const { group, scale, plane, rowStart, rowCount } = entry;
      if (entry.kind === 'PLNE') {
        const segments = found.get(`${scale} ${plane}`);
        if (group !== 0 || segments === undefined) {
          throw new FormatError(
            `chunk ${number} belongs to group ${group}, scale ${scale}, plane ${plane}, which is not`,
          );
        }
        segments.push(entry);
      } else if (
        entry.kind !== 'soun' &&
        KNOWN_KINDS.includes(entry.kind) &&
        (group || scale || plane || rowStart || rowCount)
      ) {
        throw new FormatError(`${this.container.chunk(number).label} claims a position among the planes`);
      }
    }
    for (const [key, segments] of found) {
      const [scale, plane] = key.split(' ').map(Number);
      const { rows } = this.head.scales[scale][names[plane]] as PlaneHead;
      checkRows(segments, rows, `scale ${scale}, plane ${names[plane]}`, plane < 3);
    }
  }
}

function checkRows(segments: Entry[], rows: number, where: string, isSpacePlane: boolean): void {
  if (isSpacePlane && segments.length > 1) {
    throw new FormatError(`${where}: a space plane is one segment, not ${segments.length}`);
  }
  let row = 0;
  for (const entry of segments.sort((a, b) => a.rowStart - b.rowStart)) {
    if (entry.rowStart !== row || entry.rowCount < 1) {
      throw new FormatError(`${where}: no segment starts at row ${row}, or two do`);
    }
    row += entry.rowCount;
  }
  if (row !== rows) throw new FormatError(`${where}: its segments hold ${row} rows, not ${rows}`);
}
