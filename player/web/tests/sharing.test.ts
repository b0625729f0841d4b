/** Clips whose groups share planes (section 4.7 of the spec), at once and while they arrive. */

import assert from 'node:assert/strict';
import test from 'node:test';

import { CODEC, type Entry } from '../src/container/chunk.js';
import { Container } from '../src/container/container.js';
import { KpcError } from '../src/container/errors.js';
import { Groups } from '../src/container/groups.js';
import { Scene } from '../src/container/scene.js';
import type { PlaneHead } from '../src/container/scene_chunks.js';
import { loadCore } from '../src/decoder/module.js';
import { layerTexels } from '../src/decoder/texels.js';
import type { Clip } from '../src/streaming/clip.js';
import { SharedPlanes } from '../src/streaming/shared_source.js';
import { BytesSource, type ReadOptions } from '../src/streaming/source.js';
import { described } from './described.js';
import { hasCode, until, withClip } from './playing.js';
import { type TestServer, withServer } from './server.js';
import { type Changes, type Part, sharing } from './writing.js';

/** Frames of a group, and frames that it has in common with the next one. */
const [FRAMES, COMMON] = [101, 11];
const SIZES = {
  frameCount: FRAMES,
  segmentRows: 32,
  scales: [
    [4, 64, 64, 64, 32],
    [8, 96, 96, 96, 32],
  ] as [number, number, number, number, number][],
};
const made = (changes?: Changes, sizes = SIZES) => sharing(sizes, 3, COMMON, changes);
const { clip: CLIP, scenes: SCENES } = made();
const core = await loadCore();
const sharedOf = (bytes: Uint8Array) => new Container(bytes).index.filter(({ kind }) => kind === 'PLNE');

/** Let the playhead go to times in seconds, in turn; compare all that has come there with scenes decoded at once. */
async function playsAt(clip: Clip, times: number[], scenes: Uint8Array[]): Promise<void> {
  const planes = scenes.map((bytes) => new Scene(bytes, core).planes());
  const [compared, wanted] = [new Set<number>(), new Set<number>()];
  for (const time of times) {
    const { group } = clip.timeline.at(time / clip.duration);
    wanted.add(group);
    await until(
      clip,
      () => {
        clip.setPlayhead({ time, rate: 1, loop: false });
        return clip.parts(time)[0].scene.group === group && clip.isSettled && !clip.error;
      },
      ({ group }, { scale, plane, firstRow, rowCount, layers, columns, texels }) => {
        const { symbols, head } = planes[group][scale][plane] as { symbols: Int8Array; head: PlaneHead };
        const [from, count] = [firstRow * 4 * layers * columns, rowCount * 4 * layers * columns];
        assert.deepEqual(texels, layerTexels(symbols, head).subarray(from, from + count));
        compared.add(group);
      },
    );
    const { scene, time: localTime } = clip.parts(time)[0];
    const { symbols, head } = planes[group][1].yt as { symbols: Int8Array; head: PlaneHead };
    const row = Math.round(localTime * (head.rows - 1));
    const values = core.dequantise(symbols, head.step, head.offset).subarray(row * head.columns * head.channels);
    const found = scene.row(1, 'yt', row / (head.rows - 1));
    for (const [k, value] of found.entries()) assert.ok(Math.abs(value - values[k]) < 1e-3);
  }
  for (const group of wanted) assert.ok(compared.has(group), `group ${group}`);
}

/** Return how often the server was asked for a byte. */
const asked = ({ requests }: TestServer, position: number): number =>
  requests.filter((range) => {
    const [from, to] = range.split('-').map(Number);
    return range === 'all' || (from <= position && position <= to);
  }).length;

test('groups that share planes hold what they would hold by themselves', async () => {
  assert.ok(CLIP.length < 0.6 * SCENES.reduce((sum, bytes) => sum + bytes.length, 0));
  const groups = new Groups(CLIP, core);
  for (const [number, bytes] of SCENES.entries()) {
    assert.deepEqual(await described(groups.open(number)), await described(new Scene(bytes, core)));
  }
});

