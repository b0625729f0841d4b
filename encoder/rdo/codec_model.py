"""What training made, ready to be coded, again and again: a finished checkpoint, or a .kpc file.

A checkpoint holds the scene in full precision, and training pixels to judge codings by. A file holds the scene as it was coded, and is
judged by its own pictures.
"""

import math
import zipfile
from collections.abc import Collection, Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property
from pathlib import Path
from typing import Any

import numpy as np
import torch
from kpc.encoder.evaluation.validation_rays import Fidelity, Measure, ValidationRays
from kpc.encoder.rdo.curvature import Curvature, PerPlane, estimate_curvature
from kpc.encoder.rdo.distortion import PlaneKey
from kpc.encoder.rdo.mode_decision import quantise_by_cost, requested_step
from kpc.encoder.rdo.motion_rdo import coarsen_motion
from kpc.encoder.rdo.occupancy_rdo import flip_errors, optimise_occupancy
from kpc.encoder.rdo.prune import Pruned, prune
from kpc.encoder.rdo.rate_control import (
    DECODER_SHARE,
    ROUGH_TOLERANCE,
    SLOTS_SHARE,
    TUNED_ERROR,
    Attempt,
    QuantiseFunction,
    Trade,
    choose_decoder_bits,
    loss_of_mse,
    meet_trade,
    mse_of_loss,
    reduce_slots,
    relative_steps,
    significance,
)
from kpc.encoder.rdo.rate_search import TOLERANCE
from kpc.encoder.rdo.sequential_finetune import quantise_sequentially, step_factors
from kpc.encoder.training.checkpoint import save_state
from kpc.format.coding.quantise import QuantisedPlane, QuantisedScene, bfloat16_ceil, quantise_scene, round_decoder
from kpc.format.common.errors import FormatError, TrainingError, UsageError
from kpc.format.container import scene_io
from kpc.format.container.container import MAGIC
from kpc.format.scene.cameras import Camera
from kpc.format.scene.motion import FINEST_STEP
from kpc.format.scene.scene import Appearance, Clip, Decoder, HybridDecoder, Scene
from kpc.format.scene.space import Contraction, DeviceCoordinates, SpaceMapping

CHECKPOINT_MAGIC = b"PK"
"""PyTorch writes ZIP archives."""
VERSION = 1
"""Of a finished checkpoint."""
LOOKS, LESS = 4, 0.75
"""At what a size costs, at most: with all of a model, then with what it needs if that is what it may cost, as long as that is less, by so much.
Soldier in 42,500 bytes loses 0.63 dB; with one look 0.99, by what left-out channels, cells and displacements cost."""


@dataclass(frozen=True)
class Model:
    """A scene to be coded.

    Attributes:
        scene: as trained, or as a file holds it.
        probe: rays to judge codings by.
        coded: the file as it is; None for a scene in full precision.
    """

    scene: Scene
    probe: ValidationRays
    coded: QuantisedScene | None = None

    @cached_property
    def curvature(self) -> Curvature:
        """What errors cost, `kpc.encoder.rdo.curvature`."""
        return estimate_curvature(self.scene, self.probe)

    @cached_property
    def flip_errors(self) -> np.ndarray:
        """What it costs to tell a cell otherwise than it is, `kpc.encoder.rdo.occupancy_rdo`."""
        return flip_errors(self.scene, self.probe)


