"""Views that a model holds without reason, such as those of a camera that filmed another scene."""

from dataclasses import replace

import numpy as np

from kpc.encoder.poses.doubts import CONFIRMED, confirmed_shares
from kpc.encoder.poses.structure import PlacedView, Structure

# A view that sees fewer points than these is not placed, whatever else is true of it. Right ones see 26 or more (the
# default scene, of 192x144 pixels); a camera of another scene among five of room was given places by 0 to 21 points.
LEAST_POINTS = 15
# A view of a still rig that sees less than this share of the usual number of points is not placed either. Right ones
# see 0.3 or more of it in all measured scenes. Blurred pictures of a moving camera may be placed rightly by so few;
# they go only if their matches do not confirm them, or if their lens is impossible.
LEAST_SHARE = 1 / 20
# A focal length is impossible if it is more than so many times the distance of the picture's centre from its edge.
LONGEST_LENS = 20.0


def without_false_views(structure: Structure, *, is_rig: bool = False) -> Structure:
    """Return the model without views that see next to nothing of it; these are named in `Structure.dropped`.

    Points that only one other view saw go with them. As others then see fewer points, it is looked again until nothing
    changes.

    Args:
        structure: the model.
        is_rig: whether it is of a still rig. A false view may have a lens of its own there, and fit its own few matches
            by that: these then confirm nothing.
    """
    while false := _false_views(structure, is_rig):
        structure = _without(structure, false)
    return structure


def _false_views(structure: Structure, is_rig: bool) -> set[int]:
    if not structure.views:
        return set()
    usual = float(np.median([view.points for view in structure.views.values()]))
    shares = confirmed_shares(structure)
    few = {
        number
        for number, view in structure.views.items()
        if view.points < LEAST_SHARE * usual and (is_rig or shares.get(number, 0.0) < CONFIRMED or _is_impossible(view))
    }
    return few | {number for number, view in structure.views.items() if view.points < LEAST_POINTS}


def _is_impossible(view: PlacedView) -> bool:
    return max(view.intrinsics[:2]) > LONGEST_LENS * max(view.intrinsics[2:])


def _without(structure: Structure, false: set[int]) -> Structure:
    seen = structure.observations[~np.isin(structure.observations[:, 1], sorted(false))]
    counts = np.bincount(seen[:, 0].astype(int), minlength=len(structure.points))
    kept = counts >= 2
    seen = seen[kept[seen[:, 0].astype(int)]]
    seen[:, 0] = (np.cumsum(kept) - 1)[seen[:, 0].astype(int)]
    views = {
        number: replace(view, points=int((seen[:, 1] == number).sum()))
        for number, view in structure.views.items()
        if number not in false
    }
    pairs = {
        both: pair if false.isdisjoint(both) else pair._replace(confirmed=None)
        for both, pair in structure.pairs.items()
    }
    dropped = tuple(sorted({*structure.dropped, *false}))
    return replace(
        structure, views=views, points=structure.points[kept], observations=seen, pairs=pairs, dropped=dropped
    )
