"""Edits of a file, a scene or a clip in groups, in the order in which they are made: part, box, place, time."""

import os
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

from kpc.format.coding.quantise import QuantisedScene
from kpc.format.common.errors import FormatError, UsageError
from kpc.format.common.progress import Progress, progress
from kpc.format.container import groups, rewriting
from kpc.format.container.groups import Span
from kpc.format.container.rewriting import with_metadata
from kpc.format.scene.metadata import Metadata
from kpc.format.scene.scene import Clip
from kpc.tools.editing.cropping import cropped, shared_texels
from kpc.tools.editing.files import edited
from kpc.tools.editing.placing import Placement, placed, placed_metadata
from kpc.tools.editing.timing import at_rate, at_speed, check_part, check_rate, check_speed, spans_at_rate, trimmed
from kpc.tools.editing.unread import SharedTexels


@dataclass(frozen=True)
class Edits:
    """What is to be done with a file; None leaves a thing as it is.

    Attributes:
        part_s: from when to when to keep it, seconds.
        box: (2, 3) lower and upper corner of what to keep, world units before placing.
        placement: where to put it.
        speed: how many times as fast to play it.
        fps: frames per second to have, after `speed`, with the first and the last frame at the same times.
    """

    part_s: tuple[float, float] | None = None
    box: np.ndarray | None = None
    placement: Placement | None = None
    speed: float | None = None
    fps: float | None = None

    @property
    def any(self) -> bool:
        """Whether there is anything to do."""
        return any(value is not None for value in vars(self).values())


def edit(source: Path, output: Path, edits: Edits, metadata: Metadata) -> tuple[int, tuple[float, float] | None]:
    """Write an edited file.

    Args:
        source: the file.
        output: the file to write.
        edits: what to do.
        metadata: of the clip, in the world and the time of the source.

    Returns:
        The size in bytes, and from when to when the result is of the source, seconds; None for all of it.

    Raises:
        UsageError, FormatError: it cannot be done.
    """
    clip = groups.Groups(source)
    if edits.speed is not None and edits.fps is None:
        check_speed(clip.clip, edits.speed)
    if edits.placement is not None:
        metadata = placed_metadata(metadata, edits.placement)
    if not clip.is_single:
        return _edit_groups(clip, output, edits, metadata)
    kept: list[tuple[float, float]] = []

    def change(scene: QuantisedScene) -> QuantisedScene:
        if edits.part_s is not None:
            scene, span_s = trimmed(scene, *edits.part_s)
            kept.append(span_s)
        return _retimed(_changed(scene, edits), edits)

    with Progress("editing", total=1, unit="scenes"):
        data = edited(clip.open(0), change)
    if kept:
        metadata = _in_part(metadata, kept[0], clip.clip)
    return rewriting.save(with_metadata(data, metadata), output), kept[0] if kept else None


def _edit_groups(
    clip: groups.Groups, output: os.PathLike[str], edits: Edits, metadata: Metadata
) -> tuple[int, tuple[float, float] | None]:
    """Edit a clip in groups, of which whole groups are kept."""
    numbers = list(range(len(clip)))
    kept: tuple[float, float] | None = None
    duration_s, fps, spans = clip.clip.duration_s, clip.clip.fps, clip.timeline.spans
    if edits.part_s is not None:
        start_s, end_s = edits.part_s
        check_part(clip.clip, start_s, end_s)
        shown = [[time * duration_s for time in clip.timeline.display_span(number)] for number in numbers]
        shown[-1][1] = clip.clip.total_s  # its last frame is shown as long as the others
        numbers = [number for number in numbers if shown[number][0] < end_s and start_s < shown[number][1]]
        first, last = spans[numbers[0]], spans[numbers[-1]]
        kept = (first.start - spans[0].start) / fps, (last.last - spans[0].start) / fps
        spans = tuple(Span(span.start - first.start, span.count) for span in spans)
        metadata = _in_part(metadata, kept, clip.clip)
    fps *= edits.speed or 1.0
    spans = spans[numbers[0] : numbers[-1] + 1]
    if edits.fps is not None:
        check_rate(Clip(spans[-1].last - spans[0].start + 1, fps), edits.fps)
        spans = spans_at_rate(spans, fps, edits.fps)
        try:
            groups.check_spans(spans, clip.name)
        except FormatError as error:
            raise UsageError(f"--fps {edits.fps:g}: at this rate the groups have too few or too many frames") from error
    parts = []
    texels = [None] * len(numbers) if edits.box is None else shared_texels(clip, numbers, edits.box)
    for number, span, shared in progress(list(zip(numbers, spans, texels, strict=True)), "editing", unit="groups"):

        def change(scene: QuantisedScene, span: Span = span, shared: SharedTexels | None = shared) -> QuantisedScene:
            sound = scene.sound if edits.speed is None else None
            return replace(_changed(scene, edits, shared), clip=Clip(span.count, edits.fps or fps), sound=sound)

        parts.append(groups.GroupInput.of(edited(clip.open(number), change), span.start))
    return groups.write(parts, output, metadata), kept


def _changed(scene: QuantisedScene, edits: Edits, shared: SharedTexels | None = None) -> QuantisedScene:
    if edits.box is not None:
        scene = cropped(scene, edits.box, shared)
    return scene if edits.placement is None else placed(scene, edits.placement)


def _retimed(scene: QuantisedScene, edits: Edits) -> QuantisedScene:
    if edits.speed is not None:
        scene = at_speed(scene, edits.speed)
    return scene if edits.fps is None else at_rate(scene, edits.fps)


def _in_part(metadata: Metadata, kept_s: tuple[float, float], clip: Clip) -> Metadata:
    """Return metadata whose opening view is within the part of the clip that is kept."""
    if "opening" not in metadata.document or clip.duration_s == 0:
        return metadata
    opening, (since_s, until_s) = metadata.document["opening"], kept_s
    time = (opening["time"] * clip.duration_s - since_s) / (until_s - since_s)
    return metadata.with_members(opening={**opening, "time": min(max(time, 0.0), 1.0)})
