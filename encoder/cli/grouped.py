"""A long clip in groups (`kpc.format.container.groups`): the frames of each group, and its start from the one before.

Where what moves has scales of its own, the others are trained and coded with the first group and shared by all
(`kpc.encoder.rdo.sharing`). All other planes of a group are coded anew; why differences from the group before do not
pay, and the figures behind the constants: docs/design/rate-distortion.md, "Groups of a long clip".
"""

import itertools
from collections.abc import Mapping, Sequence
from dataclasses import replace

import numpy as np
import torch

from kpc.encoder.cli.options import Options
from kpc.encoder.datasets import Dataset
from kpc.encoder.field.bounds import visible_cells
from kpc.encoder.field.config import TrainConfig
from kpc.encoder.field.field import Field
from kpc.encoder.field.layout import plan_layout
from kpc.encoder.field.occupancy_grid import grid_shape
from kpc.encoder.rdo.distortion import PlaneKey
from kpc.encoder.rdo.rate_control import Trade
from kpc.encoder.rdo.sharing import Sharing
from kpc.encoder.training.moving_area import MovingArea
from kpc.format.coding.quantise import QuantisedPlane
from kpc.format.common.errors import UsageError
from kpc.format.common.text import agreeing, counted
from kpc.format.container.container import ENTRY, HEADER
from kpc.format.container.groups import Span
from kpc.format.container.scene_io import SceneReader
from kpc.format.container.scene_layout import PLANE_KIND
from kpc.format.container.sources import AnySource
from kpc.format.scene.scene import ALL_PLANES, TIME_PLANES, Clip, Scene
from kpc.format.scene.space import SpaceMapping

# Frames that a group holds beyond those that it shows, at either end where there are more. So two groups share four
# frames, of which the player mixes the inner two.
OVERLAP = 2
LATER_STEPS = 0.5  # training steps of a group that starts where another ended, as a share of those of the first
MIN_FRAMES = 8  # of a group
STILL_SHARE = 0.6  # of a group's bytes that are of planes in which nothing moves, about
CLIP_BYTES = 1536  # that the metadata of a clip may take beside its groups, without the texts that are given


def split_into_spans(clip: Clip, group_s: float) -> tuple[Span, ...]:
    """Split a clip into as few groups as show at most `group_s` seconds each, all about equally long.

    Raises:
        UsageError: those are too few frames for a group.
    """
    frames = int(group_s * clip.fps + 1e-6)
    if frames < MIN_FRAMES:
        raise UsageError(
            f"--group {group_s:g}s: {counted(frames, 'frame')} at {clip.fps:g} fps {agreeing(frames, 'is', 'are')} too "
            f"few for a group; give at least {MIN_FRAMES / clip.fps:.2g}s"
        )
    count = -(-clip.frame_count // frames)
    ends = [number * clip.frame_count // count for number in range(count + 1)]
    spans = []
    for shown_from, shown_to in itertools.pairwise(ends):
        first, last = max(shown_from - OVERLAP, 0), min(shown_to - 1 + OVERLAP, clip.frame_count - 1)
        spans.append(Span(first, last - first + 1))
    return tuple(spans)


def spans_of(options: Options, clip: Clip) -> tuple[Span, ...]:
    """Return the frames of each group of a clip; of all of it, where it is not encoded in groups.

    Raises:
        UsageError: groups are too short, or there is none of the number `options.only`.
    """
    if options.group_s is None:
        return (Span(0, clip.frame_count),)
    spans = split_into_spans(clip, options.group_s)
    if options.only is not None and options.only >= len(spans):
        raise UsageError(f"--only {options.only}: the clip has {counted(len(spans), 'group')}, numbered from 0")
    return spans


def options_of_group(
    options: Options, number: int, spans: Sequence[Span], still_share: float = 0.0, shared: int = 0
) -> Options:
    """Return the options of one group: its share of the file's size by frames, and of the training time by steps.

    Args:
        options: of the clip.
        number: of the group.
        spans: the frames of each.
        still_share: share of the first group's bytes that the others share.
        shared: bytes that this group has from the first.
    """
    frames = np.array([span.count for span in spans], float)
    effort = frames * np.where(np.arange(len(spans)), LATER_STEPS, 1.0)
    trade, budget_s = options.trade, options.time_budget_s
    if trade.target_bytes is not None:
        parts = frames / np.where(np.arange(len(spans)), 1.0, 1 - still_share)
        share = parts[number] / parts.sum()
        texts = sum(len(text.encode()) for text in options.members.values() if text)
        beside = ENTRY.size * (len(spans) + 1) + CLIP_BYTES + texts
        trade = Trade(target_bytes=int(share * max(1, trade.target_bytes - HEADER.size - beside)) + shared)
    if budget_s is not None:
        budget_s *= float(effort[number] / effort.sum())
    return replace(options, trade=trade, time_budget_s=budget_s)


def plan_sharing(
    config: TrainConfig, dataset: Dataset, aabb: np.ndarray, mapping: SpaceMapping | None, area: MovingArea
) -> Sharing:
    """Return what all groups of a clip share: the scales in which nothing moves, with all that any group may see there.

    Args:
        config: of training. dataset: of the whole clip. aabb: (2, 3), its box. mapping: of space beyond the box.
        area: where things move at any time of the clip.
    """
    layout = plan_layout(config.with_moving_area(area.box), aabb, dataset.clip, dataset.is_dynamic)
    shape = grid_shape(aabb, config.cells_across)
    return Sharing.of_scales(
        layout.still_scales, area.cells(shape) & visible_cells(dataset.pictures, aabb, shape, mapping)
    )


def plane_bytes(source: AnySource) -> dict[PlaneKey, int]:
    """Return what each plane of a file takes, all its segments together, in bytes."""
    found: dict[PlaneKey, int] = {}
    for entry in SceneReader(source, in_parts=True).index:
        if entry.kind == PLANE_KIND:
            key = entry.scale, ALL_PLANES[entry.plane]
            found[key] = found.get(key, 0) + entry.stored_length
    return found


def take_over(settled: Mapping[PlaneKey, QuantisedPlane], field: Field) -> None:
    """Set planes of a field to those that an earlier group has settled, and keep them so."""
    with torch.no_grad():
        for (s, name), plane in settled.items():
            field.plane(s, name)[:] = torch.from_numpy(plane.dequantise())
    field.freeze(settled)


def initialise_from(field: Field, before: Scene) -> None:
    """Initialise a field from the end of a scene of the same layout, but for its rows in time.

    Space planes and decoder are copied; time planes and motion take the scene's last row at all times. Appearance
    embeddings are copied where there are as many. What the field leaves out of the scene is not copied.
    """
    earlier = Field.from_scene(before)
    with torch.no_grad():
        for scale, name, *_ in field.layout.planes():
            rows, columns = field.layout.rectangle(scale, name)
            plane = earlier.plane(scale, name)[:, columns]
            field.plane(scale, name)[:] = plane[-1:] if name in TIME_PLANES else plane[rows]
        if field.motion is not None and earlier.motion is not None:
            field.motion[:] = earlier.motion[-1:]
        for name, value in earlier.named_parameters():
            own = getattr(field, name)
            if name not in ("theta", "motion") and own.shape == value.shape:
                own[:] = value
