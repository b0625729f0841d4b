/** Clips while they arrive: from servers with faults, in little memory, and after jumps of the playhead. */

import assert from 'node:assert/strict';
import test from 'node:test';

import { Container } from '../src/container/container.js';
import { Scene } from '../src/container/scene.js';
import { isTimePlane, PLANES, type PlaneHead } from '../src/container/scene_chunks.js';
import { loadCore } from '../src/decoder/module.js';
import { layerTexels } from '../src/decoder/texels.js';
import { Clip, type SceneEvent } from '../src/streaming/clip.js';
import type { TexelRows } from '../src/streaming/texel_queue.js';
import { read } from './files.js';
import { spawnScript } from './node_worker.js';
import { hasCode, until, withClip } from './playing.js';
import { withServer } from './server.js';
import { grouped, scene } from './writing.js';

const SAMPLE = read('samples/default.kpc');
/** 100 s in 16 segments of each time plane; the first request holds no more than scale 0. */
const SIZES = { frameCount: 1001, segmentRows: 32 };
const LONG = scene({
  ...SIZES,
  scales: [
    [4, 32, 32, 32, 512],
    [8, 64, 64, 64, 512],
  ],
});
const SHORT = {
  scales: [
    [4, 24, 24, 24, 32],
    [8, 48, 48, 48, 32],
  ] as [number, number, number, number, number][],
};
const core = await loadCore();

test('the index is read in a worker, whose time is limited', async () => {
  const endless = spawnScript('globalThis.onmessage = ({ data }) => "module" in data && postMessage({ ready: true });');
  const opening = Clip.open(SAMPLE.slice().buffer, { pool: { spawn: endless, deadlineMs: 500 } });
  await assert.rejects(opening, hasCode('invalid', 'takes longer than 0.5 s'));
});

/** Compare a scene that has arrived with one that was decoded at once. */
async function hasAll(clip: Clip, expected: Scene): Promise<void> {
  const planes = expected.planes();
  await until(
    clip,
    () => clip.isSettled,
    (_, rows) => {
      const { symbols, head } = planes[rows.scale][rows.plane] as { symbols: Int8Array; head: PlaneHead };
      const texels = layerTexels(symbols, head);
      const length = 4 * rows.layers * rows.columns;
      const from = rows.firstRow * length;
      assert.deepEqual(rows.texels, texels.subarray(from, from + rows.rowCount * length));
    },
  );
  const [stream] = clip.scenes;
  assert.equal(stream.completeScales, expected.head.scales.length);
  for (const [scale, found] of planes.entries()) {
    for (const name of PLANES) {
      const plane = found[name];
      if (!plane || !isTimePlane(name)) continue;
      const values = core.dequantise(plane.symbols, plane.head.step, plane.head.offset);
      const { rows, columns, channels } = plane.head;
      for (const row of [0, 1, rows - 1]) {
        const expectedRow = values.subarray(row * columns * channels, (row + 1) * columns * channels);
        assert.deepEqual(stream.row(scale, name, rows > 1 ? row / (rows - 1) : 0).length, expectedRow.length);
        for (const [k, value] of stream.row(scale, name, row / (rows - 1)).entries()) {
          assert.ok(Math.abs(value - expectedRow[k]) < 1e-4);
        }
      }
      const between = stream.row(scale, name, 0.5 / (rows - 1));
      for (let k = 0; k < columns * channels; k++) {
        assert.ok(Math.abs(between[k] - (values[k] + values[k + columns * channels]) / 2) < 1e-4);
      }
    }
  }
}

test('fetches a coarse picture and no more as long as that is all that is wanted', async () => {
  await withServer(LONG, {}, async (server) => {
    await withClip(server.url, { position: null }, async (clip) => {
      const [stream] = clip.scenes;
      clip.setPlayhead({ time: 50, isPreview: true });
      await until(clip, () => stream.completeScales === 1 && clip.canShow(50));
      const { length } = server.requests;
      await new Promise((resolve) => setTimeout(resolve, 30));
      assert.deepEqual([server.requests.length, stream.completeScales, clip.isSettled], [length, 1, false]);
      assert.ok(clip.receivedBytes < LONG.length / 4);
      clip.setPlayhead({ time: 50 });
      await until(clip, () => clip.isSettled);
    });
  });
});