test('a group uses the last of the shared planes that may be its own', async () => {
  const later = (part: Part) => ({ ...part, group: 2, body: part.body.map((byte, k) => (k ? byte ^ 64 : byte)) });
  const { clip } = made({ shared: (parts) => [later(parts[0]), ...parts, { ...later(parts[1]), group: 1 }] });
  const planes = (bytes: Uint8Array, number: number) => new Groups(bytes, core).open(number).planes()[0];
  for (const [number, changed] of [[], ['xz'], ['xy', 'xz']].entries()) {
    const [found, before] = [planes(clip, number), planes(CLIP, number)];
    for (const name of ['xy', 'xz', 'yz'] as const) {
      const isSame = Buffer.from(found[name]?.symbols ?? []).equals(Buffer.from(before[name]?.symbols ?? []));
      assert.equal(isSame, !changed.includes(name), `${number} ${name}`);
    }
  }
});

const first = (change: Partial<Part>) => (parts: Part[]) =>
  parts.map((part, k) => (k === 0 ? { ...part, ...change } : part));
const standIn = (change: Partial<Part>, only = 0) => ({
  own: (parts: Part[], group: number) =>
    parts.map((part) => {
      const isIt = group === only && part.codec === CODEC.SHARED && part.scale === 0 && part.plane === 0;
      return isIt ? { ...part, ...change } : part;
    }),
});
const TINY = {
  ...SIZES,
  scales: SIZES.scales.map(([, ...sizes]) => [2, ...sizes.map((n) => n / 8)]) as typeof SIZES.scales,
};
const INVALID: Record<string, [Changes, string]> = {
  'of a group that is not': [{ shared: first({ group: 3 }) }, 'for groups from 3 on'],
  'of a later group alone': [{ shared: first({ group: 1 }) }, 'stands for a shared plane 0 of scale 0'],
  'of a scale that cannot be': [{ shared: first({ scale: 16 }) }, 'xy of scale 16, has no rows'],
  'of a plane that cannot be': [{ shared: first({ plane: 6 }) }, 'plane 6 of scale 0, has no rows'],
  'of later rows': [{ shared: first({ rowStart: 1 }) }, 'rows from 1'],
  'of no rows': [{ shared: first({ rowCount: 0 }) }, '0 of them'],
  'that is shared in turn': [{ shared: first({ codec: CODEC.SHARED }) }, 'no bytes of its own'],
  'there twice': [{ shared: (parts) => [...parts, parts[0]] }, 'xy of scale 0, is there twice for group 0'],
  'that is not there': [{ shared: (parts) => parts.slice(1) }, 'which the clip does not have'],
  'of other rows': [standIn({ rowCount: 7 }), 'stands for 7 rows'],
  'of another length': [standIn({ rawLength: 63 }), 'a length of 63'],
  'with bytes in the group': [standIn({ body: new Uint8Array(1) }), 'has bytes or a first row of its own'],
  'with a first row': [standIn({ rowStart: 1 }), 'has bytes or a first row of its own'],
  'with a checksum': [standIn({ crc: 1 }), 'has bytes or a first row of its own'],
  'of another group in a group': [standIn({ group: 1 }), 'belongs to group 1'],
};
for (const [name, [changes, words]] of Object.entries(INVALID)) {
  test(`a shared plane ${name} is refused`, () => {
    assert.throws(() => new Groups(made(changes, TINY).clip, core), hasCode('invalid', words));
  });
}

test('a fault of the clip is reported at once, one of a later group when it is opened', async () => {
  const [{ clip: twice }, words] = [made({ shared: (parts) => [...parts, parts[0]] }), 'twice for group 0'];
  await assert.rejects(
    withClip(twice.buffer, {}, async () => {}),
    hasCode('invalid', words),
  );
  const { clip: bytes } = made(standIn({ rowCount: 63 }, 1));
  assert.throws(() => new Groups(bytes, core).open(1), hasCode('invalid', 'stands for 63 rows'));
  await withClip(bytes.buffer, {}, async (clip) => {
    await assert.rejects(playsAt(clip, [0, 12], SCENES), hasCode('invalid', 'stands for 63 rows'));
  });
});

test('a group by itself may not share planes', async () => {
  const { offset, storedLength } = new Container(CLIP).index.find(({ kind }) => kind === 'GRUP') as Entry;
  const bytes = CLIP.slice(offset, offset + storedLength);
  const isRefused = hasCode('invalid', 'which a group of a clip alone has');
  assert.throws(() => new Scene(bytes, core), isRefused);
  await assert.rejects(
    withClip(bytes.buffer, {}, async () => {}),
    isRefused,
  );
});

