"""kpbench scaling: what encoding costs by the size of the work.

One generated scene is encoded again with more or fewer cameras, frames, seconds, pixels and channels, one at a time,
and each for the same number of steps.
"""

import argparse
import sys
import tempfile
import time
from collections.abc import Iterator
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

from kpc.tools.bench import harness
from kpc.tools.bench.encoding_commands import PRESETS, encode_once
from kpc.tools.bench.records import Record
from kpc.tools.dev import scenegen

BASE = scenegen.Options(cameras=6, frames=12, width=96, height=72, samples=1)
# Multiples of the base, the base among them.
MULTIPLES = (0.5, 1.0, 2.0)
# Ablations by the multiple of channels.
CHANNELS = {0.5: "half the channels", 1.0: "baseline", 2.0: "twice the channels"}
BOX = (-2.7, -1.8, -1.5, 2.2, 2.2, 2.2)  # of the scene, so that finding it costs nothing
TEST_VIEWS = 2  # held-out pictures that are tested


@dataclass(frozen=True)
class Size:
    """One encoding.

    Attributes:
        axis: what is more or less of.
        amount: how much of it.
        scene: the clip.
        ablation: of the channels.
    """

    axis: str
    amount: float
    scene: scenegen.Options = BASE
    ablation: str = CHANNELS[1.0]


def sizes() -> list[Size]:
    """Return what is encoded: for each axis, one size for each of MULTIPLES."""
    found = []
    for k in MULTIPLES:
        cameras, frames, side = round(BASE.cameras * k), round(BASE.frames * k), k**0.5
        width, height = (8 * round(n * side / 8) for n in (BASE.width, BASE.height))
        found += [
            Size("cameras", cameras, replace(BASE, cameras=cameras)),
            Size("frames in the same time", frames, replace(BASE, frames=frames, fps=BASE.fps * k)),
            Size("seconds at the same rate", frames / BASE.fps, replace(BASE, frames=frames)),
            Size("pixels of a picture", width * height, replace(BASE, width=width, height=height)),
            Size("channels, of those of the preset", k, BASE, CHANNELS[k]),
        ]
    return sorted(found, key=lambda size: (size.axis, size.amount))


def add_parsers(kinds: Any) -> None:
    """Add the subcommand to the subparsers `kinds`."""
    parser = kinds.add_parser(
        "scaling",
        help="what encoding costs by cameras, frames, seconds, pixels and channels",
        description="Encode a small generated scene with more or fewer of each, for the same number of steps.",
    )
    parser.add_argument("--preset", choices=PRESETS, default="draft", help="preset of kpenc (default: %(default)s)")
    parser.add_argument(
        "--steps", type=harness.positive, default=100, help="optimiser steps of each (default: %(default)s)"
    )
    parser.add_argument("--axis", help="only the axis of which this is a part of the name")
    harness.add_repeats([parser])
    parser.set_defaults(measure=_scaling)


def _scaling(options: argparse.Namespace, origin: Record) -> Iterator[Record]:
    """Yield a record for each axis and size."""
    harness.encoder()
    with tempfile.TemporaryDirectory(prefix="kpbench-") as scratch:
        folders: dict[scenegen.Options, Path] = {}
        measured: dict[tuple[Path, str], tuple[str, list[Record]]] = {}  # the base is a size of every axis
        for size in sizes():
            if options.axis and options.axis not in size.axis:
                continue
            folder = folders.setdefault(size.scene, Path(scratch) / f"generated-{len(folders)}")
            if not folder.exists():
                scenegen.generate(folder, size.scene)
            settings = {"axis": size.axis, "amount": size.amount, "preset": options.preset, "steps": options.steps}
            record = harness.new_record("scaling", folder, origin, settings) | {"name": "generated"}
            print(f"kpbench: {size.axis}, {size.amount:g}", file=sys.stderr)
            if (folder, size.ablation) not in measured:
                jobs = [
                    _Job(folder, options.preset, options.steps, seed, size.ablation) for seed in range(options.repeats)
                ]
                found = [harness.isolated(_measure, job) for job in jobs]
                measured[folder, size.ablation] = found[0][0], [repeat for _, repeat in found]
            device, repeats = measured[folder, size.ablation]
            yield record | {"seed": 0, "renderer": device, "repeats": repeats}


@dataclass(frozen=True)
class _Job:
    source: Path
    preset: str
    steps: int
    seed: int
    ablation: str


def _measure(job: _Job) -> tuple[str, Record]:
    """Read and encode; return the device and seconds of reading, training and the rest, bytes and PSNR."""
    from kpc.encoder.datasets import load_dataset  # needs torch

    kpenc = harness.encoder()
    with tempfile.TemporaryDirectory(prefix="kpbench-") as scratch:
        options = kpenc.Options(
            source=job.source,
            output=Path(scratch) / "scene.kpc",
            preset=job.preset,
            steps=job.steps,
            seed=job.seed,
            device="cpu",
            work=Path(scratch) / "work",
            box=BOX,
            test_views=TEST_VIEWS,
            ablation=job.ablation,
        )
        started = time.perf_counter()
        load_dataset(options.source, options.cache_dir, holdout=options.holdout, downscale=options.downscale)
        read_s = time.perf_counter() - started
        device, outcome = encode_once(options)
    kept = ("train_s", "peak_memory_bytes", "size_bytes", "parameters", "test_psnr")
    found = {"read_s": read_s, "rest_s": outcome["encode_s"] - outcome["train_s"]}
    return device, found | {name: outcome[name] for name in kept}
