/** The custom element `<kpc-player>`; docs/web.md lists its attributes, properties, methods and events. */

import { string, upgrade } from './attributes.js';
import { AudibleElement } from './audible_element.js';
import { Beginning } from './beginning.js';
import { textOfView } from './camera/view.js';
import { Clock, type ClockEvent } from './clock.js';
import type { Model } from './controls/panels.js';
import { Ui } from './controls/ui.js';
import { Fullscreen } from './fullscreen.js';
import { Input } from './input.js';
import { momentOf } from './link.js';
import { CONTEXT_LOST, INCOMPLETE, type PlayerError, playerErrorOf } from './messages.js';
import { PageScroll } from './page_scroll.js';
import { PlayPromises } from './play_promises.js';
import { PlayerCommands } from './player_commands.js';
import { type PlayerRanges, rangesOf } from './ranges.js';
import { Session } from './session.js';
import { blobOrNull, cameraText, finite } from './values.js';

/** Milliseconds between two `progress` events. */
const PROGRESS_MS = 350;
const HAVE_FUTURE_DATA = 3;

const connected = new Set<KpcPlayer>();

export class KpcPlayer extends AudibleElement implements Model {
  static readonly observedAttributes = [
    ...['src', 'poster', 'controls', 'loop', 'camera', 'camera-controls', 'quality', 'target-fps', 'part'],
    ...['appearance', 'autoplay', 'muted', 'preload'],
  ];

  readonly #clock = new Clock((event) => this.#clocked(event));
  readonly #commands: PlayerCommands;
  readonly #ui: Ui;
  readonly #input: Input;
  readonly #fullscreen: Fullscreen;
  #session: Session | null = null;
  #error: PlayerError | null = null;
  #file: Blob | null = null;
  #keepsLimits = true;
  #hasPlayed = false;
  readonly #plays = new PlayPromises();
  readonly #beginning = new Beginning();
  #readyState = 0;
  #progressAt = Number.NEGATIVE_INFINITY;
  readonly #scroll = new PageScroll(this);

