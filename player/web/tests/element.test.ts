import assert from 'node:assert/strict';
import { test } from 'node:test';
import { KpcError } from '../src/container/errors.js';
import { Beginning } from '../src/element/beginning.js';
import { Clock, nextSpeed } from '../src/element/clock.js';
import { clockText } from '../src/element/controls/timeline.js';
import { actionOf, flightOf, KEY_BINDINGS } from '../src/element/keyboard.js';
import { linkTo, momentOf } from '../src/element/link.js';
import { playerErrorOf } from '../src/element/messages.js';

function clockOf(duration = 2, frameCount = 21) {
  const events: string[] = [];
  const clock = new Clock((event) => events.push(event));
  Object.assign(clock, { duration, frameCount });
  const take = () => events.splice(0).join(' ');
  return { clock, take };
}

const always = () => true;

test('a clip plays, pauses and ends with the events of a video', () => {
  const { clock, take } = clockOf();
  clock.play();
  clock.tick(0, always);
  assert.equal(take(), 'play playing');
  for (let i = 0; i < 10; i++) clock.tick(0.1, always);
  assert.ok(Math.abs(clock.time - 1) < 1e-9);
  assert.match(take(), /^timeupdate( timeupdate)*$/);
  clock.pause();
  assert.equal(take(), 'timeupdate pause');
  clock.tick(0.4, always);
  assert.ok(Math.abs(clock.time - 1) < 1e-9);
  clock.play();
  for (let i = 0; i < 4; i++) clock.tick(0.4, always);
  assert.deepEqual([clock.time, clock.ended, clock.paused], [2, true, true]);
  assert.match(take(), /timeupdate pause ended$/);
  clock.play();
  assert.deepEqual([clock.time, clock.ended], [0, false]);
});

test('a clip that loops begins again, at any speed', () => {
  const { clock, take } = clockOf();
  Object.assign(clock, { loop: true, rate: 4 });
  clock.play();
  clock.tick(0, always);
  for (let i = 0; i < 3; i++) clock.tick(0.2, always);
  assert.ok(Math.abs(clock.time - 0.4) < 1e-9);
  assert.ok(!take().includes('ended'));
});

test('a clip waits for what has not arrived', () => {
  const { clock, take } = clockOf();
  clock.play();
  clock.tick(0, always);
  take();
  clock.tick(0.1, () => false);
  clock.tick(0.1, () => false);
  assert.equal(take(), 'waiting');
  assert.equal(clock.time, 0);
  clock.tick(0.1, always);
  clock.tick(0.1, always);
  assert.equal(take(), 'playing');
  assert.ok(Math.abs(clock.time - 0.1) < 1e-9);
});

test('seeking ends once the picture is there', () => {
  const { clock, take } = clockOf();
  clock.seek(99);
  clock.tick(0.1, () => false);
  assert.equal(take(), 'seeking');
  clock.tick(0.1, always);
  assert.equal(take(), 'timeupdate seeked ended');
  assert.equal(clock.time, 2);
});

test('a clip that is at its end has ended, however it came there', () => {
  const { clock, take } = clockOf();
  clock.seek(2);
  clock.tick(0.1, always);
  assert.deepEqual([clock.ended, clock.paused, clock.speed], [true, true, 0]);
  clock.loop = true;
  assert.equal(clock.ended, false);
  clock.loop = false;
  take();
  clock.play();
  for (let i = 0; i < 3; i++) clock.tick(0.1, always);
  assert.equal(take(), 'seeking play timeupdate seeked playing');
  assert.ok(clock.time < 1 && !clock.ended && !clock.paused);
  clock.seek(2); // while it plays, as by a hand on the timeline
  clock.tick(0.1, always);
  assert.deepEqual(
    [clock.ended, clock.paused, take()],
    [true, true, 'seeking timeupdate seeked timeupdate pause ended'],
  );
  clock.begin(1);
  assert.equal(clock.ended, false);
  const still = clockOf(0, 1).clock;
  assert.equal(still.ended, false);
});

