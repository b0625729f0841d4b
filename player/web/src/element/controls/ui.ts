/** What the player shows around the picture: poster, bar, panels and messages. */

import type { Commands } from '../commands.js';
import { isHeadsetThere } from '../headset/headset.js';
import type { PlayerError } from '../messages.js';
import { IconButton, make, Popup } from './dom.js';
import { fillSettings, fillViews, keyList, type Model } from './panels.js';
import { SoundControls } from './sound_controls.js';
import styles from './styles.css?text';
import { clockText, Timeline } from './timeline.js';
import { Waiting } from './waiting.js';

/** Milliseconds for which messages are shown, and after which the bar of a playing clip hides. */
const [NOTICE_MS, HINT_MS, IDLE_MS] = [4000, 5000, 2500];
const NO_TITLE = '4D scene';
/** Clips shorter than this, in seconds, show tenths. */
const TENTHS_BELOW_S = 20;

/** What changes while a clip plays. */
export interface UiState {
  hasControls: boolean;
  isMovable: boolean;
  /** Whether the picture has taken the poster's place. */
  isShown: boolean;
  isWaiting: boolean;
  /** Why the picture is waited for, as far as that is known. */
  reason: string | null;
  paused: boolean;
  ended: boolean;
  time: number;
  duration: number;
  hasSound: boolean;
  /** Whether sound is on, and the browser permits it. */
  isAudible: boolean;
  /** 0 while the sound is off. */
  volume: number;
  buffered: readonly (readonly [number, number])[];
  /** Whether to offer a large button to begin with. */
  isOffered: boolean;
  isFullscreen: boolean;
  /** Whether the page leaves all touches to the player. */
  isWhole: boolean;
}

export interface UiActions {
  commands: Commands;
  seek(seconds: number): void;
  setVolume(volume: number): void;
  hold(isHeld: boolean): void;
  reload(): void;
}

