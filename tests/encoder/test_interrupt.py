"""Ctrl-C while training: the first waits for the end of a step, the second does not."""

import os
import signal
from collections.abc import Callable
from pathlib import Path

import pytest

from kpc.encoder.cli import encode_scene
from kpc.encoder.cli.work_folder import CHECKPOINT


def test_a_second_ctrl_c_does_not_wait_for_the_end_of_a_step(tmp_path: Path) -> None:
    before = signal.getsignal(signal.SIGINT)

    class Endless:
        """A trainer whose step never ends, so that a noted Ctrl-C is never asked for."""

        def run(self, *_: object, interrupted: Callable[[], bool], **__: object) -> None:
            assert not interrupted()
            os.kill(os.getpid(), signal.SIGINT)
            assert interrupted()
            os.kill(os.getpid(), signal.SIGINT)
            raise AssertionError("the step went on")

    with pytest.raises(encode_scene.Abandoned):
        encode_scene._train(Endless(), tmp_path / CHECKPOINT, None)  # type: ignore[arg-type]
    assert signal.getsignal(signal.SIGINT) is before
