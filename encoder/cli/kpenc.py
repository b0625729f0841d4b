"""`kpenc`: encode a folder of posed videos or images as a .kpc file, or code a trained model anew."""

import contextlib
import sys
import time
from collections.abc import Mapping
from dataclasses import replace
from typing import Any

from kpc.encoder.cli.encode_groups import encode_groups, plan_groups, setting_of_span
from kpc.encoder.cli.encode_scene import encode_scene, handle_signals
from kpc.encoder.cli.estimate import Estimate, estimate
from kpc.encoder.cli.grouped import LATER_STEPS, options_of_group
from kpc.encoder.cli.options import ALL_VIEWS, Options, parse
from kpc.encoder.cli.prepare import prepare_setting, prepare_trainer, working_alone
from kpc.encoder.cli.read_dataset import read_dataset
from kpc.encoder.cli.report import log, print_estimate, print_result
from kpc.encoder.cli.transcode import transcode
from kpc.encoder.cli.work_folder import has_begun, leaving_nothing, make_work_folder
from kpc.encoder.evaluation.ablations import effective_ablations
from kpc.encoder.evaluation.profile import profile
from kpc.encoder.evaluation.validation_rays import VALIDATION_RAYS
from kpc.format.common import cli, interrupts
from kpc.format.common.compiling import MONITOR
from kpc.format.common.text import notice
from kpc.format.container.groups import Groups
from kpc.format.container.metadata_options import opening_beyond_limits

__all__ = ["ALL_VIEWS", "Options", "ablations", "dry_run", "encode", "main", "profile_steps"]


def main(argv: list[str] | None = None) -> int:
    """Run the command and return its exit code."""
    with handle_signals(interrupts.handle):
        return cli.run(_command, "kpenc", argv)


def _command(argv: list[str]) -> None:
    options, only_plan, as_json = parse(argv)
    MONITOR.announces = True
    if only_plan:
        print_estimate(dry_run(options), options, as_json)
        return
    print_result(transcode(options) if options.source.is_file() else encode(options), options, as_json)
    if isinstance(options.view_limits, Mapping):
        outside = opening_beyond_limits(Groups(options.output).metadata())
        if outside is not None:
            notice(f"kpenc: {outside}; kpedit --open-at sets another")


def encode(options: Options) -> dict[str, Any]:
    """Train on a dataset and write the .kpc file.

    Returns:
        What was measured, as a dictionary that JSON can hold.

    Raises:
        DatasetError, MediaError: the dataset cannot be used.
        TrainingError: training failed, or the file cannot be written.
        KeyboardInterrupt: stopped by the user; the checkpoint is kept.
    """
    with working_alone(options):
        if options.resume and not has_begun(options.work_dir, in_groups=options.group_s is not None):
            log(f"{options.work_dir}: there is nothing to resume; starting afresh")
        if options.group_s is not None:
            return encode_groups(options)
        return encode_scene(options, prepare_setting(options))


def dry_run(options: Options) -> Estimate:
    """Do what `encode` does up to the first few hundred steps, and estimate the rest.

    Nothing is left in the work folder that was not there before; with `options.keep` or `options.cache`, decoded pixels
    are. Raises as `encode`.
    """
    with working_alone(options), contextlib.nullcontext() if options.keep else leaving_nothing(options.work_dir):
        return _dry_run(options)


def _dry_run(options: Options) -> Estimate:
    started, compiling_s = time.monotonic(), MONITOR.spent_s
    setting = prepare_setting(options)
    groups, effort = 1, 1.0  # effort: in units of the first group
    if options.group_s is not None:
        spans, number = plan_groups(options, setting.dataset.clip), options.only or 0
        groups = 1 if options.only is not None else len(spans)
        effort = 1 + LATER_STEPS * (groups - 1)
        options, setting = options_of_group(options, number, spans), setting_of_span(setting, spans[number])
    trainer = prepare_trainer(options, setting)
    found = estimate(
        trainer,
        VALIDATION_RAYS,
        options.test_views,
        time.monotonic() - started - trainer.elapsed_s - (MONITOR.spent_s - compiling_s),  # compiled once only
        options.time_budget_s,
        options.tune_steps,
    )
    tested = effort if options.test_views is None else groups
    return replace(
        found,
        train_s=effort * found.train_s,
        test_s=tested * found.test_s,
        rest_s=effort * found.rest_s,
        test_pictures=round(tested * found.test_pictures),
        held_out_pictures=groups * found.held_out_pictures,
    )


def profile_steps(options: Options) -> dict[str, Any]:
    """Profile training steps (`kpc.encoder.evaluation.profile`). Nothing is written but pixels. Raises as `encode`."""
    return profile(prepare_trainer(options, prepare_setting(options)))


def ablations(options: Options) -> list[str]:
    """Return the names of the ablations that change a run (`kpc.encoder.evaluation.ablations`). Raises as `encode`."""
    make_work_folder(options.work_dir, options.cache)
    dataset = read_dataset(options)
    return effective_ablations(options.config(dataset))


if __name__ == "__main__":
    sys.exit(main())
