"""Refinement of cameras: corrections of poses, lenses, clocks and exposures that are learnt with the scene.

As in BARF (arXiv:2104.06405), the gradient of the loss reaches the cameras by way of their rays. A pose is corrected by
a turn about the centre of the scene, common to all cameras, and a shift, both in the world's axes.

A few numbers are found from very many pixels, and some of them hardly: a turn about the scene changes only parallax.
So they take damped Gauss-Newton steps, whose matrix says how well each is determined, rather than Adam's, which are
equally long in all directions; a prior keeps what no picture determines where it was given. Steps are free of what all
cameras have in common (a similarity of the world, a shift of all clocks, a change of all exposures), so that the box
and what is up stay where they are.
"""

from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass, replace
from typing import Any, NamedTuple

import numpy as np
import torch

from kpc.encoder.datasets import Dataset, pixel_rays
from kpc.encoder.field.config import TrainConfig
from kpc.format.scene.space import DeviceCoordinates, SpaceMapping

# Corrections that are as likely as not by the prior: of poses, radians and shares of the distance from the scene; of
# the logarithm of focal lengths; of k1 and k2; of clocks, frames; of the logarithm of exposures.
POSE_PRIOR, FOCAL_PRIOR, RADIAL_PRIOR, CLOCK_PRIOR, EXPOSURE_PRIOR = 0.01, 0.01, 0.01, 2.0, 0.1

# The largest share of a Gauss-Newton step that is taken, in training, and when the scene is finished; the longest step,
# in units of the prior; and how much of the matrix stays from one step to the next.
STEP, ALIGN_STEP, LONGEST, MEMORY = 0.03, 0.1, 0.2, 0.98

# Errors of colours count as no smaller than this where gradients are divided by them.
LEAST_ERROR = 0.02

# The largest corrections of a lens, in units of the prior.
MOST_OF_LENS = 10.0

# What refinement changes of `Pictures`, besides times.
CORRECTED = ("camera_to_world", "intrinsics", "distortion")

# Differences by which derivatives are found: of rays, whose float32 numbers are exact to a thousandth of it, and of
# rays in float64.
DIFFERENCE, FINE_DIFFERENCE = 1e-3, 1e-6


class DrawnPixels(NamedTuple):
    """Pixels of pictures; each (N,) int64."""

    picture: np.ndarray
    row: np.ndarray
    column: np.ndarray


@dataclass(frozen=True)
class Correction:
    """How far refinement has moved a camera from where it was.

    Attributes:
        camera: its name.
        turned_degrees: the angle of its rotation.
        moved_share: the distance of its centre, as a share of the rig's extent.
        focal: the ratio of its focal lengths.
        late_frames: by how many frames its pictures are later than their times.
        exposure: (3,) factors by which its red, green and blue are larger than those of the scene.
        number: in `Pictures.camera`.
        camera_to_world, intrinsics, distortion: as corrected, nested tuples of the rows of `Pictures`.
    """

    camera: str
    turned_degrees: float
    moved_share: float
    focal: float
    late_frames: float
    exposure: tuple[float, ...]
    number: int
    camera_to_world: tuple[tuple[float, ...], ...]
    intrinsics: tuple[float, ...]
    distortion: tuple[float, ...]


