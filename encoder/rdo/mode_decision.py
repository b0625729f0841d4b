"""Mode decision: of each plane the symbols of least Lagrangian cost, on the trellis or in transform blocks.

Both modes (`kpc.encoder.rdo.trellis`, `kpc.encoder.rdo.dct_rdo`) are searched at steps where a bit costs the same
distortion, so that J = D + lambda R can be compared plane by plane. Time planes in transform blocks are tried with a
significance map and without one; without, all texels that are looked up are coded, and are the identity where all
levels are 0. What the modes gain: docs/design/rate-distortion.md, "Mode decision".
"""

import os
from collections.abc import Callable, Collection, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass

import numpy as np

from kpc.encoder.coding.segments import encode_segment, segment_bounds
from kpc.encoder.rdo.curvature import PerPlane
from kpc.encoder.rdo.dct_rdo import requested_transform_step, transform_quantise
from kpc.encoder.rdo.distortion import NO_CORRELATION, PlaneKey, distortion_weights, total_distortion
from kpc.encoder.rdo.trellis import LOW_RATE_BITS, requested_trellis_step, trellis_quantise
from kpc.format.coding.quantise import (
    QuantisedPlane,
    QuantisedScene,
    looked_up_cells,
    needed_texels,
    quantise_scene,
    with_planes,
)
from kpc.format.container.segments import TransformSegments, side_info_at
from kpc.format.scene.scene import TIME_PLANES, Scene

# Figures behind these constants: docs/design/rate-distortion.md, "Mode decision".
BLOCK_SIDES = 8, 16  # sides of transform blocks that are tried
# Lambda, in squared steps per bit, where modes are compared: how errors fall when the steps of either are made finer.
# The searches themselves use less (`kpc.encoder.rdo.distortion.LAM`), since errors in one plane are compensated in
# others.
DECISION_LAM = 0.9
# Factor on the distortion of transform blocks: they lack high frequencies in all channels and planes alike, and
# pictures show the sum of such errors.
TRANSFORM_ERROR_FACTOR = 1.15
# Bits per symbol in transform blocks: below FEW_BITS the trellis is not tried, above MANY_BITS larger blocks are not.
FEW_BITS, MANY_BITS = 0.25, 1.5


def quantise_by_cost(
    scene: Scene,
    steps: PerPlane,
    looked_up: np.ndarray | None = None,
    significant: PerPlane | None = None,
    only: Collection[PlaneKey] | None = None,
    correlation: PerPlane | None = None,
    low_rate_bits: float = LOW_RATE_BITS,
    block_sides: Sequence[int] = BLOCK_SIDES,
    stores_maps: bool = False,
    done: Callable[[], None] = lambda: None,
) -> QuantisedScene:
    """Quantise a scene as `quantise_scene` does, with symbols of least cost.

    Args:
        scene: to be quantised.
        steps: (M,) per plane.
        looked_up: `looked_up_cells` of the scene, if known.
        significant: (H, W, M) per plane, not negative: cost of a squared error in each value, relative to others of its
            channel. None for equal costs.
        only: planes whose symbols are searched for; others are rounded. None for all.
        correlation: as in `kpc.encoder.rdo.curvature.Curvature`. None for independent channels.
        low_rate_bits: as for `kpc.encoder.rdo.trellis.trellis_quantise`.
        block_sides: sides of transform blocks that are tried; none for the trellis alone.
        stores_maps: whether the planes are to store their texel maps, though the occupancy implies them.
        done: called after each plane.
    """
    looked_up = looked_up_cells(scene) if looked_up is None else looked_up
    quantised = quantise_scene(scene, steps, reached=looked_up)
    matters = significant or [
        {name: np.ones(plane.shape, np.float32) for name, plane in scale.items()} for scale in scene.scales
    ]
    chosen = [(s, name) for s, scale in enumerate(scene.scales) for name in scale if only is None or (s, name) in only]

    def search(key: PlaneKey) -> QuantisedPlane:
        s, name = key
        values = scene.scales[s][name]
        plane = Plane(
            quantised.scales[s][name],
            values,
            steps[s][name],
            matters[s][name],
            name in TIME_PLANES,
            NO_CORRELATION if correlation is None else correlation[s][name],
            low_rate_bits,
        )
        if not block_sides:
            return plane.on_trellis()
        needed = needed_texels(looked_up, name, *values.shape[:2])
        implied = None if stores_maps else needed
        if looked_up is not scene.occupancy and not stores_maps:
            implied = needed_texels(scene.occupancy, name, *values.shape[:2])
        return cheapest_mode(plane, implied, needed, block_sides)

    with ThreadPoolExecutor(os.cpu_count()) as pool:  # the searches release the GIL
        searched = {}
        for key, plane in zip(chosen, pool.map(search, chosen), strict=True):
            searched[key] = plane
            done()
    return with_planes(quantised, searched)


