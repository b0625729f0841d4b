"""What moves, and what is seen when it is gone: clean plates, mattes and maps.

A camera's picture is rendered at INSTANTS over the clip. Where its colours do not differ, the clean plate is their
mean. Elsewhere each pixel is taken from the times at which it stays the same: two instants agree if their colours
differ by at most AGREEMENT, the support of an instant is the share of those that agree with it, averaged over
neighbouring pixels, and the instant of most support is chosen. A surface that is clearly farther is preferred if it has
a support of LEAST_SUPPORT, since what hides it must have moved. The plate is the mean of the instants that agree with
the chosen one. So shadows that stay for less than half the time are removed with what casts them, and what never moves
away stays.

The matte grows from 0 to 1 where a picture differs from the plate by MATTE_RANGE, or is nearer by NEARER_RANGE: a thing
that has the colour of what it hides is part of it, too.
"""

from collections.abc import Callable
from dataclasses import replace

import numpy as np

from kpc.format.common.progress import in_parts, progress
from kpc.format.scene.cameras import Camera
from kpc.format.scene.scene import Scene
from kpc.player.cpu.reference import Rendering

# Times in [0, 1] over the clip, or over a group of it, at which a plate is rendered.
INSTANTS = (np.arange(16) + 0.5) / 16
# Colours agree if no channel of display values in [0, 1] differs by more: noise of fitting is less.
AGREEMENT = 0.06
# Support from which a farther surface is preferred, and how much farther it must be.
LEAST_SUPPORT, FARTHER = 0.2, 1.1
# Differences of display values at which the matte is 0 and 1.
MATTE_RANGE = 0.08, 0.2
# Shares of the plate's distance by which a picture is nearer where the matte is 0 and 1.
NEARER_RANGE = 0.05, 0.1
# Neighbourhood over which support is averaged: a pixel more on each side for so many columns of the picture.
COLUMNS_PER_NEIGHBOUR = 80
# Distance that counts for no surface, world units.
NOTHING = 1e6

# Luma coefficients of BT.709, contrast and black level of what stands still in a map, and the colour of what moves.
LUMINANCE = np.array([0.2126, 0.7152, 0.0722], np.float32)
MUTED = 0.6, 0.2
MOVING = np.array([1.0, 0.25, 0.05], np.float32)


class CleanPlates:
    """Clean plates of the cameras and scenes that are rendered now.

    Args:
        draw: returns the picture of a scene by a camera at a time in [0, 1] over that scene.
    """

    def __init__(self, draw: Callable[[Scene, Camera, float], Rendering]) -> None:
        self._draw = draw
        # The last ones, since a fixed camera needs its plate for every frame: of two groups, and of two instants.
        self._plates: list[tuple[Scene, Camera, Rendering]] = []

    def of(self, scene: Scene, camera: Camera) -> Rendering:
        """Return the plate of a camera."""
        if (known := self._known(scene, camera)) is not None:
            return known
        times = _times(scene)
        # A camera that moves needs a plate for each frame, which then is part of the frame.
        reported = in_parts(times) if self._plates else progress(times, "clean plate", unit="pictures")
        plate = clean_plate([self._draw(scene, camera, time) for time in reported])
        self._plates = [*self._plates[-1:], (scene, camera, plate)]
        return plate

    def pictures_of(self, scene: Scene, camera: Camera) -> int:
        """Return how many pictures the plate of a camera takes that no bar of its own reports; 0 if it is there."""
        return len(_times(scene)) if self._plates and self._known(scene, camera) is None else 0

    def _known(self, scene: Scene, camera: Camera) -> Rendering | None:
        return next((plate for of, by, plate in self._plates if of is scene and _are_equal(by, camera)), None)


def _times(scene: Scene) -> list[float]:
    times: list[float] = (INSTANTS if scene.is_dynamic else INSTANTS[:1]).tolist()
    return times


