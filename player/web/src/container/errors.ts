/** A .kpc file is damaged, hostile or of an unsupported version. */
export class FormatError extends Error {
  override name = 'FormatError';
}

/** Reading a .kpc file would need more memory than the reader was given. */
export class BudgetError extends FormatError {
  override name = 'BudgetError';
}
