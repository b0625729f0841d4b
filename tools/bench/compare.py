"""kpbench compare: what is better and what worse in new records than in old ones, beyond the noise of the repeats.

    kpbench compare old.json new.json          exit code 1 if anything is worse

Records of one kind, name and settings are compared. A figure has changed if the ranges of its repeats do not overlap;
times of a single run count as noisy by `--noise`.
"""

import json
import statistics
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

from kpc.format.common import cli
from kpc.format.common.errors import KpcError, UsageError
from kpc.format.common.text import counted
from kpc.tools.bench.records import Record, load

# Endings of the names of figures of which more is better, and of which less is; those of both kinds of time.
HIGHER = ("psnr", "psnr_min", "ssim", "agreement_db", "fps", "per_s", "gflops")
LOWER = ("bytes", "_ms", "_s", "loss_db", "flip", "flicker", "max_error", "ms_median", "ms_p95")
TIMES = ("fps", "per_s", "_ms", "_s", "ms_median", "ms_p95", "gflops")
# Figures that end so, but say what a run was given or how long it was allowed to take.
IGNORED = ("target", "seed", "time_budget_s", "rays", "steps", "received_bytes")
NOISE = 0.1  # of the time of a single run, as a share


class WorseError(KpcError):
    """Something is worse than before."""


@dataclass(frozen=True)
class Change:
    """A figure that changed.

    Attributes:
        what: kind, name and settings of the records.
        figure: its name.
        before, after: medians over the repeats.
        is_better: whether that is good.
    """

    what: str
    figure: str
    before: float
    after: float
    is_better: bool

    def __str__(self) -> str:
        share = f" ({self.after / self.before - 1:+.1%})" if self.before else ""
        word = "better" if self.is_better else "worse"
        return f"{word:<6} {self.what}: {self.figure} {self.before:,.6g} -> {self.after:,.6g}{share}"


def changes(before: Record, after: Record, noise: float = NOISE) -> list[Change]:
    """Return the figures of two records of one kind that differ beyond their noise."""
    found = []
    for figure in sorted(_figures(before) & _figures(after)):
        old, new = (_values(record, figure) for record in (before, after))
        slack = [_slack(figure, values, noise) for values in (old, new)]
        if max(old) + slack[0] < min(new) - slack[1] or max(new) + slack[1] < min(old) - slack[0]:
            medians = statistics.median(old), statistics.median(new)
            is_better = (medians[1] > medians[0]) == figure.endswith(HIGHER)
            found.append(Change(_title(before), figure, *medians, is_better))
    return found


def main(argv: Sequence[str]) -> None:
    """Compare two files of records.

    Raises:
        FormatError: a file holds no records.
        UsageError: they have no record in common.
        WorseError: something is worse.
    """
    parser = cli.Parser(
        "kpbench compare",
        description="Print what is better and worse in new records; exit with 1 if anything is worse.",
    )
    for name in ("before", "after"):
        parser.add_argument(name, type=cli.input_path, metavar=f"{name.upper()}.json")
    parser.add_argument(
        "--noise", type=_share, default=NOISE, help="share by which the time of a single run may differ (%(default)s)"
    )
    options = parser.parse_args(argv)
    before, after = (_by_title(path) for path in (options.before, options.after))
    if not before.keys() & after.keys():
        raise UsageError(
            f"{options.before} and {options.after} have no record of the same measurement: none to compare"
        )
    found = [
        change
        for title in before.keys() & after.keys()
        for change in changes(before[title], after[title], options.noise)
    ]
    for change in sorted(found, key=lambda change: (change.is_better, change.what, change.figure)):
        print(change)
    for title in sorted(before.keys() ^ after.keys()):
        print(f"only in {options.before if title in before else options.after}: {title}")
    worse = sum(not change.is_better for change in found)
    print(
        f"{counted(len(before.keys() & after.keys()), 'record')} compared: {len(found) - worse} better, {worse} worse"
    )
    if worse:
        raise WorseError(f"{worse} figure{'s are' if worse > 1 else ' is'} worse than before")


def _by_title(path: Path) -> dict[str, Record]:
    return {_title(record): record for record in load([path], _title)}


def _title(record: Record) -> str:
    """Return what a record is of: its kind, name and settings."""
    settings = {name: value for name, value in record["settings"].items() if name not in ("out", "repeats")}
    if not isinstance(record["repeats"], list):
        raise ValueError("repeats is not a list")
    return f"{record['kind']} {record['name']} {json.dumps(settings, sort_keys=True)}"


def _figures(record: Record) -> set[str]:
    """Return the names of the figures of a record of which it is known what is better."""
    return {
        name
        for repeat in record["repeats"]
        for name, value in repeat.items()
        if name.endswith(HIGHER + LOWER)
        and name not in IGNORED
        and isinstance(value, int | float)
        and not isinstance(value, bool)
    }


def _values(record: Record, figure: str) -> list[float]:
    return [repeat[figure] for repeat in record["repeats"] if repeat.get(figure) is not None]


def _slack(figure: str, values: Sequence[float], noise: float) -> float:
    """Return by how much values may differ besides their range: half of the noise, where there is one time alone."""
    return abs(values[0]) * noise / 2 if len(values) == 1 and figure.endswith(TIMES) else 0.0


def _share(text: str) -> float:
    return cli.number_within(text, 0.0, 1.0, "a share")
