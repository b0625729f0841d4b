"""Sharing out work on arrays among a processor's cores, for compiled functions that release the GIL."""

import os
from collections import deque
from collections.abc import Callable, Sequence
from concurrent.futures import ThreadPoolExecutor
from itertools import pairwise
from typing import Any

CORES = os.cpu_count() or 1
# Workers of `from_both_ends`, each of which may need arrays of its own.
WORKERS = min(CORES, 8)
# Parts for each worker where work is uneven, so that all are busy to the end.
PARTS_EACH = 8
_POOL = ThreadPoolExecutor(CORES, thread_name_prefix="cores")


def share_out(work: Callable[[slice], object], count: int) -> None:
    """Call `work` for parts of range(count), one for each core, and wait for all."""
    _run_all(work, _parts(count, CORES))


def from_both_ends(work: Callable[[int, slice], object], count: int, least: int) -> None:
    """Call `work` with the number of a worker, below WORKERS, and a part of range(count), until nothing is left.

    Workers take the next part from one end or the other, so that most parts of a worker are neighbours, whose data its
    cache holds.

    Args:
        least: size of a part, at least.
    """
    parts = deque(_parts(count, max(1, min(WORKERS * PARTS_EACH, count // least))))

    def run(worker: int) -> None:
        take = parts.pop if worker % 2 else parts.popleft
        while True:
            try:
                part = take()
            except IndexError:
                return
            work(worker, part)

    _run_all(run, range(min(WORKERS, len(parts))))


def _run_all(work: Callable[[Any], object], items: Sequence[Any]) -> None:
    """Call `work` for each item at once, for the first by this thread, and wait for all."""
    others = [_POOL.submit(work, item) for item in items[1:]]
    for item in items[:1]:
        work(item)
    for other in others:
        other.result()


def _parts(count: int, most: int) -> list[slice]:
    """Split range(count) into at most so many parts of about the same size."""
    ends = [count * part // most for part in range(most + 1)]
    return [slice(*part) for part in pairwise(ends) if part[0] < part[1]]
