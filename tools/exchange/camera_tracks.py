"""Cameras between `cameras.json` and the files of other programs: still cameras, or one that moves along a path."""

import os
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace

import numpy as np

from kpc.format.common.errors import DatasetError, UsageError
from kpc.format.scene.cameras import MAX_SIDE, Camera, View, load_views
from kpc.format.scene.rotations import quaternion_of, slerp
from kpc.player.app.camera_paths import CameraPath
from kpc.player.viewpoints import fit_camera
from kpc.tools.exchange.placement import Placement

# The most cameras, and the most instants of a moving one, that are written or read.
MAX_VIEWS = 100_000
# The width of a picture where a file does not say.
DEFAULT_WIDTH = 1920
# Instants a second where a camera does not move linearly between its keys, unless the file has a rate.
SAMPLED_FPS = 24.0
# The share of the way between two keys at which that is looked at, and how far off it may be: of the extent of the
# path, and in the entries of a rotation. Half-way, a whole turn would look like none.
LOOKED_AT, TOLERANCE = 0.382, 1e-3


@dataclass(frozen=True)
class Track:
    """A camera of a file.

    Attributes:
        name: of the camera.
        views: one without `at_s` if the camera stands still; else with increasing `at_s`, between which programs
            interpolate linearly.
    """

    name: str
    views: tuple[View, ...]

    @property
    def is_moving(self) -> bool:
        """Whether the camera has instants."""
        return self.views[0].at_s is not None


def load_tracks(path: str | os.PathLike[str], fps: float | None) -> list[Track]:
    """Read a `cameras.json`: a path, sampled at `fps`, if its frames have `at`; else its views as still cameras.

    Args:
        path: of the file.
        fps: instants per second of a path; None for its keyframes alone.

    Raises:
        DatasetError: the file cannot be used.
        UsageError: there are too many instants.
    """
    views = load_views(path)
    if all(view.at_s is None for view in views):
        return [Track(view.file.rsplit(".", 1)[0], (view,)) for view in views]
    course = CameraPath.load(path)
    keyframes = course.keyframes
    if fps is None:
        first = keyframes[0].camera
        return [Track("path", tuple(_resized(view, first.width, first.height) for view in keyframes))]
    count = int((course.end_s - course.start_s) * fps + 1e-6) + 1
    if count > MAX_VIEWS:
        raise UsageError(f"{path}: {count} instants are more than {MAX_VIEWS}; choose a lower --fps")
    instants = [course.start_s + number / fps for number in range(count)]
    return [Track("path", tuple(View(*course.at(at_s), f"{n:04d}.png", at_s) for n, at_s in enumerate(instants)))]


def views_of(path: str, tracks: Sequence[Track], name: str | None) -> list[View]:
    """Return the views of a `cameras.json`: those of all still cameras, or of the one that moves.

    Args:
        path: of the file that was read, which begins messages.
        tracks: its cameras.
        name: of the camera to take; None for all.

    Raises:
        DatasetError: the file has no camera.
        UsageError: there is no such camera, or a moving one is not alone.
    """
    if not tracks:
        raise DatasetError(f"{path}: holds no perspective camera; export with cameras")
    names = ", ".join(track.name for track in tracks[:8]) + (", ..." if len(tracks) > 8 else "")
    if name is not None:
        tracks = [track for track in tracks if track.name == name]
        if len(tracks) != 1:
            raise UsageError(f"--camera {name}: {path} has {len(tracks)} cameras of that name; it has {names}")
    if len(tracks) > 1 and any(track.is_moving for track in tracks):
        raise UsageError(f"{path}: has several cameras, of which some move; choose one with --camera: {names}")
    return [view for track in tracks for view in track.views]


