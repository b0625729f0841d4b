from itertools import pairwise

import numpy as np
import pytest

from kpc.format.container.partial import PartialScene
from kpc.player.streaming.prefetch import Playhead, distances_ahead, fetch_order, min_segment_bytes, segments_to_keep
from partial_scenes import opened
from scenes import tiny_scene


@pytest.fixture(scope="module")
def scene() -> PartialScene:
    """Two scales, 20 rows in segments of 2."""
    return opened(tiny_scene(4, time=20), 2)[0]


def listed(scene: PartialScene, order: np.ndarray) -> list[tuple[int, bool, int]]:
    return [(int(scene.scales[i]), bool(scene.moves[i]), scene.entry(int(scene.numbers[i])).row_start) for i in order]


def test_the_coarse_picture_comes_first_then_finer_ones_then_segments_ahead(scene: PartialScene) -> None:
    order = listed(scene, fetch_order(scene, Playhead(0.5)))
    now = [(False, 0)] * 3 + [(True, 8)] * 3 + [(True, 10)] * 3  # row 9.5 lies between two segments
    coarse, fine, rest = order[:9], order[9:18], order[18:]
    assert coarse == [(0, *place) for place in now] and fine == [(1, *place) for place in now]
    ahead = [(row - 9.5) % 20 for _, _, row in rest]
    assert all(a <= b for a, b in pairwise(ahead)) and all(moves for _, moves, _ in rest)


def test_urgent_segments_precede_a_finer_scale_while_playing(scene: PartialScene) -> None:
    paused, playing = (fetch_order(scene, Playhead(0.5, rate)) for rate in (0.0, 0.3))
    finer = [
        next(k for k, (scale, moves, _) in enumerate(listed(scene, order)) if scale == 1) for order in (paused, playing)
    ]
    assert finer[0] < finer[1]
    soon = {row for scale, moves, row in listed(scene, playing)[: finer[1]] if moves}
    assert max(soon) >= 14 and min(soon) >= 8


def test_segments_of_the_scales_that_are_shown_come_first(scene: PartialScene) -> None:
    order = listed(scene, fetch_order(scene, Playhead(0.5, 0.3), shown=2))
    moving = [place for place in order if place[1]]
    assert moving[:12] == [(scale, True, row) for scale in (0, 1) for row in (8, 8, 8, 10, 10, 10)]


def test_segments_behind_the_playhead_follow_after_the_loop_or_last(scene: PartialScene) -> None:
    first = [
        k for k in range(len(scene.numbers)) if scene.moves[k] and scene.entry(int(scene.numbers[k])).row_start == 0
    ]
    loop, once = (distances_ahead(scene, Playhead(0.9, 0.1, loop)) for loop in (True, False))
    assert np.allclose(loop[first], 0.1) and (once[first] > 2).all()
    before = [
        k for k in range(len(scene.numbers)) if scene.moves[k] and scene.entry(int(scene.numbers[k])).row_start == 12
    ]
    assert (loop[before] > loop[first].max()).all() and (once[before] < once[first].min()).all()


def test_min_segment_bytes_is_the_maximum_over_time(scene: PartialScene) -> None:
    needs = [int(scene.sizes[scene.moves & scene.is_needed(t, t)].sum()) for t in np.linspace(0, 1, 2000)]
    assert min_segment_bytes(scene) == max(needs)


@pytest.mark.parametrize("time", [0.0, 0.33, 0.5, 0.98, 1.0])
def test_the_nearest_segments_are_kept_and_those_needed_now_always_fit(scene: PartialScene, time: float) -> None:
    least, every = min_segment_bytes(scene), int(scene.sizes[scene.moves].sum())
    assert 0 < least < every
    for room in (least, 2 * least, every):
        held = segments_to_keep(scene, Playhead(time, 0.1), room)
        assert held[~scene.moves].all() and held[scene.is_needed(time, time)].all()
        assert scene.sizes[held & scene.moves].sum() <= room
        distance = distances_ahead(scene, Playhead(time, 0.1))
        assert held.all() if room == every else distance[held].max() <= distance[~held].min() + 1e-9


def test_a_static_scene_has_no_segments_of_time_planes() -> None:
    still = opened(tiny_scene(4, dynamic=False))[0]
    assert min_segment_bytes(still) == 0 and segments_to_keep(still, Playhead(), 0).all()
    assert sorted(fetch_order(still, Playhead())) == list(range(6))
