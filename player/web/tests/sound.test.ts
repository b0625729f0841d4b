/** Sound: packets of a clip that arrives, and a clip that follows the clock of a device. */

import assert from 'node:assert/strict';
import test from 'node:test';

import { sampleAt, soundSpans } from '../src/container/clip_sound.js';
import { SAMPLE_RATE } from '../src/container/sound.js';
import { Timeline } from '../src/container/timeline.js';
import { Clock } from '../src/element/clock.js';
import { ClipSamples } from '../src/sound/clip_samples.js';
import type { Decode } from '../src/sound/opus.js';
import { type Output, type Samples, SoundPlayback, type Stereo } from '../src/sound/playback.js';
import { Clip } from '../src/streaming/clip.js';
import { spawnNode } from './node_worker.js';
import { withServer } from './server.js';
import { grouped, type Part, scene } from './writing.js';

const FRAME_S = 1 / 60;
const DURATION_S = 10;
/** Samples of a packet, of a chunk, and those that are not heard. */
const [PACKET, CHUNK, PRE_SKIP] = [960, 48000, 312];

const RAMP = Float32Array.from({ length: DURATION_S * SAMPLE_RATE }, (_, k) => k);

/** Samples that are their own number. */
class Ramp implements Samples {
  isThere = true;

  async read(first: number, count: number): Promise<Stereo | null> {
    const samples = RAMP.subarray(first, first + count);
    return this.isThere ? [samples, samples] : null;
  }
}

/** A page that plays a clip, and a device; both run on a simulated clock. */
class Bench implements Output {
  now = 0;
  isRunning = true;
  loops = true;
  failure: unknown = null;
  readonly clock = new Clock(() => {});
  readonly playback: SoundPlayback;
  #played: { samples: Float32Array; offset: number; at: number }[] = [];

  /** @param rate of the device's clock, 1 if it is right. */
  constructor(
    samples: Samples = new Ramp(),
    readonly rate = 1,
    readonly latency = 0.06,
  ) {
    Object.assign(this.clock, { duration: DURATION_S, frameCount: 301, loop: true });
    this.playback = new SoundPlayback(samples, DURATION_S, this, (error) => {
      this.failure = error;
    });
    this.clock.play();
  }

  get heardTime(): number | null {
    return this.isRunning ? this.now * this.rate - this.latency : null;
  }

  get nextTime(): number {
    return this.now * this.rate + 0.02;
  }

  schedule([samples]: Stereo, offset: number, at: number): void {
    assert.ok(at >= this.now * this.rate);
    this.#played = [...this.#played.slice(-9), { samples, offset, at }];
  }

  clear(): void {
    this.#played = this.#played.filter(({ at }) => at <= this.now * this.rate);
    for (const one of this.#played) {
      one.samples = one.samples.subarray(0, Math.round((this.now * this.rate - one.at) * SAMPLE_RATE) + one.offset);
    }
  }

  /** Show a frame, and let what is read arrive. */
  async frame(): Promise<void> {
    this.now += FRAME_S;
    const { clock, playback } = this;
    const plays = () => clock.speed === 1 && !clock.isWaiting && !clock.isSeeking;
    clock.tick(plays() ? playback.advance(FRAME_S, clock.time, clock.loop) : FRAME_S, () => true);
    if (plays()) playback.follow(clock.time, clock.loop);
    else playback.hold();
    await null;
    await null;
  }

  async run(seconds: number): Promise<void> {
    for (let frames = Math.round(seconds / FRAME_S); frames > 0; frames--) await this.frame();
  }

  /** The sample of the clip that is heard at a time of the device's clock; null for silence. */
  heard(time = this.now * this.rate - this.latency): number | null {
    for (const { samples, offset, at } of this.#played) {
      const k = Math.round((time - at) * SAMPLE_RATE) + offset;
      if (k >= offset && k < samples.length) return samples[k];
    }
    return null;
  }

  /** How far the clip is from what is heard now, seconds. */
  get apart(): number {
    const apart = this.clock.time - (this.heard() as number) / SAMPLE_RATE;
    return Math.abs(apart - DURATION_S * Math.round(apart / DURATION_S));
  }
}

for (const rate of [1.001, 0.999]) {
  test(`the clip stays with a device whose clock runs at ${rate} for ten minutes`, async () => {
    const bench = new Bench(new Ramp(), rate);
    await bench.run(3);
    let worst = 0;
    for (let second = 0; second < 600; second++) {
      await bench.run(1);
      worst = Math.max(worst, bench.apart);
    }
    assert.ok(worst < 0.04, `${worst}`);
  });
}