def clean_plate(pictures: list[Rendering]) -> Rendering:
    """Return what is seen when what moves is gone, from pictures of one camera at several times; see the module."""
    rgb = np.stack([picture.rgb for picture in pictures])
    depth = np.stack([picture.depth for picture in pictures])
    opacity = np.stack([picture.opacity for picture in pictures])
    count, height, width = opacity.shape
    plate = Rendering(rgb.mean(0), np.median(depth, axis=0), opacity.mean(0), np.sum([p.samples for p in pictures], 0))
    varies = np.ptp(rgb, axis=0).max(axis=-1) > AGREEMENT
    colours = rgb[:, varies]
    if not colours.size:
        return plate
    agrees = np.ones((count, count, colours.shape[1]), bool)
    for one in range(count):
        for other in range(one):
            agrees[one, other] = np.abs(colours[one] - colours[other]).max(axis=-1) <= AGREEMENT
            agrees[other, one] = agrees[one, other]
    support = np.ones((count, height, width), np.float32)
    support[:, varies] = agrees.mean(axis=0)
    support = _mean_around(support, max(round(width / COLUMNS_PER_NEIGHBOUR), 1))[:, varies]
    finite = np.where(np.isfinite(depth), depth, NOTHING).astype(np.float32)
    chosen = _farthest_supported(support, _mean_around(finite, 1)[:, varies])
    pixels = np.arange(chosen.size)
    members = agrees[:, chosen, pixels]
    plate.rgb[varies] = (colours * members[..., None]).sum(0) / members.sum(0)[:, None]
    plate.opacity[varies] = (opacity[:, varies] * members).sum(0) / members.sum(0)
    plate.depth[varies] = depth[:, varies][chosen, pixels]
    return plate


def matte(picture: Rendering, plate: Rendering) -> np.ndarray:
    """Return how much of each pixel moves, (H, W) float32 in [0, 1]."""
    nearer = 1 - np.minimum(picture.depth, NOTHING) / np.clip(plate.depth, 1e-9, NOTHING)
    by_colour = _ramp(np.abs(picture.rgb - plate.rgb).max(axis=-1), MATTE_RANGE)
    return np.maximum(by_colour, picture.opacity * _ramp(nearer, NEARER_RANGE))


def _ramp(values: np.ndarray, between: tuple[float, float]) -> np.ndarray:
    """Return how far values are on their way from one limit to the other, in [0, 1]."""
    low, high = between
    return np.clip((values - low) / (high - low), 0, 1)


def motion_colours(picture: Rendering, share: np.ndarray) -> Rendering:
    """Recolour a picture: grey where nothing moves, more and more of one colour where the matte (H, W) grows."""
    grey = (picture.rgb @ LUMINANCE)[..., None]
    muted, coloured = MUTED[0] * grey + MUTED[1], MOVING * (0.4 + 0.6 * grey)
    return replace(picture, rgb=(muted + share[..., None] * (coloured - muted)).astype(np.float32))


def _farthest_supported(
    support: np.ndarray,  # (K, N) of each instant
    depth: np.ndarray,  # (K, N)
) -> np.ndarray:
    """Return the instant of most support, or of a farther surface that has enough, (N,) integers."""
    chosen, pixels = support.argmax(axis=0), np.arange(support.shape[1])
    for _ in range(len(support)):
        is_farther = (support >= LEAST_SUPPORT) & (depth > FARTHER * depth[chosen, pixels])
        if not is_farther.any():
            break
        others = np.where(is_farther, support, 0)
        chosen = np.where(is_farther.any(axis=0), others.argmax(axis=0), chosen)
    return chosen


def _mean_around(values: np.ndarray, radius: int) -> np.ndarray:
    """Return the mean of (K, H, W) values over squares of 2 radius + 1 pixels a side; borders are repeated."""
    size = 2 * radius + 1
    for axis in (1, 2):
        pad = [(0, 0)] * 3
        pad[axis] = (radius + 1, radius)
        sums = np.cumsum(np.pad(values, pad, mode="edge"), axis=axis, dtype=np.float64)
        count = values.shape[axis]
        ends, starts = (np.take(sums, np.arange(count) + offset, axis=axis) for offset in (size, 0))
        values = ((ends - starts) / size).astype(np.float32)
    return values


def _are_equal(one: Camera, other: Camera) -> bool:
    """Return whether two cameras give the same picture."""
    names = ("width", "height", "fl_x", "fl_y", "cx", "cy")
    return all(getattr(one, name) == getattr(other, name) for name in names) and np.array_equal(
        one.camera_to_world, other.camera_to_world
    )
