"""What speaks against a model of cameras."""

from dataclasses import replace

import numpy as np

from kpc.encoder.poses.doubts import confirmed_shares, doubts
from kpc.encoder.poses.structure import Pair, PlacedView, Structure

NAMES = [f"cam{number:02d}" for number in range(30)]


def structure(centres: np.ndarray, pairs: dict[tuple[int, int], Pair] | None = None, apart=()) -> Structure:
    """Return a model of views at some places, (N, 3)."""
    views = {}
    for number, centre in enumerate(centres):
        pose = np.eye(4)
        pose[:3, 3] = centre
        views[number] = PlacedView(pose, (100.0, 100.0, 50.0, 50.0), (0.0,) * 4, 100, 0.2)
    return Structure(views, np.zeros((0, 3)), np.zeros((0, 4)), pairs or {}, apart)


def line(count: int) -> np.ndarray:
    return np.stack([np.arange(count) ** 1.1, np.zeros(count), np.zeros(count)], axis=1)


def test_nothing_speaks_against_a_good_model():
    pairs = {
        (0, 1): Pair(120, 100, 0.98),
        (1, 2): Pair(90, 80, 0.9),
        (0, 2): Pair(20, 6, 0.0),
        (0, 4): Pair(9, 0, None),
    }
    for kind in ("still rig", "moving camera", "photographs"):
        assert doubts(kind, NAMES, structure(line(12), pairs)) == []


def test_matches_that_contradict_the_model_are_named():
    pairs = {
        (0, 1): Pair(120, 100, 1.0),
        (1, 2): Pair(90, 50, 0.3),
        (0, 2): Pair(40, 20, 0.1),
        (0, 3): Pair(30, 30, None),
    }
    model = structure(line(4), pairs)
    assert confirmed_shares(model) == {0: 102 / 120, 1: 115 / 150, 2: 17 / 70}
    (said,) = doubts("still rig", NAMES, model)
    assert said.startswith("matches of cam02 (24%) contradict where these were placed")


def test_views_that_only_fit_each_other_are_named():
    (said,) = doubts("photographs", NAMES, structure(line(4), apart=(7, 8, 9)))
    assert said.startswith("cam07, cam08, cam09 fit each other but not the rest")


def test_pinholes_wider_than_any_lens_are_named():
    model = structure(line(5))
    for focal, is_fisheye, count in ((23.0, False, 1), (24.0, False, 0), (10.0, True, 0)):
        views = model.views | {3: replace(model.views[3], intrinsics=(focal, focal, 50.0, 50.0), is_fisheye=is_fisheye)}
        said = doubts("still rig", NAMES, replace(model, views=views))
        assert len(said) == count
        assert all(one.startswith("cam03 would have a pinhole lens of 131 degrees across") for one in said)


def test_few_points_are_named():
    model = structure(line(5))
    views = {number: replace(view, points=[90, 20, 60, 40, 300][number]) for number, view in model.views.items()}
    (said,) = doubts("still rig", NAMES, replace(model, views=views))
    assert said.startswith("views see few points (20 to 300 each)")
    views = {number: replace(view, points=[90, 20, 160, 140, 300][number]) for number, view in model.views.items()}
    assert doubts("still rig", NAMES, replace(model, views=views)) == []


def test_cameras_at_one_point_are_named_in_a_rig_only():
    centres = line(5)
    centres[3] = centres[1] + 1e-4
    assert doubts("still rig", NAMES, structure(centres)) == ["cam01 and cam03 were placed at one point"]
    assert doubts("photographs", NAMES, structure(centres)) == []


def test_a_jump_of_a_moving_camera_is_named():
    centres = line(24)
    centres[10:] += [0, 40, 0]
    (said,) = doubts("moving camera", NAMES, structure(centres))
    assert said.startswith("the path jumps between cam09 and cam10:")
    assert doubts("photographs", NAMES, structure(centres)) == []


def test_several_moving_cameras_are_named_by_camera():
    names = [*(f"ann/{number:06d}" for number in range(12)), *(f"bob/{number:06d}" for number in range(12)), "still"]
    centres = line(25)
    centres[12:] += [0, 90, 0]  # no jump: another camera
    pairs = {(1, 2): Pair(90, 50, 0.3), (13, 24): Pair(90, 50, 0.1)}
    (said,) = doubts("moving cameras", names, structure(centres, pairs))
    assert said.startswith("matches of 2 of 12 pictures of ann, 1 of 12 pictures of bob, still contradict where")
    centres[6:12] += [0, 40, 0]
    assert doubts("moving cameras", names, structure(centres))[0].startswith(
        "the path jumps between ann/000005 and ann/000006:"
    )
