/** Files on web servers with faults. */

import assert from 'node:assert/strict';
import test from 'node:test';

import { type ErrorCode, KpcError } from '../src/container/errors.js';
import { type HttpOptions, HttpSource } from '../src/streaming/http.js';
import { withServer } from './server.js';

const BYTES = Uint8Array.from({ length: 200_000 }, (_, k) => (k * 2654435761) >>> 24);
const FAST: HttpOptions = { firstPauseMs: 5 };

const hasCode =
  (code: ErrorCode, words = '') =>
  (error: unknown) =>
    error instanceof KpcError && error.code === code && error.message.includes(words);

/** Read a part of the file behind its beginning, and compare it. */
async function works(source: HttpSource, start = 100_000, end = 150_000): Promise<void> {
  let before = 0;
  const arrived = (bytes: Uint8Array) => {
    assert.ok(bytes.length >= before);
    assert.deepEqual(bytes, BYTES.subarray(start, start + bytes.length));
    before = bytes.length;
  };
  assert.deepEqual(Buffer.from(await source.read(start, end, { arrived })), Buffer.from(BYTES.subarray(start, end)));
  assert.equal(before, end - start);
}

test('asks for the beginning, then for ranges', async () => {
  await withServer(BYTES, {}, async (server) => {
    const source = await HttpSource.open(server.url, FAST);
    assert.equal(source.size, BYTES.length);
    assert.ok(source.hasRanges);
    await works(source);
    await works(source, 10, 20);
    await works(source, 60_000, 80_000);
    assert.deepEqual(server.requests, ['0-65535', '100000-149999', '65536-79999']);
    assert.deepEqual(await source.read(199_990, 300_000), BYTES.subarray(199_990));
    source.close();
  });
});

test('does without Content-Range, which other sites may not see', async () => {
  await withServer(BYTES.subarray(0, 1000), { saysRange: false }, async (server) => {
    const source = await HttpSource.open(server.url, FAST);
    assert.equal(source.size, 1000);
    source.close();
  });
  await withServer(BYTES, { saysRange: false }, async (server) => {
    const source = await HttpSource.open(server.url, FAST);
    assert.equal(source.size, null);
    await works(source);
    assert.deepEqual(await source.read(199_990, 300_000), BYTES.subarray(199_990));
    assert.equal(source.size, BYTES.length);
    source.close();
  });
});

test('asks for the rest of what is shorter than was asked for, before the file counts as cut off', async () => {
  for (const saysRange of [true, false]) {
    await withServer(BYTES, { saysRange, most: 30_000 }, async (server) => {
      const source = await HttpSource.open(server.url, FAST);
      await works(source);
      assert.equal((await source.read(190_000, 300_000)).length, 10_000);
      assert.equal(source.size, BYTES.length);
      source.close();
    });
  }
  // Other sites may refuse what lies behind the end in a way that a page cannot see.
  for (const refusal of [() => Promise.reject(new TypeError('Failed to fetch')), async () => Response.error()]) {
    await withServer(BYTES.subarray(0, 1000), { saysRange: false }, async (server) => {
      const fetching = async (input: RequestInfo | URL, init?: RequestInit) => {
        const response = await fetch(input, init);
        return response.status === 416 ? refusal() : response;
      };
      const source = await HttpSource.open(server.url, { ...FAST, fetch: fetching as typeof fetch });
      assert.deepEqual([source.size, server.requests], [1000, ['0-65535', '1000-65535']]);
      source.close();
    });
  }
});

for (const [name, faults] of Object.entries({
  'has no ranges': { hasRanges: false },
  'has no ranges and says no length': { hasRanges: false, saysLength: false },
  compresses: { hasRanges: false, isCompressed: true },
})) {
  test(`keeps the whole file of a server that ${name}`, async () => {
    await withServer(BYTES, faults, async (server) => {
      const source = await HttpSource.open(server.url, FAST);
      await Promise.all([works(source), works(source, 150_000, 200_000)]);
      assert.ok(!source.hasRanges);
      assert.equal(server.requests.length, 1);
      assert.equal((await source.read(0, 300_000)).length, BYTES.length);
      assert.equal(source.size, BYTES.length);
      source.close();
      await assert.rejects(HttpSource.open(server.url, { ...FAST, limit: 10_000 }), hasCode('budget'));
    });
  });
}

