"""Worker processes."""

import os
import signal
import subprocess
import sys
import time
from pathlib import Path

import pytest

PARENT = """
import multiprocessing, os, sys, time
from concurrent.futures import ProcessPoolExecutor
from pathlib import Path
from kpc.tools.dev.processes import end_with_parent

def work(path):
    Path(path).write_text(str(os.getpid()))
    time.sleep(60)

if __name__ == "__main__":
    with ProcessPoolExecutor(1, multiprocessing.get_context("spawn"), end_with_parent) as pool:
        pool.submit(work, sys.argv[1]).result()
"""


@pytest.mark.skipif(os.name != "posix", reason="uses POSIX signals")
def test_workers_exit_when_their_parent_is_killed(tmp_path: Path) -> None:
    (tmp_path / "parent.py").write_text(PARENT)
    parent = subprocess.Popen([sys.executable, str(tmp_path / "parent.py"), str(tmp_path / "pid")])
    child = int(_awaited(lambda: (tmp_path / "pid").read_text() if (tmp_path / "pid").exists() else ""))
    os.kill(child, 0)  # raises unless the process exists
    parent.send_signal(signal.SIGKILL)
    parent.wait()
    assert _awaited(lambda: "gone" if _is_gone(child) else "") == "gone"


def _awaited(found) -> str:  # type: ignore[no-untyped-def]
    """Return the first non-empty text that `found` returns within half a minute."""
    until = time.monotonic() + 30
    while not (text := found()) and time.monotonic() < until:
        time.sleep(0.05)
    return str(text)


def _is_gone(pid: int) -> bool:
    try:
        os.kill(pid, 0)
    except ProcessLookupError:
        return True
    stat = Path(f"/proc/{pid}/stat")
    return stat.exists() and stat.read_text().rpartition(")")[2].split()[0] == "Z"  # a zombie that nobody reaps
