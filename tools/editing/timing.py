"""A clip at another speed or frame rate, and a part of a clip.

Times in a scene are shares of the clip, so a clip of another length or rate has the same planes. A part of it has some
of their rows: it begins and ends with a row of all planes, at which the picture is that of the whole clip.
"""

import math
from collections.abc import Sequence
from dataclasses import replace
from itertools import pairwise, zip_longest

import numpy as np

from kpc.format.coding.quantise import QuantisedPlane, QuantisedScene
from kpc.format.common.cli import TIME_SLACK_S
from kpc.format.common.errors import UsageError
from kpc.format.container.groups import Span
from kpc.format.container.scene_layout import AXIS_LIMIT, FRAME_LIMIT
from kpc.format.scene.motion import QuantisedMotion
from kpc.format.scene.scene import TIME_PLANES, Clip
from kpc.format.scene.sound import SAMPLE_RATE
from kpc.tools.editing.unread import without_unread

# Limits of the frames per second that an edited clip may be given.
MIN_FPS, MAX_FPS = 0.001, 1000.0


def at_speed(scene: QuantisedScene, factor: float) -> QuantisedScene:
    """Return a clip that runs `factor` times as fast, with the same frames and no sound."""
    return replace(scene, clip=Clip(scene.clip.frame_count, scene.clip.fps * factor), sound=None)


def at_rate(scene: QuantisedScene, fps: float) -> QuantisedScene:
    """Return a clip of another frame rate, as long from its first frame to its last, to half a frame.

    Raises:
        UsageError: a moving scene would have a single frame, or a clip more than a file may have.
    """
    check_rate(scene.clip, fps)
    return replace(scene, clip=Clip(1 + round(scene.clip.duration_s * fps), fps))


def check_speed(clip: Clip, factor: float) -> None:
    """Raise a UsageError if a clip that runs `factor` times as fast has a frame rate outside of the limits."""
    if not MIN_FPS <= clip.fps * factor <= MAX_FPS:
        raise UsageError(
            f"--speed {factor:g}: the clip would have {clip.fps * factor:g} frames per second, which may be from "
            f"{MIN_FPS:g} to {MAX_FPS:g}; choose another speed"
        )


def check_rate(clip: Clip, fps: float) -> None:
    """Raise a UsageError if a clip of several frames would have too few or too many at another rate."""
    if clip.frame_count == 1:
        return
    if clip.duration_s * fps > FRAME_LIMIT - 1:
        raise UsageError(
            f"--fps {fps:g}: the clip lasts {clip.duration_s:g} s, which would be more than {FRAME_LIMIT:,} frames; "
            "choose a lower rate"
        )
    if round(clip.duration_s * fps) < 1:
        raise UsageError(
            f"--fps {fps:g}: the clip lasts {clip.duration_s:g} s, which would be a single frame; choose a higher rate"
        )


def spans_at_rate(spans: Sequence[Span], before: float, after: float) -> tuple[Span, ...]:
    """Return the frames of the groups of a clip whose frame rate changes.

    A group that ended right before the next one still does.
    """
    found = []
    for span, following in zip_longest(spans, spans[1:]):
        start, last = (round(frame * after / before) for frame in (span.start, span.last))
        if following is not None and following.start == span.last + 1:
            last = round(following.start * after / before) - 1
        found.append(Span(start, last - start + 1))
    return tuple(found)


def check_part(clip: Clip, start_s: float, end_s: float) -> None:
    """Raise a UsageError if a clip does not have a part from one time to another, seconds; it may end at infinity."""
    if not math.isfinite(clip.total_s):
        raise UsageError(f"--from, --to: at {clip.fps:g} frames per second the clip has no end in seconds")
    if start_s >= clip.total_s:
        raise UsageError(f"--from {start_s:g}s: the clip lasts {clip.total_s:.2f} s")
    if clip.total_s + TIME_SLACK_S < end_s < math.inf:
        raise UsageError(f"--to {end_s:g}s: the clip lasts {clip.total_s:.2f} s")
    if start_s >= end_s:
        raise UsageError(f"--from {start_s:g}s --to {end_s:g}s: the part ends before it begins; swap or widen them")


