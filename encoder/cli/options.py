"""Options of kpenc, and their command line."""

import argparse
import re
import sys
from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

from kpc.encoder.coding.opus import BITRATES, DEFAULT_BITRATES
from kpc.encoder.datasets import Dataset
from kpc.encoder.evaluation.ablations import ABLATIONS, BASELINE
from kpc.encoder.evaluation.testing_time import FEWEST_PICTURES
from kpc.encoder.field.appearances import choose_appearance
from kpc.encoder.field.config import (
    APPEARANCES,
    PRESETS,
    PROGRESSIVE_SCALE_DROPOUT,
    REFINEMENTS,
    TrainConfig,
)
from kpc.encoder.poses.wishes import Wishes, add_pose_options, wishes_from
from kpc.encoder.rdo.codec_model import is_coded
from kpc.encoder.rdo.rate_control import DEFAULT_LOSS_DB, Trade
from kpc.format.common import cli
from kpc.format.common.errors import UsageError
from kpc.format.container.metadata_options import TEXTS, add_metadata_options, members_from

# `Options.test_views` for all held-out pictures.
ALL_VIEWS = sys.maxsize

# `--downscale auto`: pixels along the longer side of a picture for each texel of the finest planes, which cover about
# what the picture shows. The 512 texels of K-Planes are trained on pictures of 1352 pixels.
PIXELS_PER_TEXEL = 5

# Options that apply where nothing is trained.
TRANSCODE_OPTIONS = {
    "source",
    "output",
    "max_loss",
    "target_size",
    "quality",
    "lam",
    "psnr",
    "tune_steps",
    "json",
    "view_limits",
    *TEXTS,
}


@dataclass(frozen=True)
class Options:
    """Options of one run of kpenc; the fields are the options of the command line.

    Attributes:
        test_views: the most held-out pictures that are tested; None for as many as a share of the training time permits
            (`kpc.encoder.evaluation.testing_time`), ALL_VIEWS for all.
        downscale: side of the blocks of pixels that are averaged; None for `most_across` pixels at most.
        cache: the folder of decoded pixels, which is kept; None for the work folder.
        members: of the file's metadata: title, description, author, licence and date; None removes one.
        view_limits: "auto", "none", or members of the view limits (`kpc.format.container.metadata_options`); None for
            "auto", or where nothing is trained for those of the source.
        audio: "auto", "none", a camera or a file.
        audio_bitrate: of its sound, bits per second; None for a default.
        wishes: about footage without poses.
        ablation: one of `kpc.encoder.evaluation.ablations`; not an option of the command line.
    """

    source: Path
    output: Path
    preset: str = "balanced"
    decoder: str = "explicit"
    sampling: str = "grid"
    progressive: bool = False
    layers: str = "auto"
    steps: int | None = None
    time_budget_s: float | None = None
    seed: int = 0
    device: str = "auto"
    downscale: int | None = 1
    holdout: str | None = None
    space: str = "auto"
    box: tuple[float, ...] | None = None
    appearance: str = "auto"
    refine: str = "auto"
    work: Path | None = None
    cache: Path | None = None
    keep: bool = False
    resume: bool = False
    test_views: int | None = None
    group_s: float | None = None
    only: int | None = None
    trade: Trade = field(default_factory=Trade)
    keep_checkpoint: Path | None = None
    tune_steps: int | None = None
    preview: Path | None = None
    members: Mapping[str, str | None] = field(default_factory=dict)
    view_limits: str | Mapping[str, Any] | None = None
    audio: str = "auto"
    audio_bitrate: int | None = None
    wishes: Wishes = field(default_factory=Wishes)
    ablation: str = BASELINE

    @property
    def work_dir(self) -> Path:
        return self.work or self.output.with_name(self.output.name + ".work")

    @property
    def cache_dir(self) -> Path:
        return self.cache or self.work_dir

    @property
    def most_across(self) -> int | None:
        """The most pixels along the longer side of a picture that the preset's planes can hold; None if not limited."""
        return None if self.downscale else PIXELS_PER_TEXEL * max(PRESETS[self.preset].resolutions)

    @property
    def files_read(self) -> tuple[Path, ...]:
        """The source, and the files that --audio and --sync may name."""
        sync = self.wishes.sync
        return (self.source, Path(self.audio), *((sync,) if isinstance(sync, Path) else ()))

    def config(self, dataset: Dataset) -> TrainConfig:
        """Return the configuration of training on a dataset."""
        config = PRESETS[self.preset]
        if config.adapts_to_object and dataset.has_alpha and dataset.is_monocular:
            config = config.for_single_object()
        appearance, _ = self.appearance_of(dataset)
        config = replace(
            config,
            hybrid=self.decoder == "hybrid",
            proposals=self.sampling == "proposals",
            seed=self.seed,
            scale_dropout=PROGRESSIVE_SCALE_DROPOUT if self.progressive else config.scale_dropout,
            steps=self.steps or config.steps,
            tune_steps=config.tune_steps if self.tune_steps is None else self.tune_steps,
            appearance=appearance,
            refine=self.refine_of(dataset)[0],
            view_dependent=config.view_dependent or appearance != "none",  # embeddings act through the direction MLP
        )
        return ABLATIONS[self.ablation](config)

    def appearance_of(self, dataset: Dataset) -> tuple[str, str]:
        """Return what has an appearance embedding (`TrainConfig.appearance`), and the reason, for the log."""
        if self.appearance != "auto":
            return self.appearance, "as given"
        kind, why = choose_appearance(dataset)
        return kind, f"{why}; --appearance overrides"

    def refine_of(self, dataset: Dataset) -> tuple[str, str]:
        """Return what of the cameras is refined (`TrainConfig.refine`), and the reason, for the log."""
        if self.refine != "auto":
            return self.refine, "as given"
        if not dataset.poses_found:
            return "none", "the poses were given; --refine overrides"
        has_clocks = any(clock != (0.0, 1.0) for clock in dataset.clocks.values())
        found = "the poses were found, not given" + (", and the clocks of the videos differ" if has_clocks else "")
        return "all" if has_clocks else "cameras", f"{found}; --refine overrides"


