/**
 * The script of a worker. The page first sends the compiled core and the memory that a call may take; the worker
 * answers `ready`. Then it does one task after another.
 */

import { KpcError } from '../container/errors.js';
import { Core } from './core.js';
import { perform, type Task } from './tasks.js';

export interface Start {
  module: WebAssembly.Module;
  memoryLimit: number;
}
export interface Request {
  id: number;
  task: Task;
}
export interface Failure {
  name: string;
  code: string;
  message: string;
}
export type Answer = { ready: true } | { id: number; result: unknown } | { id: number; failure: Failure };

/** An instance whose memory has grown beyond this is not kept: WebAssembly gives no memory back. */
const KEPT_BYTES = 32 << 20;

const scope = globalThis as unknown as {
  onmessage: (event: { data: Start | Request }) => void;
  postMessage(message: Answer, moved?: Transferable[]): void;
};
let start: Start;
let core: Core;

scope.onmessage = ({ data }) => {
  if ('module' in data) {
    start = data;
    core = new Core(start.module, start.memoryLimit);
    scope.postMessage({ ready: true });
    return;
  }
  try {
    const { result, moved } = perform(core, data.task);
    scope.postMessage({ id: data.id, result }, moved);
  } catch (error) {
    scope.postMessage({ id: data.id, failure: described(error) });
  }
  if (core.memoryBytes > KEPT_BYTES) core = new Core(start.module, start.memoryLimit);
};

function described(error: unknown): Failure {
  if (error instanceof KpcError) return { name: error.name, code: error.code, message: error.message };
  const isMemory = error instanceof RangeError; // of a typed array, or of the module's memory
  return { name: 'Error', code: isMemory ? 'budget' : 'worker', message: String(error) };
}
