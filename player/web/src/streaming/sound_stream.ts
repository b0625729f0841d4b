/** The sound of a scene that is arriving: packets are fetched as they are wanted, by requests of their own. */

import type { Entry } from '../container/chunk.js';
import { BudgetError, KpcError } from '../container/errors.js';
import { PRE_ROLL, packetSamples, type SoundSegment, soundChunks, soundOf } from '../container/sound.js';
import type { DecoderPool } from '../decoder/pool.js';
import { adjacentRuns, isThere } from './opening.js';
import type { Source } from './source.js';

/** So much is decoded before samples that are read by themselves that nothing is heard of where decoding begins. */
const SEAMLESS = 2 * PRE_ROLL;
/** Chunks that are held, and bytes that those of one read may take. */
const [HELD_CHUNKS, MOST_BYTES] = [4, 1 << 23];
/** The most that is fetched with one request. */
const RUN_BYTES = 1 << 18;

/** Packets that a decoder takes for `count` samples; it first yields `skip` others. */
export interface SoundPart {
  channels: number;
  packets: Uint8Array[];
  skip: number;
  count: number;
}

export class SoundStream {
  /** The numbers of the chunks, in the order of time; none of a silent scene. */
  readonly numbers: readonly number[];
  readonly #source: Source;
  readonly #pool: DecoderPool;
  readonly #index: readonly Entry[];
  readonly #held = new Map<number, SoundSegment>();
  readonly #control = new AbortController();

  constructor(source: Source, pool: DecoderPool, index: readonly Entry[]) {
    [this.#source, this.#pool, this.#index] = [source, pool, index];
    this.numbers = soundChunks(index);
  }

  /**
   * Return what to decode for samples from `first` on, fewer at the end of the sound; null where there are none.
   * Throws a KpcError if they cannot be fetched or are invalid.
   */
  async read(first: number, count: number): Promise<SoundPart | null> {
    if (this.numbers.length === 0 || !this.#isThere(this.numbers[0])) return null;
    const [head] = await this.#segments([this.numbers[0]]);
    const wanted = Math.min(count, head.sampleCount - first);
    if (wanted < 1) return null;
    const [begin, end] = [first + head.preSkip, first + head.preSkip + wanted];
    const needed = this.numbers.filter((number) => {
      const { rowStart, rowCount } = this.#index[number];
      return rowStart < end && rowStart + rowCount > begin - SEAMLESS;
    });
    const missing = needed.findIndex((number) => !this.#isThere(number));
    const there = missing < 0 ? needed : needed.slice(0, missing);
    if (there.length === 0) return null;
    if (this.#rawBytes(there) > MOST_BYTES) {
      throw new BudgetError(`its sound takes more than ${MOST_BYTES} bytes a second`);
    }
    const segments = await this.#segments(there);
    soundOf([head, ...segments]);
    const packets: Uint8Array[] = [];
    let sample = this.#index[there[0]].rowStart;
    let start = sample;
    for (const packet of segments.flatMap((segment) => segment.packets)) {
      const until = sample + packetSamples(packet);
      if (until > begin - SEAMLESS && sample < end) {
        if (packets.length === 0) start = sample;
        packets.push(packet);
      }
      sample = until;
    }
    const found = Math.min(wanted, sample - begin);
    return found < 1 ? null : { channels: head.channels, packets, skip: begin - start, count: found };
  }

  /** Bytes that packets take. */
  get memoryBytes(): number {
    const largest = this.numbers.reduce((most, number) => Math.max(most, this.#index[number].rawLength), 0);
    return Math.min(HELD_CHUNKS * largest, MOST_BYTES);
  }

  /** End all requests. */
  close(): void {
    this.#control.abort();
    this.#held.clear();
  }

  #isThere(number: number): boolean {
    return isThere(this.#index[number], this.#source);
  }

  #rawBytes(numbers: readonly number[]): number {
    return numbers.reduce((sum, number) => sum + this.#index[number].rawLength, 0);
  }

  /** Return chunks, and hold the last of them. */
  async #segments(numbers: readonly number[]): Promise<SoundSegment[]> {
    const found = new Map<number, SoundSegment>();
    for (const number of numbers) {
      const held = this.#held.get(number);
      if (held) found.set(number, held);
    }
    const wanted = numbers.filter((number) => !found.has(number));
    const { signal } = this.#control;
    for (const run of adjacentRuns(this.#index, wanted, RUN_BYTES)) {
      const [first, last] = [this.#index[run[0]], this.#index[run[run.length - 1]]];
      const bytes = await this.#source.read(first.offset, last.offset + last.storedLength, { signal });
      for (const number of run) {
        const { offset, storedLength } = this.#index[number];
        const body = bytes.slice(offset - first.offset, offset - first.offset + storedLength);
        found.set(number, await this.#parse(number, body));
      }
    }
    for (const [number, segment] of found) {
      this.#held.delete(number);
      this.#held.set(number, segment);
    }
    for (const number of [...this.#held.keys()].slice(0, -HELD_CHUNKS)) this.#held.delete(number);
    return numbers.map((number) => found.get(number) as SoundSegment);
  }

  /** Read a chunk; one that came damaged is fetched a second time. */
  async #parse(number: number, body: Uint8Array): Promise<SoundSegment> {
    const entry = this.#index[number];
    const total = this.numbers.reduce((sum, one) => sum + this.#index[one].rowCount, 0);
    const { signal } = this.#control;
    const parse = (body: Uint8Array) => this.#pool.run({ kind: 'sound', number, entry, body, total }, { signal });
    try {
      return await parse(body);
    } catch (error) {
      if (!(error instanceof KpcError) || error.code !== 'damaged') throw error;
      const { offset, storedLength } = entry;
      return parse((await this.#source.read(offset, offset + storedLength, { signal, fresh: true })).slice());
    }
  }
}
