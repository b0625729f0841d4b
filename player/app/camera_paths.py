"""Camera paths: keyframes, and the smooth way from one to the next. No window, no OpenGL.

A path is kept in a `cameras.json` like any other (`kpc.format.scene.cameras`), whose frames are the keyframes; `at` says when each is
passed. So a file made in the player's window makes a video with `kprender --path`, and pictures of its keyframes with `--cameras`.
"""

import itertools
import os
from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np
from kpc.format.common.errors import DatasetError
from kpc.format.scene.cameras import Camera, View, load_views, save_views
from kpc.format.scene.rotations import quaternion_of, rotation_of

GAP_S = 2.0
"""From one keyframe to the next where nothing else is said."""
LONGEST_S = 86_400.0


@dataclass(frozen=True, eq=False)
class CameraPath:
    """A way through keyframes, which it passes exactly.

    Between two it is cubic in seconds, with one velocity at each keyframe (Catmull and Rom's, for gaps of any length): the eye; the
    quaternion, made a unit vector again; logarithms of focal lengths; the principal point. The clip only runs forwards: to a
    keyframe of an earlier time it goes through the clip's end, as when it loops; between keyframes neither too far nor back
    (Fritsch and Butland's slopes).

    Attributes:
        keyframes: Shots whose `at_s` begins anywhere and grows from one to the next; those without are GAP_S apart. All have the
            size of the first; others are refitted to it.

    Raises:
        DatasetError: `at_s` does not grow, or lasts too long; a pose is no turn and shift, say mirrored.
    """

    keyframes: tuple[View, ...] = ()

    def __post_init__(self) -> None:
        shots: list[View] = []
        for shot in self.keyframes:
            before = shots[-1].at_s if shots else None
            at_s = shot.at_s if shot.at_s is not None else 0.0 if before is None else before + GAP_S
            if not 0.0 <= at_s <= LONGEST_S or (before is not None and at_s <= before):
                after = "lies outside a day" if before is None else f"does not follow {before:g} s within a day"
                raise DatasetError(f"keyframe {len(shots) + 1} of the camera path is at {at_s:g} s, which {after}")
            shots.append(replace(shot, at_s=at_s))
        for number, shot in enumerate(shots, 1):
            axes = shot.camera.camera_to_world[:3, :3]
            if np.abs(axes.T @ axes - np.eye(3)).max() > 1e-3 or np.linalg.det(axes) < 0:
                raise DatasetError(
                    f"keyframe {number} of the camera path: its pose is scaled, skewed or mirrored; turn and shift only"
                )
        object.__setattr__(self, "keyframes", tuple(shots))

    @staticmethod
    def load(path: str | os.PathLike[str]) -> "CameraPath":
        """Of a `cameras.json`.

        Raises:
            DatasetError: it cannot be read, or its frames make no path; the message names the file.
        """
        shots = load_views(path)
        try:
            return CameraPath(tuple(shots))
        except DatasetError as error:
            raise DatasetError(f"{path}: {error}") from error

    def save(self, path: str | os.PathLike[str]) -> None:
        """Write it as a `cameras.json`."""
        save_views(path, self.keyframes)

    @property
    def start_s(self) -> float:
        return float(self.keyframes[0].at_s or 0.0) if self.keyframes else 0.0

    @property
    def end_s(self) -> float:
        return float(self.keyframes[-1].at_s or 0.0) if self.keyframes else 0.0

    def with_keyframe(self, camera: Camera, time: float, gap_s: float = GAP_S) -> "CameraPath":
        """The same, and on to one more, `gap_s` after the last."""
        at_s = self.end_s + gap_s if self.keyframes else 0.0
        return CameraPath((*self.keyframes, View(camera, time, f"{len(self.keyframes):04d}.png", at_s)))

    def without(self, number: int) -> "CameraPath":
        """The same, but for a keyframe, from 0 on; the others keep their seconds."""
        return CameraPath(self.keyframes[:number] + self.keyframes[number + 1 :])

    def spaced(self, number: int, gap_s: float) -> "CameraPath":
        """The same, with so many seconds between a keyframe, from 1 on, and the one before; those after it move along."""
        later = float(self.keyframes[number - 1].at_s or 0.0) + gap_s - float(self.keyframes[number].at_s or 0.0)
        moved = (replace(shot, at_s=float(shot.at_s or 0.0) + later) for shot in self.keyframes[number:])
        return CameraPath((*self.keyframes[:number], *moved))

    def at(self, seconds: float) -> tuple[Camera, float]:
        """The camera and the clip's time in [0, 1], `seconds` into the path; before and after it, where it begins and ends."""
        if not self.keyframes:
            raise ValueError("a path without keyframes leads nowhere")
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

    def shots(self, fps: float) -> list[View]:
        """Every frame of a video of it, the first and the last keyframe included where the frames meet them."""
        count = int((self.end_s - self.start_s) * fps + 1e-6) + 1
        return [View(*self.at(self.start_s + number / fps), f"{number:04d}.png") for number in range(count)]

    @cached_property
    def _ats(self) -> np.ndarray:
        return np.array([shot.at_s for shot in self.keyframes])

    @cached_property
    def _values(self) -> np.ndarray:
        """(N, 12): eye, quaternion, log focal lengths, principal point, the clip's time and 1 for each time it has begun anew."""
        first = self.keyframes[0].camera
        cameras = [shot.camera.resized(first.width, first.height) for shot in self.keyframes]
        turns = np.stack([quaternion_of(camera.camera_to_world[:3, :3]) for camera in cameras])
        for before, turn in itertools.pairwise(turns):
            turn *= 1.0 if before @ turn >= 0 else -1.0  # q and -q are the same turn: take the short way
        lenses = np.array([[np.log(c.fl_x), np.log(c.fl_y), c.cx, c.cy] for c in cameras])
        eyes, times = (
            np.stack([c.camera_to_world[:3, 3] for c in cameras]),
            np.array([shot.time for shot in self.keyframes]),
        )
        rounds = np.concatenate([[0], np.cumsum(np.diff(times) < 0)])
        return np.concatenate([eyes, turns, lenses, (times + rounds)[:, None]], axis=1)

    @cached_property
    def _speeds(self) -> np.ndarray:
        """(N, 12): how fast the values change at each keyframe."""
        gaps = np.diff(self._ats)[:, None]
        slopes = np.diff(self._values, axis=0) / gaps
        a, b, before, after = slopes[:-1], slopes[1:], gaps[:-1], gaps[1:]
        inner = (a * after + b * before) / (before + after)
        weighted = _nonzero((2 * after + before) * b + (after + 2 * before) * a)
        inner[:, 11] = np.where(a * b > 0, 3 * (before + after) * a * b / weighted, 0.0)[:, 11]
        return np.concatenate([slopes[:1], inner, slopes[-1:]])


def _hermite(ends: np.ndarray, speeds: np.ndarray, share: float) -> np.ndarray:
    """The cubic that has these values and speeds, of the whole way, at both ends, a share of the way along."""
    s, t = share, 1.0 - share
    return np.asarray(t * t * ((1 + 2 * s) * ends[0] + s * speeds[0]) + s * s * ((1 + 2 * t) * ends[1] - t * speeds[1]))


def _nonzero(values: np.ndarray) -> np.ndarray:
    return np.where(values == 0, 1.0, values)