@dataclass(frozen=True)
class CodedModel:
    """What became of a model.

    Attributes:
        scene: what the file is to hold. data: that file.
        loss_db: PSNR that coding costs on the probe rays, all that was left out included.
        psnr: of its pictures against what was filmed, dB.
        agreement_db: PSNR of its pictures against those of the model.
        pruned: what was left out; None if nothing was to be.
        spare_db: that could have been spent on it.
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
    """What of a model is to be coded, and how finely each number of it.

    Attributes:
        scene: as it is coded; `coded`: the file that holds just this scene, None where there is none.
        steps: of each plane, up to one factor. significant, together: as of `kpc.encoder.rdo.mode_decision.quantise_by_cost`.
        bits: of the decoder's weights, as of `kpc.format.coding.quantise.round_decoder`.
        pruned, spare_db: as of `CodedModel`.
    """

    scene: Scene
    coded: QuantisedScene | None
    steps: PerPlane
    significant: PerPlane
    together: PerPlane
    bits: Mapping[str, int] = field(default_factory=dict)
    pruned: Pruned | None = None
    spare_db: float = 0.0

    @staticmethod
    def all_of(model: Model) -> "Selection":
        significant = significance(model.curvature.diagonal)
        steps: PerPlane = (
            relative_steps(significant)
            if model.coded is None
            else [{name: requested_step(plane) for name, plane in scale.items()} for scale in model.coded.scales]
        )
        return Selection(model.scene, model.coded, steps, significant, model.curvature.correlation)

    def needed(self, model: Model, measure: Measure, loss_db: float, prune_share: float, grids: bool) -> "Selection":
        """What of all of a model its pictures need, if coding may cost them `loss_db`; other arguments as of `code`."""
        whole, kept = measure(model.scene).psnr, replace(self, spare_db=prune_share * loss_db)
        error = mse_of_loss(whole, loss_db)
        if kept.spare_db > 0 and isinstance(self.scene.decoder, Decoder):  # no other is linear
            pruned = prune(self.scene, model.probe.rays, lambda candidate: measure(candidate).psnr, kept.spare_db)
            kept = replace(kept, pruned=pruned)
            if self.coded is None or pruned.removed_any:
                kept = replace(kept, scene=pruned.scene, coded=None, steps=pruned.select_channels(self.steps),
                               significant=pruned.select_channels(self.significant),
                               together=pruned.select_channels(self.together, in_pairs=True))  # fmt: skip
        scene = kept.scene
        if model.coded is None:  # a file that is coded again and again is not to be marched ever longer
            scene = reduce_slots(scene, measure, SLOTS_SHARE * error)
            scene = optimise_occupancy(scene, model.flip_errors, measure, error) if grids else scene
        own = 0 if model.coded is None or model.coded.motion is None else round(model.coded.motion.step / FINEST_STEP)
        coarser = coarsen_motion(scene, model.curvature.motion if grids else None, measure, error, own)
        if coarser is not scene:
            kept = replace(kept, coded=None)
        return replace(kept, scene=coarser, bits=choose_decoder_bits(coarser, measure, DECODER_SHARE * error))


def code(
    model: Model,
    trade: Trade,
    prune_share: float,
    tune_steps: int,
    quantise: QuantiseFunction | None = None,
    shown: bool = False,
    grids: bool = True,
) -> CodedModel:
    """What of a model is needed, `kpc.encoder.rdo.prune`, in symbols as coarse or as fine as a trade asks for.

    Args:
        prune_share: of what coding may cost, what may be spent on leaving something out.
        tune_steps: of training that a group of planes gets to make up for others, `kpc.encoder.rdo.sequential_finetune`; 0 for none.
        quantise: another way to choose symbols, to compare with; not tuned.
        shown: whether progress is, where it takes long.
        grids: whether occupancy and displacements are such as take few bits; else as they are, but for fewer slots and coarser steps.

    Raises:
        TrainingError: no file of this model is so small.
    """
    measure = model.probe.measure(model.scene)
    whole = measure(model.scene).psnr

    def met(kept: Selection, tune_steps: int, tolerance: float) -> Attempt:
        def chosen(
            scene: Scene,
            steps: PerPlane,
            reached: np.ndarray,
            significant: PerPlane,
            only: Collection[PlaneKey] | None = None,
        ) -> QuantisedScene:
            if quantise is not None:
                quantised = quantise(scene, steps, reached, significant)
            else:
                quantised = quantise_by_cost(scene, steps, reached, significant, only, kept.together)
            return replace(quantised, decoder=round_decoder(quantised.decoder, kept.bits))

        def tune(steps: PerPlane, reached: np.ndarray) -> QuantisedScene:
            if model.coded is None:  # steps of a file were spread when it was made
                factors = step_factors(kept.scene)
                steps = [
                    {name: bfloat16_ceil(step * np.float32(factors[s, name])) for name, step in scale.items()}
                    for s, scale in enumerate(steps)
                ]

            def choose(candidate: Scene, group: Sequence[PlaneKey]) -> QuantisedScene:
                return chosen(candidate, steps, reached, kept.significant, group)

            return quantise_sequentially(kept.scene, model.scene, choose, tune_steps, shown)

        return meet_trade(
            kept.scene,
            kept.steps,
            kept.significant,
            measure,
            whole,
            trade,
            kept.coded,
            chosen,
            tune if tune_steps else None,
            own_steps=model.coded is not None,
            tolerance=tolerance,
        )

    def needed(loss_db: float) -> Selection:
        return every.needed(model, measure, loss_db, prune_share, grids)

    every = Selection.all_of(model)
    if trade.target_bytes is None:
        kept = needed(trade.loss_db(whole))
    else:  # what that costs is known when it has been tried, and less when bytes are spared elsewhere
        kept, loss_db = every, math.inf
        for _ in range(LOOKS):
            lost = max(0.0, whole - met(kept, 0, ROUGH_TOLERANCE).measured.psnr)
            before, loss_db = (
                loss_db,
                loss_of_mse(whole, (TUNED_ERROR if tune_steps else 1.0) * mse_of_loss(whole, lost)),
            )
            if loss_db >= LESS * before:
                break
            kept = needed(loss_db)
    found, pruned = met(kept, tune_steps, TOLERANCE), kept.pruned
    if trade.target_bytes is not None and found.size_bytes > trade.target_bytes:
        raise TrainingError(
            f"{found.size_bytes:,} bytes is the least that this model takes, not {trade.target_bytes:,}; give "
            "another --target-size, or train anew with a smaller --preset"
        )
    if model.coded is not None and (as_it_was := Attempt(model.coded, measure, 0.0)).size_bytes <= found.size_bytes:
        found, pruned = as_it_was, None
    measured: Fidelity = found.measured
    return CodedModel(
        found.quantised, found.data, measured.psnr, whole - measured.psnr, measured.agreement_db, pruned, kept.spare_db
    )


def load(path: Path) -> Model:
    """A finished checkpoint or a .kpc file, whichever it is.

    Raises:
        UsageError: it is neither. TrainingError: the checkpoint cannot be used. FormatError: the file cannot be read.
    """
    if starts_with(path, MAGIC):
        return model_from_file(scene_io.read(path))
    if starts_with(path, CHECKPOINT_MAGIC):
        return load_checkpoint(path)
    raise UsageError(f"{path}: neither a folder of videos or images, nor a finished checkpoint, nor a .kpc file")


def starts_with(path: Path, magic: bytes) -> bool:
    """Whether a file is of the kind that begins so."""
    with path.open("rb") as opened:
        return opened.read(len(magic)) == magic


def model_from_file(coded: QuantisedScene) -> Model:
    """A scene as a file holds it, to be coded again."""
    coded = widen_single_texels(coded)
    scene = coded.dequantise()
    return Model(scene, ValidationRays.from_cameras(scene), coded)


def widen_single_texels(coded: QuantisedScene) -> QuantisedScene:
    """The same pictures of planes with at least two texels along either axis, as training wants them: files may hold one, all along the axis."""

    def widened(plane: QuantisedPlane) -> QuantisedPlane:
        twice = [2 if size == 1 else 1 for size in plane.coded.shape]
        symbols, known = (a.repeat(twice[0], axis=0).repeat(twice[1], axis=1) for a in (plane.symbols, plane.coded))
        return replace(plane, symbols=symbols, coded=known)

    return replace(
        coded, scales=tuple({name: widened(plane) for name, plane in scale.items()} for scale in coded.scales)
    )


# --- finished checkpoints


def save_checkpoint(path: Path, scene: Scene, probe: ValidationRays) -> None:
    """Write all that coding asks for, as plain tensors and numbers.

    Raises:
        TrainingError: it cannot be written; what was there is left as it was.
    """
    kind = "hybrid" if isinstance(scene.decoder, HybridDecoder) else "explicit"
    state = {
        "kpc": VERSION,
        "aabb": scene.aabb,
        "frame_count": scene.clip.frame_count,
        "fps": float(scene.clip.fps),
        "scales": scene.scales,
        "kind": kind,
        "decoder": vars(scene.decoder),
        "occupancy": scene.occupancy,
        "background": scene.background,
        "step": float(scene.step),
        "cameras": np.array([_camera_as_numbers(camera) for camera in scene.cameras]).reshape(-1, 22),
        "mapping": _mapping_as_numbers(scene.mapping),
        "motion": scene.motion,
        "names": [appearance.name for appearance in scene.appearances],
        "codes": [appearance.code for appearance in scene.appearances],
        "probe": vars(probe),
    }
    state = _changed(state, np.ndarray, lambda a: torch.from_numpy(np.ascontiguousarray(a)))
    save_state(path, state, "name another --keep-checkpoint")


def load_checkpoint(path: Path) -> Model:
    """What `save_checkpoint` wrote. Nothing in it is executed, and it takes no more memory than a few times its size.

    Raises:
        TrainingError: it is something else, damaged, or breaks a rule that files must keep.
    """
    try:
        with zipfile.ZipFile(path) as archive:  # what is not compressed cannot grow
            entries = archive.infolist()
            if any(entry.compress_type for entry in entries) or sum(e.file_size for e in entries) > path.stat().st_size:
                raise ValueError("compressed")
        state = torch.load(path, map_location="cpu", weights_only=True)
        if not isinstance(state, dict) or state.get("kpc") != VERSION:
            raise TrainingError(
                f"{path}: no finished checkpoint; kpenc DATASET --keep-checkpoint writes one, --resume goes on "
                "from one of a run"
            )
        state = _changed(state, torch.Tensor, _as_array)
        scene = _scene_of(state)
        probe = ValidationRays(**state["probe"])
        _check(scene, probe)
        # What no file could hold is found here, by the rules of every reader, before anything is rendered.
        scene_io.scene_chunks(
            quantise_scene(scene, [{name: 8.0 for name in scale} for scale in scene.scales], skip_unseen=False)
        )
    except (TrainingError, OSError):
        raise
    except FormatError as error:
        raise TrainingError(f"{path}: not a usable checkpoint ({error})") from error
    except Exception as error:  # what a damaged file holds may be of any kind
        raise TrainingError(f"{path}: not a usable checkpoint ({type(error).__name__}); train anew") from error
    return Model(scene, probe)


def _scene_of(state: Mapping[str, Any]) -> Scene:
    kind = {"explicit": Decoder, "hybrid": HybridDecoder}[state["kind"]]
    return Scene(
        state["aabb"],
        Clip(int(state["frame_count"]), float(state["fps"])),
        tuple(state["scales"]),
        kind(**state["decoder"]),
        state["occupancy"],
        state["background"],
        float(state["step"]),
        tuple(_camera_of(numbers) for numbers in state["cameras"]),
        _mapping_of(state["mapping"]),
        state["motion"],
        tuple(Appearance(name, code) for name, code in zip(state["names"], state["codes"], strict=True)),
    )


def _check(scene: Scene, probe: ValidationRays) -> None:
    """What coding relies on beyond the rules of files."""
    for planes in scene.scales:
        for name, plane in planes.items():
            if plane.dtype != np.float32 or min(plane.shape[:2]) < 2:
                raise ValueError(name)
    n = len(probe.times)
    wanted = {"origins": (n, 3), "directions": (n, 3), "times": (n,), "truth": (n, 3)}
    for name, shape in wanted.items():
        values = getattr(probe, name)
        if values.shape != shape or values.dtype != np.float32 or not np.isfinite(values).all() or not n:
            raise ValueError(f"probe {name}")
    lengths = np.linalg.norm(probe.directions, axis=1)
    if not ((np.abs(lengths - 1) < 1e-3).all() and (probe.times >= 0).all() and (probe.times <= 1).all()):
        raise ValueError("probe")
    numbers = probe.appearances
    if (numbers is None) != (not scene.appearances):
        raise ValueError("probe appearances")
    if numbers is not None and (numbers.shape != (n,) or numbers.min() < 0 or numbers.max() >= len(scene.appearances)):
        raise ValueError("probe appearances")
    if scene.motion is not None and not np.isfinite(scene.motion).all():
        raise ValueError("motion")


def _camera_as_numbers(camera: Camera) -> np.ndarray:
    return np.array([camera.width, camera.height, camera.fl_x, camera.fl_y, camera.cx, camera.cy,
                     *np.ravel(camera.camera_to_world)], np.float64)  # fmt: skip


def _camera_of(numbers: np.ndarray) -> Camera:
    width, height, fl_x, fl_y, cx, cy = map(float, numbers[:6])
    return Camera(int(width), int(height), fl_x, fl_y, cx, cy, numbers[6:].reshape(4, 4))


def _mapping_as_numbers(mapping: SpaceMapping | None) -> dict[str, Any] | None:
    return None if mapping is None else {"kind": type(mapping).__name__, **vars(mapping)}


def _mapping_of(numbers: Mapping[str, Any] | None) -> SpaceMapping | None:
    if numbers is None:
        return None
    kinds: dict[str, type[SpaceMapping]] = {kind.__name__: kind for kind in (Contraction, DeviceCoordinates)}
    return kinds[numbers["kind"]](**{name: value for name, value in numbers.items() if name != "kind"})


def _changed(value: Any, kind: type, change: Any) -> Any:
    """Plain data with everything of one kind in it changed; mappings become dictionaries, sequences lists."""
    if isinstance(value, kind):
        return change(value)
    if isinstance(value, Mapping):
        return {key: _changed(item, kind, change) for key, item in value.items()}
    if isinstance(value, (list, tuple)):
        return [_changed(item, kind, change) for item in value]
    return value


def _as_array(tensor: torch.Tensor) -> np.ndarray:
    """One that claims more numbers than are stored is refused."""
    if tensor.numel() * tensor.element_size() > tensor.untyped_storage().nbytes():
        raise ValueError("a tensor without its numbers")
    return np.ascontiguousarray(tensor.numpy())