class GaussNewton:
    """Damped Gauss-Newton steps for K numbers x of each of C things, in units of their prior, from batches of rays.

    A share of each step is taken, which averages over as many batches as its inverse; the prior counts once for all of
    these.

    Attributes:
        values: (C, K), x.
    """

    def __init__(self, count: int, size: int) -> None:
        self.values = np.zeros((count, size))
        self._matrix, self._seen = np.zeros((count, size, size)), 0.0

    def step(
        self, number: np.ndarray, slopes: np.ndarray, changes: np.ndarray, variance: float, share: float
    ) -> np.ndarray:
        """Return steps (C, K).

        Args:
            number: (N,) int64, the thing that each ray is of.
            slopes: (N, K), J^T e, with e the error of a ray's colour (3,) and J = d e / d x (3, K).
            changes: (N, K), such that the sum of their squares, as matrices (K, K), is about that of J^T J.
            variance: the mean square of the errors, with which the prior is weighed.
            share: of a whole step.
        """
        count, size = self.values.shape
        products = (changes[:, :, None] * changes[:, None]).reshape(-1, size * size)
        self._matrix += (1 - MEMORY) * (_sums(products, number, count).reshape(-1, size, size) - self._matrix)
        self._seen += (1 - MEMORY) * (1 - self._seen)
        prior = share * variance
        matrix = self._matrix / self._seen + (prior + 1e-12) * np.eye(size)
        slope = _sums(slopes, number, count) + prior * self.values
        step = -share * np.linalg.solve(matrix, slope[..., None])[..., 0]
        return step / np.maximum(np.abs(step).max(1, keepdims=True) / LONGEST, 1)

    def state(self) -> dict[str, Any]:
        """Return what a checkpoint holds."""
        return {"values": torch.from_numpy(self.values), "matrix": torch.from_numpy(self._matrix), "seen": self._seen}

    def load(self, state: dict[str, Any]) -> None:
        """Take over what `state` returned."""
        self.values[:], self._matrix[:] = state["values"].numpy(), state["matrix"].numpy()
        self._seen = state["seen"]


