import contextlib
from pathlib import Path
from types import SimpleNamespace

import pytest

from kpc.format.common.errors import UsageError
from kpc.player.app import kpplay
from kpc.player.app.actions import Actions
from kpc.player.app.playlist import MAX_RECENT, NAME_CHARACTERS, Playlist, menu_names


def test_a_folder_stands_for_its_files(tmp_path: Path) -> None:
    for name in ("b.kpc", "a.KPC", "notes.txt", "._a.kpc"):
        (tmp_path / name).touch()
    (tmp_path / "folder.kpc").mkdir()
    playlist = Playlist.named(["x.kpc", str(tmp_path), "https://host/y.kpc"])
    first, last = str(tmp_path / "a.KPC"), str(tmp_path / "b.kpc")
    assert playlist.files == ["x.kpc", first, last, "https://host/y.kpc"]
    assert [playlist.step(1), playlist.step(1), playlist.step(-3)] == [first, last, "https://host/y.kpc"]
    (tmp_path / "empty").mkdir()
    with pytest.raises(UsageError, match="has no"):
        Playlist.named([str(tmp_path / "empty")])


def test_what_is_opened_follows_the_present_file_and_is_remembered() -> None:
    playlist = Playlist(["a.kpc", "b.kpc"], ["old.kpc"])
    for file in ("a.kpc", "c.kpc", "b.kpc", "a.kpc"):
        playlist.opened(file, f"/home/{file}")
    assert playlist.files == ["a.kpc", "c.kpc", "b.kpc"] and playlist.position == 0
    assert playlist.recent == ("/home/a.kpc", "/home/b.kpc", "/home/c.kpc", "old.kpc")
    for number in range(20):
        playlist.opened(f"{number}.kpc", f"{number}.kpc")
    assert len(playlist.recent) == MAX_RECENT and playlist.recent[0] == "19.kpc"


def test_a_file_is_the_same_by_its_relative_and_its_absolute_path(
    monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    monkeypatch.chdir(tmp_path)
    playlist = Playlist(["a.kpc", "b.kpc"])
    playlist.opened(str(tmp_path / "b.kpc"), "b")
    assert playlist.files == ["a.kpc", "b.kpc"] and playlist.position == 1


def test_what_is_dropped_is_opened_or_follows_in_the_playlist(tmp_path: Path) -> None:
    for name in ("takes/1.kpc", "takes/2.kpc"):
        (tmp_path / name).parent.mkdir(exist_ok=True)
        (tmp_path / name).touch()
    takes, one, two = (str(tmp_path / name) for name in ("takes", "takes/1.kpc", "takes/2.kpc"))
    for dropped, opened, files in (
        (["x.kpc"], ["x.kpc"], ["a.kpc", "b.kpc"]),
        (["x.kpc", "b.kpc", "path.json", "y.kpc"], ["path.json", "x.kpc"], ["a.kpc", "x.kpc", "y.kpc", "b.kpc"]),
        ([takes], [one], ["a.kpc", one, two, "b.kpc"]),
        ([], [], ["a.kpc", "b.kpc"]),
    ):
        found: list[str] = []
        state = SimpleNamespace(reporting_errors=lambda subject: contextlib.nullcontext(), notify=lambda text: None)
        actions = SimpleNamespace(asks=False, open=found.append, playlist=Playlist(["a.kpc", "b.kpc"]), state=state)
        Actions.drop(actions, dropped)  # type: ignore[arg-type]
        assert (found, actions.playlist.files) == (opened, files)


def test_a_menu_tells_files_apart() -> None:
    long = "a_take_" * 20
    files = ["one/scene.kpc", "two/scene.kpc", "other.kpc", "other.kpc", f"{long}01.kpc", f"{long}02.kpc"]
    names = menu_names([*files, "https://me:secret@host/x.kpc?token=secret"])
    assert names[:4] == ["one/scene.kpc", "two/scene.kpc", "other.kpc", "other.kpc"]
    assert names[4].endswith("01.kpc") and names[5].endswith("02.kpc") and names[6] == "x.kpc"
    assert max(map(len, names)) == NAME_CHARACTERS


def test_the_window_is_named_by_title_and_file() -> None:
    playlist = Playlist(["a.kpc", "takes/a.kpc", "b.kpc"])
    playlist.step(1)
    assert kpplay._title("Vase", playlist) == "Vase (takes/a.kpc) - kpplay"
    playlist.step(1)
    assert kpplay._title("", playlist) == "b.kpc - kpplay"
