"""The subcommands of kpbench that encode: encode, curve, ablate, step, groups and ceiling."""

import argparse
import sys
import tempfile
from collections.abc import Iterator, Sequence
from dataclasses import asdict, replace
from pathlib import Path
from typing import Any

from kpc.format.common import cli
from kpc.format.common.memory import peak_memory_bytes
from kpc.tools.bench import harness
from kpc.tools.bench.records import Record

# A dataset, and the fields of `kpenc.Options` that differ between the runs of a record.
Run = tuple[Path, dict[str, Any]]

PRESETS = ("draft", "fast", "balanced", "best", "paper")
DEFAULT_PRESET = "balanced"  # as for kpenc


def add_parsers(kinds: Any) -> None:
    """Add the subcommands to the subparsers `kinds`."""
    encode = kinds.add_parser("encode", help="kpenc on each dataset", description="Run kpenc on each dataset.")
    encode.add_argument(
        "--time-budget", type=cli.duration_s, metavar="10m", help="duration of training instead of a number of steps"
    )
    encode.add_argument(
        "--psnr", type=cli.psnr_db, metavar="30dB", help="make the smallest file with this PSNR on training views"
    )
    encode.set_defaults(measure=_encode)

    curve = kinds.add_parser(
        "curve", help="quality against training time", description="Run kpenc on each dataset for each duration."
    )
    curve.add_argument(
        "--minutes",
        type=harness.minutes,
        default=(1.0, 2.0, 5.0, 10.0, 20.0),
        metavar="1,2,5,10,20",
        help="durations of training, each in a run of its own (default: 1,2,5,10,20)",
    )
    curve.set_defaults(measure=_curve, steps=None)

    ablate = kinds.add_parser(
        "ablate",
        help="the contribution of each part of training",
        description="Run kpenc on each dataset with one change at a time; see kpc.encoder.evaluation.ablations.",
    )
    ablate.set_defaults(measure=_ablate)

    step = kinds.add_parser(
        "step", help="profile of a training step", description="Profile a training step on the CPU."
    )
    step.set_defaults(measure=_step, device="cpu")
    harness.add_repeats((encode, curve, ablate, step))

    groups = kinds.add_parser(
        "groups",
        help="a long clip in groups",
        description="Run kpenc --group on each dataset: memory for one group and for all, and how steady held-out "
        "views are where groups join.",
    )
    groups.add_argument(
        "--group", type=cli.duration_s, default=10.0, metavar="10s", help="duration of a group (default: 10s)"
    )
    groups.set_defaults(measure=_groups)

    ceiling = kinds.add_parser(
        "ceiling",
        help="frames trained alone, as a measure for what moves",
        description="Train frames of each dataset alone, as still scenes, and compare them with its held-out views, "
        "moving and still pixels of the clip apart.",
    )
    ceiling.add_argument(
        "--frames", type=harness.positive, default=3, help="frames, spread over the clip (default: %(default)s)"
    )
    ceiling.set_defaults(measure=_ceiling)

    for parser in (encode, ablate, groups, ceiling):
        of = " of the first group" if parser is groups else ""
        parser.add_argument("--steps", type=harness.positive, help=f"optimiser steps{of} instead of the preset's")
    for parser in (encode, curve, ablate, step, groups, ceiling):
        _add_common(parser)
    for parser in (curve, ablate, step, groups, ceiling):
        parser.set_defaults(psnr=None)
    for parser in (encode, curve, ablate, groups, ceiling):
        parser.add_argument("--device", choices=("auto", "cpu", "cuda"), default="auto", help="where to train")
        if parser is not ceiling:  # which compares with all of its few frames
            parser.add_argument(
                "--test-views", type=harness.positive, metavar="N", help="test on at most N held-out pictures, not all"
            )
        parser.add_argument(
            "--keep-scenes",
            type=cli.output_path,
            metavar="DIR",
            help="keep the .kpc files, and the .kpck files for `codec`, here",
        )


def _add_common(parser: argparse.ArgumentParser) -> None:
    parser.add_argument("datasets", type=cli.named_path, nargs="+", metavar="DATASET", help="folders, as for kpenc")
    parser.add_argument(
        "--preset", choices=PRESETS, default=DEFAULT_PRESET, help="preset of kpenc (default: %(default)s)"
    )
    parser.add_argument(
        "--seed",
        type=cli.whole_number,
        default=0,
        help="seed of the first repeat; each further one adds 1 (default: 0)",
    )
    parser.add_argument("--downscale", type=harness.positive, default=1, help="average blocks of N x N pixels first")
    parser.add_argument(
        "--space", choices=("auto", "box", "contracted", "ndc"), default="auto", help="mapping of space, as for kpenc"
    )
    parser.add_argument("--box", type=cli.box_corners, metavar="x0,y0,z0,x1,y1,z1", help="scene box, as for kpenc")


