"""Rate control: from a scene and a rate-distortion target to quantised planes.

One factor on all quantisation steps sets the trade-off between size and fidelity. A user states what is wanted
(`Trade`), and the factor that brings it is searched for (`kpc.encoder.rdo.rate_search`). Relative to each other, the
steps of all channels are such that a bit spent on any of them gains the same (`relative_steps`).

Distortion D is an MSE on the 8-bit scale (`kpc.encoder.evaluation.validation_rays`), rate R is in bits per parameter
of the model. Figures behind the constants: docs/design/rate-distortion.md, "Rate control".
"""

import math
from collections.abc import Callable, Iterable, Mapping
from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np

from kpc.encoder.coding import scene_writer
from kpc.encoder.evaluation.validation_rays import Fidelity, Measure, mse_of_psnr
from kpc.encoder.field.occupancy_grid import merge_slots
from kpc.encoder.rdo.curvature import PerPlane
from kpc.encoder.rdo.mode_decision import quantise_by_cost
from kpc.encoder.rdo.rate_search import COST_OCTAVES, TOLERANCE, find_limit, find_tuned_limit, minimise
from kpc.format.coding.quantise import (
    HALF_BITS,
    QuantisedScene,
    bfloat16_ceil,
    decoder_arrays,
    looked_up_cells,
    round_decoder,
)
from kpc.format.common.errors import TrainingError
from kpc.format.container.container import ENTRY, HEADER
from kpc.format.scene.scene import Scene
from kpc.format.scene.sound import Sound

# Base-two logarithms of the factors on all steps, between which one is searched for a trained scene.
FINEST, COARSEST = -13.0, 2.0
RECODE_COARSEST = 12.0  # the coarsest for a file that is coded again; the finest is the file's own, 0
FIRST_GUESS, RECODE_GUESS = -9.5, 1.0  # where searches begin
# Expected change of log value per octave: of errors, with the square of coarser steps; of bytes, with finer steps.
ERROR_SLOPE, BYTES_SLOPE = 2 * math.log(2), 0.5
ROUGH_TOLERANCE = 0.2  # tolerance of searches that only locate where to tune, or what a size costs
RENDERINGS = 8  # scenes that a search renders, about

DEFAULT_LOSS_DB = 0.15  # PSNR that coding may cost where no target is given

# A fine-tuned coding this share below the bytes or the error that it may not exceed is good enough at first, later ones
# further below (`find_tuned_limit`): its error is predicted less well.
TUNED_BYTES_TOLERANCE, TUNED_ERROR_TOLERANCE = 0.05, 0.1
TUNED_ERROR, TUNED_BYTES = 0.7, 1.01  # error and bytes with fine-tuning, as a share of those without, about
LEAST_TUNED_ERROR = 0.4  # less than fine-tuning was seen to leave of the error; 0.5 was
SIGNIFICANCE_EXPONENT = 0.8  # of curvature in `significance`; 1 makes files 1 to 2 % larger
# Share of the allowed error that fewer slots of the occupancy may take, and how many more cells, at most, a player then
# has to march.
SLOTS_SHARE, MORE_CELLS = 0.05, 1 / 3
# Share of the allowed error that fewer bits of the decoder's weights may take, and the fewest bits.
DECODER_SHARE, FEWEST_BITS = 0.02, 3
MIN_SIGNIFICANCE = 1e-6  # of a channel, relative to the most important of all values

# Quantisation steps, (M,) per plane: one mapping per scale, from the plane's name.
Steps = list[dict[str, np.ndarray]]
# Quantises a scene, given the steps, the cells that are looked up (`looked_up_cells`) and the significance of each
# value.
QuantiseFunction = Callable[[Scene, PerPlane, np.ndarray, PerPlane], QuantisedScene]
# Quantises a fixed scene with fine-tuning, given the steps and the cells that are looked up.
TuneFunction = Callable[[PerPlane, np.ndarray], QuantisedScene]


# Chunks that every file has: scene, decoder, occupancy, and the three space planes of a scale.
MIN_CHUNKS = 6


