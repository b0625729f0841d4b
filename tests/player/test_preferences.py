import json
import os
import subprocess
import sys
from pathlib import Path

import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from kpc.player.app.preferences import _IS_VALID, MAX_BYTES, Preferences, load, preferences_path, save

MINE = Preferences((800, 600), "fine", 30.0, False, True, True, 1.5, ("a.kpc", "b.kpc"))


def test_what_is_saved_is_loaded(tmp_path: Path) -> None:
    path = tmp_path / "new" / "player.json"
    for preferences in (Preferences(), MINE):
        save(preferences, path)
        assert load(path) == preferences and [p.name for p in path.parent.iterdir()] == ["player.json"]


def test_every_field_is_checked() -> None:
    assert set(_IS_VALID) == set(Preferences.__dataclass_fields__)


@pytest.mark.parametrize(("name", "values"), {
    "size": [[1, 1], [1e9, 5], "big", [800], [800.5, 600], [True, True], None],
    "quality": ["perfect", 3, [], None],
    "target_fps": [0, -1, 1e9, "fast", True, float("nan"), float("inf"), [30]],
    "graphs": [1, "yes", None],
    "text_size": [0, 99, float("nan"), "x"],
    "recent": ["a.kpc", [3], [""], 99 * ["a.kpc"], None],
}.items())  # fmt: skip
def test_an_invalid_value_is_replaced_by_its_default(tmp_path: Path, name: str, values: list[object]) -> None:
    path = tmp_path / "player.json"
    save(MINE, path)
    for value in values:
        path.write_text(json.dumps({**json.loads(path.read_text()), name: value}))
        got = load(path)
        assert getattr(got, name) == getattr(Preferences(), name)
        assert got.planes  # the others stay


@pytest.mark.parametrize(
    "content", [b"", b"\xff\xfe", b"[]", b"null", b"[" * 60_000, b'{"a": 1}', b" " * (2 * MAX_BYTES)]
)
def test_other_files_give_the_defaults(tmp_path: Path, content: bytes) -> None:
    (tmp_path / "player.json").write_bytes(content)
    assert load(tmp_path / "player.json") == Preferences()


@settings(max_examples=30, deadline=None, suppress_health_check=[HealthCheck.function_scoped_fixture])
@given(
    st.dictionaries(
        st.sampled_from(sorted(_IS_VALID)),
        st.recursive(
            st.none() | st.booleans() | st.floats() | st.integers() | st.text(max_size=8),
            lambda inner: st.lists(inner, max_size=3),
        ),
    )
)
def test_any_content_is_accepted(tmp_path: Path, found: dict[str, object]) -> None:
    (tmp_path / "player.json").write_text(json.dumps(found))
    got = load(tmp_path / "player.json")
    assert {name: getattr(got, name) for name in _IS_VALID if name not in found} == {
        name: getattr(Preferences(), name) for name in _IS_VALID if name not in found
    }


def test_a_missing_file_a_folder_and_a_pipe_give_the_defaults(tmp_path: Path) -> None:
    os.mkfifo(tmp_path / "pipe")
    for path in (tmp_path / "none.json", tmp_path, tmp_path / "pipe"):
        assert load(path) == Preferences()


def test_the_file_is_in_the_platforms_settings_folder(tmp_path: Path) -> None:
    """In a process of its own: the platform is asked once."""
    program = "from kpc.player.app.preferences import preferences_path; print(preferences_path())"
    env = {**os.environ, "XDG_CONFIG_HOME": str(tmp_path), "APPDATA": str(tmp_path), "HOME": str(tmp_path)}
    found = subprocess.run([sys.executable, "-c", program], capture_output=True, text=True, env=env, check=True).stdout
    assert found.startswith(str(tmp_path)) and found.strip().endswith(os.path.join("kpc", "player.json"))
    assert preferences_path().is_absolute()
