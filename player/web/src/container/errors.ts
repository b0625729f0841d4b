/** What can be wrong. The codes are stable: pages may show words of their own for them. */

/**
 * Kinds of errors: first those of section 11.2 of spec/kpc-format.md, then those of getting the file.
 *
 * `empty` the file has no bytes; `not-found` the server has no such file; `blocked` another site's server does not permit it (CORS); `replaced` the
 * file changed while it was read; `network` the server cannot be reached or its answer not be used; `worker` the
 * decoder cannot run; `aborted` the caller ended it; `no-webgl` there is no WebGL2; `graphics` the card cannot draw it.
 */
export type ErrorCode =
  | 'foreign'
  | 'draft'
  | 'newer'
  | 'cut-off'
  | 'damaged'
  | 'invalid'
  | 'budget'
  | 'empty'
  | 'not-found'
  | 'blocked'
  | 'replaced'
  | 'network'
  | 'worker'
  | 'aborted'
  | 'no-webgl'
  | 'graphics';

/** Base class of all errors that this package raises on purpose. */
export class KpcError extends Error {
  override name = 'KpcError';
  readonly code: ErrorCode;

  constructor(message: string, code: ErrorCode) {
    super(message);
    this.code = code;
  }
}

/** A .kpc file is damaged, hostile or of an unsupported version. */
export class FormatError extends KpcError {
  override name = 'FormatError';

  constructor(message: string, code: ErrorCode = 'invalid') {
    super(message, code);
  }
}

/** Return any error as one of this package: what a page cannot allocate exceeds its memory. */
export function asKpcError(error: unknown): KpcError {
  if (error instanceof KpcError) return error;
  return error instanceof RangeError ? new BudgetError(String(error)) : new KpcError(String(error), 'worker');
}

/** Reading a .kpc file would need more memory than the reader was given. */
export class BudgetError extends FormatError {
  override name = 'BudgetError';

  constructor(message: string) {
    super(message, 'budget');
  }
}
