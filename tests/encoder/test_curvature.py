"""What errors in planes cost, against what they do to pictures."""

from collections.abc import Callable
from dataclasses import replace

import numpy as np
import pytest

from kpc.encoder.evaluation.evaluate import SceneRenderer
from kpc.encoder.evaluation.validation_rays import ValidationRays
from kpc.encoder.field.config import PRESETS
from kpc.encoder.rdo import curvature as module
from kpc.encoder.rdo.curvature import estimate_curvature
from kpc.format.scene.scene import Scene
from scenes import VARIANTS, tiny_scene, with_appearances

KINDS: dict[str, Callable[[Scene], Scene]] = VARIANTS | {
    "still": lambda scene: tiny_scene(3, dynamic=False),
    "appearances": with_appearances,
    "no cameras": lambda scene: replace(scene, cameras=()),
    "fewer channels": lambda scene: without_the_last_channels(scene),
}


def without_the_last_channels(scene: Scene) -> Scene:
    """The features of the coarsest scale come first."""
    left = np.delete(np.arange(16), [6, 7])
    d = scene.decoder
    decoder = replace(d, density_weight=d.density_weight[left], w2=d.w2[:, left], b2=d.b2[:, left])
    return replace(
        scene, decoder=decoder, scales=({n: p[..., :6] for n, p in scene.scales[0].items()}, scene.scales[1])
    )


def validation_rays_of(scene: Scene, count: int) -> ValidationRays:
    validation = ValidationRays.through_occupied(scene, count, seed=1)
    return replace(validation, appearances=np.arange(count) % len(scene.appearances) if scene.appearances else None)


@pytest.mark.parametrize("kind", KINDS)
def test_the_diagonal_predicts_the_effect_of_small_errors(kind: str, monkeypatch: pytest.MonkeyPatch) -> None:
    """Independent errors of variance s^2 move the three colours of a ray by s^2 sum(h) squared, in the mean: of each
    plane by itself, since a large sum would hide a small one."""
    scene = KINDS[kind](tiny_scene(3))
    monkeypatch.setattr(
        module, "RAYS_PER_GRADIENT", 16
    )  # so few rays: hardly any cross terms, that they need not cancel
    validation, rng = validation_rays_of(scene, 1000), np.random.default_rng(0)
    h = estimate_curvature(scene, validation, 1000).diagonal
    renderer = SceneRenderer(scene)
    codes = renderer.codes(validation.appearances)
    before = renderer.rgb(*validation.rays, codes)
    for s, scale in enumerate(scene.scales):
        for name, plane in scale.items():
            assert h[s][name].shape == plane.shape and h[s][name].dtype == np.float32 and (h[s][name] >= 0).all()
            moved = []
            for _ in range(8):
                changed = dict(scale) | {name: plane + rng.normal(0, 1e-3, plane.shape).astype(np.float32)}
                scales = (*scene.scales[:s], changed, *scene.scales[s + 1 :])
                moved.append(
                    np.square(SceneRenderer(replace(scene, scales=scales)).rgb(*validation.rays, codes) - before)
                    .sum(1)
                    .mean()
                )
            assert np.mean(moved) == pytest.approx(1e-6 * h[s][name].sum(), rel=0.3), (s, name)


