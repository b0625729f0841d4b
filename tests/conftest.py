"""Fixtures and settings that all tests share."""

import gc
import os
import signal
from collections.abc import Iterator
from typing import TYPE_CHECKING

import pytest

if TYPE_CHECKING:
    from kpc.encoder.datasets import Dataset

# Tests work on tiny arrays, for which threads cost more time in synchronisation than they save.
os.environ.setdefault("OMP_NUM_THREADS", "1")
# Garbage is collected less often: importing the tests, and compiling, make millions of objects that stay.
gc.set_threshold(10_000)


def pytest_collection_finish() -> None:
    """Leave what collection has made, which stays to the end, out of garbage collections: they take seconds of it."""
    gc.freeze()


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
    """Code with little effort, as `quick_coding` says."""
    import quick_coding

    quick_coding.apply(monkeypatch.setattr)


@pytest.fixture
def searched() -> None:
    """Search for symbols of least cost in spite of `rounded`."""


@pytest.fixture
def rounded(monkeypatch: pytest.MonkeyPatch, request: pytest.FixtureRequest) -> None:
    """Round to symbols instead of searching for them, which takes half of the time, where a test has not `searched`."""
    import quick_coding

    if "searched" not in request.fixturenames:
        monkeypatch.setattr("kpc.encoder.rdo.codec_model.quantise_by_cost", quick_coding.rounded)


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
