import assert from 'node:assert/strict';
import { test } from 'node:test';
import { emptyDistances } from '../src/render/atlas.js';

/** The Chebyshev distance of each cell to the nearest of some cells, at most 255, by trying all. */
function tried(cells: readonly number[][], [depth, height, width]: readonly number[]): number[] {
  const found: number[] = [];
  for (let z = 0; z < depth; z++) {
    for (let y = 0; y < height; y++) {
      for (let x = 0; x < width; x++) {
        const ways = cells.map(([a, b, c]) => Math.max(Math.abs(z - a), Math.abs(y - b), Math.abs(x - c)));
        found.push(Math.min(255, ...ways));
      }
    }
  }
  return found;
}

test('distances of cells are those to the nearest occupied one', () => {
  const cases: [number[][], number[]][] = [
    [[], [2, 3, 4]],
    [[[0, 0, 0]], [1, 1, 300]],
    [[[4, 0, 7]], [5, 6, 8]],
    [
      [
        [0, 5, 1],
        [3, 0, 6],
        [3, 1, 6],
        [6, 8, 0],
      ],
      [7, 9, 8],
    ],
  ];
  for (const [cells, sizes] of cases) {
    const occupied = new Uint8Array(sizes.reduce((product, size) => product * size));
    for (const [z, y, x] of cells) occupied[(z * sizes[1] + y) * sizes[2] + x] = 1;
    assert.deepEqual([...emptyDistances(occupied, sizes)], tried(cells, sizes));
  }
});
