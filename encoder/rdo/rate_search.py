"""Searches for one common factor on all quantisation steps, along its base-two logarithm, the exponent.

An attempt, what is made of an exponent, takes seconds, and minutes with fine-tuning. How size and error follow the
steps is known well enough to extrapolate, so that few attempts suffice.
"""

import math
from collections.abc import Callable, Iterable, Sequence
from typing import Protocol, TypeVar

TOLERANCE = 0.02  # a search ends within this share below the limit
MIN_OCTAVES = 0.02  # steps closer than this differ in their errors, but not on average
MAX_ATTEMPTS = 16  # attempts of a search
MIN_LEAP = 0.3  # first leap, in octaves, while the value is known on one side only; it doubles each time
GOLDEN = (math.sqrt(5) - 1) / 2
COST_OCTAVES = 0.3  # the least cost is located this closely; near it the cost hardly changes
MAX_TUNINGS = 4  # fine-tuned attempts, about a minute each; most searches take two
SLOPE_OCTAVES = 0.3  # distance of two attempts, at least, from which a slope is taken


class HasExponent(Protocol):
    """What was made of an exponent."""

    @property
    def exponent(self) -> float: ...


Made = TypeVar("Made", bound=HasExponent)


def find_limit(
    start: float,
    end: float,
    guess: float,
    attempt: Callable[[float], Made],
    value: Callable[[Made], float],
    limit: float,
    slope: float,
    tolerance: float = TOLERANCE,
    tried: Iterable[Made] = (),
) -> Made:
    """Find the exponent farthest from `start` whose value is at most `limit`.

    The search extrapolates log value linearly, in growing leaps, until the limit is bracketed. Then it interpolates
    between both sides, but never within a tenth of either. Where both sides are closer than MIN_OCTAVES, the value is
    noisy, and exponents beyond are tried in steps of MIN_OCTAVES.

    Args:
        start: exponent that is returned where no value is within the limit.
        end: exponent on the other side; values rise towards it.
        guess: exponent of the first attempt, unless some were `tried`.
        attempt: makes an attempt of an exponent.
        value: of an attempt.
        limit: what the value may not exceed.
        slope: expected change of log value per octave.
        tolerance: the search ends with a value within this share below the limit, or after MAX_ATTEMPTS.
        tried: attempts made before.
    """
    direction = math.copysign(1.0, end - start)
    known = list(tried)
    wanted = math.log(limit * (1 - tolerance / 2)) if limit > 0 else -math.inf
    leap, noisy = MIN_LEAP, 0
    for number in range(MAX_ATTEMPTS + 1):  # the last round only returns what was found
        # NaN counts as beyond the limit.
        within = max(
            (one for one in known if value(one) <= limit), key=lambda one: direction * one.exponent, default=None
        )
        beyond = min(
            (
                one
                for one in known
                if not value(one) <= limit and (within is None or direction * (one.exponent - within.exponent) > 0)
            ),
            key=lambda one: direction * one.exponent,
            default=None,
        )
        if within is not None and (
            value(within) >= (1 - tolerance) * limit or within.exponent == end or number == MAX_ATTEMPTS
        ):
            return within
        if within is None and (number == MAX_ATTEMPTS or (beyond is not None and beyond.exponent == start)):
            break
        if within is not None and beyond is not None:
            distance = beyond.exponent - within.exponent
            if abs(distance) < MIN_OCTAVES:
                noisy += 1
                exponent = beyond.exponent + direction * noisy * MIN_OCTAVES
            else:
                share = min(max(_share(value(within), value(beyond), wanted), 0.1), 0.9)
                exponent = within.exponent + distance * share
        elif within is not None or beyond is not None:
            nearest = within if within is not None else beyond
            assert nearest is not None
            reached = value(nearest)
            missing = abs(wanted - math.log(reached)) / slope if 0 < reached < math.inf else 0.0
            sign = direction if nearest is within else -direction
            exponent = nearest.exponent + math.copysign(max(missing, leap), sign)
            leap *= 2
        else:
            exponent = guess
        known.append(attempt(_clamp(exponent, start, end)))
    return attempt(start)


def _clamp(exponent: float, start: float, end: float) -> float:
    return min(max(exponent, min(start, end)), max(start, end))


def _share(low: float, high: float, wanted: float) -> float:
    """Interpolate log values: return where `wanted` lies from `low` (0) to `high` (1); 0.5 where they say nothing."""
    if not (0 < low < high < math.inf) or math.isinf(wanted):
        return 0.5
    return (wanted - math.log(low)) / math.log(high / low)


