"""Pruning (`kpc.encoder.rdo.prune`): redundant channels go, needed ones stay, and the reported loss is right."""

import math
from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest

from kpc.encoder.coding import scene_writer
from kpc.encoder.evaluation.evaluate import SceneRenderer, pad_channels
from kpc.encoder.evaluation.validation_rays import ValidationRays
from kpc.encoder.rdo import codec_model
from kpc.encoder.rdo.codec_model import Model, Selection, code, model_from_file
from kpc.encoder.rdo.prune import (
    SurfaceFeatures,
    elimination_order,
    keep_channels,
    make_view_independent,
    max_renderings,
    prune,
    redistribute,
)
from kpc.encoder.rdo.rate_control import Trade
from kpc.format.coding.quantise import quantise_scene
from kpc.format.container import scene_io
from kpc.format.scene.scene import Decoder, Scene
from kpc.player.cpu import reference
from scenes import VARIANTS, tiny_scene, with_appearances

pytestmark = pytest.mark.usefixtures("one_thread")
SPARE = 0.05


@pytest.fixture(autouse=True)
def whole_searches(quick_coding: None, monkeypatch: pytest.MonkeyPatch) -> None:
    """Search until the target is met, which these tests check, with enough rays for that."""
    monkeypatch.setattr("kpc.encoder.rdo.rate_search.MAX_ATTEMPTS", 16)
    monkeypatch.setattr("kpc.encoder.rdo.codec_model.TOLERANCE", 0.02)
    monkeypatch.setattr("kpc.encoder.rdo.curvature.RAYS", 1 << 13)
    for name in ("RAYS", "FEWER_RAYS"):
        monkeypatch.setattr(f"kpc.encoder.rdo.occupancy_rdo.{name}", 1 << 18)


Rays = tuple[np.ndarray, np.ndarray, np.ndarray]


def rays_of(scene: Scene) -> Rays:
    origins, directions = (
        np.concatenate(parts) for parts in zip(*(camera.rays() for camera in scene.cameras), strict=True)
    )
    times = np.random.default_rng(4).random(len(origins), np.float32)
    return origins.astype(np.float32), directions.astype(np.float32), times


class Fidelity:
    """PSNR of a scene against another's pictures with a little noise; counts its calls."""

    def __init__(self, truth: Scene, rays: Rays) -> None:
        self.rays, self.asked = rays, 0
        shown = SceneRenderer(truth).rgb(*rays)
        self.truth = shown + 0.03 * np.random.default_rng(1).normal(size=shown.shape).astype(np.float32)

    def __call__(self, scene: Scene) -> float:
        self.asked += 1
        return -10 * math.log10(float(np.square(SceneRenderer(scene).rgb(*self.rays) - self.truth).mean()))


def redundant(scene: Scene, channel: int = 2) -> Scene:
    """Return the scene with a channel of its finest scale replaced by half of another one, which makes it redundant."""
    finest = {name: plane.copy() for name, plane in scene.scales[-1].items()}
    for name, plane in finest.items():
        plane[..., channel] = plane[..., channel + 1] * (0.5 if name == "xy" else 1)
    return replace(scene, scales=(*scene.scales[:-1], finest))


def mute(scene: Scene, features: list[int]) -> Scene:
    """Return the scene with decoder weights of 0 for some features."""
    d = scene.decoder
    weights = [a.copy() for a in (d.density_weight, d.w2, d.b2)]
    for a in (weights[0], weights[1].swapaxes(0, 1), weights[2].T):
        a[features] = 0
    return replace(scene, decoder=replace(d, density_weight=weights[0], w2=weights[1], b2=weights[2]))


def directed(scene: Scene, strength: float) -> Scene:
    return replace(scene, decoder=replace(scene.decoder, w2=strength * scene.decoder.w2))


