/** A clip in a headset (WebXR): a picture for each eye, and controllers that move the scene. */

import { pinholeOf } from '../../render/camera.js';
import type { Frame } from '../../render/renderer.js';
import type { Vector } from '../camera/vector.js';
import type { View } from '../camera/view.js';
import { moved, type Placement, placedAround, poseInScene, turned } from './placement.js';

const MODE = 'immersive-vr';
/** Frames a second of headsets that do not say theirs. */
const USUAL_FPS = 72;
/** What a thumbstick does when pushed all the way, radians and metres a second; a small share of it is nothing. */
const [TURN_SPEED, MOVE_SPEED, REST] = [1.5, 1, 0.15];
/** Seconds for which a thumbstick moves the scene in one frame at most, so that nothing leaps after a late frame. */
const LONGEST_STEP = 0.1;
/** The button of the grip in the standard layout of controllers. */
const GRIP = 1;

export interface HeadsetHost {
  gl: WebGL2RenderingContext;
  /** From where to look at the beginning. */
  view: View;
  metresPerUnit: number | undefined;
  /** Called with the frames a second that pictures should hold. */
  holds(fps: number): void;
  /** Let some seconds pass. */
  advance(seconds: number): void;
  draw(frames: readonly Frame[]): void;
  /** The trigger of a controller was pulled. */
  selected(): void;
  left(): void;
}

/** Whether there is a headset that the page may use. */
export async function isHeadsetThere(): Promise<boolean> {
  try {
    return (await navigator.xr?.isSessionSupported(MODE)) ?? false;
  } catch {
    return false; // the page's policy forbids it
  }
}

export class Headset {
  #placement: Placement | null = null;
  #lastFrame = 0;
  /** Where the controllers are that hold the scene. */
  readonly #held = new Map<XRInputSource, Vector>();

  private constructor(
    readonly host: HeadsetHost,
    readonly session: XRSession,
    readonly layer: XRWebGLLayer,
    readonly space: XRReferenceSpace,
  ) {
    session.addEventListener('select', () => host.selected());
    session.addEventListener('end', () => host.left());
    host.holds(session.frameRate ?? USUAL_FPS);
    session.requestAnimationFrame(this.#frame);
  }

  /** Show a clip in the headset; called when a button has been pressed, or browsers refuse. */
  static async enter(host: HeadsetHost): Promise<Headset> {
    const xr = navigator.xr as XRSystem;
    const session = await xr.requestSession(MODE);
    try {
      await host.gl.makeXRCompatible();
      const layer = new XRWebGLLayer(session, host.gl, {
        antialias: false,
        depth: false,
        stencil: false,
        alpha: false,
      });
      await session.updateRenderState({ baseLayer: layer });
      return new Headset(host, session, layer, await session.requestReferenceSpace('local'));
    } catch (error) {
      await session.end().catch(() => {});
      throw error;
    }
  }

  leave(): void {
    this.session.end().catch(() => {}); // it has ended by itself
  }

  readonly #frame = (now: number, frame: XRFrame): void => {
    const { session, host } = this;
    session.requestAnimationFrame(this.#frame);
    const seconds = this.#lastFrame === 0 ? 0 : (now - this.#lastFrame) / 1000;
    this.#lastFrame = now;
    host.advance(seconds);
    const viewer = frame.getViewerPose(this.space);
    if (!viewer) return; // it is not on a head
    const before = this.#placement ?? placedAround(viewer.transform.matrix, host.view, host.metresPerUnit);
    const placement = this.#moved(before, viewer.transform.matrix, frame, Math.min(seconds, LONGEST_STEP));
    this.#placement = placement;
    const frames = viewer.views.map((view) => this.#eye(placement, view));
    host.draw(frames.filter((eye) => eye !== null));
  };

  /** Return what to draw for an eye. */
  #eye(placement: Placement, view: XRView): Frame | null {
    const viewport = this.layer.getViewport(view);
    if (!viewport || viewport.width === 0) return null;
    const { x, y, width, height } = viewport;
    const pose = poseInScene(placement, view.transform.matrix);
    return {
      camera: { width, height, ...pinholeOf(view.projectionMatrix, width, height), pose },
      screen: { framebuffer: this.layer.framebuffer, x, y, width, height },
      projection: null,
    };
  }

  /** Return where the scene is after what the controllers did. */
  #moved(placement: Placement, viewer: ArrayLike<number>, frame: XRFrame, seconds: number): Placement {
    let now = placement;
    const heading = Math.atan2(viewer[8], viewer[10]);
    for (const source of this.session.inputSources) {
      const { axes, buttons } = source.gamepad ?? { axes: [], buttons: [] };
      const [x, y] = (axes.length >= 4 ? axes.slice(2) : axes).map((axis) => (Math.abs(axis) > REST ? axis : 0));
      if (x) now = turned(now, [viewer[12], viewer[13], viewer[14]], x * TURN_SPEED * seconds);
      const way = (y ?? 0) * MOVE_SPEED * seconds;
      if (way) now = moved(now, [-Math.sin(heading) * way, 0, -Math.cos(heading) * way]);
      now = this.#dragged(now, source, buttons[GRIP]?.pressed ?? false, frame);
    }
    return now;
  }

  /** Return where the scene is that moves with a controller whose grip is pressed. */
  #dragged(placement: Placement, source: XRInputSource, isPressed: boolean, frame: XRFrame): Placement {
    const place = isPressed && source.gripSpace && frame.getPose(source.gripSpace, this.space)?.transform.position;
    const before = this.#held.get(source);
    if (!place) {
      this.#held.delete(source);
      return placement;
    }
    this.#held.set(source, [place.x, place.y, place.z]);
    return before ? moved(placement, [place.x - before[0], place.y - before[1], place.z - before[2]]) : placement;
  }
}
