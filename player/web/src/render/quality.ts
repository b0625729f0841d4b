/** The quality levels: those of kpc.player.quality, as far as shaders draw; a test holds both tables equal. */

export interface Quality {
  /** Whether time rows are multiplied into the planes once a frame, else at every sample. */
  folded: boolean;
  /** Distance between samples, in steps of the scene. */
  step: number;
  /** A ray ends once its transmittance is below this. */
  termination: number;
  /** Side of the raster that is marched over that of the picture. */
  resolution: number;
  /** Rays across a pixel, at most: as many as it spans texels of the finest scale. */
  raysAcross: number;
}

const TERMINATION = 1 / 1024;

/** From the fastest to the exact one. */
export const LEVELS = {
  fastest: { folded: true, step: 2, termination: 1 / 16, resolution: 0.5, raysAcross: 1 },
  faster: { folded: true, step: 1, termination: 1 / 16, resolution: 0.5, raysAcross: 1 },
  fast: { folded: true, step: 1, termination: 1 / 16, resolution: 0.75, raysAcross: 1 },
  balanced: { folded: true, step: 1, termination: 1 / 32, resolution: 1, raysAcross: 4 },
  fine: { folded: true, step: 1, termination: 1 / 64, resolution: 1, raysAcross: 4 },
  finer: { folded: true, step: 1, termination: TERMINATION, resolution: 1, raysAcross: 4 },
  reference: { folded: false, step: 1, termination: TERMINATION, resolution: 1, raysAcross: 1 },
} as const satisfies Record<string, Quality>;

export type Level = keyof typeof LEVELS;
export const LEVEL_NAMES = Object.keys(LEVELS) as Level[];