test('plays the sample from memory and from a server', async () => {
  const expected = new Scene(SAMPLE, core);
  await withClip(SAMPLE.buffer.slice(0), {}, (clip) => hasAll(clip, expected));
  await withServer(SAMPLE, {}, async (server) => {
    await withClip(server.url, {}, async (clip) => {
      assert.equal(clip.fps, 12);
      assert.equal(clip.duration, 29 / 12);
      assert.deepEqual(clip.cameras, expected.cameras);
      assert.deepEqual(clip.metadata, expected.metadata);
      assert.deepEqual(clip.buffered, []);
      await hasAll(clip, expected);
      assert.deepEqual(clip.buffered, [[0, clip.duration]]);
      assert.equal(clip.message, null);
      assert.equal(clip.notice, null);
      assert.equal(server.requests.length, 1);
    });
  });
});

for (const [name, faults] of Object.entries({
  'has no ranges': { hasRanges: false },
  compresses: { hasRanges: false, isCompressed: true, saysLength: false },
  'says nothing': { saysRange: false, etag: null },
  'breaks off': { cuts: [50_000, 100_000, 70_000, 0, 30_000] },
  'is overloaded': { statuses: [503, 503] },
})) {
  test(`plays from a server that ${name}`, async () => {
    await withServer(LONG, faults, async (server) => {
      await withClip(server.url, {}, (clip) => hasAll(clip, new Scene(LONG, core)));
    });
  });
}

test('the coarse picture comes first, then a finer one, then what is ahead', async () => {
  const { index } = new Container(LONG);
  const finer = index.findIndex((entry) => entry.scale === 1);
  await withServer(LONG, { allowed: index[finer + 2].offset }, async (server) => {
    await withClip(server.url, {}, async (clip) => {
      clip.setPlayhead({ time: 0, rate: 1 });
      const scales: number[] = [];
      const [stream] = clip.scenes;
      await until(
        clip,
        () => clip.canShow(0),
        (_, rows) => scales.push(rows.scale),
      );
      assert.equal(stream.completeScales, 1);
      const [[start, end], ...others] = clip.buffered;
      assert.ok(start === 0 && end > 6 && end < 7 && others.length === 0, `${clip.buffered}`);
      server.allowed = Number.MAX_SAFE_INTEGER;
      await until(
        clip,
        () => stream.completeScales === 2 && clip.canShow(0),
        (_, rows) => scales.push(rows.scale),
      );
      assert.deepEqual(scales, [...scales].sort());
      await until(clip, () => clip.isSettled);
    });
  });
});

test('a finer scale is not shown before its time planes are there, so that playing goes on', async () => {
  const { index } = new Container(LONG);
  const finer = index.findIndex((entry) => entry.scale === 1);
  await withServer(LONG, { allowed: index[finer + 3].offset }, async (server) => {
    await withClip(server.url, {}, async (clip) => {
      const [stream] = clip.scenes;
      clip.setPlayhead({ time: 0, rate: 1 });
      await until(clip, () => clip.canShow(0));
      const shown: string[] = [];
      const end = performance.now() + 200; // long enough to decode what has come
      await until(
        clip,
        () => {
          assert.ok(clip.canShow(0) && clip.buffered[0]?.[1] > 0);
          return performance.now() > end;
        },
        (_, { scale, plane }) => shown.push(`${scale} ${plane}`),
      );
      assert.deepEqual([stream.completeScales, shown], [1, ['1 xy', '1 xz']]);
      server.allowed = Number.MAX_SAFE_INTEGER;
      await until(clip, () => {
        assert.ok(clip.canShow(0) && clip.buffered[0][1] > 0);
        return stream.completeScales === 2;
      });
    });
  });
});

test('a jump fetches what the picture needs before what lies in between', async () => {
  await withServer(LONG, { rate: 400_000 }, async (server) => {
    await withClip(server.url, {}, async (clip) => {
      await until(clip, () => clip.canShow(0));
      const before = clip.receivedBytes;
      const atJump = server.requests.length;
      clip.setPlayhead({ time: 70, rate: 1 });
      assert.ok(!clip.canShow(70));
      await until(clip, () => clip.canShow(70));
      assert.ok(clip.receivedBytes - before < 150_000, `${clip.receivedBytes - before} bytes`);
      const { index } = new Container(LONG);
      const firstRow = Math.floor(0.7 * 511);
      const wanted = index.find((e) => e.plane > 2 && e.rowStart <= firstRow && firstRow < e.rowStart + e.rowCount);
      const [from, to] = server.requests[atJump].split('-').map(Number);
      assert.ok(from <= (wanted?.offset ?? 0) && (wanted?.offset ?? 0) < to, server.requests.join(' '));
      assert.ok(
        clip.buffered.some(([start, end]) => start <= 70 && 70 < end),
        `${clip.buffered}`,
      );
    });
  });
});

