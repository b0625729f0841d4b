"""The pixels of pictures and films, and the files of pictures."""

import contextlib
import itertools
import os
import sys
from collections.abc import Callable, Iterator, Sequence
from pathlib import Path

import numpy as np
from PIL import Image

from kpc.format.common import cli
from kpc.format.common.errors import MediaError
from kpc.format.common.images import image_info, read_image, write_image
from kpc.format.common.text import check_unicode
from kpc.format.scene.cameras import Camera
from kpc.format.scene.scene import Scene
from kpc.format.scene.space import Contraction
from kpc.player.cpu.reference import Rendering
from kpc.tools.cli.depth_images import NO_SURFACE, depth_path, write_depth
from kpc.tools.rendering.content import linear_colours, straight_colours

# Depth PNGs of contracted scenes reach this many times `Contraction.uniform_distance`: 16 bits could not resolve near
# depths if they reached as far as the rays.
CONTRACTED_DEPTH_RANGE = 16.0


def colour_pixels(picture: Rendering, is_transparent: bool, bits: int = 8) -> np.ndarray:
    """Return integers, (H, W, 3) or with straight alpha (H, W, 4): uint8, or uint16 over its whole range for more than
    8 bits."""
    rgb = np.clip(picture.rgb, 0, 1)
    if is_transparent:
        rgb = np.concatenate([straight_colours(picture), np.clip(picture.opacity, 0, 1)[..., None]], axis=2)
    kind = np.uint8 if bits == 8 else np.uint16
    return np.rint(rgb * np.iinfo(kind).max).astype(kind)


def write_picture(path: Path, picture: Rendering, is_transparent: bool, depth_unit: float | None) -> None:
    """Write a picture in the format that its suffix names, and beside it its depth if a unit is given."""
    if path.suffix.lower() == ".exr":
        _write_exr(path, picture, is_transparent)
        return
    if depth_unit is not None:  # first, so that a picture that exists is complete
        write_depth(depth_path(path), picture.depth, depth_unit)
    write_image(path, colour_pixels(picture, is_transparent))


def is_complete(path: Path, camera: Camera, with_depth: bool) -> bool:
    """Return whether a picture of a camera's size has been written, and its depth if wanted."""
    try:
        if not path.is_file():
            return False
        with _without_stderr():
            info = image_info(path)
            if (info.width, info.height) != (camera.width, camera.height):
                return False
            read_image(path)
        if path.suffix.lower() != ".exr":
            with Image.open(path) as image:
                image.verify()  # finds an end that is missing
    except (MediaError, OSError, SyntaxError):
        return False
    return not with_depth or path.suffix.lower() == ".exr" or depth_path(path).is_file()


@contextlib.contextmanager
def _without_stderr() -> Iterator[None]:
    """Discard what the process writes to stderr: OpenEXR reports there what it also raises."""
    sys.stderr.flush()
    kept = os.dup(2)
    try:
        with open(os.devnull, "wb") as nothing:
            os.dup2(nothing.fileno(), 2)
        yield
    finally:
        os.dup2(kept, 2)
        os.close(kept)


def _write_exr(path: Path, picture: Rendering, is_transparent: bool) -> None:
    """Write R, G, B in linear light, multiplied by the alpha A, and Z in world units along the ray, infinite where
    there is no surface. Over a background A is 1."""
    import OpenEXR

    check_unicode(path, "EXR")
    rgb = linear_colours(picture, is_transparent).astype(np.float32)
    alpha = np.clip(picture.opacity, 0, 1) if is_transparent else np.ones_like(picture.opacity)
    rgba = np.ascontiguousarray(np.concatenate([rgb, alpha[..., None]], axis=2), np.float32)
    channels = {"RGBA": rgba, "Z": np.ascontiguousarray(picture.depth, np.float32)}
    with (
        cli.atomic_write(path) as aside,
        OpenEXR.File({"compression": OpenEXR.ZIP_COMPRESSION, "type": OpenEXR.scanlineimage}, channels) as exr,
    ):
        try:
            exr.write(str(aside))
        except RuntimeError as error:
            reason = str(error).replace(str(aside), str(path))
            raise MediaError(f"{path}: cannot be written ({reason.rstrip('.')})") from error


def max_depth(scenes: Sequence[Scene], cameras: Sequence[Camera]) -> float:
    """Return a depth that no surface exceeds: the greatest distance from a camera to a corner of the scenes' bounds.

    In contracted space it is a limit to which depth is clipped.
    """
    if contraction := _contraction_of(scenes):
        return CONTRACTED_DEPTH_RANGE * contraction.uniform_distance
    corners = np.array([corner for scene in scenes for corner in itertools.product(*scene.bounds.T)])
    eyes = np.unique([camera.camera_to_world[:3, 3] for camera in cameras], axis=0)
    return float(np.linalg.norm(eyes[:, None] - corners, axis=2).max())


def depth_unit(scenes: Sequence[Scene], cameras: Sequence[Camera]) -> float:
    """Return the distance that a level of a depth PNG stands for, world units."""
    return max_depth(scenes, cameras) / (NO_SURFACE - 1)


def _contraction_of(scenes: Sequence[Scene]) -> Contraction | None:
    """Return the contraction that reaches farthest; None if no scene is in contracted space."""
    found = [scene.mapping for scene in scenes if isinstance(scene.mapping, Contraction)]
    return max(found, key=lambda mapping: mapping.uniform_distance, default=None)


def depth_pixels(scenes: Sequence[Scene], cameras: Sequence[Camera], bits: int) -> Callable[[Rendering], np.ndarray]:
    """Return a function that shows depth in grey: near is white, far and empty are black.

    Grey is linear in depth, or in contracted space in the ray's parameter, along which samples are evenly spaced.
    """
    mapping, farthest = _contraction_of(scenes), max_depth(scenes, cameras)
    kind = np.uint8 if bits == 8 else np.uint16

    def pixels(picture: Rendering) -> np.ndarray:
        if mapping is not None:
            brightness = 1 - mapping.parameter(picture.depth) / (2 * mapping.uniform_distance)
        else:
            relative = np.minimum(picture.depth / farthest, 1)
            brightness = np.where(np.isfinite(picture.depth), 1 - relative, 0)
        return np.repeat(np.rint(brightness * np.iinfo(kind).max).astype(kind)[..., None], 3, axis=2)

    return pixels
