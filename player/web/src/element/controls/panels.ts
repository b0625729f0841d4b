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

/** A setting: what shows it, and what makes that show how it is now. */
interface Row {
  element: HTMLElement;
  follow(): void;
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
    const list = select(options, (name) => name !== '' && choose(name)());
    panel.append(labelled('Camera', list));
  }
}

/** Fill the panel of settings; return what makes it show how they are now, however they were changed. */
export function fillSettings(panel: HTMLElement, model: Model, commands: Commands): () => void {
  const rows: Row[] = [];
  const speeds = new Map(SPEEDS.map((speed) => [String(speed), speedText(speed)]));
  const levels = new Map(['auto', ...LEVEL_NAMES].map((level) => [level, capital(level)]));
  const names = new Map([['', 'Average'], ...model.appearances.map((name) => [name, name] as [string, string])]);
  if (model.duration > 0) rows.push(speedRow(speeds, model));
  rows.push(choiceRow('Quality', levels, model, 'quality'));
  if (model.isDynamic) rows.push(choiceRow('Show', PARTS, model, 'shownPart'));
  if (model.appearances.length > 0) rows.push(choiceRow('Appearance', names, model, 'appearance'));
  if (model.duration > 0) rows.push(switchRow('Loop', model, 'loop', () => commands.toggleLoop()));
  if (model.hasLimits) {
    rows.push(switchRow('Keep to filmed views', model, 'keepsLimits', () => commands.toggleLimits()));
  }
  const buttons = make('div', { class: 'choices' });
  buttons.append(
    make('button', { type: 'button', class: 'choice', onclick: () => commands.savePicture() }, 'Save picture'),
    make('button', { type: 'button', class: 'choice', onclick: () => commands.copyLink() }, 'Copy link'),
    make('button', { type: 'button', class: 'choice wide keyboard', onclick: () => commands.toggleHelp() }, 'Keys'),
  );
  panel.replaceChildren(...rows.map(({ element }) => element), buttons);
  const follow = () => {
    for (const row of rows) row.follow();
  };
  follow();
  return follow;
}

/** Return the list of keys that do something. */
export function keyList(isMovable: boolean): HTMLElement {
  const rows = KEY_BINDINGS.filter(({ movesView }) => isMovable || !movesView).map(({ keys, help }) =>
    make('tr', {}, make('th', { scope: 'row' }, keys), make('td', {}, help)),
  );
  return make('table', {}, make('tbody', {}, ...rows));
}

function choiceRow(
  label: string,
  options: Map<string, string> | Record<string, string>,
  model: Model,
  name: 'quality' | 'shownPart' | 'appearance',
): Row {
  const list = select(options, (value) => {
    model[name] = value;
  });
  const follow = () => {
    if (list.value !== model[name]) list.value = model[name];
  };
  return { element: labelled(label, list), follow };
}

/** Speeds of the list and, in its place among them, any other that a page has set. */
function speedRow(speeds: Map<string, string>, model: Model): Row {
  const list = select(speeds, (value) => {
    model.playbackRate = Number(value);
  });
  const follow = () => {
    const rate = model.playbackRate;
    if (list.value === String(rate)) return;
    const known = [...list.options];
    for (const option of known) if (!speeds.has(option.value)) option.remove();
    if (!speeds.has(String(rate))) {
      const faster = known.find(({ value }) => speeds.has(value) && Number(value) > rate) ?? null;
      list.insertBefore(make('option', { value: rate }, speedText(rate)), faster);
    }
    list.value = String(rate);
  };
  return { element: labelled('Speed', list), follow };
}

/** A switch: a click sets what it then shows. */
function switchRow(label: string, model: Model, name: 'loop' | 'keepsLimits', toggle: () => void): Row {
  const box = make('input', {
    type: 'checkbox',
    role: 'switch',
    onchange: () => box.checked !== model[name] && toggle(),
  });
  const follow = () => {
    if (box.checked !== model[name]) box.checked = model[name];
  };
  return { element: labelled(label, box), follow };
}

function select(
  options: Map<string, string> | Record<string, string>,
  chosen: (value: string) => void,
): HTMLSelectElement {
  const entries = options instanceof Map ? [...options] : Object.entries(options);
  const list = make('select', { onchange: () => chosen(list.value) });
  for (const [name, text] of entries) list.append(make('option', { value: name }, text));
  return list;
}

const labelled = (label: string, element: HTMLElement): HTMLElement =>
  make('label', { class: 'row' }, make('span', {}, label), element);

const speedText = (speed: number): string => (speed === 1 ? 'Normal' : `${speed}×`);

const capital = (word: string): string => word.charAt(0).toUpperCase() + word.slice(1);
