"""Draw benchmark records.

    python -m kpc.tools.bench.plot docs/bench/curve.json -o docs/curve.svg
    python -m kpc.tools.bench.plot docs/bench/codec.json -o docs/codec.svg
    python -m kpc.tools.bench.plot docs/bench/groups.json -o docs/groups.svg
    python -m kpc.tools.bench.plot docs/bench/player.json -o docs/player.svg
    python -m kpc.tools.bench.plot docs/bench/quality.json -o docs/quality.svg
    python -m kpc.tools.bench.plot docs/bench/stability.json -o docs/stability.svg

Records of `kpbench curve` give quality and size against training time, those of `codec` rate against distortion, those
of `groups` the PSNR of each frame, those of `player` accuracy against frame time, those of `quality` each measure of
each frame, those of `stability` errors against what is swept. The suffix of the output chooses SVG,
PNG or PDF. Needs the extra `bench`: `pip install "kpc[bench]"`.
"""

import sys

from kpc.format.common import cli
from kpc.tools.bench import results


def main(argv: list[str] | None = None) -> int:
    """Run the command and return its exit code."""
    return cli.run(_command, "plot", argv)


def _command(argv: list[str]) -> None:
    parser = cli.Parser("plot", description="Draw records of kpbench curve, codec, groups, player or quality.")
    cli.add_version_option(parser)
    parser.add_argument("records", type=cli.named_path, nargs="+", help="files that kpbench --out wrote")
    parser.add_argument(
        "-o", "--output", type=cli.output_path, required=True, help="the .svg, .png or .pdf file to write"
    )
    options = parser.parse_args(argv)
    from kpc.tools.bench import figures  # here, since --help needs no matplotlib
    from kpc.tools.bench.stability import figure

    # What draws records of a kind; the others are drawn by `curves`.
    drawn = {
        "codec": figures.rate_distortion,
        "groups": figures.per_frame,
        "player": figures.quality_levels,
        "quality": figures.fidelity,
        "stability": figure.draw,
    }
    records = results.load(options.records)
    draw = drawn.get(records[0]["kind"] if records else "", figures.curves)
    figures.save(draw(records), options.output)
    print(options.output)


if __name__ == "__main__":
    sys.exit(main())
