/** How a camera of three.js sees an object. */

import { type Camera, Matrix4, type Object3D, Quaternion, SRGBColorSpace, Vector3, type WebGLRenderer } from 'three';
import { type Camera as KpcCamera, type Projection, pinholeOf } from '../index.js';

/** From [-1, 1] to shares of the picture's size, and depths likewise. */
const TO_SHARES = new Matrix4().set(0.5, 0, 0, 0.5, 0, 0.5, 0, 0.5, 0, 0, 0.5, 0.5, 0, 0, 0, 1);
const TO_SHARES_REVERSED = new Matrix4().set(0.5, 0, 0, 0.5, 0, 0.5, 0, 0.5, 0, 0, 1, 0, 0, 0, 0, 1);
/** An eye so many sizes of the object away stands for one that is infinitely far. */
const FAR = 1000;

/** Return the camera, in the space of the object, and how depths are to be taken; sizes in pixels. */
export function seenFrom(
  object: Object3D & { box: { min: Vector3; max: Vector3 } },
  camera: Camera,
  renderer: WebGLRenderer,
  width: number,
  height: number,
): { camera: KpcCamera; projection: Projection } {
  const toEye = new Matrix4().multiplyMatrices(camera.matrixWorldInverse, object.matrixWorld);
  const isReversed = camera.reversedDepth;
  const projection = new Matrix4()
    .multiplyMatrices(isReversed ? TO_SHARES_REVERSED : TO_SHARES, camera.projectionMatrix)
    .multiply(toEye);
  const { focal, centre, eye } = lensOf(camera, object, toEye, width, height);
  const [turn, scale] = [new Quaternion(), new Vector3()];
  const fromEye = toEye.clone().invert();
  fromEye.decompose(new Vector3(), turn, scale);
  eye.applyMatrix4(fromEye);
  const axes = new Matrix4().makeRotationFromQuaternion(turn).setPosition(eye).elements;
  const target = renderer.getRenderTarget();
  return {
    camera: {
      width,
      height,
      focal,
      centre,
      pose: [0, 1, 2].flatMap((row) => [0, 4, 8, 12].map((at) => axes[at + row])),
    },
    projection: {
      projection: projection.elements,
      unprojection: projection.clone().invert().elements,
      eye: eye.toArray(),
      isReversed,
      isLinear: target === null ? renderer.outputColorSpace !== SRGBColorSpace : !isForScreen(target),
    },
  };
}

/** Whether what is drawn into a target is shown as it is: headsets have such ones. */
const isForScreen = (target: { texture: { colorSpace: string } }): boolean =>
  'isXRRenderTarget' in target && target.texture.colorSpace === SRGBColorSpace;

/** Return the lens in pixels, and the eye in the space of the camera. */
function lensOf(
  { projectionMatrix: { elements: p } }: Camera,
  { box }: { box: { min: Vector3; max: Vector3 } },
  toEye: Matrix4,
  width: number,
  height: number,
) {
  if (p[15] === 0) return { ...pinholeOf(p, width, height), eye: new Vector3() };
  const { focal } = pinholeOf(p, width, height);
  const middle = box.min.clone().add(box.max).multiplyScalar(0.5).applyMatrix4(toEye);
  const distance = FAR * box.min.distanceTo(box.max) * toEye.getMaxScaleOnAxis();
  return {
    focal: focal.map((length) => distance * length),
    centre: [width / 2, height / 2],
    eye: new Vector3(-p[12] / p[0], -p[13] / p[5], middle.z + distance),
  };
}
