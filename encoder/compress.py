"""From a scene to symbols: how coarse each channel of each plane may be, how much each texel matters, and how coarse all may be together.

One factor on all steps states the trade between size and fidelity. A user names what it should bring (`Trade`), and it is sought.
"""

import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np

from kpc.encoder.curvature import PerPlane
from kpc.encoder.probe import Measure, Measured, squares_of
from kpc.encoder.trellis import quantise_on_trellis
from kpc.format import file
from kpc.format.errors import TrainingError
from kpc.format.motion import STEP
from kpc.format.quantise import QuantisedScene, reached_by
from kpc.format.scene import Scene

FINEST, COARSEST = -13.0, 2.0
"""Base-two logarithms of the factors on all steps, between which one is sought for a trained scene."""
COARSER = 12.0
"""The same of the coarsest for a file that is coded again, whether as it is or with something left out; the finest is its own."""
TOLERANCE = 0.02
"""A search ends this share below what it may not exceed."""
ROUGHLY = 0.2
"""The same of a search for where to tune."""
GRAIN = 0.02
"""Octaves. Steps that differ by less err differently, but on average the same."""
ATTEMPTS = 16
"""After its first, a search makes at most so many."""
PROBES = 10
"""Scenes that a search renders, about."""
GOLDEN = (math.sqrt(5) - 1) / 2
NEAR = 0.3
"""Octaves within which the least cost is sought; at the least it hardly changes."""

DEFAULT_LOSS_DB = 0.15

TUNINGS = 4
"""At most so many codings are tuned: each takes a minute, about. Mostly two are."""
ENOUGH_BYTES, ENOUGH_ERROR = 0.05, 0.1
"""A tuned coding this share below the bytes or the error that it may not exceed is good enough: errors are foreseen less well."""
ERRORS_LEFT, BYTES_MADE = 0.7, 1.01
"""What tuning makes of errors and of bytes, about: so it is known where to begin."""
APART = 0.3
"""Octaves between two steps that tell how errors and bytes follow them."""

TRUST = 0.8
"""In what curvature says of the differences between texels and channels, `significance`. Room and liam, at equal error of held-out views:
files are 1 to 2 % larger with 1; 0.7 and 0.9 make no difference."""
MOTION_SHARE, MOST_STEPS = 0.1, 16
"""Of the error that coding may bring, how much of it displacements may; and how many of `kpc.format.motion.STEP` they may be rounded to.
Soldier: a motion grid takes 3 KB for each bit of them, planes 18 KB for an error e times smaller; at equal slopes it is a tenth."""
LEAST_SIGNIFICANCE = 1e-6
"""Of a channel, relative to the most important of all numbers."""

Steps = list[dict[str, np.ndarray]]
"""One mapping a scale, plane name -> (M,) quantisation steps."""
Quantise = Callable[[Scene, PerPlane, np.ndarray, PerPlane], QuantisedScene]
"""Of a scene with steps, `reached_by` it and significance: `quantise_on_trellis`, or what is to be compared with it."""
Tune = Callable[[PerPlane, np.ndarray], QuantisedScene]
"""A better coding with the same steps, of a scene that is known, `reached_by` which is told."""


