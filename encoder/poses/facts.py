"""What is said of each camera: its clock, its lens, and how well it was placed."""

import math
from collections.abc import Sequence

import numpy as np

from kpc.encoder.poses.clocks import Clock
from kpc.encoder.poses.find import Found
from kpc.encoder.poses.structure import PlacedView

# Headings of the facts about a clock, and about a view.
CLOCK, VIEW = ("clock s", "rate", "by", "confidence"), ("focal length", "points", "error px")


def clock_facts(clock: Clock) -> tuple[str, ...]:
    """Return what CLOCK names."""
    confidence = "" if math.isnan(clock.confidence) else f"{clock.confidence:.0%}"
    return f"{clock.offset_s:+.4f}", f"{clock.rate:.5f}", clock.method, confidence


def view_facts(views: Sequence[PlacedView]) -> tuple[str, ...]:
    """Return what VIEW names: the usual number of points and the mean error of several; of none, that it is not there.

    Args:
        views: of one camera.
    """
    if not views:
        return ("not placed", "", "")
    points = sorted(view.points for view in views)[len(views) // 2]
    return lens_text(views[0]), f"{points}", f"{np.mean([view.error for view in views]):.2f}"


def lens_text(view: PlacedView) -> str:
    """Return the focal length, and whether the lens is a fisheye."""
    return f"{view.intrinsics[0]:.1f} px" + (", fisheye" if view.is_fisheye else "")


def camera_table(found: Found) -> list[tuple[str, ...]]:
    """Return a heading and a row of facts for each camera of a still rig, or of several that move."""
    placed = found.structure.views
    if found.take is None:
        of_camera = [[placed[number]] if number in placed else [] for number in range(len(found.footage))]
        counts: list[tuple[str, ...]] = [()] * len(of_camera)
    else:
        tracks = found.take.tracks
        of_camera = [[placed[number] for number in track.views if number in placed] for track in tracks]
        counts = [(f"{len(own)} of {len(track.views)}",) for own, track in zip(of_camera, tracks, strict=True)]
    rows = [("camera", *(("placed",) if found.take else ()), *CLOCK, *VIEW)]
    for one, count, clock, own in zip(found.footage, counts, found.clocks, of_camera, strict=True):
        rows.append((one.name, *count, *clock_facts(clock), *view_facts(own)))
    return rows