test('shared planes have codecs of planes, and codec SHARED is for planes alone', () => {
  const { clip: moving } = made({ shared: first({ codec: CODEC.MOTION }) }, TINY);
  assert.throws(() => new Groups(moving, core), hasCode('newer', 'xy of scale 0, uses codec 4'));
  const { clip } = made({
    own: (parts) => parts.map((part) => (part.kind === 'OCCU' ? { ...part, codec: CODEC.SHARED } : part)),
  });
  assert.throws(() => new Groups(clip, core).open(0).occupancy, hasCode('newer', 'codec 8'));
});

test('shared planes come once from a server, however long the clip plays', async () => {
  await withServer(CLIP, {}, async (server) => {
    await withClip(server.url, { memory: 64 << 20 }, async (clip) => {
      await playsAt(clip, [0, 5, 9, 12, 18, 22, 27, 9, 0], SCENES);
      assert.ok(clip.memoryBytes <= 64 << 20, `${clip.memoryBytes}`);
      for (const { offset, storedLength } of sharedOf(CLIP)) {
        for (const position of [offset, offset + storedLength - 1]) {
          assert.equal(asked(server, position), 1, server.requests.join(' '));
        }
      }
    });
  });
});

for (const [name, faults] of Object.entries({
  'has no ranges': { hasRanges: false },
  'says nothing': { saysRange: false, etag: null },
  'breaks off': { cuts: [50_000, 100_000, 70_000, 0, 30_000] },
})) {
  test(`shared planes play from a server that ${name}`, async () => {
    await withServer(CLIP, faults, (server) => withClip(server.url, {}, (clip) => playsAt(clip, [0, 12, 25], SCENES)));
  });
}

test('shared planes play from memory, and from a file of the page', async () => {
  await withClip(CLIP.buffer, {}, (clip) => playsAt(clip, [0, 12, 25], SCENES));
  await withClip(new Blob([CLIP]), {}, (clip) => playsAt(clip, [25, 0], SCENES));
});

test('planes of the first scale come before finer ones, shared or not', async () => {
  const { index } = new Container(CLIP);
  const group = index.find(({ kind }) => kind === 'GRUP') as Entry;
  const finer = index.filter(({ kind, scale }) => kind === 'PLNE' && scale === 1);
  await withServer(CLIP, {}, async (server) => {
    await withClip(server.url, {}, async (clip) => {
      await until(clip, () => clip.canShow(0) && clip.scenes[0].completeScales === 2);
      const starts = server.requests.map((range) => Number(range.split('-')[0]));
      const early = starts.indexOf(group.offset);
      const late = server.requests.findIndex((_, number) => number > 0 && starts[number] < group.offset);
      assert.ok(early > 0 && early < late && starts[late] >= finer[0].offset, server.requests.join(' '));
    });
  });
});

test('a clip plays that is cut off within a group, or before shared planes', async () => {
  const { index } = new Container(CLIP);
  const [, second] = index.filter(({ kind }) => kind === 'GRUP');
  await withServer(CLIP.slice(0, second.offset + 40_000), {}, async (server) => {
    await withClip(server.url, {}, async (clip) => {
      await playsAt(clip, [0], SCENES);
      await until(clip, () => {
        clip.setPlayhead({ time: 12, rate: 1 });
        return clip.parts(12)[0].scene.group === 1 && clip.isSettled;
      });
      assert.deepEqual([clip.scenes[0].completeScales, clip.error], [2, null]);
      assert.ok(clip.notice?.includes('cut off'));
    });
  });
  const { clip: moved } = made({ isBehind: ({ scale }) => scale === 1 });
  const cut = moved.slice(0, sharedOf(moved)[4].offset);
  for (const isRemote of [false, true]) {
    await withServer(cut, {}, async (server) => {
      await withClip(isRemote ? server.url : cut.buffer, {}, async (clip) => {
        await until(clip, () => clip.canShow(0) && clip.isSettled);
        assert.deepEqual([clip.scenes[0].completeScales, clip.error], [1, null]);
        assert.ok(clip.notice?.includes('cut off'));
      });
    });
  }
  const groups = new Groups(cut, core, { allowPartial: true });
  assert.ok(!groups.available(2));
  const planes = groups.open(2).planes();
  const whole = new Groups(CLIP, core).open(2).planes();
  assert.deepEqual([planes[0], planes[1].xy], [whole[0], whole[1].xy]);
  assert.ok(planes[1].yz?.symbols.every((symbol) => symbol === 0));
});

