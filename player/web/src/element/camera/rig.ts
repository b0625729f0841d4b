/** The cameras of a scene as a rig: the point they look at, which way is up, and viewpoints around it. */

import type { Camera } from '../../container/scene_chunks.js';
import {
  across,
  clamp,
  cross,
  dot,
  eigen,
  length,
  minus,
  normalised,
  plus,
  scaled,
  type Vector,
  vector,
} from './vector.js';

const RADIANS = Math.PI / 180;
/** Cameras surround their focus if they leave no wider gap between their azimuths, radians. */
const MAX_SURROUND_GAP = 160 * RADIANS;
/** The fraction of the angles between cameras on one side that viewpoints use: what lies beyond was not filmed. */
const USED_FRACTION = 0.7;
/** Least amplitudes of viewpoints in azimuth and elevation, radians. */
const MIN_AMPLITUDES = [2 * RADIANS, RADIANS];
/** The elevation of the viewpoint "above", radians, and distances of "near" and "far" over the median distance. */
const [ABOVE, NEAR, FAR] = [1.4, 0.6, 1.6];

/** Spherical coordinates around the focus, radians; the azimuth of the first camera is 0. */
interface Position {
  azimuth: number;
  elevation: number;
  distance: number;
}

export interface Axes {
  right: Vector;
  up: Vector;
  backward: Vector;
}

export const axesOf = ({ pose }: Camera): Axes => ({
  right: vector(pose, 0, 4),
  up: vector(pose, 1, 4),
  backward: vector(pose, 2, 4),
});
export const eyeOf = ({ pose }: Camera): Vector => vector(pose, 3, 4);

export function poseOf({ right, up, backward }: Axes, eye: Vector): number[] {
  return [0, 1, 2].flatMap((row) => [right[row], up[row], backward[row], eye[row]]);
}

/** Return the axes of a camera that looks from a point at another one, `up` pointing up in the picture. */
export function lookAt(eye: Vector, target: Vector, up: Vector): Axes {
  const backward = normalised(minus(eye, target));
  let right = cross(up, backward);
  if (length(right) < 1e-6) {
    // Looking along `up`, any right axis will do.
    const least = backward.map(Math.abs).indexOf(Math.min(...backward.map(Math.abs)));
    right = cross([+(least === 0), +(least === 1), +(least === 2)], backward);
  }
  right = normalised(right);
  return { right, up: cross(backward, right), backward };
}

export class Rig {
  readonly cameras: readonly Camera[];
  readonly focus: Vector;
  readonly up: Vector;

  /** @param aabb the lower and the upper corner of the scene's box; `up` of the metadata, if they have one. */
  constructor(cameras: readonly Camera[], aabb: readonly number[], up?: readonly number[]) {
    this.cameras = cameras.length > 0 ? cameras : [defaultCamera(aabb)];
    this.focus = focusOf(this.cameras, aabb);
    this.up = up ? normalised(vector(up)) : upOf(this.cameras);
  }

