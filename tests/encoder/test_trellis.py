"""Trellis-coded quantisation (`kpc.encoder.rdo.trellis`) and the distortion that it minimises."""

from dataclasses import replace

import numpy as np
import pytest

from kpc.encoder.coding import scene_writer
from kpc.encoder.coding.predictive import ACTIVITIES, encode_symbols, follows_trellis, trellis_transition
from kpc.encoder.coding.segments import segment_bounds
from kpc.encoder.rdo import distortion, trellis
from kpc.encoder.rdo.distortion import NO_CORRELATION
from kpc.encoder.rdo.mode_decision import quantise_by_cost
from kpc.encoder.rdo.trellis import MAGNITUDE_BINS, STATES
from kpc.format.coding.quantise import QuantisedPlane, QuantisedScene, quantise_plane, quantise_scene
from kpc.format.container import scene_io
from kpc.format.container.container import Codec
from kpc.format.container.segments import TRELLIS, WEIGHT_COUNT, side_info_of
from kpc.format.scene.scene import TIME_PLANES, Scene
from scenes import tiny_scene


def noisy(seed: int = 1) -> Scene:
    scene, rng = tiny_scene(seed), np.random.default_rng(seed)
    scales = tuple({name: plane + rng.normal(0, 0.02, plane.shape).astype(np.float32) for name, plane in scale.items()}
                   for scale in scene.scales)  # fmt: skip
    return replace(scene, scales=scales)


def quantised(scene: Scene, step: float) -> QuantisedScene:
    return quantise_scene(scene, [dict.fromkeys(scale, step) for scale in scene.scales])


def trellis_quantised(
    scene: Scene, step: float, significant: list[dict[str, np.ndarray]] | None = None
) -> QuantisedScene:
    steps = [{name: np.full(plane.shape[2], step) for name, plane in scale.items()} for scale in scene.scales]
    return quantise_by_cost(scene, steps, significant=significant, block_sides=())


NO_WEIGHTS = np.zeros((1, WEIGHT_COUNT), np.int8)
FREE = np.zeros((2 * ACTIVITIES, MAGNITUDE_BINS))  # residuals that take no bits


def searched(
    wanted: np.ndarray,
    known: np.ndarray,
    bits: np.ndarray = FREE,
    distortion: np.ndarray | None = None,
    correlation: np.ndarray = NO_CORRELATION,
) -> np.ndarray:
    distortion = np.ones(wanted.shape, np.float32) if distortion is None else distortion
    errors = np.zeros((wanted.shape[0] + 2, wanted.shape[1] + 2, wanted.shape[2]), np.float32)
    problem = trellis.Problem(wanted, distortion, known, len(wanted), TRELLIS, NO_WEIGHTS, bits, correlation)
    symbols, counts = trellis.search(problem, errors)
    assert np.allclose(
        errors[1:-1, 1:-1], np.where(known[..., None], np.sqrt(distortion) * (symbols - wanted), 0), atol=1e-4
    )
    assert counts.sum() == known.sum() * wanted.shape[2]
    assert follows_trellis(symbols, known) and not symbols[~known].any()
    return symbols


def test_without_rate_the_path_has_the_least_squared_error() -> None:
    """Compared with all paths through a short row; texels in between that are not coded keep the errors independent."""
    rng = np.random.default_rng(0)
    for _ in range(20):
        wanted = rng.uniform(-9, 9, 5)
        paths = {(0, ()): 0.0}
        for value in wanted:
            longer = {}
            for (state, path), error in paths.items():
                for symbol in range(-12 + state % 2, 13, 2):
                    longer[trellis_transition(state, symbol), (*path, symbol)] = error + (value - symbol) ** 2
            best = {}  # path of each final state
            for (state, path), error in longer.items():
                if state not in best or error < best[state][1]:
                    best[state] = path, error
            paths = {(state, path): error for state, (path, error) in best.items()}
        spaced = np.zeros((1, 9, 1))
        spaced[0, ::2, 0] = wanted
        symbols = searched(spaced, np.arange(9)[None] % 2 == 0)
        assert np.square(spaced - symbols).sum() == pytest.approx(min(paths.values()))


def apart(rows: int, columns: int) -> np.ndarray:
    """Return texels that are not adjacent to each other."""
    return np.logical_and.outer(np.arange(rows) % 2 == 0, np.arange(columns) % 2 == 0)


