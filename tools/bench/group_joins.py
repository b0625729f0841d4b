"""How steady a clip in groups is where one takes over from another: its held-out views, frame by frame, beside the truth."""

from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

import numpy as np
from kpc.encoder.datasets import Dataset
from kpc.encoder.evaluation.evaluate import SceneRenderer, ground_truth
from kpc.encoder.rdo.codec_model import widen_single_texels
from kpc.format.common.fidelity import psnr
from kpc.format.container import scene_io
from kpc.format.container.groups import Groups

AROUND = 5
"""Frames before and after a join whose mean PSNR is compared."""


@dataclass(frozen=True)
class Frame:
    """A frame of a held-out camera.

    Attributes:
        frame: of the clip. group: the one that shows it, or has the larger share of it. psnr: dB.
        change: how much its error is another than that of the frame before, root mean square; None for the first. What a viewer
            sees as flicker, or as a jump.
    """

    camera: str
    frame: int
    group: int
    psnr: float
    error_change: float | None


@dataclass(frozen=True)
class Join:
    """Where a group takes over.

    Attributes:
        frame: the first that it shows, or has the larger share of.
        agreement_db: mean PSNR of what both groups make of the frames that are mixed of both, one against the other.
        before, after: mean PSNR of AROUND frames.
        change: the largest of that frame and those that both groups share; usual_change, high_change: median and 95th percentile of
            those of all other frames.
    """

    frame: int
    agreement_db: float
    psnr_before: float
    psnr_after: float
    error_change: float
    median_error_change: float
    p95_error_change: float


def measure(scene: Path, dataset: Dataset) -> dict[str, Any]:
    """`frames` and `joins` of a clip in groups, as plain data, on the held-out pictures of what it was encoded from.

    Memory: a group, and of each camera the pictures of frames that are mixed.
    """
    groups = Groups(scene)
    timeline, first = groups.timeline, groups.timeline.spans[0].start
    begun: dict[
        tuple[int, int], np.ndarray
    ] = {}  # what a group makes of frames that are mixed of it and the next; by camera
    last_of: dict[int, np.ndarray] = {}
    found: list[Frame] = []
    agreements: list[list[float]] = [[] for _ in timeline.spans]
    for number, span in enumerate(timeline.spans):
        some = dataset.frame_range(span.start, span.last)
        renderer = SceneRenderer(widen_single_texels(scene_io.read(groups.open(number))).dequantise())
        at = np.rint(some.pictures.time * (span.count - 1)).astype(int) + span.start - first  # frame of each picture
        for picture in sorted(map(int, np.flatnonzero(some.pictures.is_test)), key=lambda p: int(at[p])):
            frame, camera = int(at[picture]), int(some.pictures.camera[picture])
            shares = {part: share for part, _, share in timeline.blend_at(_time(groups, frame))}
            if number not in shares:
                continue
            seen = np.clip(renderer.picture(some, picture), 0, 1)
            if number < max(shares):
                begun[frame, camera] = seen
                continue
            if number > min(shares):
                earlier = begun.pop((frame, camera))
                agreements[number].append(psnr(earlier, seen))
                seen = (1 - shares[number]) * earlier + shares[number] * seen
            error = seen - ground_truth(some, picture)
            change = None if camera not in last_of else float(np.sqrt(np.mean(np.square(error - last_of[camera]))))
            last_of[camera] = error
            shown, _ = timeline.at(_time(groups, frame))
            found.append(Frame(some.camera_names[camera], frame, shown, psnr(error, 0), change))
    return {
        "frames": [asdict(frame) for frame in found],
        "joins": [asdict(join) for join in _joins(groups, found, agreements)],
    }


def _time(groups: Groups, frame: int) -> float:
    return frame / max(groups.clip.frame_count - 1, 1)


def _joins(groups: Groups, frames: list[Frame], agreements: list[list[float]]) -> list[Join]:
    spans, first = groups.timeline.spans, groups.timeline.spans[0].start
    starts = [min(frame.frame for frame in frames if frame.group == number) for number in range(1, len(spans))]
    shared = [
        {start, *range(after.start - first + 1, before.last - first + 1)}
        for start, before, after in zip(starts, spans, spans[1:], strict=False)
    ]
    others = [
        f.error_change for f in frames if f.error_change is not None and not any(f.frame in some for some in shared)
    ] or [0.0]
    found = []
    for start, some, agreement in zip(starts, shared, agreements[1:], strict=True):
        before = [f.psnr for f in frames if start - AROUND <= f.frame < start]
        after = [f.psnr for f in frames if start <= f.frame < start + AROUND]
        change = max(f.error_change for f in frames if f.frame in some and f.error_change is not None)
        numbers = (np.mean(before), np.mean(after), change, np.median(others), np.quantile(others, 0.95))
        found.append(Join(start, float(np.mean(agreement)) if agreement else float("nan"), *map(float, numbers)))
    return found
