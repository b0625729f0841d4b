"""What every command shares: errors as one line, Ctrl-C, files written aside and renamed, quantities as words."""

import argparse
import contextlib
import errno
import importlib.metadata
import math
import os
import sys
import tempfile
from collections.abc import Callable, Iterator
from pathlib import Path

from kpc.format.common.errors import KpcError, UsageError


def run(command: Callable[[list[str]], None], name: str, argv: list[str] | None = None) -> int:
    """Call `command(argv)` and turn what it raises into an exit code.

    0: done. 1: a KpcError or an error of the operating system that names a file, printed as one line on stderr.
    2: a usage error. 130: interrupted. Anything else is a bug and is raised on, with its traceback.
    """
    try:
        command(sys.argv[1:] if argv is None else argv)
    except UsageError as error:
        return _fail(name, str(error), 2)
    except KpcError as error:
        return _fail(name, str(error), 1)
    except (
        KeyboardInterrupt,
        SystemError,
    ) as error:  # the latter is what compiled functions make of one that reaches them
        if not any(isinstance(cause, KeyboardInterrupt) for cause in _causes(error)):
            raise
        return _fail(name, "interrupted", 130)
    except BrokenPipeError:
        sys.stderr.close()  # the reader of our output has gone: nothing is left to tell it
        return 1
    except OSError as error:
        if error.filename is None and error.errno != errno.ENOSPC:
            raise
        where = f"{error.filename}: " if error.filename is not None else ""
        return _fail(name, f"{where}{error.strerror or error}", 1)
    return 0


def add_version_option(parser: argparse.ArgumentParser) -> None:
    """Give a command's parser `--version`, which prints the version of KPC and exits."""
    parser.add_argument("--version", action="version", version=f"%(prog)s {importlib.metadata.version('kpc')}")


def _causes(error: BaseException | None) -> Iterator[BaseException]:
    """An exception, what caused it, and so on."""
    while error is not None:
        yield error
        error = error.__cause__ or error.__context__


def _fail(name: str, message: str, code: int) -> int:
    print(f"{name}: {' '.join(message.split())}", file=sys.stderr)
    return code


@contextlib.contextmanager
def atomic_write(path: str | os.PathLike[str]) -> Iterator[Path]:
    """Give a temporary path beside `path`; rename it to `path` on success, delete it on any failure.

    A reader of `path` therefore never sees a half-written file. The temporary keeps the suffix, since writers choose
    their container by it.
    """
    target = Path(path)
    handle, name = tempfile.mkstemp(prefix=f".{target.stem}.", suffix=target.suffix, dir=target.parent)
    os.close(handle)
    aside = Path(name)
    try:
        yield aside
        umask = os.umask(0)
        os.umask(umask)
        aside.chmod(0o666 & ~umask)  # mkstemp makes it private
        os.replace(aside, target)
    except BaseException:
        aside.unlink(missing_ok=True)
        raise


def duration_s(text: str) -> float:
    """Seconds of "90", "90s", "10m" or "1.5h"."""
    unit = {"s": 1, "m": 60, "h": 3600}.get(text[-1:], None)
    try:
        value = float(text[:-1]) * unit if unit else float(text)
    except ValueError:
        value = -1.0
    if not 0 < value < 1e9:
        raise argparse.ArgumentTypeError(f"{text!r} is no duration; write 90s, 10m or 1.5h")
    return value


def frame_rate(low: float, high: float) -> Callable[[str], float]:
    """A parser of pictures a second, from `low` to `high`."""

    def parse(text: str) -> float:
        try:
            value = float(text)
        except ValueError:
            value = math.nan
        if not low <= value <= high:
            raise argparse.ArgumentTypeError(f"{text!r} is not a frame rate from {low:g} to {high:g}")
        return value

    return parse


def decibels(text: str) -> float:
    """The number of "0.1" or "0.1dB"."""
    try:
        value = float(text.lower().removesuffix("db"))
    except ValueError:
        value = math.nan
    if not 0 < value < 100:
        raise argparse.ArgumentTypeError(f"{text!r} is no loss; write 0.1dB")
    return value


def byte_count(text: str) -> int:
    """Bytes of "300000", "300KB" or "2MB", of 1,000 and 1,000,000 bytes."""
    number = text.upper().removesuffix("B")
    unit = {"K": 10**3, "M": 10**6}.get(number[-1:], 1)
    try:
        value = float(number[:-1] if unit > 1 else number) * unit
    except ValueError:
        value = math.nan
    if not 1 <= value < 1e12:
        raise argparse.ArgumentTypeError(f"{text!r} is no size; write 300KB or 2MB")
    return int(value)


def box_corners(text: str) -> tuple[float, ...]:
    """The six numbers of "x0,y0,z0,x1,y1,z1"."""
    try:
        numbers = tuple(float(n) for n in text.split(","))
    except ValueError:
        numbers = ()
    if (
        len(numbers) != 6
        or not all(map(math.isfinite, numbers))
        or not all(a < b for a, b in zip(numbers[:3], numbers[3:]))
    ):
        raise argparse.ArgumentTypeError(f"{text!r} is not x0,y0,z0,x1,y1,z1 with each lower bound below the upper")
    return numbers
