/** The meta chunk: a JSON object, untrusted and bounded (section 6.8 of spec/kpc-format.md). */

import SCHEMA from '../../../../spec/meta.schema.json' with { type: 'json' };
import { FormatError } from './errors.js';
import { type Camera, hasUnitAxes, LIMIT } from './scene_chunks.js';

export const META_LIMIT = 1 << 16;
const DEPTH_LIMIT = 8;
const MEMBER_LIMIT = 256;
const TEXT_LIMIT = 4096;
const LARGEST = 1e38;
const UNPRINTABLE = /[\u0000-\u001f\u007f-\u009f\u2028-\u202e\u2066-\u2069]/;

/** Metadata of a clip (section 6.8): what the schema names, and anything else that JSON may hold. */
export interface Metadata {
  title?: string;
  description?: string;
  author?: string;
  licence?: string;
  date?: string;
  up?: number[];
  metres_per_unit?: number;
  transparent?: boolean;
  opening?: { camera: Camera; time: number };
  view_limits?: ViewLimits;
  camera_names?: string[];
  [name: string]: unknown;
}

/** From where, and how near, the scene holds: pairs are a least and a largest number, angles in degrees. */
export interface ViewLimits {
  focus: number[];
  forward: number[];
  azimuth: number[];
  elevation: number[];
  distance: number[];
  reach: number;
}

/** The part of JSON Schema that spec/meta.schema.json uses. */
interface Schema {
  type: string | string[];
  properties?: Record<string, Schema>;
  additionalProperties?: Schema;
  required?: string[];
  items?: Schema;
  minItems?: number;
  maxItems?: number;
  minLength?: number;
  maxLength?: number;
  pattern?: string;
  minimum?: number;
  maximum?: number;
  exclusiveMinimum?: number;
}

/** Return the object of a meta chunk, checked. */
export function parseMetadata(bytes: Uint8Array): Metadata {
  if (bytes.length > META_LIMIT) throw new FormatError(`meta: holds ${bytes.length} bytes, more than are allowed`);
  let text = '';
  let document: Metadata;
  try {
    text = new TextDecoder('utf-8', { fatal: true, ignoreBOM: true }).decode(bytes);
    document = JSON.parse(text);
  } catch (error) {
    const constant = /NaN|-?Infinity/.exec(text);
    const reason = constant ? `${constant[0]} is no number of JSON` : String(error).slice(0, 120);
    throw new FormatError(`meta: no valid JSON in UTF-8 (${reason})`);
  }
  if (hasNameTwice(text)) throw new FormatError('meta: no valid JSON in UTF-8 (a name is there twice in an object)');
  checkBounds(document, 'meta', 1);
  const wrong = mismatch(document, SCHEMA as unknown as Schema, 'the object');
  if (wrong !== null) throw new FormatError(`meta: ${wrong}`);
  checkGeometry(document);
  return document;
}

/** Whether an object in a valid JSON text has two members of one name, which JSON.parse lets pass. */
function hasNameTwice(text: string) {
  const open: (Set<string> | null)[] = [];
  for (const [token, colon] of text.matchAll(/"(?:[^"\\]|\\.)*"(\s*:)?|[[\]{}]/gs)) {
    if (token === '{') open.push(new Set());
    else if (token === '[') open.push(null);
    else if (token === '}' || token === ']') open.pop();
    else if (colon !== undefined) {
      const name = JSON.parse(token.slice(0, token.length - colon.length));
      const names = open[open.length - 1];
      if (names?.has(name)) return true;
      names?.add(name);
    }
  }
  return false;
}

/** Check the limits of every value, known or not. */
function checkBounds(value: unknown, where: string, depth: number) {
  if (typeof value === 'string') return checkText(value, where, where === 'meta.description');
  if (typeof value === 'number' && !(Math.abs(value) <= LARGEST))
    throw new FormatError(`${where}: a number is too large`);
  if (value === null || typeof value !== 'object') return;
  if (depth > DEPTH_LIMIT) throw new FormatError(`meta: arrays and objects are nested deeper than ${DEPTH_LIMIT}`);
  const members = Object.entries(value);
  if (!Array.isArray(value)) {
    if (members.length > MEMBER_LIMIT) throw new FormatError(`${where}: an object of ${members.length} members`);
    for (const [name] of members) checkText(name, where, false);
  }
  for (const [name, item] of members) checkBounds(item, `${where}.${name}`, depth + 1);
}

