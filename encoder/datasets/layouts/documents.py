"""Reading of documents that hold calibrations: JSON, YAML, TOML and XML.

Nothing in them is trusted: a file of calibrations is refused if it is large, and whatever a parser raises becomes one
line. A key that is there twice in one object is an error, since it is unknown which is meant.
"""

import json
import re
import tomllib
from collections.abc import Callable
from pathlib import Path
from typing import Any
from xml.etree import ElementTree

import yaml

from kpc.encoder.datasets.capture import printable
from kpc.format.common.errors import DatasetError
from kpc.format.common.text import open_text

# The largest file of calibrations, in bytes, and the largest of YAML, of which PyYAML parses 30 KB a second at worst.
# Two hundred cameras take 60 to 100 KB.
MAX_BYTES, MAX_YAML_BYTES = 2 << 20, 512 << 10

# The most brackets of YAML inside each other, whose number each word costs. Calibrations have two.
MOST_NESTED = 32

# The first line that OpenCV writes is no directive of YAML.
_OPENCV_DIRECTIVE = re.compile(r"\A%YAML:1\.[0-9]+[^\n]*\n")


def read_json(file: Path, max_bytes: int | None = None) -> Any:
    """Read a JSON document.

    Raises:
        DatasetError: it is larger than `max_bytes`, or not JSON.
    """
    return _parsed(file, "JSON", max_bytes, lambda text: json.loads(text, object_pairs_hook=_without_repetition))


def read_yaml(file: Path) -> Any:
    """Read a YAML document, also one of OpenCV's FileStorage, whose tags are ignored. All scalars are texts.

    Names such as 010 therefore stay what they are.

    Raises:
        DatasetError: it is too large or not YAML.
    """

    def parse(text: str) -> Any:
        depth = 0
        for bracket in re.findall(r"[\[\]{}]", text):
            depth += 1 if bracket in "[{" else -1
            if depth > MOST_NESTED:
                raise ValueError("brackets are nested too deeply")
        return yaml.load(_OPENCV_DIRECTIVE.sub("", text), _TextLoader)  # a BaseLoader makes nothing but texts

    return _parsed(file, "YAML", MAX_YAML_BYTES, parse)


def read_toml(file: Path) -> dict[str, Any]:
    """Read a TOML document.

    Raises:
        DatasetError: it is too large or not TOML.
    """
    document: dict[str, Any] = _parsed(file, "TOML", MAX_BYTES, tomllib.loads)
    return document


def read_xml(file: Path) -> ElementTree.Element:
    """Read an XML document without a document type, whose entities could expand without bound.

    Raises:
        DatasetError: it is too large or not such XML.
    """

    def parse(text: str) -> ElementTree.Element:
        if "<!DOCTYPE" in text or "<!ENTITY" in text:
            raise ValueError("it has a document type")
        return ElementTree.fromstring(text)

    element: ElementTree.Element = _parsed(file, "XML", MAX_BYTES, parse)
    return element


def _parsed(file: Path, kind: str, max_bytes: int | None, parse: Callable[[str], Any]) -> Any:
    if max_bytes is not None and file.stat().st_size > max_bytes:
        raise DatasetError(f"{file}: larger than {max_bytes >> 10} KiB, so it is no calibration; export it anew")
    try:
        with open_text(file) as text:
            return parse(text.read())
    except (ValueError, RecursionError, yaml.YAMLError, ElementTree.ParseError) as error:
        reason = " ".join(str(error).split()) or type(error).__name__
        raise DatasetError(f"{file}: not {kind} ({printable(reason)}); export it anew") from error


def _without_repetition(pairs: list[tuple[str, Any]]) -> dict[str, Any]:
    """Return an object as a dictionary; raise ValueError if a key is there twice."""
    found = dict(pairs)
    if len(found) < len(pairs):
        seen: set[str] = set()
        twice = next(key for key, _ in pairs if key in seen or seen.add(key))  # type: ignore[func-returns-value]
        raise ValueError(f"the key {twice!r} is there twice in one object")
    return found


class _TextLoader(yaml.BaseLoader):
    """Loads YAML as texts, lists and dictionaries, and refuses keys that are there twice.

    It is PyYAML's loader in Python, since that in C overflows the stack where documents are deeply nested.
    """

    def construct_mapping(self, node: yaml.MappingNode, deep: bool = False) -> dict[str, Any]:
        pairs = [
            (self.construct_object(key, deep=True), self.construct_object(value, deep=True))
            for key, value in node.value
        ]
        if not all(isinstance(key, str) for key, _ in pairs):
            raise ValueError("a key is no text")
        return _without_repetition(pairs)
