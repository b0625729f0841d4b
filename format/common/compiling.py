"""Kernels are compiled when they are first needed, which takes half a minute in all, once: numba keeps them on disk. Says so meanwhile."""

import sys
import threading
import time

from numba.core import event

NOTICE = "compiling for this processor, which takes about half a minute, once"
NOTICE_AFTER_S = 1.0
"""Of compiling, until it is worth a word: now and then a small one has been missing."""


class CompilationMonitor(event.Listener):
    """Told by numba when it begins to compile a function and when it is done; one may need another."""

    def __init__(self) -> None:
        self._lock = threading.Lock()
        self._depth = 0
        self._begun = self._spent = 0.0
        self._told = False

    def on_start(self, _: event.Event) -> None:
        with self._lock:
            if self._depth == 0:
                self._begun = time.monotonic()
            self._depth += 1
            tells = self.is_compiling and not self._told and sys.stderr is not None and sys.stderr.isatty()
            self._told |= tells
        if tells:
            print(NOTICE, file=sys.stderr)

    def on_end(self, _: event.Event) -> None:
        with self._lock:
            self._depth -= 1
            if self._depth == 0:
                self._spent += time.monotonic() - self._begun

    @property
    def is_compiling(self) -> bool:
        """Whether compiling goes on, and has taken LEAST_S already."""
        return self._depth > 0 and self._spent + time.monotonic() - self._begun >= NOTICE_AFTER_S


MONITOR = CompilationMonitor()
"""What this process compiles, from the import of `kpc.format.coding.rans` on."""


def register() -> None:
    """Have numba tell WATCH."""
    event.register("numba:compile", MONITOR)
