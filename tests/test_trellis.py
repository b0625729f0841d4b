"""Symbols that are easier to foresee, and nearly as near."""

import math
from dataclasses import replace

import numpy as np
import pytest
from scenes import tiny_scene

from kpc.encoder import rounding
from kpc.encoder.rounding import rounded
from kpc.format import file
from kpc.format.quantise import QuantisedScene, quantise_scene
from kpc.format.scene import TIME_PLANES, Scene


def noisy(seed: int = 1) -> Scene:
    scene, rng = tiny_scene(seed), np.random.default_rng(seed)
    scales = tuple({name: plane + rng.normal(0, 0.02, plane.shape).astype(np.float32) for name, plane in scale.items()}
                   for scale in scene.scales)  # fmt: skip
    return replace(scene, scales=scales)


def quantised(scene: Scene, step: float) -> QuantisedScene:
    return quantise_scene(scene, [{name: step for name in scale} for scale in scene.scales])


def plainly(wanted: np.ndarray, known: np.ndarray, lam: float) -> np.ndarray:
    """What the module's text says, texel by texel, each candidate tried."""
    chosen, missed = np.zeros(wanted.shape, int), np.zeros(wanted.shape)
    seen = np.zeros(wanted.shape)
    for (i, j), value in np.ndenumerate(wanted):
        left = seen[i, j - 1] if j else (seen[i - 1, j] if i else 0)
        up = seen[i - 1, j] if i else left
        corner = seen[i - 1, j - 1] if i and j else (left if i == 0 else up)
        expected = seen[i, j] = sorted([left, up, left + up - corner])[1]
        if not known[i, j]:
            missed[i, j] = missed[i, j - 1] if j else 0
            continue
        around = [missed[a, b] for a, b in ((i, j - 1), (i - 1, j), (i - 1, j - 1), (i - 1, j + 1))
                  if a >= 0 and 0 <= b < wanted.shape[1]]  # fmt: skip
        mean = (0.3 + sum(around)) / (0.6 + len(around))
        costs = {s: (value - s) ** 2 + lam * math.log2((1 + mean) / mean) * abs(s - expected) for s in range(-128, 128)}
        chosen[i, j] = seen[i, j] = min(costs, key=lambda s: costs[s])
        missed[i, j] = abs(chosen[i, j] - expected)
    return chosen


@pytest.mark.parametrize("lam", [0.0, 0.06, 0.5])
def test_the_choice_is_the_cheapest_of_all_symbols(lam: float) -> None:
    rng = np.random.default_rng(3)
    wanted = rng.normal(0, 3, (7, 9)).cumsum(1)
    known = rng.random((7, 9)) < 0.8
    chosen = rounding._choose(wanted, known, lam, -128, 127)
    np.testing.assert_array_equal(chosen, plainly(wanted, known, lam))
    assert not chosen[~known].any()


def test_without_a_price_symbols_are_the_nearest(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(rounding, "LAM", 0.0)
    scene = noisy()
    nearest = quantised(scene, 0.05)
    assert file.encode(rounded(nearest, scene)) == file.encode(nearest)


@pytest.mark.parametrize("step", [0.05, 0.1, 0.2])
def test_bytes_fall_by_more_than_coarser_steps_would_save(step: float) -> None:
    """At a square error that is a little larger, the file is smaller than at steps that err as much."""
    scene = noisy()

    def error(q: QuantisedScene) -> float:
        needed = quantised(scene, 1e-4).scales
        planes = zip(q.dequantise().scales, scene.scales, needed)
        return float(np.mean([np.square(a[n] - b[n])[c[n].coded].mean() for a, b, c in planes for n in a]))

    economical = rounded(quantised(scene, step), scene)
    coarser = [quantised(scene, step * k) for k in np.arange(1, 1.5, 0.02)]
    as_bad = next(q for q in coarser if error(q) >= error(economical))
    assert len(file.encode(economical)) < len(file.encode(as_bad)) < len(file.encode(quantised(scene, step)))


def test_what_was_left_out_stays_so_and_steps_stay() -> None:
    scene = noisy()
    before, after = quantised(scene, 0.05), rounded(quantised(scene, 0.05), scene)
    for ours, theirs in zip(after.scales, before.scales):
        for name in ours:
            np.testing.assert_array_equal(ours[name].step, theirs[name].step)
            assert not ours[name].symbols[~ours[name].coded].any() and not (ours[name].coded & ~theirs[name].coded).any()
            if name in TIME_PLANES:
                np.testing.assert_array_equal(ours[name].coded, ours[name].symbols.any(2))
            else:
                np.testing.assert_array_equal(ours[name].coded, theirs[name].coded)


def test_symbols_stay_within_eight_bits() -> None:
    scene = tiny_scene()
    planes = [dict(scale) for scale in scene.scales]
    planes[0]["xt"] = planes[0]["xt"] + np.float32(5)
    scene = replace(scene, scales=tuple(planes))
    after = rounded(quantised(scene, 1e-6), scene)  # steps are raised until the range fits
    assert after.scales[0]["xt"].symbols.max() == 127 and np.isfinite(after.dequantise().scales[0]["xt"]).all()
