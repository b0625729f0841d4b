"""Compilation of kernels with numba: `@compiled()` for functions that Python calls, `@inlined` for their helpers.

With NUMBA_DISABLE_JIT=1 the same functions run as plain Python.
"""

from collections.abc import Callable
from typing import Any

from numba import njit

from kpc.format.common import compiling

compiling.register()


def compiled(**options: Any) -> Callable[[Callable[..., Any]], Callable[..., Any]]:
    """Return numba's `njit` as a decorator, with the GIL released and machine code cached on disk.

    Numba caches in the package's folder, or else in the user's cache folder. If it can write to neither, each process
    compiles anew.

    Args:
        options: further options of `njit`.
    """

    def decorate(function: Callable[..., Any]) -> Callable[..., Any]:
        try:
            return njit(cache=True, nogil=True, **options)(function)
        except RuntimeError:  # numba found no writable cache folder
            return njit(nogil=True, **options)(function)

    return decorate


# Compiles a function into its callers without reference counting, which takes a decoder three quarters of its time.
# Only for functions that neither create nor return arrays. Numba has no public option for it.
inlined = compiled(forceinline=True, _nrt=False)
