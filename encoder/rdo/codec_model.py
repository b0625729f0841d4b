"""Coding of a trained model, as often as wanted: from a finished checkpoint, or from a .kpc file.

A checkpoint holds the scene in full precision, and training pixels on which codings are judged. A file holds the
scene as it was coded, and is judged by its own pictures.
"""

import math
from collections.abc import Callable, Collection, Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property, partial
from pathlib import Path

import numpy as np

from kpc.encoder.coding.scene_writer import fixed_bytes
from kpc.encoder.evaluation.validation_rays import Fidelity, Measure, ValidationRays
from kpc.encoder.rdo.curvature import Curvature, PerPlane, estimate_curvature
from kpc.encoder.rdo.distortion import PlaneKey
from kpc.encoder.rdo.mode_decision import BLOCK_SIDES, quantise_by_cost, requested_step
from kpc.encoder.rdo.model_checkpoint import CHECKPOINT_MAGIC, read_checkpoint
from kpc.encoder.rdo.motion_rdo import coarsen_motion
from kpc.encoder.rdo.occupancy_rdo import flip_errors, optimise_occupancy
from kpc.encoder.rdo.prune import Pruned, max_renderings, prune
from kpc.encoder.rdo.rate_control import (
    DECODER_SHARE,
    RENDERINGS,
    ROUGH_TOLERANCE,
    SLOTS_SHARE,
    TUNED_ERROR,
    Attempt,
    QuantiseFunction,
    RateController,
    Trade,
    choose_decoder_bits,
    loss_of_mse,
    mse_of_loss,
    reduce_slots,
    relative_steps,
    significance,
)
from kpc.encoder.rdo.rate_search import TOLERANCE
from kpc.encoder.rdo.sequential_finetune import quantise_sequentially, step_factors
from kpc.encoder.rdo.sharing import Sharing
from kpc.format.coding.quantise import QuantisedPlane, QuantisedScene, bfloat16_ceil, round_decoder, with_planes
from kpc.format.common.errors import TrainingError, UsageError
from kpc.format.common.progress import Progress
from kpc.format.container import scene_io
from kpc.format.container.container import MAGIC
from kpc.format.scene.motion import FINEST_STEP
from kpc.format.scene.scene import Decoder, Scene

QUICK_TOLERANCE = 0.05  # instead of TOLERANCE where coding takes less than its usual effort
REDUCTIONS = 20  # renderings to decide on slots, cells, motion and the decoder's bits, about
# For a target size, the loss that it costs is estimated at most MAX_ESTIMATES times: first with the whole model, then
# with what is selected at the loss found before, as long as the loss falls below ESTIMATE_RATIO of it each time
# (docs/design/rate-distortion.md, "Rate control").
MAX_ESTIMATES, ESTIMATE_RATIO = 4, 0.75


@dataclass(frozen=True)
class Model:
    """A scene to be coded.

    Attributes:
        scene: as trained, or as decoded from a file.
        validation: rays on which codings are judged.
        coded: the file's quantised scene; None for a scene in full precision.
        shown: whether to show the progress of measuring and coding it.
        effort: share of the usual rays on which errors are estimated. Below 1, fewer modes are tried, too, and the
            target is met less closely.
        sharing: planes that the scene shares with other groups of a clip; None for a scene by itself.
    """

    scene: Scene
    validation: ValidationRays
    coded: QuantisedScene | None = None
    shown: bool = False
    effort: float = 1.0
    sharing: Sharing | None = None

    @cached_property
    def curvature(self) -> Curvature:
        """What errors in planes cost (`kpc.encoder.rdo.curvature`)."""
        return estimate_curvature(self.scene, self.validation, effort=self.effort, shown=self.shown)

    @cached_property
    def flip_errors(self) -> np.ndarray:
        """What flipping a cell of the occupancy costs (`kpc.encoder.rdo.occupancy_rdo`)."""
        return flip_errors(self.scene, self.validation, round(1 / self.effort), self.shown)


@dataclass(frozen=True)
class CodedModel:
    """A coded model.

    Attributes:
        scene: what the file holds.
        data: the file.
        psnr: of its pictures against what was filmed, dB.
        loss_db: PSNR that coding costs on the validation rays, pruning included, dB.
        agreement_db: PSNR of its pictures against those of the model, dB.
        pruned: what was pruned; None if nothing was to be.
        spare_db: loss that pruning was allowed, dB.
    """

    scene: QuantisedScene
    data: bytes
    psnr: float
    loss_db: float
    agreement_db: float
    pruned: Pruned | None
    spare_db: float

    @property
    def size_bytes(self) -> int:
        return len(self.data)


