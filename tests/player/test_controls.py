import math

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from kpc.format.scene.scene import Clip
from kpc.player.app.controls import FADE_S, SPEEDS, Pace, Playback, View, Wardrobe
from kpc.player.orbit import Rig
from scenes import tiny_scene, varied

SCENE = tiny_scene(0)
RIG = Rig.of(SCENE)


def opening() -> View:
    return View.of(RIG, SCENE.cameras[0])


def project(view: View, point: np.ndarray) -> tuple[float, float]:
    """Where a point is in the picture, in heights of it, from its middle, upwards."""
    camera = view.camera(480, 360)
    x, y, z = camera.camera_to_world[:3, :3].T @ (point - camera.camera_to_world[:3, 3])
    return x / -z * camera.fl_x / 360, y / -z * camera.fl_y / 360


def test_opens_on_exactly_what_the_camera_sees() -> None:
    for camera in SCENE.cameras:
        got = View.of(RIG, camera).camera(camera.width, camera.height)
        assert got.camera_to_world == pytest.approx(camera.camera_to_world, abs=1e-12)
        assert (got.fl_x, got.fl_y, got.cx, got.cy) == (camera.fl_x, camera.fl_y, camera.cx, camera.cy)


@settings(max_examples=50, deadline=None)
@given(st.lists(st.tuples(st.floats(-4, 4), st.floats(-4, 4)), max_size=12))
def test_orbiting_keeps_focus_distance_and_right_way_up(drags: list[tuple[float, float]]) -> None:
    view = opening()
    for drag in drags:
        view = view.orbit(*drag)
    assert view.axes.T @ view.axes == pytest.approx(np.eye(3), abs=1e-9)
    assert np.linalg.norm(view.eye - view.focus) == pytest.approx(opening().distance)
    assert view.axes[:, 1] @ view.up >= -1e-9
    assert project(view, view.focus) == pytest.approx((0.0, 0.0), abs=1e-9)


def test_orbiting_drags_the_near_side_along() -> None:
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


def test_a_still_scene_has_nothing_to_play() -> None:
    playback = Playback(Clip(1, 10.0))
    playback.advance(5.0)
    playback.step(1)
    assert playback.time == 0.0


def test_speeds() -> None:
    playback = Playback(Clip(11, 10.0))
    for _ in range(10):
        playback.faster(1)
    assert playback.speed == SPEEDS[-1]
    playback.faster(-1)
    assert playback.speed == SPEEDS[-2]


@pytest.mark.parametrize(("full_s", "low", "high"), [(1.0, 0.2, 0.32), (0.001, 1.0, 1.0), (100.0, 0.125, 0.15)])
def test_the_pace_settles_where_pictures_come_in_time(full_s: float, low: float, high: float) -> None:
    pace = Pace(budget_s=1 / 15)
    for _ in range(40):
        pace.saw(full_s * pace.scale**2)
    assert low <= pace.scale <= high


def test_appearances_follow_one_another_smoothly_and_end_where_they_began() -> None:
    scene = varied(tiny_scene())
    codes = [np.zeros(16, np.float32), *(appearance.code for appearance in scene.appearances)]
    wardrobe = Wardrobe(scene)
    assert wardrobe.names == ("average", "dawn.jpg", "noon.jpg", "dusk.jpg") and not wardrobe.code.any()
    for number in (1, 2, 3, 0):
        before = wardrobe.code
        wardrobe.next()
        np.testing.assert_allclose(wardrobe.code, before, atol=1e-6)  # nothing jumps
        wardrobe.advance(FADE_S / 2)
        np.testing.assert_allclose(wardrobe.code, (before + codes[number]) / 2, atol=1e-6)
        wardrobe.advance(FADE_S)
        np.testing.assert_allclose(wardrobe.code, codes[number], atol=1e-6)
        assert wardrobe.number == number and wardrobe.progress == 1
    wardrobe.next()
    wardrobe.advance(FADE_S / 4)
    shown = wardrobe.code
    wardrobe.wear(3)  # in the midst of another change
    np.testing.assert_allclose(wardrobe.code, shown, atol=1e-6)
    wardrobe.advance(FADE_S / 4)
    half_way = wardrobe.code
    wardrobe.wear(3)  # where it is going anyway
    np.testing.assert_array_equal(wardrobe.code, half_way)


