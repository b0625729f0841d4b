/** What the shaders of a scene are compiled with: the twin of kpc.player.gl.shader_constants. */

import type { DecoderWeights } from '../container/scene_chunks.js';
import { mayBeParts } from './areas.js';
import type { Layout } from './atlas.js';
import { headOf, type SceneSource } from './scene_source.js';
import type { ConstantArray, Defines } from './shader.js';

const roundUp = (n: number) => 4 * Math.ceil(n / 4);

/** Whether the colour of an explicit decoder depends on the direction of view. */
const isViewDependent = (decoder: DecoderWeights) => decoder.weights.w2.some((weight) => weight !== 0);

/** Return the macros that describe the planes. */
export function planesShape(scene: SceneSource, layout: Layout): Defines {
  const layers = layout.layers.map((count, scale) => [`LAYERS_${scale}`, count]);
  const first = layout.firstLayers.map((number, scale) => [`FIRST_${scale}`, number]);
  const { scales, features } = layout;
  const parts = mayBeParts(scene).map((isPart, scale) => [`PART_${scale}`, Number(isPart)]);
  const each = Object.fromEntries([...layers, ...first, ...parts]);
  return { SCALES: scales, FEATURES: features, BASIS: 3 * features, ...each };
}

/** Return the macros that describe the decoder; HIDDEN is 0 for view-independent colour. */
export function decoderShape(decoder: DecoderWeights): Defines {
  if (!decoder.isHybrid) {
    return { HYBRID: 0, HIDDEN: isViewDependent(decoder) ? decoder.hidden : 0, HIDDEN_4: 0, WIDTH_4: 0 };
  }
  const [hidden, width] = [roundUp(decoder.hidden), roundUp(decoder.width)];
  return { HYBRID: 1, HIDDEN: hidden, HIDDEN_4: hidden / 4, WIDTH: width, WIDTH_4: width / 4 };
}

/** Return the numbers of a (rows, columns) array whose columns go to the places `to` of rows of `width`. */
function placed(values: Float32Array, rows: number, width: number, to: readonly number[]): Float32Array {
  const out = new Float32Array(rows * width);
  const columns = to.length;
  for (let i = 0; i < values.length; i++) {
    out[Math.floor(i / columns) * width + to[i % columns]] = values[i];
  }
  return out;
}

const inOrder = (count: number) => Array.from({ length: count }, (_, i) => i);

/** Return the decoder's weights as march.glsl wants them, features in the padded layout of the planes. */
export function decoderArrays(decoder: DecoderWeights, scene: SceneSource, layout: Layout) {
  const columns = layout.firstLayers.flatMap((first, scale) =>
    inOrder(headOf(scene.head.scales[scale], 'xy').channels).map((c) => 4 * first + c),
  );
  const spread = (values: Float32Array, rows: number) => placed(values, rows, 4 * layout.features, columns);
  const arrays: Record<string, Float32Array> = { density_bias: Float32Array.of(decoder.densityBias, 0, 0, 0) };
  const { weights, hidden } = decoder;
  if (decoder.isHybrid) {
    const [width4, hidden4] = [roundUp(decoder.width), roundUp(hidden)];
    arrays.from_features = spread(weights.v, width4);
    arrays.from_features_bias = placed(weights.v_bias, 1, width4, inOrder(decoder.width));
    arrays.density_weight = placed(weights.density_weight, 1, width4, inOrder(decoder.width));
    arrays.w1 = directionLayer(decoder, hidden4);
    arrays.from_hidden = placed(weights.u, hidden4, width4, inOrder(decoder.width));
    arrays.w2 = placed(weights.w2, 3, hidden4, inOrder(hidden));
    arrays.b2 = placed(weights.b2, 1, 4, inOrder(3));
  } else {
    arrays.density_weight = spread(weights.density_weight, 1);
    arrays.b2 = spread(weights.b2, 3);
    if (isViewDependent(decoder)) {
      arrays.w1 = directionLayer(decoder, hidden);
      arrays.w2 = colourLayer(decoder, layout.features, columns);
    }
  }
  return vectors(arrays);
}

/** Return w1 and b1 side by side, 12 numbers a hidden unit. */
function directionLayer({ weights, hidden }: DecoderWeights, rows: number): Float32Array {
  const out = placed(weights.w1, rows, 12, inOrder(9));
  for (let h = 0; h < hidden; h++) out[12 * h + 9] = weights.b1[h];
  return out;
}

/** Return w2 [colour][feature][hidden] of an explicit decoder as [colour][layer][hidden][4]. */
function colourLayer(decoder: DecoderWeights, layers: number, columns: readonly number[]): Float32Array {
  const { hidden, features } = decoder;
  const out = new Float32Array(3 * layers * hidden * 4);
  decoder.weights.w2.forEach((weight, i) => {
    const [h, feature, colour] = [i % hidden, Math.floor(i / hidden) % features, Math.floor(i / hidden / features)];
    const column = columns[feature];
    out[4 * ((colour * layers + (column >> 2)) * hidden + h) + (column & 3)] = weight;
  });
  return out;
}

function vectors(arrays: Record<string, ArrayLike<number>>): Record<string, ConstantArray> {
  return Object.fromEntries(Object.entries(arrays).map(([name, values]) => [name, { kind: 'vec4', values }]));
}

/** Return where planes lie in a texture, as march.glsl wants it. */
export function blockArrays(scene: SceneSource, layout: Layout): Record<string, ConstantArray> {
  const last = scene.head.scales.flatMap((scale) => {
    const { columns, rows } = headOf(scale, 'xy');
    return [columns - 1, rows - 1, headOf(scale, 'xz').rows - 1, 0];
  });
  return {
    blocks: { kind: 'vec4', values: layout.blocks.flatMap((block) => layout.textureRectangle(block)) },
    layer_widths: { kind: 'float', values: layout.blocks.map(({ width }) => width / layout.width) },
    last_texels: { kind: 'vec4', values: last },
    first_layers: { kind: 'int', values: layout.firstLayers },
  };
}