@dataclass(frozen=True)
class Selection:
    """What of a model is coded, and at which relative precision.

    Attributes:
        scene: what is coded.
        coded: the file that holds just this scene; None where there is none.
        steps: quantisation steps of each plane, up to a common factor.
        significant: as for `kpc.encoder.rdo.mode_decision.quantise_by_cost`.
        correlation: as for `kpc.encoder.rdo.mode_decision.quantise_by_cost`.
        bits: of the decoder's weights, as for `kpc.format.coding.quantise.round_decoder`.
        pruned: as in `CodedModel`.
        spare_db: as in `CodedModel`.
    """

    scene: Scene
    coded: QuantisedScene | None
    steps: PerPlane
    significant: PerPlane
    correlation: PerPlane
    bits: Mapping[str, int] = field(default_factory=dict)
    pruned: Pruned | None = None
    spare_db: float = 0.0

    @staticmethod
    def all_of(model: Model) -> "Selection":
        """Select the whole model."""
        significant = significance(model.curvature.diagonal)
        steps: PerPlane = (
            relative_steps(significant)
            if model.coded is None
            else [{name: requested_step(plane) for name, plane in scale.items()} for scale in model.coded.scales]
        )
        return Selection(model.scene, model.coded, steps, significant, model.curvature.correlation)

    def reduce(self, model: Model, measure: Measure, loss_db: float, prune_share: float, grids: bool) -> "Selection":
        """Prune and coarsen all but the planes, as far as a share of the allowed loss permits.

        Args:
            model: of which this is the whole.
            measure: judges scenes.
            loss_db: that coding may cost in all, dB.
            prune_share: as for `code`.
            grids: as for `code`.
        """
        whole, chosen = measure(model.scene).psnr, replace(self, spare_db=prune_share * loss_db)
        mse = mse_of_loss(whole, loss_db)
        if chosen.spare_db > 0 and isinstance(self.scene.decoder, Decoder):  # pruning needs a linear decoder
            chosen = chosen._prune(model, measure)
        scene = chosen.scene
        if model.coded is None:  # else each time a file is coded again it would get more cells to march
            scene = reduce_slots(scene, measure, SLOTS_SHARE * mse)
            scene = optimise_occupancy(scene, model.flip_errors, measure, mse) if grids else scene
        own_multiple = 0
        if model.coded is not None and model.coded.motion is not None:
            own_multiple = round(model.coded.motion.step / FINEST_STEP)
        coarser = coarsen_motion(scene, model.curvature.motion if grids else None, measure, mse, own_multiple)
        if coarser is not scene:
            chosen = replace(chosen, coded=None)
        return replace(chosen, scene=coarser, bits=choose_decoder_bits(coarser, measure, DECODER_SHARE * mse))

    def _prune(self, model: Model, measure: Measure) -> "Selection":
        whole = None if model.sharing is None else model.sharing.scales
        pruned = prune(self.scene, model.validation.rays, lambda scene: measure(scene).psnr, self.spare_db, whole)
        if self.coded is not None and not pruned.removed_any:
            return replace(self, pruned=pruned)
        return replace(
            self,
            scene=pruned.scene,
            coded=None,
            steps=pruned.select_channels(self.steps),
            significant=pruned.select_channels(self.significant),
            correlation=pruned.select_channels(self.correlation, in_pairs=True),
            pruned=pruned,
        )


