/** Space planes as textures take them: half floats, four channels to a texel, layer beside layer. */

import type { PlaneHead } from '../container/scene_chunks.js';
import { dequantised } from './segment.js';

/** Layers of four channels that a plane fills. */
export const layerCount = (channels: number): number => Math.ceil(channels / 4);

/** Return the values of symbols [row][column][channel] as halves [row][layer][column][4]; 0 beyond the channels. */
export function layerTexels(symbols: Int8Array, plane: PlaneHead): Uint16Array<ArrayBuffer> {
  const { columns, channels } = plane;
  const layers = layerCount(channels);
  const halves = valueTable(plane);
  const rows = symbols.length / (columns * channels);
  const texels = new Uint16Array(rows * columns * layers * 4);
  let at = 0;
  for (let row = 0; row < rows; row++) {
    for (let column = 0; column < columns; column++) {
      for (let channel = 0; channel < channels; channel++) {
        const to = ((row * layers + (channel >> 2)) * columns + column) * 4 + (channel & 3);
        texels[to] = halves[256 * channel + symbols[at++] + 128];
      }
    }
  }
  return texels;
}

/** Return the halves of all 256 symbols of each channel. */
function valueTable({ channels, step, offset }: PlaneHead): Uint16Array {
  const table = new Uint16Array(256 * channels);
  for (let channel = 0; channel < channels; channel++) {
    for (let symbol = -128; symbol < 128; symbol++) {
      table[256 * channel + symbol + 128] = toHalf(dequantised(symbol, step[channel], offset[channel]));
    }
  }
  return table;
}

/** Return the bits of the nearest IEEE 754 binary16, ties to even, of a magnitude of at most 65504. */
export function toHalf(value: number): number {
  const sign = value < 0 || Object.is(value, -0) ? 0x8000 : 0;
  const magnitude = Math.abs(value);
  if (magnitude < 2 ** -14) return sign | roundEven(magnitude * 2 ** 24);
  const exponent = Math.floor(Math.log2(magnitude));
  const scaled = magnitude / 2 ** exponent; // in [1, 2), but for an error of log2
  const [power, fraction] =
    scaled >= 2 ? [exponent + 1, scaled / 2] : scaled < 1 ? [exponent - 1, 2 * scaled] : [exponent, scaled];
  return sign | Math.min(((power + 15) << 10) + roundEven((fraction - 1) * 1024), 0x7bff);
}

function roundEven(value: number): number {
  const low = Math.floor(value);
  const rest = value - low;
  return rest > 0.5 || (rest === 0.5 && low % 2 === 1) ? low + 1 : low;
}
