"""Where renderers look scales up."""

import numpy as np
import pytest

from kpc.format.scene.scene import SPACE_PLANES, Scene
from kpc.player.areas import FeatureAreas, may_be_parts
from kpc.player.atlas import Layout
from kpc.player.cpu.reference import SceneAtTime, features
from scenes import tiny_scene, unequal_scales, with_moving_area


def areas_of(scene: Scene, rows_at_once: int = 1000) -> FeatureAreas:
    layout = Layout.of(scene)
    areas = FeatureAreas(scene, layout)
    for scale, planes in enumerate(scene.scales):
        for name in SPACE_PLANES:
            texels = layout.texels(planes[name])
            for first in range(0, len(texels), rows_at_once):
                areas.put(scale, name, texels[first : first + rows_at_once], first)
    return areas


@pytest.mark.parametrize("rows_at_once", [1000, 3])
def test_features_are_zero_outside_their_area_and_not_everywhere_inside(rows_at_once: int) -> None:
    scene = with_moving_area(tiny_scene(4))
    low, high = areas_of(scene, rows_at_once).bounds[1]
    points = np.random.default_rng(0).random((20000, 3)).astype(np.float32)
    own = np.abs(features(scene, SceneAtTime.of(scene, 0.4), points)[:, scene.scales[0]["xy"].shape[2] :]).max(1)
    is_inside = ((points > low) & (points < high)).all(1)
    assert own[~is_inside].max() == 0 and own[is_inside].min() > 0 and 0.05 < is_inside.mean() < 0.6


def test_scales_that_are_made_for_the_box_are_looked_up_everywhere() -> None:
    scene = tiny_scene(4)
    scene.scales[0]["xy"][:, :3] = 0  # by chance
    assert may_be_parts(scene) == may_be_parts(tiny_scene(dynamic=False)) == (False, False)
    assert (areas_of(scene).bounds == [[[-1] * 3, [2] * 3]] * 2).all()


def test_a_scale_whose_planes_have_not_arrived_is_looked_up_nowhere() -> None:
    scene = with_moving_area(tiny_scene(4))
    low, high = FeatureAreas(scene, Layout.of(scene)).bounds[1]
    assert (low > 1).all() and (high < 0).all()


def test_a_part_that_fills_the_box_is_looked_up_everywhere() -> None:
    scene = unequal_scales()
    assert may_be_parts(scene) == (False, True)
    assert (areas_of(scene).bounds[1] == [[-1] * 3, [2] * 3]).all()
