/** Clips that play in tests. */

import { type ErrorCode, KpcError } from '../src/container/errors.js';
import { Clip, type ClipOptions } from '../src/streaming/clip.js';
import type { SceneStream } from '../src/streaming/scene_stream.js';
import type { TexelRows } from '../src/streaming/texel_queue.js';
import { spawnNode } from './node_worker.js';

/** Return what says whether an error has a code, and words in its message. */
export const hasCode =
  (code: ErrorCode, words = '') =>
  (error: unknown) =>
    error instanceof KpcError && error.code === code && error.message.includes(words);

/** Run a test with a clip, and close it. */
export async function withClip(
  src: string | Blob | ArrayBuffer,
  options: ClipOptions,
  body: (clip: Clip) => Promise<void>,
): Promise<void> {
  const pool = { size: 2, spawn: spawnNode, ...options.pool };
  const clip = await Clip.open(src, { firstPauseMs: 5, ...options, pool });
  try {
    await body(clip);
  } finally {
    clip.close();
  }
}

/** Wait until something holds, looking again whenever something has arrived; take all texels meanwhile. */
export async function until(
  clip: Clip,
  holds: () => unknown,
  taken: (scene: SceneStream, rows: TexelRows) => void = () => {},
) {
  for (;;) {
    for (const one of clip.scenes) for (const rows of one.take(Number.POSITIVE_INFINITY)) taken(one, rows);
    if (holds()) return;
    if (clip.error) throw clip.error;
    await new Promise<void>((resolve) => {
      const wake = () => {
        clip.removeEventListener('arrived', wake);
        clearTimeout(timer);
        resolve();
      };
      const timer = setTimeout(wake, 20);
      clip.addEventListener('arrived', wake);
    });
  }
}
