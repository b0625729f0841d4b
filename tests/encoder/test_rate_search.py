"""Searches end where they should, after few attempts."""

import math
from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
import pytest
from kpc.encoder.rdo.rate_search import COST_OCTAVES, MAX_ATTEMPTS, MAX_TUNINGS, find_limit, find_tuned_limit, minimise


@dataclass(frozen=True)
class Told:
    """In place of an Attempt."""

    exponent: float
    error: float


def rough(noise: list[float]) -> tuple[Told | None, list[Told]]:
    """What is found of tunings whose errors, at most 1, grow with the power 1.2 of steps and are off by `noise`; and all that were tried."""
    tried = [Told(e, 0.85 * 2 ** (1.2 * (e + 7))) for e in (-7.0, -6.0)]
    seen: list[Told] = []

    def tuned(exponent: float) -> Told:
        seen.append(Told(exponent, 0.6 * 2 ** (1.2 * (exponent + 7)) * noise[len(seen)]))
        return seen[-1]

    return find_tuned_limit(-13, 2, tried[0], tried, tuned, lambda one: one.error, 1.0, 0.1, 0.7, 1.2), seen


@pytest.mark.parametrize(
    "noise, tunings", [((1.0,), 1), ((1.5, 1.5), 2), ((1.6, 1.2, 1.4), 3), ((1.5, 1.3, 1.45, 1.4), 4)]
)
def test_rough_tunings_come_near_enough(noise: tuple[float, ...], tunings: int) -> None:
    found, seen = rough([*noise])
    assert found is not None and 0.9 <= found.error <= 1 and len(seen) == tunings


def test_once_too_little_and_too_much_are_known_it_is_sought_between() -> None:
    _, seen = rough([0.7, 1.4, 1.35, 0.9])
    assert seen[0].error < 0.9 and seen[1].error > 1 and seen[2].error > 1
    assert seen[0].exponent < seen[2].exponent < seen[1].exponent
    assert seen[0].exponent < seen[3].exponent < seen[2].exponent


def test_the_best_of_rough_tunings_is_found() -> None:
    found, seen = rough([1.6, 0.4, 1.5, 0.7])
    assert found in seen and len(seen) == MAX_TUNINGS
    assert found.error == max(one.error for one in seen if one.error <= 1)


def test_no_tuning_is_found_where_all_err_too_much() -> None:
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
) -> tuple[Told, list[float]]:
    """What is found, and at which exponents something was made for that."""
    seen: list[float] = []

    def attempt(exponent: float) -> Told:
        if exponent not in seen:
            seen.append(exponent)
        return Told(exponent, error(exponent))

    known = [Told(e, error(e)) for e in tried]
    return find_limit(start, end, guess, attempt, lambda one: one.error, most, 1.4, tolerance, known), seen


def grown(exponent: float) -> float:
    """As squares of steps, and less where they are coarse; and something that was left out."""
    return 0.02 + min(4.0 ** (exponent + 8), 2.0 ** (exponent + 9))


@pytest.mark.parametrize("guess", [-9.5, -13, -4, 2])
@pytest.mark.parametrize("most", [0.021, 0.05, 0.15, 1.0, 30.0])
def test_a_value_is_met_from_below_after_few_attempts(most: float, guess: float) -> None:
    found, seen = sought(grown, most, guess=guess)
    assert 0.98 * most <= found.error <= most and len(seen) <= (7 if guess == -9.5 else 10)
    roughly, fewer = sought(grown, most, guess=guess, tolerance=0.2)
    assert 0.8 * most <= roughly.error <= most and len(fewer) <= len(seen)


def test_what_was_tried_is_not_made_again() -> None:
    found, seen = sought(grown, 0.15, tried=(-13, -9.6, -9.3))
    assert 0.147 <= found.error <= 0.15 and len(seen) <= 2 and all(-9.6 < e < -9.3 for e in seen)
    assert sought(grown, 0.15, tried=(found.exponent,)) == (found, [])


@pytest.mark.parametrize("most", [0.019, 0.0, -1.0])
def test_where_nothing_is_good_enough_the_start_is_taken(most: float) -> None:
    found, seen = sought(grown, most)
    assert found.exponent == -13 and len(seen) <= 5


def test_where_all_is_good_enough_the_end_is_taken() -> None:
    found, seen = sought(grown, 1e6)
    assert found.exponent == 2 and len(seen) <= 3


@pytest.mark.parametrize("bytes_wanted", [3e3, 5e4, 4e5])
def test_it_goes_either_way(bytes_wanted: float) -> None:
    """Bytes grow towards finer steps."""
    found, seen = sought(lambda e: 1e4 * 2 ** (-(e + 5) * 0.7), bytes_wanted, start=2, end=-13)
    assert 0.98 * bytes_wanted <= found.error <= bytes_wanted and len(seen) <= 6


def test_not_a_number_is_not_good_enough() -> None:
    found, seen = sought(lambda e: grown(e) if e < -11 else math.nan, 0.15)
    assert -12 < found.exponent < -11 and len(seen) <= MAX_ATTEMPTS
    assert sought(lambda e: math.nan, 0.15)[0].exponent == -13


@pytest.mark.parametrize("seed", range(5))
def test_rough_values_end_a_search(seed: int) -> None:
    """Which leap by a fifth from one grain to the next."""

    def leaping(exponent: float) -> float:
        return grown(exponent) * float(
            np.exp(np.random.default_rng([seed, round(1e3 * exponent) % 9973]).normal(0, 0.1))
        )

    found, seen = sought(leaping, 0.15)
    assert 0.7 * 0.15 <= found.error <= 0.15 and len(seen) <= MAX_ATTEMPTS


def test_the_cheapest_is_found() -> None:
    for least in (-12.9, -7.3, 1.8):
        found = minimise(-13.0, 2.0, lambda e: Told(e, abs(e - least)), lambda one: one.error)
        assert found.error <= COST_OCTAVES
