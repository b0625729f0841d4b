"""The `transforms.json` beside the pictures of every camera, by which kpenc trains on their folder."""

import json
from collections.abc import Sequence
from pathlib import Path
from typing import Any

from kpc.format.common.cli import atomic_write
from kpc.format.common.errors import UsageError
from kpc.tools.rendering.shots import Shots

NAME = "transforms.json"
MADE_BY = "kprender"
# One in so many pictures of a camera is held out.
HOLD_OUT_EVERY = 8


def check_folder(folder: Path) -> None:
    """Refuse a folder whose document describes other pictures than those of kprender.

    Raises:
        UsageError: it does.
    """
    try:
        document = json.loads((folder / NAME).read_bytes())
    except FileNotFoundError:
        return
    except (ValueError, RecursionError, IsADirectoryError):
        document = None
    if not isinstance(document, dict) or document.get("made_by") != MADE_BY:
        raise UsageError(f"-o {folder}: holds a {NAME} that kprender did not write; give another folder")


def begin(folder: Path) -> None:
    """Delete the document of an earlier run, so that one that is there describes what was rendered, and all of it."""
    (folder / NAME).unlink(missing_ok=True)


def write_transforms(folder: Path, shots: Shots, paths: Sequence[Path]) -> None:
    """Describe pictures as nerfstudio does: intrinsics, poses, and times from 0 to 1 over the frames that they show.

    Pictures of neighbouring cameras are held out at different times, so that all moments are trained on.

    Args:
        folder: of the pictures.
        shots: the pictures.
        paths: of each of them.
    """
    frames = [_frame(shots, number, path) for number, path in zip(shots.numbers, paths, strict=True)]
    clip = {"fps": shots.fps, "frame_count": len(shots.frames)} if len(shots.frames) > 1 else {}
    places = (divmod(number, len(shots.frames)) for number in range(len(paths)))  # the camera and the frame of each
    tests = [path.name for path, place in zip(paths, places, strict=True) if sum(place) % HOLD_OUT_EVERY == 0]
    document = {"made_by": MADE_BY, **clip, "test_filenames": tests if len(paths) > 1 else [], "frames": frames}
    with atomic_write(folder / NAME) as temporary:
        temporary.write_text(json.dumps(document, indent=1) + "\n")


def _frame(shots: Shots, number: int, path: Path) -> dict[str, Any]:
    camera = shots.camera(number)
    time = {"time": shots.place(number)} if len(shots.frames) > 1 else {}
    lens = {name: getattr(camera, name) for name in ("fl_x", "fl_y", "cx", "cy")}
    pose = camera.camera_to_world.tolist()
    name = {} if (seen_by := shots.camera_name(number)) is None else {"camera_name": seen_by}
    return {
        "file_path": path.name,
        **name,
        **time,
        "w": camera.width,
        "h": camera.height,
        **lens,
        "transform_matrix": pose,
    }
