"""Work on arrays, shared out among a processor's cores. For compiled functions, which let others run meanwhile."""

import os
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor

CORES = os.cpu_count() or 1
_POOL = ThreadPoolExecutor(CORES, thread_name_prefix="cores")


def share_out(work: Callable[[slice], object], count: int) -> None:
    """Call `work` for parts of range(count), one for each core, and wait for all."""
    ends = [count * part // CORES for part in range(CORES + 1)]
    parts = [slice(*part) for part in zip(ends, ends[1:]) if part[0] < part[1]]
    others = [_POOL.submit(work, part) for part in parts[1:]]
    for part in parts[:1]:
        work(part)
    for other in others:
        other.result()
