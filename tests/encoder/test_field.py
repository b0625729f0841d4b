"""The field: where its planes lie, how they are sampled, and that a scene goes in and comes out unchanged."""

import itertools
from dataclasses import replace

import numpy as np
import pytest
import torch

from gradients import bilinear
from kpc.encoder.field.config import PRESETS, TrainConfig
from kpc.encoder.field.field import Field
from kpc.encoder.field.layout import Layout, motion_grid_shape, plan_layout
from kpc.encoder.field.priors import motion_priors
from kpc.encoder.field.sampling import scatter_rows, scatter_rows_sparse
from kpc.format.common.errors import UsageError
from kpc.format.scene.scene import ALL_PLANES, SPACE_PLANES, TIME_PLANES, Clip
from kpc.player.cpu import reference
from scenes import tiny_scene, with_motion

BOX = np.array([[0, 0, 0], [4, 2, 1]], np.float32)


def test_layout_is_gapless_and_in_order() -> None:
    layout = Layout.of(np.array([[8, 6, 4, 3], [16, 12, 8, 3]]), 5)
    assert layout.is_dynamic and layout.features == 10
    end = 0
    for s, name, start, rows, columns in layout.planes():
        axes = dict(zip("xyzt", layout.resolution[s], strict=True))
        assert start == end and (rows, columns) == (axes[name[1]], axes[name[0]])
        end += rows * columns * 5
    assert end == layout.size
    assert [name for _, name, *_ in layout.planes()] == [*ALL_PLANES] * 2


def test_a_static_scene_has_three_planes() -> None:
    layout = Layout.of(np.array([[8, 6, 4, 0]]), 4)
    assert not layout.is_dynamic and layout.size == 4 * (8 * 6 + 8 * 4 + 6 * 4)
    assert [name for _, name, *_ in layout.planes()] == [*SPACE_PLANES]
    assert (layout.table[0, 3:] == -1).all()
    assert set(Field(layout, 4).to_scene(BOX, Clip(1, 30.0), np.ones((1, 2, 2, 2)), np.ones(3), 0.1).scales[0]) == set(
        SPACE_PLANES
    )


def test_resolution_follows_the_box_and_the_clip() -> None:
    config = TrainConfig(resolutions=(32, 64), frames_per_row=2.0)
    np.testing.assert_array_equal(
        plan_layout(config, BOX, Clip(31, 30.0), True).resolution, [[32, 16, 8, 16], [64, 32, 16, 16]]
    )
    assert not plan_layout(config, BOX, Clip(1, 30.0), False).resolution[:, 3].any()
    thin = np.array([[0, 0, 0], [1, 1, 1e-6]], np.float32)
    assert plan_layout(config, thin, Clip(2, 30.0), True).resolution.min() == 2


def test_time_planes_start_as_the_identity_and_a_seed_repeats() -> None:
    layout = Layout.of(np.array([[8, 6, 4, 3]]), 4)
    one, two, other = (Field(layout, 4, torch.Generator().manual_seed(seed)) for seed in (5, 5, 6))
    for name in ALL_PLANES:
        plane = one.plane(0, name)
        assert bool((plane == 1).all()) == (name in TIME_PLANES)
    for parameter, same, different in zip(one.parameters(), two.parameters(), other.parameters(), strict=True):
        assert torch.equal(parameter, same)
        assert parameter is one.b1 or parameter is one.w2 or not torch.equal(parameter, different)


@pytest.mark.parametrize("kind", ["static", "dynamic", "displaced"])
def test_scene_to_field_and_back(kind: str) -> None:
    dynamic = kind != "static"
    scene = tiny_scene(dynamic=dynamic)
    scene = with_motion(scene) if kind == "displaced" else scene
    back = Field.from_scene(scene).to_scene(scene.aabb, scene.clip, scene.occupancy, scene.background, scene.step)
    assert back.parameter_count == scene.parameter_count and back.is_dynamic == dynamic
    for ours, theirs in zip(back.scales, scene.scales, strict=True):
        assert set(ours) == set(theirs)
        for name in theirs:
            np.testing.assert_array_equal(ours[name], theirs[name])
    for name, value in vars(scene.decoder).items():
        np.testing.assert_array_equal(getattr(back.decoder, name), np.float32(value), err_msg=name)
    for name in ("aabb", "occupancy", "background", "step", "clip", "motion"):
        np.testing.assert_array_equal(getattr(back, name), getattr(scene, name))


def test_the_motion_grid_starts_at_zero_with_nearly_cubic_cells() -> None:
    box, clip, config = (
        np.array([[0, 0, 0], [1.2, 0.5, 2.4]]),
        Clip(30, 30.0),
        replace(PRESETS["draft"], motion_cells=6),
    )
    layout = plan_layout(config, box, clip, is_dynamic=True)
    assert motion_grid_shape(config, box, layout) == (15, 7, 2, 4)
    field = Field(layout, 4, motion_shape=(15, 7, 2, 4))
    assert field.motion is not None and not field.motion.any() and field.motion.shape == (15, 7, 2, 4, 3)
    assert motion_grid_shape(replace(config, motion_cells=0), box, layout) is None
    assert motion_grid_shape(config, box, plan_layout(config, box, clip, is_dynamic=False)) is None