test('resumes a connection that breaks off behind the last byte', async () => {
  await withServer(BYTES, { cuts: [10_000, 30_000] }, async (server) => {
    const source = await HttpSource.open(server.url, FAST);
    const messages: (string | null)[] = [];
    source.report = (message) => messages.push(message);
    server.cuts = [20_000, 0, 5000];
    await works(source);
    assert.equal(messages.at(-1), null);
    assert.ok(messages.some((message) => message?.includes('trying again')));
    assert.equal(server.requests[1], '10000-65535');
    assert.ok(server.requests.includes('120000-149999'));
    source.close();
  });
});

test('resumes a whole file', async () => {
  await withServer(BYTES, { hasRanges: false, cuts: [10_000, 90_000] }, async (server) => {
    const source = await HttpSource.open(server.url, FAST);
    await works(source);
    assert.equal(server.requests.length, 3);
    source.close();
  });
});

test('asks again after failures that pass, and gives up in the end', async () => {
  await withServer(BYTES, { statuses: [503, 429] }, async (server) => {
    const source = await HttpSource.open(server.url, FAST);
    server.statuses = [500, 502, 504, 408, 425];
    await assert.rejects(source.read(100_000, 150_000), hasCode('network', 'answers 425'));
    source.attempts = Number.POSITIVE_INFINITY;
    server.statuses = [500, 502, 504, 408, 425, 503];
    await works(source);
    source.close();
  });
  await withServer(BYTES, { hangs: 1 }, async (server) => {
    const source = await HttpSource.open(server.url, { ...FAST, timeoutMs: 300 });
    assert.ok(server.requests.length > 1);
    source.close();
    server.close();
    await assert.rejects(HttpSource.open(server.url, FAST), hasCode('network'));
  });
});

test('says what the server answers in place of the file', async () => {
  await withServer(BYTES, {}, async (server) => {
    await assert.rejects(HttpSource.open(server.url.replace('scene', 'other'), FAST), hasCode('not-found', '404'));
    server.statuses = [403];
    await assert.rejects(HttpSource.open(server.url, FAST), hasCode('network', '403'));
    assert.equal(server.requests.length, 1);
    server.bytes = new Uint8Array(0);
    await assert.rejects(HttpSource.open(server.url, FAST), hasCode('empty', 'is empty'));
    server.hasRanges = false;
    await assert.rejects(HttpSource.open(server.url, FAST), hasCode('empty', 'is empty'));
  });
});

test('names the file without what may be secret', async () => {
  await withServer(BYTES, { statuses: [400] }, async (server) => {
    const url = server.url.replace('http://', 'http://user:password@').concat('?key=secret#here');
    const fetching = (input: RequestInfo | URL, init?: RequestInit) =>
      fetch(String(input).replace('user:password@', ''), init);
    await assert.rejects(HttpSource.open(url.replace('?', '?'), { ...FAST, fetch: fetching }), (error: Error) => {
      assert.ok(error.message.startsWith('http://127.0.0.1:'), error.message);
      assert.ok(!/password|secret/.test(error.message));
      return true;
    });
  });
});

test('follows a redirection, and goes back when its target is gone', async () => {
  await withServer(BYTES, { redirects: 2 }, async (server) => {
    const source = await HttpSource.open(server.url.replace('scene.kpc', 'moved'), FAST);
    await works(source);
    assert.equal(server.redirects, 1);
    server.statuses = [404];
    await works(source, 110_000, 120_000);
    assert.equal(server.redirects, 0);
    server.statuses = [404];
    await assert.rejects(source.read(120_000, 130_000), hasCode('not-found', '410'));
    source.close();
  });
});

test('notices that the file was replaced', async () => {
  const other = BYTES.map((byte) => byte ^ 1);
  await withServer(BYTES, {}, async (server) => {
    const source = await HttpSource.open(server.url, FAST);
    server.etag = '"second"'; // of another node, with the same file
    await works(source);
    source.close();
  });
  await withServer(BYTES, {}, async (server) => {
    const source = await HttpSource.open(server.url, FAST);
    Object.assign(server, { bytes: other, etag: '"second"' });
    await assert.rejects(source.read(100_000, 150_000), hasCode('replaced'));
    source.close();
  });
  await withServer(BYTES, { etag: null }, async (server) => {
    const source = await HttpSource.open(server.url, FAST);
    server.bytes = BYTES.subarray(0, 150_000);
    await assert.rejects(source.read(100_000, 120_000), hasCode('replaced'));
    await assert.rejects(source.read(160_000, 170_000), hasCode('replaced'));
    source.close();
  });
  await withServer(BYTES, { etag: null, saysRange: false }, async (server) => {
    const source = await HttpSource.open(server.url, FAST);
    await source.read(100_000, 150_000, { fresh: true }); // of which some came damaged
    server.bytes = other;
    await assert.rejects(source.read(100_000, 150_000, { fresh: true }), hasCode('replaced'));
    source.close();
  });
  await withServer(BYTES, { hasRanges: false, cuts: [90_000] }, async (server) => {
    const source = await HttpSource.open(server.url, FAST);
    Object.assign(server, { bytes: other, etag: null });
    await assert.rejects(source.read(100_000, 150_000), hasCode('replaced'));
    source.close();
  });
});

