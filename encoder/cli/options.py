"""What kpenc can be told, and how its command line says it."""

import argparse
import math
from dataclasses import dataclass, replace
from pathlib import Path

from kpc.encoder.datasets import Dataset
from kpc.encoder.evaluation.ablations import ABLATIONS
from kpc.encoder.field.appearances import choose_appearance
from kpc.encoder.field.config import APPEARANCES, PRESETS, PROGRESSIVE_SCALE_DROPOUT, TrainConfig
from kpc.encoder.rdo.rate_control import DEFAULT_LOSS_DB, Trade
from kpc.format.common import cli

CODING = {"source", "output", "max_loss", "target_size", "quality", "lam", "psnr", "tune_steps", "json"}
"""Options that mean something where nothing is trained."""


@dataclass(frozen=True)
class Options:
    """What one run of kpenc is told; the fields are the command line's options."""

    source: Path
    output: Path
    preset: str = "balanced"
    decoder: str = "explicit"
    sampling: str = "grid"
    progressive: bool = False
    steps: int | None = None
    time_budget_s: float | None = None
    seed: int = 0
    device: str = "auto"
    downscale: int = 1
    holdout: str | None = None
    space: str = "auto"
    box: tuple[float, ...] | None = None
    appearance: str = "auto"
    work: Path | None = None
    keep: bool = False
    resume: bool = False
    max_test_pictures: int | None = None
    group_s: float | None = None
    only: int | None = None
    trade: Trade = Trade()
    keep_checkpoint: Path | None = None
    tune_steps: int | None = None
    ablation: str = "baseline"
    """Of `kpc.encoder.evaluation.ablations`; no option of the command line."""

    @property
    def work_dir(self) -> Path:
        return self.work or self.output.with_name(self.output.name + ".work")

    def config(self, dataset: Dataset) -> TrainConfig:
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
            view_dependent=config.view_dependent or appearance != "none",
        )  # codes act through the direction MLP
        return ABLATIONS[self.ablation](config)

    def appearance_of(self, dataset: Dataset) -> tuple[str, str]:
        """What is to have an appearance, as `TrainConfig.appearance`, and why, in words for the log."""
        if self.appearance != "auto":
            return self.appearance, "as told"
        kind, why = choose_appearance(dataset)
        return kind, f"{why}; --appearance overrides"


