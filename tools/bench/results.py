"""Write benchmark records as tables, on stdout or into documents.

    python -m kpc.tools.bench.results docs/bench/*.json
    python -m kpc.tools.bench.results docs/bench/*.json --into README.md docs/benchmarks.md

The first prints the tables as Markdown, the second rewrites those between the markers of documents, such as
`<!-- encode: begin -->` and `<!-- encode: end -->`. Tables in documents always come from here.
"""

import re
import sys
from collections.abc import Iterable, Sequence
from pathlib import Path

from kpc.format.common import cli
from kpc.format.common.errors import FormatError
from kpc.tools.bench import records as record_files
from kpc.tools.bench.columns import TITLES
from kpc.tools.bench.records import Record
from kpc.tools.bench.tables import cells, glance, machine_name, markdown, tables

# A pair of markers: begin marker, name, what stands between, end marker.
MARKED = re.compile(r"(<!-- (\w+): begin\b[^\n]*-->)(.*?)(<!-- \2: end -->)", re.DOTALL)
MARKER = re.compile(r"<!-- \w+: (?:begin|end)\b")


def load(paths: Iterable[Path]) -> list[Record]:
    """Read the records of files that kpbench wrote, in order.

    Raises:
        FormatError: a file holds something else.
    """

    def check(record: Record) -> object:
        return cells(record["kind"], [record]), machine_name(record), record["commit"], record["command"]

    return record_files.load(paths, check)


def marked_names(document: Path) -> set[str]:
    """Return the names that a document has markers for.

    Raises:
        FormatError: markers are unpaired, repeated or of an unknown name, or there are none.
    """
    text, known = document.read_text(), {*TITLES, "glance"}
    names = [name for _, name, _, _ in MARKED.findall(text)]
    paired = len(MARKER.findall(text)) == 2 * len(names)
    if not names or not paired or len({*names}) < len(names) or not known.issuperset(names):
        raise FormatError(
            f"{document}: needs lines such as <!-- encode: begin --> and <!-- encode: end -->, one pair for each name "
            f"out of {sorted(known)}"
        )
    return {*names}


def is_shown(record: Record) -> bool:
    """Return whether documents show a record: of the player's qualities, only the default and the reference."""
    if record["kind"] != "player":
        return True
    return record["settings"]["quality"] in (record["settings"]["default_quality"], "reference")


def with_tables(text: str, records: Sequence[Record]) -> str:
    """Return a document with the tables of each name, or the summary for "glance", between the markers of that name."""
    shown = [record for record in records if is_shown(record)]

    def filled(found: re.Match[str]) -> str:
        name = found[2]
        return f"{found[1]}\n\n{glance(shown) if name == 'glance' else tables(name, shown)}\n\n{found[4]}"

    return MARKED.sub(filled, text)


def main(argv: list[str] | None = None) -> int:
    """Run the command and return its exit code."""
    return cli.run(_command, "results", argv)


def _command(argv: list[str]) -> None:
    parser = cli.Parser("results", description="Write benchmark records as Markdown tables.")
    cli.add_version_option(parser)
    parser.add_argument("records", type=cli.named_path, nargs="+", help="files that kpbench --out wrote")
    parser.add_argument(
        "--into",
        type=cli.named_path,
        nargs="+",
        default=[],
        help="rewrite the tables between the markers of these documents instead of printing them",
    )
    options = parser.parse_args(argv)
    records = load(options.records)
    if not options.into:
        print(markdown(records))
        return
    missing = {record["kind"] for record in records}.difference(*map(marked_names, options.into))
    if missing:
        raise FormatError(f"{', '.join(map(str, options.into))}: no markers for tables of {', '.join(sorted(missing))}")
    for document in options.into:
        text = with_tables(document.read_text(), records)
        with cli.atomic_write(document) as aside:
            aside.write_text(text)
        print(document)


if __name__ == "__main__":
    sys.exit(main())
