"""How the processor's renderer reaches the field: planes, or a corner grid, prepared for a time; and the call of the
march."""

import math
from abc import ABC, abstractmethod

import numpy as np

from kpc.format.scene.cameras import Camera
from kpc.format.scene.grid import sample_linear
from kpc.format.scene.scene import Scene
from kpc.format.scene.space import Contraction
from kpc.player.atlas import Layout
from kpc.player.cpu.field_kernels import CornerGridArrays, PlaneArrays
from kpc.player.cpu.lanes import Grid
from kpc.player.cpu.picture import Picture
from kpc.player.cpu.raymarch import March, Occupancy, View, march_blocks
from kpc.player.cpu.threads import from_both_ends

# A channel of a plane is stored in int16 steps: half the bytes of float32, so that caches hold more, and 1e-4 off in a
# picture's colours.
MOST_STEPS = 32767
# Pixels that a core takes at a time, at least.
PIXELS_AT_ONCE = 256

FieldArrays = tuple[CornerGridArrays | None, PlaneArrays | None]


class FieldSampler(ABC):
    """What samples find of a scene at a time, and the march that asks for it.

    Args:
        scene: the scene; space planes come by `set_planes`, time planes are read from it.
        layout: of the atlas that `set_planes` takes.
    """

    def __init__(self, scene: Scene, layout: Layout) -> None:
        self._scene, self._layout = scene, layout
        self._time: float | None = math.nan
        self._motion = _no_motion()
        self._code = np.empty(0, np.float32)

    @staticmethod
    @abstractmethod
    def serves(scene: Scene) -> bool:
        """Return whether this sampler can draw the scene, and saves time."""

    @staticmethod
    @abstractmethod
    def bytes_for(scene: Scene) -> int:
        """Return the memory that it takes."""

    @property
    def memory_bytes(self) -> int:
        return self.bytes_for(self._scene)

    @abstractmethod
    def set_planes(self, atlas: np.ndarray) -> None:
        """Take over the space planes from a (height, width, 4) atlas."""

    def time_planes_changed(self) -> None:
        """Forget what was made of time planes."""
        self._time = math.nan

    def prepare(self, time: float | None, code: np.ndarray) -> None:
        """Prepare for marching at a time in [0, 1], None: the static part, with an appearance's code
        (`reference.appearance_code`)."""
        if time != self._time:
            self._prepare_time(time)
            motion = self._scene.motion
            if motion is not None and time is not None:
                nodes = np.zeros((*motion.shape[1:4], 4), np.float32)
                nodes[..., :3] = sample_linear(motion, time)
                self._motion = Grid(nodes.reshape(-1, 4), nodes.shape[2::-1])
            else:
                self._motion = _no_motion()
            self._time = time
        self._code = code

    @abstractmethod
    def _prepare_time(self, time: float | None) -> None:
        """Prepare for a time other than the last."""

    @abstractmethod
    def _arrays(self, worker: int) -> FieldArrays:
        """Return what `march_blocks` is to sample, for one of the workers."""

    def march(
        self,
        camera: Camera,
        free: np.ndarray,
        blocks: np.ndarray,
        side: int,
        stride: float,
        termination: float,
        picture: Picture,
    ) -> None:
        """March the pixels of blocks into a picture, on all cores.

        Args:
            free: (Nz, Ny, Nx) uint8, `kpc.player.atlas.empty_distances` at the time.
            blocks: (N, 2) row and column of each block, rows from below.
            side: pixels a side of a block.
            stride: distance between samples, world units.
            termination: transmittance below which a ray ends.
        """
        scene = self._scene
        settings = march_settings(scene, stride, termination)
        view, uniform_distance = view_of(scene, camera), uniform_distance_of(scene)
        occupancy = Occupancy(free.reshape(-1), free.shape[::-1])
        blocks = np.ascontiguousarray(blocks, np.int64)

        def work(worker: int, part: slice) -> None:
            march_blocks(
                blocks[part],
                side,
                view,
                settings,
                uniform_distance,
                occupancy,
                self._motion,
                *self._arrays(worker),
                picture,
            )

        from_both_ends(work, len(blocks), PIXELS_AT_ONCE // side**2)


def view_of(scene: Scene, camera: Camera) -> View:
    """Return a camera's view of the scene's box."""
    low, box, pose = scene.aabb[0], scene.aabb[1] - scene.aabb[0], camera.camera_to_world
    # A box without a volume, or a camera infinitely far away: no ray meets anything.
    with np.errstate(divide="ignore", invalid="ignore", over="ignore"):
        if isinstance(scene.mapping, Contraction):
            box = 0.5 * box
            start = (pose[:3, 3] - scene.aabb.mean(0)) / box
        else:
            start = (pose[:3, 3] - low) / box
    lens, axes, start, box = (
        np.ascontiguousarray(array, np.float32)
        for array in ((camera.fl_x, camera.fl_y, camera.cx, camera.cy), pose[:3, :3], start, box)
    )
    return View((camera.width, camera.height), lens, axes, start, box)


def march_settings(scene: Scene, stride: float, termination: float) -> March:
    background = np.ascontiguousarray(scene.background, np.float32)
    return March(np.float32(stride), np.float32(stride / scene.extent), np.float32(termination), background)


def uniform_distance_of(scene: Scene) -> np.float32 | None:
    """Return how far along a ray samples are evenly spaced in contracted space; None elsewhere."""
    return np.float32(scene.mapping.uniform_distance) if isinstance(scene.mapping, Contraction) else None


def quantised_planes(plane: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Quantise a (..., M) plane to int16, each channel with a step of its own.

    Returns:
        (..., M) int16, and the steps, (M,) float64, by which weights are to be multiplied.
    """
    step = np.abs(plane).max(tuple(range(plane.ndim - 1))) / np.float32(MOST_STEPS)
    whole = np.rint(np.divide(plane, step, out=np.zeros_like(plane), where=step > 0)).astype(np.int16)
    return whole, step.astype(np.float64)


def _no_motion() -> Grid:
    return Grid(np.zeros((0, 4), np.float32), (0, 0, 0))
