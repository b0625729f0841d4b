"""Fixtures and settings that all tests share."""

import math
import os
import signal
from collections.abc import Iterator
from typing import TYPE_CHECKING

import pytest

if TYPE_CHECKING:
    from kpc.encoder.datasets import Dataset

# Tests work on tiny arrays, for which threads cost more time in synchronisation than they save.
os.environ.setdefault("OMP_NUM_THREADS", "1")


@pytest.fixture
def one_thread():
    """Run the fused kernels on one thread."""
    import numba

    before = numba.get_num_threads()
    numba.set_num_threads(1)
    yield
    numba.set_num_threads(before)


@pytest.fixture
def quick_coding(monkeypatch: pytest.MonkeyPatch) -> None:
    """Code with little effort, which suffices for tiny scenes: few rays, modes, passes, steps and views are tried."""
    for constant, value in {
        "evaluation.validation_rays.VALIDATION_RAYS": 512,
        "rdo.curvature.RAYS": 1 << 13,
        "rdo.codec_model.BLOCK_SIDES": (8,),
        "rdo.codec_model.TOLERANCE": 0.05,
        "rdo.dct_rdo.PASSES": 2,
        "rdo.rate_search.MAX_ATTEMPTS": 6,
        "rdo.trellis.PASSES": 2,
    }.items():
        monkeypatch.setattr(f"kpc.encoder.{constant}", value)
    monkeypatch.setattr("kpc.format.scene.view_limits.STEP", math.radians(20))


@pytest.fixture
def heeded_signals() -> Iterator[None]:
    """Restore the default of Ctrl-C, which the parent of these tests may ignore: kpenc leaves ignored signals alone."""
    before = signal.signal(signal.SIGINT, signal.default_int_handler)
    yield
    signal.signal(signal.SIGINT, before)


@pytest.fixture(scope="session")
def moving(tmp_path_factory: pytest.TempPathFactory) -> "Dataset":
    """Return a monocular dataset of a moving object with alpha."""
    import datasets as make
    from kpc.encoder.datasets import load_dataset

    folder = tmp_path_factory.mktemp("moving")
    make.write_blender(folder / "set")
    return load_dataset(folder / "set", folder / "cache", progress=False)
