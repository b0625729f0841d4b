import math

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from kpc.format.scene.rig import Rig
from kpc.format.scene.scene import Clip
from kpc.player.app.controls import BLEND_S, SPEEDS, AppearanceSelection, OrbitView, Playback
from scenes import tiny_scene, with_appearances

SCENE = tiny_scene(0)
RIG = Rig.of(SCENE)


def opening() -> OrbitView:
    return OrbitView.of(RIG, SCENE.cameras[0])


def project(view: OrbitView, point: np.ndarray) -> tuple[float, float]:
    """Return a point in the picture, from its centre to the right and upwards, in heights of the picture."""
    camera = view.camera(480, 360)
    x, y, z = camera.camera_to_world[:3, :3].T @ (point - camera.camera_to_world[:3, 3])
    return x / -z * camera.fl_x / 360, y / -z * camera.fl_y / 360


def test_a_view_of_a_camera_is_that_camera() -> None:
    for camera in SCENE.cameras:
        got = OrbitView.of(RIG, camera).camera(camera.width, camera.height)
        assert got.camera_to_world == pytest.approx(camera.camera_to_world, abs=1e-12)
        assert (got.fl_x, got.fl_y, got.cx, got.cy) == (camera.fl_x, camera.fl_y, camera.cx, camera.cy)


def test_a_very_wide_window_shows_no_more_at_its_sides() -> None:
    wide, widest = (opening().camera(width, 720) for width in (1280, 1920))
    assert wide.fl_y / 720 == pytest.approx(SCENE.cameras[0].fl_y / SCENE.cameras[0].height)
    assert widest.fl_x / 1920 == pytest.approx(wide.fl_x / 1280)
    assert (widest.cx - 960, widest.cy - 360) == pytest.approx((1.5 * (wide.cx - 640), 1.5 * (wide.cy - 360)))


@settings(max_examples=50, deadline=None)
@given(st.lists(st.tuples(st.floats(-4, 4), st.floats(-4, 4)), max_size=12))
def test_orbiting_keeps_focus_and_distance_and_stays_upright(drags: list[tuple[float, float]]) -> None:
    view = opening()
    for drag in drags:
        view = view.orbit(*drag)
    assert view.axes.T @ view.axes == pytest.approx(np.eye(3), abs=1e-9)
    assert np.linalg.norm(view.eye - view.focus) == pytest.approx(opening().distance)
    assert view.axes[:, 1] @ view.up >= -1e-9
    assert project(view, view.focus) == pytest.approx((0.0, 0.0), abs=1e-9)


def test_orbiting_moves_the_near_side_with_the_pointer() -> None:
    view = opening()
    near = view.focus + 0.3 * view.axes[:, 2]
    right = project(view.orbit(0.1, 0.0), near)
    up = project(view.orbit(0.0, 0.1), near)
    assert right[0] > 0.005 and abs(right[1]) < right[0]
    assert up[1] > 0.005 and abs(up[0]) < 1e-9


def test_panning_keeps_the_focus_plane_under_the_pointer() -> None:
    view = opening()
    assert project(view.pan(0.2, -0.1), view.focus) == pytest.approx((0.2, -0.1), abs=1e-9)


def test_zooming_and_flying() -> None:
    view = opening()
    assert view.zoom(1).distance == pytest.approx(0.9 * view.distance)
    assert view.zoom(1e6).distance > 0 and math.isfinite(view.zoom(-1e6).distance)
    ahead = view.fly(0.0, 0.0, 0.5)
    assert ahead.eye - view.eye == pytest.approx(-0.5 * view.axes[:, 2])
    assert view.fly(0.2, 0.0, 0.0).eye - view.eye == pytest.approx(0.2 * view.axes[:, 0])


def test_playing_loops_or_stops() -> None:
    clip = Clip(21, 10.0)
    playback = Playback(clip)
    playback.advance(0.5)
    assert playback.time == pytest.approx(0.25)
    playback.speed = 2.0
    playback.advance(1.0)
    assert playback.time == pytest.approx(0.25)  # round once
    playback.loop = False
    playback.advance(100.0)
    assert playback.time == 1.0 and not playback.playing
    playback.toggle()
    assert playback.playing and playback.time == 0.0


def test_stepping_goes_to_whole_frames_and_pauses() -> None:
    playback = Playback(Clip(11, 10.0), time=0.33)
    playback.step(1)
    assert playback.time == pytest.approx(0.4) and not playback.playing
    playback.step(-100)
    assert playback.time == 0.0
    playback.step(100)
    assert playback.time == 1.0


def test_a_static_clip_does_not_play() -> None:
    playback = Playback(Clip(1, 10.0))
    playback.advance(5.0)
    playback.step(1)
    assert playback.time == 0.0


def test_speeds_are_limited_to_the_list() -> None:
    playback = Playback(Clip(11, 10.0))
    for _ in range(10):
        playback.change_speed(1)
    assert playback.speed == SPEEDS[-1]
    playback.change_speed(-1)
    assert playback.speed == SPEEDS[-2]


def test_appearances_are_blended_and_cycle() -> None:
    scene = with_appearances(tiny_scene())
    codes = [np.zeros(16, np.float32), *(appearance.code for appearance in scene.appearances)]
    appearance = AppearanceSelection(scene)
    assert appearance.names == ("average", "dawn.jpg", "noon.jpg", "dusk.jpg") and not appearance.code.any()
    for number in (1, 2, 3, 0):
        before = appearance.code
        appearance.next()
        np.testing.assert_allclose(appearance.code, before, atol=1e-6)  # nothing jumps
        appearance.advance(BLEND_S / 2)
        np.testing.assert_allclose(appearance.code, (before + codes[number]) / 2, atol=1e-6)
        appearance.advance(BLEND_S)
        np.testing.assert_allclose(appearance.code, codes[number], atol=1e-6)
        assert appearance.number == number and appearance.progress == 1
    appearance.next()
    appearance.advance(BLEND_S / 4)
    shown = appearance.code
    appearance.select(3)  # in the midst of another change
    np.testing.assert_allclose(appearance.code, shown, atol=1e-6)
    appearance.advance(BLEND_S / 4)
    half_way = appearance.code
    appearance.select(3)  # where it is going anyway
    np.testing.assert_array_equal(appearance.code, half_way)


def test_a_scene_without_appearances_has_only_the_average() -> None:
    appearance = AppearanceSelection(tiny_scene())
    appearance.next()
    appearance.advance(1.0)
    assert appearance.code is None and appearance.number == 0 and appearance.names == ("average",)


def test_after_gives_the_position_that_advance_reaches() -> None:
    playback = Playback(Clip(31, 10.0), time=0.25, speed=2.0)
    later = playback.after(0.5)
    assert playback.time == 0.25 and later.time == pytest.approx(0.25 + 1 / 3) == pytest.approx(
        0.25 + 0.5 * playback.rate
    )
    assert Playback(Clip(31, 10.0), playing=False).rate == 0.0 == Playback(Clip(1, 10.0)).rate
