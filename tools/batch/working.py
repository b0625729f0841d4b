"""What a worker does: run kpenc on a task in a process of its own, and keep what it has come to in the store.

Checkpoints go to the store as they are written, so another worker goes on from there if this one is killed.
"""

import contextlib
import json
import os
import re
import socket
import subprocess
import sys
import time
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from fnmatch import fnmatch
from pathlib import Path
from typing import Any

from kpc.format.common.errors import KpcError
from kpc.tools.batch.scratch import Scratch, TaskError
from kpc.tools.batch.store import LOG, RESULT, SCENE, WORK, Store
from kpc.tools.batch.tasks import ENCODE, JOIN, PREPARE, Outcome, Task

POLL_S = 0.25
# Lines of a log that a failure shows.
LAST_LINES = 4
# Files of a work folder that other workers make by themselves.
LOCAL_FILES = ("pixels-*", ".*", "*.lock")
# Figures of groups that are averaged over their tested pictures, and those that are added up.
MEANS = ("test_psnr", "test_psnr_moving", "test_psnr_still", "test_ssim")
SUMS = ("test_pictures", "steps", "train_s", "coding_s", "encode_s")
THREADS = ("OMP_NUM_THREADS", "MKL_NUM_THREADS", "OPENBLAS_NUM_THREADS", "NUMBA_NUM_THREADS")
# What a line of progress of kpenc says, and the PSNR of its lines about training and held-out views.
PROGRESS = {"percent": r": (\d+) %", "left_s": r"(\d+) s left"}
PSNR = re.compile(r"(?:\bstep [\d,]+, |held-out PSNR )([\d.]+) dB")

# Takes the progress of a task that runs: percent done, seconds left, and PSNR, as far as they are known.
Report = Callable[[dict[str, float]], None]


@dataclass(frozen=True)
class Place:
    """Where tasks are done.

    Attributes:
        store: address of the shared place.
        scratch: folder of each worker for what it works on; empty for the system's.
    """

    store: str
    scratch: str = ""


def run(task: Task, place: Place, report: Report = lambda _: None) -> Outcome:
    """Do a task; return its outcome, of a failure, too.

    Nothing is done twice: if the result is in the store, it is returned.
    """
    started, worker = time.monotonic(), f"{socket.gethostname()}:{os.getpid()}"
    try:
        store = Store(place.store)
        if store.exists(f"{task.key}/{RESULT}"):
            return Outcome(task.key, True, store.get_json(f"{task.key}/{RESULT}"))
        scratch = Scratch(place.scratch)
        with scratch.task_folder(task.key) as folder:
            figures = _run_in(folder, task, store, scratch, report)
        store.put_json(figures, f"{task.key}/{RESULT}")
        if task.kind != PREPARE:
            store.remove(f"{task.key}/{WORK}")
    except (KpcError, OSError) as error:
        return Outcome(task.key, False, {}, str(error), time.monotonic() - started, worker)
    return Outcome(task.key, True, figures, "", time.monotonic() - started, worker)


def _run_in(folder: Path, task: Task, store: Store, scratch: Scratch, report: Report) -> dict[str, Any]:
    """Do a task in an empty folder, and bring all but its figures to the store; return those."""
    work, scene = folder / WORK, folder / SCENE
    work.mkdir()
    if task.kind == JOIN:
        parts = [folder / f"{number:04d}.kpc" for number in range(len(task.before))]
        for key, part in zip(task.before, parts, strict=True):
            store.get(f"{key}/{SCENE}", part)
        if len(parts) == 1:
            parts[0].rename(scene)
        else:
            _child(["kpjoin", *map(str, parts), "-o", str(scene)], task, folder, store, report)
        figures = combine([store.get_json(f"{key}/{RESULT}") for key in task.before])
        figures["size_bytes"] = scene.stat().st_size
    else:
        for key in task.before:
            store.get_folder(f"{key}/{WORK}", work)
        resumes = store.get_folder(f"{task.key}/{WORK}", work)
        source = scratch.source(task.source, folder)
        command = [source, "-o", str(scene), *task.words]
        if Path(source).is_dir():  # a file is coded anew, which needs no work folder
            command += [f"--work={work}", *["--resume"] * (resumes and task.kind == ENCODE)]
            if task.shares_source and not any(word.startswith("--cache") for word in task.words):
                command.append(f"--cache={scratch.pixels(task.source, folder)}")
        if task.kind == ENCODE:
            figures = _child(["kpenc", *command, "--json"], task, folder, store, report)
        else:
            figures = _child(["prepare", *command], task, folder, store, report)
            Uploads(work, store, f"{task.key}/{WORK}").run()
    if scene.exists():
        store.put(scene, f"{task.key}/{SCENE}")
    return figures


