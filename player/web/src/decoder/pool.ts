/** A pool of workers that decode in parallel, within a limit of memory and a deadline. */

import { BudgetError, type ErrorCode, FormatError, KpcError } from '../container/errors.js';
import { Endings } from './aborting.js';
import { coreModule } from './module.js';
import { type Spawn, spawnFrom, spawnInline, type WorkerPort } from './spawn.js';
import type { Result, Task } from './tasks.js';
import type { Answer, Failure } from './worker.js';

export interface PoolOptions {
  /** Workers; a phone or a laptop keeps one core for the page. */
  size?: number;
  /** Bytes that all tasks that run at once may take; a task that takes more runs alone, up to this limit. */
  memory?: number;
  /** Where the worker's script lies, for pages whose Content-Security-Policy forbids workers from blobs. */
  workerUrl?: string | URL;
  /** How workers are started, instead. */
  spawn?: Spawn;
  /** Milliseconds that a task may take, and milliseconds for each number that it decodes. */
  deadlineMs?: number;
  deadlineMsPerNumber?: number;
}

export interface RunOptions {
  /** Numbers that the task decodes: a measure of its time and memory. */
  numbers?: number;
  /** Tasks of a lower number are done before those of a higher one that wait, too. */
  rank?: number;
  /** Ends the wait for a task; one that has not begun is not done. */
  signal?: AbortSignal;
  /** Buffers of the task that are moved to the worker. */
  moved?: Transferable[];
}

/** Milliseconds that a worker may take to start, on a machine that is busy, too. */
const STARTING_MS = 20_000;
/** Bytes that a task takes for each number: symbols in the core and outside, values, and texels. */
const BYTES_PER_NUMBER = 5;

interface Job {
  id: number;
  task: Task;
  moved: Transferable[];
  numbers: number;
  rank: number;
  resolve(result: unknown): void;
  reject(error: unknown): void;
}

interface Slot {
  port: WorkerPort | null;
  state: 'none' | 'starting' | 'ready';
  job: Job | null;
  timer: ReturnType<typeof setTimeout> | undefined;
}

const defaultSize = (): number => Math.max(1, Math.min(4, (globalThis.navigator?.hardwareConcurrency ?? 2) - 1));

export class DecoderPool {
  readonly #options: PoolOptions;
  readonly #memory: number;
  readonly #slots: Slot[];
  readonly #endings = new Endings();
  #queue: Job[] = [];
  #spawn: Spawn;
  #fallback: Spawn | null;
  #lastId = 0;
  #isClosed = false;

  constructor(options: PoolOptions = {}) {
    const { size = defaultSize(), memory = 2 ** 28, workerUrl, spawn } = options;
    this.#options = options;
    this.#memory = memory;
    this.#slots = Array.from({ length: size }, () => ({ port: null, state: 'none', job: null, timer: undefined }));
    this.#spawn = spawn ?? (workerUrl ? spawnFrom(workerUrl) : spawnInline);
    // Beside the module of a site that forbids blobs lies the worker, if all of dist/ has been copied there.
    this.#fallback = spawn || workerUrl ? null : spawnSibling;
  }

  /** Bytes that all tasks that run at once may take. */
  get memory(): number {
    return this.#memory;
  }