test('a clip that begins elsewhere fetches what is there', async () => {
  await withServer(LONG, { allowed: 200_000 }, async (server) => {
    await withClip(server.url, { position: { time: 70 } }, async (clip) => {
      await until(clip, () => clip.canShow(70));
      assert.ok(!clip.canShow(20));
    });
  });
});

test('planes may wait until they are wanted', async () => {
  await withServer(LONG, {}, async (server) => {
    await withClip(server.url, { position: null }, async (clip) => {
      await new Promise((resolve) => setTimeout(resolve, 50));
      assert.equal(server.requests.length, 1);
      clip.setPlayhead({ time: 0 });
      await until(clip, () => clip.isSettled);
    });
  });
});

test('a long scene plays in little memory, and what was dropped comes again', async () => {
  const all = new Scene(LONG, core).head.valueCount;
  const pool = { memory: 2 << 20 };
  await withServer(LONG, {}, async (server) => {
    let memory = 0;
    await withClip(server.url, { pool }, async (clip) => {
      memory = clip.memoryBytes - clip.scenes[0].heldBytes + Math.round(0.4 * all);
    });
    await withClip(server.url, { memory, pool }, async (clip) => {
      const [stream] = clip.scenes;
      for (const time of [0, 20, 40, 60, 80, 99, 0, 50]) {
        clip.setPlayhead({ time, rate: 1 });
        await until(clip, () => clip.canShow(time) && stream.isSettled);
        assert.ok(clip.memoryBytes <= memory, `${clip.memoryBytes}`);
        assert.ok(stream.row(1, 'xt', time / clip.duration).some((value) => value !== 1));
      }
      clip.setPlayhead({ time: 0 });
      await until(clip, () => stream.isSettled);
      assert.ok(stream.row(1, 'xt', 0.9).every((value) => value === 1));
    });
    await assert.rejects(
      withClip(server.url, { memory: 4 << 20 }, async () => {}),
      hasCode('budget'),
    );
  });
});

test('groups that follow each other are buffered without a gap between their frames', async () => {
  const group = scene({ ...SHORT, frameCount: 101, segmentRows: 32 });
  const { valueCount } = new Container(group).header;
  await withClip(grouped([group, group], 101, 0, valueCount).buffer as ArrayBuffer, {}, async (clip) => {
    clip.setPlayhead({ time: 9.5, rate: 1 });
    await until(clip, () => clip.scenes.length === 2 && clip.isSettled);
    assert.deepEqual(clip.buffered, [[0, clip.duration]]);
  });
});

test('groups are opened ahead, blended, and released behind the playhead', async () => {
  const group = scene({ ...SHORT, frameCount: 101, segmentRows: 32 });
  const { valueCount } = new Container(group).header;
  const clipFile = grouped([group, group, group, group, group], 101, 11, valueCount);
  const memory = 64 << 20;
  await withServer(clipFile, {}, async (server) => {
    await withClip(server.url, { memory }, async (clip) => {
      assert.equal(clip.frameCount, 461);
      const events: string[] = [];
      for (const type of ['open', 'release']) {
        clip.addEventListener(type, (event) => events.push(`${type} ${(event as SceneEvent).scene.group}`));
      }
      for (let time = 0; time < clip.duration; time += 0.25) {
        clip.setPlayhead({ time, rate: 1 });
        await until(clip, () => {
          clip.setPlayhead({ time, rate: 1 });
          return clip.canShow(time);
        });
        const parts = clip.parts(time);
        assert.deepEqual(
          parts.map(({ scene: one, share, time: localTime }) => ({ group: one.group, localTime, share })),
          clip.timeline.blendAt(time / clip.duration),
        );
        assert.ok(clip.scenes.length <= 2);
        assert.ok(clip.memoryBytes <= memory, `${clip.memoryBytes}`);
        assert.ok(
          clip.buffered.some(([start, end]) => start <= time && time <= end),
          `${time} of ${clip.buffered}`,
        );
      }
      const order = [1, 2, 3, 4].flatMap((number) => [`open ${number}`, `release ${number - 1}`]);
      assert.deepEqual(
        events.filter((event) => event !== 'open 0' && event !== 'release 3').slice(0, 7),
        order.slice(0, 7),
      );
      clip.setPlayhead({ time: 15, rate: 0 });
      await until(clip, () => {
        clip.setPlayhead({ time: 15, rate: 0 });
        return clip.canShow(15);
      });
      assert.equal(clip.parts(15)[0].scene.group, 1);
    });
  });
});

