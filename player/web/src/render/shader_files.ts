/** The shader files of the desktop player, as text. */

import average from '../../../gl/glsl/average.glsl';
import changes from '../../../gl/glsl/changes.glsl';
import cubic from '../../../gl/glsl/cubic.glsl';
import decoder from '../../../gl/glsl/decoder.glsl';
import enlarge from '../../../gl/glsl/enlarge.glsl';
import fold from '../../../gl/glsl/fold.glsl';
import follow from '../../../gl/glsl/follow.glsl';
import fullscreen from '../../../gl/glsl/fullscreen.glsl';
import limits from '../../../gl/glsl/limits.glsl';
import march from '../../../gl/glsl/march.glsl';
import merge from '../../../gl/glsl/merge.glsl';
import motion from '../../../gl/glsl/motion.glsl';
import occupancy from '../../../gl/glsl/occupancy.glsl';
import planes from '../../../gl/glsl/planes.glsl';
import present from '../../../gl/glsl/present.glsl';
import ray from '../../../gl/glsl/ray.glsl';
import space from '../../../gl/glsl/space.glsl';
import upsamplePlane from '../../../gl/glsl/upsample_plane.glsl';

export const SHADER_FILES: Readonly<Record<string, string>> = {
  'average.glsl': average,
  'changes.glsl': changes,
  'cubic.glsl': cubic,
  'decoder.glsl': decoder,
  'enlarge.glsl': enlarge,
  'fold.glsl': fold,
  'follow.glsl': follow,
  'fullscreen.glsl': fullscreen,
  'limits.glsl': limits,
  'march.glsl': march,
  'merge.glsl': merge,
  'motion.glsl': motion,
  'occupancy.glsl': occupancy,
  'planes.glsl': planes,
  'present.glsl': present,
  'ray.glsl': ray,
  'space.glsl': space,
  'upsample_plane.glsl': upsamplePlane,
};