def test_the_trellis_has_the_granular_gain_of_8_states() -> None:
    """Uniform quantisation of the same rate has step 2 and errs by 2^2 / 12; the trellis of 8 states gains 1.09 dB."""
    wanted, known = np.random.default_rng(1).uniform(-100, 100, (400, 800, 2)), apart(400, 800)
    error = np.mean(np.square(wanted - searched(wanted, known))[known])
    assert 10 * np.log10(4 / 12 / error) == pytest.approx(1.09, abs=0.04)


def interpolated_error(errors: np.ndarray) -> float:
    """Return the mean square of bilinearly interpolated errors (H, W, M), relative to independent errors."""
    both = errors
    for axis in (0, 1):
        padded = np.pad(both, [(1, 1) if k == axis else (0, 0) for k in range(3)])
        before, after = (np.take(padded, range(k, k + errors.shape[axis]), axis) for k in (0, 2))
        both = both + (before + after) / 4
    return float(np.mean(errors * both))


def test_a_channel_compensates_errors_of_another() -> None:
    """Two channels of which pictures show only the sum, or the difference: their joint error is smaller than with
    independent channels. A correlation of 0 changes nothing."""
    wanted, known = np.random.default_rng(3).uniform(-9, 9, (21, 41, 2)), np.ones((21, 41), bool)
    correlation = np.zeros((11, 21, 2, 2), np.float32)
    apart = searched(wanted, known)
    np.testing.assert_array_equal(searched(wanted, known, correlation=correlation), apart)
    for sign in (1, -1):
        correlation[..., 0, 1] = correlation[..., 1, 0] = sign / distortion.CHANNEL_COUPLING
        errors, errors_apart = (
            symbols - wanted for symbols in (searched(wanted, known, correlation=correlation), apart)
        )
        shown, shown_apart = (interpolated_error(e[..., :1] + sign * e[..., 1:]) for e in (errors, errors_apart))
        assert shown < 0.6 * shown_apart
        np.testing.assert_array_equal(
            errors[..., 0], errors_apart[..., 0]
        )  # the first channel is coded without knowledge of the second


