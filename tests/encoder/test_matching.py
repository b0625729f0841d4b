"""Matching of features, and which pictures are matched."""

import numpy as np

from kpc.encoder.poses.matching import FURTHEST, RATIO, alike_pairs, match_pairs, matched, strongest


def descriptors(count: int, seed: int) -> np.ndarray:
    return np.random.default_rng(seed).integers(0, 120, (count, 128), dtype=np.uint8)


def disturbed(features: np.ndarray, seed: int) -> np.ndarray:
    noise = np.random.default_rng(seed).integers(-25, 26, features.shape)
    return np.clip(features.astype(int) + noise, 0, 255).astype(np.uint8)


def angle(one: np.ndarray, two: np.ndarray) -> np.ndarray:
    """Return the angle of each descriptor of `one` with each of `two`, (N, M)."""
    one, two = (x / np.linalg.norm(x, axis=1, keepdims=True) for x in (one.astype(float), two.astype(float)))
    return np.arccos(np.minimum(one @ two.T, 1))


def test_matches_are_mutual_near_and_distinct():
    base = descriptors(60, 0)
    one = np.concatenate([base, descriptors(15, 1)])
    two = np.concatenate([disturbed(base[::-1], 2), descriptors(25, 3), disturbed(base[:5], 4)])  # five ambiguous ones
    angles = angle(one, two)
    expected = []
    for i in range(len(one)):
        j = int(angles[i].argmin())
        others = min(np.delete(angles[i], j).min(), np.delete(angles[:, j], i).min())
        if angles[:, j].argmin() == i and angles[i, j] <= FURTHEST and angles[i, j] <= RATIO * others:
            expected.append((i, j))
    found = [tuple(pair) for pair in matched(one, two).tolist()]
    assert found == expected
    assert len(found) == 55


def test_too_few_features_do_not_match():
    assert matched(descriptors(1, 0), descriptors(9, 0)).shape == (0, 2)
    pairs = dict(match_pairs([descriptors(0, 0), descriptors(9, 0), descriptors(9, 0)], [(0, 1), (1, 2)], threads=2))
    assert [len(found) for found in pairs.values()] == [0, 9]


def test_pictures_are_compared_by_their_largest_features():
    keypoints = np.zeros((400, 6), np.float32)
    keypoints[:, 2] = np.arange(400)  # the larger ones at the end
    features = descriptors(400, 0)
    assert (strongest(keypoints, features)[:3] == features[[399, 398, 397]]).all()


def test_each_picture_is_matched_with_those_most_like_it():
    counts = {(0, 1): 50, (0, 2): 20, (1, 2): 30, (2, 3): 10, (0, 3): 9, (1, 3): 2}
    assert alike_pairs(counts, 1) == [(0, 1), (1, 2), (2, 3)]
    assert alike_pairs(counts, 2) == [(0, 1), (0, 2), (0, 3), (1, 2), (2, 3)]  # (1, 3) matches by chance


def test_pictures_that_look_alike_are_sought_in_each_group():
    counts = {(0, 1): 90, (0, 2): 9, (0, 3): 8, (1, 2): 4, (1, 3): 5, (2, 3): 70}
    assert alike_pairs(counts, 1, [0, 0, 1, 1]) == [(0, 1), (0, 2), (0, 3), (1, 3), (2, 3)]
