"""Symbols on the trellis: near, and easy to foresee."""

from dataclasses import replace

import numpy as np
import pytest
from kpc.encoder.rdo import distortion, trellis
from kpc.encoder.rdo.distortion import NO_CORRELATION
from kpc.encoder.rdo.mode_decision import quantise_by_cost
from kpc.encoder.rdo.trellis import MAGNITUDE_BINS, STATES
from kpc.format.coding.predictive import (
    ACTIVITIES,
    TRELLIS,
    WEIGHT_COUNT,
    encode_symbols,
    follows_trellis,
    trellis_transition,
    weights_in,
)
from kpc.format.coding.quantise import QuantisedPlane, QuantisedScene, quantise_plane, quantise_scene
from kpc.format.container import scene_io
from kpc.format.container.segments import rows_per_segment
from kpc.format.scene.scene import TIME_PLANES, Scene
from scenes import tiny_scene


def noisy(seed: int = 1) -> Scene:
    scene, rng = tiny_scene(seed), np.random.default_rng(seed)
    scales = tuple({name: plane + rng.normal(0, 0.02, plane.shape).astype(np.float32) for name, plane in scale.items()}
                   for scale in scene.scales)  # fmt: skip
    return replace(scene, scales=scales)


def quantised(scene: Scene, step: float) -> QuantisedScene:
    return quantise_scene(scene, [{name: step for name in scale} for scale in scene.scales])


def steered(scene: Scene, step: float, significant: list[dict[str, np.ndarray]] | None = None) -> QuantisedScene:
    steps = [{name: np.full(plane.shape[2], step) for name, plane in scale.items()} for scale in scene.scales]
    return quantise_by_cost(scene, steps, significant=significant, blocks=False)


NO_WEIGHTS = np.zeros((1, WEIGHT_COUNT), np.int8)
FREE = np.zeros((2 * ACTIVITIES, MAGNITUDE_BINS))
"""Every error costs nothing."""


def searched(
    wanted: np.ndarray,
    known: np.ndarray,
    bits: np.ndarray = FREE,
    distortion: np.ndarray | None = None,
    together: np.ndarray = NO_CORRELATION,
) -> np.ndarray:
    distortion = np.ones(wanted.shape, np.float32) if distortion is None else distortion
    errors = np.zeros((wanted.shape[0] + 2, wanted.shape[1] + 2, wanted.shape[2]), np.float32)
    problem = trellis.Problem(wanted, distortion, known, len(wanted), TRELLIS, NO_WEIGHTS, bits, together)
    symbols, counts = trellis.search(problem, errors)
    assert np.allclose(
        errors[1:-1, 1:-1], np.where(known[..., None], np.sqrt(distortion) * (symbols - wanted), 0), atol=1e-4
    )
    assert counts.sum() == known.sum() * wanted.shape[2]
    assert follows_trellis(symbols, known) and not symbols[~known].any()
    return symbols


def test_without_a_price_the_path_is_the_nearest_of_all() -> None:
    """A row's least squared error, against every path through so short a row; what lies between keeps errors apart."""
    rng = np.random.default_rng(0)
    for _ in range(20):
        wanted = rng.uniform(-9, 9, 5)
        paths = {(0, ()): 0.0}
        for value in wanted:
            longer = {}
            for (state, path), error in paths.items():
                for symbol in range(-12 + state % 2, 13, 2):
                    longer[trellis_transition(state, symbol), (*path, symbol)] = error + (value - symbol) ** 2
            best = {}  # of paths that end in the same state but differ in nothing that is still to come
            for (state, path), error in longer.items():
                if state not in best or error < best[state][1]:
                    best[state] = path, error
            paths = {(state, path): error for state, (path, error) in best.items()}
        spaced = np.zeros((1, 9, 1))
        spaced[0, ::2, 0] = wanted
        symbols = searched(spaced, np.arange(9)[None] % 2 == 0)
        assert np.square(spaced - symbols).sum() == pytest.approx(min(paths.values()))


def apart(rows: int, columns: int) -> np.ndarray:
    """Texels none of which is next to another."""
    return np.logical_and.outer(np.arange(rows) % 2 == 0, np.arange(columns) % 2 == 0)


