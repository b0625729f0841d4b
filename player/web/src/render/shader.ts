/**
 * Puts GLSL files together for WebGL2, as kpc.player.gl.shader does for the desktop: there is what the directives mean.
 *
 * The files themselves are those of the desktop, bundled as text, so no formula is written twice. They are composed
 * here, not when the player is built, because loops are unrolled and weights written out for the scene.
 */

import { SHADER_FILES } from './shader_files.js';

/** What a text begins with: `Language.WEB` of kpc.player.gl.shader. */
const WEB = `#version 300 es
precision highp float;
precision highp int;
precision highp sampler2D;
precision highp sampler3D;
precision highp usampler3D;`;

const LINES_A_FILE = 10000;
const UNROLL = /^\s*#unroll\s+(\w+)\s+([\w#]+)\s*(?:\/\/.*)?$/;
const END = /^\s*#end\s*(?:\/\/.*)?$/;
const INCLUDE = /^\s*#include\s+"([\w./-]+)"\s*(?:\/\/.*)?$/;
const WHERE = /(?:ERROR:\s*)?\b\d+[:(](\d+)\)?(?:\(\d+\))?\s*:\s*(?:error\b\s*:?)?\s*(.*)/i;

export type Defines = Readonly<Record<string, number>>;
/** Files that are made for one scene, by name. */
export type Written = Readonly<Record<string, string>>;
export interface Composed {
  text: string;
  files: string[];
}

type Line = readonly [number: number, text: string];

/** Return the whole text of a shader, and the names of the files in it. */
export function compose(name: string, defines: Defines = {}, written: Written = {}): Composed {
  const files: string[] = [];
  const macros = Object.entries(defines).map(([key, value]) => `#define ${key} ${value}\n`);
  return { text: `${WEB}\n${macros.join('')}${expand(name, files, written, defines)}`, files };
}

function expand(name: string, files: string[], written: Written, defines: Defines): string {
  const base = files.length * LINES_A_FILE;
  files.push(name);
  const source = written[name] ?? SHADER_FILES[name];
  if (source === undefined) throw new Error(`shader file ${name} does not exist`);
  const lines = source.split('\n').slice(0, source.endsWith('\n') ? -1 : undefined);
  const out = [`#line ${base + 1}`];
  let expected = base + 1;
  for (const [number, line] of unrolled(
    lines.map((text, i) => [base + 1 + i, text] as const),
    defines,
  )) {
    if (number !== expected) out.push(`#line ${number}`);
    expected = number + 1;
    const included = INCLUDE.exec(line)?.[1];
    if (included === undefined) {
      out.push(line);
    } else if (files.includes(included)) {
      out.push('');
    } else {
      out.push(expand(included, files, written, defines));
      expected = 0; // whatever comes next, its number has to be said
    }
  }
  return `${out.join('\n')}\n`;
}

/** Return numbered lines with every #unroll written out, inner ones after outer ones. */
function unrolled(lines: readonly Line[], defines: Defines): Line[] {
  const out: Line[] = [];
  for (let at = 0; at < lines.length; ) {
    const line = lines[at++];
    const head = UNROLL.exec(line[1]);
    if (head === null) {
      out.push(line);
      continue;
    }
    const [, name, many] = head;
    const start = at;
    for (let depth = 1; depth; at++) {
      if (at === lines.length) throw new Error(`#unroll ${name} has no #end`);
      depth += Number(UNROLL.test(lines[at][1])) - Number(END.test(lines[at][1]));
    }
    const count = /^\d+$/.test(many) ? Number(many) : defines[many];
    if (count === undefined) throw new Error(`#unroll ${name} ${many}: that count is not known`);
    const word = new RegExp(`##${name}\\b|\\b${name}\\b`, 'g');
    for (let i = 0; i < count; i++) {
      const body = lines.slice(start, at - 1).map(([number, text]) => [number, text.replace(word, `${i}`)] as const);
      out.push(...unrolled(body, defines));
    }
  }
  return out;
}

/** Return the first message of a driver's log that names a line, as "shader file:line: message". */
export function firstError(log: string, files: readonly string[]): string {
  for (const line of log.split('\n')) {
    const where = WHERE.exec(line);
    const file = where === null ? undefined : files[Math.floor(Number(where[1]) / LINES_A_FILE)];
    if (where && file !== undefined) return `shader ${file}:${Number(where[1]) % LINES_A_FILE}: ${where[2].trim()}`;
  }
  return `shader ${files[0]}: ${log.split(/\s+/).join(' ').trim()}`;
}

/** Rows of numbers that a shader holds as constants: vec4s, or single numbers. */
export interface ConstantArray {
  kind: 'vec4' | 'float' | 'int';
  values: ArrayLike<number>;
}

/** Return GLSL that declares arrays as constants, to the last bit of a float32. */
export function constants(arrays: Readonly<Record<string, ConstantArray>>): string {
  const lines = Object.entries(arrays).map(([name, { kind, values }]) => {
    const numbers = Array.from(values, (x) => (kind === 'int' ? `${x}` : exact(x)));
    const items =
      kind === 'vec4'
        ? Array.from({ length: numbers.length / 4 }, (_, i) => `vec4(${numbers.slice(4 * i, 4 * i + 4).join(', ')})`)
        : numbers;
    return `const ${kind} ${name}[${items.length}] = ${kind}[${items.length}](${items.join(', ')});\n`;
  });
  return lines.join('');
}

/** Return GLSL that declares arrays as a uniform block, and the numbers that it holds, each array of vec4s in order. */
export function uniformBlock(name: string, arrays: Readonly<Record<string, ConstantArray>>) {
  const lines = Object.entries(arrays).map(([array, { kind, values }]) => {
    return `    ${kind} ${array}[${kind === 'vec4' ? values.length / 4 : values.length}];\n`;
  });
  // A number of its own takes as much room as a vec4 in std140.
  const numbers = Object.values(arrays).flatMap(({ kind, values }) =>
    Array.from(values).flatMap((x) => (kind === 'vec4' ? [x] : [x, 0, 0, 0])),
  );
  return { text: `layout(std140) uniform ${name} {\n${lines.join('')}};\n`, numbers: Float32Array.from(numbers) };
}

/** Return a float32 with ten digits and, as Python does, two of the exponent. */
function exact(x: number): string {
  return Math.fround(x)
    .toExponential(9)
    .replace(/e([+-])(\d)$/, 'e$10$2');
}