@dataclass(frozen=True)
class Trade:
    """The rate-distortion target: at most one of these is set; none stands for a loss of DEFAULT_LOSS_DB.

    Attributes:
        max_loss_db: PSNR that coding may cost on training views, pruning included, dB.
        target_bytes: size that the file may not exceed.
        quality: from 1 to 100; the PSNR of coded against uncoded pictures is at least `agreement_of` it, dB.
        lam: lambda of the Lagrangian cost J = D + lambda R that is minimised.
        psnr_db: PSNR that the file reaches at least on training views, dB. Where the model itself does not reach it, as
            if no target was set.
    """

    max_loss_db: float | None = None
    target_bytes: int | None = None
    quality: float | None = None
    lam: float | None = None
    psnr_db: float | None = None

    @property
    def bound(self) -> tuple[str, float]:
        """The name of the attribute that is set, and its value."""
        for name in ("target_bytes", "quality", "lam", "psnr_db", "max_loss_db"):
            if (value := getattr(self, name)) is not None:
                return name, float(value)
        return "max_loss_db", DEFAULT_LOSS_DB

    def check_size(self, sound: Sound | None, fixed: int = 0, is_coded: bool = False) -> None:
        """Refuse a size that what is not coded by rate and distortion takes alone, before hours are spent.

        Args:
            sound: of the file.
            fixed: bytes that all files of the model have, sound included (`scene_writer.fixed_bytes`); 0 before there
                is a model.
            is_coded: whether the sound comes from a .kpc file, which keeps it.

        Raises:
            TrainingError: they take more.
        """
        heard = 0 if sound is None else sum(map(len, sound.packets))
        least = max(fixed, HEADER.size + MIN_CHUNKS * ENTRY.size + heard)
        if self.target_bytes is not None and self.target_bytes < least:
            what = "what no quantisation step shrinks (occupancy, cameras, metadata, sound)"
            what = what if fixed == least else "header, index and sound alone"
            less = "; a .kpc file keeps its sound, so encode the dataset" if is_coded else ", or encode"
            remedy = f"{less} with less sound (--audio-bitrate, --audio none)" if heard else ""
            raise TrainingError(
                f"--target-size leaves {self.target_bytes:,} bytes for the scene, and {what} "
                f"take{'s' * (fixed == least)} {least:,}; give a larger size{remedy}"
            )

    def loss_db(self, psnr: float) -> float:
        """Return the PSNR that coding may cost, about, dB; NaN for a size, of which that is not known.

        Args:
            psnr: of the uncoded scene, dB. D is assumed to add to its mean squared error.
        """
        name, value = self.bound
        if name == "target_bytes":
            return math.nan
        if name == "max_loss_db":
            return value
        if name == "psnr_db":
            return psnr - value if psnr > value else DEFAULT_LOSS_DB
        # At high rate D falls to a quarter with each bit, so that its slope is -2 ln 2 D = -lambda.
        mse = mse_of_quality(value) if name == "quality" else value / (2 * math.log(2))
        return loss_of_mse(psnr, mse)


def agreement_of(quality: float) -> float:
    """Return the PSNR of coded against uncoded pictures, dB, of a quality from 1 to 100: 20 + quality / 3."""
    return 20 + quality / 3


def mse_of_quality(quality: float) -> float:
    """Return the MSE, on the 8-bit scale, of a quality from 1 to 100."""
    return mse_of_psnr(agreement_of(quality))


def mse_of_loss(psnr: float, loss_db: float) -> float:
    """Return the MSE, on the 8-bit scale, that costs pictures of a PSNR `loss_db` when it adds to their own."""
    return mse_of_psnr(psnr) * (10 ** (loss_db / 10) - 1)


def loss_of_mse(psnr: float, mse: float) -> float:
    """Return the loss in dB; the inverse of `mse_of_loss`."""
    return 10 * math.log10(1 + mse / mse_of_psnr(psnr))


@dataclass(frozen=True)
class Attempt:
    """A scene quantised with steps scaled by 2^exponent; its file and its fidelity are computed on demand."""

    quantised: QuantisedScene
    measure: Measure
    exponent: float

    @cached_property
    def data(self) -> bytes:
        """The encoded file."""
        return scene_writer.encode(self.quantised)

    @property
    def size_bytes(self) -> int:
        return len(self.data)

    @cached_property
    def measured(self) -> Fidelity:
        return self.measure(self.quantised.dequantise())

    def cost(self, lam: float, parameters: int | None = None) -> float:
        """Return the Lagrangian cost J = D + lambda R, R in bits for each of `parameters`, by default the scene's."""
        return self.measured.mse + lam * 8 * self.size_bytes / (parameters or self.quantised.parameter_count)


def significance(diagonal: PerPlane) -> list[dict[str, np.ndarray]]:
    """Return the relative cost of a squared error in each value: (h / max h)^SIGNIFICANCE_EXPONENT, float32.

    The exponent allows for what the diagonal h of the curvature misses: cross terms, and rays that were not drawn,
    make unimportant values more important.

    Args:
        diagonal: `Curvature.diagonal`.
    """
    largest = max(float(h.max()) for scale in diagonal for h in scale.values()) or 1.0
    exponent = np.float32(SIGNIFICANCE_EXPONENT)
    return [{name: (h / np.float32(largest)) ** exponent for name, h in scale.items()} for scale in diagonal]


