/** The decoder core as a module, built from the sources in format/core. */

import bytes from '../../../../format/core/kpc_core.wasm';
import { Core } from './core.js';

let compiled: Promise<WebAssembly.Module> | null = null;

/** Return the module; browsers compile it beside the page's main thread. */
export function coreModule(): Promise<WebAssembly.Module> {
  compiled ??= WebAssembly.compile(bytes);
  return compiled;
}

/** Return an instance of the decoder core, of whose calls each may take `memoryLimit` bytes. */
export async function loadCore(memoryLimit?: number): Promise<Core> {
  return new Core(await coreModule(), memoryLimit);
}
