"""Preparation of an encode: decode the dataset, find the space that it fills, lay out the model, resume a run."""

import contextlib
import shutil
from collections.abc import Iterator
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

from kpc.encoder.cli.grouped import initialise_from, take_over
from kpc.encoder.cli.options import Options
from kpc.encoder.cli.read_dataset import PAGE, check_target_size, read_dataset
from kpc.encoder.cli.report import REFINED, SPACES, describe_model, describe_time_rows, log, show_progress
from kpc.encoder.cli.sound import find_sound
from kpc.encoder.cli.transcode import check_outputs
from kpc.encoder.cli.work_folder import CHECKPOINT, POSES, choose_device, locked, make_work_folder
from kpc.encoder.datasets import Dataset
from kpc.encoder.datasets.plausibility import doubts
from kpc.encoder.evaluation.camera_page import check_page, write_page_of_dataset
from kpc.encoder.evaluation.expectations import Expectations, expect
from kpc.encoder.field.bounds import (
    find_box,
    find_contraction_box,
    fit_contraction,
    fit_device_coordinates,
    is_unbounded,
    visible_cells,
)
from kpc.encoder.field.config import TrainConfig
from kpc.encoder.field.occupancy_grid import grid_shape
from kpc.encoder.rdo.sharing import Sharing
from kpc.encoder.training.moving_area import MovingArea, find_moving_area
from kpc.encoder.training.temporal_resolution import fit_frames_per_row
from kpc.encoder.training.tight_bounds import trim_box
from kpc.encoder.training.train import Trainer, load_checkpoint_box
from kpc.format.common import cli
from kpc.format.common.errors import DatasetError, UsageError
from kpc.format.common.progress import Progress
from kpc.format.container import scene_layout
from kpc.format.scene.scene import Scene
from kpc.format.scene.sound import Sound
from kpc.format.scene.space import FARTHEST_BOX, Contraction, DeviceCoordinates, SpaceMapping, edges_away


@dataclass(frozen=True)
class Layers:
    """Whether what moves has scales of its own. `area`: where they are; None: there are none."""

    area: MovingArea | None = None


@dataclass(frozen=True)
class Setting:
    """A dataset to be encoded, and the space that it fills.

    Attributes:
        dataset: decoded.
        aabb: (2, 3) float32, the box of the planes.
        mapping: how space beyond the box is held; None for a box with nothing outside it.
        is_final: whether the box is not to be trimmed any more.
        before: the scene to start from, whose last picture is about the first of this dataset; None to start afresh.
        dataset_sha256: of the dataset of which this is a part; None if it is a whole.
        sound: of the clip; None if it is silent.
        sound_from: the track that it is from, as --audio names it.
        refined: what of the cameras an earlier group of the clip has refined.
        layers: what `find_layers` found for all groups of the clip; None to find it for this dataset.
        sharing: planes that the groups of the clip share; None for none.
    """

    dataset: Dataset
    aabb: np.ndarray
    mapping: SpaceMapping | None
    is_final: bool
    before: Scene | None = None
    dataset_sha256: str | None = None
    sound: Sound | None = None
    sound_from: str = Options.audio
    refined: str = "none"
    layers: Layers | None = None
    sharing: Sharing | None = None


@contextlib.contextmanager
def working_alone(options: Options) -> Iterator[None]:
    """Check that the outputs can be written, and hold the work folder.

    Raises:
        UsageError, TrainingError, OSError: one cannot, or another kpenc is at work there.
    """
    check_outputs(options)
    if options.preview is not None:
        check_page(_camera_page(options))
    with locked(options.work_dir):
        yield


