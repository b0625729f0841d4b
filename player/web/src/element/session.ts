/** A clip that is being shown: it is fetched, drawn frame by frame, and moved by hands. */

import type { SceneEvent } from '../streaming/clip.js';
import { Clip } from '../streaming/clip.js';
import { Limits } from './camera/limits.js';
import { Rig } from './camera/rig.js';
import { cameraOf, type View, viewFromText, viewOf } from './camera/view.js';
import { ViewControl } from './camera/view_control.js';
import type { Clock } from './clock.js';
import { loadDriver } from './driver.js';
import { Headset } from './headset/headset.js';
import type { Input } from './input.js';
import { Picture, type ShownOptions } from './picture.js';
import { SessionSound } from './session_sound.js';

/** Pixels of the picture a CSS pixel spans at most, and pixels of the picture at most. */
const [MOST_RATIO, MOST_PIXELS] = [2, 1 << 22];
/** The share of a second that must have arrived beyond the playhead for the clip to go on. */
const FUTURE_S = 0.1;

export interface SessionOptions {
  src: string | Blob;
  memory: number;
  workerUrl: string | null;
  fps: number | undefined;
  clock: Clock;
  hasPoster(): boolean;
  /** Of the sound, 0 to 1; 0 while it is off. */
  volume(): number;
  /** Where the picture goes. */
  stage: HTMLElement;
  shown(): ShownOptions;
}

export interface SessionEvents {
  /** Header, index and cameras have arrived. */
  opened(): void;
  /** The first picture is there. */
  shown(): void;
  /** More has arrived. */
  progress(): void;
  viewChanged(): void;
  lost(isLost: boolean): void;
  failed(error: unknown): void;
  /** The clip is shown, but the end of its file is missing. */
  incomplete(): void;
  /** There is something to tell the user, who can go on. */
  notified(message: string): void;
  /** A frame is over. */
  frame(): void;
}

export class Session {
  /** Whether something has been drawn. */
  isShown = false;
  /** Pictures that have been shown so far. */
  pictures = 0;
  /** Whether what is fetched follows the playhead; false fetches the header and, without a poster, a coarse picture. */
  fetches = true;
  clip: Clip | null = null;
  view: ViewControl | null = null;
  sound: SessionSound | null = null;
  presets = new Map<string, View['lens']>();
  readonly #options: SessionOptions;
  readonly #events: SessionEvents;
  readonly #input: Input;
  readonly #opening = new AbortController();
  readonly #resizes = new ResizeObserver((entries) => this.#resized(entries[0]));
  readonly #sight = new IntersectionObserver((entries) => this.#sighted(entries[entries.length - 1].isIntersecting));
  #picture: Picture | null = null;
  #headset: Headset | null = null;
  #size: [number, number] = [0, 0];
  #isInSight = true;
  /** How many wait for a picture, who see it wherever the element is. */
  #askers = 0;
  #isReduced = false;
  /** Whether a time was sought since the last picture was drawn or gone on with. */
  #hasSought = false;
  #isSharp = false;
  #isKnownIncomplete = false;
  #request = 0;
  #lastFrame = 0;
  #shownView: View | null = null;
  #shownWords = '';
  #isClosed = false;

  constructor(options: SessionOptions, input: Input, events: SessionEvents) {
    this.#options = options;
    this.#input = input;
    this.#events = events;
    this.#resizes.observe(options.stage);
    this.#sight.observe(options.stage);
  }