def test_motion_priors_ignore_uniform_motion_and_measure_the_rest() -> None:
    config = replace(PRESETS["draft"], motion_smoothness_time=3.0, motion_smoothness_space=0.5)
    field = Field(Layout.of(np.array([[3, 3, 3, 5]]), 2), 4, motion_shape=(5, 4, 3, 3))
    t, z, y, x = torch.meshgrid(*(torch.arange(float(n)) for n in (5, 4, 3, 3)), indexing="ij")
    uniform = torch.stack([2 * t - x, 0.5 * z + y, x + y + z - t], -1)
    with torch.no_grad():
        field.motion.copy_(uniform)
    assert all(value.item() < 1e-9 for value in motion_priors(field, config).values())
    with torch.no_grad():
        field.motion[2, 1, 1, 1, 0] += 1.0  # in time 1 - 2 1; the same along z, but along y and x one difference each
    n = field.motion.numel()
    found = motion_priors(field, config)
    assert found["motion_smoothness_time"].item() == pytest.approx(3.0 * 6 / n, rel=1e-4)
    assert found["motion_smoothness_space"].item() == pytest.approx(0.5 * (5 + 4 + 4) / n, rel=1e-4)


def test_the_scene_is_a_copy() -> None:
    field = Field.from_scene(tiny_scene())
    scene = field.to_scene(BOX, Clip(2, 30.0), np.ones((1, 2, 2, 2)), np.ones(3), 0.1)
    kept = scene.scales[0]["xy"].copy()
    with torch.no_grad():
        field.theta.zero_()
    np.testing.assert_array_equal(scene.scales[0]["xy"], kept)


def test_bilinear_sampling_at_texels_between_them_and_on_the_border() -> None:
    plane = torch.arange(12, dtype=torch.float64).reshape(3, 4, 1)  # value = 4 row + column
    u = torch.tensor([0, 1 / 3, 1, 1, 0.5, 1 / 6], dtype=torch.float64)
    v = torch.tensor([0, 0.5, 1, 0, 0.5, 0.25], dtype=torch.float64)
    expected = 4 * v * 2 + u * 3
    torch.testing.assert_close(bilinear(plane, u, v)[:, 0], expected, rtol=0, atol=1e-12)


def test_bilinear_sampling_clamps_beyond_the_border() -> None:
    plane = torch.arange(12, dtype=torch.float64).reshape(3, 4, 1)
    u, v = torch.tensor([-0.2, 1.2], dtype=torch.float64), torch.tensor([-1.0, 7.0], dtype=torch.float64)
    torch.testing.assert_close(bilinear(plane, u, v)[:, 0], torch.tensor([0, 11], dtype=torch.float64))


def test_bilinear_sampling_equals_the_players() -> None:
    rng = np.random.default_rng(0)
    for rows, columns in ((2, 2), (5, 9)):
        plane, u, v = rng.random((rows, columns, 3), np.float32), rng.random(64, np.float32), rng.random(64, np.float32)
        ours = bilinear(*map(torch.from_numpy, (plane, u, v))).numpy()
        # A position of up to 8 texels is rounded to 2^-21.
        np.testing.assert_allclose(ours, reference.bilinear(plane, u, v), atol=4 * 2.0**-21)


def test_features_multiply_planes_and_concatenate_scales() -> None:
    scene = tiny_scene()
    field = Field.from_scene(scene)
    features = field.features(torch.tensor([[0.0, 1.0, 0.0]]), torch.tensor([1.0]))[0].detach().numpy()
    corners = {"x": 0, "y": -1, "z": 0, "t": -1}
    expected = np.concatenate(
        [
            np.prod([scale[name][corners[name[1]], corners[name[0]]] for name in ALL_PLANES], axis=0)
            for scale in scene.scales
        ]
    )
    np.testing.assert_allclose(features, expected, rtol=6 * 2.0**-23)


@pytest.mark.parametrize(
    "change",
    [
        {"channels": 0},
        {"steps": 0},
        {"rays": -1},
        {"resolutions": ()},
        {"resolutions": (64, 1)},
        {"object_rays": 1.0},
        {"temporal_start": -0.1},
        {"temporal_floor": 1.1},
        {"channel_dropout": -0.1},
        {"channel_dropout": 1.0},
        {"scale_dropout": -0.1},
        {"scale_dropout": 1.0},
        {"appearance": "sometimes"},
        {"appearance": "image", "view_dependent": False},
    ],
)
def test_an_invalid_config_is_refused(change: dict[str, object]) -> None:
    with pytest.raises(UsageError, match=next(iter(change))):
        TrainConfig(**change)  # type: ignore[arg-type]


def test_presets_grow() -> None:
    names = ("draft", "fast", "balanced", "best")
    assert set(names) == set(PRESETS) - {"paper"}
    for smaller, larger in itertools.pairwise(names):
        assert PRESETS[smaller].steps < PRESETS[larger].steps
        assert max(PRESETS[smaller].resolutions) < max(PRESETS[larger].resolutions)


def test_colours_are_those_of_the_basis() -> None:
    field = Field(Layout.of(np.array([[4, 3, 2, 3]]), 5), 6, torch.Generator().manual_seed(0)).double()
    with torch.no_grad():
        field.w2.normal_()
    latent, directions = torch.randn(40, 5).double(), torch.nn.functional.normalize(torch.randn(7, 3).double(), dim=1)
    ray = torch.arange(40) % 7
    wanted = torch.sigmoid(torch.einsum("nf,ncf->nc", latent, field.basis(directions)[ray]))
    torch.testing.assert_close(field.colours(latent, field.ray_terms(directions), ray), wanted)


def test_sparse_and_dense_scattering_agree() -> None:
    values, rows, shares = torch.randn(500, 8), torch.randint(0, 60, (500, 4)), torch.rand(500, 4)
    rows[rows == 7] = 8  # to one goes nothing
    torch.testing.assert_close(scatter_rows_sparse(values, rows, shares, 60), scatter_rows(values, rows, shares, 60))