def test_errors_of_the_trellis_are_smaller_than_those_of_rounding_to_as_many_bits() -> None:
    """Every other symbol to choose from is a quantiser of step 2, which errs by 2^2 / 12; the trellis of 8 states by 1.09 dB less."""
    wanted, known = np.random.default_rng(1).uniform(-100, 100, (400, 800, 2)), apart(400, 800)
    error = np.mean(np.square(wanted - searched(wanted, known))[known])
    assert 10 * np.log10(4 / 12 / error) == pytest.approx(1.09, abs=0.04)


def seen(errors: np.ndarray) -> float:
    """Mean square, over places anywhere between them, of errors (H, W, M) that are looked up bilinearly; relative to errors that are
    independent of each other."""
    both = errors
    for axis in (0, 1):
        padded = np.pad(both, [(1, 1) if k == axis else (0, 0) for k in range(3)])
        before, after = (np.take(padded, range(k, k + errors.shape[axis]), axis) for k in (0, 2))
        both = both + (before + after) / 4
    return float(np.mean(errors * both))


def test_a_channel_undoes_what_others_err() -> None:
    """Two channels of which pictures show but the sum: together they tell it more finely than either, and no less well where they go
    against each other; of which nothing is known to go together they know nothing."""
    wanted, known = np.random.default_rng(3).uniform(-9, 9, (21, 41, 2)), np.ones((21, 41), bool)
    together = np.zeros((11, 21, 2, 2), np.float32)
    apart = searched(wanted, known)
    np.testing.assert_array_equal(searched(wanted, known, together=together), apart)
    for sign in (1, -1):
        together[..., 0, 1] = together[..., 1, 0] = sign / distortion.CHANNEL_COUPLING
        errors, errors_apart = (symbols - wanted for symbols in (searched(wanted, known, together=together), apart))
        shown, shown_apart = (seen(e[..., :1] + sign * e[..., 1:]) for e in (errors, errors_apart))
        assert shown < 0.6 * shown_apart
        np.testing.assert_array_equal(errors[..., 0], errors_apart[..., 0])  # whose turn comes first