export class Ui {
  readonly player: HTMLElement;
  readonly stage: HTMLElement;
  readonly #poster = make('img', { class: 'poster', part: 'poster', alt: '', hidden: true });
  readonly #waiting = new Waiting();
  readonly #large: IconButton;
  readonly #error = make('div', { class: 'error', role: 'alert', hidden: true });
  readonly #notice = make('div', { class: 'notice', role: 'status' });
  readonly #hint = make('div', { class: 'hint', 'aria-hidden': 'true' }, 'Drag to look around');
  readonly #bar: HTMLElement;
  readonly #play: IconButton;
  readonly #fill: IconButton;
  readonly #time = make('span', { class: 'time' });
  readonly #timeline: Timeline;
  readonly #sound: SoundControls;
  readonly #popups: readonly Popup[];
  readonly #keys = make('div', {
    class: 'panel keys',
    role: 'dialog',
    'aria-label': 'Keys',
    hidden: true,
    tabindex: -1,
  });
  readonly #actions: UiActions;
  #noticeTimer = 0;
  #hintTimer = 0;
  #idleTimer = 0;
  /** Makes the settings show how they are now. */
  #followSettings = (): void => {};
  #isPlaying = false;
  #isMovable = false;
  #title = NO_TITLE;

  constructor(root: ShadowRoot, model: Model, actions: UiActions) {
    const { commands } = actions;
    this.#actions = actions;
    root.adoptedStyleSheets = [sheet()];
    this.stage = make('div', { class: 'stage', part: 'stage', tabindex: 0, role: 'application' });
    this.#large = new IconButton('play', 'Play the scene', () => commands.playOrPause(), {
      class: 'large',
      hidden: true,
    });
    this.#play = new IconButton('play', 'Play', () => commands.playOrPause());
    this.#fill = new IconButton('fill', 'Fill the screen', () => commands.toggleFullscreen());
    this.#timeline = new Timeline(actions);
    this.#sound = new SoundControls(() => commands.toggleSound(), actions.setVolume);
    this.#popups = [
      new Popup('view', 'Views', (panel) => this.#opening(panel, () => fillViews(panel, model, commands))),
      new Popup('settings', 'Settings', (panel) =>
        this.#opening(panel, () => {
          this.#followSettings = fillSettings(panel, model, commands);
        }),
      ),
    ];
    const [views, settings] = this.#popups;
    const link = new IconButton('link', 'Copy link here and now', () => commands.copyLink(), {
      class: 'button secondary',
    });
    const headset = new IconButton('headset', 'Watch in the headset', () => commands.toggleHeadset(), { hidden: true });
    isHeadsetThere().then((isThere) => {
      headset.element.hidden = !isThere;
    });
    const buttons = [views.button, settings.button, link, headset, this.#fill].map(({ element }) => element);
    const space = make('span', { class: 'space' });
    this.#bar = make(
      'div',
      { class: 'bar', part: 'bar' },
      this.#timeline.element,
      make('div', { class: 'buttons' }, this.#play.element, ...this.#sound.elements, this.#time, space, ...buttons),
    );
    const cover = make('div', { class: 'cover' }, this.#waiting.element, this.#large.element, this.#error);
    const panels = [...this.#popups.map(({ panel }) => panel), this.#keys];
    this.player = make('div', { class: 'player', part: 'player' });
    this.#poster.addEventListener('error', () => {
      this.#poster.hidden = true; // or browsers show that a picture is missing
    });
    this.player.append(this.stage, this.#poster, make('div', { class: 'ring' }));
    this.player.append(this.#hint, cover, this.#notice, this.#bar, ...panels);
    root.append(this.player);
    for (const type of ['pointermove', 'pointerdown', 'keydown', 'focusin']) {
      this.player.addEventListener(type, this.#stirred);
    }
    this.player.addEventListener(
      'keydown',
      (event) => event.key === 'Escape' && this.closePanels() && event.preventDefault(),
    );
    this.stage.addEventListener('pointerdown', () => this.closePanels());
    this.player.addEventListener('focusout', ({ relatedTarget }) => {
      // A list of choices that the system shows takes the focus, too, and names nothing that has it now.
      if (relatedTarget !== null && !this.player.contains(relatedTarget as Node)) this.closePanels();
    });
  }

  setPoster(src: string): void {
    this.#poster.hidden = src === '';
    if (src !== '' && this.#poster.src !== src) this.#poster.src = src;
  }

  setTitle(title: string): void {
    this.#title = title || NO_TITLE;
  }

  /** Name the stage, and say what hands can do there. */
  #describe(hasControls: boolean): void {
    const moving = this.#isMovable ? 'Drag, or press W A S D, to look around; ' : '';
    const keys = this.#isMovable || hasControls ? `${moving}H lists all keys.` : '';
    const label = `${this.#title}. ${keys}`.trim();
    if (this.stage.ariaLabel !== label) this.stage.ariaLabel = label;
  }

  update(state: UiState): void {
    const { hasControls, isMovable, isShown, isWaiting, paused, ended, isFullscreen, isWhole } = state;
    // Of no use beside an error, over whose button it may lie; but it has the button that leaves the full screen.
    this.#bar.hidden = !hasControls || !(this.#error.hidden || isFullscreen);
    this.#isMovable = isMovable;
    this.#describe(hasControls);
    this.stage.classList.toggle('movable', isMovable && isShown);
    this.stage.classList.toggle('whole', isWhole);
    this.stage.tabIndex = isMovable || hasControls ? 0 : -1;
    this.#poster.classList.toggle('done', isShown);
    const isOffered = hasControls && state.isOffered && this.#error.hidden;
    this.#large.element.hidden = !isOffered;
    this.#waiting.update(isWaiting && !(isOffered || !this.#error.hidden), state.reason);
    this.#play.element.hidden = state.duration === 0;
    this.#time.hidden = state.duration === 0;
    if (ended) this.#play.show('replay', 'Play again');
    else this.#play.show(paused ? 'play' : 'pause', paused ? 'Play' : 'Pause');
    if (isFullscreen) this.#fill.show('leave', 'Leave the full screen');
    else this.#fill.show('fill', 'Fill the screen');
    const withTenths = state.duration < TENTHS_BELOW_S;
    const text = `${clockText(state.time, withTenths)} / ${clockText(state.duration, withTenths)}`;
    if (this.#time.textContent !== text) this.#time.textContent = text;
    this.#timeline.update(state);
    this.#sound.update(state);
    if (this.#popups[1].isOpen) this.#followSettings();
    if (this.#isPlaying === paused) {
      this.#isPlaying = !paused;
      this.#stirred();
    }
  }

  showError(error: PlayerError | null): void {
    this.#error.hidden = error === null;
    if (error === null) return;
    const again = make(
      'button',
      { type: 'button', class: 'choice', onclick: () => this.#actions.reload() },
      'Try again',
    );
    this.#error.replaceChildren(make('p', {}, error.message), again);
    this.#error.dataset.code = error.code;
  }

  /** Show a message for a while; with `isLasting`, until the next one. An empty one removes it. */
  notify(content: string | HTMLElement, isLasting = false): void {
    clearTimeout(this.#noticeTimer);
    this.#notice.replaceChildren(...(content === '' ? [] : [content]));
    if (!isLasting) this.#noticeTimer = window.setTimeout(() => this.#notice.replaceChildren(), NOTICE_MS);
  }

  /** Say once that the view can be moved. */
  hint(): void {
    this.#hint.classList.add('shown');
    this.#hintTimer = window.setTimeout(() => this.endHint(), HINT_MS);
  }

  endHint(): void {
    clearTimeout(this.#hintTimer);
    this.#hint.classList.remove('shown');
  }

  toggleKeys(): void {
    const isOpen = !this.#keys.hidden;
    this.closePanels();
    if (isOpen) return;
    const close = make('button', { type: 'button', class: 'choice wide', onclick: () => this.closePanels() }, 'Close');
    this.#keys.replaceChildren(keyList(this.#isMovable), make('div', { class: 'choices' }, close));
    this.#keys.hidden = false;
    this.#keys.focus();
  }

  /** Close what is open; return whether anything was. */
  closePanels(): boolean {
    const isOpen = !this.#keys.hidden || this.#popups.some((popup) => popup.isOpen);
    if (!this.#keys.hidden && this.#keys.matches(':focus-within')) this.stage.focus();
    this.#keys.hidden = true;
    for (const popup of this.#popups) popup.close();
    return isOpen;
  }

  /** A click on the picture plays or pauses; a touch first shows the bar of a clip that plays. */
  click({ pointerType }: PointerEvent): void {
    if (this.#bar.hidden || !this.#error.hidden) return;
    const wasIdle = this.player.classList.contains('idle');
    this.#stirred();
    if (pointerType === 'mouse' || (!wasIdle && !this.#isPlaying)) this.#actions.commands.playOrPause();
  }

  /** End all timers. */
  rest(): void {
    for (const timer of [this.#noticeTimer, this.#hintTimer, this.#idleTimer]) clearTimeout(timer);
    this.#notice.replaceChildren();
    this.#waiting.update(false, null);
    this.player.classList.remove('idle');
  }

  #opening(panel: HTMLElement, fill: () => void): void {
    this.endHint();
    this.#keys.hidden = true;
    for (const popup of this.#popups) if (popup.panel !== panel) popup.close();
    fill();
  }

  readonly #stirred = (): void => {
    clearTimeout(this.#idleTimer);
    this.player.classList.remove('idle');
    if (this.#isPlaying) this.#idleTimer = window.setTimeout(this.#idle, IDLE_MS);
  };

  readonly #idle = (): void => {
    const isUsed = this.#popups.some((popup) => popup.isOpen) || this.#bar.querySelector(':focus-visible') !== null;
    if (this.#isPlaying && !isUsed) this.player.classList.add('idle');
  };
}

let shared: CSSStyleSheet | null = null;

/** Return the style sheet, one for all players; made when the first one needs it, since node has none. */
function sheet(): CSSStyleSheet {
  if (shared === null) {
    shared = new CSSStyleSheet();
    shared.replaceSync(styles);
  }
  return shared;
}