function checkText(text: string, where: string, hasLines: boolean) {
  const length = [...text].length;
  const isWhole = !/[\ud800-\udfff]/u.test(text);
  if (length > TEXT_LIMIT || !isWhole || UNPRINTABLE.test(hasLines ? text.replaceAll('\n', '') : text)) {
    throw new FormatError(
      `${where}: a text is longer than ${TEXT_LIMIT} characters, holds control characters or is not Unicode`,
    );
  }
}

/** Return how a JSON value breaks a schema, in words; null if it does not. */
function mismatch(value: unknown, schema: Schema, where: string): string | null {
  const kinds = [schema.type].flat();
  if (!kinds.some((kind) => isOf(value, kind))) return `${where} is no ${kinds.join(' or ')}`;
  if (typeof value === 'string') {
    const length = [...value].length;
    const fits = length >= (schema.minLength ?? 0) && length <= (schema.maxLength ?? TEXT_LIMIT);
    if (fits && new RegExp(schema.pattern ?? '', 'u').test(value)) return null;
    return `${where} is too long, too short, or not of the form that it should have`;
  }
  if (typeof value === 'number') {
    const within = value >= (schema.minimum ?? -Infinity) && value <= (schema.maximum ?? Infinity);
    if (within && value > (schema.exclusiveMinimum ?? -Infinity)) return null;
    return `${where} is ${value}, outside its range`;
  }
  if (Array.isArray(value)) {
    if (value.length < (schema.minItems ?? 0) || value.length > (schema.maxItems ?? Infinity)) {
      return `${where} has ${value.length} items`;
    }
    return firstOf(value.entries(), ([k, item]) => mismatch(item, schema.items as Schema, `${where}[${k}]`));
  }
  return typeof value === 'object' && value !== null ? memberMismatch(value, schema, where) : null;
}

function memberMismatch(value: object, schema: Schema, where: string): string | null {
  const missing = (schema.required ?? []).find((name) => !Object.hasOwn(value, name));
  if (missing !== undefined) return `${where} has no ${missing}`;
  const known = schema.properties ?? {};
  const wrong = firstOf(Object.entries(value), ([name, item]) => {
    const rule = Object.hasOwn(known, name) ? known[name] : schema.additionalProperties;
    return rule === undefined ? null : mismatch(item, rule, name);
  });
  return wrong === null || where === 'the object' ? wrong : `${where}: ${wrong}`;
}

/** Return the first result of a function that is not null. */
function firstOf<T>(items: Iterable<T>, find: (item: T) => string | null): string | null {
  for (const item of items) {
    const found = find(item);
    if (found !== null) return found;
  }
  return null;
}

function isOf(value: unknown, kind: string): boolean {
  if (kind === 'array') return Array.isArray(value);
  if (kind === 'integer') return Number.isInteger(value);
  if (kind === 'object') return value !== null && typeof value === 'object' && !Array.isArray(value);
  return typeof value === kind;
}

/** Check what the schema cannot say: lengths of vectors, order of bounds, and the pose of the camera. */
function checkGeometry(document: Metadata): void {
  const { up, view_limits: limits, opening } = document;
  if (up && !(Math.hypot(...up) >= 1 / LIMIT.BOX)) throw new FormatError('meta: up has no direction');
  if (limits) {
    if (!up || [limits.azimuth, limits.elevation, limits.distance].some(([low, high]) => low > high)) {
      throw new FormatError('meta: view_limits: there is no up, or a least value is above the largest');
    }
    const forward = limits.forward;
    const across = [0, 1, 2].map(
      (i) => forward[(i + 1) % 3] * up[(i + 2) % 3] - forward[(i + 2) % 3] * up[(i + 1) % 3],
    );
    const size = Math.hypot(...forward);
    if (!(size >= 1 / LIMIT.BOX) || Math.hypot(...across) < 1e-3 * size * Math.hypot(...up)) {
      throw new FormatError('meta: view_limits: forward has no direction, or that of up');
    }
  }
  if (opening && !hasUnitAxes(opening.camera.pose)) {
    throw new FormatError('meta: opening: the axes of the camera are not of length 1');
  }
}