test('asks for the whole file where no range is answered', async () => {
  const global = globalThis as { location?: unknown };
  global.location = { origin: 'https://page.example', href: 'https://page.example/', protocol: 'https:' };
  const rangeless = (failures: number) => (input: RequestInfo | URL, init?: RequestInit) =>
    new Headers(init?.headers).has('Range') && failures-- > 0
      ? Promise.reject(new TypeError('Failed to fetch'))
      : fetch(input, { ...init, mode: 'cors' });
  try {
    await withServer(BYTES, { hasRanges: false, isCompressed: true }, async (server) => {
      const fetching = { ...FAST, fetch: rangeless(Infinity) as typeof fetch };
      const source = await HttpSource.open(server.url, fetching);
      await works(source);
      assert.deepEqual([source.hasRanges, server.requests], [false, ['all']]);
      source.close();
      await assert.rejects(HttpSource.open(server.url, { ...fetching, limit: 10_000 }), hasCode('budget'));
    });
    await withServer(BYTES, {}, async (server) => {
      const source = await HttpSource.open(server.url, { ...FAST, fetch: rangeless(1) as typeof fetch });
      assert.equal(source.hasRanges, true); // one failure is one of the connection
      source.close();
    });
  } finally {
    delete global.location;
  }
});

test('says that another site does not permit the page to read', async () => {
  const global = globalThis as { location?: unknown };
  global.location = { origin: 'https://page.example', href: 'https://page.example/', protocol: 'https:' };
  let isOpaque = false;
  const refusing = (answers: boolean) => (_: unknown, init?: RequestInit) =>
    init?.mode === 'no-cors' && answers
      ? Promise.resolve(Object.defineProperty(new Response(null), 'type', { value: isOpaque ? 'opaque' : 'basic' }))
      : Promise.reject(new TypeError('Failed to fetch'));
  try {
    const open = (url: string, answers: boolean) =>
      HttpSource.open(url, { ...FAST, fetch: refusing(answers) as typeof fetch });
    const header = 'Access-Control-Allow-Origin: https://page.example';
    await assert.rejects(open('https://files.example/scene.kpc', true), hasCode('blocked', header));
    await assert.rejects(open('http://files.example/scene.kpc', false), hasCode('blocked', 'https'));
    await assert.rejects(open('https://files.example/scene.kpc', false), hasCode('network'));
    await assert.rejects(open('https://page.example/scene.kpc', true), hasCode('network'));
    isOpaque = true; // as after a redirection to another site
    await assert.rejects(open('https://page.example/scene.kpc', true), hasCode('blocked', 'its address leads to'));
    for (const odd of ['ftp://files.example/scene.kpc', 'about:blank', 'javascript:0', 'c:\\scene.kpc']) {
      await assert.rejects(open(odd, false), hasCode('not-found', 'cannot fetch such addresses'));
    }
    global.location = { origin: 'app://page', href: 'app://page/', protocol: 'app:' };
    await assert.rejects(open('app://page/scene.kpc', false), hasCode('network'));
    global.location = { origin: 'null', href: 'file:///page.html', protocol: 'file:' };
    await assert.rejects(open('file:///scene.kpc', true), hasCode('blocked', 'kpplay --web'));
  } finally {
    delete global.location;
  }
});

test('ends a read when it is not wanted any more, and all of them when it is closed', async () => {
  await withServer(BYTES, {}, async (server) => {
    const source = await HttpSource.open(server.url, FAST);
    server.rate = 20_000;
    const control = new AbortController();
    const first = source.read(100_000, 150_000, { signal: control.signal, arrived: () => control.abort() });
    await assert.rejects(first, hasCode('aborted'));
    const second = source.read(100_000, 150_000, { arrived: () => source.close() });
    await assert.rejects(second, hasCode('aborted'));
    await assert.rejects(HttpSource.open(server.url, { ...FAST, signal: control.signal }), hasCode('aborted'));
  });
});
