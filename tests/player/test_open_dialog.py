"""The dialog is a program of the system, whose output is the path of the file."""

import os
import time
from pathlib import Path

import pytest

from kpc.format.common.errors import DisplayError
from kpc.player.app.open_dialog import OpenDialog, dialog_command


def program(folder: Path, name: str, script: str) -> None:
    (folder / name).write_text(f"#!/bin/sh\n{script}\n")
    (folder / name).chmod(0o755)


def chosen_in(dialog: OpenDialog) -> str | None:
    until = time.monotonic() + 20
    while (chosen := dialog.take_chosen()) is None and dialog.is_open and time.monotonic() < until:
        time.sleep(0.01)
    return chosen


@pytest.fixture
def programs(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    monkeypatch.setattr("sys.platform", "linux")
    monkeypatch.setenv("PATH", f"{tmp_path}")
    return tmp_path


def test_nothing_shows_dialogs(programs: Path) -> None:
    with pytest.raises(DisplayError, match="install zenity or kdialog"):
        OpenDialog().show("/")


@pytest.mark.parametrize("name", ["zenity", "kdialog"])
def test_the_path_is_what_the_program_prints(programs: Path, name: str) -> None:
    program(programs, name, r'for word; do case "$word" in /clips*|--filename=*) echo "$word/a ü.kpc";; esac; done')
    dialog = OpenDialog()
    dialog.show("/clips")
    assert dialog.is_open
    begins = {"zenity": "--filename=/clips/", "kdialog": "/clips"}
    assert chosen_in(dialog) == f"{begins[name]}/a ü.kpc" and not dialog.is_open


def test_a_dialog_that_is_left_gives_nothing(programs: Path) -> None:
    program(programs, "zenity", "exit 1")
    dialog = OpenDialog()
    dialog.show("/")
    assert chosen_in(dialog) is None and not dialog.is_open


def test_names_may_be_any_bytes(programs: Path) -> None:
    program(programs, "zenity", r"printf '/\377.kpc\n'")
    dialog = OpenDialog()
    dialog.show("/")
    assert chosen_in(dialog) == os.fsdecode(b"/\xff.kpc")


def test_other_systems_have_their_own() -> None:
    assert dialog_command("darwin", "/clips")[0] == "osascript" and dialog_command("darwin", "/clips")[-1] == "/clips"
    assert dialog_command("win32", "C:\\clips")[0] == "powershell"
