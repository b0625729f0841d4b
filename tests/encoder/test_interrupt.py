"""Ctrl-C while loading ends at once; while training, the first waits for the end of a step, the second does not."""

import builtins
import os
import signal
from collections.abc import Callable
from pathlib import Path

import pytest

import kpc.encoder
from kpc.encoder.cli import encode_scene
from kpc.encoder.cli.options import Options
from kpc.encoder.cli.work_folder import CHECKPOINT


def test_ctrl_c_while_loading_ends_in_one_line(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    def interrupted(*_: object, **__: object) -> None:
        raise KeyboardInterrupt

    monkeypatch.setattr(builtins, "__import__", interrupted)
    code = kpc.encoder.main(["set"])
    monkeypatch.undo()
    assert code == 130
    assert capsys.readouterr() == ("", "kpenc: interrupted\n")


def test_a_second_ctrl_c_does_not_wait_for_the_end_of_a_step(tmp_path: Path, heeded_signals: None) -> None:
    before = signal.getsignal(signal.SIGINT)

    class Endless:
        """A trainer whose step never ends, so that a noted Ctrl-C is never asked for."""

        def run(self, *_: object, interrupted: Callable[[], bool], **__: object) -> None:
            assert not interrupted()
            os.kill(os.getpid(), signal.SIGINT)
            assert interrupted()
            os.kill(os.getpid(), signal.SIGINT)
            raise AssertionError("the step went on")

    options = Options(tmp_path, tmp_path / "a.kpc")
    with pytest.raises(encode_scene.Abandoned):
        encode_scene._train(Endless(), tmp_path / CHECKPOINT, options)  # type: ignore[arg-type]
    assert signal.getsignal(signal.SIGINT) is before
