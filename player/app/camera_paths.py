"""Camera paths: keyframes, and a smooth interpolation between them. No window, no OpenGL.

A path is stored in a `cameras.json` (`kpc.format.scene.cameras`) whose frames are the keyframes; `at` is the time of
each. So a file that was saved in the player's window makes a video with `kprender --path`, and pictures of its
keyframes with `--cameras`.
"""

import itertools
import os
from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np

from kpc.format.common.errors import DatasetError
from kpc.format.scene.camera_checks import check_pose
from kpc.format.scene.cameras import Camera, View, load_views, save_views
from kpc.format.scene.rotations import quaternion_of, rotation_of

# Seconds between two keyframes if the file does not say.
GAP_S = 2.0
# The longest path, seconds.
MAX_DURATION_S = 86_400.0


@dataclass(frozen=True, eq=False)
class CameraPath:
    """A smooth path that passes through keyframes exactly.

    Between two keyframes these are cubic in time: the position; the quaternion, which is then normalised; the
    logarithms of the focal lengths; the principal point. The velocities at keyframes are those of a Catmull-Rom spline
    with non-uniform knots. The clip's time only runs forwards: a keyframe with an earlier time is reached through the
    end of the clip, as when it loops. Its velocities are those of Fritsch and Butland (SIAM J. Sci. Stat. Comput. 5,
    1984), so that it is monotonic.

    Attributes:
        keyframes: views whose `at_s` increases; without `at_s` they are GAP_S apart. All get the size of the first.

    Raises:
        DatasetError: `at_s` does not increase, or exceeds MAX_DURATION_S; a pose is not a rotation and a translation.
    """

    keyframes: tuple[View, ...] = ()

    def __post_init__(self) -> None:
        views: list[View] = []
        for view in self.keyframes:
            before = views[-1].at_s if views else None
            at_s = view.at_s if view.at_s is not None else 0.0 if before is None else before + GAP_S
            if not 0.0 <= at_s <= MAX_DURATION_S or (before is not None and at_s <= before):
                reason = "lies outside a day" if before is None else f"does not follow {before:g} s within a day"
                remedy = "from 0 on" if before is None else f"above {before:g}"
                raise DatasetError(
                    f"keyframe {len(views) + 1} of the camera path is at {at_s:g} s, which {reason}; give it an `at` "
                    f"{remedy}, up to {MAX_DURATION_S:g}"
                )
            views.append(replace(view, at_s=at_s))
        for number, view in enumerate(views, 1):
            check_pose(f"keyframe {number} of the camera path", view.camera.camera_to_world)
        object.__setattr__(self, "keyframes", tuple(views))

    @staticmethod
    def load(path: str | os.PathLike[str]) -> "CameraPath":
        """Read a path from a `cameras.json`.

        Raises:
            DatasetError: the file cannot be read, or its frames make no path; the message names the file.
        """
        views = load_views(path)
        try:
            return CameraPath(tuple(views))
        except DatasetError as error:
            raise DatasetError(f"{path}: {error}") from error

    def save(self, path: str | os.PathLike[str]) -> None:
        """Write the path to a `cameras.json`."""
        save_views(path, self.keyframes)

    @property
    def start_s(self) -> float:
        """The time of the first keyframe, seconds."""
        return float(self.keyframes[0].at_s or 0.0) if self.keyframes else 0.0

    @property
    def end_s(self) -> float:
        """The time of the last keyframe, seconds."""
        return float(self.keyframes[-1].at_s or 0.0) if self.keyframes else 0.0

    def with_keyframe(self, camera: Camera, time: float, gap_s: float = GAP_S) -> "CameraPath":
        """Return the path with one more keyframe, `gap_s` seconds after the last."""
        at_s = self.end_s + gap_s if self.keyframes else 0.0
        return CameraPath((*self.keyframes, View(camera, time, f"{len(self.keyframes):04d}.png", at_s)))

    def without(self, number: int) -> "CameraPath":
        """Return the path without a keyframe, counted from 0; the others keep their times."""
        return CameraPath(self.keyframes[:number] + self.keyframes[number + 1 :])

    def spaced(self, number: int, gap_s: float) -> "CameraPath":
        """Return the path with `gap_s` seconds before keyframe `number`, from 1 on; later keyframes are shifted."""
        later = float(self.keyframes[number - 1].at_s or 0.0) + gap_s - float(self.keyframes[number].at_s or 0.0)
        moved = (replace(view, at_s=float(view.at_s or 0.0) + later) for view in self.keyframes[number:])
        return CameraPath((*self.keyframes[:number], *moved))

    def at(self, seconds: float) -> tuple[Camera, float]:
        """Return the camera and the clip's time in [0, 1] at a time of the path, clamped to its beginning and end.

        Raises:
            ValueError: the path has no keyframes.
        """
        if not self.keyframes:
            raise ValueError("the path has no keyframes")
        first, ats = self.keyframes[0].camera, self._ats
        if len(ats) == 1:
            return first, self.keyframes[0].time
        seconds = float(np.clip(seconds, ats[0], ats[-1]))
        before = min(int(np.searchsorted(ats, seconds, side="right")) - 1, len(ats) - 2)
        length = ats[before + 1] - ats[before]
        values = _hermite(
            self._values[before : before + 2],
            length * self._speeds[before : before + 2],
            (seconds - ats[before]) / length,
        )
        pose = np.eye(4)
        pose[:3, 3], pose[:3, :3] = values[:3], rotation_of(values[3:7])
        fl_x, fl_y = np.exp(values[7:9])
        camera = Camera(first.width, first.height, float(fl_x), float(fl_y), float(values[9]), float(values[10]), pose)
        return camera, float(values[11] % 1.0 if values[11] > 1.0 else max(values[11], 0.0))

    def views(self, fps: float) -> list[View]:
        """Return the views of a video at `fps` frames per second, beginning at the first keyframe."""
        count = int((self.end_s - self.start_s) * fps + 1e-6) + 1
        return [View(*self.at(self.start_s + number / fps), f"{number:04d}.png") for number in range(count)]

    @cached_property
    def _ats(self) -> np.ndarray:
        """(N,): the times of the keyframes, seconds."""
        return np.array([view.at_s for view in self.keyframes])

    @cached_property
    def _values(self) -> np.ndarray:
        """(N, 12): position, quaternion, log focal lengths, principal point, clip time plus the number of loops."""
        first = self.keyframes[0].camera
        cameras = [view.camera.resized(first.width, first.height) for view in self.keyframes]
        rotations = np.stack([quaternion_of(camera.camera_to_world[:3, :3]) for camera in cameras])
        for before, rotation in itertools.pairwise(rotations):
            rotation *= 1.0 if before @ rotation >= 0 else -1.0  # q and -q are the same rotation: take the nearer one
        intrinsics = np.array([[np.log(c.fl_x), np.log(c.fl_y), c.cx, c.cy] for c in cameras])
        eyes = np.stack([c.camera_to_world[:3, 3] for c in cameras])
        times = np.array([view.time for view in self.keyframes])
        loops = np.concatenate([[0], np.cumsum(np.diff(times) < 0)])
        return np.concatenate([eyes, rotations, intrinsics, (times + loops)[:, None]], axis=1)

    @cached_property
    def _speeds(self) -> np.ndarray:
        """(N, 12): the derivative of the values at each keyframe, per second; see the class for its sources."""
        gaps = np.diff(self._ats)[:, None]
        slopes = np.diff(self._values, axis=0) / gaps
        a, b, before, after = slopes[:-1], slopes[1:], gaps[:-1], gaps[1:]
        inner = (a * after + b * before) / (before + after)
        weighted = _nonzero((2 * after + before) * b + (after + 2 * before) * a)
        inner[:, 11] = np.where(a * b > 0, 3 * (before + after) * a * b / weighted, 0.0)[:, 11]
        return np.concatenate([slopes[:1], inner, slopes[-1:]])


def _hermite(ends: np.ndarray, speeds: np.ndarray, position: float) -> np.ndarray:
    """Evaluate the cubic Hermite polynomial on [0, 1]; ends and speeds: (2, K) values and derivatives at 0 and 1."""
    s, t = position, 1.0 - position
    return np.asarray(t * t * ((1 + 2 * s) * ends[0] + s * speeds[0]) + s * s * ((1 + 2 * t) * ends[1] - t * speeds[1]))


def _nonzero(values: np.ndarray) -> np.ndarray:
    """Replace zeros by ones, for divisors whose quotient is not used."""
    return np.where(values == 0, 1.0, values)
