/**
 * Links to a moment seen from a place: `#t=1.5&camera=...`, in the page's hash as media fragments are, or behind the
 * path of a router that keeps it there: `#/scenes/3?t=1.5&camera=...`.
 */

export interface Moment {
  /** Seconds. */
  time: number | null;
  /** As the attribute `camera`. */
  camera: string | null;
}

/** Return the path that a router of the page keeps in a hash, if it does, and what names and values there are. */
function partsOf(hash: string): [string, string] {
  const [, path = '', values = ''] = /^#?(!?\/[^?]*)?\??(.*)$/s.exec(hash) ?? [];
  return [path, values];
}

/**
 * Return an address that shows a moment in the player with an id, or in the page's only one.
 * What else the hash says is kept.
 */
export function linkTo(address: string, moment: Moment, id: string): string {
  const url = new URL(address);
  const [path, before] = partsOf(url.hash);
  const kept = before.split('&').filter((value) => value !== '' && !/^(t|camera|player)(=|$)/.test(value));
  const values = new URLSearchParams();
  if (moment.time !== null) values.set('t', String(Number(moment.time.toFixed(3))));
  if (moment.camera !== null) values.set('camera', moment.camera.replace(/\s+/g, ','));
  if (id !== '') values.set('player', id);
  url.hash = `${path && `${path}?`}${[...kept, values.toString().replaceAll('%2C', ',')].join('&')}`;
  return url.href;
}

/** Return the moment that a hash says for a player; null if it says none, or for another player. */
export function momentOf(hash: string, id: string, isFirst: boolean): Moment | null {
  const values = new URLSearchParams(partsOf(hash)[1]);
  const player = values.get('player');
  if (player === null ? !isFirst : player !== id) return null;
  const text = values.get('t');
  const seconds = text === null || text === '' ? Number.NaN : Number(text);
  const time = seconds >= 0 && Number.isFinite(seconds) ? seconds : null;
  const camera = values.get('camera');
  return time === null && camera === null ? null : { time, camera };
}
