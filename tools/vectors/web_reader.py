"""The browser player's reader under node, for the fuzzer: it plays each file that it is given."""

import json
import select
import shutil
import struct
import subprocess
from pathlib import Path
from typing import Any

import kpc.player
from kpc.format.common.errors import UsageError

SCRIPT = Path(kpc.player.__file__).parent / "web" / "tests" / "fuzz_reader.mjs"
# Megabytes that objects of JavaScript may take; arrays of bytes do not count.
HEAP_MB = 128
# Seconds without an answer after which node is ended.
SILENT_S = 30.0
# Bytes that node, its threads and earlier files may take beside the budget.
SLACK = 256 << 20


class WebReader:
    """A process of node that plays files; another takes its place if it ends.

    Args:
        budget: bytes that a clip may take.

    Raises:
        UsageError: there is no node, or no checkout with the script.
    """

    def __init__(self, budget: int) -> None:
        node = shutil.which("node")
        if node is None or not SCRIPT.is_file():
            raise UsageError("--reader web: needs node, and a checkout of the repository")
        self._command, self._budget = [node, f"--max-old-space-size={HEAP_MB}", str(SCRIPT), str(budget)], budget
        self._process = self._start()

    def examined(self, data: bytes, hang_s: float) -> str:
        """Play a file; return "read" or the name of the error that refused it.

        Args:
            data: the file.
            hang_s: seconds of processor time that are too many.

        Raises:
            AssertionError: a finding.
        """
        assert self._process.stdin is not None and self._process.stdout is not None
        self._process.stdin.write(struct.pack("<I", len(data)) + data)
        self._process.stdin.flush()
        is_there, _, _ = select.select([self._process.stdout], [], [], SILENT_S)
        line = self._process.stdout.readline() if is_there else b""
        if not line:
            self.close()
            self._process = self._start()
            raise AssertionError("node has ended" if is_there else f"no answer after {SILENT_S:.0f} s")
        answer: dict[str, Any] = json.loads(line)
        assert "finding" not in answer, answer["finding"]
        assert answer["rss"] < self._budget + SLACK, f"takes {answer['rss']:,} bytes"
        assert answer["seconds"] < hang_s, f"took {answer['seconds']:.1f} s"
        return str(answer["said"])

    def close(self) -> None:
        """End the process."""
        self._process.kill()
        self._process.communicate()

    def _start(self) -> "subprocess.Popen[bytes]":
        return subprocess.Popen(self._command, stdin=subprocess.PIPE, stdout=subprocess.PIPE)
