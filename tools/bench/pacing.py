"""What kpbench measures of a window that is left to itself: how often it shows a picture, on how fine a raster, and how near to the exact one."""

import math
import statistics
import time as clock
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from kpc.format.common.fidelity import psnr
from kpc.player.app.desktop import glfw
from kpc.player.app.preferences import Preferences
from kpc.player.gl import offscreen
from kpc.tools.bench.playback_stability import in_window

LEAD_IN_S = 5.0
"""Until the raster has settled."""
COMPARED = 12
"""Pictures of what is shown, evenly over the time, that are compared with exact ones."""


@dataclass(frozen=True)
class Pacing:
    """What one run is told."""

    scene: Path
    size: tuple[int, int]
    seconds: int
    turn: float
    """Degrees a second around the scene."""


def measure(job: Pacing) -> dict[str, Any]:
    """Play in a window, as kpplay begins, for so long.

    Raises:
        DisplayError: there is no display.
    """
    with in_window(job.scene, job.size, Preferences()) as player:
        began = now = clock.perf_counter()
        seconds: list[float] = []
        rasters: list[tuple[int, int]] = []
        kept: list[tuple[Any, float, np.ndarray]] = []
        while now - began < LEAD_IN_S + job.seconds or not kept:
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
        each = []
        for player.state.view, player.state.playback.time, shown in kept:
            player.scene_view.draw("reference", still=True)
            each.append(psnr(shown / 255, player.scene_view.pixels() / 255))
        middle = statistics.median_high(rasters)
        return {
            "renderer": offscreen.describe(player.window.ctx),
            "fps": len(seconds) / sum(seconds),
            "frame_ms_p95": 1e3 * float(np.percentile(seconds, 95)),
            "raster": "{}x{}".format(*middle),
            "raster_share": middle[0] * middle[1] / (job.size[0] * job.size[1]),
            "rasters_a_minute": 60 * sum(a != b for a, b in zip(rasters, rasters[1:])) / sum(seconds),
            "psnr": float(np.mean(each)),
            "psnr_least": min(each),
        }
