/** Programs that several scenes use. */

import assert from 'node:assert/strict';
import test from 'node:test';

import type { Compilation, Device } from '../src/render/device.js';
import { uniformBlock } from '../src/render/shader.js';
import { SharedPrograms } from '../src/render/shared_programs.js';

/** A device that compiles nothing, and notes what it is asked for. */
function noting() {
  const done: string[] = [];
  const device = {
    isCompiling: false,
    takesUntil: Number.POSITIVE_INFINITY,
    program: ({ name }: { name: string }) => ({ name }),
    release: ({ name }: { name: string }) => done.push(`release ${name}`),
    abandon: ({ name }: { name: string }) => done.push(`abandon ${name}`),
  };
  const begin = (name: string) => () => {
    done.push(`compile ${name}`);
    return { name } as unknown as Compilation;
  };
  return { device: device as unknown as Device & { isCompiling: boolean }, done, begin };
}

test('scenes of the same shape share a program, which is kept for a while for those to come', () => {
  const { device, done, begin } = noting();
  const [first, second] = [{}, {}];
  const shared = SharedPrograms.on(device);
  assert.ok(shared.isReady(first, 'a', begin('a')));
  const [program, isOthers] = shared.get(first, 'a', begin('a'));
  assert.ok(isOthers);
  assert.deepEqual(SharedPrograms.on(device).get(second, 'a', begin('a')), [program, true]);
  assert.deepEqual(shared.get(second, 'a', begin('a')), [program, false]);
  assert.deepEqual(shared.get(first, 'a', begin('a')), [program, true]);
  shared.release(first);
  assert.deepEqual(done, ['compile a']);
  shared.release(second);
  assert.deepEqual(shared.get(first, 'a', begin('a')), [program, true]); // uniforms may be of another scene
  shared.release(first);
  for (const name of 'bcdefghi') shared.get(second, name, begin(name));
  shared.get(second, 'b', begin('b'));
  shared.release(second);
  assert.deepEqual(done.slice(9), ['release a']); // eight others were needed after it
  shared.dispose();
  assert.deepEqual(
    done.slice(10).sort(),
    [...'bcdefghi'].map((name) => `release ${name}`),
  );
});

test('a program that is being compiled for nobody is given up at the end', () => {
  const { device, done, begin } = noting();
  device.isCompiling = true;
  const shared = SharedPrograms.on(device);
  assert.ok(!shared.isReady(done, 'a', begin('a')));
  shared.release(done);
  assert.deepEqual(done, ['compile a']);
  shared.dispose();
  assert.deepEqual(done, ['compile a', 'abandon a']);
});

test('a uniform block declares arrays, and holds their numbers in the layout std140', () => {
  const { text, numbers } = uniformBlock('Numbers', {
    weights: { kind: 'vec4', values: [1, 2, 3, 4, 5, 6, 7, 8] },
    widths: { kind: 'float', values: [9, 10] },
  });
  assert.equal(text, 'layout(std140) uniform Numbers {\n    vec4 weights[2];\n    float widths[2];\n};\n');
  assert.deepEqual([...numbers], [1, 2, 3, 4, 5, 6, 7, 8, 9, 0, 0, 0, 10, 0, 0, 0]);
});
