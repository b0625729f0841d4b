"""The meta chunk: metadata as a JSON object in UTF-8, untrusted and bounded (spec/kpc-format.md, "meta: metadata").

SCHEMA is spec/meta.schema.json. `mismatch` checks an object against it; it knows the keywords that the schema uses.
"""

import json
import math
import re
from collections.abc import Mapping
from typing import Any

import numpy as np

from kpc.format.common.errors import DatasetError, FormatError
from kpc.format.container.scene_layout import BOX_LIMIT, CAMERA_LIMIT, NAME_LIMIT
from kpc.format.scene.cameras import has_unit_axes
from kpc.format.scene.metadata import HISTORY_LIMIT, Metadata

META_LIMIT = 1 << 16  # bytes of the content
DEPTH_LIMIT = 8  # arrays and objects within each other, the outermost included
MEMBER_LIMIT = 256  # members of an object
TEXT_LIMIT = 4096  # code points of a string
LARGEST = 1e38  # of a number, so that it is finite in float32

# What no string may hold: control characters, and those that break a line or change the direction of what follows.
# Line feeds are allowed in the description.
UNPRINTABLE = re.compile("[\x00-\x1f\x7f-\x9f\u2028-\u202e\u2066-\u2069]")

_TEXT = {"type": "string", "minLength": 1, "maxLength": 256}
_NUMBER = {"type": "number"}
_SIDE = {"type": "integer", "minimum": 1, "maximum": 65535}
_ANGLES = {"type": "array", "minItems": 2, "maxItems": 2, "items": {"type": "number", "minimum": -360, "maximum": 360}}
_COORDINATE = {"type": "number", "minimum": -BOX_LIMIT, "maximum": BOX_LIMIT}
_LENGTH = {"type": "number", "exclusiveMinimum": 0, "maximum": BOX_LIMIT}


def _vector(count: int, items: Mapping[str, Any] = _COORDINATE) -> dict[str, Any]:
    return {"type": "array", "minItems": count, "maxItems": count, "items": items}


SCHEMA: dict[str, Any] = {
    "$schema": "https://json-schema.org/draft/2020-12/schema",
    "title": "Metadata of a .kpc file",
    "type": "object",
    "properties": {
        "title": _TEXT,
        "description": {"type": "string", "minLength": 1, "maxLength": TEXT_LIMIT},
        "author": _TEXT,
        "licence": _TEXT,
        "date": {"type": "string", "pattern": "^[0-9]{4}(-[0-9]{2}(-[0-9]{2})?)?$"},
        "up": _vector(3),
        "metres_per_unit": _LENGTH,
        "transparent": {"type": "boolean"},
        "opening": {
            "type": "object",
            "required": ["camera", "time"],
            "properties": {
                "camera": {
                    "type": "object",
                    "required": ["width", "height", "focal", "centre", "pose"],
                    "properties": {
                        "width": _SIDE,
                        "height": _SIDE,
                        "focal": _vector(2, _LENGTH),
                        "centre": _vector(2),
                        "pose": _vector(12),
                    },
                },
                "time": {"type": "number", "minimum": 0, "maximum": 1},
            },
        },
        "view_limits": {
            "type": "object",
            "required": ["focus", "forward", "azimuth", "elevation", "distance", "reach"],
            "properties": {
                "focus": _vector(3),
                "forward": _vector(3),
                "azimuth": _ANGLES,
                "elevation": _ANGLES,
                "distance": _vector(2, _LENGTH),
                "reach": {"type": "number", "minimum": 0, "maximum": BOX_LIMIT},
            },
        },
        "camera_names": {
            "type": "array",
            "maxItems": CAMERA_LIMIT,
            "items": {"type": "string", "minLength": 1, "maxLength": NAME_LIMIT},
        },
        "provenance": {
            "type": "object",
            "properties": {
                "encoder": _TEXT,
                "dataset_sha256": {"type": "string", "pattern": "^[0-9a-f]{64}$"},
                "layout": _TEXT,
                "preset": _TEXT,
                "options": {
                    "type": "object",
                    "additionalProperties": {"type": ["string", "number", "boolean"], "maxLength": 256},
                },
                "seed": {"type": "integer", "minimum": 0},
                "held_out": {
                    "type": "object",
                    "properties": {
                        "pictures": {"type": "integer", "minimum": 1},
                        "psnr_db": _NUMBER,
                        "ssim": _NUMBER,
                        "moving_psnr_db": _NUMBER,
                        "still_psnr_db": _NUMBER,
                    },
                },
                "coding_loss_db": _NUMBER,
                "history": {"type": "array", "maxItems": HISTORY_LIMIT, "items": _TEXT},
            },
        },
    },
}

_TYPES: dict[str, Any] = {"object": dict, "array": list, "string": str, "boolean": bool, "number": (int, float)}


def pack_metadata(metadata: Metadata) -> bytes:
    """Return the meta chunk.

    Raises:
        FormatError: a reader would refuse it.
    """
    try:
        raw = json.dumps(metadata.document, ensure_ascii=False, allow_nan=False, separators=(",", ":")).encode()
    except (ValueError, TypeError) as error:
        raise FormatError(f"meta: cannot be written as JSON ({error})") from error
    parse_metadata(raw)
    return raw


def parse_metadata(raw: bytes) -> Metadata:
    """Read the meta chunk."""
    if len(raw) > META_LIMIT:
        raise FormatError(f"meta: holds {len(raw):,} bytes, more than the {META_LIMIT:,} allowed")
    try:
        document = json.loads(raw.decode(), object_pairs_hook=_unique, parse_constant=_refuse_constant)
    except (ValueError, RecursionError) as error:  # of UTF-8, too
        raise FormatError(f"meta: no valid JSON in UTF-8 ({_shortened(str(error))})") from error
    _check_bounds(document, "meta", 1)
    if (wrong := mismatch(document, SCHEMA)) is not None:
        raise FormatError(f"meta: {wrong}")
    metadata = Metadata(document)
    _check_geometry(metadata)
    return metadata