@dataclass(frozen=True)
class Trade:
    """What is given up for what: one of these alone, else DEFAULT_LOSS_DB.

    Attributes:
        max_loss_db: PSNR that coding may cost on training views, what is left out included, dB.
        target_bytes: the best file of at most this size.
        quality: from 1 to 100: pictures agree with those of the uncoded scene to `agreement_of` dB.
        lam: least D + lam R, with D the mean squared difference of colours from those of the uncoded scene, in squares of 8-bit
            levels, and R bits of the file per parameter of the model.
        psnr_db: the smallest file of at least this PSNR on training views, dB; where the model itself has less, as without a trade.
    """

    max_loss_db: float | None = None
    target_bytes: int | None = None
    quality: float | None = None
    lam: float | None = None
    psnr_db: float | None = None

    @property
    def bound(self) -> tuple[str, float]:
        """Which of them it is, and how much."""
        for name in ("target_bytes", "quality", "lam", "psnr_db", "max_loss_db"):
            if (value := getattr(self, name)) is not None:
                return name, float(value)
        return "max_loss_db", DEFAULT_LOSS_DB

    def loss_db(self, psnr: float) -> float:
        """What coding may cost, about, where the uncoded scene has so many dB: D adds to its own mean squared error."""
        name, value = self.bound
        if name == "target_bytes":
            return DEFAULT_LOSS_DB
        if name == "max_loss_db":
            return value
        if name == "psnr_db":
            return psnr - value if psnr > value else DEFAULT_LOSS_DB
        # Where D falls to a quarter with a bit more, as fine quantisation has it, its slope is -2 ln 2 D.
        error = error_of(value) if name == "quality" else value / (2 * math.log(2))
        return 10 * math.log10(1 + error / squares_of(psnr))


def agreement_of(quality: float) -> float:
    """PSNR of coded against uncoded pictures, dB, that a quality from 1 to 100 stands for: 20 + quality / 3."""
    return 20 + quality / 3


def error_of(quality: float) -> float:
    """The same as a mean squared difference, in squares of 8-bit levels."""
    return squares_of(agreement_of(quality))


def error_at(psnr: float, loss_db: float) -> float:
    """The mean squared difference, in squares of 8-bit levels, that takes so many dB from pictures of some PSNR, adding to their own: what
    `Trade.loss_db` undoes."""
    return squares_of(psnr) * (10 ** (loss_db / 10) - 1)


@dataclass(frozen=True)
class Attempt:
    """A scene quantised, with steps times two to the power of `exponent`; what that gave is found out when asked for."""

    quantised: QuantisedScene
    measure: Measure
    exponent: float

    @cached_property
    def data(self) -> bytes:
        """Its file."""
        return file.encode(self.quantised)

    @property
    def size_bytes(self) -> int:
        return len(self.data)

    @cached_property
    def measured(self) -> Measured:
        return self.measure(self.quantised.dequantise())

    def cost(self, lam: float) -> float:
        """D + lam R."""
        return self.measured.error + lam * 8 * self.size_bytes / self.quantised.parameter_count


def significance(alone: PerPlane) -> list[dict[str, np.ndarray]]:
    """What an error in each number costs, as a share of the most that any does: (h / largest)^TRUST of `Curvature.alone` h, float32.

    Of h alone: what is left to cross terms, and to rays that were not drawn, makes the unimportant more important than h has it.
    """
    largest = max(float(h.max()) for scale in alone for h in scale.values()) or 1.0
    return [{name: (h / np.float32(largest)) ** np.float32(TRUST) for name, h in scale.items()} for scale in alone]


def with_coarser_motion(scene: Scene, measure: Measure, error: float) -> Scene:
    """The scene with displacements rounded to as coarse a multiple of `kpc.format.motion.STEP` as adds at most `error`, in squares of 8-bit
    levels; itself where that changes nothing, or there is none."""
    if scene.motion is None:
        return scene
    multiple, known = MOST_STEPS, measure(scene).error  # of what was left out
    while multiple > 1:
        step = np.float32(multiple * STEP)
        candidate = replace(scene, motion=np.rint(scene.motion / step) * step)
        if np.array_equal(candidate.motion, scene.motion):
            return scene
        found = measure(candidate).error - known
        if found <= error:
            return candidate
        multiple = min(multiple - 1, int(multiple * math.sqrt(error / found))) if found > error else 1  # errors grow with a step's square
    return scene


def relative_steps(significant: PerPlane) -> Steps:
    """Steps up to one common factor, such that a bit spent on any channel buys about the same.

    A uniform quantiser of step d errs by d^2 / 12 times a constant; the error costs `significant` w of it; its rate falls by one bit
    with each doubling of d. At equal slopes the mean of w d^2 is the same everywhere: d = 1 / sqrt(mean w), over texels that matter
    at all. Channels without any get the coarsest step of all.
    """
    return [{name: np.maximum(_means(w), LEAST_SIGNIFICANCE) ** -0.5 for name, w in scale.items()} for scale in significant]


