"""Comparison of kernels compiled by numba with the same code run by Python."""

import os
import subprocess
import sys


def assert_same_without_numba(program: str, kernel: str) -> None:
    """Assert that a program prints the same lines, at least one, with and without compilation.

    Args:
        program: Python source, which may import test modules.
        kernel: "module:function", a function that must be compiled in the first run and not in the second.
    """
    module, function = kernel.split(":")
    source = f"from {module} import {function} as kernel\nprint(hasattr(kernel, 'py_func'))\n{program}"

    def run(**environment: str) -> tuple[str, list[str]]:
        path = os.pathsep.join([os.path.dirname(__file__), *sys.path])
        done = subprocess.run([sys.executable, "-W", "error", "-c", source], capture_output=True, text=True, check=True,
                              env={**os.environ, "PYTHONPATH": path, **environment})  # fmt: skip
        is_compiled, *lines = done.stdout.splitlines()
        return is_compiled, lines

    (compiled, expected), (interpreted, found) = run(), run(NUMBA_DISABLE_JIT="1")
    assert (compiled, interpreted) == ("True", "False")
    assert found == expected and found