  async open(): Promise<void> {
    const { src, memory, workerUrl, stage, fps, clock, volume } = this.#options;
    try {
      const pool = workerUrl === null ? {} : { workerUrl };
      const driver = loadDriver(pool);
      const position = this.fetches ? { time: 0 } : null;
      const clip = await Clip.open(src, { memory, signal: this.#opening.signal, pool, position });
      if (this.#isClosed) return clip.close();
      this.clip = clip;
      this.sound = new SessionSound(clip, clock, volume, (message) => this.#events.notified(message));
      const { aabb } = clip.scenes[0].head;
      const { up, view_limits: limits, opening } = clip.metadata;
      const rig = new Rig(clip.cameras, aabb, up);
      this.view = new ViewControl(rig, limits && up ? new Limits(limits, up) : null, opening?.camera ?? rig.cameras[0]);
      this.presets = rig.presets();
      clip.addEventListener('arrived', this.#arrived);
      clip.addEventListener('error', () => this.#failed(clip.error));
      clip.addEventListener('release', (event) => this.#picture?.release((event as SceneEvent).scene));
      this.#events.opened();
      this.wake();
      await driver;
      if (this.#isClosed) return;
      const picture = await Picture.open(this.#size, {
        fps,
        onLost: () => this.#events.lost(true),
        onRestored: () => {
          this.#events.lost(false);
          this.wake();
        },
      });
      if (this.#isClosed) return picture.dispose();
      this.#picture = picture;
      stage.append(this.#picture.canvas);
      this.wake();
    } catch (error) {
      if (!this.#isClosed) this.#failed(error);
    }
  }

  get extent(): number {
    const box = this.clip?.scenes[0].head.aabb ?? [0, 0, 0, 1, 1, 1];
    return Math.max(box[3] - box[0], box[4] - box[1], box[5] - box[2]);
  }

  get isDynamic(): boolean {
    return this.clip?.scenes[0].head.isDynamic ?? false;
  }

  get cameraNames(): readonly string[] {
    const { cameras = [], metadata = {} } = this.clip ?? {};
    return cameras.map((_, number) => metadata.camera_names?.[number] ?? `camera ${number + 1}`);
  }

  /** Return the view that the name of a preset or a camera, "opening", or numbers say; null if they say none. */
  viewOf(text: string): View | null {
    const { clip, view, presets } = this;
    if (clip === null || view === null) return null;
    const { rig } = view;
    const opening = clip.metadata.opening?.camera ?? rig.cameras[0];
    const named = text === 'opening' ? opening : (presets.get(text) ?? clip.cameras[this.cameraNames.indexOf(text)]);
    return named ? viewOf(rig, named) : viewFromText(rig, text, opening);
  }

  /** How much is there, as of HTMLMediaElement. */
  get readyState(): number {
    const { clip } = this;
    const { time, duration } = this.#options.clock;
    if (clip === null) return 0;
    if (!this.isShown || !clip.canShow(time)) return 1;
    const [, until] = clip.buffered.find(([from, to]) => from <= time + 1e-6 && time <= to + 1e-6) ?? [0, time];
    if (until >= duration - 1e-6) return 4;
    return until >= time + FUTURE_S ? 3 : 2;
  }

  get isSharp(): boolean {
    return this.#isSharp;
  }

  set fps(fps: number | undefined) {
    if (this.#picture) this.#picture.fps = fps;
  }

  /** Draw at the next opportunity, and go on as long as something changes. */
  wake(): void {
    if (this.#headset) return; // which has frames of its own
    if (this.#request === 0 && !this.#isClosed) this.#request = requestAnimationFrame((now) => this.#frame(now));
  }

  /** Have fetched at once what a time that was sought needs: frames may be late while the card is busy. */
  seek(): void {
    this.#hasSought = true;
    if (this.clip !== null && this.view !== null) this.#follow(this.clip);
    this.wake();
  }

  /** Draw again if what is to be shown, in words, is not what it was. */
  wakeIfChanged(shown: string): void {
    if (shown === this.#shownWords) return;
    this.#shownWords = shown;
    this.#isSharp = false;
    this.wake();
  }

  /** Show the clip in a headset, or leave it. */
  async toggleHeadset(selected: () => void): Promise<void> {
    if (this.#headset) return this.#headset.leave();
    const { clip, view } = this;
    const picture = this.#picture;
    if (clip === null || view === null || picture === null) throw new Error('the scene has not arrived yet');
    const { fps, clock } = this.#options;
    this.#headset = await Headset.enter({
      gl: picture.gl,
      view: view.view,
      metresPerUnit: clip.metadata.metres_per_unit,
      holds: (headsetFps) => {
        picture.fps = picture.isSoftware ? undefined : headsetFps;
      },
      advance: (seconds) => {
        this.#advance(clip, seconds);
        this.#events.frame();
      },
      draw: (frames) => {
        if (clip.canShow(clock.time) || this.isShown) picture.drawInto(frames, clip, clock.time, this.#shownOptions());
      },
      selected,
      left: () => {
        this.#headset = null;
        picture.fps = fps;
        this.#isSharp = false;
        this.wake();
      },
    });
  }

  /** Whether the card was lost, and nothing has been drawn since. */
  get #isGone(): boolean {
    return this.isShown && this.#picture?.isThere === false;
  }

  /**
   * Return the picture as a file, once it is as fine as it will be; while the clip plays, at once, or once a lost card
   * is back.
   */
  async toBlob(type: string, quality?: number): Promise<Blob> {
    const { clock } = this.#options;
    this.#isSharp = false; // a view or a time may have been set since the last frame
    this.#askers++;
    for (let frames = 0; frames < 600 && (clock.paused || this.#isGone) && !this.#isClosed; frames++) {
      this.wake();
      await new Promise(requestAnimationFrame);
      if ((clock.isSeeking || this.#isGone) && this.clip?.error === null) frames = 0;
      else if (this.#isSharp || this.#isGone) break;
    }
    this.#askers--;
    if (this.#picture === null || !this.isShown || this.#isGone) {
      const why = this.#isClosed ? 'the scene was removed before its picture was there' : 'there is no picture yet';
      throw new DOMException(why, 'InvalidStateError');
    }
    return this.#picture.toBlob(type, quality);
  }

  close(): void {
    this.#isClosed = true;
    this.#opening.abort();
    cancelAnimationFrame(this.#request);
    this.#resizes.disconnect();
    this.#sight.disconnect();
    this.#headset?.leave();
    this.sound?.close();
    this.clip?.close();
    this.#picture?.dispose();
    this.clip = this.view = this.sound = this.#picture = null;
  }

  #frame(now: number): void {
    this.#request = 0;
    const { clip, view } = this;
    if (clip === null || view === null) return;
    const { clock } = this.#options;
    // The first frame after a pause takes no time.
    const seconds = this.#lastFrame === 0 ? 0 : (now - this.#lastFrame) / 1000;
    this.#input.advance(seconds);
    const isMoving = view.advance(seconds) || this.#input.isActive;
    const isTaking = this.#attempt(() => this.#picture?.take(clip)) ?? false; // a group may be shown thereafter
    if (this.#isClosed) return;
    this.#advance(clip, seconds);
    if (this.#isClosed) return; // by a listener
    if (view.view !== this.#shownView) {
      if (this.#shownView !== null) this.#events.viewChanged();
      this.#shownView = view.view;
    }
    this.#attempt(() => this.#draw(isTaking));
    if (this.#isClosed) return;
    this.#events.frame();
    const isGoing = isMoving || !clock.paused || clock.isSeeking || !this.#isSharp;
    this.#lastFrame = isGoing ? now : 0;
    if (isGoing) this.wake();
  }

  /** Let the clip fetch what the clock's time needs. */
  #follow(clip: Clip): void {
    const { clock, hasPoster } = this.#options;
    const isPreview = !this.fetches;
    if (!isPreview || !hasPoster())
      clip.setPlayhead({ time: clock.time, rate: clock.speed, loop: clock.loop, isPreview });
  }

  /** Let time pass. */
  #advance(clip: Clip, seconds: number): void {
    const { clock } = this.#options;
    this.#follow(clip);
    clock.tick(this.sound?.advance(seconds) ?? seconds, (time) => this.isShown && clip.canShow(time));
    if (this.isShown && this.fetches) this.sound?.follow(); // a listener may have ended all this
  }

  #draw(isTaking: boolean): void {
    const { clip, view } = this;
    const [width, height] = this.#size;
    if (clip === null || view === null || this.#picture === null || width === 0 || height === 0) return;
    const { time, isSeeking } = this.#options.clock;
    const camera = cameraOf(view.view, width, height);
    // Nothing that is worse than the poster, or than the picture before a jump.
    if (!(this.#isInSight || this.#askers > 0) || !(clip.canShow(time) || (this.isShown && !isSeeking))) {
      const isPrepared = this.#picture.prepare(clip, camera, this.#shownOptions());
      this.#isSharp = isPrepared && !isTaking;
      return;
    }
    this.#picture.resize(width, height);
    const { pictures, isSharp } = this.#picture.draw(clip, time, camera, this.#shownOptions(), this.#hasSought);
    this.#hasSought = false;
    this.pictures = pictures;
    this.#isSharp = isSharp;
    if (clip.scenes.length > 1) this.#picture.prepare(clip, camera, this.#shownOptions());
    if (pictures > 0 && !this.isShown) {
      this.isShown = true;
      this.#events.shown();
    }
    if (this.isShown && clip.notice !== null && !this.#isKnownIncomplete) {
      this.#isKnownIncomplete = true;
      this.#events.incomplete();
    }
  }

  #shownOptions(): ShownOptions {
    const shown = this.#options.shown();
    return this.#isReduced ? { ...shown, level: 'fastest' } : shown;
  }

  /** Do something on the card, and say what it returns; undefined if it fails. */
  #attempt<T>(act: () => T): T | undefined {
    try {
      return act();
    } catch (error) {
      this.#reduceOrFail(error);
      return undefined;
    }
  }

  /** Try once with as little memory as possible before giving up. */
  #reduceOrFail(error: unknown): void {
    if (this.#isReduced) {
      this.#failed(error);
      return;
    }
    this.#isReduced = true;
    this.#size = [Math.ceil(this.#size[0] / 2), Math.ceil(this.#size[1] / 2)];
    this.wake();
  }

  #failed(error: unknown): void {
    this.#events.failed(error);
  }

  readonly #arrived = (): void => {
    this.#events.progress();
    this.wake();
  };

  #resized(entry: ResizeObserverEntry): void {
    const ratio = Math.min(devicePixelRatio, MOST_RATIO);
    const { width, height } = entry.contentRect;
    const pixels = width * height * ratio * ratio;
    const scale = (pixels > MOST_PIXELS ? Math.sqrt(MOST_PIXELS / pixels) : 1) * ratio * (this.#isReduced ? 0.5 : 1);
    this.#size = [Math.round(width * scale), Math.round(height * scale)];
    this.#isSharp = false;
    this.wake();
  }

  #sighted(isInSight: boolean): void {
    this.#isInSight = isInSight;
    this.wake();
  }
}
