/** Which sound is heard when in a clip in groups (section 4.7 of spec/kpc-format.md, "Sound"). */

import { SAMPLE_RATE } from './sound.js';
import type { Timeline } from './timeline.js';

/** The samples of a clip that are those of one group; they count from the first frame of the clip. */
export interface SoundSpan {
  group: number;
  /** The first sample of the clip, and the one after the last. */
  first: number;
  stop: number;
  /** The sample of the clip that is sample 0 of the sound of the group. */
  start: number;
}

/** Return the sample that is heard when a frame of a clip, counted from 0, is first shown. */
export const sampleAt = (frame: number, fps: number): number => Math.floor((SAMPLE_RATE * frame) / fps + 0.5);

/** Return the spans of all groups, which follow one another from 0 to the end of the clip. */
export function soundSpans({ spans, frameCount }: Timeline, fps: number): SoundSpan[] {
  const origin = spans[0].first;
  const takeover = (group: number): number => {
    if (group === spans.length) return sampleAt(frameCount, fps);
    const { first } = spans[group];
    return group === 0 ? 0 : sampleAt(Math.max((spans[group - 1].last + first) / 2, first) - origin, fps);
  };
  return spans.map(({ first }, group) => {
    const start = sampleAt(first - origin, fps);
    return { group, first: takeover(group), stop: takeover(group + 1), start };
  });
}