def reduce_slots(scene: Scene, measure: Measure, mse: float) -> Scene:
    """Merge time slots of the occupancy if that adds at most `mse` (8-bit scale) and a share MORE_CELLS of cells."""
    merged = merge_slots(scene.occupancy, MORE_CELLS)
    if len(merged) == len(scene.occupancy):
        return scene
    candidate = replace(scene, occupancy=merged)
    return candidate if measure(candidate).mse - measure(scene).mse <= mse else scene


def choose_decoder_bits(scene: Scene, measure: Measure, mse: float) -> dict[str, int]:
    """Return the fewest bits per weight, for each array of the decoder, which together add at most `mse`.

    The bits are lowered for all arrays alike first, then for one array after the other, the largest first.

    Args:
        scene: with the decoder.
        measure: judges scenes.
        mse: on the 8-bit scale.

    Returns:
        Bits by the array's name, for `round_decoder`; empty where HALF_BITS are too few.
    """
    known, weights = measure(scene).mse, decoder_arrays(scene.decoder)

    def suffices(bits: dict[str, int]) -> bool:
        return measure(replace(scene, decoder=round_decoder(scene.decoder, bits))).mse - known <= mse

    uniform = (dict.fromkeys(weights, count) for count in range(FEWEST_BITS, HALF_BITS + 1))
    bits = next(filter(suffices, uniform), {})
    for name in sorted(bits, key=lambda name: -weights[name].size):
        while bits[name] > FEWEST_BITS and suffices(fewer := bits | {name: bits[name] - 1}):
            bits = fewer
    return bits


def relative_steps(significant: PerPlane) -> Steps:
    """Return quantisation steps, up to a common factor, at which a bit spent on any channel gains the same.

    The error of a uniform quantiser of step d is proportional to d^2; it costs w, its significance, per unit. The rate
    falls by one bit with each doubling of d. Slopes are equal where the mean of w d^2 is: d = 1 / sqrt(mean w), the
    mean over texels of nonzero significance. Channels without any get the coarsest step of all.

    Args:
        significant: (H, W, M) per plane.
    """
    return [
        {name: np.maximum(_nonzero_means(w), MIN_SIGNIFICANCE) ** -0.5 for name, w in scale.items()}
        for scale in significant
    ]


def _nonzero_means(values: np.ndarray) -> np.ndarray:
    """Return (M,) float64 means of the nonzero values of (H, W, M)."""
    flat = values.reshape(-1, values.shape[-1])
    return flat.sum(0, dtype=np.float64) / np.maximum(np.count_nonzero(flat, axis=0), 1)


def scaled(steps: PerPlane, factor: float) -> list[Mapping[str, np.ndarray]]:
    """Return all steps times a factor, rounded up to float32 of 8 significant bits."""
    return [
        {name: bfloat16_ceil((step * factor).astype(np.float32)) for name, step in scale.items()} for scale in steps
    ]


@dataclass(frozen=True)
class _Goal:
    """A limit on size or error, for `find_limit`: `value` rises from exponent `start` to `end`."""

    start: float
    end: float
    limit: float
    slope: float
    value: Callable[[Attempt], float]


