/**
 * Builds the player: `node build.mjs` writes dist/, `node build.mjs --test [NAME ...]` runs all tests or those,
 * `node build.mjs --out FOLDER` writes to another folder, `node build.mjs --page FILE --out FOLDER` bundles a script of
 * a page that tests open.
 *
 * Everything is inlined: the decoder core (format/core), the shaders (player/gl/glsl), the schema of metadata (spec),
 * and the text of the worker, which `import source from './worker.ts?text'` bundles. Nothing is copied.
 */

import { spawnSync } from 'node:child_process';
import { readdirSync, readFileSync, rmSync } from 'node:fs';
import { basename, join, resolve } from 'node:path';
import { parseArgs } from 'node:util';
import * as esbuild from 'esbuild';

const FOLDER = import.meta.dirname;
const NOTICE = '/*! kpc-player, Apache-2.0. Contains fzstd, Copyright (c) 2020 Arjun Barrett, MIT License. */';

/** Ends a loop of fzstd 0.1.1 over Huffman weights, of which a tree has at most 255: without it, it may be endless. */
const boundedWeights = {
  name: 'bounded Huffman weights',
  setup(build) {
    build.onLoad({ filter: /[\\/]fzstd[\\/]esm[\\/]index\.mjs$/ }, ({ path }) => {
      const parts = readFileSync(path, 'utf-8').split(/for \(;;\) \{(?=\s*fpos -= btr1;)/);
      if (parts.length !== 2) throw new Error(`${path} has changed: see \`boundedWeights\` in build.mjs`);
      return { contents: parts.join('while (wc < 256) {'), loader: 'js' };
    });
  },
};

const OPTIONS = {
  absWorkingDir: FOLDER,
  bundle: true,
  charset: 'utf8',
  loader: { '.wasm': 'binary', '.glsl': 'text' },
  logLevel: 'warning',
  plugins: [boundedWeights],
  target: 'es2022',
};
const MINIFIED = { ...OPTIONS, minify: true, legalComments: 'none' };

const bundledText = {
  name: 'bundled text',
  setup(build) {
    build.onResolve({ filter: /\?text$/ }, ({ path, resolveDir }) => ({
      namespace: 'bundled-text',
      path: resolve(resolveDir, path.replace(/\?text$/, '')),
    }));
    build.onLoad({ filter: /.*/, namespace: 'bundled-text' }, async ({ path }) => {
      const { metafile, outputFiles } = await esbuild.build({
        ...MINIFIED,
        entryPoints: [path],
        format: 'iife',
        metafile: true,
        write: false,
      });
      const watchFiles = Object.keys(metafile.inputs).map((file) => join(FOLDER, file));
      return { contents: outputFiles[0].text, loader: 'text', watchFiles };
    });
  },
};

const besidePlayer = {
  name: 'beside the player',
  setup(build) {
    build.onResolve({ filter: /\/index\.js$/ }, () => ({ path: './kpc-player.js', external: true }));
  },
};

/** Write the module, its part for three.js and, for pages that forbid workers from blobs, the worker. */
async function build(outdir) {
  const options = { ...MINIFIED, banner: { js: NOTICE }, outdir };
  await esbuild.build({
    ...options,
    entryPoints: { 'kpc-player': 'src/index.ts' },
    format: 'esm',
    plugins: [...OPTIONS.plugins, bundledText],
  });
  // Beside the player, of which it is a part, and three.js, which the page has.
  await esbuild.build({
    ...options,
    entryPoints: { 'kpc-three': 'src/three/index.ts' },
    external: ['three'],
    format: 'esm',
    plugins: [...OPTIONS.plugins, besidePlayer],
  });
  await esbuild.build({ ...options, entryPoints: { 'kpc-worker': 'src/decoder/worker.ts' }, format: 'iife' });
}

/** Bundle the tests, all or those of these names, and run them; return the exit status. */
async function test(names) {
  const files = readdirSync(join(FOLDER, 'tests')).filter((name) => name.endsWith('.test.ts'));
  const chosen = files.filter((name) => names.length === 0 || names.includes(basename(name, '.test.ts')));
  const outdir = join(FOLDER, 'build', `tests-${process.pid}`);
  await esbuild.build({
    ...OPTIONS,
    entryPoints: chosen.map((name) => `tests/${name}`),
    format: 'esm',
    outExtension: { '.js': '.mjs' },
    outdir,
    platform: 'node',
    plugins: [...OPTIONS.plugins, bundledText],
    sourcemap: 'inline',
  });
  const built = chosen.map((name) => join(outdir, name.replace(/ts$/, 'mjs')));
  const run = spawnSync(process.execPath, ['--enable-source-maps', '--test', ...built], {
    cwd: FOLDER,
    stdio: 'inherit',
  });
  rmSync(outdir, { recursive: true, force: true });
  return run.status;
}

/** Bundle a script of a page. */
async function buildPage(file, outdir) {
  await esbuild.build({ ...OPTIONS, entryPoints: [file], format: 'iife', outdir, plugins: [bundledText] });
}

const { values, positionals } = parseArgs({
  options: {
    test: { type: 'boolean' },
    page: { type: 'string' },
    out: { type: 'string', default: join(FOLDER, 'dist') },
  },
  allowPositionals: true,
});
if (values.test) process.exitCode = await test(positionals);
else if (values.page) await buildPage(values.page, resolve(values.out));
else await build(resolve(values.out));