def _encode(options: argparse.Namespace, origin: Record) -> Iterator[Record]:
    """Yield one record per dataset."""
    runs: list[Run] = [(source, {"time_budget_s": options.time_budget}) for source in options.datasets]
    yield from _encodings("encode", options, origin, runs)


def _curve(options: argparse.Namespace, origin: Record) -> Iterator[Record]:
    """Yield one record per dataset and duration; the learning rate decays over the duration, so each is a new run."""
    runs: list[Run] = [(source, {"time_budget_s": 60 * m}) for source in options.datasets for m in options.minutes]
    yield from _encodings("curve", options, origin, runs)


def _ablate(options: argparse.Namespace, origin: Record) -> Iterator[Record]:
    """Yield one record per dataset and ablation that changes its configuration, the unchanged run first."""
    harness.encoder()
    runs: list[Run] = []
    with tempfile.TemporaryDirectory(prefix="kpbench-") as scratch:
        for source in options.datasets:
            folder, work = harness.existing_folder(source), Path(scratch) / f"{len(runs)}.work"
            job = _job(options, folder, options.seed, Path(scratch) / "none.kpc", work)
            runs += [(source, {"ablation": name}) for name in harness.isolated(_ablations, job)]
    yield from _encodings("ablate", options, origin, runs)


def _encodings(kind: str, options: argparse.Namespace, origin: Record, runs: Sequence[Run]) -> Iterator[Record]:
    """Yield one record per run. Repeat k uses seed + k, so that repeats show how quality varies, too."""
    harness.encoder()  # reports a missing package before anything is read
    with tempfile.TemporaryDirectory(prefix="kpbench-") as scratch:
        kept: Path = options.keep_scenes or Path(scratch)
        kept.mkdir(parents=True, exist_ok=True)
        for source, changes in runs:
            settings = {
                "preset": options.preset,
                "steps": options.steps,
                **changes,
                "downscale": options.downscale,
                "space": options.space,
                "box": options.box,
                "psnr_db": options.psnr,
                "test_views": options.test_views,
            }
            record = harness.new_record(kind, harness.existing_folder(source), origin, settings)
            record |= {"seed": options.seed, "repeats": []}
            label = f"{record['name']}-{options.preset}"
            if kind != "encode":
                label += "-" + "-".join(map(str, changes.values())).replace(" ", "-")
            shown = [f"{key} {value}" for key, value in changes.items() if value is not None]
            for seed in range(options.seed, options.seed + options.repeats):
                print(
                    "kpbench: " + ", ".join([record["name"], options.preset, *shown, f"seed {seed}"]), file=sys.stderr
                )
                suffix = f"-{seed}" if options.repeats > 1 else ""
                work = Path(scratch) / f"{label}-{seed}.work"
                job = replace(
                    _job(options, source, seed, kept / f"{label}{suffix}.kpc", work),
                    steps=options.steps,
                    keep_checkpoint=kept / f"{label}{suffix}.kpck" if options.keep_scenes else None,
                    **changes,
                )
                device, outcome = harness.isolated(encode_once, job)
                record["repeats"].append(outcome)
            yield record | {"renderer": device}


def _step(options: argparse.Namespace, origin: Record) -> Iterator[Record]:
    """Yield one record per dataset: the profile of a training step, beside plain PyTorch and the machine's limits."""
    harness.encoder()
    with tempfile.TemporaryDirectory(prefix="kpbench-") as scratch:
        for source in options.datasets:
            settings = {
                "preset": options.preset,
                "downscale": options.downscale,
                "space": options.space,
                "box": options.box,
            }
            record = harness.new_record("step", harness.existing_folder(source), origin, settings)
            record |= {"seed": options.seed, "repeats": []}
            work = Path(scratch) / f"{record['name']}.work"
            job = _job(options, source, options.seed, Path(scratch) / "none.kpc", work)
            for _ in range(options.repeats):
                print(f"kpbench: {record['name']}, {options.preset}, training step", file=sys.stderr)
                device, found = harness.isolated(_step_once, job)
                record["repeats"].append(found)
            yield record | {"kind": "step" if device == "cpu" else "gpu", "renderer": device}