  constructor() {
    super();
    const root = this.attachShadow({ mode: 'open' });
    this.#commands = new PlayerCommands(this, () => this.#ui);
    this.#ui = new Ui(root, this, {
      commands: this.#commands,
      seek: (seconds) => this.#commands.seek(seconds),
      setVolume: (volume) => Object.assign(this, { muted: false, volume }),
      hold: (isHeld) => {
        this.#clock.isHeld = isHeld;
      },
      reload: () => this.#reload(),
    });
    this.#input = new Input(this.#ui.player, this.#ui.stage, {
      view: () => this.#session?.view ?? null,
      extent: () => this.#session?.extent ?? 1,
      isEnabled: () => this.cameraControls,
      hearsKeys: () => this.controls || this.cameraControls,
      takesWheel: () => this.#scroll.isNone || this.shadowRoot?.activeElement !== null,
      moved: () => {
        this.#ui.endHint();
        this.#session?.wake();
      },
      clicked: (event) => this.#ui.click(event),
      commands: this.#commands,
    });
    for (const gesture of ['click', 'keydown']) {
      this.#ui.player.addEventListener(gesture, () => this.#session?.sound?.unlock(), { capture: true });
    }
    this.#fullscreen = new Fullscreen(this, () => this.#refresh());
  }

  connectedCallback(): void {
    upgrade(this);
    connected.add(this);
    window.addEventListener('hashchange', this.#followLink);
    this.#ui.setPoster(this.poster);
    if (this.#session === null) this.#start();
    this.#refresh();
  }

  disconnectedCallback(): void {
    // An element that is moved is removed and put back at once.
    queueMicrotask(() => {
      if (this.isConnected) return;
      connected.delete(this);
      window.removeEventListener('hashchange', this.#followLink);
      const view = this.#session?.view;
      if (view) {
        this.#beginning.leave(this.#clock.time, textOfView(view.view), !this.#clock.paused);
      }
      this.#stop();
    });
  }

  attributeChangedCallback(name: string, before: string | null, value: string | null): void {
    if (before === value) return;
    if (name === 'src') this.#begin();
    if (name === 'poster') this.#ui.setPoster(this.poster);
    if (name === 'loop') this.#clock.loop = this.loop;
    if (name === 'camera' && (value !== null || this.#session?.view)) this.camera = value ?? 'opening';
    if (name === 'target-fps' && this.#session) this.#session.fps = this.targetFps || undefined;
    if (name === 'muted' && connected.has(this)) this.loudnessChanged();
    if (name === 'preload' && connected.has(this)) {
      if (this.#session === null) this.#start();
      else if (this.preload === 'auto') this.#fetch();
    }
    if (name === 'autoplay' && this.autoplay && this.#session?.clip) this.#playByItself();
    this.#refresh();
  }

  /** Give the keyboard to the player, whose keys act on its picture. */
  override focus(options?: FocusOptions): void {
    this.#ui.stage.focus(options);
  }

  // --- playing

  /** A file that the page has, in place of `src`. */
  get srcObject(): Blob | null {
    return this.#file;
  }

  set srcObject(file: Blob | null) {
    this.#file = blobOrNull(file, 'srcObject');
    this.#begin();
  }

  get currentTime(): number {
    return this.#session?.clip ? this.#clock.time : (this.#beginning.known ?? 0);
  }

  set currentTime(value: number) {
    const seconds = finite(value, 'currentTime');
    if (this.#session?.clip) {
      this.#clock.seek(seconds);
      this.#fetch();
    } else {
      this.#beginning.time = Math.max(seconds, 0);
    }
  }

  get duration(): number {
    return this.#session?.clip?.duration ?? Number.NaN;
  }

  get paused(): boolean {
    return this.#clock.paused;
  }

  get ended(): boolean {
    return this.#clock.ended;
  }

  get seeking(): boolean {
    return this.#clock.isSeeking;
  }

  get playbackRate(): number {
    return this.#clock.rate;
  }

  set playbackRate(rate: number) {
    this.#clock.rate = rate;
  }

  get hasSound(): boolean {
    return this.#session?.sound?.isThere ?? false;
  }

  /** Whether sound is on, and the browser permits it. */
  get isAudible(): boolean {
    return this.loudness > 0 && !this.#session?.sound?.isBlocked;
  }

  get buffered(): PlayerRanges {
    return rangesOf(this.#session?.clip?.buffered ?? []);
  }

  get readyState(): number {
    return this.#session?.readyState ?? 0;
  }

  get error(): PlayerError | null {
    return this.#error;
  }

  /** Play; resolves when the clip moves, or at once if nothing in it does. */
  play(): Promise<void> {
    if (this.#error) return Promise.reject(new DOMException(this.#error.message, 'NotSupportedError'));
    const promise = this.#plays.add();
    this.#hasPlayed = true;
    this.#clock.play();
    this.#session?.sound?.unlock();
    if (this.#session === null && this.isConnected) this.#start(true);
    this.#fetch();
    if (this.duration === 0) this.#clock.pause();
    else if (!this.#clock.isWaiting) this.#plays.settle();
    return promise;
  }

  pause(): void {
    this.#clock.pause();
    this.#session?.wake();
  }

  /** Begin anew, with whatever `src` names now. */
  load(): void {
    this.#begin(true);
  }

  /** Pause, and go some frames forward. */
  step(frames: number): void {
    this.#clock.step(frames);
    this.#fetch();
  }

  // --- looking

  /** From where to look: the eye, the point looked at, and the vertical angle of view in degrees. */
  get camera(): string {
    const view = this.#session?.view;
    return view ? textOfView(view.view) : (this.#beginning.view ?? string(this, 'camera'));
  }

  /** A name of `presets` or `cameras`, "opening", or six or seven numbers, as text or an array. */
  set camera(value: string | readonly number[] | null | undefined) {
    const text = cameraText(value);
    const session = this.#session;
    if (!session?.view) {
      this.#beginning.view = text;
      return;
    }
    const view = session.viewOf(text);
    if (view === null) console.warn(`kpc-player: there is no camera "${text}"`);
    else session.view.lookFrom(view);
    session.wake();
  }

  get presets(): readonly string[] {
    return [...(this.#session?.presets.keys() ?? [])];
  }

  get cameras(): readonly string[] {
    return this.#session?.cameraNames ?? [];
  }

  get appearances(): readonly string[] {
    return (this.#session?.clip?.scenes[0].appearances ?? []).map(({ name }) => name);
  }

  get isDynamic(): boolean {
    return this.#session?.isDynamic ?? false;
  }

  get hasLimits(): boolean {
    return Boolean(this.#session?.view?.limits);
  }

  /** Whether the view comes back to where the scene holds, if the file says where. */
  get keepsLimits(): boolean {
    return this.#keepsLimits;
  }

  set keepsLimits(value: boolean) {
    this.#keepsLimits = Boolean(value);
    const view = this.#session?.view;
    if (view && view.keepsLimits !== this.#keepsLimits) view.toggleLimits();
    this.#session?.wake();
  }

  /** What the file says of itself; an empty object before it is there. */
  get metadata(): Readonly<Record<string, unknown>> {
    return this.#session?.clip?.metadata ?? {};
  }

  /** Return what is shown as a picture file; a paused picture is drawn as finely as it will be first. */
  async toBlob(type = 'image/png', quality?: number): Promise<Blob> {
    if (!this.#session) throw new DOMException('there is no picture yet', 'InvalidStateError');
    return this.#session.toBlob(type, quality);
  }

  override requestFullscreen(options?: FullscreenOptions): Promise<void> {
    return this.#fullscreen.request(() => super.requestFullscreen(options));
  }

  /** Show the clip in a headset, or leave it; called when something has been pressed, or browsers refuse. */
  async toggleHeadset(): Promise<void> {
    if (!this.#session) throw new Error('there is no scene');
    await this.#session.toggleHeadset(() => this.#commands.playOrPause());
  }

  toggleFullscreen(): void {
    this.#fullscreen.toggle();
  }

  // --- inside

  /** Forget what was shown, and open what `src` names now; with preload="none" only if `isAsked`. */
  #begin(isAsked = false): void {
    this.#beginning.forget();
    if (!connected.has(this)) return;
    this.#stop();
    this.#hasPlayed = false;
    this.#start(isAsked);
    this.#refresh();
  }

  /** Open what `src` names; with preload="none" only if `isAsked`. */
  #start(isAsked = false): void {
    const src = this.#file ?? this.src;
    if ((src === '' && !this.hasAttribute('src')) || !this.isConnected) return;
    const mayPlay = this.autoplay && !isReducedMotion();
    if (this.preload === 'none' && !mayPlay && !isAsked) return;
    this.#clock.loop = this.loop;
    const session = new Session(
      {
        ...{ src, memory: this.memory, fps: this.targetFps || undefined, clock: this.#clock, stage: this.#ui.stage },
        workerUrl: this.getAttribute('worker-url'),
        hasPoster: () => this.poster !== '',
        volume: () => this.loudness,
        shown: () => ({ level: this.quality, part: this.shownPart, appearance: this.appearance }),
      },
      this.#input,
      {
        opened: () => this.#opened(),
        shown: () => this.#shown(),
        progress: () => this.#progressed(),
        viewChanged: () => this.#emit('camera-change'),
        lost: (isLost) => this.#ui.notify(isLost ? CONTEXT_LOST : '', isLost),
        incomplete: () => this.#ui.notify(INCOMPLETE, true),
        notified: (message) => this.#ui.notify(message),
        failed: (error) => this.#failed(error),
        frame: () => this.#refresh(),
      },
    );
    session.fetches = this.preload !== 'metadata' || mayPlay || !this.#clock.paused;
    this.#session = session;
    // Listeners that are added after the element get it, too.
    queueMicrotask(() => this.#session === session && this.#emit('loadstart'));
    session.open();
  }

  /** End whatever goes on; nothing is left but the element itself. */
  #stop(): void {
    this.#session?.close();
    this.#session = null;
    this.#error = null;
    this.#readyState = 0;
    this.#plays.settle(new DOMException('loading was ended', 'AbortError'));
    this.#clock.reset();
    this.#ui.rest();
    this.#ui.showError(null);
  }

  #reload(): void {
    const hasPlayed = this.#hasPlayed;
    this.load();
    this.#hasPlayed = hasPlayed;
  }

  #opened(): void {
    const { clip, view } = this.#session as Session;
    if (clip === null || view === null) return;
    view.hasInertia = !isReducedMotion();
    if (!this.#keepsLimits) view.toggleLimits();
    const { duration, frameCount, metadata } = clip;
    Object.assign(this.#clock, { duration, frameCount });
    const from = this.#beginning.take(this.src, momentOf(location.hash, this.id, this.#isFirst));
    this.#clock.begin(from.time ?? (metadata.opening?.time ?? 0) * duration);
    const text = from.camera ?? string(this, 'camera');
    if (text !== '') this.camera = text;
    this.#ui.setTitle(typeof metadata.title === 'string' ? metadata.title : '');
    this.#emit('durationchange');
    this.#emit('loadedmetadata');
    if (this.autoplay && from.wasPlaying !== false) this.#playByItself();
    if (duration === 0 && !this.#clock.paused) this.#clock.pause();
    this.#refresh();
  }

  #playByItself(): void {
    if (!isReducedMotion()) this.play().catch(() => {});
  }

  #shown(): void {
    this.#emit('loadeddata');
    if (this.cameraControls && this.controls && !isReducedMotion()) this.#ui.hint();
  }

  #progressed(): void {
    const now = performance.now();
    if (now - this.#progressAt < PROGRESS_MS && !this.#session?.clip?.isSettled) return;
    this.#progressAt = now;
    this.#emit('progress');
  }

  #failed(thrown: unknown): void {
    const error = playerErrorOf(thrown, this.src, location.origin);
    if (error.code === 'aborted') return;
    this.#error = error;
    this.#clock.pause();
    this.#plays.settle(new DOMException(error.message, 'NotSupportedError'));
    this.#ui.showError(error);
    console.error(`kpc-player: ${error.detail}`);
    this.#refresh();
    this.#emit('error');
  }

  #clocked(event: ClockEvent): void {
    if (event === 'seeking') this.#session?.seek();
    if (event === 'playing') this.#plays.settle();
    if (event === 'pause')
      this.#plays.settle(this.duration === 0 ? undefined : new DOMException('paused', 'AbortError'));
    this.#emit(event);
    if (event === 'ratechange') this.#refresh();
  }

  protected override loudnessChanged(): void {
    this.#session?.sound?.unlock();
    this.#session?.wake();
    this.#emit('volumechange');
  }

  /** Fetch what the playhead needs from now on, whatever `preload` says. */
  #fetch(): void {
    if (!this.#session) return;
    this.#session.fetches = true;
    this.#session.wake();
  }

  get #isFirst(): boolean {
    return connected.values().next().value === this;
  }

  readonly #followLink = (): void => {
    const moment = momentOf(location.hash, this.id, this.#isFirst);
    if (moment?.time != null) this.currentTime = moment.time;
    if (moment?.camera != null) this.camera = moment.camera;
  };

  /** Show the present state around the picture, and say what has changed. */
  #refresh(): void {
    const session = this.#session;
    const clock = this.#clock;
    const isFullscreen = this.#fullscreen.isOn;
    const { readyState } = this;
    if (readyState >= HAVE_FUTURE_DATA && this.#readyState < HAVE_FUTURE_DATA) this.#emit('canplay');
    this.#readyState = readyState;
    const isShown = session?.isShown ?? false;
    const isStarting = session !== null && !isShown && session.fetches;
    const duration = session?.clip?.duration ?? 0;
    this.#ui.update({
      hasControls: this.controls,
      isMovable: this.cameraControls,
      isShown,
      isWaiting: isStarting || (isShown && (clock.isSeeking || clock.isWaiting)),
      reason: session?.clip ? session.clip.message : 'waiting for the beginning of the file',
      isOffered: !this.#hasPlayed && clock.paused && (session === null ? this.src !== '' : duration > 0 && !isStarting),
      paused: clock.paused,
      ended: clock.ended,
      time: clock.time,
      duration,
      hasSound: this.hasSound,
      isAudible: this.isAudible,
      volume: this.loudness,
      buffered: session?.clip?.buffered ?? [],
      isFullscreen,
      isWhole: this.#scroll.isNone || isFullscreen,
    });
    session?.wakeIfChanged(`${this.quality} ${this.shownPart} ${this.appearance}`);
  }

  #emit(type: string): void {
    this.dispatchEvent(new Event(type));
  }
}

const isReducedMotion = (): boolean => matchMedia('(prefers-reduced-motion: reduce)').matches;

/** Make `<kpc-player>` known to the page. */
export function define(): void {
  if (globalThis.customElements && !customElements.get('kpc-player')) customElements.define('kpc-player', KpcPlayer);
}

declare global {
  interface HTMLElementTagNameMap {
    'kpc-player': KpcPlayer;
  }
}
