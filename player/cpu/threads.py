"""Work on arrays, shared out among a processor's cores. For compiled functions, which let others run meanwhile."""

import os
from collections import deque
from collections.abc import Callable, Sequence
from concurrent.futures import ThreadPoolExecutor
from typing import Any

CORES = os.cpu_count() or 1
WORKERS = min(CORES, 8)
"""Of `from_both_ends`, each of which may need arrays of its own."""
PARTS_EACH = 8
"""Of work that is not even, so that all are busy to the end."""
_POOL = ThreadPoolExecutor(CORES, thread_name_prefix="cores")


def share_out(work: Callable[[slice], object], count: int) -> None:
    """Call `work` for parts of range(count), one for each core, and wait for all."""
    _at_once(work, _parts(count, CORES))


def from_both_ends(work: Callable[[int, slice], object], count: int, least: int) -> None:
    """Call `work` with the number of a worker, below WORKERS, and a part of range(count), of at least so many, until nothing is left. Workers take
    what is next from one end or the other: what one does has neighbours that it has done."""
    parts = deque(_parts(count, max(1, min(WORKERS * PARTS_EACH, count // least))))

    def run(worker: int) -> None:
        take = parts.pop if worker % 2 else parts.popleft
        while True:
            try:
                part = take()
            except IndexError:
                return
            work(worker, part)

    _at_once(run, range(min(WORKERS, len(parts))))


def _at_once(work: Callable[[Any], object], things: Sequence[Any]) -> None:
    """Call `work` for each, the first by this thread, and wait for all."""
    others = [_POOL.submit(work, thing) for thing in things[1:]]
    for thing in things[:1]:
        work(thing)
    for other in others:
        other.result()


def _parts(count: int, most: int) -> list[slice]:
    """Of range(count), about even, as many as there can be."""
    ends = [count * part // most for part in range(most + 1)]
    return [slice(*part) for part in zip(ends, ends[1:]) if part[0] < part[1]]
