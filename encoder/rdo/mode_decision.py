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
from kpc.encoder.rdo.dct_rdo import in_blocks, step_in_blocks
from kpc.encoder.rdo.distortion import ALONE, Name, cost, worths
from kpc.encoder.rdo.trellis import THIN, on_trellis, step_on_trellis
from kpc.format.coding.quantise import QuantisedPlane, QuantisedScene, needed_texels, quantise_scene, reached_by
from kpc.format.container.segments import Told, encode_coded, guide_at, rows_of_segments
from kpc.format.scene.scene import TIME_PLANES, Scene

SIDES = 8, 16
"""Of blocks that are tried. Those of 4 never cost least (room, soldier)."""
SLOPE = 0.9
"""Squared steps that a bit is worth where planes are compared: what errors fall by, on the trellis and in blocks, when steps are made finer. (In
searches bits are worth less, `kpc.encoder.rdo.distortion.LAM`: what is coarse in one place is made up for in others.)"""
COHERENT = 1.15
"""What errors of blocks cost, of what `cost` says: they lack what is quick in all channels and planes alike, and pictures see the sum (soldier, room:
1.1 to 1.2)."""
FEW_BITS, MANY_BITS = 0.25, 1.5
"""A symbol, in blocks: with fewer the trellis, which then always costs more, is not tried; with more larger blocks are not."""


def quantise_by_cost(
    scene: Scene,
    steps: PerPlane,
    reached: np.ndarray | None = None,
    significant: PerPlane | None = None,
    only: Collection[Name] | None = None,
    together: PerPlane | None = None,
    thin: float = THIN,
    blocks: bool = True,
) -> QuantisedScene:
    """As `quantise_scene`, with symbols that cost least.

    Args:
        significant: what a squared error costs in each number, relative to others of its channel; (H, W, M), none negative. None: the same.
        only: the planes whose symbols are searched for; others are rounded. None: all.
        together: as of `kpc.encoder.rdo.curvature.Curvature`. None: channels know nothing of each other.
        thin: as of `kpc.encoder.rdo.trellis.on_trellis`. blocks: whether planes may be told in blocks.
    """
    reached = reached_by(scene) if reached is None else reached
    quantised = quantise_scene(scene, steps, reached=reached)
    matters = significant or [
        {name: np.ones(plane.shape, np.float32) for name, plane in scale.items()} for scale in scene.scales
    ]
    chosen = [(s, name) for s, scale in enumerate(scene.scales) for name in scale if only is None or (s, name) in only]

    def found(plane: Name) -> QuantisedPlane:
        s, name = plane
        values, beside = scene.scales[s][name], ALONE if together is None else together[s][name]
        asked = quantised.scales[s][name], values, steps[s][name], matters[s][name], name in TIME_PLANES, beside, thin
        if not blocks:
            return on_trellis(*asked)
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


def step_asked_for(plane: QuantisedPlane) -> np.ndarray:
    """(M,) float64: for which steps `quantise_by_cost` was asked when it made this plane, if it did and 8 bits were enough."""
    return step_in_blocks(plane) if isinstance(plane.guide, Told) else step_on_trellis(plane)


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
    those of which a file need not say so. Others as of `on_trellis`."""
    root = np.sqrt(worths(significant, plane.coded)) * needed[..., None]

    def in_all(candidate: QuantisedPlane, size_bytes: int) -> float:
        factor = COHERENT if isinstance(candidate.guide, Told) else 1
        return factor * cost(root * ((candidate.dequantise() - values) / step), together) + SLOPE * 8 * size_bytes

    tried = []
    for side in SIDES:
        found = [
            told
            for which in ((None, needed) if identity else (None,))
            if (told := in_blocks(plane, values, step, significant, identity, together, side, implied, which))
            is not None
        ]
        if not found:
            break
        tried += [(in_all(*told), told[0]) for told in found]
        bits = 8 * min(size for _, size in found) / (max(plane.coded.sum(), 1) * values.shape[2])
        if bits > MANY_BITS:
            break
    if not tried or bits > FEW_BITS:
        steered = on_trellis(plane, values, step, significant, identity, together, thin)
        if not tried:
            return steered
        tried.append((in_all(steered, _size(steered, identity, implied)), steered))
    return min(tried, key=lambda one: one[0])[1]


def _size(plane: QuantisedPlane, identity: bool, implied: np.ndarray) -> int:
    """Bytes of its segments."""
    rows = rows_of_segments(len(plane.symbols), identity)
    segments = [
        (slice(start, start + rows), guide_at(plane.guide, start)) for start in range(0, len(plane.symbols), rows)
    ]
    return sum(len(encode_coded(plane.symbols[own], plane.coded[own], guide, implied[own])) for own, guide in segments)