  /** Return viewpoints by name; all look at the focus. */
  presets(): Map<string, Camera> {
    const positions = this.cameras.map((camera) => this.#positionOf(camera));
    const [azimuths, elevations, distances] = (['azimuth', 'elevation', 'distance'] as const).map((name) =>
      positions.map((position) => position[name]),
    );
    const distance = median(distances);
    const elevation = elevations.reduce((a, b) => a + b) / elevations.length;
    let named: [string, Position][];
    if (surroundFocus(azimuths)) {
      const turns = { front: 0, right: 0.5, back: 1, left: -0.5 };
      named = Object.entries(turns).map(([name, turn]) => [name, { azimuth: Math.PI * turn, elevation, distance }]);
      named.push(['above', { azimuth: 0, elevation: ABOVE, distance }]);
    } else {
      const [a, e] = [azimuths, elevations].map((angles, i) => {
        const [low, high] = [Math.min(...angles), Math.max(...angles)];
        return { middle: (low + high) / 2, amplitude: Math.max((USED_FRACTION * (high - low)) / 2, MIN_AMPLITUDES[i]) };
      });
      const directions = { middle: [0, 0], left: [-1, 0], right: [1, 0], above: [0, 1], below: [0, -1] };
      named = Object.entries(directions).map(([name, [x, y]]) => [
        name,
        { azimuth: a.middle + x * a.amplitude, elevation: e.middle + y * e.amplitude, distance },
      ]);
    }
    const first = named[0][1];
    named.push(['near', { ...first, distance: NEAR * distance }], ['far', { ...first, distance: FAR * distance }]);
    return new Map(named.map(([name, position]) => [name, this.#cameraAt(position)]));
  }

  /** Return two horizontal unit vectors: from the focus to the first camera, and to the right of that camera. */
  #compass(): [Vector, Vector] {
    const { right, up } = axesOf(this.cameras[0]);
    const candidates = [minus(eyeOf(this.cameras[0]), this.focus), up, right];
    const towards = candidates.find((v) => length(across(v, this.up)) > 1e-6 * length(v) + 1e-12) ?? right;
    const ahead = normalised(across(towards, this.up));
    return [ahead, cross(this.up, ahead)];
  }

  #positionOf(camera: Camera): Position {
    const offset = minus(eyeOf(camera), this.focus);
    const distance = Math.max(length(offset), 1e-9);
    const [ahead, side] = this.#compass();
    return {
      azimuth: Math.atan2(dot(offset, side), dot(offset, ahead)),
      elevation: Math.asin(clamp(dot(offset, this.up) / distance, -1, 1)),
      distance,
    };
  }

  /** Return the first camera at another position, turned to the focus. */
  #cameraAt({ azimuth, elevation, distance }: Position): Camera {
    const [ahead, side] = this.#compass();
    const level = plus(scaled(ahead, Math.cos(azimuth)), side, Math.sin(azimuth));
    const towards = plus(scaled(level, Math.cos(elevation)), this.up, Math.sin(elevation));
    const eye = plus(this.focus, towards, distance);
    return { ...this.cameras[0], pose: poseOf(lookAt(eye, this.focus, this.up), eye) };
  }
}

function surroundFocus(azimuths: readonly number[]): boolean {
  const around = [...azimuths].sort((a, b) => a - b);
  const gaps = around.map((azimuth, i) => (around[i + 1] ?? around[0] + 2 * Math.PI) - azimuth);
  return azimuths.length > 2 && Math.max(...gaps) < MAX_SURROUND_GAP;
}

function median(values: readonly number[]): number {
  const sorted = [...values].sort((a, b) => a - b);
  const half = sorted.length / 2;
  return (sorted[Math.ceil(half) - 1] + sorted[Math.floor(half)]) / 2;
}

/** Return a camera outside a box that sees all of it, with z up. */
function defaultCamera(aabb: readonly number[]): Camera {
  const [low, high] = [vector(aabb), vector(aabb, 3)];
  const centre = scaled(plus(low, high), 0.5);
  const eye = plus(centre, [0, -Math.cos(0.35), Math.sin(0.35)], 1.2 * length(minus(high, low)));
  return {
    width: 640,
    height: 480,
    focal: [600, 600],
    centre: [320, 240],
    pose: poseOf(lookAt(eye, centre, [0, 0, 1]), eye),
  };
}

/**
 * Return the point with the least sum of squared distances to the optical axes. If that is not a point in front of the
 * cameras within the box (with a margin), return the point of the first axis that is nearest to the box's centre.
 */
function focusOf(cameras: readonly Camera[], aabb: readonly number[]): Vector {
  const eyes = cameras.map(eyeOf);
  const forward = cameras.map((camera) => scaled(axesOf(camera).backward, -1));
  // The sum of projections across the axes, and of the projected eyes.
  let total: Vector[] = [
    [0, 0, 0],
    [0, 0, 0],
    [0, 0, 0],
  ];
  let sum: Vector = [0, 0, 0];
  cameras.forEach((_, i) => {
    total = total.map((row, k) => plus(plus(row, [+(k === 0), +(k === 1), +(k === 2)]), forward[i], -forward[i][k]));
    sum = plus(sum, across(eyes[i], forward[i]));
  });
  const { values, vectors } = eigen(total);
  if (values[2] < 1e4 * values[0]) {
    const focus = vectors.reduce<Vector>((at, v, k) => plus(at, v, dot(v, sum) / values[k]), [0, 0, 0]);
    const isInside = focus.every((x, k) => {
      const margin = 0.25 * (aabb[k + 3] - aabb[k]);
      return x > aabb[k] - margin && x < aabb[k + 3] + margin;
    });
    const before = eyes.filter((eye, i) => dot(minus(focus, eye), forward[i]) > 0);
    if (isInside && before.length > 0.9 * eyes.length) return focus;
  }
  const centre = scaled(plus(vector(aabb), vector(aabb, 3)), 0.5);
  const extent = Math.max(aabb[3] - aabb[0], aabb[4] - aabb[1], aabb[5] - aabb[2]);
  return plus(eyes[0], forward[0], Math.max(dot(minus(centre, eyes[0]), forward[0]), 0.1 * extent));
}

/** Return the direction perpendicular to all right axes if they determine one, else the mean of the up axes. */
function upOf(cameras: readonly Camera[]): Vector {
  const rights = cameras.map((camera) => axesOf(camera).right);
  const mean = cameras.reduce<Vector>((sum, camera) => plus(sum, axesOf(camera).up, 1 / cameras.length), [0, 0, 0]);
  const moments = [0, 1, 2].map((row) =>
    rights.reduce<Vector>((sum, right) => plus(sum, right, right[row] / rights.length), [0, 0, 0]),
  );
  const { values, vectors } = eigen(moments);
  let up = vectors[0];
  if (values[1] < 1e-3 || values[0] > 0.05 * values[1] || Math.abs(dot(up, mean)) < 0.5 * length(mean)) {
    up = length(mean) > 1e-6 ? mean : axesOf(cameras[0]).up;
  }
  return scaled(normalised(up), dot(up, mean) >= 0 ? 1 : -1);
}
