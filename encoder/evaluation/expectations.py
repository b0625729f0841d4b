"""What may be expected of a dataset before it is trained on: how densely, how evenly and how sharply it was filmed.

Novel views hold where cameras are close together as seen from what they film. Rigs that are too sparse train for as
long as good ones and end in fog, so this is said first.
"""

from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np

from kpc.encoder.datasets.capture import first_names
from kpc.encoder.datasets.dataset import Dataset
from kpc.encoder.field.bounds import visible_cells
from kpc.format.common.images import luma
from kpc.format.common.text import spanned
from kpc.format.scene.space import SpaceMapping

# Cells along each side of the box in which it is counted how many cameras see them.
CELLS = 24
# Pictures whose light and detail are measured, evenly spread, and rows of each.
PICTURES, ROWS = 96, 32

# Neighbouring cameras further apart than this, as seen from what they look at, leave gaps in between; cameras that are
# all within the other angle see too little of depth. Both in degrees.
SPARSE, NARROW = 30.0, 1.5
# A second camera must see at least this share of the cells that one camera sees.
SHARED = 0.25
# Neighbouring cameras of a rig whose exposures differ by more than so many stops show in novel views.
STOPS = 0.6
# Pictures with less than this share of the others' fine detail are blurred; so many of a moving camera's may be.
BLURRED, BLURRED_SHARE = 0.6, 0.2


@dataclass(frozen=True)
class Expectations:
    """How a dataset was filmed.

    Attributes:
        names: of the training cameras; a moving camera is one at each of its places.
        is_rig: whether several film each instant.
        is_static: whether all of them show the same instant.
        neighbours: (N,) float64, angle in degrees between each camera and the nearest one, as seen from the point that
            they look at; empty if there is none.
        spread: the largest angle between two of them; NaN if they look at no common point.
        seen: share of the box that 1, 2, 3 and 4 of them see.
        stops: for each camera of a rig, how much brighter it is than the nearest one, and that one's number.
        blurred: numbers of cameras that are less sharp than the others.
        measured: how many cameras `blurred` is from.
    """

    names: tuple[str, ...]
    is_rig: bool
    is_static: bool
    neighbours: np.ndarray
    spread: float
    seen: tuple[float, ...]
    stops: tuple[tuple[float, int], ...]
    blurred: tuple[int, ...]
    measured: int

    def paragraph(self) -> str:
        """Describe it in one line."""
        parts = [f"{len(self.names)} {'cameras' if self.is_rig else 'places of cameras'}"]
        if len(self.neighbours):
            near, middle, far = np.quantile(self.neighbours, (0, 0.5, 1))
            parts.append(
                f"{spanned(f'{near:.3g}', f'{far:.3g}')} degrees from the next (median {middle:.3g}) and up to "
                f"{self.spread:.3g} from each other, as seen from what they look at"
            )
        if len(self.seen) > 1:
            counts = ", ".join(str(number) for number in range(2, len(self.seen) + 1))
            shares = ", ".join(f"{share:.0%}" for share in self.seen[1:])
            parts.append(f"{counts} of them see {shares} of the box")
        if self.stops:
            parts.append(f"exposures of neighbours within {max(abs(stops) for stops, _ in self.stops):.1f} stops")
        parts.append(f"{len(self.blurred) or 'none'} of {self.measured} blurred")
        return "; ".join(parts)

    def warnings(self) -> Iterator[str]:
        """Yield a line for each reason why novel views will not hold, with what to film instead."""
        if len(self.neighbours) and (self.is_rig or self.is_static) and np.median(self.neighbours) > SPARSE:
            yield (
                f"cameras are {np.median(self.neighbours):.0f} degrees from the next (median), and views between them "
                "will not hold; film with cameras 5 to 12 degrees apart, on a smaller arc if they are few"
            )
        if self.spread < NARROW:
            yield (
                f"all cameras are within {self.spread:.2g} degrees, as seen from what they look at, and show "
                "too little depth; film from more sides"
            )
        if len(self.seen) > 1 and self.seen[1] < SHARED * self.seen[0]:
            yield (
                f"only {self.seen[1] / self.seen[0]:.0%} of what one camera sees of the box is seen by a second, and "
                "the rest has no depth; film with more overlap, or give --box around what matters"
            )
        different = [(stops, number, other) for number, (stops, other) in enumerate(self.stops) if abs(stops) > STOPS]
        if different:
            stops, number, other = max(different, key=lambda found: abs(found[0]))
            yield (
                f"{self.names[number]} is {abs(stops):.1f} stops {'brighter' if stops > 0 else 'darker'} than "
                f"{self.names[other]} beside it; give --appearance camera, or film with exposure locked"
            )
        if self.blurred and (self.is_rig or len(self.blurred) > BLURRED_SHARE * self.measured):
            names = first_names([self.names[number] for number in self.blurred])
            yield f"less sharp than the others: {names}; film with a faster shutter, and focus by hand"


