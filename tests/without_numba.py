"""Kernels that numba compiles, against the same lines as plain Python."""

import os
import subprocess
import sys


def assert_same_without_numba(program: str, kernel: str) -> None:
    """`program`, which may import test modules, prints lines; compiled and not it must print the same, and some.

    `kernel`: "module:function" that has to be compiled the first time and must not be the second.
    """
    module, function = kernel.split(":")
    told = f"from {module} import {function} as kernel\nprint(hasattr(kernel, 'py_func'))\n{program}"

    def run(**more: str) -> tuple[str, list[str]]:
        path = os.pathsep.join([os.path.dirname(__file__), *sys.path])
        done = subprocess.run([sys.executable, "-W", "error", "-c", told], capture_output=True, text=True, check=True,
                              env={**os.environ, "PYTHONPATH": path, **more})  # fmt: skip
        is_compiled, *lines = done.stdout.splitlines()
        return is_compiled, lines

    (compiled, expected), (plain, found) = run(), run(NUMBA_DISABLE_JIT="1")
    assert (compiled, plain) == ("True", "False")
    assert found == expected and found
