"""Write the conformance vectors beside the spec: `python -m kpc.tools.vectors.specvectors spec/vectors`.

    valid/NAME.kpc       decodes to what manifest.json says, bit by bit
    invalid/NAME.kpc     is refused; manifest.json names the kind of error and a part of its message

Every file is computed from integers, so that it comes out the same everywhere; only files with chunks under ZSTD
depend on the version of that library, and only in how they are packed (manifest.json says which version packed them).
"""

import hashlib
import sys
from functools import cache
from pathlib import Path
from typing import Any

from kpc.format.common import cli
from kpc.format.common.errors import UsageError
from kpc.tools.vectors import group_vectors, metadata_vectors, sound_vectors
from kpc.tools.vectors.description import ZSTD_VERSION, described, manifest_json
from kpc.tools.vectors.invalid import invalid
from kpc.tools.vectors.valid import valid

__all__ = ["ZSTD_VERSION", "described", "files", "manifest", "vectors"]


def main(argv: list[str] | None = None) -> int:
    return cli.run(_command, "specvectors", argv)


def _command(argv: list[str]) -> None:
    if len(argv) != 1 or argv[0].startswith("-"):
        raise UsageError("give the folder to write, as in: python -m kpc.tools.vectors.specvectors spec/vectors")
    for path, data in vectors().items():
        target = Path(argv[0]) / path
        target.parent.mkdir(parents=True, exist_ok=True)
        with cli.atomic_write(target) as aside:
            aside.write_bytes(data)


def vectors() -> dict[str, bytes]:
    """Return all files of the vector set: path -> content."""
    return files() | {"manifest.json": manifest_json(manifest())}


@cache
def files() -> dict[str, bytes]:
    """Return the .kpc files: path -> content; one process makes them once."""
    scenes = valid() | metadata_vectors.valid() | sound_vectors.valid()
    whole = {name: data for name, (data, partial) in scenes.items() if not partial}
    found = {f"valid/{name}.kpc": data for name, (data, _) in (scenes | group_vectors.valid(whole)).items()}
    refused = invalid() | metadata_vectors.invalid() | sound_vectors.invalid() | group_vectors.invalid(whole)
    return found | {f"invalid/{name}.kpc": data for name, (data, *_) in refused.items()}


def manifest() -> dict[str, dict[str, Any]]:
    """Return what `manifest.json` says of every vector."""
    scenes = valid() | metadata_vectors.valid() | sound_vectors.valid()
    whole = {name: data for name, (data, partial) in scenes.items() if not partial}
    names = {data: name for name, data in whole.items()}
    found = {name: _hash(data) | described(data, partial) for name, (data, partial) in scenes.items()}
    for name, (data, partial) in group_vectors.valid(whole).items():
        found[name] = _hash(data) | group_vectors.described(data, partial, names)
    refused = invalid() | metadata_vectors.invalid() | sound_vectors.invalid() | group_vectors.invalid(whole)
    return {
        "valid": found,
        "invalid": {name: {"error": error, "message": message} for name, (_, error, message) in refused.items()},
    }


def _hash(data: bytes) -> dict[str, Any]:
    return {"sha256": hashlib.sha256(data).hexdigest()}


if __name__ == "__main__":
    sys.exit(main())