test('a sound begins with the clip, whatever the latency, and stays with it after seeks and pauses', async () => {
  for (const latency of [0, 0.06, 0.35]) {
    const bench = new Bench(new Ramp(), 1, latency);
    await bench.run(0.5 + latency);
    for (const time of [7, 1, 9.5]) {
      assert.ok(bench.apart < 0.1);
      await bench.run(2);
      assert.ok(bench.apart < 0.03, `${bench.apart}`);
      bench.clock.seek(time);
      await bench.run(0.5 + latency);
    }
    bench.clock.pause();
    await bench.run(0.5 + latency);
    assert.equal(bench.heard(), null);
    bench.clock.play();
    await bench.run(2);
    assert.ok(bench.apart < 0.03);
  }
});

test('a loop has no gap', async () => {
  const bench = new Bench();
  await bench.run(0.5);
  let [before, turns] = [bench.heard() as number, 0];
  for (let frames = 0; frames < 21 / FRAME_S; frames++) {
    await bench.frame();
    for (let k = 799; k >= 0; k--) {
      const sample = bench.heard(bench.now - bench.latency - k / SAMPLE_RATE);
      if (sample === null) assert.fail(`silence at ${bench.now}`);
      if (sample < before) turns++;
      else assert.ok(sample - before <= 2, `${sample - before} at ${bench.now}`);
      before = sample;
    }
  }
  assert.equal(turns, 2);
});

test('other speeds, the end and what cannot be had yet are silent, and the clip plays on', async () => {
  const ramp = new Ramp();
  const bench = new Bench(ramp);
  await bench.run(1);
  bench.clock.rate = 2;
  await bench.run(0.5);
  assert.equal(bench.heard(), null);
  bench.clock.rate = 1;
  ramp.isThere = false;
  bench.clock.seek(6);
  await bench.run(1);
  assert.equal(bench.heard(), null);
  assert.ok(Math.abs(bench.clock.time - 7) < 0.05);
  ramp.isThere = true;
  await bench.run(1);
  assert.ok(bench.apart < 0.1);
  bench.clock.loop = false;
  await bench.run(4);
  assert.deepEqual([bench.clock.ended, bench.heard()], [true, null]);
});

test('a device that stands still does not hold the clip up', async () => {
  const bench = new Bench();
  bench.isRunning = false;
  await bench.run(1);
  assert.ok(Math.abs(bench.clock.time - 1) < 2 * FRAME_S);
});

test('a sound that cannot be read ends, once, and the clip plays on', async () => {
  const reads: number[] = [];
  const bench = new Bench({
    read: async (first) => {
      reads.push(first);
      throw new Error('damaged');
    },
  });
  await bench.run(1);
  assert.equal((bench.failure as Error).message, 'damaged');
  assert.deepEqual(reads, [0]);
  assert.ok(Math.abs(bench.clock.time - 1) < 2 * FRAME_S);
});

test('groups take over where the spec says', () => {
  const shared = new Timeline([
    { first: 5, last: 44 },
    { first: 41, last: 70 },
  ]);
  assert.deepEqual(soundSpans(shared, 30), [
    { group: 0, first: 0, stop: 60000, start: 0 },
    { group: 1, first: 60000, stop: 105600, start: 57600 },
  ]);
  const apart = new Timeline([
    { first: 0, last: 9 },
    { first: 10, last: 19 },
  ]);
  assert.deepEqual(
    soundSpans(apart, 10).map(({ first, stop }) => [first, stop]),
    [
      [0, 48000],
      [48000, 96000],
    ],
  );
  assert.equal(sampleAt(1, 29.97), 1602);
});

/** Return soun chunks of a sound: packets say which they are, counted from `from`. */
function sound(seconds: number, from = 0): Part[] {
  const parts: Part[] = [];
  const total = Math.ceil((seconds * SAMPLE_RATE + PRE_SKIP) / PACKET);
  for (let first = 0; first < total; first += CHUNK / PACKET) {
    const count = Math.min(CHUNK / PACKET, total - first);
    const body = new Uint8Array(9 + 7 * count);
    const view = new DataView(body.buffer);
    view.setUint8(0, 1);
    view.setUint16(1, PRE_SKIP, true);
    view.setUint32(3, seconds * SAMPLE_RATE, true);
    view.setUint16(7, count, true);
    for (let k = 0; k < count; k++) {
      view.setUint16(9 + 2 * k, 5, true);
      view.setUint8(9 + 2 * count + 5 * k, 31 << 3); // one frame of 20 ms
      view.setUint32(9 + 2 * count + 5 * k + 1, from + first + k, true);
    }
    parts.push({ kind: 'soun', body, rowStart: first * PACKET, rowCount: count * PACKET });
  }
  return parts;
}