test('a shared plane that comes damaged is fetched again, and kept whole', async () => {
  const { offset } = sharedOf(CLIP)[4];
  const damaged = CLIP.slice();
  damaged[offset + 100] ^= 1;
  await withServer(damaged, { etag: null }, async (server) => {
    await withClip(server.url, {}, async (clip) => {
      await until(clip, () => {
        if (asked(server, offset + 100) > 0) server.bytes = CLIP;
        return clip.isSettled;
      });
      await playsAt(clip, [12, 25], SCENES);
      assert.equal(asked(server, offset + 100), 2, server.requests.join(' '));
    });
    server.bytes = damaged;
    await withClip(server.url, {}, async (clip) => {
      await assert.rejects(playsAt(clip, [0], SCENES), hasCode('damaged', '(PLNE)'));
    });
  });
});

/** A source that counts what is asked of it, and takes a moment. */
class SlowSource extends BytesSource {
  readonly asked: string[] = [];

  override async read(start: number, end: number, options: ReadOptions = {}): Promise<Uint8Array> {
    this.asked.push(`${start}-${end}`);
    options.arrived?.((await super.read(start, end)).subarray(0, 100));
    await new Promise(setImmediate);
    if (options.signal?.aborted) throw new KpcError('ended', 'aborted');
    return super.read(start, end, options);
  }
}

const [SMALL, NEXT, , LARGE] = sharedOf(CLIP).map(({ offset, storedLength }) => [offset, offset + storedLength]);

test('what does not fit the memory of shared planes is fetched again', async () => {
  const source = new SlowSource(CLIP);
  const planes = new SharedPlanes(source, sharedOf(CLIP), LARGE[1] - LARGE[0] - 1);
  for (const [start, end] of [SMALL, LARGE, SMALL, LARGE, NEXT, [SMALL[0], LARGE[1]]]) {
    assert.deepEqual(await planes.read(start, end), CLIP.subarray(start, end));
    assert.ok(planes.memoryBytes <= planes.mostBytes && planes.mostBytes < LARGE[1] - LARGE[0]);
  }
  const again = LARGE.join('-');
  assert.deepEqual(source.asked, [SMALL.join('-'), again, again, NEXT.join('-'), `${NEXT[1]}-${LARGE[1]}`]);
});

test('planes that the group opened last does not use make room', async () => {
  const source = new SlowSource(CLIP);
  const planes = new SharedPlanes(source, sharedOf(CLIP), LARGE[1] - LARGE[0]);
  for (const [start, end] of [SMALL, NEXT, LARGE, SMALL]) await planes.read(start, end);
  assert.equal(source.asked.length, 4);
  assert.equal(planes.memoryBytes, SMALL[1] - SMALL[0]);
});

test('two groups that read a shared plane at once cause one request, unless it is ended', async () => {
  const source = new SlowSource(CLIP);
  const planes = new SharedPlanes(source, sharedOf(CLIP), 1 << 30);
  const seen: number[] = [];
  const both = [planes.read(SMALL[0], NEXT[1], { arrived: ({ length }) => seen.push(length) })];
  both.push(planes.read(NEXT[0], NEXT[1]));
  const [whole, part] = await Promise.all(both);
  assert.deepEqual([whole, part], [CLIP.subarray(SMALL[0], NEXT[1]), CLIP.subarray(NEXT[0], NEXT[1])]);
  assert.deepEqual([source.asked.length, seen], [1, [100, NEXT[1] - SMALL[0]]]);
  const [one, other, third] = [new AbortController(), new AbortController(), new AbortController()];
  const reads = [one, other, third].map(({ signal }) => planes.read(LARGE[0], LARGE[1], { signal }));
  one.abort();
  other.abort();
  const results = await Promise.allSettled(reads);
  assert.deepEqual(
    results.map((result) => (result.status === 'rejected' ? result.reason.code : result.value)),
    ['aborted', 'aborted', CLIP.subarray(LARGE[0], LARGE[1])],
  );
  assert.equal(source.asked.length, 3);
});
