"""What `kpbench web --loading` measures: how soon a page shows a scene over a slow line, beside a player of splats.

Seeks are measured in a clip in which the scene follows itself many times, with planes of its own each time, so that its
end has not arrived at first.

The other player shows a still scene of as many bytes as the whole clip has: Gaussians on the surfaces that the scene's
cameras see at the beginning, as many as fit.
"""

import json
import shutil
import subprocess
import tempfile
from pathlib import Path
from typing import Any

import numpy as np

from kpc.format.common.errors import KpcError, UsageError
from kpc.format.container import scene_io
from kpc.format.scene.cameras import Camera
from kpc.format.scene.rig import Rig
from kpc.format.scene.scene import Scene
from kpc.player.cpu.reference import render
from kpc.player.viewpoints import fit_camera
from kpc.tools.bench import web_page
from kpc.tools.bench.records import Record
from kpc.tools.exchange.points import surface_points

SIZE = (320, 240)
PLAY_S, TIMEOUT_S = 5, 600
# Bytes of a Gaussian in a .splat file: place and extent, 3 float32 each, RGBA and a quaternion, 4 bytes each.
SPLAT = np.dtype([("place", "<f4", 3), ("extent", "<f4", 3), ("colour", "u1", 4), ("turn", "u1", 4)])
# Pictures from which Gaussians are taken, and the edge of the cells in which they are merged over that of the box.
PICTURE_SIZE, SPACING = (128, 96), 1 / 100

KPC_PAGE = """<!doctype html><meta charset="utf-8"><title>KPC</title>
<style>body { margin: 0 } kpc-player { display: block; width: %dpx; height: %dpx }</style>
<script>document.addEventListener('loadeddata', ({ target }) => {
  const canvas = target.shadowRoot.querySelector('canvas');
  firstPictureGiven(canvas.getContext('webgl2'));
}, true);</script>
<script type="module" src="kpc-player.js"></script>
<kpc-player src="%s" %s muted></kpc-player>
"""
# How often a clip follows itself in the one that is sought in, and its bytes at least: four seconds of the line.
REPEATS, SOUGHT_BYTES = 6, 5_000_000
SPLAT_PAGE = """<!doctype html><meta charset="utf-8"><title>Splats</title><style>body { margin: 0 }</style>
<script>globalThis.view = %s;</script><body><script type="module" src="splat_page.js"></script>
"""


def measure(source: Path) -> dict[str, Record]:
    """Return what was measured of each player: milliseconds, bytes, frames a second."""
    scene = scene_io.read(source).dequantise()
    camera = fit_camera(_opening(scene), *SIZE)
    angle = float(np.degrees(2 * np.arctan(camera.height / 2 / camera.fl_y)))
    view = {"width": SIZE[0], "height": SIZE[1], "angle": angle, "src": "scene.splat"}
    view["pose"] = camera.camera_to_world.ravel().tolist()
    splats = splats_of(scene, source.stat().st_size // SPLAT.itemsize)
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        shutil.copy(source, folder / "scene.kpc")
        (folder / "scene.splat").write_bytes(splats.tobytes())
        (folder / "long.kpc").write_bytes(sought_in(source.read_bytes(), scene.clip.frame_count))
        (folder / "kpc.html").write_text(KPC_PAGE % (*SIZE, "scene.kpc", "autoplay loop"))
        (folder / "seeks.html").write_text(KPC_PAGE % (*SIZE, "long.kpc", ""))
        (folder / "splats.html").write_text(SPLAT_PAGE % json.dumps(view))
        kpc, seeks, other = _timed(folder, "kpc.html", "seeks.html", "splats.html")
    other |= dict.fromkeys(seeks)
    return {
        "kpc-player": kpc | seeks | {"scene_bytes": source.stat().st_size, "shows": f"{scene.clip.frame_count} frames"},
        f"spark {_version()}": other | {"scene_bytes": splats.nbytes, "shows": f"{len(splats)} Gaussians, still"},
    }


def sought_in(data: bytes, frame_count: int) -> bytes:
    """Return a clip in which a file of so many frames follows itself, in groups that share no planes.

    Clips that are joined store planes only once that are alike; those of its end would arrive with its beginning.
    """
    from kpc.tools.vectors.group_vectors import packed  # needs zstandard, which viewers do without

    copies = max(REPEATS, -(-SOUGHT_BYTES // len(data)))
    return packed([(frame_count * number, frame_count, data) for number in range(copies)])


def splats_of(scene: Scene, count: int) -> np.ndarray:
    """Return at most `count` Gaussians on the surfaces that the scene's cameras see at the beginning: (N,) SPLAT.

    Raises:
        KpcError: there is no surface.
    """
    cameras = [fit_camera(camera, *PICTURE_SIZE) for camera in Rig.of(scene).cameras]
    spacing = scene.extent * SPACING
    cloud = surface_points(((camera, render(scene, camera, 0.0)) for camera in cameras), scene.aabb, spacing)
    chosen = np.random.default_rng(0).permutation(len(cloud.points))[:count]
    if not len(chosen):
        raise KpcError("the scene has no surface that its cameras see; train it longer")
    splats = np.zeros(len(chosen), SPLAT)
    splats["place"] = cloud.points[chosen]
    # So wide that those that are left cover what all did.
    splats["extent"] = spacing / 2 * np.sqrt(len(cloud.points) / len(chosen))
    splats["colour"][:, :3] = np.round(255 * cloud.colours[chosen].clip(0, 1))
    splats["colour"][:, 3] = 255
    splats["turn"] = (255, 128, 128, 128)  # none
    return splats


def _opening(scene: Scene) -> Camera:
    opening = scene.metadata.opening
    return Rig.of(scene).cameras[0] if opening is None else opening.camera


def _version() -> str:
    package = web_page.WEB / "node_modules" / "@sparkjsdev" / "spark" / "package.json"
    return str(json.loads(package.read_text())["version"])


def _timed(folder: Path, *pages: str) -> list[dict[str, Any]]:
    """Return what tests/loading_bench.mjs finds of pages in a folder, the players being put beside them.

    Raises:
        UsageError: node, Chromium or a package is not there.
        KpcError: a page failed.
    """
    reason = web_page.missing()
    packages = web_page.WEB / "node_modules"
    if reason is None and not (packages / "@sparkjsdev").is_dir():
        reason = "needs the packages of player/web: npm ci --prefix player/web"
    if reason is not None:
        raise UsageError(f"loading in a browser {reason}")
    shutil.copy(web_page.WEB / "dist" / "kpc-player.js", folder)
    options = ["--bundle", "--minify", "--format=esm", f"--outfile={folder / 'splat_page.js'}"]
    _run(str(packages / "esbuild" / "bin" / "esbuild"), "tests/splat_page.ts", *options)
    command = ["node", "tests/loading_bench.mjs", str(web_page.browser()), str(folder), str(PLAY_S), *pages]
    return list(json.loads(_run(*command)))


def _run(*command: str) -> str:
    """Run a program in player/web; return what it writes."""
    done = subprocess.run(command, capture_output=True, cwd=web_page.WEB, text=True, timeout=TIMEOUT_S, check=False)
    if done.returncode != 0:
        raise KpcError(f"loading in a browser: {done.stderr[-4000:]}")
    return done.stdout