@pytest.mark.parametrize("kind", ["static", *(space for space in VARIANTS if space != "hybrid")])
def test_a_redundant_channel_is_removed_without_loss(kind: str) -> None:
    scene = redundant(VARIANTS.get(kind, lambda scene: scene)(tiny_scene(dynamic=kind != "static")))
    rays = rays_of(scene)
    if kind == "ndc":
        path = scene.mapping.rays(rays[0], rays[1])  # as `datasets.rays` gives them
        rays = path.origins, path.directions, rays[2]
    before, fidelity = SceneRenderer(scene).rgb(*rays), Fidelity(scene, rays)
    pruned = prune(scene, rays, fidelity, SPARE)
    assert [len(kept) for kept in pruned.kept] == [8, 7] and len({2, 3} & set(pruned.kept[1])) == 1
    assert abs(pruned.loss_db) < 0.01 and pruned.next_loss_db > SPARE
    np.testing.assert_allclose(SceneRenderer(pruned.scene).rgb(*rays), before, atol=0.01)


def test_needed_channels_stay_unchanged() -> None:
    scene = tiny_scene()
    pruned = prune(scene, rays_of(scene), Fidelity(scene, rays_of(scene)), 1e-4)
    assert (
        pruned.loss_db == 0
        and pruned.next_loss_db > 1e-4
        and pruned.view_gain_db is not None
        and pruned.view_gain_db > 1e-4
    )
    for ours, theirs in zip(pruned.scene.scales, scene.scales, strict=True):
        assert all(np.array_equal(ours[name], theirs[name]) for name in theirs)
    decoders = zip(vars(pruned.scene.decoder).values(), vars(scene.decoder).values(), strict=True)
    assert all(np.array_equal(a, b) for a, b in decoders)


def test_an_unused_scale_is_removed() -> None:
    scene = mute(tiny_scene(scales=3), [*range(8, 16), 20])
    pruned = prune(scene, rays_of(scene), Fidelity(scene, rays_of(scene)), 1e-4)
    assert [len(kept) for kept in pruned.kept] == [8, 0, 7] and len(pruned.scene.scales) == 2
    assert pruned.scene.scales[1]["xy"].shape == (20, 24, 7) and pruned.scene.decoder.b2.shape == (3, 15)


def test_one_channel_is_always_kept() -> None:
    scene = tiny_scene()
    pruned = prune(scene, rays_of(scene), Fidelity(scene, rays_of(scene)), 1e3)
    assert (
        sum(len(kept) for kept in pruned.kept) == 1
        and len(pruned.scene.scales) == 1
        and pruned.next_loss_db == math.inf
    )


@pytest.mark.parametrize("spare", [0.0, 0.3, 2.0])
def test_the_reported_loss_is_that_of_pictures(spare: float) -> None:
    scene = tiny_scene()
    fidelity = Fidelity(scene, rays_of(scene))
    before = fidelity(scene)
    fidelity.asked = 0
    pruned = prune(scene, rays_of(scene), fidelity, spare)
    assert fidelity.asked <= max_renderings(16)
    assert pruned.loss_db <= spare < pruned.next_loss_db
    assert before - fidelity(pruned.scene) == pytest.approx(pruned.loss_db, abs=1e-3)


def test_pruning_and_quantisation_together_stay_within_the_limit(rounded: None) -> None:
    scene = redundant(directed(tiny_scene(scales=3, resolution=(48, 40, 32)), 0.03))
    rays = rays_of(scene)
    numbers = [{name: np.arange(1.0, 9.0) for name in scale} for scale in scene.scales]
    model = Model(scene, ValidationRays(*rays, None, Fidelity(scene, rays).truth))
    coded = code(model, Trade(max_loss_db=0.15), SPARE / 0.15, 0)
    assert coded.pruned is not None and coded.spare_db == pytest.approx(SPARE) and coded.pruned.removed_any
    kept = coded.pruned.kept[1]
    assert [step.tolist() for step in coded.pruned.select_channels(numbers)[1].values()] == [(kept + 1.0).tolist()] * 6
    pairs = [{name: np.arange(64.0).reshape(1, 1, 8, 8) for name in scale} for scale in scene.scales]
    for found in coded.pruned.select_channels(pairs, in_pairs=True)[1].values():
        np.testing.assert_array_equal(found[0, 0], 8.0 * kept[:, None] + kept)
    # So small a scene's loss leaps by a quarter from one step to the next: how near it comes depends on the
    # processor's rounding.
    assert (SPARE + 0.15) / 2 < coded.loss_db <= 0.15 and coded.size_bytes == len(scene_writer.encode(coded.scene))
    fidelity = Fidelity(scene, rays)
    assert fidelity(scene) - fidelity(coded.scene.dequantise()) == pytest.approx(coded.loss_db, abs=1e-3)


