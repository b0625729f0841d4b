/** The context in which pictures are drawn, and how to have the browser's graphics ready when it is wanted. */

import { KpcError } from '../container/errors.js';

const ATTRIBUTES = {
  alpha: false,
  antialias: false,
  depth: false,
  stencil: false,
  powerPreference: 'high-performance',
};

/** Milliseconds between two questions whether the card is idle. */
const POLL_MS = 4;

/** This browser or card cannot draw a scene; the message says why, for people. */
export class RenderError extends KpcError {
  override name = 'RenderError';

  constructor(message: string, code: 'no-webgl' | 'graphics' | 'budget' = 'graphics') {
    super(message, code);
  }
}

/**
 * Return the WebGL2 of a canvas.
 * @throws RenderError: the browser has none.
 */
export function contextOf(canvas: HTMLCanvasElement | OffscreenCanvas): WebGL2RenderingContext {
  const gl = canvas.getContext('webgl2', ATTRIBUTES as WebGLContextAttributes) as WebGL2RenderingContext | null;
  if (gl === null)
    throw new RenderError('this browser has no WebGL2; update it, or allow it to use the graphics card', 'no-webgl');
  return gl;
}

/** Resolve once the card has done what a context was given; the page goes on meanwhile. */
export async function whenIdle(gl: WebGL2RenderingContext): Promise<void> {
  const fence = gl.fenceSync(gl.SYNC_GPU_COMMANDS_COMPLETE, 0);
  gl.flush();
  while (fence && !gl.isContextLost() && gl.getSyncParameter(fence, gl.SYNC_STATUS) !== gl.SIGNALED)
    await new Promise((resolve) => setTimeout(resolve, POLL_MS));
  gl.deleteSync(fence);
}

/**
 * Make a context and let go of it: the first one of a browser takes long, because drivers are loaded for it, and the
 * page waits for that unless a worker has done it before.
 */
export function loadDriver(): void {
  if (globalThis.OffscreenCanvas === undefined) return;
  const gl = contextOf(new OffscreenCanvas(1, 1));
  gl.getParameter(gl.RENDERER); // waits until the driver is there
  gl.getExtension('WEBGL_lose_context')?.loseContext();
}