def parse(argv: list[str]) -> tuple[Options, bool, bool]:
    """Parse a command line; argparse exits where it is wrong.

    Returns:
        The options, whether only to plan (--dry-run), and whether to print JSON.
    """
    parser = cli.Parser(
        "kpenc",
        description="Encode a folder of posed videos or images as a .kpc file. Given a finished checkpoint or a .kpc "
        "file instead, code it anew, without pictures and without training.",
    )
    cli.add_version_option(parser)
    parser.add_argument(
        "source",
        type=cli.input_path,
        help="folder with videos or images, and poses_bounds.npy, transforms*.json or sparse/0; "
        "or a finished checkpoint, or a .kpc file",
    )
    parser.add_argument("-o", "--output", type=cli.output_path, help="the .kpc file to write")
    _add_training_options(parser)
    _add_dataset_options(parser)
    _add_sound_options(parser)
    add_pose_options(parser)
    _add_run_options(parser)
    _add_coding_options(parser)
    add_metadata_options(parser)
    given = parser.parse_args(cli.join_values(argv, "--box"))
    if given.output is None and given.dry_run:
        given.output = Path(given.source.resolve().name + ".kpc")
    _check(parser, given)
    return _options_from(given), given.dry_run, given.json


def _add_training_options(parser: argparse.ArgumentParser) -> None:
    parser.add_argument(
        "--preset",
        choices=sorted(PRESETS),
        default=Options.preset,
        help="effort of training and size of the model (default: %(default)s)",
    )
    parser.add_argument(
        "--decoder",
        choices=("explicit", "hybrid"),
        default=Options.decoder,
        help="hybrid: two small MLPs per sample; slower to train and to play (default: %(default)s)",
    )
    parser.add_argument(
        "--sampling",
        choices=("grid", "proposals"),
        default=Options.sampling,
        help="where to place samples on rays while training: in the cells of an occupancy grid, or by two small "
        "proposal fields; players use the occupancy grid either way (default: %(default)s)",
    )
    parser.add_argument(
        "--progressive",
        action="store_true",
        help="train the coarse scales to make a picture of their own, for scenes that are shown while they are "
        "downloaded; costs about 0.4 dB of the whole",
    )
    parser.add_argument(
        "--layers",
        choices=("auto", "one"),
        default=Options.layers,
        help="auto: of a clip by cameras that stand still, what moves gets scales of its own, in the part of the scene "
        "in which it moves; one: all scales hold both (default: %(default)s)",
    )
    steps = ", ".join(f"{name} {config.steps:,}" for name, config in sorted(PRESETS.items()))
    adapted = sorted((name, config.object_steps) for name, config in PRESETS.items() if config.adapts_to_object)
    object_steps = ", ".join(f"{name} {count:,}" for name, count in adapted)
    parser.add_argument(
        "--steps",
        type=_positive,
        help=f"optimiser steps (default, by preset: {steps}; for an object on its own that one moving camera filmed: "
        f"{object_steps})",
    )
    parser.add_argument(
        "--time-budget", type=cli.duration_s, metavar="10m", help="train for so long instead of a number of steps"
    )
    parser.add_argument("--seed", type=_seed, default=Options.seed, help="of all random numbers (default: %(default)s)")
    parser.add_argument(
        "--device",
        choices=("auto", "cpu", "cuda"),
        default=Options.device,
        help="where to train; auto: on a GPU if there is one (default: %(default)s)",
    )