def prepare_setting(options: Options) -> Setting:
    """Decode the dataset and find the space that it fills.

    Raises:
        DatasetError, MediaError: the dataset cannot be used.
        UsageError, TrainingError: the options contradict each other, or a folder cannot be made.
    """
    choose_device(options.device)
    make_work_folder(options.work_dir, options.cache)
    dataset = read_dataset(options)
    aabb, mapping, why = _find_space(dataset, options)
    sound, sound_from = find_sound(options, dataset)
    check_target_size(options, dataset.clip, sound)
    log(dataset.describe())
    if options.holdout is None and not dataset.pictures.is_test.any():
        log("nothing is held out, so the quality will not be measured; --holdout NAME holds out a camera")
    log(f"pixels: {dataset.pixels.describe()}")
    for doubt in doubts(dataset):
        log(f"warning: {doubt}")
    log(f"space: {SPACES[type(mapping)][1]} ({why})")
    expectations = expect(dataset, aabb, mapping)
    log(f"filmed: {expectations.paragraph()}")
    for warning in expectations.warnings():
        log(f"warning: {warning}")
    if options.preview is not None:
        _show_cameras(options, dataset, expectations)
    is_final = options.box is not None or isinstance(mapping, Contraction)
    return Setting(dataset, aabb, mapping, is_final, sound=sound, sound_from=sound_from)


def _camera_page(options: Options) -> Path:
    return options.output.with_name(options.output.name + ".cameras.html")


def _show_cameras(options: Options, dataset: Dataset, expectations: Expectations) -> None:
    """Write the page of the cameras beside the output: that of found cameras, or one of those that were given."""
    page = _camera_page(options)
    found = options.work_dir / POSES / PAGE
    if found.exists():
        with cli.atomic_write(page) as aside:
            shutil.copyfile(found, aside)
    else:
        write_page_of_dataset(page, dataset, [dataset.describe(), f"Filmed: {expectations.paragraph()}"])
    log(f"cameras: {page}")


def prepare_trainer(options: Options, setting: Setting) -> Trainer:
    """Lay out the model, trim the box, and resume an interrupted run: return a trainer ready for the next step."""
    device, checkpoint = choose_device(options.device), options.work_dir / CHECKPOINT
    make_work_folder(options.work_dir)
    dataset, aabb, mapping = setting.dataset, setting.aabb, setting.mapping
    appearance, why = options.appearance_of(dataset)
    log(f"appearance: {'none' if appearance == 'none' else f'an embedding for each {appearance}'} ({why})")
    config, resolution = fit_frames_per_row(options.config(dataset), dataset)
    if dataset.is_dynamic:
        log(describe_time_rows(config, dataset, resolution))
    if config.motion_cells:
        log(f"model: a motion grid and {config.steps:,} steps, for an object on its own that one moving camera filmed")
    if setting.refined != "none":
        config = replace(config, refine="none")
        log("cameras: as refined in the first group")
    else:
        kind, why = options.refine_of(dataset)
        log(f"cameras: {REFINED[kind]} ({why})")
    if setting.before is not None:
        config = replace(config, coarse_until=0.0)  # the scene before has all scales
    resumes, survey_s = options.resume and checkpoint.exists(), 0.0
    if not setting.is_final:
        if resumes:
            aabb = load_checkpoint_box(checkpoint)
        else:
            assert not isinstance(mapping, Contraction)
            aabb, survey_s = trim_with_progress(dataset, config, aabb, options.time_budget_s, mapping)
    moving = (setting.layers or find_layers(options, config, dataset, aabb, mapping)).area
    if moving is not None:
        config = config.with_moving_area(moving.box)
    trainer = Trainer(dataset, config, aabb, device, elapsed_s=survey_s, mapping=mapping, moving=moving)
    log(*describe_model(trainer).split("\n"))
    changed = ""
    if setting.before is not None:
        initialise_from(trainer.field, setting.before)
    if setting.sharing is not None and setting.sharing.reach is not None:
        take_over(setting.sharing.settled, trainer.field)
        trainer.grid.restrict(setting.sharing.reach)
    if resumes:
        changed = trainer.resume(checkpoint, options.time_budget_s)
        log(f"resumed at step {trainer.step}")
    if changed:
        log(f"length: {changed}; what is left is trained at the rates of a run of the new length")
    return trainer