def _means(values: np.ndarray) -> np.ndarray:
    """(M,) float64 of (H, W, M), over texels that are not 0."""
    flat = values.reshape(-1, values.shape[-1])
    return flat.sum(0, dtype=np.float64) / np.maximum(np.count_nonzero(flat, axis=0), 1)


def scaled(steps: Steps, factor: float) -> list[Mapping[str, np.ndarray]]:
    """All steps times a factor, as float32."""
    return [{name: (step * factor).astype(np.float32) for name, step in scale.items()} for scale in steps]


def compress(
    scene: Scene, steps: Steps, significant: PerPlane, measure: Measure, uncoded_psnr: float, trade: Trade,
    as_it_is: QuantisedScene | None = None, quantise: Quantise = quantise_on_trellis, tune: Tune | None = None,
    own_steps: bool = False,
) -> Attempt:
    """The quantisation that a trade asks for.

    Args:
        measure: judges a coding; `uncoded_psnr` is that of the scene before anything was left out.
        as_it_is: the file that holds just this scene, with these steps.
        tune: what makes a better coding at some steps, and takes its time: the trade is met by such a one.
        own_steps: `steps` are those of a file, of which something may have been left out since: nothing finer makes sense.

    Raises:
        TrainingError: no file of this model is as small as the trade wants.
    """
    reached = reached_by(scene)
    finest, coarsest = (0.0, COARSER) if own_steps or as_it_is is not None else (FINEST, COARSEST)
    tried: dict[float, Attempt] = {}

    def attempt(exponent: float) -> Attempt:
        if as_it_is is not None and exponent == 0:
            return Attempt(as_it_is, measure, exponent)
        if exponent not in tried:
            tried[exponent] = Attempt(quantise(scene, scaled(steps, 2.0**exponent), reached, significant), measure, exponent)
        return tried[exponent]

    def tuned(exponent: float) -> Attempt:
        assert tune is not None
        return Attempt(tune(scaled(steps, 2.0**exponent), reached), measure, exponent)

    name, bound = trade.bound
    if name == "lam":
        found = _cheapest(finest, coarsest, attempt, lambda found: found.cost(bound))
        return found if tune is None else min(found, tuned(found.exponent), key=lambda found: found.cost(bound))
    if name == "target_bytes":
        if as_it_is is not None and (whole := attempt(0.0)).size_bytes <= bound:
            return whole
        start, end, most, value = coarsest, finest, bound, lambda found: found.size_bytes
    elif name == "quality":
        start, end, most, value = finest, coarsest, error_of(bound), lambda found: found.measured.error
    else:
        start, end, most = finest, coarsest, trade.loss_db(uncoded_psnr)
        value = lambda found: uncoded_psnr - found.measured.psnr
    better, enough = None, ENOUGH_BYTES if name == "target_bytes" else ENOUGH_ERROR
    spent: Callable[[Attempt], float] = lambda found: found.measured.error if name == "target_bytes" else found.size_bytes
    if tune is not None:
        found = _farthest(start, end, attempt, value, most, ROUGHLY)
        better = _farthest_tuned(start, end, found, tuple(tried.values()), tuned, value, most, enough)
        if better is not None and value(better) >= (1 - enough) * most and spent(better) < spent(found):
            return better
    found = _farthest(start, end, attempt, value, most)
    if better is not None and spent(better) < spent(found):
        return better
    if name == "target_bytes" and found.size_bytes > bound:
        raise TrainingError(f"{found.size_bytes:,} bytes is the least that this model takes, not {int(bound):,}; give "
                            "another --target-size, or train anew with a smaller --preset")
    return found


