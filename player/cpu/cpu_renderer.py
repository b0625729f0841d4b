"""Pictures that a processor marches itself (`kpc.player.cpu.raymarch`), where it would draw what a graphics card does, too."""

import math
from abc import ABC, abstractmethod
from typing import Any

import numpy as np
from kpc.format.scene.cameras import Camera
from kpc.format.scene.grid import sample_linear
from kpc.format.scene.scene import Scene
from kpc.format.scene.space import Contraction
from kpc.player.cpu.raymarch import march_blocks
from kpc.player.cpu.threads import from_both_ends

MOST_STEPS = 32767
"""Of a plane's channel, from 0: half the bytes of float32, which a processor's caches hold the more of, and 1e-4 off in a picture's colours."""
BLOCK = 4
"""Pixels a side of a block of probes.glsl."""
PIXELS_AT_ONCE = 256
"""That a core takes, at least."""


class Marching(ABC):
    """What samples find of a scene at a time, and pictures of it."""

    def __init__(self, scene: Scene) -> None:
        self._scene = scene
        self._time: float | None = math.nan
        self._motion = np.zeros((0, 0, 0, 4), np.float32)
        self._room = np.empty(0, np.float32)

    @staticmethod
    @abstractmethod
    def serves(scene: Scene) -> bool:
        """Whether it can, or is worth it."""

    @staticmethod
    @abstractmethod
    def bytes_for(scene: Scene) -> int:
        """What it takes, but for `room`."""

    @property
    def memory_bytes(self) -> int:
        return self.bytes_for(self._scene) + self._room.nbytes

    @abstractmethod
    def keep(self, atlas: np.ndarray) -> None:
        """Take planes from an atlas, (height, width, 4), of the layout, from now on."""

    def forget(self) -> None:
        """Rows of time planes are others now."""
        self._time = math.nan

    def go_to(self, time: float | None, code: np.ndarray) -> None:
        """March pictures of a time in [0, 1], or of what is static, with the code of an appearance (`kpc.player.cpu.reference.appearance_code`), from now on."""
        if time != self._time:
            self._prepare(time)
            motion = self._scene.motion
            if motion is not None and time is not None:
                self._motion = np.zeros((*motion.shape[1:4], 4), np.float32)
                self._motion[..., :3] = sample_linear(motion, time)
            else:
                self._motion = np.zeros((0, 0, 0, 4), np.float32)
            self._time = time
        self._code = code

    @abstractmethod
    def _prepare(self, time: float | None) -> None:
        """For a time that is not the last."""

    @abstractmethod
    def _looked_at(self, worker: int) -> tuple[Any, Any]:
        """`baked` and `looked_up` of `march_blocks`."""

    @staticmethod
    @abstractmethod
    def rehearsed(scene: Scene) -> tuple[Any, Any]:
        """Of the same types as `_looked_at`."""

    def room(self, size: tuple[int, int]) -> tuple[np.ndarray, np.ndarray]:
        """(h, w, 4) and (h, w, 2) float32 for what is seen and met of a picture, or a part of one; valid until it is asked for again."""
        width, height = size
        if self._room.size < 6 * width * height:
            self._room = np.zeros(6 * width * height, np.float32)
        seen, met = np.split(self._room[: 6 * width * height], [4 * width * height])
        return seen.reshape(height, width, 4), met.reshape(height, width, 2)

    def march(
        self, camera: Camera, free: np.ndarray, blocks: np.ndarray, side: int, step: float, termination: float, first: tuple[int, int],
        seen: np.ndarray, met: np.ndarray,
    ) -> None:  # fmt: skip
        """Write what march.glsl gives of some blocks of a picture.

        Args:
            free: (Nz, Ny, Nx) uint8, `kpc.player.atlas.empty_distances` to what is occupied at the time.
            blocks: (N, 2) of row and column, rows from below, each of `side` x `side` pixels.
            step: world units.
            first: column and row of the pixel that comes first in `seen`, (h, w, 4) rgb and opacity, and `met`, (h, w, 2) sum of weight t and
                samples; float32, rows from below.
        """
        scene, size = self._scene, (camera.width, camera.height)
        low, box = scene.aabb[0], scene.aabb[1] - scene.aabb[0]
        pose = camera.camera_to_world
        even = _even(scene)
        with np.errstate(
            divide="ignore", invalid="ignore", over="ignore"
        ):  # a box without a volume, a camera at the end of the world: no ray meets a thing
            start = (
                (pose[:3, 3] - low) / box if even is None else (pose[:3, 3] - scene.aabb.mean(0)) / (box := 0.5 * box)
            )
        lens, axes, begin, edges, background = (
            np.ascontiguousarray(array, np.float32)
            for array in ((camera.fl_x, camera.fl_y, camera.cx, camera.cy), pose[:3, :3], start, box, scene.background)
        )
        stride, tau, least = map(np.float32, (step, step / scene.extent, termination))
        motion = self._motion

        def work(worker: int, part: slice) -> None:
            march_blocks(
                blocks[part], side, first, size, lens, axes, begin, edges, even, stride, tau, least, background,
                free.reshape(-1), free.shape[::-1], motion.reshape(-1, 4), motion.shape[2::-1], *self._looked_at(worker), seen, met,
            )  # fmt: skip

        blocks = np.ascontiguousarray(blocks)
        from_both_ends(work, len(blocks), PIXELS_AT_ONCE // side**2)


def _even(scene: Scene) -> np.float32 | None:
    """Of contracted space."""
    return np.float32(scene.mapping.uniform_distance) if isinstance(scene.mapping, Contraction) else None


def in_steps(plane: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """A plane, (..., M), as int16: each channel in steps of its own, (M,) float64, by which weights are to be the larger."""
    step = np.abs(plane).max(tuple(range(plane.ndim - 1))) / np.float32(MOST_STEPS)
    whole = np.rint(np.divide(plane, step, out=np.zeros_like(plane), where=step > 0)).astype(np.int16)
    return whole, step.astype(np.float64)


def rehearse(kind: type[Marching], scene: Scene) -> None:
    """Have `march_blocks` compiled for a kind of marching and scene, which takes five seconds, or loaded, before a picture waits for it: march no block of nothing."""
    size, nothing = (1, 1), np.zeros((0, 2), np.int64)
    one, three, four = np.float32(1), np.zeros(3, np.float32), np.zeros((1, 4), np.float32)
    march_blocks(
        nothing, 1, (0, 0), size, four[0], np.zeros((3, 3), np.float32), three, three, _even(scene), one, one, one, three,
        np.zeros(1, np.uint8), (1, 1, 1), four, (1, 1, 1), *kind.rehearsed(scene), np.zeros((1, 1, 4), np.float32), np.zeros((1, 1, 2), np.float32),
    )  # fmt: skip


def probes_of(turn: int, left: int, bottom: int, right: int, top: int, size: tuple[int, int]) -> np.ndarray:
    """(top - bottom, right - left, 2) int64 of row and column: `probe_of` of probes.glsl, of a rectangle of blocks of a picture of (width, height)."""
    rows, columns = np.mgrid[bottom:top, left:right]
    k = turn + 3 * columns + 5 * rows & 15
    x, y = 2 * ((k ^ k >> 1) & 1) + ((k >> 2 ^ k >> 3) & 1), 2 * (k & 1) + (k >> 2 & 1)
    return np.stack([np.minimum(BLOCK * rows + y, size[1] - 1), np.minimum(BLOCK * columns + x, size[0] - 1)], axis=-1)
