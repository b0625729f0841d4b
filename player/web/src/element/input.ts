/** Mouse, touch, trackpad, wheel and keys: they move the view, or are commands. */

import { notchesOf } from './camera/view.js';
import type { ViewControl } from './camera/view_control.js';
import type { Commands } from './commands.js';
import { actionOf, flightOf } from './keyboard.js';

/** Seconds in which flying crosses the longest edge of the scene's box, and how much faster it is with Shift. */
const [CROSSING_S, SHIFT_FACTOR] = [4, 4];
/** Flying goes no farther than in so many seconds at once, however long a frame took. */
const MAX_FLY_S = 0.1;
/** A press that is shorter than this and moves less is a click. */
const [CLICK_MS, CLICK_PIXELS] = [400, 6];
/** Wheel units of a notch, by `WheelEvent.deltaMode`, and of a pinch on a trackpad to grow e-fold. */
const NOTCH = [100, 3, 1];
const PINCH = 100;

export interface InputOptions {
  /** What is shown; null before a scene is there. */
  view(): ViewControl | null;
  /** Longest edge of the scene's box. */
  extent(): number;
  /** Whether hands may move the view. */
  isEnabled(): boolean;
  /** Whether keys that do not move the view are heard. */
  hearsKeys(): boolean;
  /** Whether the wheel belongs to the player, not to the page. */
  takesWheel(): boolean;
  /** Something has changed that is to be drawn. */
  moved(): void;
  /** A click that was no drag. */
  clicked(event: PointerEvent): void;
  commands: Commands;
}

interface Pointer {
  x: number;
  y: number;
  at: number;
}

/** Keys that scroll a list that has the focus. */
const SCROLLING = ['Home', 'End', 'PageUp', 'PageDown', 'ArrowUp', 'ArrowDown', ' '];

export class Input {
  readonly #stage: HTMLElement;
  readonly #options: InputOptions;
  readonly #pointers = new Map<number, Pointer>();
  readonly #flying = new Map<string, readonly [number, number, number]>();
  #pressed: Pointer | null = null; // where a press began that may still be a click
  #isFast = false;

