"""An X server of the tests' own."""

import contextlib
import os
import shutil
import subprocess
from collections.abc import Iterator

import pytest


@contextlib.contextmanager
def x_server() -> Iterator[str]:
    """Start Xvfb and yield its display; skip the test where that is impossible."""
    if shutil.which("Xvfb") is None:
        pytest.skip("no display and no Xvfb (Debian: apt install xvfb)")
    reader, writer = os.pipe()
    # without -noreset it starts over when its last client leaves, and refuses the next meanwhile
    server = subprocess.Popen(
        ["Xvfb", "-noreset", "-displayfd", str(writer), "-screen", "0", "1024x768x24"],
        pass_fds=[writer],
        stdout=subprocess.DEVNULL,
        stderr=subprocess.DEVNULL,
    )
    os.close(writer)
    with os.fdopen(reader) as output:
        number = output.readline().strip()
    try:
        if not number:
            pytest.skip("Xvfb does not start")
        yield f":{number}"
    finally:
        server.terminate()
        server.wait()
