"""Benchmark records: what `kpbench` writes, and the files that hold them.

A record is a JSON object. All kinds have the keys `kind`, `name` (dataset or scene), `date`, `commit`, `command`,
`machine`, `versions`, `load_average`, `data_sha256`, `settings`, `seed`, `renderer` and `repeats`, the list of what
each run measured; some have more. Those that compare a scene with its dataset have `dataset_data_sha256`, which is of
the dataset what `data_sha256` is of the scene; `dataset_sha256` in the metadata of scenes is another hash.
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
        found = read(path)
        for number, record in enumerate(found, 1):
            try:
                check(record)
            except (ValueError, KeyError, TypeError, AttributeError) as error:
                why = f"record {number} has no {error}" if type(error) is KeyError else f"record {number}: {error}"
                raise FormatError(f"{path}: not records of kpbench ({why}); write it with kpbench --out") from error
        records += found
    return records


def read(path: Path) -> list[Record]:
    """Read a list of objects, records of whatever kind.

    Raises:
        FormatError: the file holds something else.
    """
    try:
        found = json.loads(path.read_text(encoding="utf-8"))
    except (ValueError, RecursionError) as error:
        raise FormatError(f"{path}: not records of kpbench ({error}); write it with kpbench --out") from error
    if not isinstance(found, list) or not all(isinstance(record, dict) for record in found):
        raise FormatError(f"{path}: not a list of records; write it with kpbench --out")
    return found
