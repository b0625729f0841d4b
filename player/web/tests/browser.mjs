/**
 * Runs jobs in a page of headless Chromium: `node browser.mjs BUNDLE FOLDER CHROMIUM < jobs.json`.
 *
 * Jobs are a list of {call, args}, functions of the page that BUNDLE makes; the page finds the files of FOLDER at
 * its root. Writes a list of what the calls return, as JSON.
 */

import { readFileSync } from 'node:fs';
import { basename, join } from 'node:path';
import { chromium } from 'playwright-core';
import { FLAGS } from './browser_flags.mjs';

const ORIGIN = 'http://localhost';

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
    results.push(await page.evaluate(([name, list]) => globalThis.page[name](...list), [call, args]));
  }
  process.stdout.write(JSON.stringify(results));
} finally {
  await browser.close();
}
