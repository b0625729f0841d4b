"""Quantisation that lands where a trade says."""

import math
import pickle
from dataclasses import replace
from functools import partial
from typing import Any

import numpy as np
import pytest

from kpc.encoder.coding import scene_writer
from kpc.encoder.evaluation.validation_rays import Fidelity
from kpc.encoder.rdo import mode_decision
from kpc.encoder.rdo.rate_control import (
    FINEST,
    MIN_SIGNIFICANCE,
    SIGNIFICANCE_EXPONENT,
    Attempt,
    RateController,
    Steps,
    Trade,
    agreement_of,
    choose_decoder_bits,
    mse_of_quality,
    reduce_slots,
    relative_steps,
    scaled,
    significance,
)
from kpc.encoder.rdo.rate_search import MAX_TUNINGS
from kpc.format.coding.quantise import QuantisedScene, quantise_scene, round_decoder
from kpc.format.common.errors import TrainingError
from kpc.format.scene.scene import Scene
from kpc.format.scene.sound import Sound
from scenes import tiny_scene

# Quantised scenes by the arguments that they were made of: the searches of many tests begin with the same steps.
KNOWN: dict[bytes, QuantisedScene] = {}


def quantise_by_cost(*args: Any) -> QuantisedScene:
    """Quantise on the trellis alone, which is quicker, and the same arguments once.

    How modes are chosen is tested in test_mode_decision.py.
    """
    key = pickle.dumps(args)
    if key not in KNOWN:
        KNOWN[key] = mode_decision.quantise_by_cost(*args, block_sides=())
    return KNOWN[key]


controller = partial(RateController, quantise=quantise_by_cost)


def needed(scene: Scene) -> Scene:
    """Return the scene with all cells occupied, so that every texel is looked up."""
    return replace(scene, occupancy=np.ones((1, 2, 2, 2), bool))


def equal(scene: Scene) -> Steps:
    return [{name: np.ones(plane.shape[2]) for name, plane in scale.items()} for scale in scene.scales]


def alike(scene: Scene) -> list[dict[str, np.ndarray]]:
    return [{name: np.ones_like(plane) for name, plane in scale.items()} for scale in scene.scales]


SCENE = needed(tiny_scene())
EQUAL, ALIKE = equal(SCENE), alike(SCENE)


