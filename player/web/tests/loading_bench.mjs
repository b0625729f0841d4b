/**
 * Times pages over a slow line: `node loading_bench.mjs CHROMIUM FOLDER SECONDS PAGE ...`, each in its own browser.
 *
 * A page calls `firstPicture()` once it shows something, or `firstPictureGiven(gl)` once WebGL has been given it.
 * Writes a list as JSON: milliseconds from navigation until it is shown, the longest task of the page's main thread
 * until it is given, by the clock and by its processor time, bytes fetched, and frames a second that are drawn on the
 * canvas in the SECONDS after that. Of a page named seeks.html it writes instead milliseconds from a seek to the
 * first picture there: once, a second after the first picture, to the end of a clip of which nothing but the
 * beginning has arrived, then to and fro within what is buffered there.
 */

import { readFileSync } from 'node:fs';
import { createServer } from 'node:http';
import { extname, join } from 'node:path';
import { gzipSync } from 'node:zlib';
import { chromium } from 'playwright-core';
import { FLAGS } from './browser_flags.mjs';

/** A line of 10 Mbit/s, and milliseconds until answers begin. */
const LINE = { offline: false, latency: 40, downloadThroughput: 1.25e6, uploadThroughput: 1.25e6 };
const TYPES = { '.html': 'text/html', '.js': 'text/javascript' };
const [executablePath, folder, seconds, ...pages] = process.argv.slice(2);

/** In the page: note the first picture, the frames in which something is drawn on a canvas, and when that is done. */
function watch() {
  globalThis.found = { first: 0, frames: [], done: [] };
  globalThis.firstPicture = () => {
    globalThis.found.first ||= performance.now();
  };
  /** Note the first picture once the card, which has been given it, has drawn it. */
  globalThis.firstPictureGiven = (gl) => {
    performance.mark('given');
    globalThis.whenDone(gl, globalThis.firstPicture);
  };
  /** Call something once the card has done what it has been given. */
  globalThis.whenDone = (gl, act) => {
    const fence = gl.fenceSync(gl.SYNC_GPU_COMMANDS_COMPLETE, 0);
    gl.flush();
    const look = () => {
      const isDone = gl.isContextLost() || gl.getSyncParameter(fence, gl.SYNC_STATUS) === gl.SIGNALED;
      if (isDone) act();
      else setTimeout(look, 2);
    };
    look();
  };
  const { prototype } = WebGL2RenderingContext;
  let isOnCanvas = true;
  const { bindFramebuffer } = prototype;
  prototype.bindFramebuffer = function (target, framebuffer) {
    isOnCanvas = framebuffer === null;
    bindFramebuffer.call(this, target, framebuffer);
  };
  let last = 0;
  for (const name of ['drawArrays', 'drawElements', 'drawArraysInstanced', 'drawElementsInstanced']) {
    const draw = prototype[name];
    prototype[name] = function (...args) {
      draw.apply(this, args);
      const now = document.timeline.currentTime;
      if (isOnCanvas && now !== last) {
        const frame = globalThis.found.frames.push(now) - 1;
        queueMicrotask(() => {
          globalThis.whenDone(this, () => {
            globalThis.found.done[frame] = performance.now();
          });
        });
      }
      last = isOnCanvas ? now : last;
    };
  }
}

function serve() {
  const packed = new Map();
  const server = createServer((request, response) => {
    const name = new URL(request.url, 'http://localhost').pathname.slice(1);
    const type = TYPES[extname(name)] ?? 'application/octet-stream';
    let bytes;
    try {
      bytes = readFileSync(join(folder, name));
    } catch {
      return response.writeHead(404).end();
    }
    if (type !== 'application/octet-stream') {
      if (!packed.has(name)) packed.set(name, gzipSync(bytes));
      return response.writeHead(200, { 'content-type': type, 'content-encoding': 'gzip' }).end(packed.get(name));
    }
    const asked = /^bytes=(\d+)-(\d+)$/.exec(request.headers.range ?? '');
    const headers = { 'content-type': type, etag: '"1"' };
    if (!asked) return response.writeHead(200, headers).end(bytes);
    const [first, end] = [Number(asked[1]), Math.min(Number(asked[2]) + 1, bytes.length)];
    response.writeHead(206, { ...headers, 'content-range': `bytes ${first}-${end - 1}/${bytes.length}` });
    response.end(bytes.subarray(first, end));
  });
  return new Promise((resolve) => server.listen(0, '127.0.0.1', () => resolve(server)));
}

