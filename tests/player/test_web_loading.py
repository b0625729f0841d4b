"""Clips load in headless Chromium, whatever the page permits, and from other sites (player/web/tests/loading.mjs)."""

import json
import subprocess
from pathlib import Path
from typing import Any

import pytest

from kpc.tools.bench import web_page

# A browser that hangs is ended.
TIMEOUT_S = 300
SAMPLE = Path(__file__).parent.parent.parent / "samples" / "default.kpc"


@pytest.fixture(scope="module")
def pages() -> dict[str, dict[str, Any]]:
    """Return what became of the sample in each page."""
    reason = web_page.missing()
    if reason is not None:
        pytest.skip(reason)
    command = ["node", "tests/loading.mjs", str(web_page.browser()), SAMPLE]
    done = subprocess.run(command, cwd=web_page.WEB, capture_output=True, text=True, timeout=TIMEOUT_S)
    assert done.returncode == 0, done.stderr[-4000:]
    return dict(json.loads(done.stdout))


@pytest.mark.parametrize("page", ["plain", "blobs", "own", "other"])
def test_a_clip_loads_whole(pages: dict[str, dict[str, Any]], page: str) -> None:
    found = pages[page]
    assert found["buffered"] == [[0, found["duration"]]] and found["texels"] == pages["plain"]["texels"] > 0


def test_a_page_that_forbids_webassembly_is_told_what_to_allow(pages: dict[str, dict[str, Any]]) -> None:
    assert pages["noWasm"]["code"] == "worker" and "'wasm-unsafe-eval'" in pages["noWasm"]["message"]


def test_a_site_that_does_not_permit_the_page_is_told_what_to_send(pages: dict[str, dict[str, Any]]) -> None:
    assert pages["blocked"]["code"] == "blocked"
    assert "Access-Control-Allow-Origin: http://127.0.0.1" in pages["blocked"]["message"]
