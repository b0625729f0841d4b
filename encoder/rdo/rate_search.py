"""How coarse all steps may be together: searches along the exponent, base two, of one factor on them.

What is made of an exponent, a `HasExponent`, costs seconds, and minutes where it is tuned, so that few are made: how a value follows steps is
known well enough to guess where it is met.
"""

import math
from collections.abc import Callable, Iterable, Sequence
from typing import Protocol, TypeVar

TOLERANCE = 0.02
"""A search ends this share below what it may not exceed."""
MIN_OCTAVES = 0.02
"""Octaves. Steps that differ by less err differently, but on average the same."""
MAX_ATTEMPTS = 16
"""A search makes at most so many."""
MIN_LEAP = 0.3
"""Octaves, at least, and twice as many each time, to where a value is sought that has been met on one side only."""
GOLDEN = (math.sqrt(5) - 1) / 2
COST_OCTAVES = 0.3
"""Octaves within which the least cost is sought; at the least it hardly changes."""
MAX_TUNINGS = 4
"""At most so many codings are tuned: each takes a minute, about. Mostly two are."""
SLOPE_OCTAVES = 0.3
"""Octaves between two steps that tell how a value follows them."""


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
    most: float,
    slope: float,
    tolerance: float = TOLERANCE,
    tried: Iterable[Made] = (),
) -> Made:
    """What `attempt` makes of the exponent farthest from `start` towards `end`, along which `value` rises, where that is `most` or less; of
    `start` where nowhere.

    Begins at the `guess`, or with what was `tried`, and goes on as far as a logarithm of the value with this slope, per octave, wants it,
    but ever farther, until the value is known on both sides. Between them it goes by the line through both, but never nearer to either
    than a tenth of the way. Where both sides come within GRAIN, `value` is rough: then what lies a few grains on. Ends when the tolerance
    is met, or after ATTEMPTS.
    """
    way = math.copysign(1.0, end - start)
    known = list(tried)
    wanted = math.log(most * (1 - tolerance / 2)) if most > 0 else -math.inf
    leap, grains = MIN_LEAP, 0
    for number in range(MAX_ATTEMPTS + 1):  # and a last look
        within = max(
            (one for one in known if value(one) <= most), key=lambda one: way * one.exponent, default=None
        )  # not so with NaN
        beyond = min((one for one in known if not value(one) <= most and (within is None or way * (one.exponent - within.exponent) > 0)),
                     key=lambda one: way * one.exponent, default=None)  # fmt: skip
        if within is not None and (
            value(within) >= (1 - tolerance) * most or within.exponent == end or number == MAX_ATTEMPTS
        ):
            return within
        if within is None and (number == MAX_ATTEMPTS or beyond is not None and beyond.exponent == start):
            break
        if within is not None and beyond is not None:
            apart = beyond.exponent - within.exponent
            if abs(apart) < MIN_OCTAVES:
                grains += 1
                exponent = beyond.exponent + way * grains * MIN_OCTAVES
            else:
                exponent = within.exponent + apart * min(max(_share(value(within), value(beyond), wanted), 0.1), 0.9)
        elif within is not None or beyond is not None:
            nearest = within if within is not None else beyond
            assert nearest is not None
            reached = value(nearest)
            missing = abs(wanted - math.log(reached)) / slope if 0 < reached < math.inf else 0.0
            exponent = nearest.exponent + math.copysign(max(missing, leap), way if nearest is within else -way)
            leap *= 2
        else:
            exponent = guess
        known.append(attempt(_between(start, end, exponent)))
    return attempt(start)


def _between(start: float, end: float, exponent: float) -> float:
    """It, or the one of the two that it lies beyond."""
    return min(max(exponent, min(start, end)), max(start, end))


def _share(low: float, high: float, wanted: float) -> float:
    """Of the way between two places, where on a line of logarithms a wanted one is met; half where they tell nothing."""
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
    most: float,
    enough: float,
    made: float,
    slope: float,
) -> Made | None:
    """A coding that is tuned, whose value is `most` or less, by the share `enough` where a few tunings come so near; None where none has it.

    It is sought where its value should be so, tuning making the share `made` of what it is without: how the logarithm of the value
    follows that of the steps is known from what was `tried`, of which `found` is the best without tuning, and ever better from what was
    tuned; where nothing tells, `slope`, per octave towards the `end`, is taken.
    """
    if not 0 < value(found) <= most:
        return None
    slope = math.copysign(slope, end - start)
    others = [one for one in tried if abs(one.exponent - found.exponent) >= SLOPE_OCTAVES and 0 < value(one) < math.inf]
    if others:
        other = min(others, key=lambda one: abs(one.exponent - found.exponent))
        own = math.log(value(other) / value(found)) / (other.exponent - found.exponent)
        if own * slope > 0:
            slope = own
    wanted = math.log(most * (1 - enough / 2))
    exponent, best = found.exponent + (wanted - math.log(made * value(found))) / slope, None
    known: list[tuple[float, float]] = []
    for _ in range(MAX_TUNINGS):
        candidate = tuned(_between(start, end, exponent))
        reached = value(candidate)
        if not reached > 0:  # so with NaN
            break
        if reached <= most and (best is None or reached > value(best)):
            best = candidate
        if (1 - enough) * most <= reached <= most:
            break
        known.append((candidate.exponent, math.log(reached)))
        exponent = _where(known, wanted, slope)
    return best


def _where(known: Sequence[tuple[float, float]], wanted: float, slope: float) -> float:
    """The place of a wanted value between the farthest known (place, value) below it and the next above that; where it is not known on both sides, on
    the line through the two nearest to it; where there is but one, or that line is steeper or flatter than the slope by more than a factor
    of three, on one through the latest with that slope."""
    below = max((point for point in known if point[1] <= wanted), key=lambda point: slope * point[0], default=None)
    above = min(
        (point for point in known if point[1] > wanted and below is not None and slope * (point[0] - below[0]) > 0),
        key=lambda point: slope * point[0],
        default=None,
    )
    if below is not None and above is not None:
        return below[0] + (wanted - below[1]) / (above[1] - below[1]) * (above[0] - below[0])
    nearest = sorted(known, key=lambda point: abs(point[1] - wanted))[:2]
    place, value = known[-1]
    if len(nearest) == 2 and nearest[0][0] != nearest[1][0]:
        (one, low), (other, high) = nearest
        own = (high - low) / (other - one)
        if 1 / 3 < own / slope < 3:
            place, value, slope = one, low, own
    return place + (wanted - value) / slope


def minimise(low: float, high: float, attempt: Callable[[float], Made], cost: Callable[[Made], float]) -> Made:
    """What `attempt` makes of the exponent of least cost, by golden section: it falls, then rises."""
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
