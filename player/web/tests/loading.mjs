/**
 * Loads clips in a page of headless Chromium: `node loading.mjs CHROMIUM FILE < /dev/null`. Writes as JSON what became
 * of each of the pages below, which differ in their Content-Security-Policy and in where the file lies.
 */

import { readFileSync } from 'node:fs';
import { createServer } from 'node:http';
import { chromium } from 'playwright-core';
import { FLAGS } from './browser_flags.mjs';

const DIST = new URL('../dist/', import.meta.url);
const [executablePath, file] = process.argv.slice(2);

const STRICT = "default-src 'self'; script-src 'self' 'unsafe-inline'";
/** Policies of pages, and how the other site's server answers. */
const PAGES = {
  plain: {},
  blobs: { policy: `${STRICT} 'wasm-unsafe-eval'; worker-src blob:` },
  own: { policy: `${STRICT} 'wasm-unsafe-eval'; worker-src 'self'` },
  noWasm: { policy: STRICT },
  other: { isOther: true, allows: true },
  blocked: { isOther: true, allows: false },
};

function serve(answer) {
  const server = createServer(answer);
  return new Promise((resolve) => server.listen(0, '127.0.0.1', () => resolve(server)));
}

/** Answer a request of the file, whole or a range. */
function sendFile(request, response, headers) {
  const bytes = readFileSync(file);
  const asked = /^bytes=(\d+)-(\d+)$/.exec(request.headers.range ?? '');
  if (!asked) return response.writeHead(200, headers).end(bytes);
  const [first, last] = [Number(asked[1]), Math.min(Number(asked[2]), bytes.length - 1)];
  response.writeHead(206, { ...headers, 'content-range': `bytes ${first}-${last}/${bytes.length}` });
  response.end(bytes.subarray(first, last + 1));
}

const other = await serve((request, response) => {
  if (request.method === 'OPTIONS') return response.writeHead(403).end(); // preflights are not needed
  sendFile(request, response, request.url.includes('allows') ? { 'access-control-allow-origin': '*' } : {});
});
const own = await serve((request, response) => {
  const { pathname, searchParams } = new URL(request.url, 'http://localhost');
  const name = pathname.slice(1);
  if (name === 'scene.kpc') return sendFile(request, response, {});
  if (name.startsWith('kpc-')) {
    return response.writeHead(200, { 'content-type': 'text/javascript' }).end(readFileSync(new URL(name, DIST)));
  }
  if (name !== 'page') return response.writeHead(404).end();
  const { policy } = PAGES[searchParams.get('name')];
  const headers = { 'content-type': 'text/html', ...(policy && { 'content-security-policy': policy }) };
  response.writeHead(200, headers).end(`<!doctype html><title>Test</title><script type="module">
    import { Clip } from './kpc-player.js';
    globalThis.load = ${load};
    globalThis.Clip = Clip;
  </script>`);
});

/** In the page: load a clip until nothing more comes; return what it was and how long things took. */
async function load(src) {
  let longest = 0;
  new PerformanceObserver((list) => {
    for (const entry of list.getEntries()) longest = Math.max(longest, entry.duration);
  }).observe({ type: 'longtask', buffered: false });
  const start = performance.now();
  try {
    const clip = await globalThis.Clip.open(src);
    const opened = performance.now() - start;
    let coarse = 0;
    let texels = 0;
    for (;;) {
      for (const scene of clip.scenes) for (const rows of scene.take(1 << 22)) texels += rows.texels.length;
      if (clip.error) throw clip.error;
      if (!coarse && clip.canShow(0)) coarse = performance.now() - start;
      if (clip.isSettled) break;
      await new Promise((resolve) => clip.addEventListener('arrived', resolve, { once: true }));
    }
    const settled = performance.now() - start;
    await new Promise((resolve) => setTimeout(resolve, 100));
    clip.close();
    return { texels, buffered: clip.buffered, duration: clip.duration, opened, coarse, settled, longest };
  } catch (error) {
    return { code: error.code, message: error.message };
  }
}

const browser = await chromium.launch({ executablePath, args: FLAGS });
try {
  const results = {};
  for (const [name, { isOther, allows }] of Object.entries(PAGES)) {
    const page = await browser.newPage();
    await page.goto(`http://127.0.0.1:${own.address().port}/page?name=${name}`);
    await page.waitForFunction('globalThis.load');
    const elsewhere = `http://127.0.0.1:${other.address().port}/scene.kpc${allows ? '?allows' : ''}`;
    results[name] = await page.evaluate((src) => globalThis.load(src), isOther ? elsewhere : 'scene.kpc');
    await page.close();
  }
  process.stdout.write(JSON.stringify(results));
} finally {
  await browser.close();
  own.close();
  other.close();
}
