/** A page of Spark, a player of splats, for kpc.tools.bench.web_loading; `globalThis.view` says what it shows. */

import { SparkRenderer, SplatMesh } from '@sparkjsdev/spark';
import { Matrix4, PerspectiveCamera, Scene, WebGLRenderer } from 'three';

/** Radius in world units and milliseconds of a turn of the camera, so that there is something to draw. */
const [RADIUS, TURN_MS] = [0.02, 3000];

const { view, firstPicture } = globalThis as unknown as {
  view: { width: number; height: number; angle: number; pose: number[]; src: string };
  firstPicture(): void;
};
const renderer = new WebGLRenderer({ antialias: false });
renderer.setSize(view.width, view.height);
document.body.append(renderer.domElement);
const camera = new PerspectiveCamera(view.angle, view.width / view.height, 0.01, 1000);
const pose = new Matrix4().fromArray(view.pose).transpose();
const scene = new Scene().add(new SparkRenderer({ renderer }), new SplatMesh({ url: view.src }));
const gl = renderer.getContext();
const pixel = new Uint8Array(4);
let isShown = false;
renderer.setAnimationLoop((ms) => {
  const turn = (2 * Math.PI * ms) / TURN_MS;
  const step = new Matrix4().makeTranslation(RADIUS * Math.sin(turn), RADIUS * Math.cos(turn), 0);
  step.premultiply(pose).decompose(camera.position, camera.quaternion, camera.scale);
  renderer.render(scene, camera);
  if (isShown) return;
  gl.readPixels(view.width / 2, view.height / 3, 1, 1, gl.RGBA, gl.UNSIGNED_BYTE, pixel);
  isShown = pixel[0] + pixel[1] + pixel[2] > 0;
  if (isShown) firstPicture();
});
