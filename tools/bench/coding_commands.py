"""The subcommands of kpbench that code scenes: codec, entropy and decode."""

import argparse
import sys
from collections.abc import Iterator
from pathlib import Path
from typing import Any

from kpc.format.common import cli
from kpc.format.common.errors import UsageError
from kpc.format.common.progress import progress
from kpc.tools.bench import decode_bench, harness
from kpc.tools.bench.provenance import machine
from kpc.tools.bench.records import Record


def add_parsers(kinds: Any) -> None:
    """Add the subcommands to the subparsers `kinds`."""
    codec = kinds.add_parser(
        "codec",
        help="rate against distortion, beside general-purpose codecs",
        description="Code each scene at several rates, and its planes with general-purpose codecs; see "
        "kpc.tools.bench.baselines. With --out FILE.json also write FILE.csv and FILE.svg.",
    )
    harness.add_scenes(codec, "finished checkpoints (kpenc --keep-checkpoint) or .kpc files", _look)
    codec.add_argument(
        "--dataset",
        type=cli.named_path,
        action="append",
        metavar="DIR",
        help="measure distortion on its held-out views; once for each scene, in the same order (default: on training "
        "pixels of a checkpoint, or on pictures of the .kpc file itself)",
    )
    codec.add_argument(
        "--ablate", action="store_true", help="also measure KPC's own coder with each of its parts left out"
    )
    codec.add_argument(
        "--processes",
        type=harness.positive,
        default=int(machine()["cores"]),
        metavar="N",
        help="number of parallel processes (default: one per core)",
    )
    codec.set_defaults(measure=_codec)

    entropy = kinds.add_parser(
        "entropy",
        help="the contribution of each part of the entropy coder",
        description="Code the symbols of each scene again, with one part of the entropy coder left out at a time.",
    )
    harness.add_scenes(entropy)
    entropy.set_defaults(measure=_entropy)

    decode = kinds.add_parser(
        "decode",
        help="how long the decoder core takes",
        description="Decode all plane segments of each scene on one thread and on two, once everything is loaded. "
        "A group of a clip is a scene of its own: decode the files that were joined.",
    )
    harness.add_scenes(decode)
    harness.add_repeats([decode])
    decode.set_defaults(measure=_decode)


def _look(source: Path) -> None:
    """Raise an error if a package is missing, or a file is neither a checkpoint nor a .kpc file."""
    harness.encoder()
    from kpc.tools.bench import codec_bench  # needs scipy

    codec_bench.codec_model.is_coded(source)


def _codec(options: argparse.Namespace, origin: Record) -> Iterator[Record]:
    """Yield a record for each scene and coder.

    Beside --out FILE.json, FILE.csv holds all points and FILE.svg shows the curves. FILE.NAME.points holds the points
    of a scene measured so far, from which an interrupted benchmark goes on; it is deleted at the end.
    """
    from kpc.tools.bench import codec_bench  # needs scipy

    folders: list[Path | None] = [*map(harness.existing_folder, options.dataset or ())] or [None] * len(options.scenes)
    if len(folders) != len(options.scenes):
        raise UsageError(
            f"--dataset is given {len(folders)} times for {len(options.scenes)} scenes; name one for each, or none"
        )
    if options.out is not None:
        from kpc.tools.bench import figures  # needs matplotlib
    records: list[Record] = []
    logs: list[Path] = []
    for source, folder in zip(options.scenes, folders, strict=True):
        views = "its own validation rays"
        if folder is not None:
            views = f"held-out views of {folder.resolve().name}"
        settings = {"evaluated_on": views, "processes": options.processes}
        record = harness.new_record("codec", source, origin, settings)
        print(f"kpbench: {record['name']}, evaluated on {views}", file=sys.stderr)
        log = None
        if options.out is not None:
            stamp = {key: record[key] for key in ("commit", "data_sha256", "machine", "versions", "settings")}
            log = codec_bench.PointLog(options.out.with_suffix(f".{record['name']}.points"), stamp)
            logs.append(log.path)
        for coder in codec_bench.measure(source, folder, options.processes, options.ablate, log):
            repeats = [codec_bench.headline(coder["points"])]
            records.append(record | {"seed": None, "renderer": "cpu"} | coder | {"repeats": repeats})
            yield records[-1]
    if options.out is not None:
        with cli.atomic_write(options.out.with_suffix(".csv")) as aside:
            aside.write_text(codec_bench.as_csv(records))
        figures.save(figures.rate_distortion(records), options.out.with_suffix(".svg"))
    for path in logs:
        path.unlink()


def _entropy(options: argparse.Namespace, origin: Record) -> Iterator[Record]:
    """Yield a record for each scene and variant of the entropy coder."""
    from kpc.tools.bench import entropy_ablation  # here, since it needs numba

    for source in options.scenes:
        for variant, found in entropy_ablation.measure(source).items():
            record = harness.new_record("entropy", source, origin, {"variant": variant})
            yield record | {"seed": None, "renderer": "cpu", "repeats": [found]}


def _decode(options: argparse.Namespace, origin: Record) -> Iterator[Record]:
    """Yield a record for each scene."""
    for source in options.scenes:
        record = harness.new_record("decode", source, origin, {})
        repeats = [
            harness.isolated(decode_bench.measure, source)
            for _ in progress(range(options.repeats), "decode", unit="repeats")
        ]
        yield record | {"seed": None, "renderer": "cpu", "repeats": repeats}
