/** What keys and buttons can make a player do. */

export interface Commands {
  playOrPause(): void;
  /** Pause, and go some frames forward. */
  step(frames: number): void;
  seek(seconds: number): void;
  changeSpeed(steps: number): void;
  toggleLoop(): void;
  toggleSound(): void;
  toOpening(): void;
  nextCamera(): void;
  nextPreset(): void;
  toggleLimits(): void;
  nextAppearance(): void;
  nextPart(): void;
  changeQuality(levels: number): void;
  toggleAuto(): void;
  savePicture(): void;
  copyLink(): void;
  toggleFullscreen(): void;
  toggleHeadset(): void;
  toggleHelp(): void;
}