class Refinement:
    """The corrected cameras of a dataset.

    Pictures of the same pose and lens share a camera; one that moves has a pose for each picture. Cameras whose lenses
    are equal in the dataset share the correction of the lens. The lens of a pinhole stays one. Clocks are refined of
    cameras with several pictures; exposures unless pictures have alpha or an appearance embedding.

    Attributes:
        unit: (P,) int64, the camera of each picture, of C.
        views: the C cameras as corrected.
        is_held_out: (C,) bool, whether no picture of a camera is trained on.
        distance: the mean distance of the cameras from the centre, the unit of their shifts.
        late: (C,) by how many frames pictures are later than their times.
        gain: (C, 3) logarithms of exposures.
    """

    def __init__(self, dataset: Dataset, config: TrainConfig, centre: np.ndarray, mapping: SpaceMapping | None) -> None:
        """`centre`: (3,), the world point about which cameras are turned."""
        pictures = dataset.pictures
        self.dataset, self.centre, self.mapping = dataset, np.asarray(centre, float), mapping
        _, first, self.unit = np.unique(pictures.camera, return_index=True, return_inverse=True)
        self.given, self.views = pictures.subset(first), pictures.subset(first)
        count = len(first)
        self.is_held_out = np.bincount(self.unit, ~pictures.is_test, count) == 0
        names = ("intrinsics", "distortion", "is_fisheye", "width", "height")
        lenses = np.column_stack([getattr(self.given, name) for name in names])
        _, lens_first, lens = np.unique(np.round(lenses, 9), axis=0, return_index=True, return_inverse=True)
        self._lens = lens.ravel()
        self._is_distorted = np.any(self.given.distortion[lens_first] != 0, axis=1)
        self._has_clock = (np.bincount(self.unit, minlength=count) > 1) & dataset.is_dynamic
        self._frames = max(dataset.clip.frame_count - 1, 1)
        arms = self.given.camera_to_world[:, :3, 3] - self.centre
        self.distance = float(np.linalg.norm(arms, axis=1).mean())
        self.late, self.gain = np.zeros(count), np.zeros((count, 3))
        wants_all = bool(config.refine == "all")
        self._wants_gain = wants_all and not dataset.has_alpha and config.appearance == "none"
        units = [POSE_PRIOR] * 3 + [POSE_PRIOR * self.distance] * 3 + [CLOCK_PRIOR] * wants_all
        self._units = np.array(units)
        self._cameras = GaussNewton(count, len(units))
        self._exposures = GaussNewton(3 * count, 1)
        self._aligning: GaussNewton | None = None
        self._lens_units = np.array([FOCAL_PRIOR] + [RADIAL_PRIOR] * 2 * bool(self._is_distorted.any()))
        self._lenses = GaussNewton(len(lens_first), len(self._lens_units))

    def times(self, picture: np.ndarray) -> np.ndarray:
        """Return the corrected times of pictures, float32 in [0, 1]."""
        late = self.late[self.unit[picture]] / self._frames
        return np.clip(self.dataset.pictures.time[picture] + late, 0, 1).astype(np.float32)

    def rays(self, pixels: DrawnPixels) -> tuple[np.ndarray, np.ndarray]:
        """Return the rays through pixels, as `pixel_rays`."""
        return pixel_rays(self.views, self.unit[pixels.picture], pixels.column, pixels.row, self.mapping)

    def exposures(self, picture: np.ndarray) -> np.ndarray:
        """Return what colours of pictures are divided by, (N, 3) float32."""
        return np.exp(self.gain[self.unit[picture]]).astype(np.float32)

    def step(self, pixels: DrawnPixels, targets: np.ndarray, gradients: np.ndarray, rate: float) -> None:
        """Move the cameras of a batch of N training pixels.

        Args:
            pixels: whose rays the batch is. targets: (N, 3), their colours divided by the exposures.
            gradients: (N, RAY_GRADIENTS), `kernels.backpropagate`.
            rate: share of STEP that is taken.
        """
        unit, errors, scaled = self.unit[pixels.picture], *_errors(gradients)
        world, variance, share = self._in_world(pixels, unit, scaled), float(np.square(errors).mean()), STEP * rate
        slopes, lens_slopes = self._camera_slopes(pixels, unit, scaled, *world), self._lens_slopes(pixels, unit, *world)
        moves = self._cameras.step(unit, slopes, _changes(slopes, errors), variance, share)
        lens_moves = self._lenses.step(self._lens[unit], lens_slopes, _changes(lens_slopes, errors), variance, share)
        seen = ~self.is_held_out
        arms = (self.views.camera_to_world[:, :3, 3] - self.centre) / self.distance
        moves[seen, :6] = without_similarity(moves[seen, :6], arms[seen])
        moves[seen, 6:] -= moves[seen, 6:].mean(0)
        moves[~seen] = 0
        self._lenses.values[:] = np.clip(self._lenses.values + lens_moves, -MOST_OF_LENS, MOST_OF_LENS)
        if self._wants_gain:
            channel = (3 * unit[:, None] + np.arange(3)).ravel()
            changes = EXPOSURE_PRIOR * targets.reshape(-1, 1).astype(np.float64)
            gains = self._exposures.step(channel, changes * errors.reshape(-1, 1), changes, variance, share)
            gains = gains.reshape(-1, 3) * seen[:, None]
            self._exposures.values += (gains - gains[seen].mean(0) * seen[:, None]).reshape(-1, 1)
        self._move(moves)

    def align(self, pixels: DrawnPixels, gradients: np.ndarray, rate: float) -> None:
        """Move held-out cameras, but not their lenses and exposures.

        Arguments as for `step`, but `rate` is a share of ALIGN_STEP.
        """
        unit, errors, scaled = self.unit[pixels.picture], *_errors(gradients)
        slopes = self._camera_slopes(pixels, unit, scaled, *self._in_world(pixels, unit, scaled))
        if self._aligning is None:
            self._aligning = GaussNewton(*self._cameras.values.shape)
        variance = float(np.square(errors).mean())
        moves = self._aligning.step(unit, slopes, _changes(slopes, errors), variance, ALIGN_STEP * rate)
        moves[~self.is_held_out] = 0
        self._aligning.values += moves
        self._move(moves)

    def _in_world(
        self, pixels: DrawnPixels, unit: np.ndarray, gradients: np.ndarray
    ) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
        """Return origins and directions of rays in the world, and the gradients of both, (N, 3) each."""
        rays = pixel_rays(self.views, unit, pixels.column, pixels.row)
        origins, directions = (values.astype(np.float64) for values in rays)
        g_origins, g_directions = gradients[:, :3], gradients[:, 3:6]
        if isinstance(self.mapping, DeviceCoordinates):
            g_origins, g_directions = world_gradients(self.mapping, origins, directions, g_origins, g_directions)
        return origins, directions, g_origins, g_directions

    def _camera_slopes(
        self,
        pixels: DrawnPixels,
        unit: np.ndarray,
        gradients: np.ndarray,
        origins: np.ndarray,
        directions: np.ndarray,
        g_origins: np.ndarray,
        g_directions: np.ndarray,
    ) -> np.ndarray:
        """Return the gradients (N, K) of a camera's corrections, in units of the prior, by each ray."""
        turn = np.cross(origins - self.centre, g_origins) + np.cross(directions, g_directions)
        times = self.dataset.pictures.time[pixels.picture] + self.late[unit] / self._frames
        inside = (times > 0) & (times < 1) & self._has_clock[unit]
        late = gradients[:, 6:7] * inside[:, None] / self._frames
        parts = np.concatenate([turn, g_origins, late], axis=1)
        return parts[:, : len(self._units)] * self._units

    def _lens_slopes(
        self,
        pixels: DrawnPixels,
        unit: np.ndarray,
        origins: np.ndarray,
        directions: np.ndarray,
        g_origins: np.ndarray,
        g_directions: np.ndarray,
    ) -> np.ndarray:
        """Return the gradients (N, 1 or 3) of a lens's corrections, in units of the prior, by each ray."""
        views = self.views
        longer, bent = views.intrinsics.copy(), [views.distortion.copy() for _ in self._lens_units[1:]]
        longer[:, :2] *= 1 + DIFFERENCE
        changed = [replace(views, intrinsics=longer)]
        for k, distortion in enumerate(bent):
            distortion[:, k] += DIFFERENCE * self._is_distorted[self._lens]
            changed.append(replace(views, distortion=distortion))
        moved = [pixel_rays(some, unit, pixels.column, pixels.row)[1] - directions for some in changed]
        return np.stack([(move * g_directions).sum(1) for move in moved], axis=1) / DIFFERENCE * self._lens_units

    def _move(self, moves: np.ndarray) -> None:
        """Move cameras by (C, K), in units of the prior, and set all that follows from the corrections."""
        self._cameras.values += moves
        poses = self.views.camera_to_world
        poses[:] = moved_poses(poses, moves[:, :6] * self._units[:6], self.centre)
        self._set()

    def _set(self) -> None:
        """Set lenses, clocks and exposures from the corrections."""
        values, lens = self._cameras.values * self._units, (self._lenses.values * self._lens_units)[self._lens]
        if values.shape[1] > 6:
            self.late[:] = values[:, 6]
        self.gain[:] = EXPOSURE_PRIOR * self._exposures.values.reshape(-1, 3)
        self.views.intrinsics[:, :2] = self.given.intrinsics[:, :2] * np.exp(lens[:, :1])
        self.views.distortion[:, : lens.shape[1] - 1] = self.given.distortion[:, : lens.shape[1] - 1] + lens[:, 1:]

    def refined(self) -> Dataset:
        """Return the dataset with the corrected cameras and times."""
        return with_corrections(self.dataset, [asdict(one) for one in self.corrections()])

    def corrections(self) -> list[Correction]:
        """Return the corrections of all cameras."""
        before, after = self.given.camera_to_world, self.views.camera_to_world
        extent = max(float(torch.pdist(torch.from_numpy(before[:, :3, 3])).max()), 1e-12) if len(before) > 1 else 1.0
        turned = np.linalg.norm(after[:, :3, :3] - before[:, :3, :3], axis=(1, 2)) / np.sqrt(8)  # sin(angle / 2)
        return [
            Correction(
                self.dataset.camera_names[self.given.camera[c]],
                float(2 * np.degrees(np.arcsin(np.clip(turned[c], 0, 1)))),
                float(np.linalg.norm(after[c, :3, 3] - before[c, :3, 3]) / extent),
                float(self.views.intrinsics[c, 0] / self.given.intrinsics[c, 0]),
                float(self.late[c]),
                tuple(np.exp(self.gain[c]).tolist()),
                int(self.given.camera[c]),
                tuple(map(tuple, after[c].tolist())),
                tuple(self.views.intrinsics[c].tolist()),
                tuple(self.views.distortion[c].tolist()),
            )
            for c in range(len(before))
        ]

    def state(self) -> dict[str, Any]:
        """Return what a checkpoint holds of the refinement."""
        poses = torch.from_numpy(self.views.camera_to_world)
        return {
            "poses": poses,
            "cameras": self._cameras.state(),
            "lenses": self._lenses.state(),
            "exposures": self._exposures.state(),
        }

    def load(self, state: dict[str, Any]) -> None:
        """Take over what `state` returned."""
        self.views.camera_to_world[:] = state["poses"].numpy()
        self._cameras.load(state["cameras"])
        self._lenses.load(state["lenses"])
        self._exposures.load(state["exposures"])
        self._set()


