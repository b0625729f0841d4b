"""What tasks of a machine share is there while one uses it, and goes when none has for a while."""

import os
from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest

from kpc.tools.batch import working
from kpc.tools.batch.scratch import KEPT_S, Scratch, TaskError
from kpc.tools.batch.tasks import ENCODE, Task
from kpc.tools.batch.working import Place


@pytest.fixture
def take(tmp_path: Path) -> str:
    (tmp_path / "take").mkdir()
    (tmp_path / "take" / "cam00.mp4").write_bytes(b"one")
    return str(tmp_path / "take")


def test_decoded_pixels_stay_while_a_task_uses_them_and_a_while_longer(tmp_path: Path, take: str) -> None:
    scratch = Scratch(str(tmp_path))
    with scratch.task_folder("one") as one:
        pixels = scratch.pixels(take, one)
        (pixels / "block").write_bytes(b"1")
        scratch.tidy(kept_s=0)
        assert scratch.pixels(take, one) == pixels and (pixels / "block").exists()
    assert not one.exists()
    scratch.tidy()
    assert (pixels / "block").exists()
    before = pixels.stat().st_mtime - KEPT_S - 1
    os.utime(pixels, (before, before))
    scratch.tidy()
    assert not pixels.exists()


def test_folders_of_killed_tasks_go_with_what_they_used(tmp_path: Path, take: str) -> None:
    scratch = Scratch(str(tmp_path))
    with scratch.task_folder("one") as one:
        pixels = scratch.pixels(take, one)
        gone = one.rename(one.with_name("task-99999999-one"))  # no process has this number
    scratch.tidy(kept_s=0)
    assert not gone.exists() and not pixels.exists()


def test_a_source_that_is_not_there_is_one_line(tmp_path: Path) -> None:
    scratch = Scratch(str(tmp_path))
    with scratch.task_folder("one") as one, pytest.raises(TaskError, match="share that folder, or name it by an"):
        scratch.source(str(tmp_path / "missing"), one)


@pytest.mark.parametrize(
    "more, is_kept", [({"shares_source": True}, True), ({}, False), ({"words": ("--cache=own",)}, False)]
)
def test_pixels_are_kept_for_others_where_there_are_any(
    tmp_path: Path, take: str, monkeypatch: pytest.MonkeyPatch, more: dict[str, Any], is_kept: bool
) -> None:
    commands: list[list[str]] = []
    monkeypatch.setattr(working, "_child", lambda command, *_: commands.append(command) or {})
    task = replace(Task("key", "take", "take", ENCODE, take), **more)
    outcome = working.run(task, Place(str(tmp_path / "out"), str(tmp_path)))
    assert outcome.is_done, outcome.error
    kept = [word for word in commands[0] if word.startswith(f"--cache={tmp_path}/kpbatch/pixels/")]
    assert len(kept) == is_kept
