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
  /**
   * While the clip plays and the camera rests, only blocks of pixels are marched again whose sample pixel differs from
   * the picture before by more than this, of the full range; 0: all pixels are.
   */
  tolerance: number;
}

/** Pixels of a block across, as in follow.glsl. */
export const BLOCK = 4;

const TERMINATION = 1 / 1024;
const TOLERANCE = 5 / 255;

/** From the fastest to the exact one. */
export const LEVELS = {
  fastest: { folded: true, step: 2, termination: 1 / 16, resolution: 0.5, raysAcross: 1, tolerance: TOLERANCE },
  faster: { folded: true, step: 1, termination: 1 / 16, resolution: 0.5, raysAcross: 1, tolerance: TOLERANCE },
  fast: { folded: true, step: 1, termination: 1 / 16, resolution: 0.75, raysAcross: 1, tolerance: TOLERANCE },
  balanced: { folded: true, step: 1, termination: 1 / 32, resolution: 1, raysAcross: 4, tolerance: TOLERANCE },
  fine: { folded: true, step: 1, termination: 1 / 64, resolution: 1, raysAcross: 4, tolerance: 0 },
  finer: { folded: true, step: 1, termination: TERMINATION, resolution: 1, raysAcross: 4, tolerance: 0 },
  reference: { folded: false, step: 1, termination: TERMINATION, resolution: 1, raysAcross: 1, tolerance: 0 },
} as const satisfies Record<string, Quality>;

export type Level = keyof typeof LEVELS;
export const LEVEL_NAMES = Object.keys(LEVELS) as Level[];
/** Those whose pictures follow one another. */
export const FOLLOWING_LEVELS = LEVEL_NAMES.filter((level) => LEVELS[level].tolerance > 0);