def common_rows(scene: QuantisedScene) -> int:
    """Return into how many equal parts the clip can be cut at rows that the motion grid and all planes have, but for
    planes that are the same at all times, as those of scales for what stands still are."""
    planes = [plane for scale in scene.scales for n, plane in scale.items() if n in TIME_PLANES]
    counts = [len(plane.symbols) - 1 for plane in [p for p in planes if _changes(p)] or planes]
    if scene.motion is not None:
        counts.append(len(scene.motion.symbols) - 1)
    return math.gcd(*counts) if counts else 0


def trimmed(scene: QuantisedScene, start_s: float, end_s: float) -> tuple[QuantisedScene, tuple[float, float]]:
    """Return the part of a clip from one time to another, widened to rows of its planes.

    Symbols of rows that are kept, and of texels that the part still reads, stay as they are.

    Args:
        scene: a dynamic scene.
        start_s, end_s: seconds from the first frame.

    Returns:
        The part, and from when to when it is of the whole clip, seconds.

    Raises:
        UsageError: the part is empty or outside the clip, or the planes have no rows in common at which to cut.
    """
    parts, duration_s = common_rows(scene), scene.clip.duration_s
    if parts < 1 or duration_s <= 0:
        raise UsageError("--from, --to: the scene is static; there is nothing to cut")
    check_part(scene.clip, start_s, end_s)
    first = min(parts - 1, math.floor(start_s / duration_s * parts + 1e-9))
    last = min(parts, max(first + 1, math.ceil(min(end_s, duration_s) / duration_s * parts - 1e-9)))
    if (first, last) == (0, parts):
        if parts == 1 and (start_s > 0 or end_s < duration_s):
            raise UsageError("--from, --to: the planes of the clip have no rows in common at which it can be cut")
        return scene, (0.0, duration_s)
    since_s, until_s = (row / parts * duration_s for row in (first, last))
    intervals, rows = scene.clip.frame_count - 1, last - first
    frames = max(1, round(rows * intervals / parts))
    sound, fps = scene.sound, scene.clip.fps * (frames * parts / (rows * intervals))  # exact where frames are whole
    if sound is not None:
        sound = sound.part(round(since_s * SAMPLE_RATE), round((frames + 1) / fps * SAMPLE_RATE))
    part = replace(
        scene,
        clip=Clip(frames + 1, fps),
        sound=sound,
        scales=tuple(
            {n: _rows(plane, first, last, parts) if n in TIME_PLANES else plane for n, plane in scale.items()}
            for scale in scene.scales
        ),
        motion=None if scene.motion is None else _motion_rows(scene.motion, first, last, parts),
        occupancy=_slots(scene.occupancy, first, last, parts),
    )
    return without_unread(part, scene.occupancy), (since_s, until_s)


def _changes(plane: QuantisedPlane) -> bool:
    """Return whether a time plane has rows that differ."""
    return bool((plane.symbols != plane.symbols[:1]).any() or (plane.coded != plane.coded[:1]).any())


def _rows(plane: QuantisedPlane, first: int, last: int, parts: int) -> QuantisedPlane:
    if (len(plane.symbols) - 1) % parts:  # it is the same at all times
        return plane
    each = (len(plane.symbols) - 1) // parts
    rows = slice(first * each, last * each + 1)
    return QuantisedPlane(plane.symbols[rows], plane.step, plane.offset, plane.coded[rows])


def _motion_rows(motion: QuantisedMotion, first: int, last: int, parts: int) -> QuantisedMotion:
    each = (len(motion.symbols) - 1) // parts
    return QuantisedMotion(motion.symbols[first * each : last * each + 1], motion.step)


def _slots(occupancy: np.ndarray, first: int, last: int, parts: int) -> np.ndarray:
    """Return the occupancy of a part in as many slots as it takes for their borders to stay where they are.

    Where that would be more than a file may have, each slot holds the cells of all old ones that it touches.
    """
    slots = len(occupancy)
    count = (last - first) * math.lcm(slots, parts) // parts
    if slots == 1 or count > AXIS_LIMIT:
        count = 1 if slots == 1 else slots
    borders = (first + (last - first) * np.arange(count + 1) / count) / parts * slots
    found = []
    for low, high in pairwise(borders):
        since = math.floor(low + 1e-9)
        found.append(occupancy[since : max(since + 1, math.ceil(high - 1e-9))].any(0))
    return np.stack(found)
