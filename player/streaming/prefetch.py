"""What a player should hold of a scene, and what it should fetch next: no thread, no network, no OpenGL.

    first  segments at the playhead of the scales that are shown already
    0      scale 0: its space planes, and its time planes' segments at the playhead: the first coarse picture
    1      while it plays, segments of scale 0 that will be needed within URGENT_S
    2, 3   the same of scale 1, and so on: the picture gets finer
    last   all other segments, those first that the playhead comes to first

Held is what the playhead comes to first, as far as memory goes; what lies behind it goes first.
"""

from dataclasses import dataclass

import numpy as np
from kpc.format.container.partial import PartialScene

URGENT_S = 1.0
"""Segments needed so soon come before a finer scale."""


@dataclass(frozen=True)
class Playhead:
    """Where the clip is, and where it goes.

    Attributes:
        time: [0, 1] over the clip.
        rate: of the clip in a second; 0 while it does not play.
        loop: after the end comes the beginning.
    """

    time: float = 0.0
    rate: float = 0.0
    loop: bool = True


def distances_ahead(scene: PartialScene, head: Playhead) -> np.ndarray:
    """(N,) how far ahead of the playhead each segment is needed, of the clip; 0 for what is needed now.

    Behind it, with a loop, that is where it comes around again; without one, farther than all that is ahead.
    """
    behind = 1 + np.maximum(scene.since, 0) - head.time if head.loop else 2 + head.time - scene.until
    ahead = np.where(scene.since >= head.time, scene.since - head.time, behind)
    return np.where(scene.is_needed(head.time, head.time), 0.0, ahead)


def fetch_order(scene: PartialScene, head: Playhead, shown: int = 0) -> np.ndarray:
    """(N,) positions in the scene's arrays, what to fetch first first; of `shown` scales the space planes are all there."""
    distance = distances_ahead(scene, head)
    soon = (distance > 0) & (distance < head.rate * URGENT_S)
    stage = np.where(distance == 0, 2 * scene.scales, np.where(soon, 2 * scene.scales + 1, 2 * scene.scales.max() + 2))
    stage[(distance == 0) & (scene.scales < shown)] = -1
    return np.lexsort((scene.numbers, scene.scales, distance, stage))


def segments_to_keep(scene: PartialScene, head: Playhead, room_bytes: int) -> np.ndarray:
    """(N,) bool: segments of time planes that fit, nearest first. Space planes always do: they lie elsewhere."""
    order = np.lexsort((scene.numbers, scene.scales, distances_ahead(scene, head)))
    held = np.zeros(len(order), bool)
    held[order] = np.cumsum(np.where(scene.moves, scene.sizes, 0)[order]) <= room_bytes
    return np.asarray(held | ~scene.moves)


def min_segment_bytes(scene: PartialScene) -> int:
    """Bytes of the segments that are needed at once, at the time that needs most."""
    sizes = scene.sizes[scene.moves]
    times = np.concatenate([scene.since[scene.moves], scene.until[scene.moves]])
    changes = np.concatenate([sizes, -sizes])
    order = np.lexsort((-changes, times))  # at one time, what begins counts before what ends
    return int(changes[order].cumsum().max(initial=0))
