"""The conformance vectors in headless Chromium (player/web/tests/vectors_page.ts), bit by bit."""

import json
from pathlib import Path
from typing import Any

import pytest

from kpc.tools.bench import web_page

VECTORS = Path(__file__).parent.parent.parent / "spec" / "vectors"
MANIFEST = json.loads((VECTORS / "manifest.json").read_text())
# What the entry of a file says beside what it holds.
ABOUT = ("sha256", "partial", "zstd", "rays")


def plain(value: Any) -> Any:
    """Return JSON with all numbers as float64, the only numbers of JavaScript."""
    return json.loads(json.dumps(value), parse_int=float)


@pytest.fixture(scope="module")
def found(tmp_path_factory: pytest.TempPathFactory) -> dict[str, Any]:
    """Return what the page says of each vector, by kind and name."""
    reason = web_page.missing()
    if reason is not None:
        pytest.skip(reason)
    partial = {
        f"{kind}-{name}": entry.get("partial", False) for kind in MANIFEST for name, entry in MANIFEST[kind].items()
    }
    files = {name: (VECTORS / name.replace("-", "/", 1)).with_suffix(".kpc").read_bytes() for name in partial}
    calls = [("describe", [name, is_partial]) for name, is_partial in partial.items()]
    folder = tmp_path_factory.mktemp("vectors")
    results = web_page.run(folder, files, calls, script="tests/vectors_page.ts")
    return dict(zip(partial, results, strict=True))


def test_valid_vectors_are_decoded_to_the_same_numbers(found: dict[str, Any]) -> None:
    for name, entry in MANIFEST["valid"].items():
        scenes = [group["scene"] for group in entry.get("groups", [{"scene": name}])]
        for scene, held in zip(scenes, found[f"valid-{name}"], strict=True):
            expected = MANIFEST["valid"][scene] if scene else None
            wanted = expected and {key: value for key, value in expected.items() if key not in ABOUT}
            assert plain(held) == plain(wanted), name


def test_invalid_vectors_are_refused_with_the_same_words(found: dict[str, Any]) -> None:
    for name, entry in MANIFEST["invalid"].items():
        said = found[f"invalid-{name}"]
        assert said["error"] == entry["error"] and entry["message"] in said["message"], name
