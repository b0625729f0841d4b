"""The page player/web/tests/render_page.ts in headless Chromium, for tests; a skip where that cannot be had."""

import base64
import functools
import json
import shutil
import subprocess
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from kpc.format.scene.cameras import Camera

ROOT = Path(__file__).parent.parent
WEB = ROOT / "player" / "web"
SCRIPT = "tests/render_page.ts"
CORE = ROOT / "format" / "core" / "kpc_core.wasm"
# A page that hangs is ended, as the whole test is.
TIMEOUT_S = 300

# A function of the page, and its arguments.
Call = tuple[str, list[Any]]


@functools.cache
def missing() -> str | None:
    """Return what keeps the page from being opened."""
    if shutil.which("node") is None:
        return "needs node"
    if not (WEB / "node_modules" / "playwright-core").is_dir():
        return "needs the packages of player/web: npm ci --prefix player/web"
    if browser() is None:
        return "needs Chromium: apt install chromium (Debian)"
    return None


def browser() -> str | None:
    return shutil.which("chromium") or shutil.which("google-chrome")


def run(folder: Path, files: Mapping[str, bytes], calls: Sequence[Call]) -> list[Any]:
    """Open the page, with `files` beside it and in `folder`, and return what functions of it return."""
    reason = missing()
    if reason is not None:
        pytest.skip(reason)
    for name, data in (files | {CORE.name: CORE.read_bytes()}).items():
        (folder / name).write_bytes(data)
    subprocess.run(["node", "build.mjs", "--page", SCRIPT, "--out", folder], cwd=WEB, check=True, timeout=TIMEOUT_S)
    done = subprocess.run(
        ["node", "tests/browser.mjs", folder / Path(SCRIPT).with_suffix(".js").name, folder, str(browser())],
        input=json.dumps([{"call": name, "args": arguments} for name, arguments in calls]),
        capture_output=True,
        cwd=WEB,
        text=True,
        timeout=TIMEOUT_S,
    )
    assert done.returncode == 0, done.stderr[-4000:]
    return list(json.loads(done.stdout))


def camera_of(camera: Camera) -> dict[str, Any]:
    """Return a camera as the page takes it."""
    pose = camera.camera_to_world[:3].ravel().tolist()
    lens = {"focal": [camera.fl_x, camera.fl_y], "centre": [camera.cx, camera.cy]}
    return {"width": camera.width, "height": camera.height, **lens, "pose": pose}


def picture_of(result: Mapping[str, Any], camera: Camera) -> np.ndarray:
    """Return a picture that the page drew: (H, W, 3) float64 in [0, 1], the top row first."""
    pixels = np.frombuffer(base64.b64decode(result["pixels"]), np.uint8)
    return pixels.reshape(camera.height, camera.width, 4)[::-1, :, :3] / 255
