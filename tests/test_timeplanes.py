import numpy as np
import pytest
from scenes import tiny_scene

from kpc.format.file import SceneReader, encode
from kpc.format.partial import PartialScene
from kpc.format.quantise import quantise_scene
from kpc.player import timeplanes
from kpc.player.timeplanes import time_plane_picture, time_planes


@pytest.mark.parametrize("channels", [1, 2, 8])
@pytest.mark.parametrize("plane", ["xt", "yt", "zt"])
def test_what_stands_still_is_grey_and_what_moves_is_not(plane: str, channels: int) -> None:
    scene = tiny_scene(4, channels=channels)
    values = scene.scales[1][plane]
    picture = time_plane_picture(scene, plane, 1).astype(int)
    rows, columns = values.shape[:2]
    assert picture.shape == (columns, rows, 3)
    moves = np.abs(values - 1).max(axis=2).T[::-1] > 0.05  # time to the right, the other axis upwards
    assert moves.any() and not moves.all()
    assert np.abs(picture - 127.5).max(axis=2)[moves].min() > 1
    assert (picture[np.abs(values - 1).max(axis=2).T[::-1] == 0] == 128).all()
    assert picture.min() < 30 and picture.max() > 225  # the range is used


def test_a_plane_that_says_nothing_is_grey() -> None:
    scene = tiny_scene(4)
    scene.scales[0]["xt"][:] = 1
    assert (time_plane_picture(scene, "xt", 0) == 128).all()


def test_many_instants_are_thinned(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(timeplanes, "MOST_ROWS", 5)
    scene = tiny_scene(4, time=40)
    assert time_plane_picture(scene, "zt", 1).shape == (scene.scales[1]["zt"].shape[1], 5, 3)


def test_static_scenes_have_none() -> None:
    assert time_planes(tiny_scene(4, dynamic=False)) == []
    assert ("yt", 1) in time_planes(tiny_scene(4)) and len(time_planes(tiny_scene(4))) == 6


def test_what_has_not_arrived_is_grey() -> None:
    scene = tiny_scene(4)
    data = encode(quantise_scene(scene, [{name: 0.01 for name in scale} for scale in scene.scales]))
    part = PartialScene(SceneReader(data, in_parts=True))
    assert (time_plane_picture(part.scene, "xt", 1) == 128).all()
    part.fetch(part.needed(scales=2, start=0.0, end=1.0))
    assert (time_plane_picture(part.scene, "xt", 1) != 128).any()