def _unique(pairs: list[tuple[str, Any]]) -> dict[str, Any]:
    members = dict(pairs)
    if len(members) != len(pairs):
        raise ValueError("a name is there twice in an object")
    return members


def _refuse_constant(name: str) -> None:
    raise ValueError(f"{name} is no number of JSON")


def _check_bounds(value: Any, where: str, depth: int) -> None:
    """Check the limits of every value, known or not."""
    if isinstance(value, dict | list):
        if depth > DEPTH_LIMIT:
            raise FormatError(f"meta: arrays and objects are nested deeper than {DEPTH_LIMIT}")
        if isinstance(value, dict):
            if len(value) > MEMBER_LIMIT:
                raise FormatError(f"{where}: an object of {len(value):,} members, more than {MEMBER_LIMIT}")
            for name in value:
                _check_text(name, where, "")
        for name, item in value.items() if isinstance(value, dict) else enumerate(value):
            _check_bounds(item, f"{where}.{name}", depth + 1)
    elif isinstance(value, str):
        _check_text(value, where, "\n" if where == "meta.description" else "")
    elif isinstance(value, int | float) and not abs(value) <= LARGEST:  # False for NaN, too
        raise FormatError(f"{where}: a number is too large")


def _check_text(text: str, where: str, allowed: str) -> None:
    is_unicode = text.encode(errors="replace").decode() == text  # False if a surrogate stands alone
    if len(text) > TEXT_LIMIT:
        raise FormatError(f"{where}: a text is longer than {TEXT_LIMIT:,} characters, by {len(text) - TEXT_LIMIT:,}")
    if not is_unicode:
        raise FormatError(f"{where}: a text is not Unicode")
    if UNPRINTABLE.search(text.replace(allowed, "") if allowed else text):
        raise FormatError(f"{where}: a text holds tabs or other control characters")


def mismatch(value: Any, schema: Mapping[str, Any], where: str = "the object") -> str | None:
    """Return how a JSON value breaks a schema, in words; None if it does not.

    Args:
        value: as the json module returns it.
        schema: a JSON Schema of the keywords that SCHEMA uses.
        where: what the value is called in messages.
    """
    kinds = schema["type"] if isinstance(schema["type"], list) else [schema["type"]]
    if not any(_is_of(value, kind) for kind in kinds):
        return f"{where} is no {' or '.join(kinds)}"
    if isinstance(value, str):
        fits = schema.get("minLength", 0) <= len(value) <= schema.get("maxLength", TEXT_LIMIT)
        if not (fits and re.search(schema.get("pattern", "").replace("$", r"\Z"), value)):
            return f"{where} is too long, too short, or not of the form that it should have"
    elif isinstance(value, list):
        if not schema.get("minItems", 0) <= len(value) <= schema.get("maxItems", math.inf):
            return f"{where} has {len(value)} items"
        return next(filter(None, (mismatch(v, schema["items"], f"{where}[{k}]") for k, v in enumerate(value))), None)
    elif isinstance(value, dict):
        return _member_mismatch(value, schema, where)
    elif not isinstance(value, bool):
        above = schema.get("exclusiveMinimum", -math.inf)
        low, high = schema.get("minimum", above), schema.get("maximum", math.inf)
        if not (low <= value <= high and value > above):
            return f"{where} is {value:g}, outside its range from {low:g} to {high:g}"
    return None


def _member_mismatch(value: Mapping[str, Any], schema: Mapping[str, Any], where: str) -> str | None:
    missing = [name for name in schema.get("required", ()) if name not in value]
    if missing:
        return f"{where} has no {missing[0]}"
    known, others = schema.get("properties", {}), schema.get("additionalProperties")
    for name, item in value.items():
        rule = known.get(name, others)
        if rule is not None and (wrong := mismatch(item, rule, name)) is not None:
            return wrong if where == "the object" else f"{where}: {wrong}"
    return None


def _is_of(value: Any, kind: str) -> bool:
    if kind == "integer":
        return _is_of(value, "number") and float(value).is_integer()
    return isinstance(value, _TYPES[kind]) and (kind == "boolean" or not isinstance(value, bool))


def _check_geometry(metadata: Metadata) -> None:
    """Check what the schema cannot say: lengths of vectors, order of bounds, and the pose of the camera."""
    document = metadata.document
    limits = document.get("view_limits")
    if "up" in document and not np.linalg.norm(document["up"]) >= 1 / BOX_LIMIT:
        raise FormatError("meta: up has no direction")
    if limits is not None:
        bounds = [limits[name] for name in ("azimuth", "elevation", "distance")]
        if "up" not in document or any(low > high for low, high in bounds):
            raise FormatError("meta: view_limits: there is no up, or a least value is above the largest")
        forward, up = np.array(limits["forward"], float), np.array(document["up"], float)
        size = float(np.linalg.norm(forward))
        if not size >= 1 / BOX_LIMIT or np.linalg.norm(np.cross(forward, up)) < 1e-3 * size * np.linalg.norm(up):
            raise FormatError("meta: view_limits: forward has no direction, or that of up")
    if "opening" in document:
        try:
            opening = metadata.opening
        except DatasetError as error:
            raise FormatError(f"meta: opening: {error}") from error
        if opening is not None and not has_unit_axes(opening.camera.camera_to_world):
            raise FormatError("meta: opening: the axes of the camera are not of length 1")


def _shortened(text: str) -> str:
    return text if len(text) <= 120 and text.isprintable() else repr(text[:120])
