"""Views that a model holds without reason are dropped from it."""

from dataclasses import replace

import numpy as np
import pytest

from kpc.encoder.poses import find
from kpc.encoder.poses.false_views import without_false_views
from kpc.encoder.poses.structure import ALL, Pair, Pairing, PlacedView, Structure, _pairs


def structure(seen: list[range], confirmed: dict[int, float] | None = None) -> Structure:
    """Return a model of views that see some of the points each, and the pairs of view 0 with others."""
    observations = np.array([(point, view, 1.5, 2.5) for view, own in enumerate(seen) for point in own], np.float64)
    count = max(own.stop for own in seen)
    views = {
        view: PlacedView(np.eye(4), (100.0, 100.0, 50.0, 50.0), (0.0,) * 4, len(own), 0.2)
        for view, own in enumerate(seen)
    }
    pairs = {(0, view): Pair(60, 50, share) for view, share in (confirmed or {}).items()}
    points = np.stack([np.arange(count), np.zeros(count), np.zeros(count)], axis=1).astype(float)
    return Structure(views, points, observations.reshape(-1, 4), pairs)


def test_a_good_model_stays():
    for model in (structure([range(1000)] * 4), structure([range(30)] * 3), structure([range(2000)] * 4 + [range(90)])):
        if len(model.views) == 5:
            model.pairs[0, 4] = Pair(60, 50, 0.9)
        assert without_false_views(model) is model


@pytest.mark.parametrize("points, share", [(0, 0.8), (14, 1.0), (21, 0.31), (21, None)])
def test_a_view_that_sees_next_to_nothing_is_dropped(points, share):
    # Ten points of the false view are seen by view 0 alone besides, and go with it.
    model = structure([range(1010), range(10, 1010), range(10, 1010), range(points)], {1: 0.98, 3: share})
    left = without_false_views(model)
    assert sorted(left.views) == [0, 1, 2] and left.dropped == (3,)
    assert [view.points for view in left.views.values()] == [1000] * 3
    assert len(left.points) == 1000 and left.points[0, 0] == 10
    assert len(left.observations) == 3000 and set(left.observations[:, 1]) == {0, 1, 2}
    assert sorted(set(left.observations[:, 0])) == list(range(1000))
    assert left.pairs == {(0, 1): Pair(60, 50, 0.98), (0, 3): Pair(60, 50, None)}


def test_few_points_are_enough_for_a_picture_whose_matches_confirm_it_if_its_lens_is_possible():
    model = structure([range(1000)] * 4 + [range(34)], {4: 0.9})
    assert without_false_views(model) is model
    assert without_false_views(model, is_rig=True).dropped == (4,)
    model.views[4] = replace(model.views[4], intrinsics=(561112.0, 561112.0, 50.0, 50.0))
    assert without_false_views(model).dropped == (4,)


def test_views_that_see_what_was_dropped_alone_go_with_it():
    model = structure([range(400)] * 3 + [range(398, 410), range(390, 410)], {4: 0.9})
    left = without_false_views(model)
    assert sorted(left.views) == [0, 1, 2] and left.dropped == (3, 4)


def test_nothing_is_left_of_a_model_of_few_points():
    left = without_false_views(structure([range(10)] * 3))
    assert not left.views and left.dropped == (0, 1, 2) and left.error == float("inf")
    assert without_false_views(left) is left


def test_views_are_placed_again_without_a_false_one():
    """A false view may spoil the lens of the others, as in five cameras of room beside one of liam: 204 px for 335."""
    asked: list[Pairing] = []

    def place(pairing: Pairing) -> Structure:
        asked.append(pairing)
        good = [range(1000)] * 3
        return without_false_views(structure(good if pairing.without else [*good, range(40)], {3: 0.9}), is_rig=True)

    found = find._undisturbed(place)
    assert asked == [ALL, Pairing(without=(3,))]
    assert sorted(found.views) == [0, 1, 2] and found.dropped == (3,)
    assert find._rank(found) == (3, -found.error)


def test_a_view_is_not_matched_if_it_is_left_out():
    pictures = [{"view": view, "instant": 0} for view in range(4)]
    assert _pairs(pictures, Pairing(without=(1, 3)), range(4)) == [(0, 2)]
