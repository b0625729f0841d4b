"""Detection of numba's compilation, to explain the delay when kernels are used for the first time.

Kernels are compiled on first use, a minute or two in all, and numba caches them on disk. Meanwhile a notice is printed
on terminals, and elsewhere for commands that say so (`CompilationMonitor.announces`).
"""

import sys
import threading
import time
from typing import Any

NOTICE = "compiling kernels for this processor, which takes a minute or two, once"

# Seconds of compilation before the notice is due: now and then a single small kernel is missing from the cache.
NOTICE_AFTER_S = 1.0


class CompilationMonitor:
    """Measures how long numba compiles, and prints NOTICE once on a terminal. Compilations may nest."""

    def __init__(self) -> None:
        self._lock = threading.Lock()
        self._depth = 0
        self._begun = self._spent = 0.0
        self._notified = False
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
            print(NOTICE, file=sys.stderr)

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


# Monitors this process, from the import of `kpc.format.common.jit` on.
MONITOR = CompilationMonitor()


def working_s() -> float:
    """Return the seconds of a clock that stands still while numba compiles."""
    return time.monotonic() - MONITOR.spent_s


def register() -> None:
    """Have numba report its compilations to MONITOR."""
    from numba.core import event  # here, so that what shows progress need not load numba

    class Listener(event.Listener):  # type: ignore[misc]
        def on_start(self, event: event.Event) -> None:
            MONITOR.on_start(event)

        def on_end(self, event: event.Event) -> None:
            MONITOR.on_end(event)

    event.register("numba:compile", Listener())