def _add_dataset_options(parser: argparse.ArgumentParser) -> None:
    parser.add_argument(
        "--downscale",
        type=_downscale,
        default=Options.downscale,
        metavar="N|auto",
        help="average blocks of N x N pixels first; auto: so that pictures have no more than "
        f"{PIXELS_PER_TEXEL} pixels for a texel of the preset's finest planes (default: %(default)s)",
    )
    parser.add_argument("--holdout", metavar="NAME", help="camera, file or folder of images to test on, or 'none'")
    parser.add_argument(
        "--space",
        choices=("auto", "box", "contracted", "ndc"),
        default=Options.space,
        help="box: nothing lies outside it; contracted: the surroundings are held, too; ndc: device coordinates, "
        "for cameras that face one way (default: %(default)s)",
    )
    parser.add_argument(
        "--box",
        type=cli.box_corners,
        metavar="x0,y0,z0,x1,y1,z1",
        help="corners of the scene, or of its part that is not contracted, instead of those found",
    )
    parser.add_argument(
        "--appearance",
        choices=("auto", *APPEARANCES),
        default=Options.appearance,
        help="learn an appearance embedding for each camera or each image: unequal exposure, white balance, weather; "
        "auto: image for photographs by many lenses, else none (default: %(default)s)",
    )
    parser.add_argument(
        "--refine",
        choices=("auto", *REFINEMENTS),
        default=Options.refine,
        help="learn small corrections of the cameras with the scene: of poses, focal lengths and distortion "
        "(cameras), or of clocks and exposures, too (all); auto: cameras that kpenc or kpposes found, and all if "
        "their clocks were found, too; none for poses that were given (default: %(default)s)",
    )


def _add_sound_options(parser: argparse.ArgumentParser) -> None:
    parser.add_argument(
        "--audio",
        default=Options.audio,
        metavar="auto|none|NAME|FILE",
        help="the sound of the clip: the clearest track of its videos, none, the track of a camera, or a sound file "
        "that begins with the videos or, beside images, with the first frame (default: %(default)s)",
    )
    low, high = BITRATES
    mono, stereo = DEFAULT_BITRATES.values()
    parser.add_argument(
        "--audio-bitrate",
        type=_bitrate,
        metavar="48k",
        help=f"bits per second of the sound, {low // 1000}k to {high // 1000}k (default: {mono // 1000}k for mono, "
        f"{stereo // 1000}k for stereo)",
    )


def _add_run_options(parser: argparse.ArgumentParser) -> None:
    parser.add_argument(
        "--work", type=cli.output_path, help="folder for decoded pixels and the checkpoint (default: OUTPUT.work)"
    )
    parser.add_argument(
        "--cache",
        type=cli.output_path,
        metavar="DIR",
        help="folder for decoded pixels, which is kept, and which encodes of one dataset can share, also at the same "
        "time (default: the folder of --work)",
    )
    parser.add_argument("--keep", action="store_true", help="keep that folder when done")
    parser.add_argument("--resume", action="store_true", help="go on from the checkpoint of an interrupted run")
    parser.add_argument(
        "--test-views",
        type=test_views,
        metavar="N|all",
        help="test on at most N held-out pictures, or on all (default: as many as a tenth of the training time "
        f"permits, at least {FEWEST_PICTURES})",
    )
    parser.add_argument(
        "--preview",
        action="store_true",
        help="while training, keep a small picture of a held-out view beside what was filmed in OUTPUT.preview.png; "
        "also show the cameras in OUTPUT.cameras.html",
    )
    parser.add_argument(
        "--keep-checkpoint",
        type=cli.output_file(".kpck"),
        metavar="MODEL.kpck",
        help="also write the finished checkpoint there; kpenc codes it anew without training",
    )
    parser.add_argument(
        "--group",
        type=cli.duration_s,
        metavar="10s",
        help="code a long clip in groups that show at most so long each, one after the other: encoding takes "
        "the memory of one, playing that of two; --steps are those of the first group",
    )
    parser.add_argument(
        "--only",
        type=cli.whole_number,
        metavar="N",
        help="with --group: code only group N, counted from 0; kpjoin joins groups to a clip",
    )
    parser.add_argument(
        "--dry-run",
        action="store_true",
        help="only print what would be done, and how much time and memory it takes; needs no -o and leaves nothing",
    )
    parser.add_argument("--json", action="store_true", help="print the results as JSON")