def test_for_a_target_size_pruning_takes_a_share_of_its_loss(rounded: None) -> None:
    """The loss is that with pruning, not that of the unpruned model."""
    scene = redundant(directed(tiny_scene(scales=3, resolution=(48, 40, 32)), 0.03))
    rays = rays_of(scene)
    model = Model(scene, ValidationRays(*rays, None, Fidelity(scene, rays).truth))
    coded = code(model, Trade(target_bytes=5_500), 0.1, 0)
    assert coded.spare_db < 4 * 0.1 * coded.loss_db  # else ten times that


def test_what_meets_a_target_size_is_not_given_up_for_less_pruning(monkeypatch: pytest.MonkeyPatch) -> None:
    """What is pruned costs next to nothing, and for next to nothing not enough would be pruned."""
    scene = tiny_scene()
    rays = rays_of(scene)
    model = Model(scene, ValidationRays(*rays, None, Fidelity(scene, rays).truth))

    def meet(self: codec_model._Coder, chosen: Selection, *_: object) -> SimpleNamespace:
        lost, size = (0.0, 900) if chosen.spare_db else (2.0, 2000)
        return SimpleNamespace(size_bytes=size, measured=SimpleNamespace(psnr=self.uncoded_psnr - lost))

    monkeypatch.setattr(codec_model._Coder, "meet", meet)
    monkeypatch.setattr(codec_model._Coder, "_reduce", lambda self, whole, loss_db: replace(whole, spare_db=loss_db))
    chosen = codec_model._Coder(model, Trade(target_bytes=1000), 0.1, 0, None, True).select()
    assert chosen.spare_db == pytest.approx(2.0)


@pytest.mark.parametrize("strength, goes", [(0.02, True), (3.0, False)])
def test_view_dependence_is_removed_where_it_gains_little(strength: float, goes: bool) -> None:
    scene = directed(tiny_scene(), strength)
    pruned = prune(scene, rays_of(scene), Fidelity(scene, rays_of(scene)), SPARE)
    assert pruned.view_gain_db is not None and (pruned.view_gain_db <= SPARE) == goes
    assert pruned.scene.decoder.w2.any() != goes


def test_view_independent_colour_has_no_direction_weights() -> None:
    scene = directed(tiny_scene(), 0.0)
    pruned = prune(scene, rays_of(scene), Fidelity(scene, rays_of(scene)), SPARE)
    assert pruned.view_gain_db is None and pruned.scene.decoder.w1.shape == (1, 9)
    np.testing.assert_array_equal(make_view_independent(scene, rays_of(scene)[1]).decoder.b2, scene.decoder.b2)


def test_the_mean_basis_is_over_the_directions_of_rays() -> None:
    scene = tiny_scene()
    directions = rays_of(scene)[1]
    plain = make_view_independent(scene, directions)
    assert not plain.decoder.w2.any()
    expected = reference.direction_basis(scene.decoder, directions, np.zeros(16, np.float32)).mean(0)
    np.testing.assert_allclose(plain.decoder.b2, expected, atol=1e-5)
    seen = reference.direction_basis(plain.decoder, directions[:3], np.zeros(1, np.float32))
    np.testing.assert_allclose(seen, np.stack([expected] * 3), atol=1e-5)


def test_view_independent_colour_takes_few_bytes() -> None:
    """The decoder's chunk then has 7 values per feature, 10 zeros and a head."""
    scene = tiny_scene()
    plain = make_view_independent(scene, rays_of(scene)[1])
    steps = [dict.fromkeys(scale, 0.05) for scale in scene.scales]
    stored = []
    for each in (scene, plain):
        reader = scene_io.SceneReader(scene_writer.encode(quantise_scene(each, steps)))
        (deco,) = [entry for entry in reader.index if entry.kind == "DECO"]
        stored.append((deco.raw_length, deco.stored_length))
    assert stored[1][0] == 8 + 2 * (7 * 16 + 10) < 0.15 * stored[0][0] and stored[1][1] <= stored[1][0]


