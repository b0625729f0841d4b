"""From bare footage to cameras and clocks: what `kpposes` does, and `kpenc` for a folder without poses."""

import re
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

from kpc.encoder.datasets.capture import first_names
from kpc.encoder.datasets.left_out import left_out_clause
from kpc.encoder.poses.clocks import UNKNOWN, Clock
from kpc.encoder.poses.doubts import MATCHED, by_camera, doubts
from kpc.encoder.poses.false_views import without_false_views
from kpc.encoder.poses.footage import Footage, find_footage, frame_size, left_out
from kpc.encoder.poses.given_clocks import read_clocks
from kpc.encoder.poses.gravity import LEAST_TAGS, agreed_up, tagged_up
from kpc.encoder.poses.instants import Picture, grey_of, moving_pictures, still_pictures
from kpc.encoder.poses.orientation import extent, up_direction
from kpc.encoder.poses.structure import (
    ALL,
    MANY,
    Pairing,
    PlacedView,
    Structure,
    check_installed,
    oriented,
    reconstruct,
)
from kpc.encoder.poses.survey import Survey, frame_count, survey
from kpc.encoder.poses.sync import SURE, clocks_by_motion, clocks_by_sound, wants_motion
from kpc.encoder.poses.takes import Take, frame_names, pairing_of, pictures_of, take_of
from kpc.encoder.poses.wishes import Wishes
from kpc.format.common.errors import DatasetError
from kpc.format.common.images import image_info, read_image
from kpc.format.common.progress import progress
from kpc.format.common.text import agreeing, counted, notice, spanned

# Attempts at a still rig: features in each picture, and instants at which what moves is matched.
ATTEMPTS = ((4096, 4), (8192, 10))
# Features in each picture of a moving camera or a collection of more than MANY.
FEATURES_OF_MANY = 2048
# Features in each picture of a moving camera of more than LONG, which sees each point in many of them.
LONG, FEATURES_OF_LONG = 200, 1024
# Photographs are matched with those that look alike, and with the next ones, which mostly were taken there, too.
PHOTOGRAPHS = Pairing((1, 2), alike=20)
# What to do where clocks are unknown.
CLAP = "film a clap that all cameras see and hear, or give their offsets with --sync offsets.json"
# Where gravity and the horizons of the cameras differ by more, that is said.
CONTRADICTING_DEGREES = 60.0
# A scene cannot be made from fewer cameras.
LEAST_CAMERAS = 3


@dataclass(frozen=True)
class Found:
    """What was found.

    Attributes:
        kind: what the footage was taken for: "still rig", "moving camera", "moving cameras" or "photographs".
        footage: of each camera; of each photograph in a collection.
        clocks: of each camera.
        view_names: of the views: cameras, or pictures of moving ones.
        structure: z up; the rig's extent is 1 unless `is_metric`.
        is_metric: whether the unit is the metre.
        motion: of each camera of a still rig, how much moves before each frame.
        take: of one or several cameras that move, which views are theirs; None for others.
    """

    kind: str
    footage: tuple[Footage, ...]
    clocks: tuple[Clock, ...]
    view_names: tuple[str, ...]
    structure: Structure
    is_metric: bool
    motion: tuple[np.ndarray, ...] = ()
    take: Take | None = None

    @property
    def writes_frames(self) -> bool:
        """Whether frames are written as images beside the document: those of the videos of cameras that move."""
        return self.take is not None and self.footage[0].video is not None


