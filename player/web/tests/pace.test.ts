/** The choice of what frames have time for, on devices of many speeds. */

import assert from 'node:assert/strict';
import test from 'node:test';

import { costOf, Pace, settingsOf } from '../src/render/pace.js';

const FRAME = 1 / 30;

/**
 * Draw frames on a device that takes `fixed` seconds and `perRay` for each ray of a pixel; return all settings' costs.
 */
function play(pace: Pace, perRay: number, fixed: number, frames: number): number[] {
  return Array.from({ length: frames }, (_, i) => {
    const setting = pace.setting(1);
    const cost = costOf(setting, 1);
    pace.record(cost, (fixed + perRay * cost) * (i % 7 === 3 ? 1.3 : 1));
    return cost;
  });
}

for (const [speed, perRay] of [0.0005, 0.02, 0.1, 1, 5].entries()) {
  test(`frames come in time, and are as fine as there is time for: speed ${speed}`, () => {
    for (const fixed of [0, 0.004]) {
      const costs = play(new Pace(FRAME, 0.1), perRay, fixed, 600).slice(60);
      const cost = costs.sort((a, b) => a - b)[Math.floor(costs.length / 2)];
      assert.ok(fixed + perRay * cost <= FRAME || cost === costOf(settingsOf(1)[0], 1));
      const finer = settingsOf(1)
        .map((setting) => costOf(setting, 1))
        .find((other) => other > cost);
      assert.ok(finer === undefined || fixed + perRay * finer > 0.4 * FRAME);
    }
  });
}

test('what was too slow is not tried again soon', () => {
  const pace = new Pace(FRAME, 0.1);
  const costs = play(pace, 0.06, 0.002, 400).slice(100);
  const changes = costs.filter((cost, i) => i > 0 && cost !== costs[i - 1]).length;
  assert.ok(changes <= 4, `${changes} changes`);
});

test('a device that becomes faster gets finer pictures', () => {
  const pace = new Pace(FRAME, 0.1);
  const slow = play(pace, 1, 0, 100).at(-1) ?? 0;
  const fast = play(pace, 0.01, 0, 700).at(-1) ?? 0;
  assert.ok(fast > 4 * slow);
});

test('where little depends on the rays, pictures do not become ever coarser', () => {
  const cost = play(new Pace(FRAME, 0.1), 0.1, 0.05, 600).at(-1) ?? 0;
  assert.ok(cost > 0.01);
});

test('settings cost more and more', () => {
  for (const texels of [0.05, 0.3, 1, 1.7, 2, 8, 100]) {
    const costs = settingsOf(texels).map((setting) => costOf(setting, texels));
    assert.deepEqual(
      costs,
      [...costs].sort((a, b) => a - b),
    );
    assert.ok(costs.length >= 2 && costs[0] <= Math.max(0.01, (texels / 3) ** 2));
  }
});

test('slow frames at the beginning, or while something else runs, do not keep pictures coarse', () => {
  const perRay = 0.047 / costOf(settingsOf(0.6)[0], 0.6);
  const pace = new Pace(0.1, 0);
  const play = (frames: number, factor: number): number[] =>
    Array.from({ length: frames }, () => {
      const cost = costOf(pace.setting(0.6), 0.6);
      pace.record(cost, perRay * cost * factor);
      return perRay * cost;
    });
  play(6, 6);
  assert.ok((play(40, 1).at(-1) ?? 0) > 0.06);
  play(12, 6);
  assert.ok((play(120, 1).at(-1) ?? 0) > 0.06); // within twelve seconds
});
