"""Section 4.7: clips in groups."""

from .common import clamp, require
from .container import SHARED, group_chunks, plain_content, read_chunks, shared_planes_of
from .metadata import decode_metadata
from .scene import decode


def decode_groups(data, is_prefix=False):
    """Return (groups, scenes): [(row_start, row_count, the file of the group)], and the scenes of those that are held.

    None for a file that is a scene."""
    chunks, beside, shared, value_count = group_chunks(data, is_prefix)
    if not chunks:
        return None
    require(len(beside) <= 1, "there are two meta chunks")
    for chunk in beside:
        if chunk.is_whole:
            decode_metadata(plain_content(chunk).data)
    first = [chunk.row_start for chunk in chunks]
    last = [chunk.row_start + chunk.row_count - 1 for chunk in chunks]
    for g in range(len(chunks) - 1):
        require(first[g] < first[g + 1] <= last[g] + 1 and last[g] < last[g + 1], "invalid frames of groups")
    require(all(last[g] < first[g + 2] for g in range(len(chunks) - 2)), "a frame is in three groups")
    require(last[-1] - first[0] + 1 <= 1 << 24, "invalid number of frames")
    planes = [shared_planes_of(chunk.group, shared) for chunk in chunks]
    held = [g for g in range(len(chunks)) if is_held(chunks[g], planes[g])]
    scenes = [decode(chunks[g].stored, shared=planes[g]) for g in held]
    for chunk, scene in zip((chunks[g] for g in held), scenes):
        require(scene["frame_count"] == chunk.row_count and scene["fps"] == scenes[0]["fps"], "invalid clip of a group")
        require(scene["value_count"] <= value_count, "invalid value count of a group")
    return [(chunk.row_start, chunk.row_count, chunk.stored) for chunk in chunks], scenes


def is_held(group, planes):
    """Return whether a group is whole, and the shared planes that it uses are."""
    if not group.is_whole:
        return False
    used = [(chunk.scale, chunk.plane) for chunk in read_chunks(group.stored, False)[0] if chunk.codec == SHARED]
    return all(planes[place].is_whole for place in used if place in planes)


def shown_group(spans, time):
    """Return (number, local time) of the group shown at a time of the clip; spans: (row_start, row_count) of each."""
    first = [start for start, _ in spans]
    last = [start + count - 1 for start, count in spans]
    current = first[0] + time * (last[-1] - first[0])
    g = sum(current >= (last[i - 1] + first[i]) / 2 for i in range(1, len(spans)))
    return g, clamp((current - first[g]) / (last[g] - first[g]), 0.0, 1.0) if last[g] > first[g] else 0.0


def blend(spans, time):
    """Return {number: weight} of the one or two groups that make the picture at a time of the clip."""
    first = [start for start, _ in spans]
    last = [start + count - 1 for start, count in spans]
    current = first[0] + time * (last[-1] - first[0])
    for i in range(1, len(spans)):
        if first[i] < current < last[i - 1]:
            share = (current - first[i]) / (last[i - 1] - first[i])
            return {i - 1: 1 - share, i: share}
    return {shown_group(spans, time)[0]: 1.0}
