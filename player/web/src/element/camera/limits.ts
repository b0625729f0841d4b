/** Keeping a view within the limits from where a scene holds (section 6.8 of spec/kpc-format.md). */

import type { ViewLimits } from '../../container/metadata.js';
import { lookAt } from './rig.js';
import { across, clamp, cross, dot, length, minus, normalised, plus, scaled, type Vector, vector } from './vector.js';
import { eyeOfView, type View } from './view.js';

/** Seconds in which a view outside the limits comes back by all but 1/e of the way. */
const RETURN_S = 0.15;
/** A view that is as near as this to the limits is put on them: radians, lengths over the largest distance. */
const NEARLY = 1e-4;

type Bounds = readonly [number, number];

/** View limits with angles in radians and directions as unit vectors. */
export class Limits {
  readonly focus: Vector;
  readonly up: Vector;
  readonly forward: Vector;
  readonly side: Vector;
  readonly bounds: readonly [Bounds, Bounds, Bounds];
  readonly reach: number;

  constructor(limits: ViewLimits, up: readonly number[]) {
    const radians = ([low, high]: number[]): Bounds => [(low * Math.PI) / 180, (high * Math.PI) / 180];
    this.focus = vector(limits.focus);
    this.up = normalised(vector(up));
    this.forward = normalised(across(vector(limits.forward), this.up));
    this.side = cross(this.up, this.forward);
    const [near, far] = limits.distance;
    this.bounds = [radians(limits.azimuth), radians(limits.elevation), [near, far]];
    this.reach = limits.reach;
  }

  /**
   * Return a view that has moved towards the limits for some time; the same view if it lies within them.
   *
   * The eye moves along the sphere around the limits' focus and to or from it, the point that is looked at straight
   * towards that focus; what lies within its limits does not move.
   */
  kept(view: View, seconds: number): View {
    const offset = minus(view.focus, this.focus);
    const away = length(offset);
    const beyond = Math.max(away - this.reach, 0);
    const position = this.#positionOf(eyeOfView(view));
    const excess = position.map((x, i) => x - clamp(x, ...this.bounds[i]));
    const most = this.bounds[2][1];
    const isWithin = (times: number) =>
      beyond <= times * NEARLY * most && excess.every((x, i) => Math.abs(x) <= times * NEARLY * (i < 2 ? 1 : most));
    if (isWithin(1)) return view;
    const share = isWithin(2) ? 1 : 1 - Math.exp(-seconds / RETURN_S);
    const focus = away === 0 ? view.focus : plus(view.focus, offset, (-share * beyond) / away);
    const eye = this.#eyeAt(position.map((x, i) => x - share * excess[i]));
    return { ...view, focus, distance: length(minus(eye, focus)), axes: lookAt(eye, focus, this.up) };
  }

  /** Return azimuth, nearest to the middle of its limits, elevation and distance of a point. */
  #positionOf(eye: Vector): number[] {
    const offset = minus(eye, this.focus);
    const distance = Math.max(length(offset), 1e-12);
    const [low, high] = this.bounds[0];
    const turn = Math.atan2(dot(offset, this.side), dot(offset, this.forward)) - (low + high) / 2;
    const azimuth = (low + high) / 2 + turn - 2 * Math.PI * Math.round(turn / (2 * Math.PI));
    return [azimuth, Math.asin(clamp(dot(offset, this.up) / distance, -1, 1)), distance];
  }

  #eyeAt([azimuth, elevation, distance]: number[]): Vector {
    const level = plus(scaled(this.forward, Math.cos(azimuth)), this.side, Math.sin(azimuth));
    const towards = plus(scaled(level, Math.cos(elevation)), this.up, Math.sin(elevation));
    return plus(this.focus, towards, distance);
  }
}
