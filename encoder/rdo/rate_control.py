"""From a scene to symbols: how coarse each channel of each plane may be, how much each texel matters, and how coarse all may be together.

One factor on all steps states the trade between size and fidelity. A user names what it should bring (`Trade`), and it is sought
(`kpc.encoder.rdo.rate_search`).
"""

import math
from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np
from kpc.encoder.evaluation.validation_rays import Fidelity, Measure, mse_of_psnr
from kpc.encoder.field.occupancy_grid import merge_slots
from kpc.encoder.rdo.curvature import PerPlane
from kpc.encoder.rdo.mode_decision import quantise_by_cost
from kpc.encoder.rdo.rate_search import TOLERANCE, find_limit, find_tuned_limit, minimise
from kpc.format.coding.quantise import (
    HALF_BITS,
    QuantisedScene,
    bfloat16_ceil,
    decoder_arrays,
    looked_up_cells,
    round_decoder,
)
from kpc.format.container import scene_io
from kpc.format.scene.scene import Scene

FINEST, COARSEST = -13.0, 2.0
"""Base-two logarithms of the factors on all steps, between which one is sought for a trained scene."""
RECODE_COARSEST = 12.0
"""The same of the coarsest for a file that is coded again, whether as it is or with something left out; the finest is its own."""
FIRST_GUESS, RECODE_GUESS = -9.5, 1.0
"""Where searches between them begin."""
ERROR_SLOPE, BYTES_SLOPE = 2 * math.log(2), 0.5
"""What logarithms grow by per octave, of errors with coarser steps, with their square, and of bytes with finer ones, about."""
ROUGH_TOLERANCE = 0.2
"""How far, as `search.TOLERANCE`, a search may end below that is only to tell where to tune, or what a size costs."""
RENDERINGS = 8
"""Scenes that a search renders, about."""

DEFAULT_LOSS_DB = 0.15

TUNED_BYTES_TOLERANCE, TUNED_ERROR_TOLERANCE = 0.05, 0.1
"""A tuned coding this share below the bytes or the error that it may not exceed is good enough: errors are foreseen less well."""
TUNED_ERROR, TUNED_BYTES = 0.7, 1.01
"""What tuning makes of errors and of bytes, about: so it is known where to begin."""
SIGNIFICANCE_EXPONENT = 0.8
"""In what curvature says of the differences between texels and channels, `significance`. Room and liam, at equal error of held-out views:
files are 1 to 2 % larger with 1; 0.7 and 0.9 make no difference."""
SLOTS_SHARE, MORE_CELLS = 0.05, 1 / 3
"""Of the error that coding may bring, how much of it fewer slots of the occupancy may; and by how many more cells, at most, players have to
march. Soldier: 4 slots for 8 take 6.7 KB in place of 12.4, and a picture of 640x480 on two cores 80 ms in place of 64; so it is left to
files that are to be small, from 0.4 dB of loss on."""
DECODER_SHARE, FEWEST_BITS = 0.02, 3
"""Of the error that coding may bring, how much fewer bits of the decoder's weights may; and the fewest. Default scene and room: 1.5 and 2.1 KB in place
of 1.9 and 2.6 with 7 significant bits, 1.4 and 1.9 with 6; an error of a fiftieth planes undo with a fifth of a kilobyte."""
MIN_SIGNIFICANCE = 1e-6
"""Of a channel, relative to the most important of all numbers."""

Steps = list[dict[str, np.ndarray]]
"""One mapping a scale, plane name -> (M,) quantisation steps."""
QuantiseFunction = Callable[[Scene, PerPlane, np.ndarray, PerPlane], QuantisedScene]
"""Of a scene with steps, `looked_up_cells` it and significance: `quantise_by_cost`, or what is to be compared with it."""
TuneFunction = Callable[[PerPlane, np.ndarray], QuantisedScene]
"""A better coding with the same steps, of a scene that is known, `looked_up_cells` which is told."""


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
        """What coding may cost, about, where the uncoded scene has so many dB: D adds to its own mean squared error. Of a size nobody knows."""
        name, value = self.bound
        if name == "target_bytes":
            return math.nan
        if name == "max_loss_db":
            return value
        if name == "psnr_db":
            return psnr - value if psnr > value else DEFAULT_LOSS_DB
        # Where D falls to a quarter with a bit more, as fine quantisation has it, its slope is -2 ln 2 D.
        error = mse_of_quality(value) if name == "quality" else value / (2 * math.log(2))
        return loss_of_mse(psnr, error)


