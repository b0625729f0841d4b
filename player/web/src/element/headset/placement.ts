/** Where a scene stands in the space of a headset: x right, y up, metres. All functions return another placement. */

import { type Axes, poseOf } from '../camera/rig.js';
import { across, cross, minus, normalised, plus, rotated, scaled, type Vector, vector } from '../camera/vector.js';
import { eyeOfView, type View } from '../camera/view.js';

/** Metres from the viewer to what the view looks at, where the file does not say how long a unit is. */
const USUAL_DISTANCE = 1.5;
const UP: Vector = [0, 1, 0];

export interface Placement {
  /** Metres of a unit of the scene. */
  readonly scale: number;
  /** Radians by which the scene is turned around the vertical. */
  readonly turn: number;
  /** A point of the scene, and where it is. */
  readonly pivot: Vector;
  readonly at: Vector;
  /** The directions in the scene that are right, up and backward before it is turned. */
  readonly axes: Axes;
}

/** Place a scene so that a viewer, whose pose is 4 columns of 4 numbers, is where the eye of a view is. */
export function placedAround(viewer: ArrayLike<number>, view: View, metresPerUnit?: number): Placement {
  const right = normalised(across(view.axes.right, view.up));
  const backward = vector(viewer, 8);
  return {
    scale: metresPerUnit ?? USUAL_DISTANCE / view.distance,
    turn: Math.atan2(backward[0], backward[2]),
    pivot: eyeOfView(view),
    at: vector(viewer, 12),
    axes: { right, up: view.up, backward: cross(right, view.up) },
  };
}

/** Turn the scene around a point by an angle, counter-clockwise seen from above. */
export function turned(placement: Placement, around: Vector, angle: number): Placement {
  const at = plus(around, rotated(minus(placement.at, around), UP, angle));
  return { ...placement, turn: placement.turn + angle, at };
}

/** Move the scene, metres. */
export const moved = (placement: Placement, by: Vector): Placement => ({ ...placement, at: plus(placement.at, by) });

/** Return the pose in the scene, 3 rows of 4 numbers, of an eye whose pose is 4 columns of 4 numbers. */
export function poseInScene({ scale, turn, pivot, at, axes }: Placement, eye: ArrayLike<number>): number[] {
  const inScene = (direction: Vector): Vector => {
    const [x, y, z] = rotated(direction, UP, -turn);
    return plus(plus(scaled(axes.right, x), axes.up, y), axes.backward, z);
  };
  const [right, up, backward] = [0, 4, 8].map((column) => inScene(vector(eye, column)));
  return poseOf({ right, up, backward }, plus(pivot, inScene(scaled(minus(vector(eye, 12), at), 1 / scale))));
}