@dataclass(frozen=True)
class RateController:
    """Finds the quantisation of a scene that meets a rate-distortion target.

    Attributes:
        scene: to be coded.
        steps: of its planes, up to a common factor; of a file that is coded again, its own.
        significant: cost of a squared error in each value, (H, W, M) per plane.
        measure: judges a coding.
        uncoded_psnr: of the scene before anything was pruned, dB.
        source_file: the file that holds just this scene, with these steps.
        quantise: chooses the symbols.
        tune: quantises with fine-tuning, which is better and slow. Where given, its result is to meet the target.
        own_steps: whether `steps` are those of a file that was pruned since; finer steps then gain nothing.
    """

    scene: Scene
    steps: PerPlane
    significant: PerPlane
    measure: Measure
    uncoded_psnr: float
    source_file: QuantisedScene | None = None
    quantise: QuantiseFunction = quantise_by_cost
    tune: TuneFunction | None = None
    own_steps: bool = False

    @cached_property
    def _looked_up(self) -> np.ndarray:
        return looked_up_cells(self.scene)

    @cached_property
    def _tried(self) -> dict[float, Attempt]:
        return {}

    def meet(self, trade: Trade, tolerance: float = TOLERANCE) -> Attempt:
        """Return the quantisation that meets a target; of a size that no file has, the smallest.

        Args:
            trade: the target.
            tolerance: as for `kpc.encoder.rdo.rate_search.find_limit`.
        """
        own_steps = self.own_steps or self.source_file is not None
        finest, coarsest, guess = (0.0, RECODE_COARSEST, RECODE_GUESS) if own_steps else (FINEST, COARSEST, FIRST_GUESS)
        name, bound = trade.bound
        if self._is_beyond(trade):
            return self._attempt(0.0)
        if name == "lam":
            found = minimise(finest, coarsest, self._attempt, lambda one: one.cost(bound))
            if self.tune is None:
                return found
            least = found.cost(bound) - (1 - LEAST_TUNED_ERROR) * found.measured.mse
            if self.source_file is not None and least >= self._attempt(0.0).cost(bound):
                return self._attempt(0.0)  # without minutes of fine-tuning
            return min(found, self._tuned(found.exponent), key=lambda one: one.cost(bound))
        goal = self._goal(trade, finest, coarsest)
        if self.tune is None:
            return self._search(goal, guess, tolerance)
        return self._search_tuned(goal, guess, tolerance, name == "target_bytes")

    def _is_beyond(self, trade: Trade) -> bool:
        """Return whether any other coding than the source file errs too much, so that there is nothing to search for.

        Numbers that are rounded once more, by other steps, err at once, and ever more with coarser steps. So the finest
        other coding decides: its error, less what fine-tuning may take off it, against all that the target permits.
        """
        name, bound = trade.bound
        if self.source_file is None or name == "target_bytes":
            return False
        error = self._attempt(COST_OCTAVES).measured.mse * (1 if self.tune is None else LEAST_TUNED_ERROR)
        if name == "lam":
            return error >= self._attempt(0.0).cost(bound)
        return error > mse_of_loss(self.uncoded_psnr, trade.loss_db(self.uncoded_psnr))

    def _attempt(self, exponent: float) -> Attempt:
        if self.source_file is not None and exponent == 0:
            return Attempt(self.source_file, self.measure, exponent)
        if exponent not in self._tried:
            steps = scaled(self.steps, 2.0**exponent)
            quantised = self.quantise(self.scene, steps, self._looked_up, self.significant)
            self._tried[exponent] = Attempt(quantised, self.measure, exponent)
        return self._tried[exponent]

    def _tuned(self, exponent: float) -> Attempt:
        assert self.tune is not None
        return Attempt(self.tune(scaled(self.steps, 2.0**exponent), self._looked_up), self.measure, exponent)

    def _goal(self, trade: Trade, finest: float, coarsest: float) -> _Goal:
        name, bound = trade.bound
        if name == "target_bytes":
            return _Goal(coarsest, finest, bound, BYTES_SLOPE, lambda one: one.size_bytes)
        if name == "quality":
            return _Goal(finest, coarsest, mse_of_quality(bound), ERROR_SLOPE, lambda one: one.measured.mse)
        limit = trade.loss_db(self.uncoded_psnr)
        return _Goal(finest, coarsest, limit, ERROR_SLOPE, lambda one: self.uncoded_psnr - one.measured.psnr)

    def _search(self, goal: _Goal, guess: float, tolerance: float, tried: Iterable[Attempt] = ()) -> Attempt:
        return find_limit(
            goal.start, goal.end, guess, self._attempt, goal.value, goal.limit, goal.slope, tolerance, tried
        )

    def _search_tuned(self, goal: _Goal, guess: float, tolerance: float, by_size: bool) -> Attempt:
        """Meet the goal with fine-tuning, unless a coding without is better.

        Without, the search first only comes near the limit, and goes on where it may still beat fine-tuning.
        """
        gain, enough = (TUNED_BYTES, TUNED_BYTES_TOLERANCE) if by_size else (TUNED_ERROR, TUNED_ERROR_TOLERANCE)

        def spent(one: Attempt) -> float:
            return one.measured.mse if by_size else one.size_bytes

        found = self._search(goal, guess, ROUGH_TOLERANCE)
        better = find_tuned_limit(
            goal.start,
            goal.end,
            found,
            self._tried.values(),
            self._tuned,
            goal.value,
            goal.limit,
            enough,
            gain,
            goal.slope,
        )
        if better is not None and spent(better) < self._expected(found, goal, spent, by_size):
            return better
        found = self._search(goal, guess, tolerance, self._tried.values())
        return better if better is not None and spent(better) < spent(found) else found

    def _expected(self, found: Attempt, goal: _Goal, spent: Callable[[Attempt], float], by_size: bool) -> float:
        """Return what a coding without fine-tuning would spend at the limit, by one that is `found` within it.

        What is spent is taken as a power of the value: from `found` and the nearest attempt beyond the limit, or of the
        usual exponent where none was made.
        """
        power = -ERROR_SLOPE / BYTES_SLOPE if by_size else -BYTES_SLOPE / ERROR_SLOPE
        beyond = (one for one in self._tried.values() if goal.value(one) > goal.limit)
        value, nearest = goal.value(found), min(beyond, key=goal.value, default=None)
        if nearest is not None and 0 < spent(nearest) < spent(found):
            power = math.log(spent(nearest) / spent(found)) / math.log(goal.value(nearest) / value)
        return spent(found) * (goal.limit / value) ** power
