"""What `kpbench web` measures: what pictures in a browser look up, how near they are to the reference, and how fast a
processor draws them.

None of the machines at hand has the graphics card of a telephone, so what a picture looks up is counted, by a variant
of the shader, and divided by what such a card can look up.
"""

import tempfile
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from kpc.format.common.fidelity import psnr
from kpc.format.container import scene_io
from kpc.format.scene.cameras import Camera
from kpc.format.scene.rig import Rig
from kpc.player.quality import LEVELS
from kpc.player.viewpoints import fit_camera
from kpc.tools.bench import web_page
from kpc.tools.bench.records import Record

# Devices: filtered RGBA16F texels that they look up a second, and the frames a second that they are to hold.
DEVICES = {
    "phone": (5e9, 30),
    "integrated": (10e9, 60),
    "card": (100e9, 60),
}
COMPARED_TIME = 0.5
# Bytes of a texel of planes, of exact rows, of the grid of cells, and of a picture that is ready to be shown.
PLANE_BYTES, ROW_BYTES, CELL_BYTES, SHOWN_BYTES = 8, 16, 1, 4
# Texels of the smaller picture that a pixel of the larger one takes (cubic.glsl).
CUBIC_TEXELS = 12
FRAMES, PLAY_S, TIMEOUT_S = 5, 12, 3600

# Runs calls in a browser of their own.
Run = Callable[..., list[Any]]
# A level, and the side of the raster over that which the level has.
Rung = tuple[str, float]


@dataclass(frozen=True)
class Drawing:
    """A scene to draw, and the size of its pictures."""

    scene: Path
    size: tuple[int, int]
    is_timed: bool  # whether the processor's frame rate is measured, too


def measure(job: Drawing) -> tuple[str, dict[Rung, Record]]:
    """Return what draws, and what was measured for each level, what `auto` chooses on DEVICES and, if timed, for it."""
    scene = scene_io.read(job.scene).dequantise()
    camera = fit_camera(Rig.of(scene).cameras[0], *job.size)

    def job_of(level: Any, time: float = COMPARED_TIME) -> dict[str, Any]:
        return {"file": job.scene.name, "camera": web_page.camera_of(camera), "time": time, "level": level}

    def run(*calls: web_page.Call) -> list[Any]:
        with tempfile.TemporaryDirectory() as folder:
            return web_page.timed(Path(folder), {job.scene.name: job.scene.read_bytes()}, calls, TIMEOUT_S)

    def values(*calls: web_page.Call) -> list[Any]:
        return [result["value"] for result in run(*calls)]

    (rungs,) = values(("rungs", [job_of("auto")]))
    named: dict[Rung, Any] = {(level, 1.0): level for level in LEVELS}
    named |= {(rung["level"], rung["scale"]): {"level": rung["level"], "scale": rung["scale"]} for rung in rungs}
    counts = dict(zip(named, values(*(("counted", [job_of(level)]) for level in named.values())), strict=True))
    found = {rung: _looked_up(counted, job.size, scene.is_dynamic) for rung, counted in counts.items()}
    reference = web_page.picture_of(counts["reference", 1.0], camera)

    ladder = [(rung["level"], rung["scale"]) for rung in rungs]
    choices = [
        ("chosen", [job_of("auto"), [found[rung]["look_ups"] / rate for rung in ladder], fps])
        for rate, fps in DEVICES.values()
    ]
    chosen = dict(zip(DEVICES, (ladder[number] for number in values(*choices)), strict=True))
    shown = list(dict.fromkeys([*((level, 1.0) for level in LEVELS), *chosen.values()]))
    resampled = [rung for rung in shown if counts[rung]["pixels"] is None]
    pictures = dict(zip(resampled, values(*(("picture", [job_of(named[rung])]) for rung in resampled)), strict=True))
    for rung in shown:
        got = web_page.picture_of(pictures.get(rung, counts[rung]), camera)
        devices = [name for name, other in chosen.items() if other == rung]
        found[rung] |= {"psnr": float(psnr(got, reference)), "chosen_on": devices}
    measured = {rung: found[rung] for rung in shown}
    (drawn,) = values(("picture", [job_of({"level": "fastest", "scale": 0.1})]))
    return drawn["name"], measured | (_timed(run, job_of, camera, reference, measured) if job.is_timed else {})


def _looked_up(counted: Record, size: tuple[int, int], is_dynamic: bool) -> Record:
    """Return what a picture looks up: texels, those of float32 twice, and bytes."""
    rays, pixels = counted["width"] * counted["height"], size[0] * size[1]
    is_exact = counted["folding"] == 0 and is_dynamic
    planes = counted["samples"] * counted["perSample"]
    rows = planes // 2 if is_exact else 0
    folding = 2 * counted["folding"]
    showing = rays + (CUBIC_TEXELS * pixels if rays < pixels else 0)
    look_ups = planes + rows + 2 * folding + counted["cells"] + showing
    read = PLANE_BYTES * (planes - rows) + ROW_BYTES * (rows + folding) + CELL_BYTES * counted["cells"]
    written = PLANE_BYTES * (counted["folding"] + rays) + SHOWN_BYTES * pixels
    devices = {f"{name}_fps": rate / look_ups for name, (rate, _) in DEVICES.items()}
    return {
        "raster": f"{counted['width']}x{counted['height']}",
        "samples_per_ray": counted["samples"] / rays,
        "cells_per_ray": counted["cells"] / rays,
        "texels_per_pixel": planes / pixels,
        "look_ups": look_ups,
        "bytes": read + SHOWN_BYTES * showing + written,
        **devices,
    }


def _timed(
    run: Run, job_of: Callable[..., Any], camera: Camera, reference: np.ndarray, measured: dict[Rung, Record]
) -> dict[Rung, Record]:
    """Time a processor's pictures of each rung, into `measured`; return what `auto` does."""
    ready = ("picture", [job_of("fastest")])
    for (level, scale), record in measured.items():
        times = [(COMPARED_TIME + number / 30) % 1 for number in range(1, 1 + FRAMES)]
        frames = ("frames", [[job_of({"level": level, "scale": scale}, time) for time in times]])
        _, _, took = run(ready, frames, frames)
        record["software_fps"] = 1e3 / float(np.median(took["value"]))
        record["cpu_ms"] = None if took["cpuSeconds"] is None else 1e3 * took["cpuSeconds"] / FRAMES
    played, still = run(("play", [job_of("auto"), PLAY_S]), ("picture", [job_of("auto")]))
    rung = {key: played["value"][key] for key in ("level", "scale")}
    (picture,) = run(("picture", [job_of(rung)]))
    took = played["value"]["ms"]
    return {
        ("auto", rung["scale"]): {
            "raster": f"{rung['level']}, {rung['scale']:.2f}",
            "software_fps": 1e3 / float(np.median(took[len(took) // 2 :])),
            "psnr": float(psnr(web_page.picture_of(picture["value"], camera), reference)),
            "psnr_still": float(psnr(web_page.picture_of(still["value"], camera), reference)),
            "chosen_on": [],
        }
    }
