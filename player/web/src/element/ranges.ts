/** Ranges of time, as `HTMLMediaElement.buffered` has them. */

export interface PlayerRanges {
  readonly length: number;
  start(index: number): number;
  end(index: number): number;
}

/** Return ranges of pairs of seconds. */
export function rangesOf(pairs: readonly (readonly [number, number])[]): PlayerRanges {
  const bound = (index: number, end: 0 | 1) => {
    if (!(index in pairs)) throw new DOMException(`there is no range ${index}`, 'IndexSizeError');
    return pairs[index][end];
  };
  return { length: pairs.length, start: (index) => bound(index, 0), end: (index) => bound(index, 1) };
}
