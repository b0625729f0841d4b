"""Depth maps as 16-bit PNG files: written by kprender, read by contactsheet.

A level times the text entry `depth_unit` is the depth in world units along the ray. NO_SURFACE marks pixels whose ray
hits nothing.
"""

from pathlib import Path

import numpy as np
from PIL import Image, PngImagePlugin

from kpc.format.common import cli

NO_SURFACE = 65535


def depth_path(picture: Path) -> Path:
    """Return where the depth of a picture lies."""
    return picture.with_name(f"{picture.stem}_depth.png")


def write_depth(
    path: Path,
    depth: np.ndarray,  # (H, W) float, infinite where there is no surface
    unit: float,
) -> None:
    """Write a depth map whose levels are multiples of `unit`; larger depths are clipped to the last level."""
    levels = np.rint(np.minimum(depth / unit, NO_SURFACE - 1))
    levels[~np.isfinite(depth)] = NO_SURFACE
    text = PngImagePlugin.PngInfo()
    text.add_text("depth_unit", repr(unit))
    with cli.atomic_write(path) as aside:
        Image.fromarray(levels.astype(np.uint16)).save(aside, pnginfo=text)


def read_depth_levels(path: Path) -> np.ndarray:
    """Return the levels (H, W) uint16 of a depth map."""
    with Image.open(path) as image:
        return np.asarray(image).astype(np.uint16)