def test_cross_channel_errors_use_the_correlation_of_their_block() -> None:
    errors = np.zeros((7, 8, 3), np.float32)
    errors[1:-1, 1:-1] = np.random.default_rng(1).normal(size=(5, 6, 3))
    correlation = np.random.default_rng(2).normal(size=(3, 3, 3, 3)).astype(np.float32)
    c = np.zeros((7, 8))
    for y, x in np.ndindex(5, 6):
        c[y + 1, x + 1] = distortion.CHANNEL_COUPLING * (correlation[y // 2, x // 2, 1] @ errors[y + 1, x + 1])
    kernel = np.array([distortion.EDGE_COUPLING, 1, distortion.EDGE_COUPLING])
    weights = np.outer(kernel, kernel)
    expected = [[(weights * c[y : y + 3, x : x + 3]).sum() for x in range(6)] for y in range(5)]
    assert distortion.CORNER_COUPLING == distortion.EDGE_COUPLING**2
    np.testing.assert_allclose(distortion.cross_channel_errors(errors, correlation, 1), expected, rtol=1e-4, atol=1e-5)


def test_interpolated_error_matches_bilinear_look_ups() -> None:
    rng = np.random.default_rng(7)
    errors, (u, v) = rng.normal(size=(60, 80, 1)).cumsum(1), rng.random((2, 200_000))
    errors -= errors.mean()
    row, column = rng.integers(0, 59, u.size), rng.integers(0, 79, u.size)
    corners = [
        errors[row + i, column + j, 0] * (v if i else 1 - v) * (u if j else 1 - u) for i in (0, 1) for j in (0, 1)
    ]
    assert interpolated_error(errors) == pytest.approx(np.mean(np.square(sum(corners))) * 9 / 4, rel=0.05)


def test_neighbouring_errors_compensate_each_other() -> None:
    """Interpolated, they are half a decibel smaller than independent errors, though each is larger."""
    rng = np.random.default_rng(6)
    wanted, known = rng.uniform(-100, 100, (100, 120, 2)), np.ones((100, 120), bool)
    errors = searched(wanted, known) - wanted
    alone = 4 / 12 * 10**-0.109
    assert np.mean(np.square(errors)) > alone and 10 * np.log10(alone / interpolated_error(errors)) > 0.4


def test_transitions_form_an_8_state_trellis() -> None:
    steps = {
        state: [trellis_transition(state, symbol) for symbol in (state % 2, state % 2 + 2)] for state in range(STATES)
    }
    assert all(a != b for a, b in steps.values())
    came = [to for pair in steps.values() for to in pair]
    assert sorted(came) == sorted(2 * list(range(STATES)))  # two ways into each
    assert trellis_transition(0, 0) == trellis_transition(0, -4) == 0 and trellis_transition(
        0, -2
    ) == trellis_transition(0, 2)


def test_rate_favours_small_residuals() -> None:
    rng = np.random.default_rng(2)
    wanted, known = rng.normal(0, 2, (30, 40, 2)), rng.random((30, 40)) < 0.8
    dear = np.broadcast_to(10.0 * np.arange(MAGNITUDE_BINS), FREE.shape).copy()
    free, bought = searched(wanted, known), searched(wanted, known, dear)
    assert np.abs(bought).sum() < 0.9 * np.abs(free).sum()
    assert np.square(wanted - bought)[known].sum() > np.square(wanted - free)[known].sum()


def test_errors_are_larger_where_weights_are_small() -> None:
    """The right half has a hundredth of the weight: bits saved there are spent on the left."""
    rng = np.random.default_rng(5)
    wanted, known = rng.normal(0, 6, (30, 40, 2)), np.ones((30, 40), bool)
    dear = np.broadcast_to(np.arange(float(MAGNITUDE_BINS)), FREE.shape).copy()
    distortion = np.ones(wanted.shape, np.float32)
    distortion[:, 20:] = 0.01
    equal, weighted = (np.abs(wanted - searched(wanted, known, dear, w)) for w in (None, distortion))
    assert weighted[:, 20:].mean() > 3 * equal[:, 20:].mean() and weighted[:, :20].mean() < 1.05 * equal[:, :20].mean()


def test_weights_are_relative_to_the_channel() -> None:
    scene = noisy()
    faint = [
        {name: np.full(p.shape, 2.0 ** -np.arange(p.shape[2]), np.float32) for name, p in scale.items()}
        for scale in scene.scales
    ]
    assert scene_writer.encode(trellis_quantised(scene, 0.05, faint)) == scene_writer.encode(
        trellis_quantised(scene, 0.05)
    )


@pytest.mark.parametrize("step", [0.3, 1.0, 3.0])
def test_planes_take_fewer_bytes_than_rounded_ones_of_equal_error(step: float) -> None:
    rng = np.random.default_rng(3)
    values = rng.normal(0, 2, (60, 70, 3)).cumsum(0).cumsum(1)
    values = (10 * values / values.std() + rng.normal(0, 2, values.shape)).astype(np.float32)

    def error(plane: QuantisedPlane) -> float:
        return interpolated_error(plane.dequantise() - values)

    def size(plane: QuantisedPlane) -> int:
        return len(encode_symbols(plane.symbols, plane.coded, plane.side_info))

    economical = trellis.trellis_quantise(
        quantise_plane(values, step, identity=False), values, np.full(3, step), np.ones_like(values), False
    )
    as_bad = next(
        plane
        for k in np.arange(1, 4, 0.01)
        if error(plane := quantise_plane(values, k * step, identity=False)) >= error(economical)
    )
    assert size(economical) < size(as_bad) - 0.12 * values.size / 8  # 1.09 dB are 0.18 bits


def test_any_symbol_may_follow_where_eight_bits_are_too_few(monkeypatch: pytest.MonkeyPatch) -> None:
    """At a step much coarser than requested, trellis symbols would err more than the nearest, and bits cost little:
    interpolated errors are smaller than those of the nearest symbols, except where weights are next to nothing."""
    monkeypatch.setattr(distortion, "MIN_WEIGHT", 1e-4)
    values = np.random.default_rng(4).uniform(-100, 100, (20, 40, 2)).astype(np.float32)
    nearest, step = quantise_plane(values, 0.2, identity=False), np.full(2, 0.2)
    significant = np.ones_like(values)
    significant[:, 20:] = 1e-9
    free = trellis.trellis_quantise(nearest, values, step, np.ones_like(values), False)
    weighted = trellis.trellis_quantise(nearest, values, step, significant, False)
    assert (
        not follows_trellis(free.symbols, free.coded) and np.abs(free.symbols - nearest.symbols.astype(int)).max() <= 1
    )
    errors = [interpolated_error((plane.dequantise() - values)[:, :20]) for plane in (nearest, free, weighted)]
    assert errors[1] < errors[0] and errors[2] < 1.1 * errors[0]
    assert len(encode_symbols(weighted.symbols, weighted.coded)) < 0.95 * len(
        encode_symbols(nearest.symbols, nearest.coded)
    )
    at_own_step = trellis.trellis_quantise(nearest, values, nearest.step, np.ones_like(values), False)
    assert follows_trellis(at_own_step.symbols, at_own_step.coded)


@pytest.mark.parametrize("step", [0.005, 0.05])
def test_uncoded_texels_and_requested_steps_are_kept(step: float) -> None:
    """In mode DEPENDENT the steps differ, but the requested ones can be recovered."""
    scene = noisy()
    before, after = quantised(scene, step), trellis_quantised(scene, step)
    assert any(plane.side_info is not None for scale in after.scales for plane in scale.values()) == (step == 0.05)
    for ours, theirs in zip(after.scales, before.scales, strict=True):
        for name in ours:
            np.testing.assert_allclose(trellis.requested_trellis_step(ours[name]), theirs[name].step, rtol=2**-7)
            assert (
                not ours[name].symbols[~ours[name].coded].any() and not (ours[name].coded & ~theirs[name].coded).any()
            )
            if name not in TIME_PLANES:
                np.testing.assert_array_equal(ours[name].coded, theirs[name].coded)
            elif ours[name].side_info is None:
                np.testing.assert_array_equal(ours[name].coded, ours[name].symbols.any(2))


def waves(seed: int, rows: int = 60, columns: int = 70) -> np.ndarray:
    """Return (rows, columns, 3) smooth values with noise of standard deviation 1."""
    rng = np.random.default_rng(seed)
    smooth = rng.normal(0, 1, (rows + 8, columns + 8, 3)).cumsum(0).cumsum(1)
    kernel = np.ones(9) / 9
    for axis in (0, 1):
        smooth = np.apply_along_axis(np.convolve, axis, smooth, kernel, "valid")
    return (20 * smooth / smooth.std() + rng.normal(0, 1, (rows, columns, 3))).astype(np.float32)


@pytest.mark.parametrize("identity", [False, True])
def test_low_rates_use_dependent_mode(identity: bool) -> None:
    """Its Lagrangian cost is lower than that of the trellis at the requested steps."""
    values = waves(11, 48) + identity
    step, equal = np.full(3, 2.0), np.ones_like(values)
    rounded = quantise_plane(values, step, identity=identity)

    def cost(plane: QuantisedPlane) -> float:
        parts = [slice(*bounds) for bounds in segment_bounds(plane, identity)]
        bodies = [encode_symbols(plane.symbols[rows], plane.coded[rows], plane.side_info) for rows in parts]
        assert all(side_info_of(Codec.PREDICTIVE, body) == plane.side_info for body in bodies)
        errors = plane.dequantise() - values
        return float(
            (errors / 2.0).ravel() @ (errors / 2.0).ravel() * interpolated_error(errors) / np.mean(np.square(errors))
        ) + distortion.LAM * 8 * sum(map(len, bodies))

    around = trellis.trellis_quantise(rounded, values, step, equal, identity)
    assert around.side_info is not None
    np.testing.assert_allclose(trellis.requested_trellis_step(around), step, rtol=2**-7)
    on_trellis = trellis.trellis_quantise(rounded, values, step, equal, identity, low_rate_bits=0.0)
    assert on_trellis.side_info is None and cost(around) < 0.92 * cost(on_trellis)


def test_files_keep_prediction_weights() -> None:
    scene = trellis_quantised(noisy(), 0.05)
    data = scene_writer.encode(scene)
    back = scene_io.read(data)
    assert scene_writer.encode(back) == data
    for ours, theirs in zip(back.scales, scene.scales, strict=True):
        assert all(ours[name].side_info == theirs[name].side_info for name in ours)
    forgotten = replace(
        back,
        scales=tuple({name: replace(plane, side_info=None) for name, plane in scale.items()} for scale in back.scales),
    )
    assert len(scene_writer.encode(forgotten)) > len(data)


def test_symbols_stay_within_eight_bits() -> None:
    scene = tiny_scene()
    planes = [dict(scale) for scale in scene.scales]
    planes[0]["xt"] = planes[0]["xt"] + np.float32(5)
    scene = replace(scene, scales=tuple(planes))
    after = trellis_quantised(scene, 1e-6)  # steps are raised until the range fits
    assert after.scales[0]["xt"].symbols.max() == 127 and np.isfinite(after.dequantise().scales[0]["xt"]).all()
