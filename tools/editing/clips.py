"""Edits of a file, a scene or a clip in groups, in the order in which they are made: part, layer, box, place, time."""

import os
from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path

import numpy as np

from kpc.format.coding.quantise import QuantisedScene
from kpc.format.common.errors import FormatError, UsageError
from kpc.format.common.progress import Progress, progress
from kpc.format.container import groups, rewriting
from kpc.format.container.groups import Span
from kpc.format.container.partial import PartialScene
from kpc.format.container.rewriting import with_metadata
from kpc.format.container.scene_io import read
from kpc.format.scene.metadata import Metadata
from kpc.format.scene.scene import Clip, Scene
from kpc.tools.editing.cropping import shared_texels, touched_cells, with_cells
from kpc.tools.editing.files import edited
from kpc.tools.editing.layers import Layer, OpenScene, Packed, find_layer
from kpc.tools.editing.placing import Placement, placed, placed_metadata
from kpc.tools.editing.timing import at_rate, at_speed, check_part, check_rate, check_speed, spans_at_rate, trimmed
from kpc.tools.editing.unread import SharedTexels


@dataclass(frozen=True)
class Edits:
    """What is to be done with a file; None leaves a thing as it is.

    Attributes:
        part_s: from when to when to keep it, seconds.
        layer: which layer to keep.
        box: (2, 3) lower and upper corner of what to keep, world units before placing.
        placement: where to put it.
        speed: how many times as fast to play it.
        fps: frames per second to have, after `speed`, with the first and the last frame at the same times.
    """

    part_s: tuple[float, float] | None = None
    layer: Layer | None = None
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
    (layer,) = _layers(clip, [0], edits)

    def change(scene: QuantisedScene) -> QuantisedScene:
        if edits.part_s is not None:
            scene, span_s = trimmed(scene, *edits.part_s)
            kept.append(span_s)
        cells = _kept_cells(scene.dequantise, layer, edits)
        if cells is not None and not cells.any():
            raise _nothing(edits)
        return _retimed(_changed(scene, edits, cells), edits)

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
    layers = _layers(clip, numbers, edits)

    def cells_of(k: int) -> np.ndarray | None:
        return _kept_cells(lambda: PartialScene(clip.open(numbers[k])).scene, layers[k], edits)

    if not any((cells := cells_of(k)) is None or cells.any() for k in range(len(numbers))):
        raise _nothing(edits)
    texels = shared_texels(clip, numbers, map(cells_of, range(len(numbers))))
    for k, number in enumerate(progress(numbers, "editing", unit="groups")):

        def change(scene: QuantisedScene, k: int = k) -> QuantisedScene:
            sound = scene.sound if edits.speed is None else None
            changed = _changed(scene, edits, cells_of(k), texels[k])
            return replace(changed, clip=Clip(spans[k].count, edits.fps or fps), sound=sound)

        parts.append(groups.GroupInput.of(edited(clip.open(number), change), spans[k].start))
    return groups.write(parts, output, metadata), kept


def _layers(clip: groups.Groups, numbers: Sequence[int], edits: Edits) -> Sequence[Packed | None]:
    """Return the cells of the layer that is kept of each of some groups; None where all is.

    Raises:
        UsageError: there is no such layer, or no such part.
    """
    if edits.layer is None:
        return [None] * len(numbers)
    whole = [partial(_opened, clip, number) for number in range(len(clip))]
    if not clip.is_single:
        return find_layer(edits.layer, [whole[number] for number in numbers], whole)
    part_s = edits.part_s
    if part_s is None or trimmed(read(clip.open(0)), *part_s)[1] == (0.0, clip.clip.duration_s):
        return find_layer(edits.layer, whole, [])
    return find_layer(edits.layer, [lambda: trimmed(read(clip.open(0)), *part_s)[0].dequantise()], whole)


def _opened(clip: groups.Groups, number: int) -> Scene:
    return read(clip.open(number)).dequantise()


def _kept_cells(open_scene: OpenScene, layer: Packed | None, edits: Edits) -> np.ndarray | None:
    """Return the cells of a scene that are kept, (K, Nz, Ny, Nx) bool; None where all are."""
    if edits.box is None:
        return None if layer is None else layer.array()
    scene = open_scene()
    return (scene.occupancy if layer is None else layer.array()) & touched_cells(scene, edits.box)


def _nothing(edits: Edits) -> UsageError:
    """Return the error that nothing is left."""
    assert edits.box is not None, "a layer holds something"
    low, high = edits.box.tolist()
    what = "" if edits.layer is None else f" of --layer {edits.layer}"
    return UsageError(f"--box: there is nothing{what} from {low} to {high}")


def _changed(
    scene: QuantisedScene, edits: Edits, cells: np.ndarray | None, shared: SharedTexels | None = None
) -> QuantisedScene:
    if cells is not None:
        scene = with_cells(scene, cells, shared)
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
