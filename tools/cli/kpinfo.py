"""kpinfo: show what is inside .kpc files.

    kpinfo scene.kpc             clip, scene box, planes and chunks
    kpinfo *.kpc                 a line for each file, and totals
    kpinfo https://host/scene.kpc
    kpinfo long.kpc --group 2    one group of a clip in groups; without --group, a list of its groups
    kpinfo scene.kpc --json      the same as a JSON object, which docs/kpinfo.schema.json describes
    kpinfo scene.kpc --verify    also check all checksums and decode everything

The exit code is 1 if any file is damaged or cannot be read. Without --verify, a file whose end is missing is described
as far as it goes, and of a clip in groups only what describes the groups is read, so that damage to the rest is not
noticed.
"""

import argparse
import sys

from kpc.format.common import cli
from kpc.format.common.errors import KpcError, UsageError
from kpc.format.common.memory import DEFAULT_BUDGET
from kpc.format.common.text import agreeing
from kpc.tools.cli.kpinfo_facts import SCHEMA, examine, totals
from kpc.tools.cli.kpinfo_page import page, table


def main(argv: list[str] | None = None) -> int:
    """Run the command and return its exit code."""
    return cli.run(_command, "kpinfo", argv)


def _command(argv: list[str]) -> None:
    options = _parser().parse_args(argv)
    is_one = len(options.files) == 1
    if options.group is not None and not is_one:
        raise UsageError("--group describes a group of one file; name one file")
    files = []
    for file in options.files:
        info = examine(
            file,
            memory=options.memory,
            group=options.group,
            verify=options.verify,
            details=options.json or is_one,
        )
        files.append(info)
        if info["error"] is not None and not is_one:
            cli.print_error("kpinfo", info["error"])
    sums = totals(files)
    if options.json:
        cli.print_json({"schema": SCHEMA, "files": files, "totals": sums})
    elif not is_one:
        print(table(files, sums))
    elif not sums["failed"] or len(files[0]["groups"]) > 1:  # of a damaged clip, what can be read
        print(page(files[0]))
    if sums["failed"]:
        are = agreeing(sums["failed"], "is", "are")
        summary = f"{sums['failed']} of {len(files)} files {are} damaged or cannot be read"
        raise KpcError(files[0]["error"] if is_one else summary)


def _parser() -> argparse.ArgumentParser:
    parser = cli.Parser(prog="kpinfo", description="Show what is inside .kpc files.")
    cli.add_version_option(parser)
    parser.add_argument("files", nargs="+", type=cli.file_name, metavar="file", help="a .kpc file, or its http address")
    parser.add_argument("--json", action="store_true", help="print a JSON object (docs/kpinfo.schema.json)")
    parser.add_argument(
        "--group", type=cli.whole_number, metavar="N", help="describe group N of a clip in groups, counted from 0"
    )
    parser.add_argument("--verify", action="store_true", help="check every CRC32C and decode everything")
    parser.add_argument(
        "--memory",
        type=cli.byte_count,
        default=DEFAULT_BUDGET,
        metavar="500MB",
        help=f"limit for a scene, or a group of a clip in groups (default: {DEFAULT_BUDGET / 1e9:.3g}GB)",
    )
    return parser


if __name__ == "__main__":
    sys.exit(main())
