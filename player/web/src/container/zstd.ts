import { decompress } from 'fzstd';
import { FormatError } from './errors.js';

const MAGIC = 0xfd2fb528;
const LARGEST_BLOCK = 1 << 17;

/**
 * Return the content of exactly one Zstandard frame (section 4.5), which must declare `length` bytes; `what` it holds
 * is for messages.
 */
export function unpackFrame(body: Uint8Array, length: number, what: string): Uint8Array {
  const invalid = new FormatError(`${what} is no valid zstd frame`);
  const frame = parseFrame(body);
  if (frame === null) throw invalid;
  if (frame.contentSize !== length || frame.dictionary) {
    throw new FormatError(`${what}: its zstd frame claims another length`);
  }
  if (frame.end !== body.length || length > frame.most) throw invalid;
  try {
    const content = decompress(body, new Uint8Array(length));
    if (content.length !== length) throw invalid;
    return content;
  } catch {
    throw invalid;
  }
}

/** Return what a frame declares, where it ends and how much its blocks may hold (RFC 8878); null if it is none. */
function parseFrame(body: Uint8Array) {
  if (body.length < 6) return null;
  const view = new DataView(body.buffer, body.byteOffset, body.length);
  if (view.getUint32(0, true) !== MAGIC) return null;
  const descriptor = body[4];
  const isSingle = (descriptor >> 5) & 1;
  const sizeBytes = [isSingle, 2, 4, 8][descriptor >> 6];
  const dictionaryBytes = [0, 1, 2, 4][descriptor & 3];
  const start = 5 + (isSingle ? 0 : 1);
  let at = start + dictionaryBytes + sizeBytes;
  if (at + 3 > body.length || descriptor & 8) return null;
  const dictionary = body.subarray(start, start + dictionaryBytes).some((byte) => byte > 0);
  let contentSize = sizeBytes === 2 ? 256 : 0;
  for (let k = 0; k < sizeBytes; k++) contentSize += body[start + dictionaryBytes + k] * 2 ** (8 * k);
  if (sizeBytes === 0) contentSize = -1;
  let most = 0;
  for (let last = false; !last; ) {
    if (at + 3 > body.length) return null;
    const header = body[at] | (body[at + 1] << 8) | (body[at + 2] << 16);
    const type = (header >> 1) & 3;
    const size = header >> 3;
    if (type === 3 || size > LARGEST_BLOCK) return null;
    last = (header & 1) === 1;
    most += type === 2 ? LARGEST_BLOCK : size;
    at += 3 + (type === 1 ? 1 : size);
  }
  return { contentSize, dictionary, most, end: at + (descriptor & 4 ? 4 : 0) };
}
