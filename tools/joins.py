"""How steady a clip in groups is where one takes over from another: its held-out views, frame by frame, beside the truth."""

import argparse
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

import numpy as np

from kpc.encoder.datasets import Dataset
from kpc.encoder.evaluate import SceneRenderer, true_picture
from kpc.format import file
from kpc.format.fidelity import psnr
from kpc.format.groups import Groups

AROUND = 5
"""Frames before and after a join whose mean PSNR is compared."""


@dataclass(frozen=True)
class Frame:
    """A frame of a held-out camera.

    Attributes:
        frame: of the clip. group: the one that shows it. psnr: dB.
        change: how much its error is another than that of the frame before, root mean square; None for the first. What a viewer
            sees as flicker, or as a jump.
    """

    camera: str
    frame: int
    group: int
    psnr: float
    change: float | None


@dataclass(frozen=True)
class Join:
    """Where a group takes over.

    Attributes:
        frame: the first that it shows.
        agreement_db: PSNR of what both groups make of that frame, one against the other.
        before, after: mean PSNR of AROUND frames.
        change: of that frame; usual_change, high_change: median and 95th percentile of those of all other frames.
    """

    frame: int
    agreement_db: float
    before: float
    after: float
    change: float
    usual_change: float
    high_change: float


def measure(scene: Path, dataset: Dataset) -> dict[str, Any]:
    """`frames` and `joins` of a clip in groups, as plain data, on the held-out pictures of what it was encoded from.

    Memory: a group, and a picture of each camera.
    """
    groups = Groups(scene)
    first = groups.timeline.spans[0].start
    last_of: dict[int, np.ndarray] = {}
    frames: list[Frame] = []
    agreements: list[float] = []
    before: tuple[SceneRenderer, Dataset, np.ndarray] | None = None
    for number, span in enumerate(groups.timeline.spans):
        some = dataset.between(span.start, span.last)
        renderer = SceneRenderer(file.read(groups.open(number)).dequantise())
        shown = _shown(groups, number)
        at = np.rint(some.pictures.time * (span.count - 1)).astype(int) + span.start  # frame of each picture
        held_out = np.flatnonzero(some.pictures.is_test & np.isin(at, shown))
        for picture in sorted(map(int, held_out), key=lambda p: int(at[p])):
            camera, seen = int(some.pictures.camera[picture]), np.clip(renderer.picture(some, picture), 0, 1)
            error = seen - true_picture(some, picture)
            change = None if camera not in last_of else float(np.sqrt(np.mean(np.square(error - last_of[camera]))))
            last_of[camera] = error
            quality = psnr(error, 0)
            frames.append(Frame(some.camera_names[camera], int(at[picture]) - first, number, quality, change))
            if before is not None and at[picture] == shown[0]:
                earlier, same, its_at = before
                match = np.flatnonzero((its_at == shown[0]) & (same.pictures.camera == camera) & same.pictures.is_test)
                if len(match):
                    agreements.append(psnr(np.clip(earlier.picture(same, int(match[0])), 0, 1), seen))
        before = renderer, some, at
    return {"frames": [asdict(frame) for frame in frames], "joins": [asdict(join) for join in _joins(groups, frames, agreements)]}


def _shown(groups: Groups, number: int) -> np.ndarray:
    """The frames that a group shows."""
    span, last = groups.timeline.spans[number], max(groups.clip.frame_count - 1, 1)
    start = groups.timeline.spans[0].start
    frames = np.arange(span.start, span.last + 1)
    return np.array([frame for frame in frames if groups.timeline.at((frame - start) / last)[0] == number])


def _joins(groups: Groups, frames: list[Frame], agreements: list[float]) -> list[Join]:
    of_join = {int(_shown(groups, number)[0]) - groups.timeline.spans[0].start for number in range(1, len(groups))}
    others = [frame.change for frame in frames if frame.change is not None and frame.frame not in of_join] or [0.0]
    found = []
    for k, start in enumerate(sorted(of_join)):
        before = [f.psnr for f in frames if start - AROUND <= f.frame < start]
        after = [f.psnr for f in frames if start <= f.frame < start + AROUND]
        changes = [f.change for f in frames if f.frame == start and f.change is not None]
        numbers = (np.mean(before), np.mean(after), np.mean(changes), np.median(others), np.quantile(others, 0.95))
        found.append(Join(start, agreements[k] if k < len(agreements) else float("nan"), *map(float, numbers)))
    return found
