"""Detection of numba's compilation, to explain the delay when kernels are used for the first time.

Kernels are compiled on first use, a minute or two in all, and numba caches them on disk. Meanwhile a notice is printed
on terminals, and elsewhere for commands that say so (`CompilationMonitor.announces`).
"""

import sys
import threading
import time
from typing import Any

from kpc.format.common import interrupts

NOTICE = "compiling kernels for this processor, which takes a minute or two, once"

# Seconds of compilation before the notice is due: now and then a single small kernel is missing from the cache.
NOTICE_AFTER_S = 1.0

# numba's event of its compiler, within which it compiles kernels or loads them from its cache.
LOCK = "numba:compiler_lock"


class CompilationMonitor:
    """Measures how long numba compiles, and prints a notice once on a terminal. Compilations may nest."""

    def __init__(self) -> None:
        self._lock = threading.Lock()
        self._depth = 0
        self._begun = self._spent = 0.0
        self._notified = False
        self.notice = NOTICE
        self.announces = False  # whether to print NOTICE where stderr is no terminal, too

    def on_start(self, _: Any) -> None:
        """Record that numba begins to compile a function."""
        with self._lock:
            if self._depth == 0:
                self._begun = time.monotonic()
            self._depth += 1
            shows = sys.stderr is not None and (self.announces or sys.stderr.isatty())
            notify = self.is_compiling and not self._notified and shows
            self._notified |= notify
        if notify:
            print(self.notice, file=sys.stderr)

    def on_end(self, _: Any) -> None:
        """Record that numba is done with a function."""
        with self._lock:
            self._depth -= 1
            if self._depth == 0:
                self._spent += time.monotonic() - self._begun

    @property
    def spent_s(self) -> float:
        """Seconds that this process has spent on compiling."""
        return self._spent + (time.monotonic() - self._begun if self._depth else 0.0)

    @property
    def is_compiling(self) -> bool:
        """Whether numba is compiling and has spent at least NOTICE_AFTER_S on it so far."""
        return self._depth > 0 and self.spent_s >= NOTICE_AFTER_S


class SafePlaces:
    """Makes Ctrl-C wait, while numba compiles or loads a kernel, until the next pass of the compiler begins or ends."""

    def __init__(self) -> None:
        self._depth = 0

    def on_start(self, which: Any) -> None:
        """Record that numba takes the lock of its compiler."""
        if threading.current_thread() is threading.main_thread():
            self._depth += which.kind == LOCK
            self._raise(which.kind != LOCK)

    def on_end(self, which: Any) -> None:
        """Record that numba is done, or at a place where an exception does no harm."""
        if threading.current_thread() is threading.main_thread():
            self._depth -= which.kind == LOCK
            self._raise(which.kind != LOCK or not self._depth)

    def is_busy(self) -> bool:
        """Return whether the main thread is within the compiler."""
        return self._depth > 0

    @staticmethod
    def _raise(is_safe: bool) -> None:
        if is_safe:
            interrupts.raise_pending()


# Monitors this process, from the import of `kpc.jit` on, which alone imports numba.
MONITOR = CompilationMonitor()


def working_s() -> float:
    """Return the seconds of a clock that stands still while numba compiles."""
    return time.monotonic() - MONITOR.spent_s