def find_layers(
    options: Options, config: TrainConfig, dataset: Dataset, aabb: np.ndarray, mapping: SpaceMapping | None
) -> Layers:
    """Find whether what moves in a dataset is to have scales of its own, as `options.layers` says, and log the reason.

    Args:
        aabb: (2, 3), the box of the planes, as it stays. mapping: how space beyond it is held.
    """
    if options.layers == "one":
        return Layers()
    area, why = None, "nothing moves"
    if config.motion_cells or config.summed or not config.moving_texels:
        why = "the model is of another kind"
    elif dataset.is_dynamic:
        area, why = find_moving_area(dataset, aabb, mapping)
    own = f"what moves has scales of its own, with up to {config.moving_rows:g} times as many rows in time"
    log(f"layers: {'all in one' if area is None else own} ({why})")
    return Layers(area)


def trim_with_progress(
    dataset: Dataset,
    config: TrainConfig,
    aabb: np.ndarray,
    time_budget_s: float | None,
    mapping: DeviceCoordinates | None,
) -> tuple[np.ndarray, float]:
    """Trim the box to what is occupied, showing progress; return the box and the seconds that took."""
    with Progress("finding the box", total=100, unit="%") as progress:
        return trim_box(
            dataset,
            config,
            aabb,
            lambda report: show_progress(progress, report),
            time_budget_s=time_budget_s,
            mapping=mapping,
        )


def _find_space(dataset: Dataset, options: Options) -> tuple[np.ndarray, SpaceMapping | None, str]:
    """Find the box, the mapping of space beyond it, and the reason for both, within what a file can hold."""
    unbounded, why = is_unbounded(dataset.pictures, dataset.has_alpha)
    space = options.space if options.space != "auto" else "contracted" if unbounded else "box"
    if space == "ndc" and options.box is not None:
        raise UsageError(
            "--box is in world units, device coordinates have a box of their own: drop --box or --space ndc"
        )
    mapping: SpaceMapping | None = None
    try:
        if space == "ndc":
            mapping, aabb = fit_device_coordinates(dataset.pictures)
        elif options.box is not None:
            aabb = np.array(options.box, np.float32).reshape(2, 3)
        elif space == "contracted":
            aabb = find_contraction_box(dataset.pictures)
        else:
            aabb = find_box(dataset.pictures, dataset.has_alpha)
    except DatasetError as error:
        raise DatasetError(f"{options.source}: {error}") from error
    if space == "contracted":
        mapping = fit_contraction(dataset.pictures, aabb)
    _check_space(dataset, options, aabb, mapping)
    return aabb, mapping, f"{why}; --space overrides" if options.space == "auto" else "as given"


def _check_space(dataset: Dataset, options: Options, aabb: np.ndarray, mapping: SpaceMapping | None) -> None:
    another = "give another with --box x0,y0,z0,x1,y1,z1"
    if (
        not (np.abs(aabb) <= scene_layout.BOX_LIMIT).all()
        or not (aabb[1] - aabb[0] >= 1 / scene_layout.BOX_LIMIT).all()
    ):
        raise DatasetError(
            f"{options.source}: a box from {aabb[0].tolist()} to {aabb[1].tolist()} is too large or too thin; {another}"
        )
    if not isinstance(mapping, DeviceCoordinates) and (away := edges_away(aabb, np.zeros(3))) > FARTHEST_BOX:
        raise DatasetError(
            f"{options.source}: the box lies {away:,.0f} times its longest edge away from the origin, where numbers "
            f"are too coarse (at most {FARTHEST_BOX:,.0f}); subtract one position from all cameras, and from --box"
        )
    samples_per_unit = options.config(dataset).samples_across / (aabb[1] - aabb[0]).max()
    if isinstance(mapping, Contraction) and mapping.uniform_distance * samples_per_unit > scene_layout.SAMPLE_LIMIT:
        raise DatasetError(
            f"{options.source}: the box is too small for cameras that lie {mapping.uniform_distance:.4g} from its far "
            "side; give a larger one with --box x0,y0,z0,x1,y1,z1, or --space box"
        )
    if not visible_cells(dataset.pictures, aabb, grid_shape(aabb, 64), mapping).any():
        raise DatasetError(f"{options.source}: the box lies outside every camera's view; {another}")
