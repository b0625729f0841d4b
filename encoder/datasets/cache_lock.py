"""One process builds a cache while others wait for it."""

from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

from filelock import FileLock, Timeout

from kpc.format.common.text import notice


@contextmanager
def exclusive(path: Path) -> Iterator[None]:
    """Hold the lock file `path`; where another process holds it, say so on stderr and wait.

    The system releases the lock of a process that ends, however it ends.
    """
    path.parent.mkdir(parents=True, exist_ok=True)
    lock = FileLock(path)
    try:
        lock.acquire(timeout=0)
    except Timeout:
        notice(f"{path.parent}: another process decodes the same pictures; waiting for it")
        lock.acquire()
    try:
        yield
    finally:
        path.unlink(missing_ok=True)  # a process that waits for it notices, and makes another
        lock.release()
