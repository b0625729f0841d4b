"""What `kpbench window` measures: frame rate, resolution and accuracy of a window under quality control."""

import itertools
import math
import statistics
import time as clock
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from kpc.format.common.fidelity import psnr
from kpc.format.common.progress import Progress, progress
from kpc.player.app.desktop import glfw
from kpc.player.app.preferences import Preferences
from kpc.player.gl import offscreen
from kpc.tools.bench.harness import size_text
from kpc.tools.bench.playback_stability import in_window

# Time until the resolution has settled.
LEAD_IN_S = 5.0

# Number of pictures, evenly spread over the duration, that are compared with the reference.
COMPARED = 12


@dataclass(frozen=True)
class Pacing:
    """One run: a scene, the size of the window, the duration, and how fast the camera orbits the scene meanwhile."""

    scene: Path
    size: tuple[int, int]
    seconds: int
    turn: float  # degrees per second


def measure(job: Pacing) -> dict[str, Any]:
    """Play in a window with the settings that kpplay starts with.

    Raises:
        DisplayError: there is no display.
    """
    with in_window(job.scene, job.size, Preferences()) as player:
        began = now = clock.perf_counter()
        seconds: list[float] = []
        rasters: list[tuple[int, int]] = []
        kept: list[tuple[Any, float, np.ndarray]] = []
        with Progress("playing", LEAD_IN_S + job.seconds, "s") as bar:
            while now - began < LEAD_IN_S + job.seconds or not kept:
                bar.reach(now - began)  # between two frames, in the time of neither
                before, now = now, clock.perf_counter()
                glfw.poll_events()
                if job.turn:
                    player.state.look_from(player.state.view.orbit(math.radians(job.turn) * (now - before), 0.0))
                player.frame()
                if now - began < LEAD_IN_S:
                    continue
                seconds.append(clock.perf_counter() - now)
                rasters.append(player.scene_view.raster)
                if now - began - LEAD_IN_S >= job.seconds * len(kept) / COMPARED:
                    kept.append((player.state.view, player.state.playback.time, player.scene_view.pixels()))
        psnrs = []
        for player.state.view, player.state.playback.time, shown in progress(kept, "comparing", unit="pictures"):
            player.scene_view.draw("reference", still=True)
            psnrs.append(psnr(shown / 255, player.scene_view.pixels() / 255))
        middle = statistics.median_high(rasters)
        changes = sum(a != b for a, b in itertools.pairwise(rasters))
        return {
            "renderer": offscreen.describe(player.window.ctx),
            "fps": len(seconds) / sum(seconds),
            "frame_ms_p95": 1e3 * float(np.percentile(seconds, 95)),
            "raster": size_text(middle),
            "raster_share": middle[0] * middle[1] / (job.size[0] * job.size[1]),
            "raster_changes_per_minute": 60 * changes / sum(seconds),
            "psnr": float(np.mean(psnrs)),
            "psnr_min": min(psnrs),
        }
