"""A folder holds the results of one set of options at a time; machines that share it may each make some of them."""

import contextlib
import hashlib
import json
import uuid
from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import TYPE_CHECKING, Any

from kpc.format.common.errors import UsageError

if TYPE_CHECKING:
    from filelock import FileLock

# Seconds to wait for a lock that another process tries, to see whether its owner has ended.
TRIED_S = 5.0


@contextlib.contextmanager
def claimed(folder: Path, command: str, described: Mapping[str, Any]) -> Iterator[None]:
    """Keep runs of a command with other options out of a folder; those with the same may go on there together.

    Each run holds a lock file whose name says what it makes. The system releases the lock of a process that ends,
    however it ends, and the next run removes its file. Where a file system knows no locks, nothing is kept out.

    Args:
        folder: which is there.
        command: its name.
        described: what the results depend on, as values of JSON.

    Raises:
        UsageError: a run with other options is at work there.
    """
    from filelock import FileLock, Timeout  # here, since it imports asyncio

    kind = hashlib.sha256(json.dumps(described, sort_keys=True).encode()).hexdigest()[:12]
    mine = folder / f".{command}-{kind}-{uuid.uuid4().hex[:12]}.lock"
    lock = FileLock(mine)
    try:
        lock.acquire(timeout=TRIED_S)
    except NotImplementedError:
        mine.unlink(missing_ok=True)
        yield
        return
    try:
        for path in folder.glob(f".{command}-*.lock"):
            if path == mine:
                continue
            other = FileLock(path)
            try:
                other.acquire(timeout=0)
            except Timeout:
                if path.name.startswith(f".{command}-{kind}-"):
                    continue
                raise UsageError(
                    f"{folder}: another {command} with other options is at work there; wait for it, or give another "
                    "folder with -o"
                ) from None
            _remove(other, path)  # its owner has ended
        yield
    finally:
        _remove(lock, mine)


def _remove(lock: "FileLock", path: Path) -> None:
    lock.release()  # first, since Windows removes no open file; nobody else makes one of this name
    path.unlink(missing_ok=True)
