"""Pictures in bands of rows, so that progress is seen, and Ctrl-C heard, before a picture is whole."""

from collections.abc import Callable
from dataclasses import replace

import numpy as np

from kpc.format.common.progress import in_parts
from kpc.format.scene.cameras import Camera
from kpc.player.cpu.reference import Rendering


def in_bands(draw: Callable[[Camera], Rendering], camera: Camera, pixels: int) -> Rendering:
    """Draw a picture in bands of rows.

    Args:
        draw: draws what a camera sees. Pixels must not depend on those around them.
        camera: of the whole picture.
        pixels: the most of a band, but for one of a single row.
    """
    rows = max(1, pixels // camera.width)
    starts = range(0, camera.height, rows)
    if len(starts) == 1:
        return draw(camera)
    parts = [
        draw(replace(camera, height=min(rows, camera.height - start), cy=camera.cy - start))
        for start in in_parts(starts)
    ]
    fields = ("rgb", "depth", "opacity", "samples")
    return Rendering(*(np.concatenate([getattr(part, field) for part in parts]) for field in fields))
