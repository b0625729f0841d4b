/** What pages set is converted as for `<video>`; run with an element that has attributes and no page. */

import assert from 'node:assert/strict';
import { test } from 'node:test';
import { upgrade } from '../src/element/attributes.js';
import { AudibleElement } from '../src/element/audible_element.js';
import { Clock } from '../src/element/clock.js';
import { blobOrNull, byteCount, cameraText } from '../src/element/values.js';

class Player extends AudibleElement {
  readonly attributesSet = new Map<string, string>();
  changes = 0;

  override getAttribute(name: string): string | null {
    return this.attributesSet.get(name) ?? null;
  }

  override setAttribute(name: string, value: string): void {
    this.attributesSet.set(name, value);
  }

  override hasAttribute(name: string): boolean {
    return this.attributesSet.has(name);
  }

  override removeAttribute(name: string): void {
    this.attributesSet.delete(name);
  }

  override toggleAttribute(name: string, isThere: boolean): boolean {
    if (isThere) this.attributesSet.set(name, '');
    else this.attributesSet.delete(name);
    return isThere;
  }

  protected override loudnessChanged(): void {
    this.changes++;
  }
}

test('camera-controls is off by its word as a property, too', () => {
  const player = new Player();
  player.controls = true;
  player.cameraControls = 'none';
  assert.equal(player.cameraControls, false);
});

test('an unknown word counts as the first known one, and is warned of once', (context) => {
  const player = new Player();
  const warn = context.mock.method(console, 'warn', () => {});
  player.quality = 'high';
  assert.deepEqual([player.quality, player.quality], ['auto', 'auto']);
  player.quality = 'Fine';
  assert.equal(player.quality, 'fine');
  const said = warn.mock.calls.map(({ arguments: [message] }) => String(message).slice(0, 58));
  assert.deepEqual(said, ['kpc-player: quality="high" is not known; use auto, fastest']);
});

test('booleans are true or false whatever is set', () => {
  for (const name of ['controls', 'autoplay', 'loop', 'playsInline', 'muted', 'cameraControls'] as const) {
    const player = new Player();
    for (const value of [undefined, 0, null, '', Number.NaN, false] as unknown as boolean[]) {
      player[name] = true;
      player[name] = value;
      assert.equal(player[name], false, `${name} = ${value}`);
    }
    for (const value of ['false', 1, {}, true] as unknown as boolean[]) {
      player[name] = false;
      player[name] = value;
      assert.equal(player[name], true, `${name} = ${value}`);
    }
  }
});

test('texts without a value take the attribute away', () => {
  const player = new Player();
  for (const nothing of [null, undefined] as unknown as string[]) {
    player.poster = 'a.jpg';
    player.poster = nothing;
    assert.equal(player.hasAttribute('poster'), false);
  }
  player.appearance = 7 as unknown as string;
  assert.equal(player.appearance, '7');
});

test('numbers may be texts, and must be finite', () => {
  const player = new Player();
  player.volume = '0.5' as unknown as number;
  assert.equal(player.volume, 0.5);
  player.volume = null as unknown as number;
  assert.equal(player.volume, 0);
  for (const odd of ['x', undefined, Infinity] as unknown as number[]) {
    assert.throws(() => Object.assign(player, { volume: odd }), TypeError);
  }
  for (const odd of [-0.1, 1.1]) {
    assert.throws(() => Object.assign(player, { volume: odd }), { name: 'IndexSizeError' });
  }
  assert.deepEqual([player.volume, player.changes], [0, 2]);
  const clock = new Clock(() => {});
  clock.rate = '2' as unknown as number;
  assert.equal(clock.rate, 2);
  assert.throws(() => Object.assign(clock, { rate: 'x' }), TypeError);
  for (const odd of [0, -1, 17])
    assert.throws(() => Object.assign(clock, { rate: odd }), { name: 'NotSupportedError' });
  assert.equal(clock.rate, 2);
});

test('a value that is refused does not keep an element from its other values', (context) => {
  const logged = context.mock.method(console, 'error', () => {});
  const player = new Player();
  Object.defineProperty(player, 'volume', { value: 'x', configurable: true, writable: true });
  Object.defineProperty(player, 'loop', { value: 1, configurable: true, writable: true });
  upgrade(player);
  assert.deepEqual([player.volume, player.loop], [1, true]);
  assert.match(String(logged.mock.calls[0].arguments[0]), /volume must be a finite number/);
});

test('a camera is a text, numbers or nothing', () => {
  assert.equal(cameraText([1, -3, 1, 0, 0, 0]), '1 -3 1 0 0 0');
  assert.equal(cameraText('1,2,3'), '1,2,3');
  assert.equal(cameraText(new Float32Array([1, 2])), '1,2');
  for (const nothing of [null, undefined, '', ' ', []]) assert.equal(cameraText(nothing), 'opening');
  assert.equal(cameraText(7), '7');
});

test('a file is a Blob, or none', () => {
  const blob = new Blob(['x']);
  assert.equal(blobOrNull(blob, 'srcObject'), blob);
  for (const nothing of [null, undefined]) assert.equal(blobOrNull(nothing, 'srcObject'), null);
  for (const odd of ['text', '', 0, false, {}]) {
    assert.throws(() => blobOrNull(odd, 'srcObject'), { name: 'TypeError', message: /^srcObject must be a Blob/ });
  }
});

test('sizes are those of the option --memory', () => {
  const sizes = {
    '300000': 3e5,
    '300KB': 3e5,
    '2mb': 2e6,
    '1.5M': 1.5e6,
    '512 MB': 512e6,
    '.5GB': 5e8,
    '1e8': 1e8,
    ' 7b ': 7,
  };
  for (const [text, bytes] of Object.entries(sizes)) assert.equal(byteCount(text), bytes, text);
  for (const odd of ['', 'MB', '-1', '0', '0x10', '1TB', '1 M B', 'x1', '1e12', '1e999', 'NaN', '512MiB']) {
    assert.equal(byteCount(odd), null, odd);
  }
});

test('a size that is none is refused with one warning', (context) => {
  const warned = context.mock.method(console, 'warn', () => {});
  const player = new Player();
  const { memory } = player;
  player.memory = '512MB';
  assert.equal(player.memory, 512e6);
  for (const odd of ['much', 'much', '-3']) {
    player.memory = odd;
    assert.equal(player.memory, memory);
  }
  assert.equal(warned.mock.callCount(), 2);
  assert.match(String(warned.mock.calls[0].arguments[0]), /memory="much" is not a size/);
  player.memory = null as unknown as number;
  assert.equal(player.memory, memory);
});
