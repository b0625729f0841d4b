"""Compilation of kernels with numba: `@compiled()` for functions that Python calls, `@inlined` for those that kernels
call.

With NUMBA_DISABLE_JIT=1 the same functions run as plain Python.
"""

from collections.abc import Callable
from typing import Any

from kpc.format.common import compiling
from numba import njit

compiling.register()


def compiled(**options: Any) -> Callable[[Callable[..., Any]], Callable[..., Any]]:
    """Return a decorator: numba's `njit`, which releases the GIL and caches machine code on disk where there is a
    folder for it.

    Numba caches in the package's folder or else in the user's; where it can write to neither, each process compiles
    anew.
    """

    def decorate(function: Callable[..., Any]) -> Callable[..., Any]:
        try:
            return njit(cache=True, nogil=True, **options)(function)
        except RuntimeError:  # numba found no folder that it can write to
            return njit(nogil=True, **options)(function)

    return decorate


# Compiles a function into its callers without reference counts. Only for functions that create and return no array:
# counting at every call would take a decoder three quarters of its time, and numba has no public option that leaves
# it out.
inlined = compiled(forceinline=True, _nrt=False)