def test_redistribution_is_least_squares() -> None:
    """No other shares leave a smaller error of colour and density."""
    scene = tiny_scene()
    seen, gone = SurfaceFeatures.sample(scene, rays_of(scene)), np.array([3, 9])
    left = np.setdiff1d(np.arange(16), gone)
    after = redistribute(scene.decoder, seen, gone)
    colour = scene.decoder.b2[:, gone].astype(float)
    best = np.linalg.lstsq(seen.features[:, left], seen.features[:, gone] @ colour.T, rcond=None)[0]
    np.testing.assert_allclose(after.b2[:, left] - scene.decoder.b2[:, left], best.T, atol=2e-2)
    with_constant = np.concatenate([seen.all_features[:, left], np.ones((len(seen.all_features), 1))], axis=1)
    target = seen.all_features[:, gone] @ scene.decoder.density_weight[gone]
    least = np.square(with_constant @ np.linalg.lstsq(with_constant, target, rcond=None)[0] - target).mean()
    before = scene.decoder
    change = (
        seen.all_features @ (after.density_weight - before.density_weight) + after.density_bias - before.density_bias
    )
    assert np.square(change).mean() == pytest.approx(least, rel=1e-2)
    assert not after.density_weight[gone].any() and not after.b2[:, gone].any() and not after.w2[:, gone].any()


def test_elimination_order_follows_the_loss_of_a_linear_map() -> None:
    """The independent feature of least weight goes first if all are of equal size; a duplicate goes before all."""
    rng = np.random.default_rng(3)
    features = rng.normal(size=(4096, 5))
    features[:, 4] = features[:, 3]
    weight = np.array([0.5, 0.1, 1.0, 2.0, 2.0], np.float32)
    basis = np.stack([weight.astype(float)] * 3)[None].repeat(4096, 0)
    decoder = Decoder(weight, 0.0, np.zeros((1, 9)), np.zeros(1), np.zeros((3, 5, 1)), basis[0].astype(np.float32))
    order = elimination_order(decoder, SurfaceFeatures(features, basis, features))
    assert order[0] in (3, 4) and order[1:].tolist() == [1, 0, 2]


def test_all_renderers_agree_on_unequal_numbers_of_channels() -> None:
    """The encoder's renderer, the reference, and the scene as read from a file."""
    scene = keep_channels(tiny_scene(), (np.array([0, 5, 6]), np.arange(8)))
    camera = scene.cameras[0]
    origins, directions = camera.rays()
    times = np.full(len(origins), 0.5, np.float32)
    ours = SceneRenderer(scene).rgb(origins, directions, times)
    theirs = reference.render(scene, camera, 0.5).rgb.reshape(-1, 3)
    assert np.quantile(np.abs(ours - theirs), 0.99) < 2 / 255
    even = pad_channels(scene)
    np.testing.assert_allclose(reference.render(even, camera, 0.5).rgb.reshape(-1, 3), theirs, atol=1e-5)
    quantised = quantise_scene(scene, [dict.fromkeys(scale, 0.02) for scale in scene.scales])
    again = scene_io.read(scene_writer.encode(quantised)).dequantise()
    assert [scale["xy"].shape[2] for scale in again.scales] == [3, 8] and again.parameter_count == scene.parameter_count


def test_the_direction_mlp_stays_where_appearances_use_it() -> None:
    scene = with_appearances(tiny_scene())
    rays = rays_of(scene)
    pruned = prune(scene, rays, lambda candidate: 30.0, 1.0)  # whatever goes costs nothing
    assert pruned.view_gain_db is None and pruned.scene.decoder.w2.any()
    assert pruned.scene.appearances == scene.appearances and len(pruned.scene.decoder.b1) == len(
        scene.appearances[0].code
    )


@pytest.mark.parametrize("quality", [10, 20, 99])
def test_a_pruned_file_is_coded_with_its_own_steps_or_coarser_ones(rounded: None, quality: float) -> None:
    scene = redundant(tiny_scene(scales=3, resolution=(48, 40, 32)))
    own = quantise_scene(scene, [dict.fromkeys(planes, 0.004) for planes in scene.scales])
    coded = code(model_from_file(own), Trade(quality=quality), 0.25, 0)
    assert coded.pruned is not None and coded.pruned.removed_any
    assert coded.size_bytes < len(scene_writer.encode(own))
    if quality < 50:
        assert 0 <= coded.agreement_db - (20 + quality / 3) < 0.5