def test_what_goes_together_is_told_block_by_block() -> None:
    errors = np.zeros((7, 8, 3), np.float32)
    errors[1:-1, 1:-1] = np.random.default_rng(1).normal(size=(5, 6, 3))
    together = np.random.default_rng(2).normal(size=(3, 3, 3, 3)).astype(np.float32)
    c = np.zeros((7, 8))
    for y, x in np.ndindex(5, 6):
        c[y + 1, x + 1] = distortion.CHANNEL_COUPLING * (together[y // 2, x // 2, 1] @ errors[y + 1, x + 1])
    kernel = np.array([distortion.EDGE_COUPLING, 1, distortion.EDGE_COUPLING])
    weights = np.outer(kernel, kernel)  # ACROSS is BESIDE squared
    expected = [[(weights * c[y : y + 3, x : x + 3]).sum() for x in range(6)] for y in range(5)]
    assert distortion.CORNER_COUPLING == distortion.EDGE_COUPLING**2
    np.testing.assert_allclose(distortion.cross_channel_errors(errors, together, 1), expected, rtol=1e-4, atol=1e-5)


def test_seen_is_what_bilinear_look_ups_see() -> None:
    rng = np.random.default_rng(7)
    errors, (u, v) = rng.normal(size=(60, 80, 1)).cumsum(1), rng.random((2, 200_000))
    errors -= errors.mean()
    row, column = rng.integers(0, 59, u.size), rng.integers(0, 79, u.size)
    corners = [
        errors[row + i, column + j, 0] * (v if i else 1 - v) * (u if j else 1 - u) for i in (0, 1) for j in (0, 1)
    ]
    assert seen(errors) == pytest.approx(np.mean(np.square(sum(corners))) * 9 / 4, rel=0.05)


def test_errors_next_to_each_other_make_up_for_each_other() -> None:
    """What is seen of them is half a decibel less than of errors without regard to each other, though they are larger one by one."""
    rng = np.random.default_rng(6)
    wanted, known = rng.uniform(-100, 100, (100, 120, 2)), np.ones((100, 120), bool)
    errors = searched(wanted, known) - wanted
    alone = 4 / 12 * 10**-0.109
    assert np.mean(np.square(errors)) > alone and 10 * np.log10(alone / seen(errors)) > 0.4


def test_states_part_and_meet_as_a_code_of_8_states_wants() -> None:
    steps = {
        state: [trellis_transition(state, symbol) for symbol in (state % 2, state % 2 + 2)] for state in range(STATES)
    }
    assert all(a != b for a, b in steps.values())
    came = [to for pair in steps.values() for to in pair]
    assert sorted(came) == sorted(2 * list(range(STATES)))  # two ways into each
    assert trellis_transition(0, 0) == trellis_transition(0, -4) == 0 and trellis_transition(
        0, -2
    ) == trellis_transition(0, 2)


def test_a_price_buys_errors_that_are_nearer_to_what_is_expected() -> None:
    rng = np.random.default_rng(2)
    wanted, known = rng.normal(0, 2, (30, 40, 2)), rng.random((30, 40)) < 0.8
    dear = np.broadcast_to(10.0 * np.arange(MAGNITUDE_BINS), FREE.shape).copy()
    free, bought = searched(wanted, known), searched(wanted, known, dear)
    assert np.abs(bought).sum() < 0.9 * np.abs(free).sum()
    assert np.square(wanted - bought)[known].sum() > np.square(wanted - free)[known].sum()


def test_errors_go_where_they_are_worth_little() -> None:
    """The right half is worth a hundredth: what is saved there is given out on the left."""
    rng = np.random.default_rng(5)
    wanted, known = rng.normal(0, 6, (30, 40, 2)), np.ones((30, 40), bool)
    dear = np.broadcast_to(np.arange(float(MAGNITUDE_BINS)), FREE.shape).copy()
    distortion = np.ones(wanted.shape, np.float32)
    distortion[:, 20:] = 0.01
    alike, told = (np.abs(wanted - searched(wanted, known, dear, w)) for w in (None, distortion))
    assert told[:, 20:].mean() > 3 * alike[:, 20:].mean() and told[:, :20].mean() < 1.05 * alike[:, :20].mean()


def test_what_is_worth_is_relative_to_the_channel() -> None:
    scene = noisy()
    faint = [{name: np.full(plane.shape, 2.0 ** -np.arange(plane.shape[2]), np.float32) for name, plane in scale.items()}
             for scale in scene.scales]  # fmt: skip
    assert scene_io.encode(steered(scene, 0.05, faint)) == scene_io.encode(steered(scene, 0.05))


@pytest.mark.parametrize("step", [0.3, 1.0, 3.0])
def test_planes_take_fewer_bytes_than_rounded_ones_that_err_as_much(step: float) -> None:
    rng = np.random.default_rng(3)
    values = rng.normal(0, 2, (60, 70, 3)).cumsum(0).cumsum(1)
    values = (10 * values / values.std() + rng.normal(0, 2, values.shape)).astype(np.float32)

    def error(plane: QuantisedPlane) -> float:
        return seen(plane.dequantise() - values)

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


def test_where_eight_bits_are_too_few_any_symbol_may_follow(monkeypatch: pytest.MonkeyPatch) -> None:
    """Those of the trellis would err by four thirds of what the nearest do, and at a step so much coarser than the one asked for bits are
    worth little: what is seen of errors is less than of those of the nearest, but where they are worth next to nothing."""
    monkeypatch.setattr(distortion, "MIN_WEIGHT", 1e-4)
    values = np.random.default_rng(4).uniform(-100, 100, (20, 40, 2)).astype(np.float32)
    nearest, step = quantise_plane(values, 0.2, identity=False), np.full(2, 0.2)
    significant = np.ones_like(values)
    significant[:, 20:] = 1e-9
    free = trellis.trellis_quantise(nearest, values, step, np.ones_like(values), False)
    told = trellis.trellis_quantise(nearest, values, step, significant, False)
    assert (
        not follows_trellis(free.symbols, free.coded) and np.abs(free.symbols - nearest.symbols.astype(int)).max() <= 1
    )
    errors = [seen((plane.dequantise() - values)[:, :20]) for plane in (nearest, free, told)]
    assert errors[1] < errors[0] and errors[2] < 1.1 * errors[0]
    assert len(encode_symbols(told.symbols, told.coded)) < 0.95 * len(encode_symbols(nearest.symbols, nearest.coded))
    steered = trellis.trellis_quantise(nearest, values, nearest.step, np.ones_like(values), False)
    assert follows_trellis(steered.symbols, steered.coded)


@pytest.mark.parametrize("step", [0.005, 0.05])
def test_what_was_left_out_stays_so_and_steps_stay(step: float) -> None:
    """Steps around predictions are others, but it is known what was asked for."""
    scene = noisy()
    before, after = quantised(scene, step), steered(scene, step)
    assert any(plane.side_info is not None for scale in after.scales for plane in scale.values()) == (step == 0.05)
    for ours, theirs in zip(after.scales, before.scales):
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
    """(rows, columns, 3) of which most is foreseen, and the rest is noise of standard deviation 1."""
    rng = np.random.default_rng(seed)
    smooth = rng.normal(0, 1, (rows + 8, columns + 8, 3)).cumsum(0).cumsum(1)
    kernel = np.ones(9) / 9
    for axis in (0, 1):
        smooth = np.apply_along_axis(np.convolve, axis, smooth, kernel, "valid")
    return (20 * smooth / smooth.std() + rng.normal(0, 1, (rows, columns, 3))).astype(np.float32)


@pytest.mark.parametrize("identity", [False, True])
def test_what_is_hardly_told_goes_around_predictions(identity: bool) -> None:
    """And costs less, errors and bytes together, than on the trellis at the steps that were asked for."""
    values = waves(11, 48) + identity
    step, alike = np.full(3, 2.0), np.ones_like(values)
    rounded = quantise_plane(values, step, identity=identity)

    def cost(plane: QuantisedPlane) -> float:
        segments = range(0, len(values), rows_per_segment(len(values), identity))
        parts = [slice(start, start + segments.step) for start in segments]
        bodies = [encode_symbols(plane.symbols[rows], plane.coded[rows], plane.side_info) for rows in parts]
        assert all(weights_in(body) == plane.side_info for body in bodies)
        errors = plane.dequantise() - values
        return float(
            (errors / 2.0).ravel() @ (errors / 2.0).ravel() * seen(errors) / np.mean(np.square(errors))
        ) + distortion.LAM * 8 * sum(map(len, bodies))

    around = trellis.trellis_quantise(rounded, values, step, alike, identity)
    assert around.side_info is not None
    np.testing.assert_allclose(trellis.requested_trellis_step(around), step, rtol=2**-7)
    on_trellis = trellis.trellis_quantise(rounded, values, step, alike, identity, low_rate_bits=0.0)
    assert on_trellis.side_info is None and cost(around) < 0.92 * cost(on_trellis)


def test_files_keep_what_symbols_were_chosen_by() -> None:
    scene = steered(noisy(), 0.05)
    data = scene_io.encode(scene)
    back = scene_io.read(data)
    assert scene_io.encode(back) == data
    for ours, theirs in zip(back.scales, scene.scales):
        assert all(ours[name].side_info == theirs[name].side_info for name in ours)
    forgotten = replace(
        back,
        scales=tuple({name: replace(plane, side_info=None) for name, plane in scale.items()} for scale in back.scales),
    )
    assert len(scene_io.encode(forgotten)) > len(data)


def test_symbols_stay_within_eight_bits() -> None:
    scene = tiny_scene()
    planes = [dict(scale) for scale in scene.scales]
    planes[0]["xt"] = planes[0]["xt"] + np.float32(5)
    scene = replace(scene, scales=tuple(planes))
    after = steered(scene, 1e-6)  # steps are raised until the range fits
    assert after.scales[0]["xt"].symbols.max() == 127 and np.isfinite(after.dequantise().scales[0]["xt"]).all()