def _groups(options: argparse.Namespace, origin: Record) -> Iterator[Record]:
    """Yield one record per dataset: peak memory after the first group and after all, and steadiness at the joins.

    Beside --out FILE.json, FILE.svg shows the PSNR of each frame.
    """
    harness.encoder()
    records: list[Record] = []
    with tempfile.TemporaryDirectory(prefix="kpbench-") as scratch:
        kept: Path = options.keep_scenes or Path(scratch)
        kept.mkdir(parents=True, exist_ok=True)
        for source in options.datasets:
            settings = {
                "preset": options.preset,
                "group_s": options.group,
                "steps": options.steps,
                "downscale": options.downscale,
                "space": options.space,
                "box": options.box,
                "test_views": options.test_views,
            }
            record = harness.new_record("groups", harness.existing_folder(source), origin, settings)
            record |= {"seed": options.seed}
            output, work = kept / f"{record['name']}-groups.kpc", Path(scratch) / f"{record['name']}.work"
            job = replace(
                _job(options, source, options.seed, output, work),
                steps=options.steps,
                group_s=options.group,
                keep=True,
            )
            print(f"kpbench: {record['name']}, {options.preset}, groups of {options.group:g} s", file=sys.stderr)
            device, found = harness.isolated(encode_once, job)
            groups = found.pop("groups")
            first_peak = groups[0]["peak_memory_bytes"]
            repeat = found | {"groups": len(groups), "first_group_peak_memory_bytes": first_peak}
            record |= {"renderer": device, "repeats": [repeat], "per_group": groups}
            records.append(record | harness.isolated(_measure_joins, job))
            yield records[-1]
    if options.out is not None:
        from kpc.tools.bench import figures  # needs matplotlib

        figures.save(figures.per_frame(records), options.out.with_suffix(".svg"))


def _ceiling(options: argparse.Namespace, origin: Record) -> Iterator[Record]:
    """Yield one record per dataset."""
    harness.encoder()
    from kpc.tools.bench import ceiling, quality  # need torch

    with tempfile.TemporaryDirectory(prefix="kpbench-") as scratch:
        for source in options.datasets:
            folder = harness.existing_folder(source)
            settings = {
                "dataset": folder.resolve().name,
                "preset": options.preset,
                "steps": options.steps,
                "frames": options.frames,
                "downscale": options.downscale,
                "space": options.space,
                "box": options.box,
            }
            record = harness.new_record("ceiling", folder, origin, settings)
            print(f"kpbench: {record['name']}, {options.preset}, {options.frames} frames alone", file=sys.stderr)
            kept = options.keep_scenes or Path(scratch)
            kept.mkdir(parents=True, exist_ok=True)
            job = replace(
                _job(
                    options,
                    folder,
                    options.seed,
                    kept / f"{record['name']}-frame.kpc",
                    Path(scratch) / f"{record['name']}.work",
                ),
                steps=options.steps,
            )
            found = harness.isolated(ceiling.measure, ceiling.Job(job, options.frames))
            print(quality.frame_table(found["frames"]), file=sys.stderr)
            yield record | {
                "seed": options.seed,
                "renderer": "cpu",
                "frames": found["frames"],
                "repeats": [found["means"]],
            }


def _job(options: argparse.Namespace, source: Path, seed: int, output: Path, work: Path) -> Any:
    """Return the `kpenc.Options` that all subcommands have in common."""
    kpenc = harness.encoder()
    job = kpenc.Options(
        source=source,
        output=output,
        preset=options.preset,
        seed=seed,
        device=options.device,
        downscale=options.downscale,
        space=options.space,
        box=options.box,
        work=work,
        test_views=getattr(options, "test_views", None) or kpenc.ALL_VIEWS,
    )
    return replace(job, trade=replace(job.trade, psnr_db=options.psnr))


# --- what runs in processes of its own


def _ablations(job: Any) -> list[str]:
    names: list[str] = harness.encoder().ablations(job)
    return names


def encode_once(job: Any) -> tuple[str, Record]:
    """Encode; return the device and what kpenc reports."""
    import torch

    outcome = harness.encoder().encode(job)
    device = outcome.pop("device")
    outcome["file"] = Path(outcome["file"]).name  # without the folder, which is private to the machine
    outcome["peak_memory_bytes"] = peak_memory_bytes()
    return device if device == "cpu" else torch.cuda.get_device_name(), outcome


def _step_once(job: Any) -> tuple[str, Record]:
    """Profile a training step; return the device and the profile."""
    found: Record = harness.encoder().profile_steps(job)
    device = found.pop("device")
    from kpc.tools.bench import machine_limits  # here, since it needs numba

    limits = {"limits": asdict(machine_limits.measure())} if device == "cpu" else {}
    return device, found | limits | {"peak_memory_bytes": peak_memory_bytes()}


def _measure_joins(job: Any) -> dict[str, Any]:
    from kpc.encoder.datasets import load_dataset  # needs torch
    from kpc.tools.bench.group_joins import measure

    return measure(job.output, load_dataset(job.source, job.work_dir, holdout=job.holdout, downscale=job.downscale))
