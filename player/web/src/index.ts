/** What the package exports; importing it makes `<kpc-player>` known. */

import { define } from './element/kpc-player.js';

export type { Entry } from './container/chunk.js';
export { Container, type Header } from './container/container.js';
export { BudgetError, type ErrorCode, FormatError, KpcError } from './container/errors.js';
export { Groups } from './container/groups.js';
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
export { PRE_ROLL, packetSamples, SAMPLE_RATE, type Sound, type SoundSegment } from './container/sound.js';
export { type Part, type Span, Timeline } from './container/timeline.js';
export { Core, type SegmentSymbols } from './decoder/core.js';
export { loadCore } from './decoder/module.js';
export { DecoderPool, type PoolOptions } from './decoder/pool.js';
export { appearanceOf, ClipScenes } from './element/clip_scenes.js';
export { Clock, type ClockEvent } from './element/clock.js';
export { KpcPlayer } from './element/kpc-player.js';

export type { PlayerError, PlayerErrorCode } from './element/messages.js';
export type { PlayerRanges } from './element/ranges.js';
export { pinholeOf } from './render/camera.js';
export { RenderError } from './render/context.js';
export type { DrawnScene } from './render/drawn_scene.js';
export type { Projection } from './render/merging.js';
export type { Moment, ShownPart } from './render/picture_job.js';
export { LEVEL_NAMES, type Level } from './render/quality.js';
export { type DrawnPicture, type DrawOptions, type Frame, Renderer, type RendererOptions } from './render/renderer.js';
export { Clip, type ClipOptions, type ClipPosition, SceneEvent, type ScenePart } from './streaming/clip.js';
export type { SceneStream } from './streaming/scene_stream.js';
export type { TexelRows } from './streaming/texel_queue.js';

define();
