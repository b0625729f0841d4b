"""What the pictures in a folder show, so that --resume does not mix pictures of different options."""

import argparse
import contextlib
import hashlib
import json
import re
from collections.abc import Collection, Iterator
from enum import Enum
from pathlib import Path
from typing import Any

import numpy as np

from kpc.format.common.cli import atomic_write
from kpc.format.common.errors import UsageError
from kpc.format.common.text import notice
from kpc.format.container.http_address import Address, is_url
from kpc.tools.rendering.claims import claimed

RECORD = "kprender.json"
# Options that do not change what a picture shows: they choose pictures, or concern other outputs. A picture of another
# format is another file.
FREE = {"output", "resume", "start_s", "end_s", "frames", "step", "format", "codec", "crf", "bits"}
# The member of the record that lists pictures that lay in the folder before kprender rendered into it.
UNKNOWN = "pictures of unknown origin"
CHECKSUM = "SHA-256 "
PICTURES = {".png", ".jpg", ".jpeg", ".exr"}
# Options whose name on the command line differs from that of their value.
NAMES = {"content": "what is shown", "part": "--diagnose", "scene": "the scene", "others": "--with"}


@contextlib.contextmanager
def rendering(
    folder: Path, options: argparse.Namespace, is_transparent: bool, paths: Collection[Path]
) -> Iterator[None]:
    """Note in a folder what its pictures show, before the first one is rendered, and keep it from other pictures.

    Without `--resume`, pictures of other options that are to be replaced are deleted first, so that a later `--resume`
    does not take them for finished, and so are those that lay there before the first run; where others stay, the folder
    is noted, and said, to hold pictures of various options, or of unknown origin.

    Args:
        folder: the folder of the pictures.
        options: the options of `kprender`.
        is_transparent: whether the pictures have alpha; the background of `options` is black then.
        paths: of the pictures to render.

    Raises:
        UsageError: `--resume` is given, and pictures that are there were rendered with other options, or nobody knows
            with which; or others are rendered there now.
    """
    now = described(options)
    if is_transparent:
        now["background"] = "transparent"
    with claimed(folder, "kprender", {name: _identity(value) for name, value in now.items()}):
        _begin(folder, options, now, paths)
        yield


def _begin(folder: Path, options: argparse.Namespace, now: dict[str, Any], paths: Collection[Path]) -> None:
    record = folder / RECORD
    names = {path.name for path in paths}
    unknown: set[str] = set()
    if record.is_file():
        try:
            before = dict(json.loads(record.read_text()))
        except (ValueError, TypeError) as error:
            if options.resume:
                raise UsageError(f"--resume: {record} cannot be read; delete it, or render without --resume") from error
            before = {}
        changed = [name for name in now if _identity(before.get(name)) != _identity(now[name])]
        if changed and options.resume:
            what, was, given = _difference(changed[0], before, now, _pictures(folder), names)
            raise UsageError(
                f"--resume: the pictures in {folder} were rendered with another value of {what} "
                f"({_shown(was)}, now {_shown(given)}); give the same, or another folder with -o"
            )
        unknown = set(map(str, found)) if isinstance(found := before.get(UNKNOWN), list) else set()
        if lying := sorted(path.name for path in paths if path.name in unknown and path.exists() and options.resume):
            raise UsageError(
                f"--resume: {folder / lying[0]} was there before kprender, so what it shows is not known; delete it, "
                "or give another folder with -o"
            )
        stale = names if changed else names & unknown
    elif options.resume and any(path.exists() for path in paths):
        raise UsageError(
            f"--resume: {folder} holds pictures and no {RECORD}, so what they show is not known; delete them, or give "
            "another folder with -o"
        )
    else:
        changed, stale, unknown = [], names, _pictures(folder)
    for name in stale:
        (folder / name).unlink(missing_ok=True)
    staying = _pictures(folder) - names
    if changed and staying:
        now |= dict.fromkeys(changed, "various")
    if unknown := unknown & staying:
        now[UNKNOWN] = sorted(unknown)
    if others := staying if changed else unknown:
        notice(f"kprender: {folder}: other pictures stay there, such as {min(others)}; {len(others):,} in all")
    with atomic_write(record) as temporary:
        temporary.write_text(json.dumps(now, indent=1) + "\n")


def _difference(
    name: str, before: dict[str, Any], now: dict[str, Any], lying: Collection[str], names: Collection[str]
) -> tuple[str, Any, Any]:
    """Return what differs, as users name it, and its value in the folder and now.

    Pictures are transparent in EXR, and not in other formats, where --background is not given: then the format differs.

    Args:
        name: of a member of the record that differs. lying: pictures in the folder. names: of those to render.
    """
    was, given = before.get(name), now[name]
    kinds, asked = ({Path(one).suffix[1:] for one in some} for some in (lying, names))
    is_unasked = name == "background" and (was, given) in ((None, "transparent"), ("transparent", None))
    if kinds and is_unasked and "exr" in kinds ^ asked:
        return "--format", " and ".join(sorted(kinds)), " and ".join(asked)
    return NAMES.get(name, "--" + name.replace("_", "-")), was, given


def _pictures(folder: Path) -> set[str]:
    """Return the names of the pictures in a folder."""
    return {path.name for path in folder.iterdir() if path.suffix.lower() in PICTURES}


def described(options: argparse.Namespace) -> dict[str, Any]:
    """Return the options that pictures depend on, as JSON values without what is secret; files count by content."""
    found = {}
    for name, value in sorted(vars(options).items()):
        if name in FREE:
            continue
        found[name] = _described(value)
    return found


def _described(value: Any) -> Any:
    """Return the value of an option as JSON, a file by its name and content."""
    if isinstance(value, Enum):
        return value.value
    if isinstance(value, np.ndarray):
        return [float(number) for number in value]
    if isinstance(value, list):
        return [_described(one) for one in value] or None
    if isinstance(value, str | Path) and Path(value).is_file():
        return f"{Path(value).name}, {_checksum(Path(value).read_bytes())}"
    if isinstance(value, str) and is_url(value):
        address = Address.parse(value)  # the query may say which scene it is; user and password do not
        return f"{address.name}, address of {_checksum(address.url.encode())}"
    return value if isinstance(value, int | float | None) else str(value)


def _checksum(content: bytes) -> str:
    return f"{CHECKSUM}{hashlib.sha256(content).hexdigest()[:16]}"


def _identity(value: Any) -> Any:
    """Return what distinguishes one value from another: of files their content, since they may be renamed."""
    if isinstance(value, list):
        return [_identity(one) for one in value]
    return value[value.index(CHECKSUM) :] if isinstance(value, str) and CHECKSUM in value else value


def _shown(value: Any) -> str:
    """Return a value as the command line takes it: a size as 640x480, a colour as #ffffff."""
    if isinstance(value, list) and isinstance(value[0], str):
        return ", ".join(value)
    if isinstance(value, list):
        return "#" + "".join(f"{round(255 * part):02x}" for part in value)
    return "not given" if value is None else re.sub(r"\((\d+), (\d+)\)", r"\1x\2", str(value))
