"""The readers in JavaScript (player/web), tested by node's own test runner."""

import re
import shutil
import subprocess
from pathlib import Path

import pytest

ROOT = Path(__file__).parent.parent


def test_the_tests_of_node_pass() -> None:
    node = shutil.which("node")
    version = subprocess.run([node, "--version"], capture_output=True, text=True).stdout if node else ""
    found = re.match(r"v(\d+)\.", version)
    if node is None or found is None or int(found[1]) < 18:
        pytest.skip(f"needs node 18 or newer, not {version.strip() or 'none'}")
    if not (ROOT / "player" / "web" / "node_modules" / "fzstd").is_dir():
        pytest.skip("needs the packages of player/web: npm ci --prefix player/web")
    files = sorted(map(str, (ROOT / "tests" / "node").glob("*.test.js")))
    assert files
    done = subprocess.run([node, "--test", *files], capture_output=True, text=True, cwd=ROOT)
    assert done.returncode == 0, done.stdout[-4000:]
