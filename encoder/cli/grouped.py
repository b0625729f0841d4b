"""A long clip in groups (`kpc.format.container.groups`): which frames each holds, and how one begins where the one before ended.

Space planes are coded for each group anew. As differences from those of the group before, at equal steps, they take 1.4 times as
many bytes (default scene, second group after 600 steps): training moves all of them a little, by about as much as they vary.
"""

from collections.abc import Sequence
from dataclasses import replace

import numpy as np
import torch
from kpc.encoder.cli.options import Options
from kpc.encoder.field.field import Field
from kpc.encoder.rdo.rate_control import Trade
from kpc.format.common.errors import UsageError
from kpc.format.container.container import ENTRY, HEADER
from kpc.format.container.groups import Span
from kpc.format.scene.scene import TIME_PLANES, Clip, Scene

OVERLAP = 2
"""Frames that a group holds beyond those it shows, at either end where there are more: so four are shared, and the inner two of them mixed
(`kpc.format.container.groups`). The error of the default scene over 90 frames in 128x96 pixels (`draft`, 800 steps) changes by 0.027 from one
frame to the next where a group takes over at once, 0.012 and 0.016 before and after; by 0.014, 0.015 and 0.017 where two are mixed."""

LATER_STEPS = 0.5
"""Steps of a group that begins where another ended, of those of one that begins anew. Held-out PSNR of the three groups named
below with 800 steps of `fast` for the first: 27.2, 30.8, 32.9 dB with 1, 27.2, 29.0, 31.1 dB with 0.5; with 2,400 and 0.25 it is 36.0,
31.5, 33.9 dB, which falls off where they join. Five frames before and after the first join of the run named above, it is 31.0 and 31.5 dB
with 0.5, 31.0 and 32.9 dB with 1."""

MIN_FRAMES = 8
"""Of a group."""


def split_into_spans(clip: Clip, group_s: float) -> tuple[Span, ...]:
    """The frames of as few groups as show at most `group_s` seconds each, all about equally many.

    Raises:
        UsageError: those are too few frames to make a scene of.
    """
    frames = int(group_s * clip.fps + 1e-6)
    if frames < MIN_FRAMES:
        raise UsageError(
            f"--group {group_s:g}s: {frames} frames at {clip.fps:g} fps are too few for a group; give at least "
            f"{MIN_FRAMES / clip.fps:.2g}s"
        )
    count = -(-clip.frame_count // frames)
    ends = [number * clip.frame_count // count for number in range(count + 1)]
    spans = []
    for shown_from, shown_to in zip(ends, ends[1:]):
        first, last = max(shown_from - OVERLAP, 0), min(shown_to - 1 + OVERLAP, clip.frame_count - 1)
        spans.append(Span(first, last - first + 1))
    return tuple(spans)


def options_of_group(options: Options, number: int, spans: Sequence[Span]) -> Options:
    """What a group gets of a file's size, as much as it has of the frames, and of the time for training: LATER counts there."""
    frames = np.array([span.count for span in spans], float)
    effort = frames * np.where(np.arange(len(spans)), LATER_STEPS, 1.0)
    trade, budget_s = options.trade, options.time_budget_s
    if trade.target_bytes is not None:
        share = frames[number] / frames.sum()
        trade = Trade(target_bytes=int(share * (trade.target_bytes - HEADER.size - ENTRY.size * len(spans))))
    if budget_s is not None:
        budget_s *= float(effort[number] / effort.sum())
    return replace(options, trade=trade, time_budget_s=budget_s)


def initialise_from(field: Field, before: Scene) -> None:
    """Let a field begin where a scene of the same layout, but for its rows in time, ended: space planes and decoder as they are
    there, what changes as it is in its last row, all the time.

    Of the default scene over 90 frames, in three groups of 800 steps of `fast` each, the second and third have 30.8 and 32.9 dB so,
    and 26.7 and 29.1 dB begun anew.
    """
    earlier = Field.from_scene(before)
    with torch.no_grad():
        for scale, name, *_ in field.layout.planes():
            plane = earlier.plane(scale, name)
            field.plane(scale, name)[:] = plane[-1:] if name in TIME_PLANES else plane
        if field.motion is not None and earlier.motion is not None:
            field.motion[:] = earlier.motion[-1:]
        for name, value in earlier.named_parameters():
            mine = getattr(field, name)
            if (
                name not in ("theta", "motion") and mine.shape == value.shape
            ):  # codes of other pictures may be more or fewer
                mine[:] = value
