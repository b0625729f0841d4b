/**
 * The outer structure of a .kpc file: header, chunk index, chunks (section 4 of spec/kpc-format.md). It does not know
 * what a scene is.
 */

import { Chunk, type Entry, EXPANSION_LIMIT } from './chunk.js';
import { crc32c } from './crc32c.js';
import { FormatError } from './errors.js';
import { unpackFrame } from './zstd.js';

export const MAGIC: readonly number[] = [0x89, 0x4b, 0x50, 0x43, 0x0d, 0x0a, 0x1a, 0x0a];
export const VERSION = 1;
export const HEADER_LENGTH = 48;
export const ENTRY_LENGTH = 30;
export const CHUNK_LIMIT = 1 << 16;

/** What the header says (section 4.1). */
export interface Header {
  chunkCount: number;
  indexLength: number;
  indexCrc: number;
  fileLength: number;
  valueCount: number;
  largestRaw: number;
}

export interface ContainerOptions {
  /** Whether the end of the file may be missing. */
  allowPartial?: boolean;
  /** Stored chunks beyond the bytes that are given, by their numbers. */
  bodies?: ReadonlyMap<number, Uint8Array>;
  /** The index where it was read elsewhere; without it, it is read here. */
  index?: readonly Entry[];
}

/**
 * Random access to the chunks of a file that is in memory: whole or, if `allowPartial`, its beginning, and chunks that
 * were fetched besides.
 */
export class Container {
  readonly header: Header;
  readonly index: readonly Entry[];
  readonly bytes: Uint8Array;
  readonly #bodies: ReadonlyMap<number, Uint8Array>;

  constructor(bytes: Uint8Array, { allowPartial = false, bodies = new Map(), index }: ContainerOptions = {}) {
    this.bytes = bytes;
    this.#bodies = bodies;
    this.header = readHeader(bytes, allowPartial);
    this.index = index ?? readIndex(bytes, this.header);
  }

  /** Whether all bytes of a chunk are there. */
  available(number: number): boolean {
    const entry = this.index[number];
    return entry.offset + entry.storedLength <= this.bytes.length || this.#bodies.get(number) !== undefined;
  }

  /** Return a chunk, which may not be there. */
  chunk(number: number): Chunk {
    const entry = this.index[number];
    const held = this.#bodies.get(number) ?? this.bytes.subarray(entry.offset, entry.offset + entry.storedLength);
    return new Chunk(number, entry, this.available(number) ? held : null);
  }
}

/** Read and check the header (section 4.1). */
export function readHeader(bytes: Uint8Array, allowPartial: boolean): Header {
  const view = new DataView(bytes.buffer, bytes.byteOffset, bytes.length);
  if (bytes.length === 0 || MAGIC.some((byte, k) => k < bytes.length && bytes[k] !== byte)) {
    throw new FormatError('not a .kpc file', 'foreign');
  }
  if (bytes.length >= 12) {
    if (view.getUint16(10, true) === 0) throw new FormatError('a draft of the format; encode it again', 'draft');
    const version = view.getUint16(8, true);
    if (version !== VERSION) {
      throw new FormatError(`format version ${version}, this reader knows ${VERSION}; update kpc`, 'newer');
    }
  }
  if (bytes.length < HEADER_LENGTH) throw new FormatError('cut off within the header; fetch the file again', 'cut-off');
  if (crc32c(bytes.subarray(0, 44)) !== view.getUint32(44, true)) {
    throw new FormatError('the header is damaged (its CRC32C differs); fetch the file again', 'damaged');
  }
  if (view.getUint16(10, true) !== HEADER_LENGTH) {
    throw new FormatError(`the header claims ${view.getUint16(10, true)} bytes, not ${HEADER_LENGTH}`);
  }
  const header = {
    chunkCount: view.getUint32(12, true),
    indexLength: view.getUint32(16, true),
    indexCrc: view.getUint32(20, true),
    fileLength: Number(view.getBigUint64(24, true)),
    valueCount: Number(view.getBigUint64(32, true)),
    largestRaw: view.getUint32(40, true),
  };
  checkSizes(header, bytes.length, allowPartial);
  return header;
}

function checkSizes(header: Header, size: number, allowPartial: boolean): void {
  const { chunkCount, indexLength, fileLength, valueCount, largestRaw } = header;
  const least = HEADER_LENGTH + Math.max(indexLength, 8 * chunkCount);
  const countFits = chunkCount > 0 && chunkCount <= CHUNK_LIMIT;
  if (!countFits || indexLength === 0 || indexLength > 64 + 40 * chunkCount || fileLength < least) {
    throw new FormatError(
      `the header claims ${chunkCount} chunks and ${indexLength} bytes of index in a file of ${fileLength} bytes`,
    );
  }
  if (size > fileLength) throw new FormatError(`${size - fileLength} bytes follow the end of the file`);
  if (size < fileLength && !allowPartial) throw new FormatError(`cut off at ${size} of ${fileLength} bytes`, 'cut-off');
  if (Math.max(valueCount, largestRaw) > fileLength * EXPANSION_LIMIT) {
    throw new FormatError(
      `claims ${valueCount} values and chunks of ${largestRaw} bytes, more than ${fileLength} bytes can hold`,
    );
  }
}

/** Read and check the index (section 4.2) of bytes that begin with this header. */
export function readIndex(bytes: Uint8Array, header: Header): Entry[] {
  const { chunkCount, indexLength, indexCrc, fileLength, largestRaw } = header;
  if (bytes.length < HEADER_LENGTH + indexLength) throw new FormatError('cut off within the chunk index', 'cut-off');
  const index = bytes.subarray(HEADER_LENGTH, HEADER_LENGTH + indexLength);
  if (crc32c(index) !== indexCrc) {
    throw new FormatError('the chunk index is damaged (its CRC32C differs); fetch the file again', 'damaged');
  }
  const table = unpackFrame(index, ENTRY_LENGTH * chunkCount, 'chunk index');
  const row = new Uint8Array(ENTRY_LENGTH);
  const view = new DataView(row.buffer);
  const entries: Entry[] = [];
  let offset = HEADER_LENGTH + indexLength;
  for (let number = 0; number < chunkCount; number++) {
    for (let k = 0; k < ENTRY_LENGTH; k++) row[k] = table[k * chunkCount + number];
    const kind = String.fromCharCode(...row.subarray(0, 4));
    if (!/^[A-Za-z]{4}$/.test(kind)) throw new FormatError(`chunk ${number} has a kind that is not four letters`);
    const entry = {
      kind,
      group: view.getUint16(4, true),
      scale: row[6],
      plane: row[7],
      rowStart: view.getUint32(8, true),
      rowCount: view.getUint32(12, true),
      codec: view.getUint16(16, true),
      storedLength: view.getUint32(18, true),
      rawLength: view.getUint32(22, true),
      crc: view.getUint32(26, true),
      offset,
    };
    if (entry.rawLength > largestRaw) {
      throw new FormatError(`chunk ${number} claims ${entry.rawLength} bytes, more than the header's limit`);
    }
    entries.push(entry);
    offset += entry.storedLength;
  }
  if (offset !== fileLength) throw new FormatError(`the chunks end at byte ${offset} of ${fileLength}`);
  return entries;
}
