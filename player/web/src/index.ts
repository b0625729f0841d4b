/** What the package exports. */

export { Container, type Entry, type Header } from './container/container.js';
export { BudgetError, FormatError } from './container/errors.js';
export { Groups, type Part, type Span } from './container/groups.js';
export type { Metadata, ViewLimits } from './container/metadata.js';
export { type PlaneSymbols, Scene, type SceneOptions } from './container/scene.js';
export type {
  Appearance,
  Camera,
  DecoderWeights,
  Mapping,
  MotionGrid,
  OccupancyGrid,
  PlaneHead,
  PlaneName,
  Scale,
  SceneHead,
} from './container/scene_chunks.js';
export { Core, type SegmentSymbols } from './decoder/core.js';
export { loadCore } from './decoder/module.js';