def with_corrections(dataset: Dataset, corrections: Sequence[Mapping[str, Any]]) -> Dataset:
    """Return a dataset with cameras and times as corrected; `corrections` are those of cameras, as dictionaries.

    Pictures of other cameras stay as they are.
    """
    pictures = dataset.pictures
    order = np.argsort([one["number"] for one in corrections])
    numbers = np.array([one["number"] for one in corrections])[order]
    row = np.searchsorted(numbers, pictures.camera).clip(max=len(numbers) - 1)
    is_known = numbers[row] == pictures.camera
    changed = {name: getattr(pictures, name).copy() for name in (*CORRECTED, "time")}
    for name in CORRECTED:
        rows = np.array([one[name] for one in corrections])[order]
        changed[name][is_known] = rows[row[is_known]]
    late = np.array([one["late_frames"] for one in corrections])[order][row] / max(dataset.clip.frame_count - 1, 1)
    changed["time"][is_known] = np.clip(pictures.time + late, 0, 1)[is_known]
    return replace(dataset, pictures=replace(pictures, **changed))


def without_similarity(twist: np.ndarray, arms: np.ndarray) -> np.ndarray:
    """Return steps of cameras without what a similarity of the world does: the nearest steps orthogonal to these.

    Args:
        twist: (C, 6), turns about a common centre and shifts.
        arms: (C, 3), the cameras' positions from that centre, in the unit of the shifts.
    """
    twist, arms = twist - twist.mean(0), arms - arms.mean(0)
    scale = (twist[:, 3:] * arms).sum() / max(np.square(arms).sum(), 1e-12)
    return np.concatenate([twist[:, :3], twist[:, 3:] - scale * arms], axis=1)


