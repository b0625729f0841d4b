"""A long clip in groups (`kpc.format.groups`): which frames each holds, and how one begins where the one before ended."""

from dataclasses import replace

import torch

from kpc.encoder.compress import Trade
from kpc.encoder.field import Field
from kpc.encoder.options import Options
from kpc.format.container import ENTRY, HEADER
from kpc.format.errors import UsageError
from kpc.format.groups import Span
from kpc.format.scene import TIME_PLANES, Clip, Scene

OVERLAP = 2
"""Frames that a group holds beyond those it shows, at either end where there are more: it takes over in the midst of what it knows."""

LEAST_FRAMES = 8
"""Of a group."""


def spans_of(clip: Clip, group_s: float) -> tuple[Span, ...]:
    """The frames of as few groups as show at most `group_s` seconds each, all about equally many.

    Raises:
        UsageError: those are too few frames to make a scene of.
    """
    frames = int(group_s * clip.fps + 1e-6)
    if frames < LEAST_FRAMES:
        raise UsageError(f"--group {group_s:g}s: {frames} frames at {clip.fps:g} fps are too few for a group; give at least "
                         f"{LEAST_FRAMES / clip.fps:.2g}s")
    count = -(-clip.frame_count // frames)
    ends = [number * clip.frame_count // count for number in range(count + 1)]
    spans = []
    for shown_from, shown_to in zip(ends, ends[1:]):
        first, last = max(shown_from - OVERLAP, 0), min(shown_to - 1 + OVERLAP, clip.frame_count - 1)
        spans.append(Span(first, last - first + 1))
    return tuple(spans)


def share_of(options: Options, span: Span, spans: tuple[Span, ...]) -> Options:
    """What a group gets of a file's size and of the time for training: as much as it has of the frames."""
    share = span.count / sum(each.count for each in spans)
    trade, budget_s = options.trade, options.time_budget_s
    if trade.target_bytes is not None:
        trade = Trade(target_bytes=int(share * (trade.target_bytes - HEADER.size - ENTRY.size * len(spans))))
    return replace(options, trade=trade, time_budget_s=None if budget_s is None else share * budget_s)


def begin_with(field: Field, before: Scene) -> None:
    """Let a field begin where a scene of the same layout, but for its rows in time, ended: space planes and decoder as they are
    there, time planes as they are in its last row, all the time."""
    earlier = Field.from_scene(before)
    with torch.no_grad():
        for scale, name, *_ in field.layout.planes():
            plane = earlier.plane(scale, name)
            field.plane(scale, name)[:] = plane[-1:] if name in TIME_PLANES else plane
        for name, value in earlier.named_parameters():
            if name not in ("theta", "motion", "codes"):
                getattr(field, name)[:] = value
