"""Pages in headless Chromium, driven by node: one that draws scenes, player/web/tests/render_page.ts, or another."""

import base64
import json
import shutil
import subprocess
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np

import kpc.player
from kpc.format.common.errors import KpcError, UsageError
from kpc.format.scene.cameras import Camera

WEB = Path(kpc.player.__file__).parent / "web"
SCRIPT = "tests/render_page.ts"

# A function of the page, and its arguments.
Call = tuple[str, list[Any]]


def missing() -> str | None:
    """Return what keeps the page from being opened; None if nothing does."""
    if not (WEB / SCRIPT).is_file():
        return "needs a checkout of KPC"
    if shutil.which("node") is None:
        return "needs node"
    if not (WEB / "node_modules" / "playwright-core").is_dir():
        return "needs the packages of player/web: npm ci --prefix player/web"
    if browser() is None:
        return "needs Chromium: apt install chromium (Debian)"
    return None


def browser() -> str | None:
    """Return the path of Chromium, if it is installed."""
    return shutil.which("chromium") or shutil.which("google-chrome")


def run(
    folder: Path, files: Mapping[str, bytes], calls: Sequence[Call], timeout_s: float = 300, script: str = SCRIPT
) -> list[Any]:
    """Open the page, with `files` beside it and in `folder`, and return what functions of it return."""
    return [result["value"] for result in timed(folder, files, calls, timeout_s, script)]


def timed(
    folder: Path, files: Mapping[str, bytes], calls: Sequence[Call], timeout_s: float, script: str = SCRIPT
) -> list[Any]:
    """Return for each call {"value": what it returns, "cpuSeconds": those of all processes of the browser, or None}.

    Raises:
        UsageError: node or Chromium is not there.
        KpcError: the page failed.
    """
    reason = missing()
    if reason is not None:
        raise UsageError(f"drawing in a browser {reason}")
    for name, data in files.items():
        (folder / name).write_bytes(data)
    bundle = folder / Path(script).with_suffix(".js").name
    _node("build.mjs", "--page", script, "--out", folder, timeout_s=timeout_s)
    jobs = json.dumps([{"call": name, "args": arguments} for name, arguments in calls])
    output = _node("tests/browser.mjs", bundle, folder, str(browser()), jobs=jobs, timeout_s=timeout_s)
    return list(json.loads(output))


def _node(*arguments: str | Path, timeout_s: float, jobs: str | None = None) -> str:
    done = subprocess.run(
        ["node", *arguments], input=jobs, capture_output=True, cwd=WEB, text=True, timeout=timeout_s, check=False
    )
    if done.returncode != 0:
        raise KpcError(f"{arguments[0]}: {done.stderr[-4000:]}")
    return done.stdout


def camera_of(camera: Camera) -> dict[str, Any]:
    """Return a camera as the page takes it."""
    pose = camera.camera_to_world[:3].ravel().tolist()
    lens = {"focal": [camera.fl_x, camera.fl_y], "centre": [camera.cx, camera.cy]}
    return {"width": camera.width, "height": camera.height, **lens, "pose": pose}


def picture_of(result: Mapping[str, Any], camera: Camera) -> np.ndarray:
    """Return a picture that the page drew: (H, W, 3) float64 in [0, 1], the top row first."""
    pixels = np.frombuffer(base64.b64decode(result["pixels"]), np.uint8)
    return pixels.reshape(camera.height, camera.width, 4)[::-1, :, :3] / 255