def moved_poses(poses: np.ndarray, twist: np.ndarray, centre: np.ndarray) -> np.ndarray:
    """Return poses (C, 4, 4) turned about a centre (3,) and shifted, by twist (C, 6), radians and world units."""
    x, y, z = twist[:, :3].T
    zero = np.zeros_like(x)
    skew = np.stack([zero, -z, y, z, zero, -x, -y, x, zero], axis=1).reshape(-1, 3, 3)
    turns = torch.linalg.matrix_exp(torch.from_numpy(skew)).numpy()
    moved = poses.copy()
    moved[:, :3, :3] = turns @ poses[:, :3, :3]
    moved[:, :3, 3] = centre + (turns @ (poses[:, :3, 3] - centre)[..., None])[..., 0] + twist[:, 3:]
    return moved


def world_gradients(
    mapping: DeviceCoordinates,
    origins: np.ndarray,
    directions: np.ndarray,
    g_origins: np.ndarray,
    g_directions: np.ndarray,
) -> tuple[np.ndarray, np.ndarray]:
    """Return the gradients of rays in the world, given those of the same rays in device coordinates; all (N, 3)."""
    base = mapping.rays(origins, directions)

    def slope(origins: np.ndarray, directions: np.ndarray, step: float) -> np.ndarray:
        moved = mapping.rays(origins, directions)
        change = (moved.origins - base.origins) * g_origins + (moved.directions - base.directions) * g_directions
        return change.sum(1) / step

    along, step = np.eye(3), FINE_DIFFERENCE * mapping.near
    by_origin = [slope(origins + step * axis, directions, step) for axis in along]
    by_direction = [slope(origins, directions + FINE_DIFFERENCE * axis, FINE_DIFFERENCE) for axis in along]
    return np.stack(by_origin, axis=1), np.stack(by_direction, axis=1)


def _errors(gradients: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return the errors of rays (N, 3), and the gradients of half the sum of their squares, given those of the loss."""
    scaled = gradients.astype(np.float64) * (1.5 * len(gradients))
    return scaled[:, 7:], scaled


def _changes(slopes: np.ndarray, errors: np.ndarray) -> np.ndarray:
    """Return J^T e / |e| of rays (N, K), given J^T e and e (N, 3): what stands for J where only slopes are known."""
    return slopes / np.maximum(np.linalg.norm(errors, axis=1), LEAST_ERROR)[:, None]


def _sums(values: np.ndarray, number: np.ndarray, count: int) -> np.ndarray:
    """Return the sums (count, K) of rows of values (N, K) with the same number (N,)."""
    return np.stack([np.bincount(number, column, count) for column in values.T], axis=1)
