"""The page of kpc.tools.bench.web_page for tests, which are skipped where it cannot be opened."""

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import pytest

from kpc.tools.bench import web_page
from kpc.tools.bench.web_page import Call, camera_of, picture_of

__all__ = ["Call", "camera_of", "picture_of", "run"]


def run(folder: Path, files: Mapping[str, bytes], calls: Sequence[Call]) -> list[Any]:
    """Open the page, with `files` beside it and in `folder`, and return what functions of it return."""
    reason = web_page.missing()
    if reason is not None:
        pytest.skip(reason)
    return web_page.run(folder, files, calls)
