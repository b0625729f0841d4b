"""`cameras.html` of what was found."""

import math
from pathlib import Path

import numpy as np

from kpc.encoder.datasets.video import read_video
from kpc.encoder.evaluation.camera_page import PICTURES, Curve, ShownCamera, spread, write_camera_page
from kpc.encoder.poses.epipolar_lines import checks
from kpc.encoder.poses.find import Found
from kpc.encoder.poses.footage import Footage
from kpc.encoder.poses.instants import frame_times
from kpc.format.common.images import read_image

NAME = "cameras.html"


def write_page(found: Found, title: str, file: Path) -> None:
    """Write the page: where the cameras stand, their clocks and errors, and a picture of each."""
    is_rig, names, views = found.kind == "still rig", found.view_names, found.structure.views
    columns = (("clock s", "rate", "by", "confidence") if is_rig else ()) + ("focal px", "points", "error px")
    with_picture = set() if found.kind == "moving camera" else set(spread(len(names), PICTURES))
    cameras = []
    for number, name in enumerate(names):
        view, facts = views.get(number), tuple[str, ...]()
        if is_rig:
            clock = found.clocks[number]
            confidence = "" if math.isnan(clock.confidence) else f"{clock.confidence:.0%}"
            facts = (f"{clock.offset_s:+.4f}", f"{clock.rate:.5f}", clock.method, confidence)
        facts += ("not placed",) if view is None else ()
        facts += () if view is None else (f"{view.intrinsics[0]:.1f}", f"{view.points}", f"{view.error:.2f}")
        picture = _first_picture(found.footage[number]) if number in with_picture else None
        lens = (1.0, 1.0, 0.5, 0.5) if view is None else view.intrinsics
        size = (1, 1) if view is None else (round(2 * lens[2]), round(2 * lens[3]))
        pose = None if view is None else view.camera_to_world
        lines = () if view is None or picture is None else checks(found.structure, number)
        cameras.append(ShownCamera(name, pose, lens, size, facts, picture, lines))
    said = [
        f"{found.kind}: {len(views)} of {len(names)} placed, mean reprojection error {found.structure.error:.2f} px"
    ]
    curves = [
        Curve(one.name, clock.offset_s + clock.rate * frame_times(one), motion)
        for one, clock, motion in zip(found.footage, found.clocks, found.motion, strict=False)
        if len(motion) > 2
    ]
    write_camera_page(file, title, said, cameras, columns, found.structure.points, curves)


def _first_picture(footage: Footage) -> np.ndarray:
    if footage.video is None:
        return np.asarray(read_image(footage.files[0], upright=True)[..., :3])
    return next(iter(read_video(footage.files[0], footage.video, 0, 1)))[..., :3]