def find_poses(root: Path, wishes: Wishes) -> Found:
    """Find cameras and clocks of the footage in a folder; say in one line what it is taken for.

    Raises:
        DatasetError: the footage cannot be used, COLMAP is not installed, or fewer than LEAST_CAMERAS views could be
            placed.
        MediaError: a file cannot be read.
    """
    footage = find_footage(root)
    check_installed()
    if unused := left_out(root, footage):
        used = "videos" if footage[0].video else "images"
        notice(f"{root}: {counted(len(unused), 'file')} beside the {used} {left_out_clause(unused)}")
    counts = [frame_count(one) for one in footage]
    if max(counts) == 1 and footage[0].video is not None:
        raise DatasetError(f"{root}: its videos have one frame each; give whole videos, or photographs as images")
    if max(counts) == 1 and wishes.rig == "moving":
        footage = (Footage(root.name, tuple(file for one in footage for file in one.files), None),)
        counts = [len(counts)]
    _check_distance(root, footage, wishes)
    if max(counts) == 1:
        frames = "; --rig moving for the frames of a clip" if _is_numbered(footage) else ""
        notice(f"{root}: taken for photographs of one scene ({counted(len(footage), 'image')}{frames})")
        found = _find_photographs(root, footage, wishes.lens)
    else:
        sync = read_clocks(wishes.sync, [one.name for one in footage]) if isinstance(wishes.sync, Path) else wishes.sync
        looked = [] if wishes.rig == "moving" else footage
        surveys = [survey(one) for one in progress(looked, "looking at what moves", unit="camera")]
        is_still = all(seen.is_still for seen in surveys) if wishes.rig == "auto" else wishes.rig == "still"
        notice(f"{root}: {_what(footage, surveys, is_still, wishes.rig)}")
        if is_still:
            found = _find_still_rig(root, footage, surveys, sync, wishes.lens)
        else:
            found = _find_moving_cameras(root, footage, surveys, sync, wishes)
    _check(root, found, wishes.require_all)
    for doubt in doubts(found.kind, found.view_names, found.structure):
        notice(f"{root}: warning: {doubt}")
    return _scaled(root, found, wishes)


def _is_numbered(footage: Sequence[Footage]) -> bool:
    """Return whether images are numbered without gaps."""
    numbers = [int(found[0]) for one in footage if (found := re.search(r"\d+(?=\D*$)", one.name))]
    return len(numbers) == len(footage) == 1 + numbers[-1] - numbers[0]


def _what(footage: Sequence[Footage], surveys: Sequence[Survey], is_still: bool, rig: str) -> str:
    shares = sorted(seen.still_share for seen in surveys if np.isfinite(seen.still_share))
    why = "as --rig says"
    if rig == "auto":
        why = "pictures have no texture"
        if shares:
            why = f"{spanned(f'{shares[0]:.0%}', f'{shares[-1]:.0%}')} of a picture's texture stays"
    if is_still:
        stand = agreeing(len(footage), "stands", "stand")
        return f"taken for a rig of {counted(len(footage), 'camera')} that {stand} still ({why})"
    if len(footage) == 1:
        return f"taken for a camera that moves ({why})"
    still = [one.name for one, seen in zip(footage, surveys, strict=False) if seen.is_still]
    beside = ""
    if still:
        beside = f" and {len(still)} that {agreeing(len(still), 'stands', 'stand')} still, {first_names(still)}"
        why += "; --rig still if all do, --rig moving if none does"
    move = len(footage) - len(still)
    return f"taken for {counted(move, 'camera')} that {agreeing(move, 'moves', 'move')}{beside} ({why})"


def _check_distance(root: Path, footage: Sequence[Footage], wishes: Wishes) -> None:
    """Refuse a distance between views that are not there, as far as is known before videos are read."""
    if wishes.distance is None:
        return
    names = [one.name for one in footage] if len(footage) > 1 else []
    if not names or (wishes.rig != "still" and max(frame_count(one) for one in footage) > 1):
        for one in footage:
            names += frame_names(one.name if len(footage) > 1 else "", range(frame_count(one)))
    _check_view_names(root, wishes, names)


def _check_view_names(root: Path, wishes: Wishes, names: Sequence[str]) -> None:
    if wishes.distance is None:
        return
    unknown = [name for name in wishes.distance[:2] if name not in names]
    if unknown:
        is_or_are = agreeing(len(unknown), "is not there", "are not there")
        raise DatasetError(f"{root}: --distance: {', '.join(unknown)} {is_or_are}; there are {first_names(names)}")


