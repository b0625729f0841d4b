/** The device that plays sound, by WebAudio. */

import { SAMPLE_RATE } from '../container/sound.js';
import type { Output, Stereo } from './playback.js';

/** Seconds from now on until what is scheduled can be played for certain. */
const LEAD_S = 0.02;
/** Time constant in seconds with which sound ends, so that it does not click, and after which nothing is heard. */
const [FADE_S, FADED_S] = [0.004, 0.03];
/** Milliseconds of silence after which the device may rest. */
const REST_MS = 2000;

export class AudioOutput implements Output {
  #context: AudioContext | null = null;
  #gain: GainNode | null = null;
  #sources: AudioBufferSourceNode[] = [];
  /** What the sources of one beginning go through. */
  #fader: GainNode | null = null;
  #rest: ReturnType<typeof setTimeout> | undefined;
  #isResting = false;

  /** Whether the browser waits for a gesture of the user. */
  get isBlocked(): boolean {
    return this.#context !== null && this.#context.state !== 'running' && !this.#isResting;
  }

  /** From 0 to 1, about as loudness is heard. */
  set volume(volume: number) {
    const gain = this.#gain?.gain;
    if (gain && gain.value !== volume * volume) gain.value = volume * volume;
  }

  get heardTime(): number | null {
    if (this.#context?.state !== 'running') return null;
    const { currentTime, outputLatency, baseLatency } = this.#context;
    return currentTime - (outputLatency || baseLatency || 0);
  }

  get nextTime(): number {
    return (this.#context?.currentTime ?? 0) + LEAD_S;
  }

  schedule([left, right]: Stereo, offset: number, at: number): void {
    if (this.#context === null || this.#gain === null) return;
    const buffer = new AudioBuffer({ length: left.length, numberOfChannels: 2, sampleRate: SAMPLE_RATE });
    buffer.copyToChannel(left, 0);
    buffer.copyToChannel(right, 1);
    const source = new AudioBufferSourceNode(this.#context, { buffer });
    if (this.#fader === null) {
      this.#fader = this.#context.createGain();
      this.#fader.connect(this.#gain);
    }
    source.connect(this.#fader);
    source.onended = () => {
      source.disconnect();
      this.#sources = this.#sources.filter((one) => one !== source);
    };
    // Whole samples, so that the samples of two blocks follow one another.
    source.start(Math.round(at * SAMPLE_RATE) / SAMPLE_RATE, offset / SAMPLE_RATE);
    this.#sources.push(source);
  }

  clear(): void {
    const { currentTime } = this.#context ?? { currentTime: 0 };
    this.#fader?.gain.setTargetAtTime(0, currentTime, FADE_S);
    this.#fader = null;
    for (const source of this.#sources) source.stop(currentTime + FADED_S);
    this.#sources = [];
  }

  /** Let the device rest after a while without sound. */
  rest(): void {
    this.#rest ??= setTimeout(() => {
      if (this.#context?.state !== 'running') return;
      this.#isResting = true;
      this.#context.suspend().catch(() => {});
    }, REST_MS);
  }

  /**
   * Open the device, or go on after a rest. Throws what the browser does if there is none.
   * @param isGesture whether the user has just done something, which browsers wait for.
   */
  wake(isGesture: boolean): void {
    clearTimeout(this.#rest);
    this.#rest = undefined;
    if (this.#context === null) {
      this.#context = new AudioContext({ sampleRate: SAMPLE_RATE });
      this.#gain = this.#context.createGain();
      this.#gain.connect(this.#context.destination);
    }
    if (!this.#isResting && !isGesture) return;
    this.#isResting = false;
    if (this.#context.state !== 'running') this.#context.resume().catch(() => {});
  }

  close(): void {
    clearTimeout(this.#rest);
    this.#context?.close().catch(() => {});
  }
}
