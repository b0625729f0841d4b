/** A chunk of a .kpc file, and how its stored bytes become its content (sections 4.3 to 4.5 of spec/kpc-format.md). */

import { crc32c } from './crc32c.js';
import { FormatError } from './errors.js';
import { unpackFrame } from './zstd.js';

/** EXPANSION_LIMIT of section 11.1. */
export const EXPANSION_LIMIT = 32768;
export const CODEC = {
  ...{ RAW: 0, ZSTD: 1, PREDICTIVE: 2, TRANSFORM: 3, MOTION: 4, OCCUPANCY: 5, WEIGHTS: 6, POSES: 7 },
  /** In a group of a clip: a plane that lies beside the groups. */
  SHARED: 8,
};

/** A chunk, as the index lists it; `offset` is its position in the file. */
export interface Entry {
  kind: string;
  group: number;
  scale: number;
  plane: number;
  rowStart: number;
  rowCount: number;
  codec: number;
  storedLength: number;
  rawLength: number;
  crc: number;
  offset: number;
}

/** Whether a reader must know the kind of a chunk (section 4.3). */
export const isCritical = (entry: Entry) => entry.kind[0] < 'a';

export class Chunk {
  readonly entry: Entry;
  /** What the chunk is called in messages. */
  readonly label: string;
  readonly #body: Uint8Array | null;

  /** Take the chunk of this number with its stored bytes; null if they are not there. */
  constructor(number: number, entry: Entry, body: Uint8Array | null) {
    this.entry = entry;
    this.label = `chunk ${number} (${entry.kind})`;
    this.#body = body;
  }

  /** Return the stored bytes, their CRC32C verified. */
  stored(): Uint8Array {
    if (this.#body === null) throw new FormatError(`cut off: ${this.label} is not there`, 'cut-off');
    if (this.#body.length !== this.entry.storedLength || crc32c(this.#body) !== this.entry.crc) {
      throw new FormatError(`${this.label} is damaged (its CRC32C differs); fetch the file again`, 'damaged');
    }
    return this.#body;
  }

  /** Return the content under RAW or ZSTD, of at most `limit` bytes. */
  content(limit = Infinity): Uint8Array {
    const { codec, rawLength } = this.entry;
    if (rawLength > limit) {
      throw new FormatError(`${this.label} claims ${rawLength} bytes where at most ${limit} make sense`);
    }
    let content = this.stored();
    if (codec === CODEC.ZSTD) content = unpackFrame(content, rawLength, this.label);
    else if (codec !== CODEC.RAW) {
      throw new FormatError(`${this.label} uses codec ${codec}, unknown to this reader; update kpc`, 'newer');
    }
    if (content.length !== rawLength) {
      throw new FormatError(`${this.label} holds ${content.length} bytes, not the ${rawLength} it claims`);
    }
    return content;
  }

  /** Return what is stored under one of the codecs from PREDICTIVE on, if it may hold what it claims. */
  coded(): Uint8Array {
    const { rawLength, storedLength } = this.entry;
    if (rawLength > storedLength * EXPANSION_LIMIT) {
      throw new FormatError(`${this.label} claims a length of ${rawLength}, more than ${storedLength} bytes can hold`);
    }
    return this.stored();
  }
}