test('the beginning of another group is requested once when the playhead jumps there', async () => {
  const group = scene({ ...SHORT, frameCount: 101, segmentRows: 32 });
  const { valueCount } = new Container(group).header;
  const clipFile = grouped([group, group, group], 101, 1, valueCount);
  const { offset } = new Container(clipFile).index[2];
  const content = new Container(group).index.findIndex(({ kind }) => kind === 'PLNE');
  await withServer(clipFile, {}, async (server) => {
    await withClip(server.url, {}, async (clip) => {
      const position = { time: 0.9 * clip.duration };
      await until(clip, () => {
        clip.setPlayhead(position);
        return clip.canShow(position.time);
      });
      assert.equal(clip.parts(position.time)[0].scene.group, 2);
      const planes = offset + new Container(group).index[content].offset;
      const ranges = server.requests.map((range) => range.split('-').map(Number));
      const opening = ranges.filter(([from, to]) => from < planes && to >= offset);
      assert.equal(opening.length, 1, server.requests.join(' '));
    });
  });
});

test('a damaged chunk is fetched again, and reported if it stays so', async () => {
  const damaged = LONG.slice();
  const entry = new Container(LONG).index[12];
  damaged[entry.offset + 5] ^= 1;
  await withServer(damaged, { etag: null }, async (server) => {
    await withClip(server.url, {}, async (clip) => {
      clip.addEventListener('arrived', () => {});
      let errors = 0;
      clip.addEventListener('error', () => errors++);
      await assert.rejects(
        until(clip, () => clip.isSettled && !clip.error),
        hasCode('damaged', 'chunk 12'),
      );
      assert.equal(errors, 1);
      assert.ok(clip.message?.startsWith('loading stopped'));
    });
    await withClip(server.url, {}, async (clip) => {
      const asked = `${entry.offset}-${entry.offset + entry.storedLength - 1}`;
      await until(clip, () => {
        if (clip.receivedBytes > 0) server.bytes = LONG;
        return clip.isSettled;
      });
      assert.ok(server.requests.filter((range) => range === asked).length > 0);
    });
  });
});

test('a file that is replaced while its server says nothing of it is no damaged file', async () => {
  const group = scene({ ...SHORT, frameCount: 101, segmentRows: 32 });
  const { valueCount } = new Container(group).header;
  const clipFile = grouped([group, group, group], 101, 1, valueCount);
  for (const other of [grouped([LONG, LONG], 101, 1, valueCount), LONG, clipFile.subarray(0, 5000).toReversed()]) {
    await withServer(clipFile, { etag: null, saysRange: false }, async (server) => {
      await withClip(server.url, { position: { time: 0, isPreview: true } }, async (clip) => {
        server.bytes = other;
        const time = 0.9 * clip.duration;
        const jump = until(clip, () => {
          clip.setPlayhead({ time });
          return clip.canShow(time);
        });
        await assert.rejects(jump, hasCode('replaced'));
      });
    });
  }
});

test('a file that is cut off plays as far as it goes', async () => {
  const { index } = new Container(LONG);
  const cut = LONG.slice(0, index[40].offset + 10);
  await withServer(cut, {}, async (server) => {
    await withClip(server.url, {}, async (clip) => {
      await until(clip, () => clip.isSettled);
      const [there, all] = [cut, LONG].map(({ length }) => length.toLocaleString('en'));
      assert.equal(clip.notice, `cut off at ${there} of ${all} bytes; what is there is played`);
      assert.ok(clip.buffered[0][1] < clip.duration);
      assert.equal(clip.error, null);
    });
  });
});

test('a clip that is cut off plays without the groups that are not there', async () => {
  const group = scene({ ...SHORT, frameCount: 101, segmentRows: 32 });
  const whole = grouped([group, group, group], 101, 11, new Container(group).header.valueCount);
  const second = new Container(whole).index.filter(({ kind }) => kind === 'GRUP')[1];
  const planes = new Container(group).index.filter(({ kind }) => kind === 'PLNE');
  for (const there of [-1, 0, 30, 400, planes[1].offset + 5]) {
    const cut = whole.slice(0, second.offset + there);
    for (const faults of [null, {}, { hasRanges: false }, { saysRange: false }]) {
      const plays = async (clip: Clip) => {
        await until(clip, () => clip.isSettled && clip.canShow(0));
        // Where the second group would be blended, where it would be alone, at the end, and back at the beginning.
        for (const share of [0.33, 0.5, 1, 0]) {
          const time = share * clip.duration;
          await until(clip, () => {
            clip.setPlayhead({ time, rate: 1, loop: share === 1 });
            return clip.canShow(time) && clip.isSettled;
          });
          assert.deepEqual(
            clip.parts(time).map(({ scene: { group }, share }) => [group, share]),
            [[0, 1]],
          );
        }
        assert.deepEqual([clip.error, clip.message], [null, null]);
        assert.ok(clip.notice?.startsWith('cut off'));
      };
      if (faults === null) await withClip(cut.buffer, {}, plays);
      else await withServer(cut, faults, (server) => withClip(server.url, {}, plays));
    }
  }
});

