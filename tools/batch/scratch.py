"""The folder of a machine in which tasks work: one for each task, and what several tasks share.

    kpbatch/task-PID-KEY/      what a task works on; removed when it ends, or once its process is found to be gone
    kpbatch/sources/ADDRESS/   a source that was fetched
    kpbatch/pixels/ADDRESS/    decoded pixels of a source, for kpenc --cache

What is shared is removed once no task has used it for a while.
"""

import contextlib
import os
import shutil
import socket
import tempfile
import time
from collections.abc import Iterator
from pathlib import Path

import fsspec
from filelock import FileLock

from kpc.format.common.errors import KpcError
from kpc.tools.batch.addresses import source_address

SOURCES, PIXELS = "sources", "pixels"
# The file in the folder of a task that names what it uses of what is shared, one folder a line.
USES = "uses"
# Seconds for which shared folders are kept that no task uses: the next task of that source may be about to begin.
KEPT_S = 600


class TaskError(KpcError):
    """A task failed; the message says why."""


class Scratch:
    """What the tasks of a machine work on.

    Args:
        parent: the folder that holds it; empty for the system's temporary folder.
    """

    def __init__(self, parent: str = "") -> None:
        self.base = Path(parent or tempfile.gettempdir()) / "kpbatch"

    @contextlib.contextmanager
    def task_folder(self, key: str) -> Iterator[Path]:
        """Yield an empty folder, which is removed at the end; remove first what nobody needs any more."""
        self.base.mkdir(parents=True, exist_ok=True)
        self.tidy()
        folder = self.base / f"task-{os.getpid()}-{key}"
        shutil.rmtree(folder, ignore_errors=True)
        folder.mkdir()
        try:
            yield folder
        finally:
            for name in _uses(folder):
                with contextlib.suppress(OSError):
                    os.utime(self.base / name)  # its last use
            shutil.rmtree(folder, ignore_errors=True)

    def tidy(self, kept_s: float = KEPT_S) -> None:
        """Remove folders of tasks whose processes are gone, and what is shared but has not been used for so long."""
        if not self.base.exists():
            return
        for folder in self.base.glob("task-*-*"):
            if not _is_alive(int(folder.name.split("-")[1])):
                shutil.rmtree(folder, ignore_errors=True)
        with self._lock():
            used = {name for folder in self.base.glob("task-*-*") for name in _uses(folder)}
            for shared in (*self.base.glob(f"{SOURCES}/*"), *self.base.glob(f"{PIXELS}/*")):
                with contextlib.suppress(FileNotFoundError):  # another worker was faster
                    is_old = time.time() - shared.stat().st_mtime >= kept_s
                    if is_old and shared.relative_to(self.base).as_posix() not in used:
                        shutil.rmtree(shared, ignore_errors=True)

    def pixels(self, source: str, task_folder: Path) -> Path:
        """Return the folder for decoded pixels of a source, which stays while a task uses it."""
        return self._shared(PIXELS, source, task_folder)

    def source(self, source: str, task_folder: Path) -> str:
        """Return the path of a source; fetch what lies at an address, once for all tasks of this machine.

        Raises:
            TaskError: this machine has no such path.
        """
        if "://" not in source:
            if not Path(source).exists():
                machine = socket.gethostname()
                raise TaskError(f"{source}: is not on {machine}; share that folder, or name it by an address")
            return source
        target = self._shared(SOURCES, source, task_folder) / source.rstrip("/").rsplit("/", 1)[-1]
        if not target.exists():
            with tempfile.TemporaryDirectory(dir=target.parent) as folder:
                fetched = Path(folder) / target.name
                fs, root = fsspec.core.url_to_fs(source)
                for name in sorted(fs.find(root)) or [root]:
                    inner = name.removeprefix(root).lstrip("/")
                    file = fetched / inner if inner else fetched
                    file.parent.mkdir(parents=True, exist_ok=True)
                    fs.get_file(name, str(file))
                with contextlib.suppress(OSError):  # another task was faster
                    fetched.rename(target)
        return str(target)

    def _shared(self, kind: str, source: str, task_folder: Path) -> Path:
        """Return a shared folder, made if necessary, and note that a task uses it."""
        name = f"{kind}/{source_address(source)}"
        with self._lock():
            with (task_folder / USES).open("a") as uses:
                uses.write(f"{name}\n")
            (self.base / name).mkdir(parents=True, exist_ok=True)
        return self.base / name

    def _lock(self) -> FileLock:
        return FileLock(self.base / ".lock")


def _uses(task_folder: Path) -> list[str]:
    """Return what a task uses of what is shared: names of folders."""
    try:
        return (task_folder / USES).read_text().split()
    except FileNotFoundError:
        return []


def _is_alive(pid: int) -> bool:
    try:
        os.kill(pid, 0)
    except ProcessLookupError:
        return False
    except PermissionError:
        return True
    return True
