/** Whole scenes of a file as the renderer wants them, without streaming and workers. */

import type { PlaneSymbols, Scene } from '../src/container/scene.js';
import type { PlaneName } from '../src/container/scene_chunks.js';
import { layerTexels } from '../src/decoder/texels.js';
import { type PlaneRows, type SceneSource, SPACE_PLANES } from '../src/render/scene_source.js';

/** Pieces of planes that are handed out at once, so that pictures begin with a part of them. */
const PIECES = 2;

export function sourceOf(scene: Scene): SceneSource {
  const planes = scene.planes();
  const planeOf = (scale: number, plane: PlaneName) => planes[scale][plane] as PlaneSymbols;
  const spacePlanes = (): PlaneRows[] =>
    planes.flatMap((_, scale) =>
      SPACE_PLANES.map((plane) => {
        const { head, symbols } = planeOf(scale, plane);
        return { scale, plane, firstRow: 0, rowCount: head.rows, texels: layerTexels(symbols, head) };
      }),
    );
  let waiting = spacePlanes();
  return {
    ...{ head: scene.head, mapping: scene.mapping, motion: scene.motion, occupancy: scene.occupancy },
    ...{ decoder: scene.decoder, appearances: scene.appearances, version: 0 },
    take: () => waiting.splice(0, PIECES),
    row(scale, plane, time) {
      const { head, symbols, offset } = planeOf(scale, plane);
      const values = scene.core.dequantise(symbols, head.step, offset);
      const position = time * (head.rows - 1);
      const lower = Math.min(Math.floor(position), Math.max(head.rows - 2, 0));
      const length = head.columns * head.channels;
      const [one, other] = [lower, Math.min(lower + 1, head.rows - 1)].map((row) => row * length);
      const share = position - lower;
      return Float32Array.from({ length }, (_, i) => values[one + i] * (1 - share) + values[other + i] * share);
    },
    restore() {
      waiting = spacePlanes();
    },
  };
}
