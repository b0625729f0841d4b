"""What a player keeps of a scene, and what it fetches next. No threads, no network, no OpenGL.

Segments are fetched in this order:

    first   segments at the playhead, of the scales that are shown already
    0       scale 0, for a first coarse picture: its space planes, and segments of its time planes at the playhead
    1       while the clip plays, segments of scale 0 that will be needed within URGENT_S
    2, 3    the same for scale 1, and so on
    last    all other segments, in the order in which the playhead reaches them

Memory is given to the segments that the playhead reaches first; those behind it are dropped first.
"""

from dataclasses import dataclass

import numpy as np

from kpc.format.container.partial import PartialScene

# Segments that will be needed within so many seconds are fetched before a finer scale.
URGENT_S = 1.0


@dataclass(frozen=True)
class Playhead:
    """The position in a clip, and how it moves.

    Attributes:
        time: in [0, 1] over the clip.
        rate: fraction of the clip that is played per second; 0 while paused.
        loop: whether the clip begins again after its end.
    """

    time: float = 0.0
    rate: float = 0.0
    loop: bool = True


def distances_ahead(scene: PartialScene, head: Playhead) -> np.ndarray:
    """Return how far ahead of the playhead each segment is needed.

    Args:
        scene: the scene, with N segments.
        head: the playhead.

    Returns:
        (N,) fractions of the clip; 0 for segments that are needed now. A segment behind the playhead is reached again
        after the loop; without a loop it is farther than all that are ahead.
    """
    behind = 1 + np.maximum(scene.since, 0) - head.time if head.loop else 2 + head.time - scene.until
    ahead = np.where(scene.since >= head.time, scene.since - head.time, behind)
    return np.where(scene.is_needed(head.time, head.time), 0.0, ahead)


def fetch_order(scene: PartialScene, head: Playhead, shown: int = 0) -> np.ndarray:
    """Return the order in which to fetch segments; see the module.

    Args:
        scene: the scene, with N segments.
        head: the playhead.
        shown: number of scales, from the coarsest on, whose space planes have arrived.

    Returns:
        (N,) positions in the arrays of the scene.
    """
    distance = distances_ahead(scene, head)
    soon = (distance > 0) & (distance < head.rate * URGENT_S)
    stage = np.where(distance == 0, 2 * scene.scales, np.where(soon, 2 * scene.scales + 1, 2 * scene.scales.max() + 2))
    stage[(distance == 0) & (scene.scales < shown)] = -1
    return np.lexsort((scene.numbers, scene.scales, distance, stage))


def segments_to_keep(scene: PartialScene, head: Playhead, available_bytes: int) -> np.ndarray:
    """Return which segments to hold: those of time planes that fit, nearest first, and all space planes.

    Args:
        scene: the scene, with N segments.
        head: the playhead.
        available_bytes: for segments of time planes; space planes are held elsewhere.

    Returns:
        (N,) bool.
    """
    order = np.lexsort((scene.numbers, scene.scales, distances_ahead(scene, head)))
    keep = np.zeros(len(order), bool)
    keep[order] = np.cumsum(np.where(scene.moves, scene.sizes, 0)[order]) <= available_bytes
    return np.asarray(keep | ~scene.moves)


def min_segment_bytes(scene: PartialScene) -> int:
    """Return the bytes of the segments of time planes that are needed at once, at the time that needs most."""
    sizes = scene.sizes[scene.moves]
    times = np.concatenate([scene.since[scene.moves], scene.until[scene.moves]])
    changes = np.concatenate([sizes, -sizes])
    order = np.lexsort((-changes, times))  # at equal times, beginnings count before ends
    return int(changes[order].cumsum().max(initial=0))
