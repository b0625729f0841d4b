"""`cameras.html` of what was found."""

from pathlib import Path

import numpy as np

from kpc.encoder.datasets.video import read_video
from kpc.encoder.evaluation.camera_page import PICTURES, Curve, ShownCamera, spread, write_camera_page
from kpc.encoder.poses.epipolar_lines import checks
from kpc.encoder.poses.facts import CLOCK, VIEW, camera_table, clock_facts, view_facts
from kpc.encoder.poses.find import Found
from kpc.encoder.poses.footage import Footage
from kpc.encoder.poses.instants import frame_times
from kpc.format.common.images import read_image

NAME = "cameras.html"


def write_page(found: Found, title: str, file: Path) -> None:
    """Write the page: where the cameras stand, their clocks and errors, and a picture of each."""
    is_rig, names, views = found.kind == "still rig", found.view_names, found.structure.views
    columns = (*(CLOCK if is_rig else ()), *VIEW)
    shown = _shown(found)
    cameras = []
    for number, name in enumerate(names):
        view, facts = views.get(number), tuple[str, ...]()
        if is_rig:
            facts = clock_facts(found.clocks[number])
        facts += view_facts([] if view is None else [view])
        picture = _picture(*shown[number]) if number in shown else None
        lens = (1.0, 1.0, 0.5, 0.5) if view is None else view.intrinsics
        size = (1, 1) if view is None else (round(2 * lens[2]), round(2 * lens[3]))
        pose = None if view is None else view.camera_to_world
        lines = () if view is None or picture is None else checks(found.structure, number)
        cameras.append(ShownCamera(name, pose, lens, size, facts, picture, lines))
    said = [
        f"{found.kind}: {len(views)} of {len(names)} placed, mean reprojection error {found.structure.error:.2f} px"
    ]
    if found.kind == "moving cameras":
        titles, *rows = camera_table(found)
        for name, *row in rows:
            named = zip(titles[1:], row, strict=True)
            said.append(f"{name}: " + ", ".join(f"{title} {fact}" for title, fact in named if fact))
    curves = [
        Curve(one.name, clock.offset_s + clock.rate * frame_times(one), motion)
        for one, clock, motion in zip(found.footage, found.clocks, found.motion, strict=False)
        if len(motion) > 2
    ]
    z = np.array([0.0, 0.0, 1.0])
    write_camera_page(file, title, said, cameras, columns, found.structure.points, curves, z)


def _shown(found: Found) -> dict[int, tuple[Footage, int]]:
    """Return the views that have a picture, and which frame of which camera it is: of one that moves the first."""
    if found.take is None:
        return {number: (found.footage[number], 0) for number in spread(len(found.view_names), PICTURES)}
    shown = {}
    for number in spread(len(found.footage), PICTURES):
        track = found.take.tracks[number]
        frame = next((frame for frame in track.frames if track.view_of(frame) in found.structure.views), None)
        if frame is not None:
            shown[track.view_of(frame)] = found.footage[number], frame
    return shown


def _picture(footage: Footage, frame: int) -> np.ndarray:
    if footage.video is None:
        return np.asarray(read_image(footage.files[frame], upright=True)[..., :3])
    return next(iter(read_video(footage.files[0], footage.video, frame, frame + 1)))[..., :3]
