"""The work folder of an encode, where decoded pixels and the checkpoint are kept, and the device to train on."""

import contextlib
import itertools
import shutil
from collections.abc import Iterator
from fnmatch import fnmatch
from pathlib import Path

import torch
from filelock import FileLock, Timeout

from kpc.format.common.errors import TrainingError, UsageError
from kpc.format.container import rewriting

CHECKPOINT = "checkpoint.kpck"
LOCK = ".kpenc.lock"
POSES = "poses"  # the folder of cameras found for footage without poses
# The files of an encode in its work folder, but for decoded pixels.
OWN_FILES = ("group-*.kpc", "group-*.json", "group-*.kpck", CHECKPOINT, f".{Path(CHECKPOINT).stem}.*")


def make_work_folder(work: Path, cache: Path | None = None) -> None:
    """Create the work folder, and that of decoded pixels if it is another.

    Raises:
        TrainingError: one cannot be created.
    """
    for folder, option in ((work, "--work"), (cache, "--cache")):
        try:
            if folder is not None:
                folder.mkdir(parents=True, exist_ok=True)
        except OSError as error:
            raise TrainingError(
                f"{folder}: {error.strerror}; name another folder for decoded pixels with {option}"
            ) from error


@contextlib.contextmanager
def locked(work: Path) -> Iterator[None]:
    """Hold the work folder, which is made, so that no other kpenc uses it and then removes what is in it.

    The system releases the lock of a process that ends, however it ends.

    Raises:
        TrainingError: another process holds it, or it cannot be written.
    """
    make_work_folder(work)
    lock = FileLock(work / LOCK)
    try:
        lock.acquire(timeout=0)
    except Timeout:
        raise TrainingError(
            f"{work}: another kpenc is at work there; wait for it, or name another folder with --work"
        ) from None
    except PermissionError as error:
        raise TrainingError(f"{work}: no permission to write there; name another folder with --work") from error
    try:
        yield
    finally:
        (work / LOCK).unlink(missing_ok=True)
        lock.release()
        remove_if_empty(work)


def clear_work_folder(work: Path, cache: Path | None = None) -> None:
    """Remove what kpenc has put into the work folder, and the folder if nothing else is in it.

    Decoded pixels stay if `cache` names a folder for them, even this one, since other encodes may use them.
    """
    patterns = list(OWN_FILES)
    if cache is None:
        patterns += ["pixels-*.bin", "pixels-*.json"]
        for packed in work.glob("pixels-*/"):
            shutil.rmtree(packed)
    for pattern in patterns:
        for leftover in work.glob(pattern):
            leftover.unlink(missing_ok=True)
    shutil.rmtree(work / POSES, ignore_errors=True)
    remove_if_empty(work)


def has_begun(work: Path, *, in_groups: bool) -> bool:
    """Return whether there is something in the work folder with which `--resume` goes on.

    Args:
        work: the folder; it may be missing.
        in_groups: whether a clip is encoded in groups, each with a checkpoint of its own, and a report once it is done.
    """
    if not in_groups:
        return (work / CHECKPOINT).exists()
    return any(itertools.chain(work.glob("group-*.json"), work.glob(f"group-*/{CHECKPOINT}")))


def is_own_file(path: Path, work: Path) -> bool:
    """Return whether a file has a name that an encode uses, and then removes, in its work folder."""
    return path.parent.resolve() == work.resolve() and any(fnmatch(path.name, own) for own in OWN_FILES)


@contextlib.contextmanager
def leaving_nothing(work: Path) -> Iterator[None]:
    """Remove at the end, also after an error, what was put into the locked work folder meanwhile."""
    before = set(work.glob("*"))
    try:
        yield
    finally:
        for leftover in set(work.glob("*")) - before:
            if leftover.is_dir():
                shutil.rmtree(leftover)
            else:
                leftover.unlink(missing_ok=True)


def remove_if_empty(work: Path) -> None:
    with contextlib.suppress(OSError):
        work.rmdir()


def save_scene(data: bytes, output: Path, work: Path) -> int:
    """Write an encoded file and return its size in bytes.

    Raises:
        TrainingError: it cannot be written; the message says how to keep what was trained.
    """
    try:
        return rewriting.save(data, output)
    except OSError as error:
        kept = f", or give another -o with --work {work} --resume to keep what is trained"
        raise TrainingError(f"{output}: {error.strerror}; make room there{kept}") from error


def choose_device(name: str) -> str:
    """Return "cpu" or "cuda" for "auto", "cpu" or "cuda".

    Raises:
        UsageError: "cuda" was asked for, and there is none.
    """
    if name == "auto":
        return "cuda" if torch.cuda.is_available() else "cpu"
    if name == "cuda" and not torch.cuda.is_available():
        raise UsageError(
            "--device cuda: this PyTorch sees no CUDA device; use --device cpu, or install a CUDA build of PyTorch"
        )
    return name
