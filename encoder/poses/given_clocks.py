"""Clocks that the user gives: `--sync offsets.json`.

The file holds an object with an offset in seconds for each camera, or an object of offset and rate:

    {"cam00": 0, "cam01": 0.4, "cam02": {"offset_s": -0.12, "rate": 1.00002}}

Time of the clip = offset_s + rate * time of the camera's file. Cameras that are not named have an offset of 0.
"""

import math
from collections.abc import Sequence
from pathlib import Path
from typing import Any

from kpc.encoder.datasets.capture import first_names, printable
from kpc.encoder.datasets.layouts.documents import MAX_BYTES, read_json
from kpc.encoder.datasets.layouts.transforms import check_clock
from kpc.encoder.poses.clocks import UNKNOWN, Clock
from kpc.format.common.errors import DatasetError
from kpc.format.common.text import notice

KEYS = ("offset_s", "rate")


def read_clocks(file: Path, names: Sequence[str]) -> list[Clock]:
    """Read the clocks of the named cameras.

    Raises:
        DatasetError: there is no such file, or it names other cameras or holds what is no clock.
    """
    if not file.is_file():
        raise DatasetError(f"{file}: no such file; give --sync auto, audio, motion, none, or a file of offsets")
    document = read_json(file, MAX_BYTES)
    if not isinstance(document, dict) or not document:
        raise DatasetError(f'{file}: no object with an offset for each camera, such as {{"cam01": 0.4}}; correct it')
    unknown = [name for name in document if name not in names]
    if unknown:
        raise DatasetError(
            f"{file}: names cameras that are not there: {first_names(unknown)}; there are {first_names(list(names))}"
        )
    missing = [name for name in names if name not in document]
    if missing:
        notice(f"{file}: does not name {first_names(missing)}, whose clocks are left as they are")
    return [_clock(file, name, document[name]) if name in document else UNKNOWN for name in names]


def _clock(file: Path, name: str, value: Any) -> Clock:
    where = f"{file}: {printable(name)}"
    entry = value if isinstance(value, dict) else {"offset_s": value}
    others = [key for key in entry if key not in KEYS]
    if others:
        raise DatasetError(f"{where}: unknown keys {first_names(others)}; there are {' and '.join(KEYS)}")
    offset, rate = (_number(where, key, entry.get(key, default)) for key, default in zip(KEYS, (0.0, 1.0), strict=True))
    check_clock(where, KEYS, offset, rate)
    return Clock(offset, rate, "given", float("nan"))


def _number(where: str, key: str, value: Any) -> float:
    if isinstance(value, bool) or not isinstance(value, int | float):
        raise DatasetError(f"{where}: {key} is no number; give seconds")
    try:
        return float(value)
    except OverflowError:
        return math.inf
