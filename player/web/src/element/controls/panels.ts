/** What the panels of the bar hold: views to choose from, and settings. */

import { LEVEL_NAMES } from '../../render/quality.js';
import { SPEEDS } from '../clock.js';
import type { Commands } from '../commands.js';
import { KEY_BINDINGS } from '../keyboard.js';
import { make } from './dom.js';

/** What panels show and change; `KpcPlayer` has it. */
export interface Model {
  readonly presets: readonly string[];
  readonly cameras: readonly string[];
  readonly appearances: readonly string[];
  readonly duration: number;
  readonly isDynamic: boolean;
  readonly hasLimits: boolean;
  keepsLimits: boolean;
  camera: string;
  playbackRate: number;
  get quality(): string;
  set quality(value: string);
  shownPart: string;
  appearance: string;
  loop: boolean;
}

const PARTS = { all: 'Everything', static: 'What stands still', dynamic: 'What moves' };

export function fillViews(panel: HTMLElement, model: Model, commands: Commands): void {
  const choose = (name: string) => () => {
    model.camera = name;
  };
  const buttons = model.presets.map((name) =>
    make('button', { type: 'button', class: 'choice', onclick: choose(name) }, capital(name)),
  );
  const opening = make(
    'button',
    { type: 'button', class: 'choice wide', onclick: () => commands.toOpening() },
    'Opening view',
  );
  panel.replaceChildren(make('div', { class: 'choices' }, opening, ...buttons));
  if (model.cameras.length > 1) {
    const options = Object.fromEntries([['', 'Choose'], ...model.cameras.map((name) => [name, name])]);
    panel.append(select('Camera', options, '', (name) => name !== '' && choose(name)()));
  }
}

export function fillSettings(panel: HTMLElement, model: Model, commands: Commands): void {
  const rows: HTMLElement[] = [];
  if (model.duration > 0) {
    const speeds = Object.fromEntries(SPEEDS.map((speed) => [speed, speed === 1 ? 'Normal' : `${speed}×`]));
    const ordered = new Map(SPEEDS.map((speed) => [String(speed), speeds[speed]]));
    rows.push(
      select('Speed', ordered, String(model.playbackRate), (value) => {
        model.playbackRate = Number(value);
      }),
    );
  }
  const levels = new Map(['auto', ...LEVEL_NAMES].map((level) => [level, capital(level)]));
  rows.push(
    select('Quality', levels, model.quality, (value) => {
      model.quality = value;
    }),
  );
  if (model.isDynamic) {
    rows.push(
      select('Show', PARTS, model.shownPart, (value) => {
        model.shownPart = value;
      }),
    );
  }
  if (model.appearances.length > 0) {
    const names = new Map([['', 'Average'], ...model.appearances.map((name) => [name, name] as [string, string])]);
    rows.push(
      select('Appearance', names, model.appearance, (value) => {
        model.appearance = value;
      }),
    );
  }
  if (model.duration > 0) rows.push(check('Loop', model.loop, () => commands.toggleLoop()));
  if (model.hasLimits) rows.push(check('Keep to filmed views', model.keepsLimits, () => commands.toggleLimits()));
  const buttons = make('div', { class: 'choices' });
  buttons.append(
    make('button', { type: 'button', class: 'choice', onclick: () => commands.savePicture() }, 'Save picture'),
    make('button', { type: 'button', class: 'choice', onclick: () => commands.copyLink() }, 'Copy link'),
    make('button', { type: 'button', class: 'choice wide keyboard', onclick: () => commands.toggleHelp() }, 'Keys'),
  );
  panel.replaceChildren(...rows, buttons);
}

/** Return the list of keys that do something. */
export function keyList(isMovable: boolean): HTMLElement {
  const rows = KEY_BINDINGS.filter(({ movesView }) => isMovable || !movesView).map(({ keys, help }) =>
    make('tr', {}, make('th', { scope: 'row' }, keys), make('td', {}, help)),
  );
  return make('table', {}, make('tbody', {}, ...rows));
}

function select(
  label: string,
  options: Map<string, string> | Record<string, string>,
  value: string,
  chosen: (value: string) => void,
): HTMLElement {
  const entries = options instanceof Map ? [...options] : Object.entries(options);
  const list = make('select', { onchange: () => chosen(list.value) });
  for (const [name, text] of entries) list.append(make('option', { value: name }, text));
  list.value = value;
  return make('label', { class: 'row' }, make('span', {}, label), list);
}

function check(label: string, isOn: boolean, changed: () => void): HTMLElement {
  const box = make('input', { type: 'checkbox', role: 'switch', onchange: changed });
  box.checked = isOn;
  return make('label', { class: 'row' }, make('span', {}, label), box);
}

const capital = (word: string): string => word.charAt(0).toUpperCase() + word.slice(1);
