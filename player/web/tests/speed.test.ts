/** The choice of what frames have time for while the camera moves and while it rests. */

import assert from 'node:assert/strict';
import test from 'node:test';

import { costOf, type Setting } from '../src/render/pace.js';
import { FOLLOWING_LEVELS } from '../src/render/quality.js';
import { Speed } from '../src/render/speed.js';

const FPS = 30;
/** What a picture that follows another takes, over one that is marched whole. */
const SHARE = 0.25;

interface Frame {
  setting: Setting;
  cost: number;
  seconds: number;
}

/**
 * Draw frames on a device that takes so many seconds for each ray of a pixel.
 * @param restedS for how long the camera has rested before; null: it moves.
 */
function play(speed: Speed, perRay: (frame: number) => number, frames: number, restedS: number | null): Frame[] {
  const drawn: Frame[] = [];
  let rested = restedS ?? 0;
  for (let i = 0; i < frames; i++) {
    const setting = speed.setting(1, rested);
    const cost = costOf(setting, 1);
    const canFollow = FOLLOWING_LEVELS.includes(setting.level);
    const isFollowing = restedS !== null && speed.isSettled && drawn.at(-1)?.cost === cost && canFollow;
    const seconds = perRay(i) * cost * (isFollowing ? SHARE : 1);
    const work = { raysPerRow: cost, raysPerPixel: cost, rowsLeft: 1, follows: isFollowing ? {} : null };
    speed.record(work, seconds, speed.isResting(rested) && canFollow);
    drawn.push({ setting, cost, seconds });
    if (restedS !== null) rested += Math.max(seconds, speed.secondsPerFrame);
  }
  return drawn;
}

const lastOf = (frames: Frame[]) => frames[frames.length - 1];

for (const perRay of [0.05, 0.1, 0.3]) {
  test(`a resting camera gets finer pictures that come in time: ${perRay} s for a ray of each pixel`, () => {
    const speed = new Speed(false, FPS);
    const moving = lastOf(play(speed, () => perRay, 300, null));
    const resting = play(speed, () => perRay, 300, 0);
    assert.ok(lastOf(resting).cost >= 1.9 * moving.cost, `${lastOf(resting).cost} for ${moving.cost}`);
    assert.ok(resting.slice(100).filter(({ seconds }) => seconds > 1.05 / FPS).length <= 3);
    assert.ok(
      resting.every(({ seconds }) => seconds <= 4 / FPS),
      'no picture is awaited for long',
    );
    assert.equal(play(speed, () => perRay, 1, null)[0].cost, moving.cost, 'the next move is in time at once');
  });
}

test('a camera that rests from the beginning comes as far, and so does the first move', () => {
  const speed = new Speed(true, 10);
  const resting = lastOf(play(speed, () => 0.3, 200, 0));
  const moving = play(speed, () => 0.3, 40, null);
  assert.ok(resting.cost >= 1.9 * lastOf(moving).cost);
  assert.ok(moving.every(({ seconds }) => seconds <= 1.05 / 10));
  assert.equal(moving[0].cost, lastOf(moving).cost);
});

for (const [isSoftware, fps, perRay] of [
  [false, 30, 0.2],
  [false, 30, 0.05],
  [true, 10, 0.3],
  [true, 10, 1],
] as const) {
  test(`a slow beginning at rest is forgotten: ${fps} frames a second, ${perRay} s for a ray of each pixel`, () => {
    const slow = (speed: Speed, isResting: boolean) =>
      lastOf(play(speed, (i) => perRay * (i < 5 * fps ? 6 : 1), 40 * fps, isResting ? 0 : null)).cost;
    const moving = slow(new Speed(isSoftware, fps), false);
    const resting = slow(new Speed(isSoftware, fps), true);
    assert.ok(resting >= moving, `${resting} for ${moving}`);
  });
}

test('settings do not change all the time where motion comes and goes', () => {
  const speed = new Speed(false, FPS);
  play(speed, () => 0.2, 300, null);
  const frames = play(speed, (i) => 0.2 * (i % 100 < 50 ? 0.5 : 3.6), 1500, 0);
  const changes = frames.slice(200).filter(({ cost }, i, all) => i > 0 && cost !== all[i - 1].cost).length;
  assert.ok(changes <= 20, `${changes} changes`);
});

test('a fast device draws fine pictures, which follow none', () => {
  const speed = new Speed(false, FPS);
  play(speed, () => 0.001, 200, null);
  assert.equal(lastOf(play(speed, () => 0.001, 100, 0)).setting.level, 'fine');
});

test('pieces of a picture that follows another are no larger than a whole one would let them be', () => {
  const speed = new Speed(true);
  const work = { raysPerRow: 100, raysPerPixel: 1, rowsLeft: 1e9, follows: null };
  for (let i = 0; i < 20; i++) {
    speed.recordRows(work, 10, 0.01);
    speed.recordRows({ ...work, follows: {} }, 10, 1e-6);
  }
  const rows = speed.rows(work, 0.25);
  assert.ok(Math.abs(rows - 250) <= 1);
  assert.ok(Math.abs(speed.rows({ ...work, follows: {} }, 0.25) - 4 * rows) <= 4);
  assert.equal(speed.rows({ ...work, rowsLeft: 7 }, 0.25), 7);
});

test('sample pixels are marched at once, or not at all', () => {
  const speed = new Speed(true);
  const work = { raysPerRow: 1000, raysPerPixel: 1, rowsLeft: 100, follows: null };
  assert.ok(speed.canSample(work));
  for (let i = 0; i < 20; i++) speed.recordRows(work, 100, 2);
  assert.ok(!speed.canSample(work));
});
