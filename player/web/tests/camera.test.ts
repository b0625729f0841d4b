import assert from 'node:assert/strict';
import { test } from 'node:test';
import { Limits } from '../src/element/camera/limits.js';
import { axesOf, eyeOf, lookAt, poseOf, Rig } from '../src/element/camera/rig.js';
import { dot, eigen, length, minus, type Vector } from '../src/element/camera/vector.js';
import {
  cameraOf,
  eyeOfView,
  flown,
  orbited,
  panned,
  textOfView,
  viewFromText,
  viewOf,
  zoomed,
} from '../src/element/camera/view.js';
import { ViewControl } from '../src/element/camera/view_control.js';

const BOX = [-1, -1, -1, 1, 1, 1];
const UP: Vector = [0, 0, 1];
const EYES: Vector[] = [
  [3, 0, 1],
  [2.6, 1.5, 1],
  [2.6, -1.5, 1],
];
const LIMITS = {
  focus: [0, 0, 0],
  forward: [1, 0, 0],
  azimuth: [-20, 20],
  elevation: [0, 30],
  distance: [2, 4],
  reach: 0.2,
};

const camera = (eye: Vector) => ({
  ...{ width: 640, height: 480, focal: [600, 600], centre: [320, 240] },
  pose: poseOf(lookAt(eye, [0, 0, 0], UP), eye),
});
const rig = new Rig(EYES.map(camera), BOX);
const start = viewOf(rig, rig.cameras[0]);

function assertNear(got: readonly number[], wanted: readonly number[], tolerance = 1e-9): void {
  got.forEach((x, i) => {
    assert.ok(Math.abs(x - wanted[i]) <= tolerance, `${got} is not ${wanted}`);
  });
}

test('eigenvectors of a symmetric matrix are turned into multiples of themselves', () => {
  const matrix: Vector[] = [
    [4, 1, -2],
    [1, 3, 0.5],
    [-2, 0.5, 1],
  ];
  const { values, vectors } = eigen(matrix);
  vectors.forEach((v, i) => {
    assertNear(
      matrix.map((row) => dot(row, v)),
      v.map((x) => values[i] * x),
    );
    assertNear([length(v)], [1]);
  });
  assert.deepEqual(
    values,
    [...values].sort((a, b) => a - b),
  );
});

test('a rig finds what its cameras look at and which way is up', () => {
  assertNear(rig.focus, [0, 0, 0]);
  assertNear(rig.up, UP);
});

test('a scene without cameras is seen from outside its box', () => {
  const alone = new Rig([], BOX);
  assertNear(alone.focus, [0, 0, 0]);
  assert.ok(length(eyeOf(alone.cameras[0])) > Math.sqrt(3));
});

test('orbiting keeps the distance, the horizon, and off the poles', () => {
  let view = orbited(start, 0.3, -0.2);
  assertNear([length(minus(eyeOfView(view), view.focus))], [start.distance]);
  assertNear([dot(view.axes.right, UP)], [0]);
  for (let i = 0; i < 200; i++) view = orbited(view, 0.01, -0.1);
  assert.ok(Math.abs(dot(view.axes.backward, UP)) < 0.99995);
  assertNear([dot(view.axes.right, view.axes.up), length(view.axes.right)], [0, 1]);
});

test('panning keeps what is under the pointer, zooming and flying move the eye', () => {
  const { axes, distance, lens } = start;
  assertNear(
    minus(panned(start, 1, 0).focus, start.focus),
    axes.right.map((x) => (-x * distance * lens.height) / lens.focal[1]),
  );
  assertNear([zoomed(start, 1).distance], [0.9 * distance]);
  assertNear(
    minus(eyeOfView(flown(start, 0, 0, 2)), eyeOfView(start)),
    axes.backward.map((x) => -2 * x),
  );
});

test('a picture shows the height of the lens, more where it is narrow, and less where it is very wide', () => {
  const wide = cameraOf(start, 1280, 720);
  assertNear([wide.focal[1] / 720, wide.centre[0]], [600 / 480, 640]);
  const widest = cameraOf(start, 1920, 720);
  assertNear([widest.focal[0] / 1920, ...widest.centre], [wide.focal[0] / 1280, 960, 360]);
  const narrow = cameraOf(start, 480, 960);
  assert.ok(narrow.focal[1] / 960 < 600 / 480 && narrow.focal[0] / 480 > 600 / 640);
  assertNear(eyeOf(wide), eyeOfView(start));
  assertNear(axesOf(wide).backward, start.axes.backward);
});

test('a view is the same after it was written and read', () => {
  const view = orbited(start, 0.4, -0.1);
  const text = textOfView(view);
  const again = viewFromText(rig, text, view.lens);
  assert.ok(again);
  assert.equal(textOfView(again), text);
  assert.equal(viewFromText(rig, '1 2 3', view.lens), null);
  assert.equal(viewFromText(rig, '0 0 0 0 0 0', view.lens), null);
  assert.equal(viewFromText(rig, '1 0 0 0 0 x', view.lens), null);
  assert.equal(viewFromText(rig, '1 0 0 0 0 1e9', view.lens), null);
});

test('a view that left the limits comes back softly, and only then', () => {
  const limits = new Limits(LIMITS, UP);
  assert.equal(limits.kept(start, 0.1), start);
  let view = panned(zoomed(orbited(start, 1, 0.9), 20), 0.5, 0.5);
  const before = view.distance;
  view = limits.kept(view, 0.02);
  assert.ok(view.distance > before && view.distance < 2);
  for (let i = 0; i < 100; i++) view = limits.kept(view, 0.05);
  assert.equal(limits.kept(view, 0.05), view);
  const eye = eyeOfView(view);
  assert.ok(length(eye) >= 1.999 && length(view.focus) <= 0.201);
  assert.ok(Math.abs(Math.atan2(eye[1], eye[0])) <= (20.01 * Math.PI) / 180);
});

test('a view goes on after a drag, not after a rest, and not with inertia off', () => {
  const drag = (rest: number, hasInertia: boolean) => {
    const control = new ViewControl(rig, null, rig.cameras[0]);
    control.hasInertia = hasInertia;
    control.hold();
    for (let i = 0; i < 10; i++) {
      control.orbit(0.02, 0, 0.016);
      control.advance(0.016);
    }
    for (let i = 0; i < rest; i++) control.advance(0.05);
    control.release();
    const before = control.view;
    while (control.advance(0.016)) assert.notEqual(control.view, before);
    return length(minus(eyeOfView(control.view), eyeOfView(before)));
  };
  assert.ok(drag(0, true) > 0.1);
  assert.equal(drag(20, true), 0);
  assert.equal(drag(0, false), 0);
});

test('a drag that is taken back leaves the view where it was held, or was sent meanwhile, without inertia', () => {
  const control = new ViewControl(rig, new Limits(LIMITS, UP), rig.cameras[1]);
  const drag = () => {
    control.hold();
    for (let i = 0; i < 3; i++) control.orbit(0.02, 0.1, 0.016);
  };
  const taken = (view: typeof start) => {
    control.restore();
    control.release();
    assert.equal(control.advance(0.016), false);
    assert.equal(control.view, view);
  };
  const { view } = control;
  drag();
  taken(view);
  drag();
  control.lookFrom(start);
  control.orbit(0.02, 0.1, 0.016);
  taken(start);
});

test('a camera that was chosen is left where it is, outside the limits, too', () => {
  const control = new ViewControl(rig, new Limits(LIMITS, UP), rig.cameras[1]);
  assert.equal(control.advance(0.1), false);
  control.orbit(0, 0, 0.016);
  assert.equal(control.advance(0.1), true);
});
