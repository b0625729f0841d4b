"""Section 4.7: clips in groups."""

import itertools

from .common import clamp, require
from .container import group_chunks
from .scene import decode


def decode_groups(data, is_prefix=False):
    """Return (groups, scenes): [(row_start, row_count, the file of the group)], and the scenes of those that are whole.

    None for a file that is a scene."""
    chunks, value_count = group_chunks(data, is_prefix)
    if not chunks:
        return None
    spans = [(chunk.row_start, chunk.row_start + chunk.row_count - 1) for chunk in chunks]  # (a, b) of each
    for (a, b), (next_a, next_b) in itertools.pairwise(spans):
        require(a < next_a <= b + 1 and b < next_b, "frames of groups")
    require(all(b < a for (_, b), (a, _) in zip(spans, spans[2:])), "a frame in three groups")
    require(spans[-1][1] - spans[0][0] + 1 <= 1 << 24, "number of frames")
    scenes = [decode(chunk.stored) for chunk in chunks if chunk.is_whole]
    for chunk, scene in zip(chunks, scenes):
        require(scene["frame_count"] == chunk.row_count and scene["fps"] == scenes[0]["fps"], "clip of a group")
        require(scene["value_count"] <= value_count, "value count of a group")
    return [(chunk.row_start, chunk.row_count, chunk.stored) for chunk in chunks], scenes


def shown_group(spans, time):
    """Return (number, local time) of the group shown at a time of the clip; spans: (row_start, row_count) of each."""
    a = [start for start, _ in spans]
    b = [start + count - 1 for start, count in spans]
    f = a[0] + time * (b[-1] - a[0])
    g = sum(f >= (b[k - 1] + a[k]) / 2 for k in range(1, len(spans)))
    return g, clamp((f - a[g]) / (b[g] - a[g]), 0.0, 1.0) if b[g] > a[g] else 0.0


def blend(spans, time):
    """Return {number: weight} of the one or two groups that make the picture at a time of the clip."""
    a = [start for start, _ in spans]
    b = [start + count - 1 for start, count in spans]
    f = a[0] + time * (b[-1] - a[0])
    for k in range(1, len(spans)):
        if a[k] < f < b[k - 1]:
            s = (f - a[k]) / (b[k - 1] - a[k])
            return {k - 1: 1 - s, k: s}
    return {shown_group(spans, time)[0]: 1.0}