/** Return the longest task of the page's main thread until WebGL is given its first picture, in milliseconds. */
function longestTask(events) {
  const mark = events.find(({ name }) => name === 'given');
  if (mark === undefined) return { longest_task_ms: null, longest_task_cpu_ms: null };
  const start = Math.max(
    ...events.filter(({ name, pid }) => name === 'navigationStart' && pid === mark.pid).map(({ ts }) => ts),
  );
  const tasks = events.filter(
    ({ name, pid, tid, ts }) =>
      name.endsWith('RunTask') && pid === mark.pid && tid === mark.tid && ts >= start && ts <= mark.ts,
  );
  return {
    longest_task_ms: Math.max(...tasks.map(({ dur = 0 }) => dur)) / 1e3,
    longest_task_cpu_ms: Math.max(...tasks.map(({ tdur = 0 }) => tdur)) / 1e3,
  };
}

async function measure(address, name) {
  const browser = await chromium.launch({ executablePath, args: FLAGS });
  try {
    const page = await browser.newPage({ viewport: { width: 320, height: 240 } });
    page.on('pageerror', (error) => console.error(`${name}: ${error.message}`));
    await page.addInitScript(watch);
    await page.goto('about:blank');
    const client = await page.context().newCDPSession(page);
    await client.send('Network.enable');
    await client.send('Network.emulateNetworkConditions', LINE);
    if (name === 'seeks.html') {
      await page.goto(`${address}/${name}`);
      await page.waitForFunction(() => globalThis.found.first > 0, null, { timeout: 60_000 });
      return await page.evaluate(seeks);
    }
    let bytes = 0;
    client.on('Network.loadingFinished', ({ encodedDataLength }) => {
      bytes += encodedDataLength;
    });
    await browser.startTracing(page, { categories: ['toplevel', 'blink.user_timing', 'disabled-by-default-v8.gc'] });
    await page.goto(`${address}/${name}`);
    await page.waitForFunction(() => globalThis.found.first > 0, null, { timeout: 60_000 });
    const { traceEvents } = JSON.parse((await browser.stopTracing()).toString());
    const from = await page.evaluate(() => document.timeline.currentTime);
    await page.waitForTimeout(1000 * seconds);
    if (process.env.KPC_SCREENSHOTS) await page.screenshot({ path: join(process.env.KPC_SCREENSHOTS, `${name}.png`) });
    const { first, frames } = await page.evaluate(() => globalThis.found);
    const drawn = frames.filter((at) => at >= from && at < from + 1000 * seconds).length;
    return { first_picture_ms: first, ...longestTask(traceEvents), bytes, fps: drawn / seconds };
  } finally {
    await browser.close();
  }
}

/** In the page: seek in a paused clip once it shows its beginning; return milliseconds until pictures are drawn. */
async function seeks() {
  const player = document.querySelector('kpc-player');
  const { frames, done } = globalThis.found;
  const nextFrame = () => new Promise(requestAnimationFrame);
  /** Return the buffered part of the clip that holds a time; null if it is not buffered. */
  const bufferedAt = (time) => {
    const { buffered } = player;
    for (let i = 0; i < buffered.length; i++)
      if (buffered.start(i) <= time && time <= buffered.end(i)) return [buffered.start(i), buffered.end(i)];
    return null;
  };
  /** The player says within a frame that a time is there, and then draws it. */
  const seek = async (time) => {
    const start = performance.now();
    const seeked = new Promise((resolve) => {
      player.addEventListener('seeked', () => resolve(document.timeline.currentTime), { once: true });
    });
    player.currentTime = time;
    const since = await seeked;
    const isDone = (_, frame) => frames[frame] >= since;
    while (!done.some(isDone)) await nextFrame();
    return done.find(isDone) - start;
  };
  const aSecond = async () => {
    for (let i = 0; i < 60; i++) await nextFrame();
  };
  const end = 0.8 * player.duration;
  await aSecond();
  if (bufferedAt(end) !== null) throw new Error('the end of the clip arrived before it was sought');
  const unbuffered = await seek(end);
  const places = [0.1, 0.7, 0.3, 0.9, 0.5];
  const buffered = [];
  for (const share of places) {
    await aSecond();
    const [from, to] = bufferedAt(player.currentTime);
    buffered.push(await seek(from + share * (to - from)));
  }
  return { seek_unbuffered_ms: unbuffered, seek_buffered_ms: buffered.sort((a, b) => a - b)[places.length >> 1] };
}

const server = await serve();
try {
  const results = [];
  for (const name of pages) results.push(await measure(`http://127.0.0.1:${server.address().port}`, name));
  process.stdout.write(JSON.stringify(results));
} finally {
  server.close();
}
