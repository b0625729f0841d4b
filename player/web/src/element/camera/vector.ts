/** Vectors of three numbers, and symmetric matrices of three rows. */

export type Vector = readonly [number, number, number];

export const vector = (numbers: ArrayLike<number>, first = 0, stride = 1): Vector => [
  numbers[first],
  numbers[first + stride],
  numbers[first + 2 * stride],
];
export const dot = (a: Vector, b: Vector): number => a[0] * b[0] + a[1] * b[1] + a[2] * b[2];
export const scaled = (a: Vector, factor: number): Vector => [a[0] * factor, a[1] * factor, a[2] * factor];
/** Return a + factor * b. */
export const plus = (a: Vector, b: Vector, factor = 1): Vector => [
  a[0] + factor * b[0],
  a[1] + factor * b[1],
  a[2] + factor * b[2],
];
export const minus = (a: Vector, b: Vector): Vector => plus(a, b, -1);
export const length = (a: Vector): number => Math.hypot(...a);
export const normalised = (a: Vector): Vector => scaled(a, 1 / length(a));
export const cross = (a: Vector, b: Vector): Vector => [
  a[1] * b[2] - a[2] * b[1],
  a[2] * b[0] - a[0] * b[2],
  a[0] * b[1] - a[1] * b[0],
];
/** Return the part of a vector that is perpendicular to a unit vector. */
export const across = (a: Vector, unit: Vector): Vector => plus(a, unit, -dot(a, unit));
export const clamp = (x: number, low: number, high: number): number => Math.min(Math.max(x, low), high);

/** Turn a vector around a unit vector, counter-clockwise seen from its tip (Rodrigues' formula). */
export function rotated(a: Vector, axis: Vector, angle: number): Vector {
  const sideways = cross(axis, a);
  return plus(plus(a, sideways, Math.sin(angle)), cross(axis, sideways), 1 - Math.cos(angle));
}

/**
 * Return eigenvalues, from the least to the largest, and unit eigenvectors of a symmetric matrix (Jacobi's method).
 * @param matrix 3 rows of 3 numbers.
 */
export function eigen(matrix: readonly Vector[]): { values: number[]; vectors: Vector[] } {
  const a = matrix.map((row) => [...row]);
  const v = [
    [1, 0, 0],
    [0, 1, 0],
    [0, 0, 1],
  ];
  for (let sweep = 0; sweep < 30; sweep++) {
    for (const [p, q] of [
      [0, 1],
      [0, 2],
      [1, 2],
    ]) {
      if (a[p][q] === 0) continue;
      const theta = Math.atan2(2 * a[p][q], a[q][q] - a[p][p]) / 2;
      const [cos, sin] = [Math.cos(theta), Math.sin(theta)];
      for (const rows of [a, v]) {
        for (const row of rows) [row[p], row[q]] = [cos * row[p] - sin * row[q], sin * row[p] + cos * row[q]];
      }
      for (let k = 0; k < 3; k++) [a[p][k], a[q][k]] = [cos * a[p][k] - sin * a[q][k], sin * a[p][k] + cos * a[q][k]];
    }
  }
  const order = [0, 1, 2].sort((i, j) => a[i][i] - a[j][j]);
  return { values: order.map((i) => a[i][i]), vectors: order.map((i) => [v[0][i], v[1][i], v[2][i]]) };
}