def agreement_of(quality: float) -> float:
    """PSNR of coded against uncoded pictures, dB, that a quality from 1 to 100 stands for: 20 + quality / 3."""
    return 20 + quality / 3


def mse_of_quality(quality: float) -> float:
    """The same as a mean squared difference, in squares of 8-bit levels."""
    return mse_of_psnr(agreement_of(quality))


def mse_of_loss(psnr: float, loss_db: float) -> float:
    """The mean squared difference, in squares of 8-bit levels, that takes so many dB from pictures of some PSNR, adding to their own."""
    return mse_of_psnr(psnr) * (10 ** (loss_db / 10) - 1)


def loss_of_mse(psnr: float, error: float) -> float:
    """What `mse_of_loss` undoes."""
    return 10 * math.log10(1 + error / mse_of_psnr(psnr))


@dataclass(frozen=True)
class Attempt:
    """A scene quantised, with steps times two to the power of `exponent`; what that gave is found out when asked for."""

    quantised: QuantisedScene
    measure: Measure
    exponent: float

    @cached_property
    def data(self) -> bytes:
        """Its file."""
        return scene_io.encode(self.quantised)

    @property
    def size_bytes(self) -> int:
        return len(self.data)

    @cached_property
    def measured(self) -> Fidelity:
        return self.measure(self.quantised.dequantise())

    def cost(self, lam: float) -> float:
        """D + lam R."""
        return self.measured.mse + lam * 8 * self.size_bytes / self.quantised.parameter_count


def significance(alone: PerPlane) -> list[dict[str, np.ndarray]]:
    """What an error in each number costs, as a share of the most that any does: (h / largest)^TRUST of `Curvature.diagonal` h, float32.

    Of h alone: what is left to cross terms, and to rays that were not drawn, makes the unimportant more important than h has it.
    """
    largest = max(float(h.max()) for scale in alone for h in scale.values()) or 1.0
    return [
        {name: (h / np.float32(largest)) ** np.float32(SIGNIFICANCE_EXPONENT) for name, h in scale.items()}
        for scale in alone
    ]


def reduce_slots(scene: Scene, measure: Measure, error: float) -> Scene:
    """The scene with its occupancy in fewer slots, if that adds at most `error`, in squares of 8-bit levels, and MORE_CELLS cells; else
    itself."""
    merged = merge_slots(scene.occupancy, MORE_CELLS)
    if len(merged) == len(scene.occupancy):
        return scene
    candidate = replace(scene, occupancy=merged)
    return candidate if measure(candidate).mse - measure(scene).mse <= error else scene


def choose_decoder_bits(scene: Scene, measure: Measure, error: float) -> dict[str, int]:
    """Of each array of the decoder's weights, for `round_decoder`, the fewest bits with which all of them add at most `error`, in squares of
    8-bit levels: first of all arrays alike, then of one after the other, those that take most first. None at all where HALF_BITS are too few."""
    known, weights = measure(scene).mse, decoder_arrays(scene.decoder)

    def enough(bits: dict[str, int]) -> bool:
        return measure(replace(scene, decoder=round_decoder(scene.decoder, bits))).mse - known <= error

    alike = (dict.fromkeys(weights, count) for count in range(FEWEST_BITS, HALF_BITS + 1))
    bits = next(filter(enough, alike), {})
    for name in sorted(bits, key=lambda name: -weights[name].size):
        while bits[name] > FEWEST_BITS and enough(fewer := bits | {name: bits[name] - 1}):
            bits = fewer
    return bits


def relative_steps(significant: PerPlane) -> Steps:
    """Steps up to one common factor, such that a bit spent on any channel buys about the same.

    A uniform quantiser of step d errs by d^2 / 12 times a constant; the error costs `significant` w of it; its rate falls by one bit
    with each doubling of d. At equal slopes the mean of w d^2 is the same everywhere: d = 1 / sqrt(mean w), over texels that matter
    at all. Channels without any get the coarsest step of all.
    """
    return [
        {name: np.maximum(_means(w), MIN_SIGNIFICANCE) ** -0.5 for name, w in scale.items()} for scale in significant
    ]


