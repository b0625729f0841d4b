/** The scenes of a clip on a graphics card. */

import type { DrawnScene } from '../render/drawn_scene.js';
import type { Moment } from '../render/picture_job.js';
import type { Renderer } from '../render/renderer.js';
import type { Clip } from '../streaming/clip.js';
import type { SceneStream } from '../streaming/scene_stream.js';

export class ClipScenes {
  readonly #scenes = new Map<SceneStream, DrawnScene>();

  constructor(readonly renderer: Renderer) {}

  /** Take what has arrived of scenes that are shown or will be; return whether to go on: there was some, or may be. */
  take(clip: Clip): boolean {
    const drawn = clip.scenes.map((scene) => this.#drawn(scene));
    const before = drawn.map(({ version }) => version);
    const areAnswered = drawn.map((scene) => this.renderer.upload(scene));
    return areAnswered.includes(false) || drawn.some(({ version }, i) => version !== before[i]);
  }

  /** Return what makes the picture at a time. */
  moments(clip: Clip, time: number): Moment[] {
    return clip.parts(time).map(({ scene, time, share }) => ({ scene: this.#drawn(scene), time, share }));
  }

  /** Return a moment of each scene that is shown or will be. */
  all(clip: Clip): Moment[] {
    return clip.scenes.map((scene) => ({ scene: this.#drawn(scene), time: 0, share: 1 }));
  }

  /** Forget a scene that the clip no longer holds. */
  release(scene: SceneStream): void {
    const drawn = this.#scenes.get(scene);
    if (drawn) this.renderer.removeScene(drawn);
    this.#scenes.delete(scene);
  }

  #drawn(scene: SceneStream): DrawnScene {
    const known = this.#scenes.get(scene);
    if (known) return known;
    const drawn = this.renderer.addScene(scene);
    this.#scenes.set(scene, drawn);
    return drawn;
  }
}

/** Return the numbers of an appearance of a clip; null, which is the average, where none has the name. */
export function appearanceOf(clip: Clip, time: number, name: string): Float32Array | null {
  return clip.parts(time)[0].scene.appearances.find((appearance) => appearance.name === name)?.embedding ?? null;
}
