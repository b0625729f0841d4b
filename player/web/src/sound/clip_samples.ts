/** The samples of a clip, fetched and decoded as they are wanted. */

import { soundSpans } from '../container/clip_sound.js';
import type { Clip } from '../streaming/clip.js';
import type { Decode } from './opus.js';
import type { Samples, Stereo } from './playback.js';

export class ClipSamples implements Samples {
  readonly #clip: Pick<Clip, 'scenes' | 'timeline' | 'fps'>;
  readonly #decode: Decode;

  constructor(clip: Pick<Clip, 'scenes' | 'timeline' | 'fps'>, decode: Decode) {
    this.#clip = clip;
    this.#decode = decode;
  }

  /** Return samples from `first` on, 0 where there are none; null as long as their group is not held. */
  async read(first: number, count: number): Promise<Stereo | null> {
    const found: Stereo = [new Float32Array(count), new Float32Array(count)];
    for (const span of soundSpans(this.#clip.timeline, this.#clip.fps)) {
      const [begin, stop] = [Math.max(first, span.first), Math.min(first + count, span.stop)];
      if (begin >= stop) continue;
      const scene = this.#clip.scenes.find(({ group }) => group === span.group);
      if (scene === undefined) return null;
      const part = await scene.sound.read(begin - span.start, stop - begin);
      if (part === null) continue;
      const decoded = await this.#decode(part.packets, part.channels);
      for (const [side, samples] of found.entries()) {
        const channel = decoded[Math.min(side, part.channels - 1)]; // one channel is heard on both sides
        samples.set(channel.subarray(part.skip, part.skip + part.count), begin - first);
      }
    }
    return found;
  }
}