def _means(values: np.ndarray) -> np.ndarray:
    """(M,) float64 of (H, W, M), over texels that are not 0."""
    flat = values.reshape(-1, values.shape[-1])
    return flat.sum(0, dtype=np.float64) / np.maximum(np.count_nonzero(flat, axis=0), 1)


def scaled(steps: Steps, factor: float) -> list[Mapping[str, np.ndarray]]:
    """All steps times a factor, as float32 of 8 significant bits, `bfloat16_ceil`."""
    return [
        {name: bfloat16_ceil((step * factor).astype(np.float32)) for name, step in scale.items()} for scale in steps
    ]


def meet_trade(
    scene: Scene,
    steps: Steps,
    significant: PerPlane,
    measure: Measure,
    uncoded_psnr: float,
    trade: Trade,
    source_file: QuantisedScene | None = None,
    quantise: QuantiseFunction = quantise_by_cost,
    tune: TuneFunction | None = None,
    own_steps: bool = False,
    tolerance: float = TOLERANCE,
) -> Attempt:
    """The quantisation that a trade asks for; of a size that no file has, the smallest.

    Args:
        measure: judges a coding; `uncoded_psnr` is that of the scene before anything was left out.
        source_file: the file that holds just this scene, with these steps.
        tune: what makes a better coding at some steps, and takes its time: the trade is met by such a one.
        own_steps: `steps` are those of a file, of which something may have been left out since: nothing finer makes sense.
        tolerance: as of `kpc.encoder.rdo.rate_search.find_limit`.
    """
    reached = looked_up_cells(scene)
    own_steps = own_steps or source_file is not None
    finest, coarsest, guess = (0.0, RECODE_COARSEST, RECODE_GUESS) if own_steps else (FINEST, COARSEST, FIRST_GUESS)
    tried: dict[float, Attempt] = {}

    def attempt(exponent: float) -> Attempt:
        if source_file is not None and exponent == 0:
            return Attempt(source_file, measure, exponent)
        if exponent not in tried:
            tried[exponent] = Attempt(
                quantise(scene, scaled(steps, 2.0**exponent), reached, significant), measure, exponent
            )
        return tried[exponent]

    def tuned(exponent: float) -> Attempt:
        assert tune is not None
        return Attempt(tune(scaled(steps, 2.0**exponent), reached), measure, exponent)

    name, bound = trade.bound
    if name == "lam":
        found = minimise(finest, coarsest, attempt, lambda found: found.cost(bound))
        return found if tune is None else min(found, tuned(found.exponent), key=lambda found: found.cost(bound))
    value: Callable[[Attempt], float]
    if name == "target_bytes":
        if source_file is not None and (whole := attempt(0.0)).size_bytes <= bound:
            return whole
        start, end, most, slope, value = coarsest, finest, bound, BYTES_SLOPE, lambda found: found.size_bytes
    elif name == "quality":
        start, end, most, slope, value = (
            finest,
            coarsest,
            mse_of_quality(bound),
            ERROR_SLOPE,
            lambda found: found.measured.mse,
        )
    else:
        start, end, most, slope = finest, coarsest, trade.loss_db(uncoded_psnr), ERROR_SLOPE
        value = lambda found: uncoded_psnr - found.measured.psnr
    if tune is None:
        return find_limit(start, end, guess, attempt, value, most, slope, tolerance)
    by_size = name == "target_bytes"
    made, enough = (TUNED_BYTES, TUNED_BYTES_TOLERANCE) if by_size else (TUNED_ERROR, TUNED_ERROR_TOLERANCE)
    spent: Callable[[Attempt], float] = lambda found: found.measured.mse if by_size else found.size_bytes
    found = find_limit(start, end, guess, attempt, value, most, slope, ROUGH_TOLERANCE)
    better = find_tuned_limit(start, end, found, tried.values(), tuned, value, most, enough, made, slope)
    if better is not None and value(better) >= (1 - enough) * most and spent(better) < spent(found):
        return better
    found = find_limit(start, end, guess, attempt, value, most, slope, tolerance, tried.values())
    return better if better is not None and spent(better) < spent(found) else found
