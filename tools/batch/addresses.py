"""The address of a result: a hash of its inputs, its options, and the code that makes it.

Two tasks of one address have one result, so what is done need not be done again.
"""

import hashlib
import json
import os
from collections.abc import Iterator
from functools import cache
from importlib.util import find_spec
from pathlib import Path
from typing import Any

from kpc.format.common.errors import UsageError
from kpc.format.common.media_files import is_hidden
from kpc.tools.batch.store import reason

# Packages whose code decides what a result is.
CODE = ("kpc.encoder", "kpc.format")
LENGTH = 24  # hexadecimal digits of an address


def address_of(*parts: Any) -> str:
    """Return the address of what JSON can hold."""
    return hashlib.sha256(json.dumps(parts, sort_keys=True).encode()).hexdigest()[:LENGTH]


@cache
def code_address() -> str:
    """Return the address of the installed code of encoder and format."""
    digest = hashlib.sha256()
    for package in CODE:
        root = Path(_folder_of(package))
        for file in sorted(file for end in ("*.py", "*.wasm") for file in root.rglob(end)):
            digest.update(f"{root.name}/{file.relative_to(root)}".encode() + b"\0" + file.read_bytes())
    return digest.hexdigest()[:LENGTH]


@cache
def source_address(source: str) -> str:
    """Return the address of a file's or folder's content; at an address, of what the server says of its version.

    Raises:
        UsageError: it cannot be read.
    """
    try:
        if "://" in source:
            return _remote_address(source)
        path, digest = Path(source), hashlib.sha256()
        for file in [path] if path.is_file() else sorted(_files(path)):
            name = file.relative_to(path).as_posix() if file != path else file.name
            with file.open("rb") as opened:
                digest.update(os.fsencode(name) + b"\0" + hashlib.file_digest(opened, "sha256").digest())
        return digest.hexdigest()[:LENGTH]
    except Exception as error:
        raise UsageError(f"{source}: {reason(error)}") from error


def _folder_of(package: str) -> str:
    """Return the folder of a package, which is not imported: the encoder's takes seconds."""
    spec = find_spec(package)
    assert spec is not None and spec.submodule_search_locations
    return next(iter(spec.submodule_search_locations))


def _files(folder: Path) -> Iterator[Path]:
    """Yield all files of a folder but hidden ones, and what kpenc puts beside its results."""
    for path in folder.iterdir():
        if is_hidden(path) or path.name.endswith(".kpc.work"):
            continue
        if path.is_dir():
            yield from _files(path)
        elif path.is_file():
            yield path


def _remote_address(source: str) -> str:
    import fsspec

    fs, root = fsspec.core.url_to_fs(source)
    names = sorted(fs.find(root)) or [root]
    return address_of([(name.removeprefix(root), str(fs.ukey(name))) for name in names])
