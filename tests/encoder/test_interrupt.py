"""Ctrl-C while training: the first waits for the end of a step, unless nothing is trained yet; the second does not."""

import os
import signal
from collections.abc import Callable
from pathlib import Path

import pytest

from kpc.encoder.cli import encode_scene
from kpc.encoder.cli.options import Options
from kpc.encoder.cli.work_folder import CHECKPOINT


def test_a_second_ctrl_c_does_not_wait_for_the_end_of_a_step(tmp_path: Path, heeded_signals: None) -> None:
    before = signal.getsignal(signal.SIGINT)

    class Endless:
        """A trainer whose step never ends, so that a noted Ctrl-C is never asked for."""

        step = 0

        def run(self, *_: object, interrupted: Callable[[], bool], **__: object) -> None:
            self.step = 1
            assert not interrupted()
            os.kill(os.getpid(), signal.SIGINT)
            assert interrupted()
            os.kill(os.getpid(), signal.SIGINT)
            raise AssertionError("the step went on")

    options = Options(tmp_path, tmp_path / "a.kpc")
    with pytest.raises(encode_scene.Abandoned):
        encode_scene._train(Endless(), tmp_path / CHECKPOINT, options)  # type: ignore[arg-type]
    assert signal.getsignal(signal.SIGINT) is before


def test_ctrl_c_in_the_first_step_saves_nothing(tmp_path: Path, heeded_signals: None) -> None:
    class Compiling:
        """A trainer whose first step does not end, since kernels are compiled."""

        step = 0

        def run(self, *_: object, **__: object) -> None:
            os.kill(os.getpid(), signal.SIGINT)
            raise AssertionError("the step went on")

    options = Options(tmp_path, tmp_path / "a.kpc")
    with pytest.raises(encode_scene.Abandoned):
        encode_scene._train(Compiling(), tmp_path / CHECKPOINT, options)  # type: ignore[arg-type]
    assert not (tmp_path / CHECKPOINT).exists()