def test_a_scene_of_one_appearance_knows_no_other() -> None:
    wardrobe = Wardrobe(tiny_scene())
    wardrobe.next()
    wardrobe.advance(1.0)
    assert wardrobe.code is None and wardrobe.number == 0 and wardrobe.names == ("average",)


def test_where_a_clip_will_be_is_where_it_comes_to() -> None:
    playback = Playback(Clip(31, 10.0), time=0.25, speed=2.0)
    later = playback.after(0.5)
    assert playback.time == 0.25 and later.time == pytest.approx(0.25 + 1 / 3) == pytest.approx(
        0.25 + 0.5 * playback.pace
    )
    assert Playback(Clip(31, 10.0), playing=False).pace == 0.0 == Playback(Clip(1, 10.0)).pace


def test_the_pace_asks_for_few_rasters_and_stands_still_in_noise() -> None:
    rng, pace, scales = np.random.default_rng(0), Pace(1 / 15), []
    for _ in range(500):
        pace.saw(0.4 * pace.scale**2 * float(np.exp(rng.normal(0, 0.1))))
        scales.append(pace.scale)
    assert len(set(scales)) <= 5 and sum(a != b for a, b in zip(scales[50:], scales[51:])) <= 25
    pace.saw(100.0)  # an exception
    assert pace.scale > 0.55 * scales[-1]
    assert {round(4 * math.log2(scale), 9) % 1 for scale in scales} == {0.0}


@pytest.mark.parametrize(("fixed_s", "low", "high"), [(0.02, 0.34, 0.43), (0.05, 0.24, 0.5), (0.2, 0.35, 1.0)])
def test_a_raster_gets_no_coarser_than_helps(fixed_s: float, low: float, high: float) -> None:
    rng, pace, scales = np.random.default_rng(0), Pace(1 / 15), []
    for _ in range(300):
        pace.saw((fixed_s + 0.3 * pace.scale**2) * float(np.exp(rng.normal(0, 0.1))))
        scales.append(pace.scale)
    assert low <= np.median(scales[100:]) <= high and np.std(scales[100:]) < 0.2 * high


@pytest.mark.parametrize("whole", [1.0, 3.0, 5.0])
def test_the_pace_is_that_of_pictures_that_follow_one_another(whole: float) -> None:
    """What follows none takes so many times as long: the first on a raster, and one a lap."""
    rng, pace, scales, raster = np.random.default_rng(0), Pace.of(software=True), [], None
    for number in range(600):
        follows = pace.scale == raster and number % 40
        scales.append(raster := pace.scale)
        pace.saw(0.15 * pace.scale**2 * (1.0 if follows else whole) * float(np.exp(rng.normal(0, 0.1))))
    assert 0.55 < min(scales[100:]) and max(scales[100:]) < 0.8  # 1 / 15 s
    assert sum(a != b for a, b in zip(scales[100:], scales[101:])) <= 6


@pytest.mark.parametrize("slow", [2.0, 3.5, 6.0])
@pytest.mark.parametrize("pictures", [3, 5, 8, 12])
def test_a_slow_start_does_not_last(slow: float, pictures: int) -> None:
    """As while a scene is read beside the first pictures."""
    pace, raster = Pace.of(software=True), None
    for number in range(100):
        whole, raster = (1.0 if pace.scale == raster else 3.0), pace.scale
        pace.saw((0.015 + 0.12 * pace.scale**2) * whole * (slow if number < pictures else 1.0))
    assert 0.55 < pace.scale < 0.75


@pytest.mark.parametrize("settled", [1, 2, 5, 50])
def test_slowness_is_met_soon(settled: int) -> None:
    """As where a camera begins to turn, and pictures cannot follow: on a raster that is new as on one that is not."""
    pace = Pace(1 / 15, 0.5)
    for _ in range(settled):
        pace.saw(0.05)
    scales = []
    for _ in range(12):
        pace.saw(0.8 * pace.scale**2)
        scales.append(pace.scale)
    assert scales[0] == pytest.approx(0.5) and scales[2] < 0.49 and scales[-1] < 0.36


def test_a_processor_begins_coarsely() -> None:
    assert Pace.of(software=True).scale < 0.5 and Pace.of(software=False).scale == 1.0
