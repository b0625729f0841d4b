/** Decoding of Opus packets by the browser: WebCodecs' `AudioDecoder`. */

import { packetSamples, SAMPLE_RATE } from '../container/sound.js';

/** Refused packets of one call; what follows them is silence. */
const MOST_REFUSED = 8;
/** Milliseconds after which a decoder that does not answer is given up. */
const DEADLINE_MS = 5000;

/** Returns all samples of packets, an array for each channel. */
export type Decode = (packets: readonly Uint8Array[], channels: number) => Promise<Float32Array<ArrayBuffer>[]>;

/** Whether the browser decodes; only for pages that came by https, or from this computer. */
export const canDecode = (): boolean => 'AudioDecoder' in globalThis;

/** Decode packets; one that the decoder refuses is silence of its length. */
export const decode: Decode = async (packets, channels) => {
  const starts = [0];
  for (const packet of packets) starts.push(starts[starts.length - 1] + packetSamples(packet));
  const found = Array.from({ length: channels }, () => new Float32Array(starts[packets.length]));
  let next = 0;
  for (let refused = 0; next < packets.length && refused <= MOST_REFUSED; refused++) {
    const end = await decodeRun(packets.slice(next), found, starts[next]);
    // The packet after those that were decoded is the one that was refused.
    while (next < packets.length && starts[next + 1] <= end) next++;
    next++;
  }
  return found;
};

/** Decode packets until one is refused into arrays from a position on; return the position after the last sample. */
async function decodeRun(
  packets: readonly Uint8Array[],
  found: readonly Float32Array<ArrayBuffer>[],
  position: number,
): Promise<number> {
  let failed: () => void = () => {};
  const failure = new Promise<void>((resolve) => {
    failed = resolve;
  });
  const decoder = new AudioDecoder({
    output: (data) => {
      const count = Math.min(data.numberOfFrames, found[0].length - position);
      for (const [channel, samples] of found.entries()) {
        const planeIndex = Math.min(channel, data.numberOfChannels - 1);
        const options = { planeIndex, frameCount: count, format: 'f32-planar' } as const;
        if (count > 0) data.copyTo(samples.subarray(position, position + count), options);
      }
      position += count;
      data.close();
    },
    error: failed,
  });
  let timer: ReturnType<typeof setTimeout> | undefined;
  try {
    decoder.configure({ codec: 'opus', sampleRate: SAMPLE_RATE, numberOfChannels: found.length });
    for (const [number, data] of packets.entries()) {
      decoder.decode(new EncodedAudioChunk({ type: 'key', timestamp: number, data: data as Uint8Array<ArrayBuffer> }));
    }
    const late = new Promise<never>((_, reject) => {
      timer = setTimeout(() => reject(new Error('the decoder does not answer')), DEADLINE_MS);
    });
    await Promise.race([decoder.flush().catch(failed), failure, late]);
  } finally {
    clearTimeout(timer);
    if (decoder.state !== 'closed') decoder.close();
  }
  return position;
}