@dataclass(frozen=True)
class _Coder:
    """Codes a model; arguments as for `code`."""

    model: Model
    trade: Trade
    prune_share: float
    tune_steps: int
    quantise: QuantiseFunction | None
    grids: bool

    @cached_property
    def measure(self) -> Measure:
        return self.model.validation.measure(self.model.scene)

    @cached_property
    def uncoded_psnr(self) -> float:
        return self.measure(self.model.scene).psnr

    @cached_property
    def settled(self) -> Mapping[PlaneKey, QuantisedPlane]:
        return {} if self.model.sharing is None else self.model.sharing.settled

    @property
    def keeps_settled(self) -> bool:
        """Whether the file that is coded again, if there is one, holds the planes that are settled."""
        coded, sharing = self.model.coded, self.model.sharing
        return coded is None or sharing is None or sharing.is_kept_by(coded)

    def select(self) -> Selection:
        """Select what of the model is to be coded."""
        whole = Selection.all_of(self.model)
        if self.trade.target_bytes is None:
            return self._reduce(whole, self.trade.loss_db(self.uncoded_psnr))
        # What a size costs is known when it has been tried, and falls when bytes are saved elsewhere.
        chosen, loss_db, smaller = whole, math.inf, None
        for _ in range(MAX_ESTIMATES):
            found = self.meet(chosen, 0, ROUGH_TOLERANCE)
            if found.size_bytes <= self.trade.target_bytes:
                smaller = chosen
            elif smaller is not None:  # its loss was so small that too little was pruned for it
                return smaller
            lost = max(0.0, self.uncoded_psnr - found.measured.psnr)
            mse = (TUNED_ERROR if self.tune_steps else 1.0) * mse_of_loss(self.uncoded_psnr, lost)
            before, loss_db = loss_db, loss_of_mse(self.uncoded_psnr, mse)
            if loss_db >= ESTIMATE_RATIO * before:
                break
            chosen = self._reduce(whole, loss_db)
        return chosen

    def _reduce(self, whole: Selection, loss_db: float) -> Selection:
        features = sum(scale["xy"].shape[2] for scale in whole.scene.scales)
        total = max_renderings(features) + REDUCTIONS
        with Progress("pruning", total, "renderings", shown=self.model.shown) as progress:

            def measure(scene: Scene) -> Fidelity:
                progress.extend(1)
                found = self.measure(scene)
                progress.advance()
                return found

            return whole.reduce(self.model, measure, loss_db, self.prune_share, self.grids)

    def meet(self, chosen: Selection, tune_steps: int, tolerance: float) -> Attempt:
        """Quantise a selection so that it meets the target."""
        planes = sum(map(len, chosen.scene.scales))
        with Progress("choosing quantisation steps", RENDERINGS * planes, "planes", shown=self.model.shown) as progress:
            return self._meet(chosen, tune_steps, tolerance, progress)

    def _meet(self, chosen: Selection, tune_steps: int, tolerance: float, progress: Progress) -> Attempt:
        def quantise(
            scene: Scene,
            steps: PerPlane,
            looked_up: np.ndarray,
            significant: PerPlane,
            only: Collection[PlaneKey] | None = None,
        ) -> QuantisedScene:
            if self.quantise is not None:
                quantised = self.quantise(scene, steps, looked_up, significant)
            else:
                planes = [(s, name) for s, scale in enumerate(scene.scales) for name in scale]
                wanted = [key for key in planes if key not in self.settled and (only is None or key in only)]
                progress.extend(len(wanted))
                search = partial(
                    quantise_by_cost,
                    scene,
                    steps,
                    significant=significant,
                    correlation=chosen.correlation,
                    block_sides=BLOCK_SIDES if self.model.effort == 1 else BLOCK_SIDES[:1],
                    done=progress.advance,
                )
                quantised = self._search(search, looked_up, wanted)
            return replace(quantised, decoder=round_decoder(quantised.decoder, chosen.bits))

        def tune(steps: PerPlane, looked_up: np.ndarray) -> QuantisedScene:
            if self.model.coded is None:  # the steps of a file have the factors already
                factors = step_factors(chosen.scene)
                steps = [
                    {name: bfloat16_ceil(step * np.float32(factors[s, name])) for name, step in scale.items()}
                    for s, scale in enumerate(steps)
                ]

            def quantise_group(candidate: Scene, group: Sequence[PlaneKey]) -> QuantisedScene:
                return quantise(candidate, steps, looked_up, chosen.significant, group)

            return quantise_sequentially(
                chosen.scene, self.model.scene, quantise_group, tune_steps, self.model.shown, self.settled
            )

        controller = RateController(
            chosen.scene,
            chosen.steps,
            chosen.significant,
            self.measure,
            self.uncoded_psnr,
            chosen.coded if self.keeps_settled else None,
            quantise,
            tune if tune_steps else None,
            own_steps=self.model.coded is not None,
        )
        return controller.meet(self.trade, tolerance)

    def _search(
        self, search: Callable[..., QuantisedScene], looked_up: np.ndarray, wanted: Collection[PlaneKey]
    ) -> QuantisedScene:
        """Quantise a scene with its settled planes; those that later groups share are to hold where these need them."""
        sharing = self.model.sharing
        if sharing is None:
            return search(looked_up=looked_up, only=wanted)
        quantised = search(looked_up=looked_up, only=[key for key in wanted if key not in sharing.planes])
        shared = dict(self.settled)
        if own := [key for key in wanted if key in sharing.planes]:
            wide = search(looked_up=looked_up | sharing.cells, only=own, stores_maps=True)
            shared |= {(s, name): replace(wide.scales[s][name], stores_map=True) for s, name in own}
        return with_planes(quantised, shared)

    def coded(self, found: Attempt, pruned: Pruned | None = None, spare_db: float = 0.0) -> CodedModel:
        """Return the coded model that an attempt made; the other arguments as in `CodedModel`."""
        measured: Fidelity = found.measured
        loss_db = self.uncoded_psnr - measured.psnr
        return CodedModel(found.quantised, found.data, measured.psnr, loss_db, measured.agreement_db, pruned, spare_db)


