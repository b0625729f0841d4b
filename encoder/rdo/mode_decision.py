"""Symbols of a scene: of each plane those that cost least, on the trellis (`kpc.encoder.rdo.trellis`) or in blocks (`kpc.encoder.rdo.dct_rdo`).

Both know at which steps bits are worth as much. So what errors cost, plus what bits are worth, is compared plane by plane.

All planes, at equal error of pictures, beside the trellis alone: soldier takes 17 % fewer bytes at 38 dB of agreement with the uncoded pictures and 28 %
at 34; shelf_hand 4 % at 40 and 18 % at 35; the default scene 4 % at 35 to 40 and 13 % at 30; room and liam hardly any. Nothing at 44 dB.

Blocks of a time plane are tried with a map of what is told and without one. Without, all that is needed is told, and is identity where all levels are 0;
what is near to 1 is then told by few levels and not taken for 1: shelf_hand takes 11 % fewer bytes at 33 dB, room as many.
"""

import os
from collections.abc import Collection
from concurrent.futures import ThreadPoolExecutor
from dataclasses import replace

import numpy as np
from kpc.encoder.rdo.curvature import PerPlane
from kpc.encoder.rdo.dct_rdo import requested_transform_step, transform_quantise
from kpc.encoder.rdo.distortion import NO_CORRELATION, PlaneKey, distortion_weights, total_distortion
from kpc.encoder.rdo.trellis import LOW_RATE_BITS, requested_trellis_step, trellis_quantise
from kpc.format.coding.quantise import QuantisedPlane, QuantisedScene, looked_up_cells, needed_texels, quantise_scene
from kpc.format.container.segments import TransformSegments, encode_segment, rows_per_segment, side_info_at
from kpc.format.scene.scene import TIME_PLANES, Scene

BLOCK_SIDES = 8, 16
"""Of blocks that are tried. Those of 4 never cost least (room, soldier)."""
DECISION_LAM = 0.9
"""Squared steps that a bit is worth where planes are compared: what errors fall by, on the trellis and in blocks, when steps are made finer. (In
searches bits are worth less, `kpc.encoder.rdo.distortion.LAM`: what is coarse in one place is made up for in others.)"""
TRANSFORM_ERROR_FACTOR = 1.15
"""What errors of blocks cost, of what `total_distortion` says: they lack what is quick in all channels and planes alike, and pictures see the sum (soldier, room:
1.1 to 1.2)."""
FEW_BITS, MANY_BITS = 0.25, 1.5
"""A symbol, in blocks: with fewer the trellis, which then always costs more, is not tried; with more larger blocks are not."""


def quantise_by_cost(
    scene: Scene,
    steps: PerPlane,
    reached: np.ndarray | None = None,
    significant: PerPlane | None = None,
    only: Collection[PlaneKey] | None = None,
    together: PerPlane | None = None,
    thin: float = LOW_RATE_BITS,
    blocks: bool = True,
) -> QuantisedScene:
    """As `quantise_scene`, with symbols that cost least.

    Args:
        significant: what a squared error costs in each number, relative to others of its channel; (H, W, M), none negative. None: the same.
        only: the planes whose symbols are searched for; others are rounded. None: all.
        together: as of `kpc.encoder.rdo.curvature.Curvature`. None: channels know nothing of each other.
        thin: as of `kpc.encoder.rdo.trellis.trellis_quantise`. blocks: whether planes may be told in blocks.
    """
    reached = looked_up_cells(scene) if reached is None else reached
    quantised = quantise_scene(scene, steps, reached=reached)
    matters = significant or [
        {name: np.ones(plane.shape, np.float32) for name, plane in scale.items()} for scale in scene.scales
    ]
    chosen = [(s, name) for s, scale in enumerate(scene.scales) for name in scale if only is None or (s, name) in only]

    def found(plane: PlaneKey) -> QuantisedPlane:
        s, name = plane
        values, beside = scene.scales[s][name], NO_CORRELATION if together is None else together[s][name]
        asked = quantised.scales[s][name], values, steps[s][name], matters[s][name], name in TIME_PLANES, beside, thin
        if not blocks:
            return trellis_quantise(*asked)
        needed = needed_texels(reached, name, *values.shape[:2])
        implied = needed if reached is scene.occupancy else needed_texels(scene.occupancy, name, *values.shape[:2])
        return _cheapest(*asked, implied, needed)

    with ThreadPoolExecutor(os.cpu_count()) as pool:  # the searches hold no lock
        searched = dict(zip(chosen, pool.map(found, chosen), strict=True))
    scales = tuple(
        {name: searched.get((s, name), plane) for name, plane in scale.items()}
        for s, scale in enumerate(quantised.scales)
    )
    return replace(quantised, scales=scales)


def requested_step(plane: QuantisedPlane) -> np.ndarray:
    """(M,) float64: for which steps `quantise_by_cost` was asked when it made this plane, if it did and 8 bits were enough."""
    return (
        requested_transform_step(plane)
        if isinstance(plane.side_info, TransformSegments)
        else requested_trellis_step(plane)
    )


def _cheapest(
    plane: QuantisedPlane,
    values: np.ndarray,
    step: np.ndarray,
    significant: np.ndarray,
    identity: bool,
    together: np.ndarray,
    thin: float,
    implied: np.ndarray,
    needed: np.ndarray,
) -> QuantisedPlane:
    """The plane that is quantised to the nearest, with the symbols that cost least. `needed`: texels that anything occupied looks up; `implied`:
    those of which a file need not say so. Others as of `trellis_quantise`."""
    root = np.sqrt(distortion_weights(significant, plane.coded)) * needed[..., None]

    def in_all(candidate: QuantisedPlane, size_bytes: int) -> float:
        factor = TRANSFORM_ERROR_FACTOR if isinstance(candidate.side_info, TransformSegments) else 1
        return (
            factor * total_distortion(root * ((candidate.dequantise() - values) / step), together)
            + DECISION_LAM * 8 * size_bytes
        )

    tried = []
    for side in BLOCK_SIDES:
        found = [
            told
            for which in ((None, needed) if identity else (None,))
            if (told := transform_quantise(plane, values, step, significant, identity, together, side, implied, which))
            is not None
        ]
        if not found:
            break
        tried += [(in_all(*told), told[0]) for told in found]
        bits = 8 * min(size for _, size in found) / (max(plane.coded.sum(), 1) * values.shape[2])
        if bits > MANY_BITS:
            break
    if not tried or bits > FEW_BITS:
        steered = trellis_quantise(plane, values, step, significant, identity, together, thin)
        if not tried:
            return steered
        tried.append((in_all(steered, _size(steered, identity, implied)), steered))
    return min(tried, key=lambda one: one[0])[1]


def _size(plane: QuantisedPlane, identity: bool, implied: np.ndarray) -> int:
    """Bytes of its segments."""
    rows = rows_per_segment(len(plane.symbols), identity)
    segments = [
        (slice(start, start + rows), side_info_at(plane.side_info, start))
        for start in range(0, len(plane.symbols), rows)
    ]
    return sum(
        len(encode_segment(plane.symbols[own], plane.coded[own], side_info, implied[own]))
        for own, side_info in segments
    )