def with_instants_between(
    where: str, keys: np.ndarray, poses: Callable[[np.ndarray], np.ndarray], step: float
) -> np.ndarray:
    """Return the instants of a camera's keys, and others where it does not move linearly between two: it turns with
    what holds it, say, or jumps.

    Args:
        where: the camera, which begins messages.
        keys: (N,) increasing.
        poses: of the camera at instants, (M,) to (M, 4, 4).
        step: between the instants that are added, in the unit of the keys.

    Raises:
        DatasetError: there are more than MAX_VIEWS.
    """
    if len(keys) < 2:
        return keys
    ends, gaps = poses(keys), np.diff(keys)
    seen = poses(keys[:-1] + LOOKED_AT * gaps)
    eyes, turns = ends[:, :3, 3], quaternion_of(ends[:, :3, :3])
    linear = (1 - LOOKED_AT) * eyes[:-1] + LOOKED_AT * eyes[1:]
    moved = np.linalg.norm(linear - seen[:, :3, 3], axis=1)
    circled = slerp(turns[:-1], turns[1:], np.full((len(gaps), 1), LOOKED_AT))
    cosines = (circled * quaternion_of(seen[:, :3, :3])).sum(1)  # of half the angle between two rotations
    turned = np.sqrt(8 * np.maximum(1 - cosines**2, 0))  # the Frobenius norm of R^T R' - 1
    is_linear = (moved <= TOLERANCE * np.ptp(eyes, axis=0).max()) & (turned <= TOLERANCE)
    counts = np.where(is_linear, 1, np.maximum(np.ceil(gaps / step - 1e-6), 1))
    if counts.sum() + 1 > MAX_VIEWS:
        raise DatasetError(f"{where}: sampled between its keys, it has more than {MAX_VIEWS} instants; export fewer")
    added = [key + gap * np.arange(1, count + 1) / count for key, gap, count in zip(keys, gaps, counts, strict=False)]
    return np.concatenate([keys[:1], *added])


def sampled_note(fps: float) -> str:
    """Return what to say of a camera to which instants were added."""
    return f"between keys the camera jumps, or turns with what holds it: it is sampled {fps:g} times a second there"


def times_at(instants: np.ndarray, keys: np.ndarray, times: Sequence[float] | None) -> list[float]:
    """Return the clip's times at instants, from those at keys; without them, the clip plays once along the path."""
    if len(keys) < 2:
        return [0.0] if times is None else list(times)
    if times is None:
        return ((instants - keys[0]) / (keys[-1] - keys[0])).tolist()
    loops = np.concatenate([[0], np.cumsum(np.diff(times) < 0)])
    whole = np.interp(instants, keys, np.asarray(times) + loops)
    return [float(time if time <= 1 else time % 1) for time in whole]


def placed(tracks: Sequence[Track], placement: Placement) -> list[Track]:
    """Return tracks with their cameras placed."""
    return [
        replace(track, views=tuple(replace(v, camera=placement.camera(v.camera)) for v in track.views))
        for track in tracks
    ]


def size_for(where: str, aspect: float, stored: object, size: tuple[int, int] | None) -> tuple[int, int, float]:
    """Return the size of a camera's pictures, for which the aspect holds that is returned, too.

    It is the size that the file stores, else `size`, else one of the file's shape. `fitted` makes it `size`.

    Args:
        where: the camera, which begins messages.
        aspect: of the file: width over height of the pictures, with square pixels.
        stored: what the file holds as the size, a list of two integers; anything else counts as none.
        size: the one asked for.

    Raises:
        DatasetError: the aspect is none of pictures.
    """
    if isinstance(stored, list) and len(stored) == 2 and all(_is_side(side) for side in stored):
        return int(stored[0]), int(stored[1]), aspect
    if size is not None:
        return *size, size[0] / size[1]
    if not 1e-3 <= aspect <= 1e3:
        raise DatasetError(f"{where}: an aspect ratio of {aspect:g} is that of no picture; correct the camera")
    height = round(DEFAULT_WIDTH / aspect)
    if height > MAX_SIDE or height < 1:
        raise DatasetError(f"{where}: an aspect ratio of {aspect:g} needs --size")
    return DEFAULT_WIDTH, height, aspect


def fitted(camera: Camera, size: tuple[int, int] | None) -> Camera:
    """Return a camera for pictures of the size asked for, with the same vertical field of view and shape of pixels."""
    return camera if size is None else fit_camera(camera, *size)


def _is_side(side: object) -> bool:
    return isinstance(side, int) and not isinstance(side, bool) and 1 <= side <= MAX_SIDE


def _resized(view: View, width: int, height: int) -> View:
    return replace(view, camera=view.camera.resized(width, height))
