"""Section 6.8: metadata, a JSON object that satisfies meta.schema.json."""

import json
import math
import pathlib
import re

from .common import Refused, require

SCHEMA = json.loads((pathlib.Path(__file__).parents[1] / "meta.schema.json").read_bytes())
BOX_LIMIT = 2**30
UNPRINTABLE = re.compile("[\x00-\x1f\x7f-\x9f\u2028-\u202e\u2066-\u2069]")
TYPES = {"object": dict, "array": list, "string": str, "boolean": bool, "number": (int, float)}


def decode_metadata(content):
    """Return the object as a dict."""
    require(len(content) <= 65536, "metadata are too long")
    try:
        document = json.loads(content.decode("utf-8"), object_pairs_hook=decode_members, parse_constant=refuse)
    except (ValueError, RecursionError) as error:
        raise Refused("metadata are no JSON in UTF-8") from error
    require_limits(document, 1, ())
    require(satisfies(document, SCHEMA), "metadata do not satisfy the schema")
    require_geometry(document)
    return document


def decode_members(pairs):
    members = dict(pairs)
    require(len(members) == len(pairs), "a name is there twice in an object")
    return members


def refuse(constant):
    raise Refused("NaN and infinity are no JSON")


def require_limits(value, depth, path):
    if isinstance(value, (dict, list)):
        require(depth <= 8, "metadata are nested too deeply")
        require(isinstance(value, list) or len(value) <= 256, "an object has too many members")
        for name, item in value.items() if isinstance(value, dict) else enumerate(value):
            require_limits(name, depth, ())
            require_limits(item, depth + 1, (*path, name))
    elif isinstance(value, str):
        text = value.replace("\n", "") if path == ("description",) else value
        require(len(value) <= 4096 and not UNPRINTABLE.search(text), "a text is too long or not printable")
        require(not re.search("[\ud800-\udfff]", text), "a text is not Unicode")
    elif isinstance(value, (int, float)):
        require(abs(value) <= 1e38, "a number is not finite")


def satisfies(value, schema):
    kinds = schema["type"] if isinstance(schema["type"], list) else [schema["type"]]
    if not any(is_of(value, kind) for kind in kinds):
        return False
    if isinstance(value, str):
        pattern = schema.get("pattern", "").replace("$", r"\Z")
        return schema.get("minLength", 0) <= len(value) <= schema.get("maxLength", 4096) and re.search(pattern, value)
    if isinstance(value, list):
        fits = schema.get("minItems", 0) <= len(value) <= schema.get("maxItems", math.inf)
        return fits and all(satisfies(item, schema["items"]) for item in value)
    if isinstance(value, dict):
        known, others = schema.get("properties", {}), schema.get("additionalProperties")
        rules = {name: known.get(name, others) for name in value}
        return all(name in value for name in schema.get("required", ())) and all(
            satisfies(value[name], rule) for name, rule in rules.items() if rule is not None
        )
    if isinstance(value, bool):
        return True
    within = schema.get("minimum", -math.inf) <= value <= schema.get("maximum", math.inf)
    return within and value > schema.get("exclusiveMinimum", -math.inf)


def is_of(value, kind):
    if kind == "integer":
        return is_of(value, "number") and value == math.floor(value)
    return isinstance(value, TYPES[kind]) and (kind == "boolean" or not isinstance(value, bool))


def require_geometry(document):
    if "up" in document:
        require(math.hypot(*document["up"]) >= 1 / BOX_LIMIT, "up has no direction")
    if "view_limits" in document:
        limits = document["view_limits"]
        require("up" in document, "there are view limits without up")
        for name in ("azimuth", "elevation", "distance"):
            require(limits[name][0] <= limits[name][1], "a least value is above the largest")
        (a, b, c), (x, y, z) = limits["forward"], document["up"]
        size = math.hypot(a, b, c)
        require(size >= 1 / BOX_LIMIT, "forward has no direction")
        sine = math.hypot(b * z - c * y, c * x - a * z, a * y - b * x) / (size * math.hypot(x, y, z))
        require(sine >= 0.001, "forward has the direction of up")
    if "opening" in document:
        pose = document["opening"]["camera"]["pose"]
        require(all(0.5 <= math.hypot(*pose[column::4]) <= 2 for column in range(3)), "invalid axes of a camera")
