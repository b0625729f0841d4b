from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from hypothesis.extra import numpy as hnp

from kpc.format.scene.scene import SPACE_PLANES, TIME_PLANES
from kpc.player.atlas import FARTHEST, Layout, TimeRows, empty_distances
from kpc.player.cpu import reference
from kpc.player.gl.shader_constants import decoder_arrays
from scenes import tiny_scene


@pytest.mark.parametrize(("channels", "scales"), [(8, 2), (5, 3), (1, 1)])
def test_the_atlas_holds_every_plane(channels: int, scales: int) -> None:
    scene = tiny_scene(0, channels=channels, scales=scales)
    layout = Layout.of(scene)
    atlas = np.zeros((layout.size[1], layout.size[0], 4), np.float32)
    for block in layout.blocks:
        assert layout.block(block.scale, block.plane) is block
        wide = layout.layers[block.scale] * block.width
        atlas[block.y : block.y + block.height, block.x : block.x + wide] = layout.texels(
            scene.scales[block.scale][block.plane]
        )
    assert layout.layers == (-(-channels // 4),) * scales and atlas.shape == (layout.size[1], layout.size[0], 4)
    claimed = np.zeros(atlas.shape[:2], int)
    for block, (s, name) in zip(
        layout.blocks, [(s, name) for s in range(scales) for name in SPACE_PLANES], strict=True
    ):
        assert (block.scale, block.plane) == (s, name)
        claimed[block.y : block.y + block.height, block.x : block.x + layout.layers[block.scale] * block.width] += 1
        for m in range(channels):
            x = block.x + (m // 4) * block.width
            part = atlas[block.y : block.y + block.height, x : x + block.width, m % 4]
            assert np.array_equal(part, scene.scales[s][name][..., m])
    assert claimed.max() == 1


def test_an_upsampled_layout_has_room_between_texels_along_the_folded_axis() -> None:
    scene = tiny_scene(0)
    coarse, fine = Layout.of(scene), Layout.of(scene, 2)
    for a, b in zip(coarse.blocks, fine.blocks, strict=True):
        widened = a.plane in ("xy", "yz")  # x and y run along columns, z in xz along rows
        assert (b.width, b.height) == ((2 * a.width - 1, a.height) if widened else (a.width, 2 * a.height - 1))


def test_rows_are_the_time_planes_cut() -> None:
    scene = tiny_scene(1, channels=6)
    layout, at = Layout.of(scene), 0.43
    rows = TimeRows(scene, layout).at(at)
    for s, scale in enumerate(scene.scales):
        for axis, name in enumerate(TIME_PLANES):
            size = scale[name].shape[1]
            u = np.linspace(0, 1, size, dtype=np.float32)
            wanted = reference.bilinear(scale[name], u, np.full_like(u, at))
            first = layout.first_line(axis, s)
            got = rows[first : first + layout.layers[s], :size].swapaxes(0, 1).reshape(size, -1)[:, :6]
            assert got == pytest.approx(wanted, abs=1e-6)


def test_upsampled_rows_are_straight_between_those_of_the_scene() -> None:
    rows = TimeRows(scene := tiny_scene(1, channels=6), Layout.of(scene))
    whole, finer = rows.at(0.43), rows.at(0.43, 3)
    assert finer.shape == (len(whole), 3 * (rows.width - 1) + 1, 4) and np.array_equal(finer[:, ::3], whole)
    assert finer[:, 4::3] == pytest.approx((2 * whole[:, 1:-1] + whole[:, 2:]) / 3, abs=1e-6)


def test_a_row_of_ones_stays_exactly_one() -> None:
    scene = tiny_scene(1)
    rows = TimeRows(scene, Layout.of(scene)).at(0.777)
    assert np.mean(rows == 1.0) > 0.5


@settings(max_examples=40, deadline=None)
@given(hnp.arrays(bool, st.tuples(*[st.integers(1, 7)] * 3)))
def test_distances_are_those_to_the_nearest_occupied_cell(occupied: np.ndarray) -> None:
    got = empty_distances(occupied)
    cells = np.argwhere(occupied)
    for index in np.ndindex(occupied.shape):
        wanted = np.abs(cells - index).max(axis=1).min() if len(cells) else FARTHEST
        assert got[index] == wanted


def test_decoder_arrays_keep_every_weight() -> None:
    scene = tiny_scene(4, channels=6)
    layout, decoder = Layout.of(scene), scene.decoder
    arrays = decoder_arrays(decoder, scene, layout)
    hidden, groups = len(decoder.b1), layout.features
    place = np.concatenate([layout.first_layers[s] * 4 + np.arange(6) for s in range(2)])
    assert np.array_equal(arrays["density_weight"].ravel()[place], decoder.density_weight)
    assert np.array_equal(arrays["b2"].reshape(3, -1)[:, place], decoder.b2)
    w2 = arrays["w2"].reshape(3, groups, hidden, 4)
    assert np.array_equal(np.moveaxis(w2, 2, 3).reshape(3, groups * 4, hidden)[:, place], decoder.w2)
    w1 = arrays["w1"].reshape(hidden, 12)
    assert np.array_equal(w1[:, :9], decoder.w1) and np.array_equal(w1[:, 9], decoder.b1)
    assert arrays["density_bias"][0, 0] == decoder.density_bias
    assert arrays["w2"].sum() == pytest.approx(decoder.w2.sum(), rel=1e-4)  # the padding is 0
    undirected = replace(decoder, w2=np.zeros_like(decoder.w2))
    assert set(decoder_arrays(undirected, scene, layout)) == {"density_weight", "density_bias", "b2"}
