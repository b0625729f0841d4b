"""Time of decoding the plane segments of a file by the decoder core, on one thread and on two."""

import statistics
import time
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path

from kpc.format.container.scene_io import SceneReader
from kpc.format.container.scene_reader import largest_first
from kpc.format.scene.scene import ALL_PLANES, TIME_PLANES
from kpc.tools.bench.records import Record

PASSES = 10  # over all segments; of each segment the shortest time counts, since other programs only add to it


def measure(path: Path) -> Record:
    """Return what decoding a file takes, in milliseconds, once everything is loaded.

    `slowest_time_segment_ms` is None where the scene has no time planes.
    """
    reader = SceneReader(path)
    segments = largest_first(reader, [number for number, entry in enumerate(reader.index) if entry.kind == "PLNE"])

    def decode(number: int) -> float:
        start = time.perf_counter()
        reader.segment(number)
        return 1e3 * (time.perf_counter() - start)

    first_ms = _elapsed_ms(lambda: list(map(decode, segments)))  # loads the module, and reads the file
    passes: list[list[float]] = []
    one_thread_ms = [_elapsed_ms(lambda: passes.append(list(map(decode, segments)))) for _ in range(PASSES)]
    each = dict(zip(segments, map(min, zip(*passes, strict=True)), strict=True))
    with ThreadPoolExecutor(2) as pool:
        list(pool.map(decode, segments))  # each thread gets an instance of its own
        two_threads_ms = _elapsed_ms(lambda: list(pool.map(decode, segments)))
    over_time = (ms for number, ms in each.items() if ALL_PLANES[reader.index[number].plane] in TIME_PLANES)
    return {
        "segments": len(segments),
        "symbols": reader.head.value_count,
        "first_ms": first_ms,
        "decode_ms": statistics.median(one_thread_ms),
        "two_threads_ms": two_threads_ms,
        "slowest_segment_ms": max(each.values()),
        "slowest_time_segment_ms": max(over_time, default=None),
    }


def _elapsed_ms(work: Callable[[], object]) -> float:
    start = time.perf_counter()
    work()
    return 1e3 * (time.perf_counter() - start)
