"""Reasons to doubt a model in spite of small errors: patterns that repeat themselves, few points, impossible places."""

from collections import Counter
from collections.abc import Iterable, Sequence

import numpy as np

from kpc.encoder.datasets.capture import first_names
from kpc.encoder.poses.orientation import extent
from kpc.encoder.poses.structure import Structure
from kpc.format.common.text import spanned

# Views are compared by the features that agree with one geometry of two, if so many do.
MATCHED = 15
# A view is doubtful if less than this share of these agrees with where it was placed. Right ones have 0.74 or more
# (liam, whose walls repeat themselves in places; 0.98 in room and the default scene), wrong ones 0.1 to 0.6.
CONFIRMED = 0.65
# Views of which half see fewer points than these may be placed wrongly by some per cent. In the default scene, of
# 192x144 pixels, they see 26 to 52, and places are wrong by 1 to 3 % of the rig's extent, focal lengths by 5 %; in liam
# 313 to 956, in room 1,412 to 1,890.
FEW_POINTS = 100
# Cameras of a rig are at one place if they are nearer than this share of its extent.
ONE_PLACE = 0.005
# Degrees across the width of a picture beyond which a pinhole is doubtful: 9 mm on a full frame, the widest lens that
# is sold, have 127.
WIDEST_PINHOLE = 130.0
# A moving camera jumps if it moves so many times as far as is usual around that frame, and by this share of its path's
# extent; so many frames before and after are looked at.
JUMP, JUMP_EXTENT, AROUND = 12.0, 0.03, 15


def doubts(kind: str, names: Sequence[str], structure: Structure) -> list[str]:
    """Return what speaks against a model, in one clause each.

    Args:
        kind: what the footage was taken for, as in `find.Found`.
        names: of the views.
        structure: the model.
    """
    found = []
    if structure.is_lens_contradicted:
        are_fisheye = any(view.is_fisheye for view in structure.views.values())
        given, other = ("fisheye", "pinhole") if are_fisheye else ("pinhole", "fisheye")
        found.append(f"clearly more matches agree with a {other} than with a {given}; try again without --lens {given}")
    shares = {view: share for view, share in confirmed_shares(structure).items() if share < CONFIRMED}
    doubtful = [f"{names[view]} ({share:.0%})" for view, share in shares.items()]
    apart = [names[view] for view in structure.apart]
    if kind == "moving cameras":
        doubtful, apart = by_camera(names, shares), by_camera(names, structure.apart)
    if doubtful:
        found.append(
            f"matches of {first_names(doubtful)} contradict where these were placed: patterns that repeat themselves, "
            "such as tiles or windows, may have been mistaken for each other; film with something unlike beside them"
        )
    if apart:
        found.append(f"{first_names(apart)} fit each other but not the rest; film what connects them")
    wide = {view: angle for view, angle in _pinhole_angles(structure).items() if angle > WIDEST_PINHOLE}
    if wide:
        angle = max(wide.values())
        shown = by_camera(names, wide) if kind == "moving cameras" else [names[view] for view in wide]
        found.append(
            f"{first_names(shown)} would have a pinhole lens of {angle:.0f} degrees across, wider than any that is "
            "sold; if some lenses are fisheyes and others are not, place those of one kind alone, else try --lens "
            "fisheye"
        )
    points = sorted(view.points for view in structure.views.values())
    if points[len(points) // 2] < FEW_POINTS:
        found.append(
            f"views see few points ({spanned(str(points[0]), str(points[-1]))} each), so that places and focal lengths "
            "may be wrong by some per cent; film at a higher resolution, or with more texture"
        )
    if kind == "still rig":
        found += [f"{names[one]} and {names[two]} were placed at one point" for one, two in _at_one_place(structure)]
    if kind in ("moving camera", "moving cameras"):
        cameras = [_camera(name) if kind == "moving cameras" else "" for name in names]
        jumps = [f"{names[one]} and {names[two]}" for one, two in _jumps(cameras, structure)]
        if jumps:
            found.append(
                f"the path jumps between {first_names(jumps)}: the clip is cut there, or its frames were placed wrongly"
            )
    return found


def confirmed_shares(structure: Structure) -> dict[int, float]:
    """Return by view the share of its verified matches with other placed views that agrees with the model."""
    counts: dict[int, list[float]] = {}
    for views, pair in structure.pairs.items():
        if pair.confirmed is not None and pair.agreeing >= MATCHED:
            for view in views:
                total = counts.setdefault(view, [0.0, 0.0])
                total[0] += pair.agreeing * pair.confirmed
                total[1] += pair.agreeing
    return {view: agreeing / total for view, (agreeing, total) in sorted(counts.items())}


def _pinhole_angles(structure: Structure) -> dict[int, float]:
    """Return by view how many degrees across the width of its picture are; of those without a fisheye."""
    return {
        number: float(2 * np.degrees(np.arctan2(view.intrinsics[2], view.intrinsics[0])))
        for number, view in sorted(structure.views.items())
        if not view.is_fisheye
    }


def _at_one_place(structure: Structure) -> list[tuple[int, int]]:
    numbers = sorted(structure.views)
    poses = np.stack([structure.views[number].camera_to_world for number in numbers])
    centres, least = poses[:, :3, 3], ONE_PLACE * extent(poses)
    apart = np.linalg.norm(centres[:, None] - centres, axis=2)
    return [(numbers[i], numbers[j]) for i, j in np.argwhere(np.triu(apart < least, 1)).tolist()]


def by_camera(names: Sequence[str], views: Iterable[int]) -> list[str]:
    """Describe some of the views of several cameras that move, each camera once.

    Args:
        names: of all views, such as "cam00/000012"; that of a camera that stands still among them is its own.
        views: numbers of some.
    """
    counts, totals = Counter(_camera(names[view]) for view in views), Counter(map(_camera, names))
    said = []
    for camera, count in counts.items():
        share = f"all {count}" if count == totals[camera] else f"{count} of {totals[camera]}"
        said.append(camera if camera in names else f"{share} pictures of {camera}")
    return said


def _camera(name: str) -> str:
    """Return the name of a view's camera by that of the view."""
    return name.rpartition("/")[0] or name


def _jumps(cameras: Sequence[str], structure: Structure) -> list[tuple[int, int]]:
    """Return frames between which a camera moves much further than around them; `cameras` are those of all views."""
    paths: dict[str, list[int]] = {}
    for number in sorted(structure.views):
        paths.setdefault(cameras[number], []).append(number)
    size = extent(np.stack([view.camera_to_world for view in structure.views.values()]))
    found = []
    for numbers in paths.values():
        centres = np.stack([structure.views[number].camera_to_world[:3, 3] for number in numbers])
        steps = np.linalg.norm(np.diff(centres, axis=0), axis=1) / np.diff(numbers)
        for k in np.flatnonzero(steps > JUMP_EXTENT * size).tolist():
            around = np.delete(steps[max(k - AROUND, 0) : k + AROUND + 1], min(k, AROUND))
            if len(around) >= 4 and steps[k] > JUMP * float(np.median(around)):
                found.append((numbers[k], numbers[k + 1]))
    return found
