"""How steady a clip in groups is where one group takes over from another, measured on held-out views."""

from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

import numpy as np

from kpc.encoder.datasets import Dataset
from kpc.encoder.evaluation.evaluate import SceneRenderer
from kpc.encoder.evaluation.ground_truth import ground_truth
from kpc.encoder.rdo.codec_model import widen_single_texels
from kpc.format.common.fidelity import psnr
from kpc.format.container import scene_io
from kpc.format.container.groups import Groups

# Number of frames before and after a join whose mean PSNR is compared.
AROUND = 5


@dataclass(frozen=True)
class Frame:
    """A frame of a held-out camera.

    Attributes:
        frame: its number in the clip.
        group: the group that shows it, or has the larger share of it.
        psnr: in dB.
        error_change: RMS difference between its error and that of the frame before, which is visible as flicker or as a
            jump; None for the first frame.
    """

    camera: str
    frame: int
    group: int
    psnr: float
    error_change: float | None


@dataclass(frozen=True)
class Join:
    """A frame at which a group takes over.

    Attributes:
        frame: the first that the group shows, or has the larger share of.
        agreement_db: mean PSNR between the pictures of both groups, over the frames that are blended of both.
        psnr_before, psnr_after: mean PSNR of AROUND frames.
        error_change: the largest of this frame and the blended ones.
        median_error_change, p95_error_change: median and 95th percentile over all other frames.
    """

    frame: int
    agreement_db: float
    psnr_before: float
    psnr_after: float
    error_change: float
    median_error_change: float
    p95_error_change: float


def measure(scene: Path, dataset: Dataset) -> dict[str, Any]:
    """Compare a clip in groups with the held-out pictures of its dataset.

    One group is in memory at a time, and for each camera the pictures of blended frames.

    Returns:
        `frames` and `joins`, the fields of `Frame` and `Join` as plain data.
    """
    groups = Groups(scene)
    timeline, first = groups.timeline, groups.timeline.spans[0].start
    blending: dict[int, np.ndarray] = {}  # by picture: how the earlier group renders it
    last_error: dict[int, np.ndarray] = {}  # by camera
    found: list[Frame] = []
    agreements: list[list[float]] = [[] for _ in timeline.spans]
    for number, span in enumerate(timeline.spans):
        some = dataset.frame_range(span.start, span.last)
        renderer = SceneRenderer(widen_single_texels(scene_io.read(groups.open(number))).dequantise())
        frames = np.rint(some.pictures.time * (span.count - 1)).astype(int) + span.start - first  # of each picture
        for picture in sorted(map(int, np.flatnonzero(some.pictures.is_test)), key=lambda p: int(frames[p])):
            frame, camera = int(frames[picture]), int(some.pictures.camera[picture])
            same = int(some.pictures.offset[picture])  # in every group
            shares = {part: share for part, _, share in timeline.blend_at(_time(groups, frame))}
            if number not in shares:
                continue
            rendered = np.clip(renderer.picture(some, picture), 0, 1)
            if number < max(shares):
                blending[same] = rendered
                continue
            if number > min(shares):
                earlier = blending.pop(same)
                agreements[number].append(psnr(earlier, rendered))
                rendered = (1 - shares[number]) * earlier + shares[number] * rendered
            error = rendered - ground_truth(some, picture)
            change = None
            if camera in last_error:
                change = float(np.sqrt(np.mean(np.square(error - last_error[camera]))))
            last_error[camera] = error
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
    joined = [
        {start, *range(after.start - first + 1, before.last - first + 1)}
        for start, before, after in zip(starts, spans[:-1], spans[1:], strict=True)
    ]
    changes = {f: f.error_change for f in frames if f.error_change is not None}
    others = [change for f, change in changes.items() if not any(f.frame in some for some in joined)] or [0.0]
    found = []
    for start, some, agreement in zip(starts, joined, agreements[1:], strict=True):
        before = [f.psnr for f in frames if start - AROUND <= f.frame < start]
        after = [f.psnr for f in frames if start <= f.frame < start + AROUND]
        found.append(
            Join(
                frame=start,
                agreement_db=float(np.mean(agreement)) if agreement else float("nan"),
                psnr_before=float(np.mean(before)),
                psnr_after=float(np.mean(after)),
                error_change=max(change for f, change in changes.items() if f.frame in some),
                median_error_change=float(np.median(others)),
                p95_error_change=float(np.quantile(others, 0.95)),
            )
        )
    return found