test('steps go to whole frames, and speeds through a list', () => {
  const { clock } = clockOf();
  clock.seek(0.52);
  clock.step(1);
  assert.ok(Math.abs(clock.time - 0.6) < 1e-9);
  assert.deepEqual([nextSpeed(1, 1), nextSpeed(1.4, 1), nextSpeed(0.25, -1), nextSpeed(0.1, -1)], [2, 2, 0.1, 0.1]);
});

test('times and steps that are no finite numbers are refused', () => {
  const { clock, take } = clockOf();
  clock.begin(1);
  clock.play();
  take();
  for (const odd of [Number.NaN, Infinity, undefined, 'x', {}] as number[]) {
    assert.throws(() => clock.step(odd), TypeError);
    assert.throws(() => clock.seek(odd), TypeError);
    assert.throws(() => clock.begin(odd), TypeError);
  }
  assert.deepEqual([clock.time, clock.paused, take()], [1, false, '']);
  clock.step('2' as unknown as number);
  assert.ok(Math.abs(clock.time - 1.2) < 1e-9);
  clock.step(-1.5);
  assert.ok(Math.abs(clock.time - 1.1) < 1e-9);
});

test('time stands still while the timeline is dragged', () => {
  const { clock } = clockOf();
  clock.play();
  clock.tick(0, always);
  clock.isHeld = true;
  clock.tick(0.1, always);
  assert.equal(clock.time, 0);
});

test('a link says time, camera and player, and keeps what else the hash says', () => {
  const moment = { time: 1.23456, camera: '1 2 3 4 5 6 30.5' };
  const link = linkTo('https://a.example/b?c=d#e=f&t=9', moment, 'one');
  assert.equal(link, 'https://a.example/b?c=d#e=f&t=1.235&camera=1,2,3,4,5,6,30.5&player=one');
  const { hash } = new URL(link);
  assert.deepEqual(momentOf(hash, 'one', false), { time: 1.235, camera: '1,2,3,4,5,6,30.5' });
  assert.equal(momentOf(hash, 'two', true), null);
  assert.equal(
    linkTo('https://a.example/#top', { time: null, camera: 'front' }, ''),
    'https://a.example/#top&camera=front',
  );
});

test('a link keeps the path of a router in the hash', () => {
  for (const [hash, linked] of [
    ['', '#t=2&camera=1,2,3,4,5,6'],
    ['#/', '#/?t=2&camera=1,2,3,4,5,6'],
    ['#/scenes/3', '#/scenes/3?t=2&camera=1,2,3,4,5,6'],
    ['#!/scenes/3?x=%C3%BC&y&t=1', '#!/scenes/3?x=%C3%BC&y&t=2&camera=1,2,3,4,5,6'],
    ['#/a=b?camera=left', '#/a=b?t=2&camera=1,2,3,4,5,6'],
    ['#top&t=5&t', '#top&t=2&camera=1,2,3,4,5,6'],
  ]) {
    const moment = { time: 2, camera: '1,2,3,4,5,6' };
    const link = linkTo(`https://a.example/b${hash}`, moment, '');
    assert.equal(link, `https://a.example/b${linked}`);
    assert.equal(linkTo(link, moment, ''), link);
    assert.deepEqual(momentOf(new URL(link).hash, '', true), moment);
  }
  assert.equal(momentOf('#/scenes/3', '', true), null);
});

test('a link without a player is for the first one, and odd values count as none', () => {
  assert.deepEqual(momentOf('#t=1', 'x', true), { time: 1, camera: null });
  assert.equal(momentOf('#t=1', 'x', false), null);
  for (const hash of ['', '#', '#t=', '#t=-1', '#t=x', '#t=Infinity', '#section'])
    assert.equal(momentOf(hash, '', true), null);
});

test('every key of the list is known once, and flies or acts', () => {
  const keys = KEY_BINDINGS.flatMap(({ actions }) => Object.keys(actions));
  assert.equal(new Set(keys).size, keys.length);
  for (const key of keys) assert.ok(actionOf({ key, code: '' }));
  assert.equal(actionOf({ key: 'toString', code: '' }), null);
});