def _find_still_rig(
    root: Path, footage: tuple[Footage, ...], surveys: list[Survey], sync: str | list[Clock], lens: str
) -> Found:
    """Place cameras that stand still; their clocks are given, or found as --sync says."""
    if len(footage) < LEAST_CAMERAS:
        raise DatasetError(
            f"{root}: {counted(len(footage), 'camera')} that {agreeing(len(footage), 'stands', 'stand')} still: depth "
            f"needs {LEAST_CAMERAS} or more; film with more cameras, or walk around with one"
        )
    names = [one.name for one in footage]
    # Views of one size may differ in their lenses.
    ways = (_lenses([seen.median.shape for seen in surveys]), list(range(len(footage))))

    def place(pictures: Sequence[Picture], features: int) -> Structure:
        def without_false(pairing: Pairing) -> Structure:
            return without_false_views(
                reconstruct(pictures, names, ways[0], features, pairing, ways, lens), is_rig=True
            )

        return _undisturbed(without_false)

    still: Structure | None = None
    if isinstance(sync, str):
        clocks = clocks_by_sound(footage, sync)
        if wants_motion(footage, clocks, sync):
            still = place(list(still_pictures(surveys)), ATTEMPTS[0][0])
            clocks = clocks_by_motion(footage, surveys, clocks, still.views)
        _warn_of_clocks(root, names, clocks)
        _warn_if_none_found(root, footage, clocks, sync)
    else:
        clocks = sync
    best, count = Structure({}, np.zeros((0, 3)), np.zeros((0, 4)), {}), len(footage)
    for number, (features, instants) in enumerate(ATTEMPTS):
        if number > 0:
            notice(f"{root}: {len(best.views)} of {count} cameras placed; trying again with more features")
        pictures = [*still_pictures(surveys), *moving_pictures(footage, surveys, clocks, instants)]
        pictures.sort(key=lambda picture: picture.view)
        best = max(best, place(pictures, features), key=_rank)
        if len(best.views) == count:
            break
    if still is not None and len(still.views) > len(best.views):
        best = still
    _warn_if_nothing_in_common(root, [(footage[view], clocks[view]) for view in sorted(best.views)])
    motion = tuple(seen.motion for seen in surveys)
    return Found("still rig", footage, tuple(clocks), tuple(names), best, False, motion)


def _rank(structure: Structure) -> tuple[int, float]:
    """Return by what one of several models of the same cameras is chosen: the largest."""
    return len(structure.views), -structure.error


def _undisturbed(place: Callable[[Pairing], Structure]) -> Structure:
    """Place the views; do so once more without those that were dropped, which may have disturbed the others."""
    first = place(ALL)
    if not first.dropped or len(first.views) < LEAST_CAMERAS:
        return first
    again = place(replace(ALL, without=first.dropped))
    if len(again.views) < len(first.views):
        return first
    dropped = tuple(sorted({*first.dropped, *again.dropped}))
    return replace(again, pairs=first.pairs | again.pairs, dropped=dropped)


def _warn_of_clocks(root: Path, names: Sequence[str], clocks: Sequence[Clock], *, are_moving: bool = False) -> None:
    """Name the cameras whose clocks could not be found, if others' could or cameras move, and those that are unsure."""
    unknown = [name for name, clock in zip(names, clocks, strict=True) if clock.method == "none"]
    why = " by sound, and what moves says nothing of them while cameras move; they" if are_moving else " and"
    if unknown and (are_moving or len(unknown) < len(names)):
        notice(
            f"{root}: warning: the clocks of {first_names(unknown)} could not be found{why} are left as they are; "
            f"{CLAP}"
        )
    unsure = [
        f"{name} ({clock.confidence:.0%})"
        for name, clock in zip(names, clocks, strict=True)
        if clock.method == "motion" and clock.confidence < SURE
    ]
    if unsure:
        notice(f"{root}: warning: the clocks of {first_names(unsure)} are unsure; {CLAP}")


def _warn_if_none_found(root: Path, footage: Sequence[Footage], clocks: Sequence[Clock], sync: str) -> None:
    """Say so if no clock of a still rig could be found; folders of frames are in step unless a way is asked for."""
    ways = {"auto": "sound or what moves", "audio": "sound", "motion": "what moves"}
    if sync not in ways or (sync == "auto" and footage[0].video is None):
        return
    if all(clock.method == "none" for clock in clocks):
        instead = "" if sync == "auto" else f"drop --sync {sync}, "
        notice(
            f"{root}: warning: no clocks could be found by {ways[sync]}, and all are left as they are; {instead}{CLAP}"
        )


