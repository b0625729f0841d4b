/**
 * Runs jobs in a page of headless Chromium: `node browser.mjs BUNDLE FOLDER CHROMIUM < jobs.json`.
 *
 * Jobs are a list of {call, args}, functions of the page that BUNDLE makes; the page finds the files of FOLDER at
 * its root. Writes a list of {value, cpuSeconds} as JSON: what the calls return, and the time that all processes of the
 * browser spent on them (on Linux; else null).
 */

import { readdirSync, readFileSync } from 'node:fs';
import { basename, join } from 'node:path';
import { chromium } from 'playwright-core';
import { FLAGS } from './browser_flags.mjs';

const TICKS_PER_SECOND = 100;
const ORIGIN = 'http://localhost';

/** Return the seconds that this process and all below it have used so far; null where there is no /proc. */
function cpuSeconds() {
  const [parents, ticks] = [new Map(), new Map()];
  try {
    for (const pid of readdirSync('/proc').filter((name) => /^\d+$/.test(name))) {
      try {
        const fields = readFileSync(`/proc/${pid}/stat`, 'utf-8')
          .replace(/^.*\) /, '')
          .split(' ');
        parents.set(pid, fields[1]);
        ticks.set(pid, Number(fields[11]) + Number(fields[12]));
      } catch {} // it has ended
    }
  } catch {
    return null;
  }
  const isBelow = (pid) => pid !== undefined && (pid === String(process.pid) || isBelow(parents.get(pid)));
  return [...ticks].reduce((sum, [pid, used]) => (isBelow(pid) ? sum + used / TICKS_PER_SECOND : sum), 0);
}

const [bundle, folder, executablePath] = process.argv.slice(2);
const jobs = JSON.parse(readFileSync(0, 'utf-8'));
const browser = await chromium.launch({ executablePath, args: FLAGS });
try {
  const page = await browser.newPage();
  await page.route(`${ORIGIN}/**`, (route) => {
    const name = basename(decodeURIComponent(new URL(route.request().url()).pathname));
    if (name === 'page.html') route.fulfill({ contentType: 'text/html', body: '<!doctype html><title>Test</title>' });
    else route.fulfill({ contentType: 'application/octet-stream', body: readFileSync(join(folder, name)) });
  });
  page.on('console', (message) => console.error(message.text()));
  await page.goto(`${ORIGIN}/page.html`);
  await page.addScriptTag({ path: bundle });
  const results = [];
  for (const { call, args } of jobs) {
    const before = cpuSeconds();
    const value = await page.evaluate(([name, list]) => globalThis.page[name](...list), [call, args]);
    results.push({ value, cpuSeconds: before === null ? null : cpuSeconds() - before });
  }
  process.stdout.write(JSON.stringify(results));
} finally {
  await browser.close();
}