test('keys go by letter, or by place where there are other letters', () => {
  const loop = actionOf({ key: 'l', code: 'KeyL' });
  assert.equal(actionOf({ key: 'L', code: 'KeyL' }), loop);
  assert.equal(actionOf({ key: 'д', code: 'KeyL' }), loop);
  assert.deepEqual(flightOf({ key: 'z', code: 'KeyW' }), [0, 0, 1]); // AZERTY
  assert.equal(flightOf({ key: ',', code: 'KeyW' }), null); // Dvorak: slower
  assert.deepEqual(flightOf({ key: 'w', code: 'Comma' }), [0, 0, 1]);
});

test('keys that move the view do nothing where hands may not, and all others work', () => {
  const letters = 'rnbx'.split('');
  for (const key of KEY_BINDINGS.flatMap(({ actions }) => Object.keys(actions))) {
    assert.equal(actionOf({ key, code: '' }, false), letters.includes(key) ? null : actionOf({ key, code: '' }), key);
  }
});

test('every kind of error is a sentence', () => {
  const codes = [
    ...['foreign', 'draft', 'newer', 'cut-off', 'damaged', 'invalid', 'budget', 'not-found', 'blocked', 'replaced'],
    ...['empty', 'network', 'worker', 'no-webgl', 'graphics'],
  ] as const;
  const messages = codes.map((code) => {
    const error = playerErrorOf(new KpcError('detail', code), 'https://a.example/b.kpc', 'https://c.example');
    assert.equal(error.code, code);
    return error.message;
  });
  for (const message of messages) assert.match(message, /^[A-Z].*([.]|: https:\/\/c.example)$/s);
  assert.ok(new Set(messages).size >= codes.length - 1);
  assert.match(
    playerErrorOf(new KpcError('x', 'blocked'), 'https://a.example/b', 'o').message,
    /^The server a\.example .*Access-Control/,
  );
  const messageOf = (code: 'blocked' | 'not-found', src: string) =>
    playerErrorOf(new KpcError('x', code), src, 'https://c.example').message;
  assert.match(messageOf('blocked', 'https://c.example/a.kpc'), /^The address leads to another server, which does/);
  assert.match(messageOf('blocked', 'file:///home/a.kpc'), /^A page cannot read files of a disk\..*\.$/);
  assert.match(messageOf('not-found', 'ftp://a.example/b.kpc'), /^A page cannot fetch .* "ftp:"\..*\.$/);
  assert.match(messageOf('not-found', 'http://['), /^There is no such file/);
  const answered = (status: string) =>
    playerErrorOf(new KpcError(`b.kpc: the server answers ${status}; check the address`, 'network'), '', '').message;
  assert.match(answered('403 Forbidden'), /^The server does not permit everyone .*\(403\)\.$/);
  assert.match(answered('500'), /^The server does not send .* 500\. Try again later\.$/);
  assert.equal(playerErrorOf('odd', '', '').code, 'unknown');
});

test('times are minutes and seconds', () => {
  assert.equal(clockText(61.26), '1:01');
  assert.equal(clockText(0.3, true), '0:00.3');
  assert.equal(clockText(2.4166, true), '0:02.4');
});

test('a clip begins by its link, by what is set, or where it was left', () => {
  const beginning = new Beginning();
  const link = { time: 1.5, camera: 'left' };
  beginning.time = 0.25;
  assert.deepEqual(beginning.take('a.kpc', link), { ...link, wasPlaying: null });
  assert.deepEqual(beginning.take('b.kpc', link), { time: null, camera: null, wasPlaying: null });
  beginning.leave(2, '1 2 3 0 0 0', true);
  assert.equal(beginning.known, 2);
  assert.deepEqual(beginning.take('a.kpc', link), { time: 2, camera: '1 2 3 0 0 0', wasPlaying: true });
  beginning.leave(2, '1 2 3 0 0 0', true);
  beginning.time = 0.5;
  assert.deepEqual(beginning.take('a.kpc', link), { time: 0.5, camera: '1 2 3 0 0 0', wasPlaying: true });
  beginning.leave(2, '1 2 3 0 0 0', false);
  beginning.forget();
  assert.deepEqual(beginning.take('c.kpc', null), { time: null, camera: null, wasPlaying: null });
});
