/** Cameras to draw from, and how many texels of a scene a pixel of one spans. */

import { extentOf, headOf, type SceneSource, SPACE_PLANES } from './scene_source.js';

/** A pinhole camera, lengths in pixels; `pose` is camera to world, 3 rows of 4 numbers: right, up, backward, place. */
export interface Camera {
  width: number;
  height: number;
  focal: ArrayLike<number>;
  centre: ArrayLike<number>;
  pose: ArrayLike<number>;
}

/** Return the same view at another size; each axis is scaled independently. */
export function resized(camera: Camera, width: number, height: number): Camera {
  const [x, y] = [width / camera.width, height / camera.height];
  const [focal, centre] = [camera.focal, camera.centre].map((lens) => [lens[0] * x, lens[1] * y]);
  return { width, height, focal, centre, pose: camera.pose };
}

/** Return the lens of a perspective projection, a 4x4 matrix column by column, for a picture of this size. */
export function pinholeOf(projection: ArrayLike<number>, width: number, height: number) {
  return {
    focal: [projection[0] * (width / 2), projection[5] * (height / 2)],
    centre: [(width / 2) * (1 - projection[8]), (height / 2) * (1 + projection[9])],
  };
}

/** Return whether two cameras see the same picture. */
export function isSameView(a: Camera, b: Camera): boolean {
  const numbers = ({ width, height, focal, centre, pose }: Camera) =>
    [width, height, focal[0], focal[1], centre[0], centre[1], ...Array.from(pose)].map(Math.fround);
  const others = numbers(b);
  return numbers(a).every((x, i) => x === others[i]);
}

/** Return the columns of a pose, as a shader takes them: right, up, backward, place. */
export function columnsOf(pose: ArrayLike<number>): number[] {
  return [0, 1, 2, 3].flatMap((column) => [pose[column], pose[column + 4], pose[column + 8]]);
}

/**
 * Return how many texels of the finest scale a pixel spans: in the middle of the box; in device coordinates about,
 * taking the planes to be as wide as the picture.
 */
export function texelsPerPixel(scene: SceneSource, camera: Camera): number {
  const { aabb, scales } = scene.head;
  const finest = scales[scales.length - 1];
  const sizes = SPACE_PLANES.map((name) => headOf(finest, name)).flatMap(({ columns, rows }) => [columns, rows]);
  const across = Math.max(1, ...sizes.map((size) => size - 1));
  if (scene.mapping?.mapping === 2) return across / Math.max(camera.width, camera.height);
  const inBox = scene.mapping === null ? across : across / 2; // the box is half of contracted space
  const place = columnsOf(camera.pose).slice(9);
  const distance = Math.hypot(...place.map((x, axis) => (aabb[axis] + aabb[axis + 3]) / 2 - x));
  return (distance / Math.min(camera.focal[0], camera.focal[1])) * (inBox / extentOf(scene));
}
