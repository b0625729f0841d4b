"""Leaving out the texels that nothing reads."""

from dataclasses import replace
from itertools import pairwise

import numpy as np

from kpc.format.coding.quantise import QuantisedPlane, QuantisedScene, looked_up_cells, needed_texels
from kpc.format.container.segments import TransformSegments


def without_unread(scene: QuantisedScene, occupancy_before: np.ndarray) -> QuantisedScene:
    """Return a scene without the texels that no occupied cell reads; all other symbols stay as they are.

    Args:
        scene: whose occupancy has lost cells.
        occupancy_before: that with which its planes were encoded.
    """
    looked_up = looked_up_cells(scene.dequantise())

    def kept(plane: QuantisedPlane, name: str) -> QuantisedPlane:
        shape = plane.coded.shape
        needed = needed_texels(looked_up, name, *shape)
        if not (plane.coded & ~needed).any():
            return plane
        changed = replace(plane, symbols=plane.symbols * needed[..., None], coded=plane.coded & needed)
        if not isinstance(plane.side_info, TransformSegments):
            return changed
        implied = [needed_texels(occupancy, name, *shape) for occupancy in (occupancy_before, scene.occupancy)]
        return replace(changed, side_info=_recoded(plane, changed.coded, *implied))

    scales = tuple({name: kept(plane, name) for name, plane in scale.items()} for scale in scene.scales)
    return replace(scene, scales=scales)


def _recoded(
    plane: QuantisedPlane, coded: np.ndarray, implied_before: np.ndarray, implied: np.ndarray
) -> TransformSegments:
    """Return the segments of a plane under TRANSFORM with the same levels and another map; see `without_unread`."""
    from kpc.encoder.coding.transform import decode_levels, encode_blocks  # here, since they need numba

    assert isinstance(plane.side_info, TransformSegments)
    rows, columns, channels = plane.symbols.shape
    segments = {}
    for start, stop in pairwise([*(plane.starts or (0,)), rows]):
        if (body := plane.side_info.segments.get(start)) is not None:
            part = slice(start, stop)
            blocks = decode_levels(body, stop - start, columns, channels, implied_before[part])
            segments[start] = encode_blocks(blocks, coded[part], implied[part])
    return TransformSegments(segments)