@pytest.mark.parametrize("kind", ["box", "fewer channels"])
def test_the_correlation_predicts_the_effect_of_errors_in_two_channels(
    kind: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Squared moves of colours by the same errors in both channels, less those by errors of opposite signs, are four
    times what goes together: of the two channels of each plane for which that is most."""
    scene = KINDS[kind](tiny_scene(3))
    monkeypatch.setattr(module, "RAYS_PER_GRADIENT", 16)
    monkeypatch.setattr(module, "BLOCK_SIDE", 1)
    validation, rng = validation_rays_of(scene, 1000), np.random.default_rng(0)
    found = estimate_curvature(scene, validation, 1000)
    before = SceneRenderer(scene).rgb(*validation.rays)
    for s, scale in enumerate(scene.scales):
        for name, plane in scale.items():
            roots, correlation = np.sqrt(found.diagonal[s][name]), found.correlation[s][name]
            assert np.abs(correlation).max() < 1.001 and not np.einsum("abmm->abm", correlation).any()
            np.testing.assert_array_equal(correlation, correlation.swapaxes(2, 3))
            products = np.einsum("abmn,abm,abn->mn", correlation, roots, roots)
            m, n = np.unravel_index(np.abs(products).argmax(), products.shape)
            moved = []
            for _ in range(8):
                error = rng.normal(0, 1e-3, plane.shape[:2]).astype(np.float32)
                for sign in (1, -1):
                    changed = plane.copy()
                    changed[..., m] += error
                    changed[..., n] += sign * error
                    scales = (*scene.scales[:s], dict(scale) | {name: changed}, *scene.scales[s + 1 :])
                    colours = SceneRenderer(replace(scene, scales=scales)).rgb(*validation.rays)
                    moved.append(sign * np.square(colours - before).sum(1).mean())
            assert 2 * np.mean(moved) == pytest.approx(4e-6 * products[m, n], rel=0.35), (s, name)


@pytest.mark.parametrize("rows, columns", [(4, 6), (5, 7), (1, 1)])
def test_channel_products_are_summed_over_blocks(rows: int, columns: int) -> None:
    plane = np.random.default_rng(0).normal(size=(rows, columns, 3)).astype(np.float32)
    sums = module.channel_products(plane)
    assert sums.shape == (-(-rows // 2), -(-columns // 2), 3, 3)
    for y, x in np.ndindex(sums.shape[:2]):
        block = plane[2 * y : 2 * y + 2, 2 * x : 2 * x + 2].reshape(-1, 3)
        np.testing.assert_allclose(sums[y, x], block.T @ block, rtol=1e-4, atol=1e-6)


def test_values_that_no_ray_meets_cost_nothing() -> None:
    scene = tiny_scene(3)
    h = estimate_curvature(
        replace(scene, occupancy=np.zeros_like(scene.occupancy)), validation_rays_of(scene, 100), 100
    )
    assert all(not plane.any() for part in (h.diagonal, h.correlation) for scale in part for plane in scale.values())


def test_values_that_more_rays_meet_cost_more() -> None:
    """Half of the box is empty, so that rays meet the texels of planes along x on one side only."""
    scene = tiny_scene(3)
    occupancy = scene.occupancy.copy()
    occupancy[..., : occupancy.shape[3] // 2] = False
    h = estimate_curvature(replace(scene, occupancy=occupancy), validation_rays_of(scene, 500), 500).diagonal[1]
    for name in ("xy", "xz", "xt"):
        columns = h[name].sum((0, 2))
        assert not columns[: len(columns) // 2 - 2].any() and columns[len(columns) // 2 + 2 : -4].all()


def test_missing_rays_are_drawn_from_the_cameras() -> None:
    """All validation rays miss the scene. Random rays replace them, the same each time."""
    scene = tiny_scene(3)
    blind = replace(validation_rays_of(scene, 64), origins=np.full((64, 3), 50, np.float32))
    once, again = (estimate_curvature(scene, blind, 1000).diagonal for _ in range(2))
    assert once[0]["xy"].any()
    for name in once[1]:
        np.testing.assert_array_equal(once[1][name], again[1][name])


def test_rays_through_empty_space_do_not_count() -> None:
    scene = tiny_scene(3)
    validation = validation_rays_of(scene, 64)
    astray = replace(
        validation,
        origins=np.concatenate([validation.origins, np.full((64, 3), 50, np.float32)]),
        directions=np.tile(validation.directions, (2, 1)),
        times=np.tile(validation.times, 2),
    )
    with_them, without = estimate_curvature(scene, astray, 64), estimate_curvature(scene, validation, 64)
    for name, found in with_them.diagonal[1].items():
        assert found.any() and found.tobytes() == without.diagonal[1][name].tobytes()


def test_less_effort_takes_fewer_rays(monkeypatch: pytest.MonkeyPatch) -> None:
    """Drafts and short runs are coded with a share of the rays."""
    monkeypatch.setattr(module, "RAYS", 800)
    scene = tiny_scene()
    validation = ValidationRays.from_cameras(scene, 300)
    less, few = estimate_curvature(scene, validation, effort=0.25), estimate_curvature(scene, validation, 200)
    for scale, other in zip(less.diagonal, few.diagonal, strict=True):
        assert all(np.array_equal(scale[name], other[name]) for name in scale)
    draft, fast = PRESETS["draft"], PRESETS["fast"]
    assert [draft.coding_effort(steps) for steps in (1, 1500, 6000, 9000)] == [1 / 16, 1 / 4, 1, 1]
    assert [fast.coding_effort(steps) for steps in (1, 250, 1000, 3000)] == [1 / 16, 1 / 4, 1, 1]
