"""The subcommands of kpbench that compare with the truth: quality, pictures and stability."""

import argparse
import sys
from collections.abc import Iterator
from pathlib import Path
from typing import Any

from kpc.format.common import cli, extras
from kpc.format.common.progress import progress
from kpc.format.container.groups import Groups
from kpc.tools.bench import harness
from kpc.tools.bench.provenance import data_hash
from kpc.tools.bench.records import Record


def add_parsers(kinds: Any) -> None:
    """Add the subcommands to the subparsers `kinds`."""
    quality = kinds.add_parser(
        "quality",
        help="how near a scene is to held-out views, frame by frame, moving and still pixels apart",
        description="Compare a scene with the held-out views of its dataset by PSNR, SSIM, FLIP and flicker. With "
        "--out FILE.json also write FILE.csv and FILE.svg, with every frame.",
    )
    quality.add_argument(
        "--test-views",
        type=harness.positive,
        metavar="N",
        help="compare with at most N held-out pictures, spread over time, which leaves no flicker (default: all)",
    )
    quality.set_defaults(measure=_quality)

    pictures = kinds.add_parser(
        "pictures",
        help="held-out views beside the truth, and where they differ",
        description="Keep the worst and the median of a scene's held-out views beside what was filmed, with maps of "
        "their errors, for kpbench report.",
    )
    pictures.add_argument(
        "--test-views",
        type=harness.positive,
        default=12,
        metavar="N",
        help="choose among N held-out pictures, spread over time (default: %(default)s)",
    )
    pictures.set_defaults(measure=_pictures)

    for parser in (quality, pictures):
        parser.add_argument("scene", type=cli.input_path, metavar="SCENE", help="a .kpc file")
        parser.add_argument("dataset", type=cli.named_path, metavar="DATASET", help="the folder that it was made from")
        parser.add_argument("--holdout", metavar="NAME", help="camera or file to compare with (default: as encoded)")
        parser.add_argument(
            "--downscale",
            type=harness.positive,
            metavar="N",
            help="average blocks of N x N pixels (default: as encoded)",
        )

    stability = kinds.add_parser(
        "stability",
        help="every stage against float64, at numbers from small to large",
        description="Sweep boxes, cameras, clips, planes, mappings, motion, densities, samples and bits from small to "
        "large, and compare pictures, products and gradients with float64. With --out FILE.json also write FILE.svg.",
    )
    stability.set_defaults(measure=_stability)


def _quality(options: argparse.Namespace, origin: Record) -> Iterator[Record]:
    """Yield one record; beside --out FILE.json, FILE.csv and FILE.svg hold every frame."""
    harness.encoder()  # reports a missing package before anything is read
    from kpc.tools.bench import quality  # needs torch

    if options.out is not None:
        from kpc.tools.bench import figures  # needs matplotlib
    record, job = _beginning("quality", options, origin)
    found = harness.isolated(quality.measure, job)
    record |= {"frames": found["frames"], "repeats": [found["means"]]}
    print(quality.frame_table(found["frames"]), file=sys.stderr)
    if found["means"]["flip"] is None:
        print(f"kpbench: FLIP needs flip-evaluator; {extras.install('bench')}", file=sys.stderr)
    yield record
    if options.out is not None:
        with cli.atomic_write(options.out.with_suffix(".csv")) as aside:
            aside.write_text(quality.as_csv([record]))
        figures.save(figures.fidelity([record]), options.out.with_suffix(".svg"))


def _pictures(options: argparse.Namespace, origin: Record) -> Iterator[Record]:
    """Yield one record, with the pictures in it."""
    harness.encoder()
    from kpc.tools.bench import picture_pairs  # needs torch

    record, job = _beginning("pictures", options, origin)
    yield record | harness.isolated(picture_pairs.measure, job)


def _beginning(kind: str, options: argparse.Namespace, origin: Record) -> tuple[Record, Any]:
    """Return a record before anything is measured, and the `quality.Job` of it: a scene and its dataset, as encoded."""
    from kpc.tools.bench import quality  # needs torch

    made = Groups(options.scene).metadata().provenance
    encoded: dict[str, Any] = dict(made.get("options", {}))
    holdout = options.holdout or encoded.get("holdout")
    downscale = options.downscale or int(encoded.get("downscale", 1))
    folder = harness.existing_folder(options.dataset)
    if encoded.get("refine", "none") != "none":
        print(
            f"kpbench: {options.scene.name} was trained with refined cameras; held-out views are drawn from where the "
            "dataset puts them",
            file=sys.stderr,
        )
    settings = {
        "dataset": folder.resolve().name,
        "holdout": holdout,
        "downscale": downscale,
        "test_views": options.test_views,
    }
    record = harness.new_record(kind, options.scene, origin, settings)
    record |= {"dataset_data_sha256": data_hash(folder), "seed": None, "renderer": "cpu"}
    print(f"kpbench: {record['name']}, against {settings['dataset']}", file=sys.stderr)
    return record, quality.Job(options.scene, folder, holdout, downscale, options.test_views)


def _stability(options: argparse.Namespace, origin: Record) -> Iterator[Record]:
    """Yield a record for each sweep; beside --out FILE.json, FILE.svg shows all of them."""
    harness.encoder()  # reports a missing package before anything is measured
    import torch

    from kpc.tools.bench.stability import pictures, scenes, stages, sweeps  # need torch

    if options.out is not None:
        from kpc.tools.bench import figures  # needs matplotlib
        from kpc.tools.bench.stability import figure
    drawn_by = scenes.opengl_name()
    if drawn_by is None:
        print("kpbench: no OpenGL here; the player's renderers are left out", file=sys.stderr)
    torch.set_num_threads(1)  # pictures are small
    records = []
    for sweep in progress([*stages.sweeps(), *pictures.sweeps()], "stability", unit="sweeps"):
        found = sweeps.run(sweep)
        record = harness.new_record("stability", Path(scenes.__file__), origin, sweep.settings())
        record |= {"name": sweep.stage, "seed": 0, "renderer": drawn_by or "cpu"}
        record |= {"points": found["points"], "passes": found["passes"]}
        record["repeats"] = [{"max_error": found["max_error"], "worst": found["worst"]}]
        records.append(record)
        yield record
    if options.out is not None:
        figures.save(figure.draw(records), options.out.with_suffix(".svg"))
