/** The view that is shown: moved by hands, going on by itself for a moment, and kept to where the scene holds. */

import type { Camera } from '../../container/scene_chunks.js';
import type { Limits } from './limits.js';
import type { Rig } from './rig.js';
import { flown, orbited, panned, type View, viewOf, zoomed } from './view.js';

/** Seconds in which a view that was let go slows down to 1/e of its speed, and the speed at which it stops, rad/s. */
const INERTIA_S = 0.25;
const STOPPED = 0.02;
/** Weight of the newest motion in the speed of a drag, for each second that it took. */
const SPEED_WEIGHT_PER_S = 25;
/** A view moves no farther by itself than in so many seconds at once, however long a frame took. */
const MAX_STEP_S = 0.1;

export class ViewControl {
  keepsLimits = true;
  /** Whether a view that is let go while it moves goes on for a moment. */
  hasInertia = true;
  #view: View;
  /** Whether hands have moved the view since it was chosen; limits count only then. */
  #isMoved = false;
  #isHeld = false;
  /** The view when it was held, and whether hands had moved it before. */
  #heldFrom: [View, boolean];
  /** Radians a second to the right and up, while dragged and thereafter. */
  #speed: [number, number] = [0, 0];

  constructor(
    readonly rig: Rig,
    readonly limits: Limits | null,
    opening: Camera,
  ) {
    this.#view = viewOf(rig, opening);
    this.#heldFrom = [this.#view, false];
  }

  get view(): View {
    return this.#view;
  }

  /** Go to a view at once. */
  lookFrom(view: View): void {
    this.#view = view;
    this.#isMoved = false;
    this.#heldFrom = [view, false];
    this.#speed = [0, 0];
  }

  /** Begin to drag: what still moves stops. */
  hold(): void {
    this.#isHeld = true;
    this.#heldFrom = [this.#view, this.#isMoved];
    this.#speed = [0, 0];
  }

  /** Take back the drag so far. */
  restore(): void {
    [this.#view, this.#isMoved] = this.#heldFrom;
    this.#speed = [0, 0];
  }

  /** Let go. */
  release(): void {
    this.#isHeld = false;
    if (!this.hasInertia) this.#speed = [0, 0];
  }

  /** Orbit by two angles in radians, which took some seconds of a drag. */
  orbit(right: number, up: number, seconds: number): void {
    this.#moveTo(orbited(this.#view, right, up));
    const [weight, dt] = [Math.min(1, SPEED_WEIGHT_PER_S * seconds), Math.max(seconds, 1e-3)];
    const [x, y] = this.#speed;
    this.#speed = [x + weight * (right / dt - x), y + weight * (up / dt - y)];
  }

  /** Drag what is looked at, in heights of the picture. */
  pan(right: number, up: number): void {
    this.#moveTo(panned(this.#view, right, up));
    this.#speed = [0, 0];
  }

  /** Move closer, in notches of the wheel. */
  zoom(notches: number): void {
    this.#moveTo(zoomed(this.#view, notches));
  }

  /** Move along the camera's axes, world units. */
  fly(right: number, up: number, forward: number): void {
    this.#moveTo(flown(this.#view, right, up, forward));
  }

  /** Have limits count from now on, or not. */
  toggleLimits(): void {
    this.keepsLimits = !this.keepsLimits;
    this.#isMoved = true;
  }

  /** Slow down a drag that pauses, go on after one, and come back into the limits; return whether the view moved. */
  advance(seconds: number): boolean {
    const before = this.#view;
    const step = Math.min(seconds, MAX_STEP_S);
    const [x, y] = this.#speed;
    if (Math.hypot(x, y) > STOPPED) {
      if (!this.#isHeld) this.#view = orbited(this.#view, x * step, y * step);
      const left = Math.exp(-step / (this.#isHeld ? INERTIA_S / 4 : INERTIA_S));
      this.#speed = [x * left, y * left];
    } else if (!this.#isHeld) {
      this.#speed = [0, 0];
    }
    if (this.limits && this.keepsLimits && this.#isMoved) this.#view = this.limits.kept(this.#view, step);
    return this.#view !== before;
  }

  #moveTo(view: View): void {
    this.#view = view;
    this.#isMoved = true;
  }
}