  /** @param root where keys are heard; @param stage where the pointer is. */
  constructor(root: HTMLElement, stage: HTMLElement, options: InputOptions) {
    this.#stage = stage;
    this.#options = options;
    stage.addEventListener('pointerdown', this.#down);
    stage.addEventListener('pointermove', this.#move);
    for (const type of ['pointerup', 'pointercancel'] as const) stage.addEventListener(type, this.#up);
    stage.addEventListener('contextmenu', (event) => {
      if (options.isEnabled()) event.preventDefault();
    });
    stage.addEventListener('wheel', this.#wheel, { passive: false });
    // Two fingers are for the scene, whatever the page does with one.
    stage.addEventListener(
      'touchmove',
      (event) => {
        if (event.touches.length > 1 && options.isEnabled() && event.cancelable) event.preventDefault();
      },
      { passive: false },
    );
    root.addEventListener('keydown', this.#key);
    root.addEventListener('keyup', ({ code, shiftKey }) => {
      this.#flying.delete(code);
      this.#isFast = shiftKey;
    });
    root.addEventListener('focusout', () => this.#flying.clear());
  }

  /** Whether the pointer or a key holds the view at present. */
  get isActive(): boolean {
    return this.#pointers.size > 0 || this.#flying.size > 0;
  }

  /** Fly while keys are held. */
  advance(seconds: number): void {
    const view = this.#options.view();
    if (view === null || this.#flying.size === 0) return;
    const [right, up, forward] = [0, 1, 2].map((i) => [...this.#flying.values()].reduce((sum, way) => sum + way[i], 0));
    const speed = ((this.#isFast ? SHIFT_FACTOR : 1) * this.#options.extent()) / CROSSING_S;
    const distance = speed * Math.min(seconds, MAX_FLY_S);
    view.fly(distance * right, distance * up, distance * forward);
  }

  readonly #down = (event: PointerEvent): void => {
    const pointer = { x: event.clientX, y: event.clientY, at: event.timeStamp };
    this.#pressed = this.#pointers.size === 0 && event.button === 0 ? pointer : null;
    const view = this.#options.view();
    if (!this.#options.isEnabled() || view === null) return;
    this.#pointers.set(event.pointerId, pointer);
    this.#stage.setPointerCapture(event.pointerId);
    view.hold();
  };

  readonly #move = (event: PointerEvent): void => {
    const before = this.#pointers.get(event.pointerId);
    const view = this.#options.view();
    if (before === undefined || view === null) return;
    const now = { x: event.clientX, y: event.clientY, at: event.timeStamp };
    const height = Math.max(this.#stage.clientHeight, 1);
    const [right, down] = [(now.x - before.x) / height, (now.y - before.y) / height];
    if (this.#pressed && distanceOf(now, this.#pressed) > CLICK_PIXELS) this.#pressed = null;
    if (this.#pointers.size > 1) this.#pinch(view, event.pointerId, now, right, down);
    else if (event.buttons & 6 || event.shiftKey) view.pan(right, -down);
    else if (this.#pressed === null || event.pointerType === 'mouse') {
      // Dragging over the height of the picture orbits by half a turn.
      view.orbit(Math.PI * right, -Math.PI * down, (now.at - before.at) / 1000);
    }
    this.#pointers.set(event.pointerId, now);
    this.#options.moved();
  };

  /** Move with the middle of two fingers, and closer as they part. */
  #pinch(view: ViewControl, id: number, now: Pointer, right: number, down: number): void {
    const before = this.#pointers.get(id) as Pointer;
    const [, other] = [...this.#pointers].find(([key]) => key !== id) as [number, Pointer];
    view.pan(right / 2, -down / 2);
    view.zoom(notchesOf(Math.max(distanceOf(now, other), 1) / Math.max(distanceOf(before, other), 1)));
  }

  readonly #up = (event: PointerEvent): void => {
    const view = this.#options.view();
    // A stroke that the browser takes, to scroll the page, was never the player's.
    if (this.#pointers.delete(event.pointerId) && event.type === 'pointercancel') view?.restore();
    if (this.#pointers.size === 0) view?.release();
    else view?.hold();
    const pressed = this.#pressed;
    this.#pressed = null;
    if (event.type === 'pointerup' && pressed && event.timeStamp - pressed.at < CLICK_MS) this.#options.clicked(event);
    this.#options.moved();
  };

  readonly #wheel = (event: WheelEvent): void => {
    const view = this.#options.view();
    if (view === null || !this.#options.isEnabled() || !(event.ctrlKey || this.#options.takesWheel())) return;
    event.preventDefault();
    const isPinch = event.ctrlKey && event.deltaMode === 0 && Math.abs(event.deltaY) < NOTCH[0];
    view.zoom(isPinch ? notchesOf(Math.exp(-event.deltaY / PINCH)) : -event.deltaY / NOTCH[event.deltaMode]);
    this.#options.moved();
  };

  readonly #key = (event: KeyboardEvent): void => {
    const target = event.composedPath()[0];
    if (event.ctrlKey || event.altKey || event.metaKey || event.defaultPrevented || !this.#options.hearsKeys()) return;
    if (target instanceof HTMLSelectElement || (target instanceof HTMLInputElement && target.type === 'text')) return;
    if (target instanceof HTMLElement && target.classList.contains('keys') && SCROLLING.includes(event.key)) return;
    // Space presses buttons and switches; on the timeline, where it does nothing else, it plays or pauses.
    const isPressed =
      target instanceof HTMLInputElement ? target.type !== 'range' : target instanceof HTMLButtonElement;
    if (event.key === ' ' && isPressed) return;
    this.#isFast = event.shiftKey;
    const isMovable = this.#options.isEnabled();
    const flight = isMovable ? flightOf(event) : null;
    const action = actionOf(event, isMovable);
    if (flight) this.#flying.set(event.code, flight);
    else if (action) action(this.#options.commands);
    else return;
    event.preventDefault();
    this.#options.moved();
  };
}

const distanceOf = (a: Pointer, b: Pointer): number => Math.hypot(a.x - b.x, a.y - b.y);
