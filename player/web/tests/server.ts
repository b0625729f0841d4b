/** A web server for tests, with faults. */

import { createServer, type IncomingMessage, type Server, type ServerResponse } from 'node:http';
import type { AddressInfo } from 'node:net';
import { gzipSync } from 'node:zlib';

export interface Faults {
  /** Whether it answers range requests. */
  hasRanges: boolean;
  isCompressed: boolean;
  /** Null: it sends none. */
  etag: string | null;
  /** Whether Content-Range is sent, which other sites may not see. */
  saysRange: boolean;
  /** Bytes of an answer at most. */
  most: number;
  /** Whether it says how long an answer is. */
  saysLength: boolean;
  /** Statuses of the next answers. */
  statuses: number[];
  /** Bytes after which the next answers break off. */
  cuts: number[];
  /** Answers that never end, or never begin. */
  hangs: number;
  /** How often `/moved` leads to the file before it is gone. */
  redirects: number;
  /** Bytes a second, and bytes in all until it is raised. */
  rate: number;
  allowed: number;
}

export interface TestServer extends Faults {
  url: string;
  bytes: Uint8Array;
  /** The ranges that were asked for, `a-b`, or `all`. */
  requests: string[];
  close(): void;
}

const NONE: Faults = {
  hasRanges: true,
  isCompressed: false,
  etag: '"first"',
  saysRange: true,
  most: Number.POSITIVE_INFINITY,
  saysLength: true,
  statuses: [],
  cuts: [],
  hangs: 0,
  redirects: 0,
  rate: Number.POSITIVE_INFINITY,
  allowed: Number.POSITIVE_INFINITY,
};

/** Serve bytes until the test ends. */
export async function serve(bytes: Uint8Array, faults: Partial<Faults> = {}): Promise<TestServer> {
  let server: Server;
  const state: TestServer = {
    ...NONE,
    ...faults,
    bytes,
    requests: [],
    url: '',
    close: () => {
      server.closeAllConnections();
      server.close();
    },
  };
  server = createServer((request, response) => answer(state, request, response));
  await new Promise<void>((resolve) => server.listen(0, '127.0.0.1', resolve));
  state.url = `http://127.0.0.1:${(server.address() as AddressInfo).port}/scene.kpc`;
  return state;
}

function answer(state: TestServer, request: IncomingMessage, response: ServerResponse): void {
  if (request.url === '/moved') {
    if (state.redirects-- <= 0) return void response.writeHead(410).end();
    return void response.writeHead(302, { location: '/scene.kpc' }).end();
  }
  if (request.url !== '/scene.kpc') return void response.writeHead(404).end('no such file');
  const asked = /^bytes=(\d+)-(\d+)$/.exec(request.headers.range ?? '');
  state.requests.push(asked ? `${asked[1]}-${asked[2]}` : 'all');
  if (state.hangs > 0) {
    state.hangs--;
    return;
  }
  const status = state.statuses.shift();
  if (status) return void response.writeHead(status).end();
  const headers: Record<string, string> = state.etag === null ? {} : { etag: state.etag };
  const size = state.bytes.length;
  if (!asked || !state.hasRanges) {
    const body = state.isCompressed ? gzipSync(state.bytes) : state.bytes;
    if (state.isCompressed) headers['content-encoding'] = 'gzip';
    if (state.saysLength) headers['content-length'] = String(body.length);
    response.writeHead(200, headers);
    send(state, response, body);
    return;
  }
  const first = Number(asked[1]);
  const last = Math.min(Number(asked[2]), size - 1, first + state.most - 1);
  if (first >= size) {
    return void response.writeHead(416, state.saysRange ? { 'content-range': `bytes */${size}` } : {}).end();
  }
  if (state.saysRange) headers['content-range'] = `bytes ${first}-${last}/${size}`;
  if (state.saysLength) headers['content-length'] = String(last + 1 - first);
  response.writeHead(206, headers);
  send(state, response, state.bytes.subarray(first, last + 1));
}

function send(state: TestServer, response: ServerResponse, body: Uint8Array): void {
  const cut = state.cuts.shift();
  if (cut !== undefined) {
    response.write(body.subarray(0, cut), () => setTimeout(() => response.destroy(), 20));
  } else if (Math.min(state.rate, state.allowed) < Number.POSITIVE_INFINITY) {
    const drip = (at: number) => {
      if (response.destroyed) return;
      if (at >= body.length) return void response.end();
      const count = Math.min(Math.max(1, Math.round(state.rate / 100)), state.allowed, body.length - at);
      state.allowed -= count;
      if (count > 0) response.write(body.subarray(at, at + count));
      setTimeout(() => drip(at + count), 10);
    };
    drip(0);
  } else response.end(body);
}

/** Run a test with a server, and end it. */
export async function withServer(
  bytes: Uint8Array,
  faults: Partial<Faults>,
  body: (server: TestServer) => Promise<void>,
): Promise<void> {
  const server = await serve(bytes, faults);
  try {
    await body(server);
  } finally {
    server.close();
  }
}