def parse(argv: list[str]) -> tuple[Options, bool, bool]:
    """The options, whether only to plan (--dry-run), and whether to answer in JSON; argparse exits on anything else."""
    parser = argparse.ArgumentParser(
        "kpenc",
        description="A folder of posed videos or images becomes a .kpc file. A finished checkpoint, or a .kpc file, is "
        "coded anew, without pictures and without training: name it, -o, and one of the trades.",
    )
    cli.add_version_option(parser)
    parser.add_argument(
        "source",
        type=Path,
        help="folder: videos or images, and poses_bounds.npy, transforms*.json or sparse/0; "
        "or a finished checkpoint, or a .kpc file",
    )
    parser.add_argument("-o", "--output", type=Path, required=True, help="the .kpc file to write")
    parser.add_argument(
        "--preset", choices=sorted(PRESETS), default="balanced", help="how much to spend (default: balanced)"
    )
    parser.add_argument(
        "--decoder",
        choices=("explicit", "hybrid"),
        default="explicit",
        help="hybrid: two small MLPs for each sample; slower to train and to play (default: explicit)",
    )
    parser.add_argument(
        "--sampling",
        choices=("grid", "proposals"),
        default="grid",
        help="where to look on a ray while training: where an occupancy grid is set, or where two small fields "
        "say; what is written is marched through the grid either way (default: grid)",
    )
    parser.add_argument(
        "--progressive",
        action="store_true",
        help="train the coarse scales to make a picture alone, for scenes that are seen while they arrive; costs "
        "some 0.4 dB of the whole",
    )
    parser.add_argument("--steps", type=_positive, help="optimiser steps instead of the preset's")
    parser.add_argument(
        "--time-budget", type=cli.duration_s, metavar="10m", help="train for so long instead of a number of steps"
    )
    parser.add_argument("--seed", type=_seed, default=0, help="of everything random (default: 0)")
    parser.add_argument("--device", choices=("auto", "cpu", "cuda"), default="auto")
    parser.add_argument(
        "--downscale", type=_positive, default=1, help="average blocks of N x N pixels first (default: 1)"
    )
    parser.add_argument("--holdout", metavar="NAME", help="camera or file to test on, or 'none'")
    parser.add_argument(
        "--space",
        choices=("auto", "box", "contracted", "ndc"),
        default="auto",
        help="box: nothing lies outside it; contracted: the surroundings are held, too; ndc: device coordinates, "
        "for cameras that face one way (default: auto)",
    )
    parser.add_argument(
        "--box",
        type=cli.box_corners,
        metavar="x0,y0,z0,x1,y1,z1",
        help="corners of the scene, or of its undistorted part, taken as they are, instead of those found",
    )
    parser.add_argument(
        "--appearance",
        choices=("auto", *APPEARANCES),
        default="auto",
        help="learn beside the scene how each camera, or each image, shows its colours: unequal exposure, white "
        "balance, weather (default: auto, image for photographs by many lenses, else none)",
    )
    parser.add_argument("--work", type=Path, help="folder for decoded pixels and the checkpoint (default: OUTPUT.work)")
    parser.add_argument("--keep", action="store_true", help="keep that folder when done")
    parser.add_argument("--resume", action="store_true", help="go on from the checkpoint of an interrupted run")
    parser.add_argument("--test-views", type=_positive, metavar="N", help="test on at most N held-out pictures")
    parser.add_argument(
        "--keep-checkpoint",
        type=Path,
        metavar="MODEL.kpck",
        help="write the finished checkpoint there, too: all that coding anew takes",
    )
    parser.add_argument(
        "--group",
        type=cli.duration_s,
        metavar="10s",
        help="code a long clip in groups that show at most so long each, one after the other: encoding and playing "
        "take the memory of one; steps are those of the first group",
    )
    parser.add_argument(
        "--only",
        type=_number,
        metavar="N",
        help="of --group: code group N alone, from 0 on; kpjoin makes a clip of them",
    )
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
        help="the file of least D + LAM R: D the mean squared difference from the uncoded pictures, in squares of "
        "8-bit levels, R bits per parameter",
    )
    trade.add_argument(
        "--psnr",
        type=cli.decibels,
        metavar="30dB",
        help="the smallest file that has at least this PSNR on training views: what is simple takes less",
    )
    parser.add_argument(
        "--tune-steps",
        type=_number,
        metavar="N",
        help="training steps that a group of planes gets to make up for the errors of those that are coded: files "
        "are a tenth smaller with 100, and take a minute or two longer (default: 0 for draft, else 100); "
        "fewer after short training",
    )
    parser.add_argument(
        "--dry-run", action="store_true", help="only say what would be done, how long it would take and how much memory"
    )
    parser.add_argument("--json", action="store_true", help="print the results as JSON")
    a = parser.parse_args(_box_joined(argv))
    if a.source.is_file():
        for name, value in vars(a).items():
            if name not in CODING and value != parser.get_default(name):
                parser.error(
                    f"--{name.replace('_', '-')}: {a.source} is trained already, it can only be coded anew; drop it"
                )
    options = Options(
        a.source,
        a.output,
        a.preset,
        a.decoder,
        a.sampling,
        a.progressive,
        a.steps,
        a.time_budget,
        a.seed,
        a.device,
        a.downscale,
        a.holdout,
        a.space,
        a.box,
        a.appearance,
        a.work,
        a.keep,
        a.resume,
        a.test_views,
        a.group,
        a.only,
        Trade(a.max_loss, a.target_size, a.quality, a.lam, a.psnr),
        a.keep_checkpoint,
        a.tune_steps,
    )
    if a.only is not None and a.group is None:
        parser.error("--only names a group; say how long they are with --group 10s")
    if a.keep_checkpoint is not None and a.group is not None and a.only is None:
        parser.error("--keep-checkpoint holds a single scene; with --group give --only N, too")
    if a.dry_run and a.resume:
        parser.error("--dry-run tells what a whole run takes; drop --resume")
    return options, a.dry_run, a.json


def _positive(text: str) -> int:
    value = int(text)
    if value < 1:
        raise argparse.ArgumentTypeError(f"{text} is not a positive number")
    return value


def _number(text: str) -> int:
    if not text.isdecimal():
        raise argparse.ArgumentTypeError(f"{text!r} is not a whole number from 0 on")
    return int(text)


def _quality(text: str) -> float:
    return _number_within(text, 1, 100)


def _lam(text: str) -> float:
    return _number_within(text, 1e-4, 1e6)


def _number_within(text: str, low: float, high: float) -> float:
    try:
        value = float(text)
    except ValueError:
        value = math.nan
    if not low <= value <= high:
        raise argparse.ArgumentTypeError(f"{text!r} is not a number from {low:g} to {high:g}")
    return value


def _seed(text: str) -> int:
    value = int(text)
    if not 0 <= value < 1 << 63:
        raise argparse.ArgumentTypeError(f"{text} is not a whole number from 0 to 2^63 - 1")
    return value


def _box_joined(argv: list[str]) -> list[str]:
    """`--box -1,...` as `--box=-1,...`: argparse would take a value that starts with a minus for an option."""
    joined: list[str] = []
    for word in argv:
        if joined and joined[-1] == "--box":
            joined[-1] = f"--box={word}"
        else:
            joined.append(word)
    return joined
