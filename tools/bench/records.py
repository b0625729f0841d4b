"""Benchmark records: what `kpbench` writes, and the files that hold them.

A record is a JSON object. All kinds have the keys `kind`, `name` (dataset or scene), `date`, `commit`, `command`,
`machine`, `versions`, `load_average`, `data_sha256`, `settings`, `seed`, `renderer` and `repeats`, the list of what
each run measured; some have more.
"""

import json
import statistics
from collections.abc import Callable, Iterable, Sequence
from pathlib import Path
from typing import Any

from kpc.format.common.errors import FormatError

Record = dict[str, Any]


def median(record: Record, key: str) -> float | None:
    """Return the median of `key` over the repeats that have it; None where none has."""
    values = [repeat[key] for repeat in record["repeats"] if repeat.get(key) is not None]
    return statistics.median(values) if values else None


def as_json(records: Sequence[Record]) -> str:
    """Return records as a JSON list with one record a line."""
    return "[\n" + ",\n".join(json.dumps(record) for record in records) + "\n]\n"


def load(paths: Iterable[Path], check: Callable[[Record], object]) -> list[Record]:
    """Read the records of files that kpbench wrote, in order.

    Args:
        check: raises ValueError, KeyError, TypeError or AttributeError for an object that is no valid record.

    Raises:
        FormatError: a file holds something else.
    """
    records: list[Record] = []
    for path in paths:
        try:
            found = json.loads(path.read_text())
            if not isinstance(found, list):
                raise ValueError("not a list")
            for record in found:
                check(record)
        except (ValueError, KeyError, TypeError, AttributeError) as error:
            raise FormatError(f"{path}: not records of kpbench ({error!r}); write it with kpbench --out") from error
        records += found
    return records
