"""The conformance vectors of metadata."""

import json
from collections.abc import Callable
from typing import Any

from kpc.encoder.coding.scene_writer import scene_chunks
from kpc.format.container.container import Chunk
from kpc.format.container.metadata_chunk import DEPTH_LIMIT, MEMBER_LIMIT, META_LIMIT, TEXT_LIMIT
from kpc.tools.vectors.files import Stored, assemble, raw, value_count, zstd
from kpc.tools.vectors.scenes import make_scene

MINIMAL = b'{"title":"minimal"}'

LIMITS = {
    "focus": [0, 0.25, -0.5],
    "forward": [0.6, -0.8, 0.25],
    "azimuth": [-30, 40.5],
    "elevation": [-5, 60],
    "distance": [0.5, 4],
    "reach": 0.75,
}
CAMERA = {
    "width": 64,
    "height": 48,
    "focal": [80, 80.5],
    "centre": [32, 24],
    "pose": [0.96, 0, 0.28, 0.5, 0, 1, 0, -0.25, -0.28, 0, 0.96, 3],
}
FULL: dict[str, Any] = {
    "title": "A dancer, 舞者",
    "description": "Twelve cameras.\nOne take.",
    "author": "A. Author",
    "licence": "CC-BY-4.0",
    "date": "2026-11-27",
    "up": [0, 0, 2],
    "metres_per_unit": 0.01,
    "transparent": True,
    "opening": {"camera": CAMERA, "time": 0.5},
    "view_limits": LIMITS,
    "camera_names": ["cam00", "cam01"],
    "provenance": {
        "encoder": "kpc 0.2.0",
        "dataset_sha256": 32 * "0f",
        "layout": "N3DV",
        "preset": "balanced",
        "options": {"downscale": 2, "progressive": True, "space": "box"},
        "seed": 7,
        "held_out": {
            "pictures": 30,
            "psnr_db": 30.25,
            "ssim": 0.953,
            "moving_psnr_db": 27.5,
            "still_psnr_db": 31,
        },
        "coding_loss_db": 0.1,
        "history": ["kpedit --title"],
    },
    "later": {"nobody": [1, None, {"knows": "this"}]},
}


def valid() -> dict[str, tuple[bytes, bool]]:
    """Return files by name, and whether they are prefixes."""
    full, depth = _json(FULL), DEPTH_LIMIT - 1
    large = {
        "description": TEXT_LIMIT * "\n",
        "members": {f"{k:x}": k for k in range(MEMBER_LIMIT)},
        "nested": json.loads(depth * "[" + depth * "]"),
        "numbers": [1e38, -1e38, 5e-324, 2**63],
    }
    return {
        "metadata": (_file(full), False),
        "metadata-prefix": (_file(full)[: -len(full)], True),
        "metadata-zstd": (_file(full, zstd), False),
        "metadata-empty": (_file(b" {}\n"), False),
        "limits-metadata": (_file(_json(large).ljust(META_LIMIT), zstd), False),
    }


def invalid() -> dict[str, tuple[bytes, str, str]]:
    """Return files by name, the error and a part of its message."""

    def changed(**members: Any) -> bytes:
        return _file(_json(FULL | members))

    def limits(**members: Any) -> bytes:
        return changed(view_limits=LIMITS | members)

    def camera(**members: Any) -> bytes:
        return changed(opening={"camera": CAMERA | members, "time": 0})

    depth, stretched = DEPTH_LIMIT, [2 * number for number in CAMERA["pose"]]  # type: ignore[attr-defined]
    files = {
        "twice": (_file(MINIMAL, count=2), "2 meta chunks"),
        "cut": (_file(MINIMAL[:-1]), "no valid JSON"),
        "latin": (_file(b'{"title":"\xe9"}'), "no valid JSON"),
        "mark": (_file(b"\xef\xbb\xbf" + MINIMAL), "no valid JSON"),
        "nan": (_file(b'{"metres_per_unit":NaN}'), "no number of JSON"),
        "infinite": (_file(b'{"later":1e999}'), "too large"),
        "name-twice": (_file(b'{"title":"a","title":"b"}'), "is there twice"),
        "array": (_file(b"[]"), "is no object"),
        "brackets": (_file(META_LIMIT * b"[", zstd), "no valid JSON"),
        "deep": (changed(later=json.loads(depth * "[" + depth * "]")), "nested deeper"),
        "members": (changed(later=dict.fromkeys(map(str, range(MEMBER_LIMIT + 1)))), "members"),
        "long": (_file(MINIMAL.ljust(META_LIMIT + 1), zstd), "at most"),
        "text": (_file(_json({"later": (TEXT_LIMIT + 1) * "a"}), zstd), "a text is longer"),
        "escape": (changed(title="\x1b[2J"), "control characters"),
        "direction": (changed(author="\u202e"), "control characters"),
        "line": (changed(title="a\nb"), "control characters"),
        "surrogate": (_file(b'{"title":"\\ud800"}'), "not Unicode"),
        "title": (changed(title=7), "title is no string"),
        "title-empty": (changed(title=""), "title is too long, too short"),
        "date": (changed(date="27.11.2026"), "date is too long"),
        "unit": (changed(metres_per_unit=0), "metres_per_unit is 0"),
        "flag": (changed(transparent=1), "transparent is no boolean"),
        "up": (changed(up=[0, 0, 0]), "up has no direction"),
        "up-short": (changed(up=[0, 1]), "up has 2 items"),
        "no-up": (_file(_json({"view_limits": LIMITS})), "there is no up"),
        "limits-order": (limits(azimuth=[1, 0]), "least value is above"),
        "limits-up": (limits(forward=[0, 0, 3]), "that of up"),
        "limits-missing": (changed(view_limits={}), "view_limits has no focus"),
        "limits-near": (limits(distance=[0, 1]), "outside its range"),
        "opening-time": (changed(opening={"camera": CAMERA, "time": 1.5}), "time is 1.5"),
        "opening-width": (camera(width=64.5), "width is no integer"),
        "opening-axes": (camera(pose=[3 * number for number in stretched]), "not of length 1"),
        "names": (changed(camera_names=["a", ""]), "too short"),
        "option": (changed(provenance={"options": {"a": []}}), "no string or number or boolean"),
        "hash": (changed(provenance={"dataset_sha256": 64 * "g"}), "dataset_sha256 is too long"),
    }
    return {f"metadata-{name}": (content, "FormatError", message) for name, (content, message) in files.items()}


def _json(document: dict[str, Any]) -> bytes:
    return json.dumps(document, ensure_ascii=False, separators=(",", ":")).encode()


def _file(content: bytes, store: Callable[[Chunk], Stored] = raw, count: int = 1) -> bytes:
    """Return the file of a scene of two cameras with chunks `meta` at its end."""
    scene = make_scene(dynamic=False, sizes=[(1, 2, 2, 2, 0)], cameras=2)
    chunks = [raw(chunk) for chunk in scene_chunks(scene)]
    return assemble([*chunks, *(store(Chunk("meta", content)) for _ in range(count))], value_count(scene))