@pytest.fixture(autouse=True)
def few_passes(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("kpc.encoder.rdo.trellis.PASSES", 2)


@pytest.fixture
def steady(monkeypatch: pytest.MonkeyPatch) -> None:
    """A scene whose searches end alike however its numbers are rounded, as processors round differently: with errors
    of 2e-7 in each number eight of eight times, while those of SCENE end elsewhere in three."""
    scene = needed(tiny_scene(resolution=(16, 14, 12)))
    for name, value in (("SCENE", scene), ("EQUAL", equal(scene)), ("ALIKE", alike(scene))):
        monkeypatch.setattr(f"{__name__}.{name}", value)


def measure(scene: Scene) -> Fidelity:
    """Stand in for rendering: an MSE of 1e-3, to which the errors of the planes add."""
    pairs = zip(scene.scales, SCENE.scales, strict=True)
    error = float(np.mean([np.square(ours[n] - theirs[n]).mean() for ours, theirs in pairs for n in ours]))
    return Fidelity(-10 * math.log10(1e-3 + error), 255**2 * error)


def coded(**trade: float) -> Attempt:
    return controller(SCENE, EQUAL, ALIKE, measure, 30.0).meet(Trade(**trade))  # type: ignore[arg-type]


def loss(found: Attempt) -> float:
    return 30.0 - measure(found.quantised.dequantise()).psnr


@pytest.mark.parametrize("most", [0.02, 0.05, 0.15, 0.4, 1.0])
def test_the_loss_stays_just_below_its_limit(most: float) -> None:
    assert 0.9 * most <= loss(coded(max_loss_db=most)) <= most


@pytest.mark.parametrize("psnr", [27.0, 29.0, 29.9])
def test_the_psnr_stays_just_above_its_limit(psnr: float) -> None:
    assert psnr <= 30.0 - loss(coded(psnr_db=psnr)) <= psnr + 0.1 * (30.0 - psnr)


def test_a_psnr_beyond_the_model_means_the_default_loss() -> None:
    assert loss(coded(psnr_db=31.0)) == loss(coded()) == loss(coded(psnr_db=30.0))


def test_no_target_means_the_default_loss() -> None:
    assert Trade().bound == ("max_loss_db", 0.15) and loss(coded()) == loss(coded(max_loss_db=0.15))


@pytest.mark.parametrize("quality", [40, 60, 75, 95])
def test_quality_sets_the_agreement_with_the_uncoded_scene(quality: float) -> None:
    found = coded(quality=quality)
    assert agreement_of(quality) <= found.measured.agreement_db <= agreement_of(quality) + 0.2
    assert mse_of_quality(quality) == pytest.approx(255**2 * 10 ** (-(20 + quality / 3) / 10))


def test_a_better_quality_takes_more_bytes() -> None:
    sizes = [coded(quality=quality).size_bytes for quality in (1, 50, 75, 100)]
    assert sizes == sorted(sizes) and sizes[-1] > 1.3 * sizes[0]


@pytest.mark.parametrize("share", [0.1, 0.5, 0.9])
def test_the_size_stays_just_below_its_limit(share: float) -> None:
    """The tolerance is wide because chunks are few and small here."""
    largest, smallest = (coded(max_loss_db=most).size_bytes for most in (1e-9, 1e9))
    target = int(smallest + share * (largest - smallest))
    found = coded(target_bytes=target)
    assert found.size_bytes == len(scene_writer.encode(found.quantised))
    assert 0.94 * target < found.size_bytes <= target


def test_an_unreachable_size_gives_the_smallest_file() -> None:
    assert coded(target_bytes=10).size_bytes == coded(max_loss_db=1e9).size_bytes


def test_lam_minimises_the_lagrangian_cost() -> None:
    """Nothing on a fine raster of factors is cheaper by more than a little: the least is flat, and where 8 bits become
    too few for the trellis a plane goes back to rounding, which makes the cost jump a little."""
    exponents = np.arange(-10, 2, 0.4)
    raster = [Attempt(quantise_by_cost(SCENE, scaled(EQUAL, 2.0**e)), measure, float(e)) for e in exponents]
    for lam in (0.01, 0.3, 10.0):
        assert coded(lam=lam).cost(lam) <= 1.06 * min(attempt.cost(lam) for attempt in raster)


def test_a_larger_lam_gives_a_smaller_file() -> None:
    sizes = [coded(lam=lam).size_bytes for lam in (0.001, 0.1, 10.0)]
    assert sizes == sorted(sizes, reverse=True) and sizes[0] > sizes[-1]


def test_an_unreachable_loss_gives_the_finest_steps() -> None:
    finest = quantise_by_cost(SCENE, scaled(EQUAL, 2.0**FINEST))
    assert scene_writer.encode(coded(max_loss_db=-1.0).quantised) == scene_writer.encode(finest)


def test_nan_does_not_meet_a_target() -> None:
    seen = []

    def broken(scene: Scene) -> Fidelity:
        seen.append(scene)
        return measure(scene) if len(seen) < 3 else Fidelity(math.nan, math.nan)

    found = controller(SCENE, EQUAL, ALIKE, broken, 30.0).meet(Trade(0.15))
    assert math.isfinite(found.measured.psnr) and found.size_bytes > 0


def test_a_file_is_never_coded_with_finer_steps() -> None:
    whole = quantise_scene(SCENE, scaled(EQUAL, 0.01))
    own = [{name: plane.step.astype(np.float64) for name, plane in scale.items()} for scale in whole.scales]
    size = len(scene_writer.encode(whole))
    for trade in (Trade(quality=100), Trade(target_bytes=size), Trade(max_loss_db=1e-9)):
        judged = controller(whole.dequantise(), own, ALIKE, measure, measure(whole.dequantise()).psnr, whole).meet(
            trade
        )
        assert judged.quantised is whole
    smaller = controller(whole.dequantise(), own, ALIKE, measure, 30.0, whole).meet(Trade(target_bytes=int(0.8 * size)))
    assert 0.7 * size < smaller.size_bytes <= 0.8 * size


@pytest.mark.parametrize(
    ("trade", "most_tried"), [({"lam": 1e-4}, 1), ({"quality": 100}, 1), ({"max_loss_db": 1e-9}, 1), ({"lam": 0.3}, 99)]
)
def test_a_file_that_nothing_betters_is_not_searched_for_long(trade: dict[str, float], most_tried: int) -> None:
    whole = quantise_scene(SCENE, scaled(EQUAL, 0.01))
    own = [{name: plane.step.astype(np.float64) for name, plane in scale.items()} for scale in whole.scales]
    tried: list[QuantisedScene] = []

    def quantise(*words: Any) -> QuantisedScene:
        tried.append(quantise_by_cost(*words))
        return tried[-1]

    psnr = measure(whole.dequantise()).psnr
    judged = controller(
        whole.dequantise(), own, ALIKE, measure, psnr, whole, quantise=quantise, tune=lambda *_: pytest.fail("tuned")
    )
    found = judged.meet(Trade(**trade))  # type: ignore[arg-type]
    assert found.quantised is whole and len(tried) <= most_tried


def test_a_size_that_sound_alone_takes_is_refused_at_once() -> None:
    sound = Sound(1, 312, 960, (bytes(5000),))
    Trade().check_size(sound)
    Trade(target_bytes=6000).check_size(sound)
    Trade(target_bytes=300).check_size(None)
    for target, heard, words in ((5000, sound, "give a larger size, or encode with less sound"), (5, None, "larger")):
        with pytest.raises(TrainingError, match=f"leaves {target:,} bytes .* index and sound alone take .*{words}"):
            Trade(target_bytes=target).check_size(heard)
    with pytest.raises(
        TrainingError, match=r"give a larger size; a [.]kpc file keeps its sound, so encode the dataset"
    ):
        Trade(target_bytes=5000).check_size(sound, is_coded=True)


def test_targets_as_a_loss_in_decibels() -> None:
    assert Trade(max_loss_db=0.3).loss_db(30) == 0.3 and math.isnan(Trade(target_bytes=9).loss_db(30))
    assert Trade(psnr_db=28.5).loss_db(30) == 1.5 and Trade(psnr_db=31).loss_db(30) == 0.15
    as_much_again = 3 * (30 - 20)  # an error as large as the model's own
    assert Trade(quality=as_much_again).loss_db(30) == pytest.approx(10 * math.log10(2))
    assert Trade(lam=2 * math.log(2) * 255**2 * 1e-3).loss_db(30) == pytest.approx(10 * math.log10(2))


def test_significance_is_a_power_of_the_curvature() -> None:
    h = [{name: np.full_like(plane, 4.0**-s) for name, plane in scale.items()} for s, scale in enumerate(SCENE.scales)]
    h[1]["yt"][3, 2, 1] = 64
    significant = significance(h)
    assert significant[1]["yt"][3, 2, 1] == 1 and significant[1]["yt"].dtype == np.float32
    np.testing.assert_allclose(significant[0]["xy"], 64.0**-SIGNIFICANCE_EXPONENT, rtol=1e-5)
    np.testing.assert_allclose(significant[1]["xy"], 256.0**-SIGNIFICANCE_EXPONENT, rtol=1e-5)


def test_steps_follow_the_significance() -> None:
    """Rounding errors cost the same in all channels of nonzero significance."""

    def of(k: int, plane: np.ndarray) -> np.ndarray:
        w = 0.5**k * np.arange(1.0, plane.shape[2] + 1) * np.linspace(0, 2, plane.shape[0])[:, None, None]
        return np.broadcast_to(w, plane.shape).astype(np.float32)

    w = [{n: of(6 * s + k, p) for k, (n, p) in enumerate(scale.items())} for s, scale in enumerate(SCENE.scales)]
    for scale, steps in zip(w, relative_steps(w), strict=True):
        for name, values in scale.items():
            np.testing.assert_allclose(values[1:].mean((0, 1)) * steps[name] ** 2, 1, rtol=1e-5)


def test_channels_without_significance_get_the_coarsest_step() -> None:
    w = [{name: np.where(np.arange(plane.shape[2]) == 2, 0, 1) + np.zeros(plane.shape) for name, plane in scale.items()}
         for scale in SCENE.scales]  # fmt: skip
    for scale in relative_steps(w):
        for step in scale.values():
            assert step[2] == pytest.approx(MIN_SIGNIFICANCE**-0.5) and (np.delete(step, 2) == 1).all()


def test_steps_are_equal_where_nothing_has_significance() -> None:
    nothing = significance([{name: np.zeros_like(plane) for name, plane in scale.items()} for scale in SCENE.scales])
    assert len({float(step) for scale in relative_steps(nothing) for steps in scale.values() for step in steps}) == 1
    assert math.isfinite(controller(SCENE, EQUAL, nothing, measure, 30.0).meet(Trade()).measured.psnr)


@pytest.mark.parametrize("error, common, slots", [(1.0, 100, 1), (1.0, 50, 2), (0.1, 100, 4)])
def test_similar_slots_are_merged(error: float, common: int, slots: int) -> None:
    """Unless the error is too large, or too many cells would be marched: each slot has ten cells of its own."""
    cells = np.zeros((4, 250), bool)
    cells[:, :common] = True
    for k in range(4):
        cells[k, 200 + 10 * k :][:10] = True
    scene = replace(tiny_scene(), occupancy=cells.reshape(4, 5, 5, 10))
    found = reduce_slots(scene, lambda candidate: Fidelity(30.0, 0.5 + 0.3 * (len(candidate.occupancy) < 4)), error)
    assert len(found.occupancy) == slots and (found is scene) == (slots == 4)
    np.testing.assert_array_equal(found.occupancy.any(0), scene.occupancy.any(0))


@pytest.mark.parametrize("error, bits", [(0.0, None), (2.0**-24, 11), (2.0**-15, 7), (2.0**-11, 5), (1.0, 3)])
def test_decoder_weights_get_the_fewest_bits_that_the_error_allows(error: float, bits: int | None) -> None:
    """One array affects pictures; all others get the fewest bits."""
    scene = tiny_scene()

    def measure(candidate: Scene) -> Fidelity:
        exact, rounded = (one.decoder.w1 for one in (scene, candidate))
        return Fidelity(
            30.0, 0.25 + float(np.max(np.abs(rounded - exact)) / 2.0 ** np.frexp(np.abs(exact).max())[1]) ** 2
        )

    found = choose_decoder_bits(scene, measure, error)
    assert found == ({} if bits is None else {"density_weight": 3, "w1": bits, "b1": 3, "w2": 3, "b2": 3})
    rounded = round_decoder(scene.decoder, found)
    for name, few in found.items():
        largest = np.abs(getattr(scene.decoder, name)).max()
        multiples = np.ldexp(getattr(rounded, name), few - int(np.frexp(largest)[1])) if largest else np.zeros(1)
        np.testing.assert_array_equal(multiples, np.rint(multiples))
    assert measure(replace(scene, decoder=rounded)).mse <= 0.25 + error or bits is None


def test_scaled_steps_are_rounded_up() -> None:
    out = scaled([{"xy": np.array([1.0, 2.0, 0.1])}], 0.25)
    assert out[0]["xy"].dtype == np.float32
    np.testing.assert_array_equal(out[0]["xy"][:2], [0.25, 0.5])
    assert 0.025 < out[0]["xy"][2] < 0.025 * (1 + 2**-7)


def tuned_to(factor: float, seen: list[Attempt] | None = None, power: float = 1.0, **trade: float) -> Attempt:
    """Code with a stand-in for fine-tuning, whose errors are those of other steps at the same bytes."""

    def tune(steps: Steps, reached: np.ndarray) -> QuantisedScene:
        made = quantise_by_cost(
            SCENE, [{name: factor * step**power for name, step in scale.items()} for scale in steps], reached
        )
        if seen is not None:
            seen.append(Attempt(made, measure, 0.0))
        return made

    return controller(SCENE, EQUAL, ALIKE, measure, 30.0, tune=tune).meet(Trade(**trade))  # type: ignore[arg-type]


@pytest.mark.parametrize("factor", [0.6, 0.85])
def test_fine_tuned_codings_meet_the_target(steady: None, factor: float) -> None:
    """Within 10 %, after few attempts, whatever fine-tuning gains."""
    for most in (0.05, 0.15, 0.4):
        seen: list[Attempt] = []
        assert 0.9 * most <= loss(tuned_to(factor, seen, max_loss_db=most)) <= most
        assert 1 <= len(seen) <= MAX_TUNINGS
    assert agreement_of(60) <= tuned_to(factor, quality=60).measured.agreement_db <= agreement_of(60) + 0.5
    target = coded(quality=60).size_bytes
    assert 0.9 * target < tuned_to(factor, target_bytes=target).size_bytes <= target


@pytest.mark.parametrize("power", [0.6, 1.6])
def test_errors_with_fine_tuning_may_follow_steps_less_or_more(steady: None, power: float) -> None:
    plain = coded(max_loss_db=0.15)
    seen: list[Attempt] = []
    factor = 0.7 * float(2.0**plain.exponent) ** (1 - power)
    assert 0.9 * 0.15 <= loss(tuned_to(factor, seen, power, max_loss_db=0.15)) <= 0.15
    assert 2 <= len(seen) <= MAX_TUNINGS


def test_harmful_fine_tuning_is_not_used() -> None:
    plain = coded(max_loss_db=0.15)
    assert tuned_to(1e-3, max_loss_db=0.15).size_bytes < 1.1 * plain.size_bytes
    assert loss(tuned_to(1e3, max_loss_db=0.15)) <= 0.15
    assert tuned_to(1e-3, lam=0.3).cost(0.3) <= coded(lam=0.3).cost(0.3)


def test_nothing_is_searched_for_that_fine_tuning_beats_already() -> None:
    """Fine-tuned codings end below the limit whatever their steps, and are small: no search without follows."""
    made: list[str] = []

    def judge(scene: Scene) -> Fidelity:
        return Fidelity(30 - 0.11, 1.0) if scene.step == 7 else measure(scene)

    def quantise(*arguments: object) -> QuantisedScene:
        made.append("plain")
        return quantise_by_cost(*arguments)  # type: ignore[arg-type]

    def tune(steps: Steps, reached: np.ndarray) -> QuantisedScene:
        made.append("tuned")
        return replace(coarse.quantised, step=7.0)

    coarse = coded(max_loss_db=1.1)
    found = controller(SCENE, EQUAL, ALIKE, judge, 30.0, quantise=quantise, tune=tune).meet(Trade(0.15))
    assert found.quantised.step == 7 and "plain" not in made[made.index("tuned") :]


def test_failed_fine_tuning_leaves_the_untuned_coding() -> None:
    def broken(scene: Scene) -> Fidelity:
        return Fidelity(math.nan, math.nan) if scene.step == 7 else measure(scene)

    def tune(steps: Steps, reached: np.ndarray) -> QuantisedScene:
        return replace(quantise_by_cost(SCENE, steps, reached), step=7.0)

    found = controller(SCENE, EQUAL, ALIKE, broken, 30.0, tune=tune).meet(Trade(0.15))
    assert found.quantised.step != 7 and 0.07 < loss(found) <= 0.15
