/** A view that orbits around a point, and how hands move it. All functions return another view. */

import type { Camera } from '../../container/scene_chunks.js';
import { type Axes, axesOf, eyeOf, lookAt, poseOf, type Rig } from './rig.js';
import { across, clamp, cross, dot, length, minus, normalised, plus, rotated, type Vector } from './vector.js';

/** Orbiting stops at this angle from looking straight up or down, radians. */
const MIN_POLAR_ANGLE = Math.PI / 180;
/** Distance over that before, for each notch of the wheel, and bounds of the distance, world units. */
const [ZOOM_FACTOR, MIN_DISTANCE, MAX_DISTANCE] = [0.9, 1e-4, 1e6];
const DECIMALS = 4;
/** The shape, width over height, in which encoders see to it that the opening view holds. */
const OPENING_ASPECT = 16 / 9;

export interface View {
  /** The camera whose intrinsics to use; its pose is ignored. */
  readonly lens: Camera;
  /** The point it orbits around, and how far the eye is from it. */
  readonly focus: Vector;
  readonly distance: number;
  readonly axes: Axes;
  /** The axis of horizontal orbits. */
  readonly up: Vector;
}

export const eyeOfView = ({ focus, distance, axes }: View): Vector => plus(focus, axes.backward, distance);

/** Return the view of a camera, orbiting around the point of its axis that is nearest to the rig's focus. */
export function viewOf(rig: Rig, camera: Camera): View {
  const [axes, eye] = [axesOf(camera), eyeOf(camera)];
  const offset = minus(rig.focus, eye);
  const distance = Math.max(-dot(offset, axes.backward), 0.1 * length(offset), 1e-3);
  return { lens: camera, focus: plus(eye, axes.backward, -distance), distance, axes, up: rig.up };
}

/**
 * Return the camera for a picture of this size. Its height shows what the lens's does; a picture that is narrower than
 * the lens's, as on an upright telephone, shows more above and below so that it need not lose as much at the sides. One
 * that is wider than that and than OPENING_ASPECT shows less above and below, and no more at the sides.
 */
export function cameraOf(view: View, width: number, height: number): Camera {
  const { lens, axes } = view;
  const [byWidth, byHeight] = [width / lens.width, height / lens.height];
  const widest = Math.max(lens.width, OPENING_ASPECT * lens.height);
  const scale = byWidth < byHeight ? Math.sqrt(byWidth * byHeight) : Math.max(byHeight, width / widest);
  return {
    width,
    height,
    focal: lens.focal.map((focal) => focal * scale),
    centre: [
      width / 2 + (lens.centre[0] - lens.width / 2) * scale,
      height / 2 + (lens.centre[1] - lens.height / 2) * scale,
    ],
    pose: poseOf(axes, eyeOfView(view)),
  };
}

/** Drag the scene by two angles in radians; the eye moves the other way around the focus. */
export function orbited(view: View, right: number, up: number): View {
  const turned = mapped(view.axes, (axis) => rotated(axis, view.up, -right));
  const pitched = mapped(turned, (axis) => rotated(axis, turned.right, up));
  const angles = [turned, pitched].map(({ backward }) => Math.acos(clamp(dot(backward, view.up), -1, 1)));
  const [before, polar] = angles.map((angle) => Math.min(angle, Math.PI - angle));
  const isTooSteep = polar < MIN_POLAR_ANGLE && polar < before;
  const isUpsideDown = dot(pitched.up, view.up) < 0 && dot(turned.up, view.up) > 0;
  return { ...view, axes: orthonormal(isTooSteep || isUpsideDown ? turned : pitched) };
}

/** Drag the focus parallel to the picture, in heights of the picture, so that it stays under the pointer. */
export function panned(view: View, right: number, up: number): View {
  const height = (view.distance * view.lens.height) / view.lens.focal[1];
  const { axes } = view;
  return { ...view, focus: plus(plus(view.focus, axes.right, -height * right), axes.up, -height * up) };
}

/** Move closer by a tenth of the distance for each notch of the wheel. */
export function zoomed(view: View, notches: number): View {
  const distance = view.distance * ZOOM_FACTOR ** clamp(notches, -100, 100);
  return { ...view, distance: clamp(distance, MIN_DISTANCE, MAX_DISTANCE) };
}

/** Return how many notches bring what is seen to a size over that before. */
export const notchesOf = (factor: number): number => -Math.log(factor) / Math.log(ZOOM_FACTOR);

/** Move eye and focus along the camera's axes, world units. */
export function flown(view: View, right: number, up: number, forward: number): View {
  const { axes } = view;
  return { ...view, focus: plus(plus(plus(view.focus, axes.right, right), axes.up, up), axes.backward, -forward) };
}

/** Return a view in words: the eye, the point that it looks at, and the vertical angle of view in degrees. */
export function textOfView(view: View): string {
  const { lens, focus } = view;
  const angle = (2 * Math.atan(lens.height / 2 / lens.focal[1]) * 180) / Math.PI;
  return [...eyeOfView(view), ...focus, angle].map((x) => String(Number(x.toFixed(DECIMALS)))).join(' ');
}

/** Return the view that such words say, with or without the angle; null if they say none. */
export function viewFromText(rig: Rig, text: string, lens: Camera): View | null {
  const numbers = text
    .trim()
    .split(/[\s,]+/)
    .map(Number);
  if (![6, 7].includes(numbers.length) || !numbers.every((x) => Math.abs(x) <= MAX_DISTANCE)) return null;
  const [eye, focus] = [0, 3].map((first) => numbers.slice(first, first + 3) as unknown as Vector);
  const distance = length(minus(eye, focus));
  if (!(distance >= MIN_DISTANCE)) return null;
  const view = { lens, focus, distance, axes: lookAt(eye, focus, rig.up), up: rig.up };
  const angle = numbers[6];
  if (angle === undefined) return view;
  if (!(angle >= 1 && angle <= 170)) return null;
  const scale = lens.height / 2 / Math.tan((angle * Math.PI) / 360) / lens.focal[1];
  return { ...view, lens: { ...lens, focal: lens.focal.map((focal) => focal * scale) } };
}

const mapped = ({ right, up, backward }: Axes, turn: (axis: Vector) => Vector): Axes => ({
  right: turn(right),
  up: turn(up),
  backward: turn(backward),
});

/** Return axes that are perpendicular again, so that many small rotations do not add up to a skew. */
function orthonormal(axes: Axes): Axes {
  const backward = normalised(axes.backward);
  const right = normalised(across(axes.right, backward));
  return { right, up: cross(backward, right), backward };
}
