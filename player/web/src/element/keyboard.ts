/** What keys do; docs/web.md and the list in the player are made from the same table. */

import type { Commands } from './commands.js';

export interface KeyBinding {
  /** The keys, as people read them on a US keyboard. */
  keys: string;
  help: string;
  /** Whether it moves the view, so that it does nothing where hands may not. */
  movesView?: boolean;
  /** By the value of `KeyboardEvent.key`, letters small; empty for what `Input` handles while it is held. */
  actions: Readonly<Record<string, (commands: Commands) => void>>;
}

export const KEY_BINDINGS: readonly KeyBinding[] = [
  { keys: 'Drag', help: 'orbit around the scene', movesView: true, actions: {} },
  { keys: 'Right drag, Shift+drag', help: 'pan', movesView: true, actions: {} },
  { keys: 'Wheel', help: 'zoom', movesView: true, actions: {} },
  { keys: 'W A S D, Q E', help: 'fly; four times as fast with Shift', movesView: true, actions: {} },
  { keys: 'Space', help: 'play or pause', actions: { ' ': (do_) => do_.playOrPause() } },
  {
    keys: 'Left, Right',
    help: 'one frame back or forward',
    actions: { ArrowLeft: (do_) => do_.step(-1), ArrowRight: (do_) => do_.step(1) },
  },
  {
    keys: 'Home, End',
    help: 'go to the start or the end',
    actions: { Home: (do_) => do_.seek(0), End: (do_) => do_.seek(Infinity) },
  },
  {
    keys: '[  ]',
    help: 'play slower or faster',
    actions: {
      '[': (do_) => do_.changeSpeed(-1),
      ',': (do_) => do_.changeSpeed(-1),
      ']': (do_) => do_.changeSpeed(1),
      '.': (do_) => do_.changeSpeed(1),
    },
  },
  { keys: 'L', help: 'loop on or off', actions: { l: (do_) => do_.toggleLoop() } },
  { keys: 'M', help: 'sound off or on', actions: { m: (do_) => do_.toggleSound() } },
  {
    keys: 'R',
    help: 'back to the view that the file opens with',
    movesView: true,
    actions: { r: (do_) => do_.toOpening() },
  },
  { keys: 'N', help: 'next camera of the scene', movesView: true, actions: { n: (do_) => do_.nextCamera() } },
  { keys: 'B', help: 'next viewpoint', movesView: true, actions: { b: (do_) => do_.nextPreset() } },
  {
    keys: 'X',
    help: 'leave or keep the limits from where the scene holds',
    movesView: true,
    actions: { x: (do_) => do_.toggleLimits() },
  },
  { keys: 'V', help: 'next appearance, if the scene has several', actions: { v: (do_) => do_.nextAppearance() } },
  { keys: 'C', help: 'show everything, the static part, the dynamic part', actions: { c: (do_) => do_.nextPart() } },
  {
    keys: '-  =',
    help: 'lower or higher quality',
    actions: {
      '-': (do_) => do_.changeQuality(-1),
      '=': (do_) => do_.changeQuality(1),
      '+': (do_) => do_.changeQuality(1),
    },
  },
  { keys: 'U', help: 'keep the frame rate, or keep the quality', actions: { u: (do_) => do_.toggleAuto() } },
  { keys: 'P', help: 'save a picture', actions: { p: (do_) => do_.savePicture() } },
  { keys: 'K', help: 'copy a link to this view at this time', actions: { k: (do_) => do_.copyLink() } },
  { keys: 'F', help: 'fill the screen, or leave it', actions: { f: (do_) => do_.toggleFullscreen() } },
  { keys: 'H', help: 'show this list', actions: { h: (do_) => do_.toggleHelp() } },
];

const actionsOf = (bindings: readonly KeyBinding[]): KeyBinding['actions'] =>
  Object.assign({}, ...bindings.map(({ actions }) => actions));
const ACTIONS = actionsOf(KEY_BINDINGS);
const WITHOUT_VIEW = actionsOf(KEY_BINDINGS.filter(({ movesView }) => !movesView));

/** Flying: right, up and forward, by place on a US keyboard. */
const FLYING: Readonly<Record<string, readonly [number, number, number]>> = {
  a: [-1, 0, 0],
  d: [1, 0, 0],
  q: [0, -1, 0],
  e: [0, 1, 0],
  s: [0, 0, -1],
  w: [0, 0, 1],
};

/** What of a KeyboardEvent counts. */
export interface KeyPress {
  key: string;
  code: string;
}

/**
 * Return what a key does; null if nothing, as those that move the view if hands may not. Keys without Latin letters go
 * by their place.
 */
export function actionOf({ key, code }: KeyPress, isMovable = true): ((commands: Commands) => void) | null {
  const actions = isMovable ? ACTIONS : WITHOUT_VIEW;
  const letter = /^[^\u0000-\u024f]$/u.test(key) ? letterOf(code) : key.length === 1 ? key.toLowerCase() : key;
  return Object.hasOwn(actions, letter) ? actions[letter] : null;
}

/**
 * Return where a key flies to; null if it does not. It goes by its place, or by its letter where that has a shortcut.
 */
export function flightOf(press: KeyPress): readonly [number, number, number] | null {
  if (actionOf(press) !== null) return null;
  return FLYING[letterOf(press.code)] ?? FLYING[press.key.toLowerCase()] ?? null;
}

const letterOf = (code: string): string => (code.startsWith('Key') ? code.slice(3).toLowerCase() : '');
