"""Leaving out the texels that nothing reads."""

from collections.abc import Mapping
from dataclasses import replace
from itertools import pairwise

import numpy as np

from kpc.format.coding.quantise import QuantisedPlane, QuantisedScene, looked_up_cells, needed_texels
from kpc.format.container.segments import TransformSegments

# (rows, columns) bool by scale and plane: the texels that any group reads of a plane that groups share.
SharedTexels = Mapping[tuple[int, str], np.ndarray]


def without_unread(
    scene: QuantisedScene, occupancy_before: np.ndarray, shared: SharedTexels | None = None
) -> QuantisedScene:
    """Return a scene without the texels that no occupied cell reads; all other symbols stay as they are.

    Args:
        scene: whose occupancy has lost cells.
        occupancy_before: that with which its planes were encoded.
        shared: of planes that other groups of a clip share with it, which must come out the same for all of them, so
            that their maps are stored.
    """
    looked_up = looked_up_cells(scene.dequantise())

    def kept(s: int, name: str, plane: QuantisedPlane) -> QuantisedPlane:
        shape, together = plane.coded.shape, (shared or {}).get((s, name))
        needed = needed_texels(looked_up, name, *shape) if together is None else together
        if not (plane.coded & ~needed).any() and (together is None or plane.stores_map):
            return plane
        changed = replace(plane, symbols=plane.symbols * needed[..., None], coded=plane.coded & needed)
        changed = replace(changed, stores_map=plane.stores_map or together is not None)
        if not isinstance(plane.side_info, TransformSegments):
            return changed
        implied_before, implied = (
            needed_texels(occupancy, name, *shape) for occupancy in (occupancy_before, scene.occupancy)
        )
        blocks = _recoded(plane, changed.coded, implied_before, None if changed.stores_map else implied)
        return replace(changed, side_info=blocks)

    scales = tuple(
        {name: kept(s, name, plane) for name, plane in scale.items()} for s, scale in enumerate(scene.scales)
    )
    return replace(scene, scales=scales)


def _recoded(
    plane: QuantisedPlane, coded: np.ndarray, implied_before: np.ndarray, implied: np.ndarray | None
) -> TransformSegments:
    """Return the segments of a plane under TRANSFORM with the same levels and another map; see `without_unread`.

    Args:
        implied: the map that the occupancy implies; None to store the map in any case.
    """
    from kpc.encoder.coding.transform import decode_levels, encode_blocks  # here, since they need numba

    assert isinstance(plane.side_info, TransformSegments)
    rows, columns, channels = plane.symbols.shape
    segments = {}
    for start, stop in pairwise([*(plane.starts or (0,)), rows]):
        if (body := plane.side_info.segments.get(start)) is not None:
            part = slice(start, stop)
            blocks = decode_levels(body, stop - start, columns, channels, implied_before[part])
            segments[start] = encode_blocks(blocks, coded[part], None if implied is None else implied[part])
    return TransformSegments(segments)