def _add_coding_options(parser: argparse.ArgumentParser) -> None:
    trade = parser.add_mutually_exclusive_group()
    trade.add_argument(
        "--max-loss",
        type=cli.decibels,
        metavar="0.1dB",
        help=f"the smallest file that costs at most this PSNR on training views (default: {DEFAULT_LOSS_DB:g}dB)",
    )
    trade.add_argument("--target-size", type=cli.byte_count, metavar="2MB", help="the best file of at most this size")
    trade.add_argument(
        "--quality",
        type=_quality,
        metavar="1..100",
        help="the smallest file whose pictures agree with the uncoded ones to a PSNR of 20 + QUALITY / 3 dB",
    )
    trade.add_argument(
        "--lam",
        type=_lam,
        metavar="LAM",
        help="the file of least Lagrangian cost D + LAM R: D the mean squared difference from the uncoded pictures on "
        "the 8-bit scale, R the bits per parameter",
    )
    trade.add_argument(
        "--psnr",
        type=cli.psnr_db,
        metavar="30dB",
        help="the smallest file of at least this PSNR on training views",
    )
    tune_steps = ", ".join(f"{name} {config.tune_steps}" for name, config in sorted(PRESETS.items()))
    parser.add_argument(
        "--tune-steps",
        type=cli.whole_number,
        metavar="N",
        help="steps of fine-tuning after each group of planes is coded, in which the others learn to compensate its "
        "errors: files are 2 to 13 % smaller, and take two or three minutes longer (default, by preset: "
        f"{tune_steps}; {TrainConfig().tune_steps} where nothing is trained; fewer after short training)",
    )


def _check(parser: argparse.ArgumentParser, given: argparse.Namespace) -> None:
    if given.output is None:
        parser.error("-o names the file to write; give for example -o scene.kpc")
    if given.source.suffix.lower() in (".kpc", ".kpck") and not given.source.exists():
        parser.error(f"{given.source}: no such file")
    if given.source.is_fifo():
        parser.error(f"{given.source}: is a pipe, and sources are read in any order; save it to a file")
    if given.source.is_file():
        for name, value in vars(given).items():
            if name not in TRANSCODE_OPTIONS and value != parser.get_default(name):
                try:
                    is_coded(given.source)
                except UsageError as error:  # it is neither a .kpc file nor a checkpoint
                    parser.error(str(error))
                parser.error(
                    f"--{name.replace('_', '-')}: {given.source} is trained already and can only be coded anew; drop it"
                )
    if given.only is not None and given.group is None:
        parser.error("--only names a group; give the length of groups with --group 10s")
    if given.keep_checkpoint is not None and given.group is not None and given.only is None:
        parser.error("--keep-checkpoint holds a single scene; with --group give --only N, too")
    if given.audio == "none" and given.audio_bitrate is not None:
        parser.error("--audio none leaves the sound out; drop --audio-bitrate")
    if given.steps is not None and given.time_budget is not None:
        parser.error("--steps and --time-budget both say how long to train; drop one")
    if given.dry_run and given.resume:
        parser.error("--dry-run estimates a whole run; drop --resume")


def _options_from(given: argparse.Namespace) -> Options:
    return Options(
        source=given.source,
        output=given.output,
        preset=given.preset,
        decoder=given.decoder,
        sampling=given.sampling,
        progressive=given.progressive,
        layers=given.layers,
        steps=given.steps,
        time_budget_s=given.time_budget,
        seed=given.seed,
        device=given.device,
        downscale=given.downscale,
        holdout=given.holdout,
        space=given.space,
        box=given.box,
        appearance=given.appearance,
        refine=given.refine,
        work=given.work,
        cache=given.cache,
        keep=given.keep,
        resume=given.resume,
        test_views=given.test_views,
        group_s=given.group,
        only=given.only,
        trade=Trade(given.max_loss, given.target_size, given.quality, given.lam, given.psnr),
        keep_checkpoint=given.keep_checkpoint,
        tune_steps=given.tune_steps,
        preview=given.output.with_name(given.output.name + ".preview.png") if given.preview else None,
        members=members_from(given),
        view_limits=given.view_limits,
        audio=given.audio,
        audio_bitrate=given.audio_bitrate,
        wishes=wishes_from(given),
    )


def _positive(text: str) -> int:
    return cli.whole_number(text, 1)


def _downscale(text: str) -> int | None:
    return None if text == "auto" else _positive(text)


def test_views(text: str) -> int:
    """Parse the most held-out pictures to test: a positive number, or "all"."""
    return ALL_VIEWS if text == "all" else _positive(text)


def _quality(text: str) -> float:
    return cli.number_within(text, 1, 100)


def _lam(text: str) -> float:
    return cli.number_within(text, 1e-4, 1e6)


def _bitrate(text: str) -> int:
    low, high = BITRATES
    number = text.lower().removesuffix("k")
    value = int(number) * (1000 if number != text.lower() else 1) if re.fullmatch("[0-9]{1,6}", number) else 0
    if not low <= value <= high:
        raise argparse.ArgumentTypeError(f"{text!r} is not a bitrate from {low // 1000}k to {high // 1000}k")
    return value


def _seed(text: str) -> int:
    return cli.whole_number(text, 0, (1 << 63) - 1)