def _warn_if_nothing_in_common(root: Path, cameras: Sequence[tuple[Footage, Clock]]) -> None:
    """Say so if videos have no time in common by their clocks: no scene can be made from them together."""
    spans = [
        (one.name, *(clock.offset_s + clock.rate * one.video.times[[0, -1]]))
        for one, clock in cameras
        if one.video is not None
    ]
    if not spans:
        return
    early, late = min(spans, key=lambda span: span[2]), max(spans, key=lambda span: span[1])
    if early[2] < late[1]:
        notice(
            f"{root}: warning: videos have no time in common, and kpenc will refuse them: {early[0]} ends at "
            f"{early[2]:.6g} s, {late[0]} starts at {late[1]:.6g} s; correct their clocks with --sync offsets.json, "
            "or remove those that filmed at another time"
        )


def _find_moving_cameras(
    root: Path, footage: tuple[Footage, ...], surveys: Sequence[Survey], sync: str | list[Clock], wishes: Wishes
) -> Found:
    """Place each frame of one or several cameras that move; their clocks are given, or found by sound.

    Args:
        root: the folder, for messages.
        footage: of each camera.
        surveys: of each, where some may stand still; else none.
        sync: one of `wishes.SYNC_MODES`, or the clocks.
        wishes: for the names of views, and the lens.
    """
    names, are_videos = [one.name for one in footage], footage[0].video is not None
    if single := next((one.files[0].name for one in footage if frame_count(one) == 1), None):
        raise DatasetError(
            f"{root}: {single} has one frame, beside cameras that move; remove it, or give a whole video"
        )
    if sync == "motion" and len(footage) > 1:
        raise DatasetError(
            f"{root}: --sync motion: what moves in pictures says nothing of clocks while cameras move; {CLAP}"
        )
    clocks = clocks_by_sound(footage, sync) if isinstance(sync, str) else sync
    if sync in ("auto", "audio") and are_videos and len(footage) > 1:
        _warn_of_clocks(root, names, clocks, are_moving=True)
        known = [clock.method != "none" for clock in clocks]
    else:
        known = [True] * len(footage)
    take = take_of(root, footage, clocks, [seen.is_still for seen in surveys] or [False] * len(footage))
    _check_view_names(root, wishes, take.names)
    count = len(take.names)
    features = FEATURES_OF_LONG if count > LONG else FEATURES_OF_MANY if count > MANY else ATTEMPTS[0][0]
    by_size = _lenses([frame_size(one) for one in footage])
    structure = without_false_views(
        reconstruct(
            pictures_of(footage, surveys, take),
            take.names,
            take.cameras,
            features,
            pairing_of(take, known),
            ([by_size[camera] for camera in take.cameras], take.cameras) if len(footage) > 1 else (),
            wishes.lens,
        )
    )
    kind = "moving cameras" if len(footage) > 1 else "moving camera"
    return Found(kind, footage, tuple(clocks), take.names, structure, False, take=take)


def _find_photographs(root: Path, footage: tuple[Footage, ...], lens: str) -> Found:
    def pictures() -> Iterator[Picture]:
        for number, one in enumerate(footage):
            yield Picture(number, 0, grey_of(read_image(one.files[0], upright=True)), None)

    sizes = [image_info(one.files[0]).displayed_size for one in footage]
    features = FEATURES_OF_MANY if len(footage) > MANY else ATTEMPTS[0][0]
    names = [one.name for one in footage]
    structure = without_false_views(reconstruct(pictures(), names, _lenses(sizes), features, PHOTOGRAPHS, (), lens))
    clocks = (UNKNOWN,) * len(footage)
    return Found("photographs", footage, clocks, tuple(names), structure, False)


def _lenses(sizes: Sequence[tuple[int, ...]]) -> list[int]:
    """Return the number of each view's lens, to begin with: views of one size share it."""
    distinct = list(dict.fromkeys(sizes))
    return [distinct.index(size) for size in sizes]


def _check(root: Path, found: Found, require_all: bool) -> None:
    """Name the views that could not be placed, and refuse if too few were."""
    names, structure = found.view_names, found.structure
    missing = [number for number in range(len(names)) if number not in structure.views]
    if not missing:
        return
    said = by_camera(names, missing) if found.kind == "moving cameras" else _with_neighbours(found, missing)
    noun = "cameras" if found.kind == "still rig" else "pictures"
    placed = f"{len(structure.views)} of {len(names)} {noun} could be placed"
    advice = "film with more overlap, more texture and sharper pictures"
    if len(structure.views) < LEAST_CAMERAS:
        raise DatasetError(f"{root}: {placed}, too few: {first_names(said)}; {advice}")
    if require_all:
        raise DatasetError(f"{root}: {placed}; left out: {first_names(said)}; {advice}, or drop --require-all")
    notice(f"{root}: {placed}; left out: {first_names(said)}")


