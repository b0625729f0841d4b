/** Sound: Opus packets in soun chunks (section 6.9 of spec/kpc-format.md). */

import type { Entry } from './chunk.js';
import { FormatError } from './errors.js';

export const SAMPLE_RATE = 48000;
/** Samples that a decoder must decode before its output is that of one which began earlier. */
export const PRE_ROLL = 7680;
/** SOUND_LIMIT and DURATION_LIMIT of section 11.1. */
export const SOUND_LIMIT = 1 << 20;
export const DURATION_LIMIT = 480000;

const HEAD_LENGTH = 9;
const SILK = [480, 960, 1920, 2880];
const CELT = [120, 240, 480, 960];

/** What every soun chunk of a file says of the whole sound. */
export interface SoundHead {
  /** 1 or 2. */
  channels: number;
  /** Samples that the decoder yields before those of the sound. */
  preSkip: number;
  /** Samples of the sound. */
  sampleCount: number;
}

/** The content of a soun chunk. */
export interface SoundSegment extends SoundHead {
  packets: Uint8Array[];
}

/** The sound of a scene; of a file that is cut off, the packets that are there. */
export type Sound = SoundSegment;

/** Return the numbers of the soun chunks in the order of time, their fields in the index checked. */
export function soundChunks(index: readonly Entry[]): number[] {
  const numbers = [...index.keys()].filter((number) => index[number].kind === 'soun');
  numbers.sort((a, b) => index[a].rowStart - index[b].rowStart);
  let sample = 0;
  for (const number of numbers) {
    const { group, scale, plane, rowStart, rowCount } = index[number];
    if (group || scale || plane) throw new FormatError(`chunk ${number} (soun) claims a position among the planes`);
    if (rowStart !== sample || rowCount < 1 || rowCount > DURATION_LIMIT) {
      throw new FormatError(`soun: no chunk starts at sample ${sample}, or two do, or one has no or too many samples`);
    }
    sample += rowCount;
  }
  if (sample >= 2 ** 32) throw new FormatError(`soun: ${sample} samples are more than a file may have`);
  return numbers;
}

/** Read the content of a soun chunk: `samples` that its packets decode to by the index, `total` of all chunks. */
export function parseSound(raw: Uint8Array, samples: number, total: number): SoundSegment {
  if (raw.length < HEAD_LENGTH) throw new FormatError(`soun: ends after ${raw.length} bytes, ${HEAD_LENGTH} needed`);
  const view = new DataView(raw.buffer, raw.byteOffset, raw.length);
  const channels = view.getUint8(0);
  const preSkip = view.getUint16(1, true);
  const sampleCount = view.getUint32(3, true);
  const count = view.getUint16(7, true);
  if (channels < 1 || channels > 2 || sampleCount === 0 || preSkip + sampleCount > total) {
    const claims = `${channels} channels (1 or 2 allowed), ${preSkip} and ${sampleCount} of ${total} samples`;
    throw new FormatError(`soun: ${claims} make no sense`);
  }
  let position = HEAD_LENGTH + 2 * count;
  if (position > raw.length) throw new FormatError(`soun: ends after ${raw.length} bytes, ${position} needed`);
  const lengths = Array.from({ length: count }, (_, k) => view.getUint16(HEAD_LENGTH + 2 * k, true));
  const bytes = lengths.reduce((sum, length) => sum + length, 0);
  if (position + bytes !== raw.length) {
    throw new FormatError(`soun: packets of ${bytes} bytes where there are ${raw.length - position}`);
  }
  const packets = lengths.map((length) => {
    position += length;
    return raw.subarray(position - length, position);
  });
  const found = packets.reduce((sum, packet) => sum + packetSamples(packet), 0);
  if (found !== samples) throw new FormatError(`soun: packets of ${found} samples where the index claims ${samples}`);
  return { channels, preSkip, sampleCount, packets };
}

/** Return the sound of segments that follow one another from the first on; null without any. */
export function soundOf(segments: readonly SoundSegment[]): Sound | null {
  if (segments.length === 0) return null;
  const { channels, preSkip, sampleCount } = segments[0];
  for (const one of segments) {
    if (one.channels !== channels || one.preSkip !== preSkip || one.sampleCount !== sampleCount) {
      throw new FormatError('soun: chunks disagree about channels, pre_skip or sample_count');
    }
  }
  return { channels, preSkip, sampleCount, packets: segments.flatMap((one) => one.packets) };
}

/** Return the samples, for each channel, that an Opus packet decodes to (RFC 6716, section 3.1). */
export function packetSamples(packet: Uint8Array): number {
  const configuration = packet[0] >> 3;
  const code = packet[0] & 3;
  if (packet.length < 1 || (code === 3 && packet.length < 2)) {
    throw new FormatError('soun: a packet is too short for an Opus packet');
  }
  let frame = CELT[configuration & 3];
  if (configuration < 12) frame = SILK[configuration & 3];
  else if (configuration < 16) frame = configuration & 1 ? 960 : 480;
  const frames = code === 3 ? packet[1] & 63 : Math.min(code, 1) + 1;
  if (frames < 1 || frames * frame > 5760) {
    throw new FormatError(`soun: a packet of ${frames} frames of ${frame} samples is no Opus packet`);
  }
  return frames * frame;
}
