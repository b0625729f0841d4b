"""Epipolar lines on pictures of found cameras."""

import numpy as np
import pytest

pytest.importorskip("scipy", reason="needs scipy")

from kpc.encoder.poses.epipolar_lines import LINES, checks, looks, seen_at
from kpc.encoder.poses.structure import PlacedView, Structure
from textured_room import rig

LENS, BARREL = (240.0, 238.0, 128.0, 96.0), (-0.08, 0.01, 0.001, -0.002)


def model(turned: float = 0.0) -> Structure:
    """Return two cameras that see 40 points; the second one is placed wrongly by an angle in radians."""
    views = {n: PlacedView(camera.pose, LENS, BARREL, 40, 0.1) for n, camera in enumerate(rig(3)[:2])}
    points = np.random.default_rng(0).uniform((-0.6, -0.5, 0.2), (0.6, 0.5, 1.2), (40, 3))
    seen = [(number, view, *place) for view in views for number, place in enumerate(seen_at(views[view], points))]
    pose = views[1].camera_to_world.copy()
    c, s = np.cos(turned), np.sin(turned)
    pose[:3, :3] = pose[:3, :3] @ [[c, -s, 0], [s, c, 0], [0, 0, 1]]
    views[1] = PlacedView(pose, LENS, BARREL, 40, 0.1)
    return Structure(views, points, np.array(seen, float), {})


def distance(check) -> float:
    """Return how far a point is from its line, in pixels."""
    a, b, p = check.line[:-1], check.line[1:], np.array(check.place)
    share = np.clip(((p - a) * (b - a)).sum(1) / np.square(b - a).sum(1), 0, 1)
    return float(np.linalg.norm(a + share[:, None] * (b - a) - p, axis=1).min())


@pytest.mark.parametrize("is_fisheye", [False, True])
def test_what_is_seen_at_a_place_lies_where_it_looks(is_fisheye):
    lens, distortion = ((90.0, 91.0, 128.0, 96.0), (0.03, -0.004, 0.001, 0.0002)) if is_fisheye else (LENS, BARREL)
    view = PlacedView(model().views[0].camera_to_world, lens, distortion, 40, 0.1, is_fisheye)
    places = np.random.default_rng(1).uniform((10, 10), (240, 180), (20, 2))
    ahead = view.camera_to_world[:3, 3] + 3.0 * looks(view, *places.T)
    assert seen_at(view, ahead) == pytest.approx(places, abs=1e-6)
    behind = view.camera_to_world[:3, 3] - looks(view, *places.T)
    assert np.isnan(seen_at(view, behind)).all()


def test_lines_go_through_their_points_unless_cameras_are_placed_wrongly():
    for number in (0, 1):
        found = checks(model(), number)
        assert len(found) == LINES
        assert max(map(distance, found)) < 0.05  # chords of a line that the lens bends
        assert max(map(distance, checks(model(turned=0.05), number))) > 1


def test_views_without_common_points_have_no_lines():
    alone = model()
    assert checks(Structure(alone.views, alone.points, alone.observations[:40], {}), 0) == ()
