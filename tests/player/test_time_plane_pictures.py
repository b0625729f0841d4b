import numpy as np
import pytest

from kpc.encoder.coding.scene_writer import encode
from kpc.format.coding.quantise import quantise_scene
from kpc.format.container.partial import PartialScene
from kpc.format.container.scene_io import SceneReader
from kpc.player.app import time_plane_pictures
from kpc.player.app.time_plane_pictures import moving_part, time_plane_picture, time_planes
from scenes import tiny_scene


@pytest.mark.parametrize("channels", [1, 2, 8])
@pytest.mark.parametrize("plane", ["xt", "yt", "zt"])
def test_static_texels_are_grey_and_moving_ones_are_not(plane: str, channels: int) -> None:
    scene = tiny_scene(4, channels=channels)
    values = scene.scales[1][plane]
    values[:, 0] = 0.3  # constant, if not 1
    picture = time_plane_picture(scene, plane, 1).astype(int)
    rows, columns = values.shape[:2]
    assert picture.shape == (columns, rows, 3)
    deviations = np.abs(values - values.mean(axis=0)).max(axis=2).T[::-1]  # time to the right, the other axis upwards
    moves = np.ptp(values, axis=0).max(axis=1)[::-1] > 0
    assert moves.any() and not moves.all() and not moves[-1]
    assert (picture[~moves] == 128).all() and np.abs(picture - 128).max(axis=2)[deviations > 0.05].min() > 1
    assert picture.min() < 60 and picture.max() > 195  # the range is used


def test_a_constant_plane_is_grey() -> None:
    scene = tiny_scene(4)
    scene.scales[0]["xt"][:] = 1
    assert (time_plane_picture(scene, "xt", 0) == 128).all()


def test_long_planes_are_subsampled(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(time_plane_pictures, "MAX_INSTANTS", 5)
    scene = tiny_scene(4, time=40)
    assert time_plane_picture(scene, "zt", 1).shape == (scene.scales[1]["zt"].shape[1], 5, 3)


def test_static_scenes_have_no_time_planes() -> None:
    assert time_planes(tiny_scene(4, dynamic=False)) == []
    assert ("yt", 1) in time_planes(tiny_scene(4)) and len(time_planes(tiny_scene(4))) == 6


def test_segments_that_have_not_arrived_are_grey() -> None:
    scene = tiny_scene(4)
    data = encode(quantise_scene(scene, [dict.fromkeys(scale, 0.01) for scale in scene.scales]))
    part = PartialScene(SceneReader(data, in_parts=True))
    assert (time_plane_picture(part.scene, "xt", 1) == 128).all()
    part.fetch(part.needed(scales=2, start=0.0, end=1.0))
    assert (time_plane_picture(part.scene, "xt", 1) != 128).any()


def test_the_moving_part_is_found_with_a_margin() -> None:
    picture = np.full((40, 9, 3), 128, np.uint8)
    assert moving_part(picture) == (0.0, 1.0)
    picture[10:20, 4, 1] = 200
    low, high = moving_part(picture)
    assert 0.15 < low < 0.25 and 0.5 < high < 0.6
    picture[30, 4, 1] = 136  # a little elsewhere
    assert moving_part(picture) == (low, high)
    picture[[0, -1]] = 0
    assert moving_part(picture) == (0.0, 1.0)
