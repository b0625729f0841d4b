/** Where scenes stand before a viewer. */

import assert from 'node:assert/strict';
import { test } from 'node:test';
import { lookAt } from '../src/element/camera/rig.js';
import type { Vector } from '../src/element/camera/vector.js';
import { moved, placedAround, poseInScene, turned } from '../src/element/headset/placement.js';

/** A view from (0, -4, 1) at (0, 0, 0), z being up. */
const EYE: Vector = [0, -4, 1];
const VIEW = {
  lens: { width: 4, height: 3, focal: [4, 4], centre: [2, 1.5], pose: [] },
  focus: [0, 0, 0] as Vector,
  distance: Math.hypot(4, 1),
  axes: lookAt(EYE, [0, 0, 0], [0, 0, 1]),
  up: [0, 0, 1] as Vector,
};
/** A viewer at (1, 1.6, 2) who looks along x. */
const VIEWER = [0, 0, 1, 0, 0, 1, 0, 0, -1, 0, 0, 0, 1, 1.6, 2, 1];

const place = (pose: readonly number[]) => [3, 7, 11].map((at) => Number(pose[at].toFixed(9)));

test('the viewer is where the eye of the view is, and looks level the same way', () => {
  const pose = poseInScene(placedAround(VIEWER, VIEW, 0.5), VIEWER);
  assert.deepEqual(place(pose), [0, -4, 1]);
  assert.deepEqual(
    pose.filter((_, i) => i % 4 < 3).map((x) => Math.round(1e9 * x) / 1e9 + 0),
    [1, 0, 0, 0, 0, -1, 0, 1, 0],
  );
});

test('a step is as long as the file says, or what is looked at is within reach', () => {
  const ahead = VIEWER.map((x, i) => (i === 12 ? x + 1 : x));
  assert.deepEqual(place(poseInScene(placedAround(VIEWER, VIEW, 0.5), ahead)), [0, -2, 1]);
  const [, y] = place(poseInScene(placedAround(VIEWER, VIEW), ahead));
  assert.ok(Math.abs(y + 4 - VIEW.distance / 1.5) < 1e-6);
});

test('the scene is turned around a point and moved', () => {
  const placement = placedAround(VIEWER, VIEW, 1);
  // The scene's centre, 4 m ahead and 1 m below, comes to the viewer's left.
  const left = turned(placement, [1, 1.6, 2], Math.PI / 2);
  const atLeft = VIEWER.map((x, i) => x + ({ 13: -1, 14: -4 }[i] ?? 0));
  assert.deepEqual(
    place(poseInScene(left, atLeft)).map((x) => Math.abs(x)),
    [0, 0, 0],
  );
  assert.deepEqual(place(poseInScene(moved(placement, [0, 0.25, 0]), VIEWER)), [0, -4, 0.75]);
});
