"""Compilation of kernels with numba, for the encoder and the processor renderer.

`@compiled()` is for functions that Python calls, `@inlined` for their helpers. With NUMBA_DISABLE_JIT=1 the same
functions run as plain Python.
"""

import threading
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from typing import Any

from numba import njit
from numba.core import event

from kpc.format.common import interrupts
from kpc.format.common.compiling import LOCK, MONITOR, CompilationMonitor, SafePlaces


class _Listener(event.Listener):  # type: ignore[misc]
    """Reports what numba does."""

    def __init__(self, target: CompilationMonitor | SafePlaces) -> None:
        self.target = target

    def on_start(self, event: event.Event) -> None:
        self.target.on_start(event)

    def on_end(self, event: event.Event) -> None:
        self.target.on_end(event)


def _register() -> None:
    """Have numba report its compilations to MONITOR, and let Ctrl-C end them where that is safe."""
    places = SafePlaces()
    for kind, target in (("numba:compile", MONITOR), (LOCK, places), ("numba:run_pass", places)):
        event.register(kind, _Listener(target))
    interrupts.defer_while(places.is_busy)


_register()


class NotCachedError(Exception):
    """A kernel is not in numba's cache."""


class _Refusal(event.Listener):  # type: ignore[misc]
    """Ends compilations as they begin, but for those of the main thread."""

    def on_start(self, event: event.Event) -> None:
        if threading.current_thread() is not threading.main_thread():
            raise NotCachedError

    def on_end(self, event: event.Event) -> None:
        pass


@contextmanager
def only_cached() -> Iterator[None]:
    """Have threads load kernels and not compile them.

    Raises:
        NotCachedError: where a kernel is not in numba's cache.
    """
    refusal = _Refusal()
    event.register("numba:compile", refusal)
    try:
        yield
    finally:
        event.unregister("numba:compile", refusal)


def compiled(**options: Any) -> Callable[[Callable[..., Any]], Callable[..., Any]]:
    """Return numba's `njit` as a decorator, with the GIL released and machine code cached on disk.

    Numba caches in the package's folder, or else in the user's cache folder. If it can write to neither, each process
    compiles anew.

    Args:
        options: further options of `njit`.
    """

    def decorate(function: Callable[..., Any]) -> Callable[..., Any]:
        # No kernel is a callback of C, whose wrapper would be an eighth of the work of compiling.
        wanted = {"nogil": True, "no_cfunc_wrapper": True, **options}
        try:
            return njit(cache=True, **wanted)(function)
        except RuntimeError:  # numba found no writable cache folder
            return njit(**wanted)(function)

    return decorate


# Compiles a function into its callers without reference counting, which takes a decoder three quarters of its time.
# Only for functions that neither create nor return arrays. Numba has no public option for it.
inlined = compiled(forceinline=True, _nrt=False)
