/** Workers of browsers. Tests under node give the pool others. */

import workerText from './worker.ts?text';

/** What the pool needs of a worker. */
export interface WorkerPort {
  post(message: unknown, moved: Transferable[]): void;
  terminate(): void;
}

export interface WorkerListener {
  message(data: unknown): void;
  /** The worker has failed; `reason` may be empty. */
  failed(reason: string): void;
}

export type Spawn = (listener: WorkerListener) => WorkerPort;

/** Start a worker whose script lies at an address of the page's own site. */
export const spawnFrom =
  (address: string | URL): Spawn =>
  (listener) => {
    const worker = new Worker(address);
    worker.onmessage = (event) => listener.message(event.data);
    worker.onerror = (event) => listener.failed(event.message ?? '');
    worker.onmessageerror = () => listener.failed('its answer could not be read');
    return { post: (message, moved) => worker.postMessage(message, moved), terminate: () => worker.terminate() };
  };

/** Start a worker whose script comes with this module. */
export const spawnInline: Spawn = (listener) => {
  const address = URL.createObjectURL(new Blob([workerText], { type: 'text/javascript' }));
  try {
    return spawnFrom(address)(listener);
  } finally {
    // The worker has its script once it has been constructed, but some browsers fetch it a little later.
    setTimeout(() => URL.revokeObjectURL(address), 10_000);
  }
};