def requested_step(plane: QuantisedPlane) -> np.ndarray:
    """Return the steps, (M,) float64, that `quantise_by_cost` was given to make this plane, where 8 bits sufficed."""
    if isinstance(plane.side_info, TransformSegments):
        return requested_transform_step(plane)
    return requested_trellis_step(plane)


@dataclass(frozen=True)
class Plane:
    """A plane to be quantised; attributes as for `kpc.encoder.rdo.trellis.trellis_quantise`."""

    nearest: QuantisedPlane
    values: np.ndarray
    step: np.ndarray
    significant: np.ndarray
    identity: bool
    correlation: np.ndarray
    low_rate_bits: float

    def on_trellis(self) -> QuantisedPlane:
        return trellis_quantise(
            self.nearest,
            self.values,
            self.step,
            self.significant,
            self.identity,
            self.correlation,
            self.low_rate_bits,
        )

    def in_blocks(
        self, side: int, implied: np.ndarray | None, needed: np.ndarray | None
    ) -> tuple[QuantisedPlane, int] | None:
        return transform_quantise(
            self.nearest,
            self.values,
            self.step,
            self.significant,
            self.identity,
            self.correlation,
            side,
            implied,
            needed,
        )


def cheapest_mode(
    plane: Plane, implied: np.ndarray | None, needed: np.ndarray, block_sides: Sequence[int] = BLOCK_SIDES
) -> QuantisedPlane:
    """Return the plane in the mode of least cost.

    Args:
        plane: to be quantised.
        implied: (H, W) bool, texels that the file's occupancy implies to be coded; None to store them.
        needed: (H, W) bool, texels that are looked up.
        block_sides: sides of transform blocks that are tried, at least one.
    """
    root = np.sqrt(distortion_weights(plane.significant, plane.nearest.coded)) * needed[..., None]

    def cost(candidate: QuantisedPlane, size_bytes: int) -> float:
        factor = TRANSFORM_ERROR_FACTOR if isinstance(candidate.side_info, TransformSegments) else 1
        errors = root * ((candidate.dequantise() - plane.values) / plane.step)
        return factor * total_distortion(errors, plane.correlation) + DECISION_LAM * 8 * size_bytes

    tried = []
    for side in block_sides:
        maps = (None, needed) if plane.identity else (None,)
        found = [one for coded in maps if (one := plane.in_blocks(side, implied, coded)) is not None]
        if not found:
            break
        tried += [(cost(candidate, size), candidate) for candidate, size in found]
        bits = 8 * min(size for _, size in found) / (max(plane.nearest.coded.sum(), 1) * plane.values.shape[2])
        if bits > MANY_BITS:
            break
    if not tried or bits > FEW_BITS:
        on_trellis = plane.on_trellis()
        if not tried:
            return on_trellis
        tried.append((cost(on_trellis, coded_size(on_trellis, plane.identity, implied)), on_trellis))
    return min(tried, key=lambda one: one[0])[1]


def coded_size(plane: QuantisedPlane, identity: bool, implied: np.ndarray | None) -> int:
    """Return the size of a plane's segments in bytes."""
    segments = [
        (slice(start, stop), side_info_at(plane.side_info, start)) for start, stop in segment_bounds(plane, identity)
    ]
    return sum(
        len(encode_segment(plane.symbols[own], plane.coded[own], side_info, None if implied is None else implied[own]))
        for own, side_info in segments
    )
