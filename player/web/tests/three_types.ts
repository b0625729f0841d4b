/** What TypeScript must accept of a clip in three.js, and what not; tsc reads this, and nothing runs it. */

import { Scene } from 'three';
import { KpcObject } from '../src/three/index.js';

const clip = new KpcObject('scene.kpc');
for (const type of ['loadedmetadata', 'canplay', 'error', 'ended', 'added'] as const) {
  clip.addEventListener(type, (event) => console.log(event.type, event.target));
}
// @ts-expect-error: there is no such event
clip.addEventListener('loaded', () => {});
new Scene().add(clip);
