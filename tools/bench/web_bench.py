"""What `kpbench web` measures: what pictures in a browser look up, how near they are to the reference, and how fast a
processor draws them.

None of the project's machines has the graphics card of a telephone, so what a picture looks up is counted, by a variant
of the shader, and divided by what such a card can look up.
"""

import tempfile
from collections.abc import Callable
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np

from kpc.format.common.fidelity import psnr
from kpc.format.common.progress import Progress
from kpc.format.container import scene_io
from kpc.format.scene.cameras import Camera
from kpc.format.scene.rig import Rig
from kpc.player.quality import LEVELS
from kpc.player.viewpoints import fit_camera
from kpc.tools.bench import decode_bench, web_page
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
# How far a moving camera turns to either side, and pictures until it is back.
SWAY_DEGREES, SWAY_FRAMES = 10, 60

# Runs calls in a browser of their own.
Run = Callable[..., list[Any]]
# A level, and the side of the raster over that which the level has.
Setting = tuple[str, float]


@dataclass(frozen=True)
class Drawing:
    """A scene to draw, and the size of its pictures."""

    scene: Path
    size: tuple[int, int]
    is_timed: bool  # whether the processor's frame rate is measured, too


def measure(job: Drawing) -> tuple[str, dict[Setting, Record]]:
    """Return what draws, and what was measured for each level, what `auto` chooses on DEVICES and, if timed, for it."""
    with Progress("drawing", 5 + job.is_timed * (6 + len(LEVELS)), "runs") as bar:
        return _measured(job, bar)


def _measured(job: Drawing, bar: Progress) -> tuple[str, dict[Setting, Record]]:
    scene = scene_io.read(job.scene).dequantise()
    camera = fit_camera(Rig.of(scene).cameras[0], *job.size)

    def job_of(level: Any, time: float = COMPARED_TIME) -> dict[str, Any]:
        return {"file": job.scene.name, "camera": web_page.camera_of(camera), "time": time, "level": level}

    def run(*calls: web_page.Call) -> list[Any]:
        with tempfile.TemporaryDirectory() as folder:
            found = web_page.timed(Path(folder), {job.scene.name: job.scene.read_bytes()}, calls, TIMEOUT_S)
        bar.advance()
        return found

    def values(*calls: web_page.Call) -> list[Any]:
        return [result["value"] for result in run(*calls)]

    (settings,) = values(("settings", [job_of("auto")]))
    named: dict[Setting, Any] = {(level, 1.0): level for level in LEVELS}
    named |= {
        (setting["level"], setting["scale"]): {"level": setting["level"], "scale": setting["scale"]}
        for setting in settings
    }
    counts = dict(zip(named, values(*(("counted", [job_of(level)]) for level in named.values())), strict=True))
    found = {setting: _looked_up(counted, job.size, scene.is_dynamic) for setting, counted in counts.items()}
    reference = web_page.picture_of(counts["reference", 1.0], camera)

    offered = [(setting["level"], setting["scale"]) for setting in settings]
    choices = [
        ("chosen", [job_of("auto"), [found[setting]["look_ups"] / rate for setting in offered], fps])
        for rate, fps in DEVICES.values()
    ]
    chosen = dict(zip(DEVICES, (offered[number] for number in values(*choices)), strict=True))
    shown = list(dict.fromkeys([*((level, 1.0) for level in LEVELS), *chosen.values()]))
    resampled = [setting for setting in shown if counts[setting]["pixels"] is None]
    pictures = dict(
        zip(resampled, values(*(("picture", [job_of(named[setting])]) for setting in resampled)), strict=True)
    )
    for setting in shown:
        got = web_page.picture_of(pictures.get(setting, counts[setting]), camera)
        devices = [name for name, other in chosen.items() if other == setting]
        found[setting] |= {"psnr": float(psnr(got, reference)), "chosen_on": devices}
    measured = {setting: found[setting] for setting in shown}
    (drawn,) = values(("picture", [job_of({"level": "fastest", "scale": 0.1})]))
    if not job.is_timed:
        return drawn["name"], measured
    bar.extend(6 + len(measured))
    chosen_by_time = _timed(run, job_of, camera, scene.clip.frame_count, reference, measured)
    (decode_ms,) = values(("decode", [job.scene.name]))
    decoding = {"decode_ms": decode_ms, "python_decode_ms": decode_bench.measure(job.scene)["decode_ms"]}
    for record in chosen_by_time.values():
        record |= decoding
    return drawn["name"], measured | chosen_by_time


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
    run: Run,
    job_of: Callable[..., Any],
    camera: Camera,
    frame_count: int,
    reference: np.ndarray,
    measured: dict[Setting, Record],
) -> dict[Setting, Record]:
    """Time a processor's pictures of each setting, into `measured`; return what `auto` does."""
    ready = ("picture", [job_of("fastest")])
    angles = SWAY_DEGREES * np.sin(np.arange(SWAY_FRAMES) * (2 * np.pi / SWAY_FRAMES))
    cameras = [web_page.camera_of(_turned(camera, angle)) for angle in angles]
    for (level, scale), record in measured.items():
        times = [(COMPARED_TIME - number / frame_count) % 1 for number in reversed(range(2 * FRAMES))]
        jobs = [job_of({"level": level, "scale": scale}, time) for time in times]
        before, resting = jobs[:FRAMES], jobs[FRAMES:]
        swaying = [{**job, "camera": seen} for job, seen in zip(resting, cameras, strict=False)]
        frames = (("frames", [group]) for group in (swaying, swaying, before, resting))
        _, _, swayed, _, rested, played = run(ready, *frames, ("played", [resting]))
        record |= _spent(swayed) | {f"resting_{name}": value for name, value in _spent(rested).items()}
        record["resting_psnr"] = float(psnr(web_page.picture_of(played["value"][-1], camera), reference))
    (still,) = run(("picture", [job_of("auto")]))
    found: dict[Setting, Record] = {}
    for name, seen in (("auto", cameras), ("auto, at rest", cameras[:1])):
        (played,) = run(("play", [job_of("auto"), PLAY_S, seen]))
        setting, took = {key: played["value"][key] for key in ("level", "scale")}, played["value"]["ms"]
        (picture,) = run(("picture", [job_of(setting)]))
        found[name, setting["scale"]] = {
            "raster": f"{setting['level']}, {setting['scale']:.2f}",
            "software_fps": 1e3 / float(np.median(took[len(took) // 2 :])),
            "psnr": float(psnr(web_page.picture_of(picture["value"], camera), reference)),
            "psnr_still": float(psnr(web_page.picture_of(still["value"], camera), reference)),
            "chosen_on": [],
        }
    return found


def _turned(camera: Camera, degrees: float) -> Camera:
    """Return the camera turned about its own upward axis."""
    cos, sin = np.cos(np.radians(degrees)), np.sin(np.radians(degrees))
    pose = camera.camera_to_world.copy()
    pose[:3, :3] = pose[:3, :3] @ np.array([[cos, 0, sin], [0, 1, 0], [-sin, 0, cos]])
    return replace(camera, camera_to_world=pose)


def _spent(took: Record) -> Record:
    """Return the frames a second of `frames`, and the milliseconds of all cores for each."""
    cpu_s = took["cpuSeconds"]
    fps = 1e3 / float(np.median(took["value"]))
    return {"software_fps": fps, "cpu_ms": None if cpu_s is None else 1e3 * cpu_s / FRAMES}