test('what is cut off before there is a picture is refused', async () => {
  const planes = new Container(LONG).index.filter(({ kind }) => kind === 'PLNE');
  const cut = LONG.slice(0, planes[2].offset + 1);
  await assert.rejects(
    withClip(cut.buffer, {}, async () => {}),
    hasCode('cut-off'),
  );
  await withServer(cut, { hasRanges: false }, async (server) => {
    const playing = withClip(server.url, {}, (clip) => until(clip, () => false));
    await assert.rejects(playing, hasCode('cut-off', 'before there is anything to show'));
  });
  const clip = grouped([LONG, LONG], 1001, 1, new Container(LONG).header.valueCount);
  const { offset } = new Container(clip).index[0];
  await assert.rejects(
    withClip(clip.slice(0, offset).buffer, {}, async () => {}),
    hasCode('cut-off'),
  );
});

test('what cannot be opened says why', async () => {
  const open = (bytes: Uint8Array) => withServer(bytes, {}, (server) => withClip(server.url, {}, async () => {}));
  await assert.rejects(open(new TextEncoder().encode('<!doctype html>')), hasCode('foreign'));
  await assert.rejects(
    withClip(new ArrayBuffer(0), {}, async () => {}),
    hasCode('empty', 'the file is empty'),
  );
  await assert.rejects(open(read('spec/vectors/invalid/draft-1.kpc')), hasCode('draft'));
  await assert.rejects(open(SAMPLE.slice(0, 2000)), hasCode('cut-off'));
  const newer = SAMPLE.slice();
  newer[8] = 2;
  await assert.rejects(open(newer), hasCode('newer'));
  const trailing = new Uint8Array(SAMPLE.length + 1);
  trailing.set(SAMPLE);
  await assert.rejects(open(trailing), hasCode('invalid', '1 bytes follow'));
  for (const text of ['no address', '', 'http://[', 'https://h:99999/x.kpc']) {
    await assert.rejects(
      withClip(text, {}, async () => {}),
      hasCode('not-found', 'is no address'),
    );
  }
  const control = new AbortController();
  control.abort();
  await withServer(SAMPLE, {}, async (server) => {
    await assert.rejects(
      withClip(server.url, { signal: control.signal }, async () => {}),
      hasCode('aborted'),
    );
  });
});

test('space planes come again for a renderer that has lost them', async () => {
  await withServer(LONG, {}, async (server) => {
    await withClip(server.url, {}, async (clip) => {
      await until(clip, () => clip.isSettled);
      const [stream] = clip.scenes;
      stream.restore();
      assert.equal(stream.completeScales, 0);
      let planes = 0;
      await until(
        clip,
        () => clip.isSettled,
        () => planes++,
      );
      assert.equal(planes, 6);
    });
  });
});

test('texels are taken row by row, one plane after the other', async () => {
  const planes = new Scene(SAMPLE, core).planes();
  await withClip(SAMPLE.buffer.slice(0), {}, async (clip) => {
    const [stream] = clip.scenes;
    const taken: Pick<TexelRows, 'scale' | 'plane' | 'firstRow'>[] = [];
    while (!clip.isSettled) {
      const found = stream.take(1);
      assert.ok(found.every(({ rowCount }) => rowCount === 1) && found.length <= 1);
      taken.push(...found.map(({ scale, plane, firstRow }) => ({ scale, plane, firstRow })));
      if (found.length === 0) await new Promise((resolve) => setTimeout(resolve, 5));
    }
    const begun = taken.filter(({ firstRow }) => firstRow === 0); // in the order in which workers decode them
    const expected = begun.flatMap(({ scale, plane }) => {
      const { rows } = (planes[scale][plane] as { head: PlaneHead }).head;
      return [...Array(rows).keys()].map((firstRow) => ({ scale, plane, firstRow }));
    });
    assert.equal(begun.length, 3 * planes.length);
    assert.deepEqual(taken, expected);
  });
});

test('a closed clip asks for nothing more', async () => {
  await withServer(LONG, { rate: 300_000 }, async (server) => {
    await withClip(server.url, {}, async (clip) => {
      await until(clip, () => clip.receivedBytes > 70_000);
      clip.close();
      const { length } = server.requests;
      clip.setPlayhead({ time: 50 });
      await new Promise((resolve) => setTimeout(resolve, 100));
      assert.equal(server.requests.length, length);
    });
  });
});
