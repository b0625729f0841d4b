/** What a clip hands to a graphics card. */

import assert from 'node:assert/strict';
import { test } from 'node:test';
import { ClipScenes } from '../src/element/clip_scenes.js';
import type { DrawnScene } from '../src/render/drawn_scene.js';
import type { Renderer } from '../src/render/renderer.js';
import type { Clip } from '../src/streaming/clip.js';

test('frames go on until the card has answered and all that has arrived is taken', () => {
  const source = { version: 0 };
  let [isAsked, pieces] = [true, 2];
  const renderer = {
    addScene: () =>
      ({
        get version() {
          return source.version;
        },
      }) as DrawnScene,
    upload: () => {
      if (!isAsked && pieces > 0) [pieces, source.version] = [pieces - 1, source.version + 1];
      return !isAsked;
    },
  } as unknown as Renderer;
  const scenes = new ClipScenes(renderer);
  const clip = { scenes: [source] } as unknown as Clip;
  assert.equal(scenes.take(clip), true); // nothing is taken yet
  isAsked = false;
  assert.deepEqual([scenes.take(clip), scenes.take(clip), scenes.take(clip)], [true, true, false]);
  assert.equal(pieces, 0);
});