def _farthest_tuned(
    start: float, end: float, found: Attempt, tried: Sequence[Attempt], tuned: Callable[[float], Attempt],
    value: Callable[[Attempt], float], most: float, enough: float,
) -> Attempt | None:
    """A coding that is tuned, whose value is `most` or less, by the share `enough` where a few tunings come so near; None where none has it.

    It is sought where its value should be so: how the logarithm of the value follows that of the steps is known from what was `tried`,
    of which `found` is the best without tuning, and ever better from what was tuned.
    """
    others = [one for one in tried if abs(one.exponent - found.exponent) >= APART and value(one) > 0]
    if not others or not 0 < value(found) <= most:
        return None
    other = min(others, key=lambda one: abs(one.exponent - found.exponent))
    slope = math.log(value(other) / value(found)) / (other.exponent - found.exponent)
    rises_towards_finer = end < start  # as bytes do, and errors do not
    if not math.isfinite(slope) or slope == 0 or (slope < 0) != rises_towards_finer:
        return None
    expected = value(found) * (BYTES_MADE if rises_towards_finer else ERRORS_LEFT)
    wanted = math.log(most * (1 - enough / 2))
    exponent, best = found.exponent + (wanted - math.log(expected)) / slope, None
    known: list[tuple[float, float]] = []
    for _ in range(TUNINGS):
        candidate = tuned(min(max(exponent, min(start, end)), max(start, end)))
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
    """The place of a wanted value on the line through the two known (place, value) nearest to it; where there is but one, or that line is
    steeper or flatter than the slope by more than a factor of three, on one through the latest with that slope."""
    nearest = sorted(known, key=lambda point: abs(point[1] - wanted))[:2]
    place, value = known[-1]
    if len(nearest) == 2 and nearest[0][0] != nearest[1][0]:
        (one, low), (other, high) = nearest
        own = (high - low) / (other - one)
        if 1 / 3 < own / slope < 3:
            place, value, slope = one, low, own
    return place + (wanted - value) / slope


def _farthest(
    start: float, end: float, attempt: Callable[[float], Attempt], value: Callable[[Attempt], float], most: float,
    tolerance: float = TOLERANCE,
) -> Attempt:
    """What `attempt` makes of the exponent farthest from `start` towards `end`, along which `value` rises, where that is `most`
    or less; of `start` where nowhere.

    Bisects until the value is known and positive on both sides, then goes by its logarithm, nearly a straight line, but never
    nearer to an end than a tenth of the way. Where both sides come within GRAIN, `value` is rough: then what lies a few grains on.
    Ends when the tolerance is met, or after ATTEMPTS.
    """
    best = attempt(start)
    low, high = value(best), math.nan
    if not low <= most:
        return best
    grains = 0
    for _ in range(ATTEMPTS):
        if low >= (1 - tolerance) * most:
            break
        if abs(end - start) < GRAIN:
            grains += 1
            candidate = attempt(end + math.copysign(grains * GRAIN, end - start))
            if low < value(candidate) <= most:
                low, best = value(candidate), candidate
            continue
        share = 0.5
        if low > 0 and math.isfinite(high):
            way = math.log(most * (1 - tolerance / 2) / low) / math.log(high / low)
            share = min(max(way, 0.1), 0.9)
        middle = start + share * (end - start)
        candidate = attempt(middle)
        found = value(candidate)
        if found <= most:  # not so with NaN
            start, low, best = middle, found, candidate
        else:
            end, high = middle, found
    return best


def _cheapest(low: float, high: float, attempt: Callable[[float], Attempt], cost: Callable[[Attempt], float]) -> Attempt:
    """What `attempt` makes of the exponent of least cost, by golden section: it falls, then rises."""
    left, right = high - GOLDEN * (high - low), low + GOLDEN * (high - low)
    one, other = attempt(left), attempt(right)
    while high - low > NEAR:
        if cost(one) <= cost(other):
            high, right, other = right, left, one
            left = high - GOLDEN * (high - low)
            one = attempt(left)
        else:
            low, left, one = left, right, other
            right = low + GOLDEN * (high - low)
            other = attempt(right)
    return min(one, other, key=cost)
