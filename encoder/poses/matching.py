"""Which pictures are matched, and the matching of their features."""

from collections.abc import Iterator, Sequence
from concurrent.futures import ThreadPoolExecutor

import numpy as np

# The largest angle between descriptors that match, in radians, and its largest ratio to the angle of the next.
FURTHEST, RATIO = 0.7, 0.8

# Features by which pictures are compared before they are matched: those of the largest scales.
STRONGEST = 300
# Pictures may look alike if so many of these match.
LEAST_ALIKE = 4


def matched(one: np.ndarray, two: np.ndarray) -> np.ndarray:
    """Return (M, 2) uint32 numbers of features that are each other's nearest, and much nearer than the second.

    As in COLMAP, whose own matcher takes ten times as long on a processor: angles between descriptors at most FURTHEST,
    and at most RATIO of that to the second nearest (Lowe, IJCV 2004, section 7.1).

    Args:
        one, two: (N, 128) uint8 descriptors.
    """
    if min(len(one), len(two)) < 2:
        return np.zeros((0, 2), np.uint32)
    cosines = _unit(one) @ _unit(two).T  # (N, M) float32
    partners = cosines.argmax(1)
    first = cosines[np.arange(len(one)), partners]
    mutual = np.flatnonzero(first == cosines.max(0)[partners])
    partners, first = partners[mutual], first[mutual]
    cosines[mutual, partners] = -1
    others = np.maximum(cosines.max(1)[mutual], cosines.max(0)[partners])
    angles = np.arccos(np.minimum(first, 1))
    good = (angles <= FURTHEST) & (angles <= RATIO * np.arccos(np.minimum(others, 1)))
    return np.stack([mutual[good], partners[good]], axis=1).astype(np.uint32)


def _unit(descriptors: np.ndarray) -> np.ndarray:
    found = descriptors.astype(np.float32)
    found /= np.maximum(np.linalg.norm(found, axis=1, keepdims=True), 1e-6)
    return found


def match_pairs(
    features: Sequence[np.ndarray], pairs: Sequence[tuple[int, int]], threads: int
) -> Iterator[tuple[tuple[int, int], np.ndarray]]:
    """Yield each pair of pictures with what `matched` finds."""
    with ThreadPoolExecutor(threads) as pool:
        yield from zip(pairs, pool.map(lambda pair: matched(features[pair[0]], features[pair[1]]), pairs), strict=True)


def strongest(keypoints: np.ndarray, descriptors: np.ndarray) -> np.ndarray:
    """Return the descriptors of the STRONGEST features of largest scale.

    Args:
        keypoints: (N, 6) float32: x y, and the 2 x 2 matrix from the feature's own unit square to pixels.
        descriptors: (N, 128) uint8.
    """
    sizes = np.hypot(keypoints[:, 2], keypoints[:, 4])
    return descriptors[np.argsort(-sizes, kind="stable")[:STRONGEST]]


def alike_pairs(
    counts: dict[tuple[int, int], int], wanted: int, groups: Sequence[int] | None = None
) -> list[tuple[int, int]]:
    """Choose for each picture those that look most like it, by how many of their strongest features match.

    As in Wu, "Towards linear-time incremental structure from motion", 3DV 2013, section 3.

    Args:
        counts: matches of pairs of pictures.
        wanted: pictures for each one, at most, in each group.
        groups: of each picture; None if there is one group.
    """
    partners: dict[tuple[int, int], list[tuple[int, tuple[int, int]]]] = {}
    for pair, count in counts.items():
        if count >= LEAST_ALIKE:
            for picture, other in (pair, pair[::-1]):
                group = 0 if groups is None else groups[other]
                partners.setdefault((picture, group), []).append((-count, pair))
    return sorted({pair for found in partners.values() for _, pair in sorted(found)[:wanted]})
