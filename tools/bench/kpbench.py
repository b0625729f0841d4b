"""kpbench: measure quality, size and speed, as records that can be checked.

    kpbench encode room liam --preset balanced --out docs/bench/balanced.json
    kpbench curve room liam --minutes 1,2,5,10,20 --out docs/bench/curve.json
    kpbench ablate default --preset fast --steps 2000 --out docs/bench/ablate.json
    kpbench step room soldier --preset balanced --out docs/bench/step.json
    kpbench groups long_clip --preset fast --group 5s --out docs/bench/groups.json
    kpbench ceiling room --preset balanced --frames 3 --out docs/bench/ceiling.json
    kpbench player room.kpc liam.kpc --out docs/bench/player.json
    kpbench stream room.kpc liam.kpc --out docs/bench/stream.json
    kpbench window room.kpc liam.kpc --out docs/bench/window.json
    kpbench steady room.kpc liam.kpc --out docs/bench/steady.json
    kpbench web room.kpc liam.kpc --out docs/bench/web.json
    kpbench web default.kpc --loading --repeats 3 --out docs/bench/webload.json
    kpbench codec room.kpck liam.kpc --dataset room --dataset liam --out docs/bench/codec.json
    kpbench entropy room.kpc liam.kpc --out docs/bench/entropy.json
    kpbench decode room.kpc liam.kpc --out docs/bench/decode.json
    kpbench scaling --repeats 3 --out docs/bench/scaling.json
    kpbench quality room.kpc room --out docs/bench/quality.json
    kpbench stability --out docs/bench/stability.json
    kpbench compare old.json new.json
    kpbench report docs/bench/*.json -o report.html
    kpbench suite -o records --plan

Every record states what was run (commit, command, seed, settings), on what (machine, renderer, versions, SHA-256 of the
data) and the result of every repeat; see `kpc.tools.bench.records`. The output is one JSON list: with --out it is
written after every record, otherwise to stdout at the end. Every repeat runs in a process of its own.
"""

import argparse
import shlex
import sys
from importlib import import_module
from pathlib import Path

from kpc.format.common import cli
from kpc.tools.bench import checking_commands, coding_commands, encoding_commands, playing_commands, scaling, tables
from kpc.tools.bench.provenance import commit, machine, versions
from kpc.tools.bench.records import Record, as_json

# Subcommands that measure nothing themselves: their module, loaded where it is needed, and what they do.
APART = {
    "compare": ("compare", "what is better and worse in new records than in old ones"),
    "report": ("report.page", "one page with the curves of all trades"),
    "suite": ("suite", "all of it from one commit, in less than an hour on generated scenes"),
}


def main(argv: list[str] | None = None) -> int:
    """Run the command and return its exit code."""
    return cli.run(_command, "kpbench", argv)


def _command(argv: list[str]) -> None:
    if argv and argv[0] in APART:
        import_module(f"kpc.tools.bench.{APART[argv[0]][0]}").main(argv[1:])
        return
    options = _parser().parse_args(argv)
    origin = {
        "commit": commit(),
        "command": shlex.join(["kpbench", *argv]),
        "machine": machine(),
        "versions": versions(),
    }
    out: Path | None = options.out
    if out is not None:
        cli.check_writable(out, option="--out")
    for scene in getattr(options, "scenes", ()):
        options.look(scene)
    records: list[Record] = []
    try:
        for record in options.measure(options, origin):
            records.append(record)
            if out is not None:
                with cli.atomic_write(out) as aside:
                    aside.write_text(as_json(records))
    finally:  # a later failure or Ctrl-C loses nothing that was measured
        if records:
            print(tables.printed(records[0]["kind"], records), file=sys.stderr)
            print(f"all figures are in {out or 'the JSON on stdout'}", file=sys.stderr)
            if out is None:
                print(as_json(records), end="")


def _parser() -> argparse.ArgumentParser:
    parser = cli.Parser(
        "kpbench", description="Measure encoding or playing; write JSON to stdout or --out, and a table to stderr."
    )
    cli.add_version_option(parser)
    kinds = parser.add_subparsers(
        dest="kind",
        required=True,
        metavar="encode|curve|ablate|step|groups|ceiling|player|stream|window|steady|web|codec|entropy|decode|quality|"
        "pictures|stability|scaling|compare|report|suite",
    )
    for name, (_, help) in APART.items():
        kinds.add_parser(name, add_help=False, help=help)
    for module in (encoding_commands, playing_commands, coding_commands, checking_commands, scaling):
        module.add_parsers(kinds)
    for kind in kinds.choices.values():
        if kind.add_help:  # others parse their options themselves
            cli.add_version_option(kind)
        kind.add_argument(
            "--out", type=cli.output_file(".json"), metavar="JSON", help="write the records here instead of to stdout"
        )
    return parser


if __name__ == "__main__":
    sys.exit(main())
