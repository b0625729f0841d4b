"""What the subcommands of kpbench share: the head of a record, processes of their own, options and parsers."""

import argparse
import multiprocessing
import os
import re
from collections.abc import Callable, Iterable
from concurrent.futures import ProcessPoolExecutor
from concurrent.futures.process import BrokenProcessPool
from datetime import UTC, datetime
from pathlib import Path
from types import ModuleType
from typing import Any, TypeVar

from kpc.format.common import cli
from kpc.format.common.errors import KpcError, UsageError
from kpc.format.container.container import Reader
from kpc.tools.bench.provenance import data_hash
from kpc.tools.bench.records import Record
from kpc.tools.dev.processes import end_with_parent

T = TypeVar("T")


def new_record(kind: str, source: Path, origin: Record, settings: dict[str, Any]) -> Record:
    """Return a record with all that is known before anything is measured.

    Args:
        source: the dataset or scene.
        origin: commit, command, machine and versions.
        settings: what this record was measured with.
    """
    return {
        "kind": kind,
        "name": source.resolve().stem if source.is_file() else source.resolve().name,
        "date": datetime.now(UTC).isoformat(timespec="seconds"),
        **origin,
        "load_average": os.getloadavg()[0],
        "data_sha256": data_hash(source),
        "settings": settings,
    }


def isolated(function: Callable[[Any], T], job: Any) -> T:
    """Return `function(job)`, computed in a new process, so that no run inherits the memory of another.

    Raises:
        KpcError: the process was killed.
    """
    with ProcessPoolExecutor(1, multiprocessing.get_context("spawn"), initializer=end_with_parent) as pool:
        try:
            return pool.submit(function, job).result()
        except BrokenProcessPool as error:
            raise KpcError(f"{function.__name__.strip('_')}: the process was killed; free some memory") from error


def existing_folder(source: Path) -> Path:
    """Return `source`.

    Raises:
        UsageError: it is no folder.
    """
    if not source.is_dir():
        raise UsageError(f"{source}: no such folder")
    return source


def encoder() -> ModuleType:
    """Return the module `kpenc`, which needs the extra `encoder`."""
    from kpc.encoder.cli import kpenc

    return kpenc


def size_text(size: tuple[int, int]) -> str:
    """Return a size as WIDTHxHEIGHT."""
    return "{}x{}".format(*size)


# --- the command line


def add_scenes(
    parser: argparse.ArgumentParser, help: str = ".kpc files", look: Callable[[Path], object] = Reader
) -> None:
    """Add the positional argument SCENE...; `look` raises an error for what is none, before anything is measured."""
    parser.set_defaults(look=look)
    parser.add_argument("scenes", type=cli.named_path, nargs="+", metavar="SCENE", help=help)


def add_size(parser: argparse.ArgumentParser, default: tuple[int, int], what: str) -> None:
    """Add --size WxH of `what`."""
    help = f"size of {what} (default: {size_text(default)})"
    parser.add_argument("--size", type=picture_size, default=default, metavar="WxH", help=help)


def add_repeats(parsers: Iterable[argparse.ArgumentParser]) -> None:
    """Add --repeats."""
    for parser in parsers:
        parser.add_argument("--repeats", type=positive, default=1, help="runs of each measurement (default: 1)")


def positive(text: str) -> int:
    """Parse an integer of at least 1."""
    return cli.whole_number(text, 1)


def minutes(text: str) -> tuple[float, ...]:
    """Parse a list of minutes such as 1,2,5."""
    try:
        values = tuple(float(word) for word in text.split(","))
    except ValueError:
        values = ()
    if not values or not all(0 < value < 1e6 for value in values):
        raise argparse.ArgumentTypeError(f"{text!r} is not a list of minutes such as 1,2,5")
    return values


def picture_size(text: str) -> tuple[int, int]:
    """Parse WIDTHxHEIGHT, each from 1 to 9999."""
    match = re.fullmatch(r"([1-9]\d{0,3})x([1-9]\d{0,3})", text)
    if match is None:
        raise argparse.ArgumentTypeError(f"{text!r} is not a size such as 320x240")
    return int(match[1]), int(match[2])
