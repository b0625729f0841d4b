"""Searches end where they should, after few attempts."""

import math
from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
import pytest

from kpc.encoder.rdo.rate_search import COST_OCTAVES, MAX_ATTEMPTS, MAX_TUNINGS, find_limit, find_tuned_limit, minimise


@dataclass(frozen=True)
class Attempt:
    """Stand in for `kpc.encoder.rdo.rate_control.Attempt`."""

    exponent: float
    error: float


def rough(noise: list[float]) -> tuple[Attempt | None, list[Attempt]]:
    """Search among attempts whose errors grow with the power 1.2 of steps, times `noise`; also return them."""
    tried = [Attempt(e, 0.85 * 2 ** (1.2 * (e + 7))) for e in (-7.0, -6.0)]
    seen: list[Attempt] = []

    def tuned(exponent: float) -> Attempt:
        seen.append(Attempt(exponent, 0.6 * 2 ** (1.2 * (exponent + 7)) * noise[len(seen)]))
        return seen[-1]

    return find_tuned_limit(-13, 2, tried[0], tried, tuned, lambda one: one.error, 1.0, 0.1, 0.7, 1.2), seen


@pytest.mark.parametrize(
    "noise, tunings", [((1.0,), 1), ((1.5, 1.5), 2), ((1.6, 1.2, 1.4), 3), ((1.5, 1.3, 1.45, 1.4), 4)]
)
def test_noisy_fine_tunings_reach_the_tolerance(noise: tuple[float, ...], tunings: int) -> None:
    found, seen = rough([*noise])
    assert found is not None and 0.9 <= found.error <= 1 and len(seen) == tunings


@pytest.mark.parametrize("noise, least, tunings", [(1.3, 0.88, 2), (1.25, 0.98, 4)])
def test_the_second_fine_tuning_may_be_half_as_much_further_below(noise: float, least: float, tunings: int) -> None:
    found, seen = rough([1.4, noise, 1.45, 1.4])
    assert len(seen) == tunings and found is not None and least <= found.error <= least + 0.02


def test_a_bracketed_limit_is_interpolated() -> None:
    _, seen = rough([0.7, 1.4, 1.35, 0.9])
    assert seen[0].error < 0.9 and seen[1].error > 1 and seen[2].error > 1
    assert seen[0].exponent < seen[2].exponent < seen[1].exponent
    assert seen[0].exponent < seen[3].exponent < seen[2].exponent


def test_the_best_of_noisy_fine_tunings_is_returned() -> None:
    found, seen = rough([0.9, 0.8, 1.6, 1.2])  # the second errs less with coarser steps
    assert found in seen and len(seen) == MAX_TUNINGS
    assert found.exponent == max(one.exponent for one in seen if one.error <= 1)
    assert found.error < max(one.error for one in seen if one.error <= 1)


def test_none_where_all_fine_tunings_exceed_the_limit() -> None:
    found, seen = rough([2.0, 4.0, 8.0, 16.0])
    assert found is None and len(seen) == MAX_TUNINGS


def sought(
    error: Callable[[float], float],
    most: float,
    start: float = -13,
    end: float = 2,
    guess: float = -9.5,
    tried: tuple[float, ...] = (),
    tolerance: float = 0.02,
) -> tuple[Attempt, list[float]]:
    """Return what is found, and the exponents of all attempts."""
    seen: list[float] = []

    def attempt(exponent: float) -> Attempt:
        if exponent not in seen:
            seen.append(exponent)
        return Attempt(exponent, error(exponent))

    known = [Attempt(e, error(e)) for e in tried]
    return find_limit(start, end, guess, attempt, lambda one: one.error, most, 1.4, tolerance, known), seen


def grown(exponent: float) -> float:
    """Errors that grow as the square of steps, and less where these are coarse, plus a constant."""
    return 0.02 + min(4.0 ** (exponent + 8), 2.0 ** (exponent + 9))


@pytest.mark.parametrize("guess", [-9.5, -13, -4, 2])
@pytest.mark.parametrize("most", [0.021, 0.05, 0.15, 1.0, 30.0])
def test_a_limit_is_reached_from_below_in_few_attempts(most: float, guess: float) -> None:
    found, seen = sought(grown, most, guess=guess)
    assert 0.98 * most <= found.error <= most and len(seen) <= (7 if guess == -9.5 else 10)
    roughly, fewer = sought(grown, most, guess=guess, tolerance=0.2)
    assert 0.8 * most <= roughly.error <= most and len(fewer) <= len(seen)


def test_earlier_attempts_are_used() -> None:
    found, seen = sought(grown, 0.15, tried=(-13, -9.6, -9.3))
    assert 0.147 <= found.error <= 0.15 and len(seen) <= 2 and all(-9.6 < e < -9.3 for e in seen)
    assert sought(grown, 0.15, tried=(found.exponent,)) == (found, [])


@pytest.mark.parametrize("most", [0.019, 0.0, -1.0])
def test_an_unreachable_limit_gives_the_start(most: float) -> None:
    found, seen = sought(grown, most)
    assert found.exponent == -13 and len(seen) <= 5


def test_a_limit_above_all_values_gives_the_end() -> None:
    found, seen = sought(grown, 1e6)
    assert found.exponent == 2 and len(seen) <= 3


@pytest.mark.parametrize("bytes_wanted", [3e3, 5e4, 4e5])
def test_searches_go_in_either_direction(bytes_wanted: float) -> None:
    """Bytes grow with finer steps."""
    found, seen = sought(lambda e: 1e4 * 2 ** (-(e + 5) * 0.7), bytes_wanted, start=2, end=-13)
    assert 0.98 * bytes_wanted <= found.error <= bytes_wanted and len(seen) <= 6


def test_nan_exceeds_the_limit() -> None:
    found, seen = sought(lambda e: grown(e) if e < -11 else math.nan, 0.15)
    assert -12 < found.exponent < -11 and len(seen) <= MAX_ATTEMPTS
    assert sought(lambda e: math.nan, 0.15)[0].exponent == -13


@pytest.mark.parametrize("seed", range(5))
def test_noisy_values_end_a_search(seed: int) -> None:
    """Values jump by a fifth between neighbouring exponents."""

    def leaping(exponent: float) -> float:
        return grown(exponent) * float(
            np.exp(np.random.default_rng([seed, round(1e3 * exponent) % 9973]).normal(0, 0.1))
        )

    found, seen = sought(leaping, 0.15)
    assert 0.7 * 0.15 <= found.error <= 0.15 and len(seen) <= MAX_ATTEMPTS


def test_minimise_finds_the_least_cost() -> None:
    for least in (-12.9, -7.3, 1.8):
        found = minimise(-13.0, 2.0, lambda e, least=least: Attempt(e, abs(e - least)), lambda one: one.error)
        assert found.error <= COST_OCTAVES
