"""Progress on stderr: a bar on a terminal that has a size; elsewhere a line after a second, one as soon as the
remaining time can be estimated, and then one every ten seconds."""

import contextlib
import os
import sys
import threading
import time
from collections.abc import Iterable, Iterator, Sequence, Sized
from types import TracebackType
from typing import Any, Self, TextIO, TypeVar

from tqdm import tqdm

from kpc.format.common.compiling import working_s
from kpc.format.common.text import escaped

T = TypeVar("T")

# Seconds before the first lines, and between later ones, where there is no bar.
FIRST_LINE_S, LINE_EVERY_S = 1.0, 10.0


class _Open(threading.local):
    """The tasks of a thread that are reported now, the innermost last."""

    def __init__(self) -> None:
        self.tasks: list[Progress] = []


_open = _Open()


class _Bar(tqdm):
    """A bar that shows the remaining time of `Progress` as `left`, and as `whole` how many whole units are done."""

    left = "?"

    @property
    def format_dict(self) -> dict[str, Any]:
        return {**super().format_dict, "left": self.left, "whole": _whole(self.n)}


class Progress:
    """Reports the progress of a task on stderr, as a context manager.

        with Progress("decode", total=300, unit="frame") as progress:
            progress.advance()
            progress.note("psnr 27.1")

    Where a unit takes long, `part` and `in_parts` report how much of it is done.

    Args:
        label: name of the task.
        total: units of work in all; None if unknown.
        unit: name of a unit, or "%" where the total is 100.
        shown: False to report nothing.
    """

    def __init__(self, label: str, total: float | None = None, unit: str = "", *, shown: bool = True) -> None:
        self.label, self.total, self.unit, self.shown = escaped(label), total, unit, shown
        self.done, self.text = 0.0, ""
        # Units that `advance` has counted, and the size in units of the part of the next one that is worked on.
        self.counted, self.size = 0.0, 1.0
        self.reported_at, self.line_after_s = time.monotonic(), FIRST_LINE_S
        # Units done and the time at the first call of `advance`. The remaining time is estimated from there on, since
        # before it caches are filled. The time of compiling kernels never counts.
        self.first: tuple[float, float] | None = None
        self.bar: _Bar | None = None
        if shown and _fits_a_bar(sys.stderr):
            count = "" if unit == "%" else " {whole}/{total:.0f}"  # the bar begins with the percentage
            layout = f"{{l_bar}}{{bar}}|{count} [{{elapsed}}<{{left}}]{{postfix}}" if total else None
            self.bar = _Bar(
                total=total,
                desc=self.label,
                unit=unit or "it",
                leave=False,
                file=sys.stderr,
                bar_format=layout,
                miniters=0,  # else tqdm waits for as many units as before, and stands where they become slower
            )

    def advance(self, count: float = 1) -> None:
        """Record that `count` more units are done, of which parts may have been reported."""
        self.counted += count
        self.reach(self.counted)

    def reach(self, done: float) -> None:
        """Record that `done` units are done in all, if that is more than before."""
        count = max(done - self.done, 0.0)
        self.done += count
        self.extend(0)  # tqdm cannot show more than the total
        self.first = self.first or (self.done, working_s())
        if self.bar is not None:
            left_s = self._left_s()
            self.bar.left = "?" if left_s is None else tqdm.format_interval(left_s)
            self.bar.update(count)
        elif self.shown and time.monotonic() - self.reported_at >= self.line_after_s:
            self._print_line()

    def extend(self, count: float) -> None:
        """Expect at least `count` more units, where the total was a guess."""
        if self.total is not None and self.done + count > self.total:
            self.total = self.done + count
            if self.bar is not None:
                self.bar.total = self.total

    def note(self, text: str) -> None:
        """Set the text shown behind the bar, or at the end of the next line."""
        self.text = text
        if self.bar is not None:
            self.bar.set_postfix_str(text, refresh=False)

    def __enter__(self) -> Self:
        _open.tasks.append(self)
        return self

    def __exit__(
        self, kind: type[BaseException] | None, value: BaseException | None, trace: TracebackType | None
    ) -> None:
        if self in _open.tasks:  # else a generator is closed by another thread
            _open.tasks.remove(self)
        if self.bar is not None:
            self.bar.close()

    def _print_line(self) -> None:
        self.reported_at = time.monotonic()
        parts = [f"{self.label}: {_whole(self.done)}"]
        if not self.total:
            self.line_after_s = LINE_EVERY_S
        else:
            of = "" if self.unit == "%" else f"/{self.total:.0f}"
            parts = [f"{self.label}: {_whole(self.done)}{of} {self.unit}".rstrip()]
            if self.done > self.counted and self.total < 100:
                parts.append(f"{100 * self.done / self.total:.0f} %")
            if (left_s := self._left_s()) is not None:
                self.line_after_s = LINE_EVERY_S
                parts.append(f"{left_s:.0f} s left")
        print(", ".join(parts + ([self.text] if self.text else [])), file=sys.stderr, flush=True)

    def _left_s(self) -> float | None:
        """Return the seconds that remain; None while they cannot be estimated."""
        if not self.total or self.first is None or self.done <= self.first[0]:
            return None
        done, when = self.first
        return (working_s() - when) * (self.total - self.done) / (self.done - done)


def _whole(count: float) -> int:
    """Return the number of whole units; parts of one, which are added up, may lack a rounding error."""
    return int(count + 1e-6)


def _fits_a_bar(stream: TextIO) -> bool:
    """Return whether a stream is a terminal that has a size: on one of no columns, tqdm shows nothing."""
    if not stream.isatty():
        return False
    try:
        return os.get_terminal_size(stream.fileno()).columns > 0
    except OSError:  # it stands for a terminal, without a file
        return True


def progress(
    items: Iterable[T], label: str, total: int | None = None, unit: str = "", *, shown: bool = True
) -> Iterator[T]:
    """Yield `items` and report how many have been consumed; see `Progress` for the other arguments."""
    if total is None and isinstance(items, Sized):
        total = len(items)
    with Progress(label, total, unit, shown=shown) as bar:
        for item in items:
            yield item
            bar.advance()


@contextlib.contextmanager
def part(share: float) -> Iterator[None]:
    """Report the work within as this share of a unit of the innermost task of this thread, or of the part around it."""
    if not _open.tasks:
        yield
        return
    task = _open.tasks[-1]
    start, size = task.done, task.size
    task.size = size * share
    try:
        yield
        task.reach(start + task.size)
    finally:
        task.size = size


def in_parts(items: Sequence[T]) -> Iterator[T]:
    """Yield `items`, and report the work on each as an equal part; see `part`."""
    for item in items:
        with part(1 / len(items)):
            yield item
