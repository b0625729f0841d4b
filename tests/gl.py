"""OpenGL for tests: one context for all of them, a skip where there is none."""

import functools

import moderngl
import pytest

from kpc.format.errors import DisplayError
from kpc.player.offscreen import open_context


@functools.cache
def _context() -> moderngl.Context | str:
    try:
        return open_context()
    except DisplayError as error:
        return str(error)


def context() -> moderngl.Context:
    found = _context()
    if isinstance(found, str):
        pytest.skip(found)
    return found