def expect(dataset: Dataset, aabb: np.ndarray, mapping: SpaceMapping | None) -> Expectations:
    """Measure how a dataset was filmed, from its cameras and from ROWS rows of at most PICTURES pictures.

    Args:
        aabb: (2, 3) box of the planes.
        mapping: how space beyond the box is held.
    """
    pictures = dataset.pictures
    train = np.flatnonzero(~pictures.is_test)
    _, first = np.unique(pictures.camera[train], return_index=True)
    shown = train[np.sort(first)]  # a picture of each camera
    names = tuple(dataset.camera_names[int(pictures.camera[n])] for n in shown)
    is_rig = dataset.is_dynamic and not dataset.is_monocular
    poses = pictures.camera_to_world[shown].astype(np.float64)
    apart = _angles(poses)
    spread, neighbours = float("nan"), np.zeros(0)
    if apart is None:
        nearest = _nearest(np.linalg.norm(poses[:, None, :3, 3] - poses[:, :3, 3], axis=2))
    else:
        nearest, spread = _nearest(apart), float(apart.max())
        neighbours = apart[np.arange(len(apart)), nearest] if len(apart) > 1 else neighbours
    seen = tuple(
        float(visible_cells(pictures, aabb, (CELLS,) * 3, mapping, count).mean())
        for count in range(1, min(len(shown), 4) + 1)
    )
    light, detail = _light_and_detail(dataset, train, shown)
    stops = [(float(light[n] - light[other]), int(other)) for n, other in enumerate(nearest)] if is_rig else []
    sharp = float(np.nanmedian(detail)) if np.isfinite(detail).any() else 0.0
    blurred = tuple(np.flatnonzero(detail < BLURRED * sharp).tolist())
    known = [(stop, other) for stop, other in stops if np.isfinite(stop)]
    return Expectations(
        *(names, is_rig, not dataset.is_dynamic, neighbours, spread, seen),
        tuple(known) if len(known) == len(stops) else (),
        blurred,
        int(np.isfinite(detail).sum()),
    )


def _angles(poses: np.ndarray) -> np.ndarray | None:
    """Return the angles in degrees between cameras as seen from the point nearest to all axes, (N, N) float64.

    Returns:
        None if the axes are about parallel, or the point lies behind most cameras.
    """
    centres, forward = poses[:, :3, 3], -poses[:, :3, 2]
    off = np.eye(3) - forward[:, :, None] * forward[:, None, :]
    total = off.sum(0)
    if len(poses) < 2 or np.linalg.cond(total) > 1e4:
        return None
    point = np.linalg.solve(total, np.einsum("nij,nj->i", off, centres))
    if ((point - centres) * forward).sum(1).mean() <= 0:
        return None
    towards = centres - point
    towards /= np.maximum(np.linalg.norm(towards, axis=1, keepdims=True), 1e-12)
    return np.degrees(np.arccos(np.clip(towards @ towards.T, -1, 1)))


def _nearest(distances: np.ndarray) -> np.ndarray:
    """Return for each camera the number of the nearest other one."""
    others = distances + np.diag(np.full(len(distances), np.inf))
    return others.argmin(1)


def _light_and_detail(dataset: Dataset, train: np.ndarray, shown: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return for each camera the mean log2 luma, and the fine detail relative to the coarse: (C,) float64, NaN if
    unknown.

    Fine detail is the root mean square difference between neighbouring pixels of a row, coarse that of pixels four
    apart: blur lowers their ratio, and the contrast of what is shown does not change it.
    """
    pictures, order = dataset.pictures, {int(dataset.pictures.camera[n]): k for k, n in enumerate(shown)}
    light: list[list[float]] = [[] for _ in shown]
    detail: list[list[float]] = [[] for _ in shown]
    by_time = train[np.lexsort((pictures.time[train], pictures.camera[train]))]
    for n in by_time[np.linspace(0, len(by_time) - 1, min(len(by_time), PICTURES)).round().astype(int)].tolist():
        tops = np.linspace(0, int(pictures.height[n]) - 1, ROWS).astype(int).tolist()
        rows = np.concatenate([dataset.pixels.picture(n, top, top + 1) for top in sorted(set(tops))]).astype(np.float32)
        opaque = rows[..., 3] > 0 if dataset.has_alpha else np.ones(rows.shape[:2], bool)
        grey = luma(rows)
        fine, coarse = ((grey[:, step:] - grey[:, :-step])[opaque[:, step:] & opaque[:, :-step]] for step in (1, 4))
        camera = order[int(pictures.camera[n])]
        if opaque.any():
            light[camera].append(float(np.log2(grey[opaque].mean() + 1)))
        if len(coarse) and (power := float((coarse**2).mean())) > 1:
            detail[camera].append(float(np.sqrt((fine**2).mean() / power)))
    return _medians(light), _medians(detail)


def _medians(values: list[list[float]]) -> np.ndarray:
    return np.array([np.median(own) if own else np.nan for own in values])
