"""Fixtures that tests of commands share."""

from collections.abc import Callable
from pathlib import Path

import pytest

from kpc.encoder.coding.scene_writer import write
from kpc.format.coding.quantise import quantise_scene
from kpc.tools.cli import kprender
from scenes import tiny_scene


@pytest.fixture(scope="module")
def scene_file(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Return a clip of 11 frames at 10 frames per second."""
    path = tmp_path_factory.mktemp("scene") / "tiny.kpc"
    scene = tiny_scene(4)
    write(quantise_scene(scene, [dict.fromkeys(scale, 0.01) for scale in scene.scales]), path)
    return path


@pytest.fixture
def run(capsys: pytest.CaptureFixture[str]) -> Callable[..., tuple[int, str, str]]:
    """Return a function that runs kprender and returns its exit code, output and messages."""

    def call(*arguments: object) -> tuple[int, str, str]:
        try:
            code = kprender.main([str(a) for a in arguments])
        except SystemExit as error:  # argparse
            code = int(error.code or 0)
        output = capsys.readouterr()
        return code, output.out, output.err

    return call
