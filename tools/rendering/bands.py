"""Large pictures in bands of rows, so that progress is seen, and Ctrl-C heard, before a picture is whole."""

import contextlib
import time
from collections.abc import Callable
from dataclasses import replace

import numpy as np

from kpc.format.common.progress import Progress
from kpc.format.scene.cameras import Camera
from kpc.player.cpu.reference import Rendering

# Pixels of a band: some seconds on a processor, beside which the cost of a band does not count.
BAND_PIXELS = 1 << 17
# Seconds that a picture may take before a bar of its own is shown.
SLOW_S = 2.0


def in_bands(draw: Callable[[Camera], Rendering], camera: Camera) -> Rendering:
    """Draw a picture in bands of rows.

    Args:
        draw: draws what a camera sees. Pixels must not depend on those around them.
        camera: of the whole picture.
    """
    rows = max(1, BAND_PIXELS // camera.width)
    starts = range(0, camera.height, rows)
    if len(starts) == 1:
        return draw(camera)
    began, parts = time.monotonic(), []
    with contextlib.ExitStack() as stack:
        bar: Progress | None = None
        for start in starts:
            height = min(rows, camera.height - start)
            parts.append(draw(replace(camera, height=height, cy=camera.cy - start)))
            if bar is not None:
                bar.advance()
            elif (time.monotonic() - began) * len(starts) > SLOW_S * len(parts):
                bar = stack.enter_context(Progress("drawing", len(starts), "bands"))
                bar.advance(len(parts))
    fields = ("rgb", "depth", "opacity", "samples")
    return Rendering(*(np.concatenate([getattr(part, field) for part in parts]) for field in fields))
