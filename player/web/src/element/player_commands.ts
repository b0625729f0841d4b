/** The commands of keys and buttons, done by the element's own properties and methods. */

import { LEVEL_NAMES } from '../render/quality.js';
import { nextSpeed } from './clock.js';
import type { Commands } from './commands.js';
import { make } from './controls/dom.js';
import type { Ui } from './controls/ui.js';
import type { KpcPlayer } from './kpc-player.js';
import { linkTo } from './link.js';

const PARTS = ['all', 'static', 'dynamic'] as const;

export class PlayerCommands implements Commands {
  readonly #player: KpcPlayer;
  readonly #ui: () => Ui;
  #camera = 0;
  #preset = -1;

  constructor(player: KpcPlayer, ui: () => Ui) {
    this.#player = player;
    this.#ui = ui;
  }

  playOrPause(): void {
    if (this.#player.paused)
      this.#player.play().catch(() => {}); // what is wrong is shown, and in `error`
    else this.#player.pause();
  }

  step(frames: number): void {
    this.#player.step(frames);
  }

  seek(seconds: number): void {
    this.#player.currentTime = Math.min(seconds, this.#player.duration || 0);
  }

  changeSpeed(steps: number): void {
    this.#player.playbackRate = nextSpeed(this.#player.playbackRate, steps);
    this.#ui().notify(`Speed ${this.#player.playbackRate}×`);
  }

  toggleLoop(): void {
    this.#player.loop = !this.#player.loop;
    this.#ui().notify(this.#player.loop ? 'Loop on' : 'Loop off');
  }

  toggleSound(): void {
    const player = this.#player;
    if (!player.hasSound) {
      this.#ui().notify('This scene has no sound');
    } else if (player.isAudible) {
      player.muted = true;
      this.#ui().notify('Sound off');
    } else {
      player.muted = false;
      if (player.volume === 0) player.volume = 1;
      this.#ui().notify(`Volume ${Math.round(100 * player.volume)} %`);
    }
  }

  toOpening(): void {
    [this.#camera, this.#preset] = [0, -1];
    this.#player.camera = 'opening';
  }

  nextCamera(): void {
    const { cameras } = this.#player;
    if (cameras.length === 0) return;
    this.#camera = (this.#camera + 1) % cameras.length;
    this.#look(cameras[this.#camera]);
  }

  nextPreset(): void {
    const { presets } = this.#player;
    if (presets.length === 0) return;
    this.#preset = (this.#preset + 1) % presets.length;
    this.#look(presets[this.#preset]);
  }

  toggleLimits(): void {
    const player = this.#player;
    if (player.hasLimits) {
      player.keepsLimits = !player.keepsLimits;
      this.#ui().notify(player.keepsLimits ? 'The view keeps to where the scene was filmed' : 'The view is free');
    } else {
      this.#ui().notify('This file does not say from where it holds');
    }
  }

  nextAppearance(): void {
    const names = ['', ...this.#player.appearances];
    if (names.length === 1) return;
    this.#player.appearance = names[(names.indexOf(this.#player.appearance) + 1) % names.length];
    this.#ui().notify(`Appearance: ${this.#player.appearance || 'average'}`);
  }

  nextPart(): void {
    if (!this.#player.isDynamic) return;
    this.#player.shownPart = PARTS[(PARTS.indexOf(this.#player.shownPart) + 1) % PARTS.length];
    this.#ui().notify(
      { all: 'Everything', static: 'What stands still', dynamic: 'What moves' }[this.#player.shownPart] ?? '',
    );
  }

  changeQuality(levels: number): void {
    const { quality } = this.#player;
    const at = quality === 'auto' ? LEVEL_NAMES.indexOf('balanced') : LEVEL_NAMES.indexOf(quality);
    const next = Math.min(Math.max(at + levels, 0), LEVEL_NAMES.length - 1);
    this.#player.quality = LEVEL_NAMES[next];
    this.#ui().notify(`Quality: ${LEVEL_NAMES[next]}, level ${next + 1} of ${LEVEL_NAMES.length}`);
  }

  toggleAuto(): void {
    this.#player.quality = this.#player.quality === 'auto' ? 'balanced' : 'auto';
    this.#ui().notify(`Quality: ${this.#player.quality}`);
  }

  async savePicture(): Promise<void> {
    const player = this.#player;
    try {
      const address = URL.createObjectURL(await player.toBlob());
      make('a', { href: address, download: `${fileStem(player)}-${player.currentTime.toFixed(2)}s.png` }).click();
      setTimeout(() => URL.revokeObjectURL(address), 60_000);
    } catch (error) {
      this.#ui().notify((error as Error).message);
    }
  }

  async copyLink(): Promise<void> {
    const player = this.#player;
    const link = linkTo(
      location.href,
      { time: player.duration > 0 ? player.currentTime : null, camera: player.camera },
      player.id,
    );
    try {
      await navigator.clipboard.writeText(link);
      this.#ui().notify('Link to this view at this time copied');
    } catch {
      // Without https, or without leave, the page may not write there: the link is shown, to be copied by hand.
      const field = make('input', {
        type: 'text',
        readonly: true,
        value: link,
        'aria-label': 'Link to this view at this time',
      });
      this.#ui().notify(field, true);
      field.addEventListener('blur', () => this.#ui().notify(''));
      field.select();
    }
  }

  toggleFullscreen(): void {
    this.#player.toggleFullscreen();
  }

  async toggleHeadset(): Promise<void> {
    try {
      await this.#player.toggleHeadset();
    } catch (error) {
      this.#ui().notify(`The headset cannot show the scene: ${(error as Error).message}.`);
    }
  }

  toggleHelp(): void {
    this.#ui().toggleKeys();
  }

  #look(name: string): void {
    this.#player.camera = name;
    this.#ui().notify(name);
  }
}

/** Return the name of a player's file without its suffix. */
function fileStem({ srcObject, src }: KpcPlayer): string {
  const name = srcObject ? ((srcObject as File).name ?? '') : new URL(src || 'about:scene').pathname;
  return (name.split('/').pop() ?? '').replace(/\.kpc$/i, '') || 'scene';
}