def _with_neighbours(found: Found, missing: Sequence[int]) -> list[str]:
    """Return the names of views that could not be placed, each with those that it matches."""
    said = []
    for number in missing:
        near = [found.view_names[n] for n in _neighbours(found.structure, number)]
        why = f"matches only {first_names(near)}" if near else "matches none"
        if number in found.structure.dropped:
            why += ", and fits these by too few points"
        said.append(f"{found.view_names[number]} ({why})")
    return said


def _neighbours(structure: Structure, number: int) -> list[int]:
    agreeing = {
        (two if one == number else one): pair.agreeing
        for (one, two), pair in structure.pairs.items()
        if number in (one, two) and pair.agreeing >= MATCHED
    }
    return sorted(agreeing, key=lambda other: -agreeing[other])


def _scaled(root: Path, found: Found, wishes: Wishes) -> Found:
    views = found.structure.views
    size = extent(np.stack([view.camera_to_world for view in views.values()]))
    if size <= 0:
        raise DatasetError(f"{root}: all cameras were found at one place; move the camera while filming")
    scale, is_metric = 1 / size, wishes.distance is not None
    if wishes.distance is not None:
        one, two, metres = wishes.distance
        numbers = [found.view_names.index(name) if name in found.view_names else -1 for name in (one, two)]
        if any(number not in views for number in numbers):
            raise DatasetError(f"{root}: --distance {one},{two}: both must be cameras that were placed")
        first, second = (views[number].camera_to_world[:3, 3] for number in numbers)
        scale = metres / max(float(np.linalg.norm(first - second)), 1e-12)
    structure = oriented(found.structure, _up(root, found), scale)
    return replace(found, structure=structure, is_metric=is_metric)


def _up(root: Path, found: Found) -> np.ndarray:
    """Return what is up, (3,), by the gravity tags of placed images, else by the cameras; say by which in one line."""
    views, files = found.structure.views, _images(found)
    votes = [
        view.camera_to_world[:3, :3] @ up
        for number, view in views.items()
        if number in files and (up := tagged_up(files[number])) is not None
    ]
    agreed = agreed_up(np.array(votes).reshape(-1, 3))
    by_horizons = up_direction(np.stack([view.camera_to_world for view in views.values()]))
    tags = counted(len(votes), "gravity tag")
    if agreed is not None:
        angle = np.degrees(np.arccos(np.clip(agreed.up @ by_horizons, -1, 1)))
        against = f"; the horizons of the cameras differ by {angle:.0f} degrees"
        said = f"{agreed.agreeing} of {tags} agree{against if angle > CONTRADICTING_DEGREES else ''}"
        notice(f"{root}: up follows gravity: {said}")
        return agreed.up
    why = f"{tags} disagree" if len(votes) >= LEAST_TAGS else f"only {tags}" if votes else "no gravity tags"
    notice(f"{root}: up follows from the horizons of the cameras" + (f" ({why})" if files else ""))
    return by_horizons


def _images(found: Found) -> dict[int, Path]:
    """Return the file of each view that is an image; the first of a camera that stands still."""
    if found.take is None:
        return {number: one.files[0] for number, one in enumerate(found.footage) if one.video is None}
    return {
        view: one.files[frame]
        for one, track in zip(found.footage, found.take.tracks, strict=True)
        if one.video is None
        for view, frame in zip(track.views, track.frames, strict=False)
    }


def depth_range(structure: Structure, number: int, view: PlacedView) -> tuple[float, float] | None:
    """Return nearest and furthest depth of the points that a view sees, with a margin; None if it sees too few."""
    own = structure.observations[structure.observations[:, 1] == number, 0].astype(int)
    if len(own) < 10:
        return None
    inverse = np.linalg.inv(view.camera_to_world)
    depths = -(structure.points[own] @ inverse[2, :3] + inverse[2, 3])
    near, far = np.quantile(depths, (0.01, 0.99))
    return (0.8 * float(near), 1.25 * float(far)) if near > 0 else None