/** A decoder whose samples are their numbers in the whole sound. */
const decode: Decode = async (packets) => {
  const samples = new Float32Array(packets.length * PACKET);
  for (const [k, packet] of packets.entries()) {
    const number = new DataView(packet.buffer, packet.byteOffset).getUint32(1, true);
    for (let i = 0; i < PACKET; i++) samples[k * PACKET + i] = number * PACKET + i - PRE_SKIP;
  }
  return [samples];
};

const SIZES = {
  frameCount: 41,
  segmentRows: 8,
  scales: [[2, 8, 8, 8, 16]] as [number, number, number, number, number][],
};
const options = { pool: { size: 1, spawn: spawnNode }, firstPauseMs: 5 };

async function until(holds: () => boolean): Promise<void> {
  while (!holds()) await new Promise((resolve) => setTimeout(resolve, 5));
}

test('samples of a clip come from its server, as few as are wanted', async () => {
  await withServer(scene({ ...SIZES, others: sound(4) }), {}, async (server) => {
    const clip = await Clip.open(server.url, options);
    const samples = new ClipSamples(clip, decode);
    for (const [first, count] of [
      [0, 48000],
      [95_000, 3000],
      [180_001, 20_000],
    ]) {
      const [left, right] = (await samples.read(first, count)) as Stereo;
      const expected = Float32Array.from({ length: count }, (_, k) => (first + k < 192_000 ? first + k : 0));
      assert.deepEqual(left, expected);
      assert.deepEqual(right, expected);
    }
    clip.close();
    await assert.rejects(samples.read(0, 10));
  });
});

test('samples of a clip in groups change where another group takes over', async () => {
  const numbers = 2000;
  const parts = [sound(4.1), sound(4.1, numbers)].map((others) => scene({ ...SIZES, others }));
  const clip = await Clip.open(grouped(parts, 41, 4, 1 << 20).buffer, { ...options, position: null });
  const samples = new ClipSamples(clip, decode);
  // Frames 37 to 40 are shared, so that group 1 takes over at frame 38.5, and its sample 0 is that of frame 37.
  const [takeover, start] = [3.85 * SAMPLE_RATE, 3.7 * SAMPLE_RATE];
  assert.equal(await samples.read(takeover - 100, 200), null);
  clip.setPlayhead({ time: 3.6, rate: 1 });
  await until(() => clip.scenes.length === 2);
  const [left] = (await samples.read(takeover - 100, 200)) as Stereo;
  for (let k = 0; k < 200; k++) {
    const sample = takeover - 100 + k;
    assert.equal(left[k], k < 100 ? sample : numbers * PACKET + sample - start);
  }
  clip.close();
});

test('chunks that disagree, are damaged, cut off or too large end in an error or in silence', async () => {
  const read = async (parts: Part[], cut = 0, change = (_: Uint8Array): unknown => null): Promise<Stereo | null> => {
    const bytes = scene({ ...SIZES, others: parts });
    change(bytes);
    const clip = await Clip.open(bytes.slice(0, bytes.length - cut).buffer, options);
    return new ClipSamples(clip, decode).read(0, 48000).finally(() => clip.close());
  };
  const parts = sound(2);
  const other = sound(2);
  new DataView(other[1].body.buffer).setUint16(1, 7, true);
  await assert.rejects(read([parts[0], other[1], ...parts.slice(2)]), /disagree/);
  await assert.rejects(
    read(parts, 0, (bytes) => bytes.fill(255, bytes.length - 30)),
    /damaged/,
  );
  const [left] = (await read(parts, parts[1].body.length + parts[2].body.length)) as Stereo;
  assert.equal(left[CHUNK - PRE_SKIP - 1], CHUNK - PRE_SKIP - 1);
  assert.equal(left[CHUNK - PRE_SKIP], 0);
  const large = parts.map((part) => ({ ...part, rawLength: 1 << 22 }));
  await assert.rejects(read(large), /at most 1048576/);
});