def combine(parts: Sequence[Mapping[str, Any]]) -> dict[str, Any]:
    """Return figures of a clip from those of its groups: means over tested pictures, and sums of times."""
    found: dict[str, Any] = {"groups": len(parts)}
    for name in MEANS:
        known = [part for part in parts if part.get(name) is not None and part.get("test_pictures")]
        pictures = sum(part["test_pictures"] for part in known)
        found[name] = sum(part["test_pictures"] * part[name] for part in known) / pictures if pictures else None
    return found | {name: sum(part.get(name) or 0 for part in parts) for name in SUMS}


def _child(command: list[str], task: Task, folder: Path, store: Store, report: Report) -> dict[str, Any]:
    """Run a command in a process that ends with this one; return what it printed as JSON.

    Raises:
        TaskError: it failed.
    """
    log, out = folder / LOG, folder / "out.json"
    words = [sys.executable, "-m", "kpc.tools.batch.child", str(os.getpid()), *command]
    environment = os.environ | dict.fromkeys(THREADS, str(task.resources.cores))
    uploads = Uploads(folder / WORK, store, f"{task.key}/{WORK}")
    with log.open("wb") as errors, out.open("wb") as results:
        process = subprocess.Popen(words, stdin=subprocess.DEVNULL, stdout=results, stderr=errors, env=environment)
    try:
        while process.poll() is None:
            time.sleep(POLL_S)
            uploads.run()
            report(_progress(log))
    finally:
        process.kill()
        process.wait()
        store.put(log, f"{task.key}/{LOG}")
    if process.returncode:
        lines = log.read_text(errors="replace").strip().splitlines()[-LAST_LINES:]
        raise TaskError("\n".join(lines) or f"ended with exit code {process.returncode}")
    try:
        figures: dict[str, Any] = json.loads(out.read_text() or "{}")
    except ValueError:
        figures = {}  # of a command that prints none
    figures.pop("file", None)  # that of this folder
    return figures


class Uploads:
    """Brings the files of a work folder to the store whenever they have changed."""

    def __init__(self, work: Path, store: Store, name: str) -> None:
        self._work, self._store, self._name = work, store, name
        self._sent: dict[Path, tuple[int, int]] = {}

    def run(self) -> None:
        for file in sorted(self._work.rglob("*")):
            inner = file.relative_to(self._work)
            if any(fnmatch(part, each) for part in inner.parts for each in LOCAL_FILES):
                continue
            with contextlib.suppress(FileNotFoundError):  # it has been removed or renamed
                state = file.stat()
                if file.is_file() and self._sent.get(inner) != (state.st_mtime_ns, state.st_size):
                    self._store.put(file, f"{self._name}/{inner.as_posix()}")
                    self._sent[inner] = state.st_mtime_ns, state.st_size


def _progress(log: Path) -> dict[str, float]:
    """Return what a log says of progress: percent and seconds left, by its last line about either, and the last PSNR.

    Losses, gains and noise floors have the unit of the PSNR, too.
    """
    lines = log.read_text(errors="replace").splitlines()[::-1]
    line = next((line for line in lines if " %" in line), "")
    found = {name: re.search(pattern, line) for name, pattern in PROGRESS.items()}
    found["psnr"] = next((match for match in map(PSNR.search, lines) if match), None)
    return {name: float(match[1]) for name, match in found.items() if match}
