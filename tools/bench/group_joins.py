"""How steady a clip in groups is where one group takes over from another, measured on held-out views."""

from collections.abc import Iterator, Set
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np

from kpc.encoder.datasets import Dataset
from kpc.encoder.evaluation.evaluate import Comparison, SceneRenderer, compare, testable_pictures
from kpc.encoder.rdo.codec_model import widen_single_texels
from kpc.format.common.errors import UsageError
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


@dataclass(frozen=True)
class Shown:
    """A frame of a held-out camera, as the clip shows it.

    Attributes:
        camera: the number of the camera.
        name: of the camera.
        frame: its number in the clip.
        group: the group that shows it, or has the larger share of it.
        key: says which picture of the dataset it is (`Pictures.offset`).
        comparison: with what was filmed.
        agreement: where two groups are blended, the later one and the PSNR in dB between their pictures.
    """

    camera: int
    name: str
    frame: int
    group: int
    key: int
    comparison: Comparison
    agreement: tuple[int, float] | None


def shown_frames(groups: Groups, dataset: Dataset, wanted: Set[int] | None = None) -> Iterator[Shown]:
    """Yield the held-out pictures of a clip's dataset, group by group, the frames of a camera in order.

    One group is in memory at a time, and the pictures of frames that are blended with it.

    Args:
        groups: the clip, or a scene without groups.
        dataset: with its held-out pictures.
        wanted: keys of the pictures to yield; None for all.

    Raises:
        UsageError: the clip in groups is not as long as that of the dataset.
    """
    if not groups.is_single and groups.clip.frame_count != dataset.clip.frame_count:
        raise UsageError(
            f"{groups.name} has {groups.clip.frame_count} frames, {dataset.path} has {dataset.clip.frame_count}; give "
            "the dataset that it was made from"
        )
    timeline, first = groups.timeline, groups.timeline.spans[0].start
    blending: dict[int, np.ndarray] = {}  # by picture: how the earlier group renders it
    for number, span in enumerate(timeline.spans):
        some = dataset if groups.is_single else dataset.frame_range(span.start, span.last)
        renderer = SceneRenderer(widen_single_texels(scene_io.read(groups.open(number))).dequantise())
        pictures = some.pictures
        frames = (
            np.rint(pictures.time * (some.clip.frame_count - 1)).astype(int) + span.start - first
        )  # of each picture
        held_out = testable_pictures(some, right_halves=bool(renderer.scene.appearances)).tolist()
        for picture in sorted(held_out, key=lambda p: (int(pictures.camera[p]), int(frames[p]))):
            frame, key = int(frames[picture]), int(pictures.offset[picture])  # the key is the same in every group
            shares = {part: share for part, _, share in timeline.blend_at(_time(groups, frame))}
            if number not in shares or (wanted is not None and key not in wanted):
                continue
            found = compare(renderer, some, picture)
            if number < max(shares):
                blending[key] = found.picture
                continue
            agreement = None
            if number > min(shares):
                earlier, rendered = blending.pop(key), found.picture
                agreement = number, psnr(earlier, rendered)
                found = replace(found, picture=(1 - shares[number]) * earlier + shares[number] * rendered)
            shown, _ = timeline.at(_time(groups, frame))
            camera = int(pictures.camera[picture])
            yield Shown(camera, some.camera_names[camera], frame, shown, key, found, agreement)


def error_change(error: np.ndarray, before: np.ndarray, where: np.ndarray | None = None) -> float:
    """Return the RMS difference between the errors of a picture and of the one before, visible as flicker.

    Args:
        error, before: (H, W, 3), rendered less filmed colours.
        where: (H, W) bool, the pixels that count; None for all.
    """
    change = error - before
    return float(np.sqrt(np.mean(np.square(change if where is None else change[where]))))


def measure(scene: Path, dataset: Dataset) -> dict[str, Any]:
    """Compare a clip in groups with the held-out pictures of its dataset.

    Returns:
        `frames` and `joins`, the fields of `Frame` and `Join` as plain data.
    """
    groups = Groups(scene)
    last_error: dict[int, np.ndarray] = {}  # by camera
    found: list[Frame] = []
    agreements: list[list[float]] = [[] for _ in groups.timeline.spans]
    for shown in shown_frames(groups, dataset):
        if shown.agreement is not None:
            agreements[shown.agreement[0]].append(shown.agreement[1])
        error, before = shown.comparison.error, last_error.get(shown.camera)
        last_error[shown.camera] = error
        change = None if before is None else error_change(error, before)
        found.append(Frame(shown.name, shown.frame, shown.group, shown.comparison.psnr(), change))
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
