from pathlib import Path

import pytest

from kpc.format.common.errors import UsageError
from kpc.player.app.playlist import MAX_RECENT, Playlist


def test_a_folder_stands_for_its_files(tmp_path: Path) -> None:
    for name in ("b.kpc", "a.KPC", "notes.txt"):
        (tmp_path / name).touch()
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