def find_tuned_limit(
    start: float,
    end: float,
    found: Made,
    tried: Iterable[Made],
    tuned: Callable[[float], Made],
    value: Callable[[Made], float],
    limit: float,
    enough: float,
    gain: float,
    slope: float,
) -> Made | None:
    """Find a fine-tuned attempt whose value is at most `limit`, in few attempts.

    The exponent is extrapolated: from `found`, with the slope of the attempts that were `tried`, then with ever better
    slopes from the fine-tuned attempts.

    Args:
        start: as for `find_limit`.
        end: as for `find_limit`.
        found: the best attempt without fine-tuning.
        tried: other attempts without fine-tuning.
        tuned: makes a fine-tuned attempt of an exponent.
        value: of an attempt.
        limit: what the value may not exceed.
        enough: the search ends with a value within this share below the limit, after each further attempt half as much
            more, or after MAX_TUNINGS.
        gain: expected ratio of values with and without fine-tuning.
        slope: expected change of log value per octave towards `end`, where no attempt says more.

    Returns:
        The attempt within the limit that is nearest to `end`; None where there is none. Values scatter by about a
        tenth, so its value need not be the largest.
    """
    if not 0 < value(found) <= limit:
        return None
    slope = math.copysign(slope, end - start)
    others = [one for one in tried if abs(one.exponent - found.exponent) >= SLOPE_OCTAVES and 0 < value(one) < math.inf]
    if others:
        other = min(others, key=lambda one: abs(one.exponent - found.exponent))
        measured = math.log(value(other) / value(found)) / (other.exponent - found.exponent)
        if measured * slope > 0:
            slope = measured
    wanted = math.log(limit * (1 - enough / 2))
    exponent, best = found.exponent + (wanted - math.log(gain * value(found))) / slope, None
    known: list[tuple[float, float]] = []
    for number in range(MAX_TUNINGS):
        candidate = tuned(_clamp(exponent, start, end))
        reached = value(candidate)
        if not reached > 0:  # true for NaN
            break
        if reached <= limit and (best is None or (candidate.exponent - best.exponent) * slope > 0):
            best = candidate
        if (1 - enough * (1 + number / 2)) * limit <= reached <= limit:
            break
        known.append((candidate.exponent, math.log(reached)))
        exponent = _extrapolate(known, wanted, slope)
    return best


def _extrapolate(known: Sequence[tuple[float, float]], wanted: float, slope: float) -> float:
    """Return the exponent at which a log value is expected, from known (exponent, log value) pairs.

    Interpolates between the farthest pair below the value and the next pair above it. Where the value is not bracketed,
    extrapolates the line through the two nearest pairs; where there is one pair only, or that line differs from `slope`
    by more than a factor of three, a line of that slope through the latest pair.
    """
    below = max((point for point in known if point[1] <= wanted), key=lambda point: slope * point[0], default=None)
    above = min(
        (point for point in known if point[1] > wanted and below is not None and slope * (point[0] - below[0]) > 0),
        key=lambda point: slope * point[0],
        default=None,
    )
    if below is not None and above is not None:
        return below[0] + (wanted - below[1]) / (above[1] - below[1]) * (above[0] - below[0])
    nearest = sorted(known, key=lambda point: abs(point[1] - wanted))[:2]
    exponent, value = known[-1]
    if len(nearest) == 2 and nearest[0][0] != nearest[1][0]:
        (one, low), (other, high) = nearest
        measured = (high - low) / (other - one)
        if 1 / 3 < measured / slope < 3:
            exponent, value, slope = one, low, measured
    return exponent + (wanted - value) / slope


def minimise(low: float, high: float, attempt: Callable[[float], Made], cost: Callable[[Made], float]) -> Made:
    """Return the attempt of least cost by golden-section search; the cost falls, then rises, from `low` to `high`."""
    left, right = high - GOLDEN * (high - low), low + GOLDEN * (high - low)
    one, other = attempt(left), attempt(right)
    while high - low > COST_OCTAVES:
        if cost(one) <= cost(other):
            high, right, other = right, left, one
            left = high - GOLDEN * (high - low)
            one = attempt(left)
        else:
            low, left, one = left, right, other
            right = low + GOLDEN * (high - low)
            other = attempt(right)
    return min(one, other, key=cost)
