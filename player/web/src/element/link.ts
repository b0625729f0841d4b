/** Links to a moment seen from a place: `#t=1.5&camera=...`, in the page's hash as media fragments are. */

export interface Moment {
  /** Seconds. */
  time: number | null;
  /** As the attribute `camera`. */
  camera: string | null;
}

/**
 * Return an address that shows a moment in the player with an id, or in the page's only one.
 * What else the hash says is kept, if it is made of names and values, too.
 */
export function linkTo(address: string, moment: Moment, id: string): string {
  const url = new URL(address);
  const values = new URLSearchParams(url.hash.includes('=') ? url.hash.slice(1) : '');
  for (const name of ['t', 'camera', 'player']) values.delete(name);
  if (moment.time !== null) values.set('t', String(Number(moment.time.toFixed(3))));
  if (moment.camera !== null) values.set('camera', moment.camera.replace(/\s+/g, ','));
  if (id !== '') values.set('player', id);
  url.hash = values.toString().replaceAll('%2C', ',');
  return url.href;
}

/** Return the moment that a hash says for a player; null if it says none, or for another player. */
export function momentOf(hash: string, id: string, isFirst: boolean): Moment | null {
  const values = new URLSearchParams(hash.replace(/^#/, ''));
  const player = values.get('player');
  if (player === null ? !isFirst : player !== id) return null;
  const text = values.get('t');
  const seconds = text === null || text === '' ? Number.NaN : Number(text);
  const time = seconds >= 0 && Number.isFinite(seconds) ? seconds : null;
  const camera = values.get('camera');
  return time === null && camera === null ? null : { time, camera };
}