  /** Start a worker for a task that will come. */
  warm(): void {
    const [slot] = this.#slots;
    if (slot.state === 'none' && !this.#isClosed) this.#start(slot);
  }

  /** Tasks that wait or run. */
  get pending(): number {
    return this.#queue.length + this.#slots.filter((slot) => slot.job).length;
  }

  /**
   * Do a task in a worker.
   *
   * Throws a FormatError for what is wrong with its data, a BudgetError if it takes more than the pool's memory, and a
   * KpcError if there is no worker, the worker breaks down or takes longer than the deadline, or `signal` aborts.
   */
  run<T extends Task>(task: T, { numbers = 0, rank = 0, signal, moved = [] }: RunOptions = {}): Promise<Result<T>> {
    return new Promise((resolve, reject) => {
      if (this.#isClosed || signal?.aborted) return reject(new KpcError('decoding was ended', 'aborted'));
      if (numbers * BYTES_PER_NUMBER > this.#memory) {
        return reject(new BudgetError('decoding takes more memory than the budget allows'));
      }
      const job: Job = { id: ++this.#lastId, task, moved, numbers, rank, resolve: resolve as Job['resolve'], reject };
      const abort = () => {
        this.#queue = this.#queue.filter((waiting) => waiting !== job);
        reject(new KpcError('decoding was ended', 'aborted'));
      };
      const settled = signal ? this.#endings.add(signal, abort) : () => {};
      job.resolve = (result) => {
        settled();
        resolve(result as Result<T>);
      };
      job.reject = (error) => {
        settled();
        reject(error);
      };
      const behind = this.#queue.findIndex((waiting) => waiting.rank > rank);
      this.#queue.splice(behind < 0 ? this.#queue.length : behind, 0, job);
      this.#pump();
    });
  }

  /** End all workers; what waits or runs is rejected. */
  close(): void {
    this.#isClosed = true;
    const jobs = [...this.#queue, ...this.#slots.map((slot) => slot.job)];
    this.#queue = [];
    for (const slot of this.#slots) this.#end(slot);
    for (const job of jobs) job?.reject(new KpcError('decoding was ended', 'aborted'));
  }

  /** Give waiting jobs to idle workers, as far as the memory allows, and start workers if there are too few. */
  #pump(): void {
    for (const slot of this.#slots) {
      const job = this.#queue[0];
      if (job === undefined) return;
      if (slot.state !== 'ready' || slot.job !== null) continue;
      const used = this.#slots.reduce((sum, other) => sum + (other.job ? other.job.numbers * BYTES_PER_NUMBER : 0), 0);
      if (used > 0 && used + job.numbers * BYTES_PER_NUMBER > this.#memory) return;
      this.#queue.shift();
      slot.job = job;
      this.#send(slot, job);
    }
    let missing = this.#queue.length - this.#slots.filter((slot) => slot.state === 'starting').length;
    for (const slot of this.#slots) if (slot.state === 'none' && missing-- > 0) this.#start(slot);
  }

  async #start(slot: Slot): Promise<void> {
    slot.state = 'starting';
    try {
      const module = await coreModule();
      if (this.#isClosed) return;
      const port = this.#spawn({
        message: (data) => this.#receive(slot, port, data as Answer),
        failed: (reason) => this.#lost(slot, port, reason),
      });
      slot.port = port;
      this.#arm(slot, STARTING_MS, () => this.#lost(slot, port, 'it does not start'));
      port.post({ module, memoryLimit: this.#memory }, []);
    } catch (error) {
      this.#lost(slot, slot.port, String(error));
    }
  }

  #send(slot: Slot, job: Job): void {
    const { deadlineMs = 20_000, deadlineMsPerNumber = 0.01 } = this.#options;
    const limit = deadlineMs + deadlineMsPerNumber * job.numbers;
    this.#arm(slot, limit, () => {
      this.#end(slot);
      const what = 'number' in job.task ? `chunk ${job.task.number}` : 'the scene';
      this.#finish(slot)?.reject(new FormatError(`${what} takes longer than ${limit / 1000} s to decode`));
    });
    try {
      slot.port?.post({ id: job.id, task: job.task }, job.moved);
    } catch (error) {
      this.#finish(slot)?.reject(error); // the task cannot be copied
    }
  }

  #receive(slot: Slot, port: WorkerPort, answer: Answer): void {
    if (slot.port !== port) return;
    if ('ready' in answer) {
      clearTimeout(slot.timer);
      slot.state = 'ready';
      this.#pump();
    } else if (slot.job?.id === answer.id) {
      const job = this.#finish(slot);
      if ('failure' in answer) job?.reject(rebuilt(answer.failure));
      else job?.resolve(answer.result);
    }
  }

  /** Free a worker for the next job; return the one it had. */
  #finish(slot: Slot): Job | null {
    const { job } = slot;
    clearTimeout(slot.timer);
    slot.job = null;
    queueMicrotask(() => this.#pump());
    return job;
  }

  /** Call a function when a worker takes longer for something than `limit` milliseconds. */
  #arm(slot: Slot, limit: number, late: () => void): void {
    const due = performance.now() + limit;
    clearTimeout(slot.timer);
    slot.timer = setTimeout(() => {
      // A timer that is late shows that the page was suspended, and the worker with it.
      if (performance.now() > due + 1000) this.#arm(slot, limit, late);
      else late();
    }, limit);
  }

  /** Let go of a worker that has broken down; if it has not even started, start it in another way. */
  #lost(slot: Slot, port: WorkerPort | null, reason: string): void {
    if (slot.port !== port || this.#isClosed) return;
    const hasStarted = slot.state === 'ready';
    this.#end(slot);
    if (hasStarted) {
      this.#finish(slot)?.reject(new KpcError(`the decoder broke down (${reason || 'no reason given'})`, 'worker'));
      return;
    }
    if (this.#fallback) {
      this.#spawn = this.#fallback;
      this.#fallback = null;
      this.#start(slot);
      return;
    }
    if (this.#slots.some((other) => other.state !== 'none')) return;
    const advice =
      "the page's Content-Security-Policy must allow worker-src blob: and script-src 'wasm-unsafe-eval', " +
      'and Trusted Types, if it demands them, need a default policy that lets scripts of workers pass';
    const jobs = this.#queue;
    this.#queue = [];
    for (const job of jobs) {
      job.reject(new KpcError(`the decoder cannot run (${reason || 'no reason given'}); ${advice}`, 'worker'));
    }
  }

  #end(slot: Slot): void {
    clearTimeout(slot.timer);
    slot.port?.terminate();
    slot.port = null;
    slot.state = 'none';
  }
}

const spawnSibling: Spawn = (listener) => spawnFrom(new URL('kpc-worker.js', import.meta.url))(listener);

function rebuilt({ name, code, message }: Failure): KpcError {
  if (name === 'BudgetError' || code === 'budget') return new BudgetError(message);
  return name === 'FormatError'
    ? new FormatError(message, code as ErrorCode)
    : new KpcError(message, code as ErrorCode);
}