def code(
    model: Model,
    trade: Trade,
    prune_share: float,
    tune_steps: int,
    quantise: QuantiseFunction | None = None,
    grids: bool = True,
) -> CodedModel:
    """Code a model so that it meets a rate-distortion target.

    Args:
        model: to be coded.
        trade: the target.
        prune_share: share of the loss that pruning may take (`kpc.encoder.rdo.prune`).
        tune_steps: steps of fine-tuning per group of planes (`kpc.encoder.rdo.sequential_finetune`); 0 for none.
        quantise: another way to choose symbols, for comparison.
        grids: whether to choose occupancy and displacements by rate and distortion. Otherwise they are only merged into
            fewer slots and rounded to coarser steps.

    Raises:
        TrainingError: no file of this model is as small as the target.
    """
    check_size(model.scene, trade, is_coded=model.coded is not None)
    coder = _Coder(model, trade, prune_share, tune_steps, quantise, grids)
    unchanged = None
    if model.coded is not None and coder.keeps_settled:
        unchanged = Attempt(model.coded, coder.measure, 0.0)
    if unchanged is not None and trade.target_bytes is not None and unchanged.size_bytes <= trade.target_bytes:
        return coder.coded(unchanged)  # no other is better
    chosen = coder.select()
    tolerance = TOLERANCE if model.effort == 1 else QUICK_TOLERANCE
    found, pruned = coder.meet(chosen, tune_steps, tolerance), chosen.pruned
    if trade.target_bytes is not None and found.size_bytes > trade.target_bytes:
        raise TrainingError(
            f"{found.size_bytes:,} bytes is the smallest size of this model, and --target-size leaves "
            f"{trade.target_bytes:,} for it; give a larger one, or train anew with a smaller --preset"
        )
    if unchanged is not None:

        def spent(one: Attempt) -> float:
            if trade.lam is None:
                return one.size_bytes
            return one.cost(trade.lam, model.scene.parameter_count)  # of the same number, whatever was pruned

        if spent(unchanged) <= spent(found):
            found, pruned = unchanged, None
    return coder.coded(found, pruned, chosen.spare_db)


def check_size(scene: Scene | QuantisedScene, trade: Trade, *, is_coded: bool) -> None:
    """Refuse a target size that no choice of steps can reach, before the search for one.

    Args:
        scene: to be coded.
        trade: the target.
        is_coded: whether it comes from a file, whose cells stay as they are; those of a trained scene are to be chosen.

    Raises:
        TrainingError: what coding leaves as it is takes more.
    """
    trade.check_size(scene.sound, fixed_bytes(scene, with_occupancy=is_coded), is_coded)


def load(path: Path) -> Model:
    """Read a finished checkpoint or a .kpc file.

    Raises:
        UsageError: it is neither.
        TrainingError: the checkpoint cannot be used.
        FormatError: the file cannot be read.
    """
    return model_from_file(scene_io.read(path)) if is_coded(path) else load_checkpoint(path)


def is_coded(path: Path) -> bool:
    """Return whether a file is a .kpc file, by its first bytes; False for a checkpoint.

    Raises:
        UsageError: it is neither.
    """
    if starts_with(path, MAGIC):
        return True
    if starts_with(path, CHECKPOINT_MAGIC):
        return False
    raise UsageError(f"{path}: neither a folder of videos or images, nor a finished checkpoint, nor a .kpc file")


def load_checkpoint(path: Path) -> Model:
    """Read a finished checkpoint; raises as `kpc.encoder.rdo.model_checkpoint.read_checkpoint`."""
    return Model(*read_checkpoint(path))


def starts_with(path: Path, magic: bytes) -> bool:
    """Return whether a file starts with some bytes."""
    with path.open("rb") as opened:
        return opened.read(len(magic)) == magic


def model_from_file(coded: QuantisedScene) -> Model:
    """Return a model to code a file's scene again."""
    coded = widen_single_texels(coded)
    scene = coded.dequantise()
    return Model(scene, ValidationRays.from_cameras(scene), coded)


def widen_single_texels(coded: QuantisedScene) -> QuantisedScene:
    """Return the scene with at least two texels along both axes of every plane, as training requires; same pictures.

    Files may hold planes of one texel along an axis, which are constant along it.
    """

    def widen(plane: QuantisedPlane) -> QuantisedPlane:
        down, across = (2 if size == 1 else 1 for size in plane.coded.shape)
        symbols, known = (a.repeat(down, axis=0).repeat(across, axis=1) for a in (plane.symbols, plane.coded))
        return replace(plane, symbols=symbols, coded=known)

    return replace(coded, scales=tuple({name: widen(plane) for name, plane in scale.items()} for scale in coded.scales))
