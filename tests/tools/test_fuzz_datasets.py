"""Damaged datasets are read or refused in printable lines, and no file of theirs goes unmentioned."""

import random
import signal
import time
from pathlib import Path

import pytest

from kpc.tools.dev import fuzz_datasets as fuzz


@pytest.fixture(scope="module")
def starts() -> list[fuzz.Files]:
    return fuzz.seeds()


def test_every_seed_is_read(starts: list[fuzz.Files], tmp_path: Path) -> None:
    for number, files in enumerate(starts):
        fuzz.write(files, tmp_path / str(number))
        assert fuzz.examined(tmp_path / str(number), tmp_path / "cache") == "read"


def test_damaged_datasets_are_read_or_refused() -> None:
    outcomes, findings = fuzz.run(200, seed=7)
    assert findings == []
    assert outcomes["read"] > 25 and outcomes["DatasetError"] > 25


def test_a_number_is_always_the_same_dataset(starts: list[fuzz.Files]) -> None:
    some = [fuzz.number(1, n, starts) for n in range(20)]
    assert some == [fuzz.number(1, n, starts) for n in range(20)]
    assert sum(files not in starts for files in some) > 15


def test_findings_are_reported_and_kept(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    def load(*_: object, **__: object) -> None:
        raise ZeroDivisionError

    monkeypatch.setattr(fuzz, "load_dataset", load)
    assert fuzz.main(["--count", "1", "--seed", "5", "-o", str(tmp_path / "found")]) == 1
    assert "dataset 0: ZeroDivisionError" in capsys.readouterr().err
    kept = {str(f.relative_to(tmp_path / "found" / "5-0")) for f in (tmp_path / "found").rglob("*") if f.is_file()}
    assert kept == set(fuzz.number(5, 0, fuzz.seeds()))


@pytest.mark.skipif(not hasattr(signal, "setitimer"), reason="this system has no timer of processor time")
def test_a_hang_is_a_finding(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    def load(*_: object, **__: object) -> None:
        until = time.monotonic() + 60
        while time.monotonic() < until:
            random.random()

    monkeypatch.setattr(fuzz, "load_dataset", load)
    monkeypatch.setattr(fuzz, "HANG_S", 0.01)
    with pytest.raises(fuzz.Hang):
        fuzz.examined(tmp_path, tmp_path)


def test_a_file_that_goes_unmentioned_is_a_finding(
    starts: list[fuzz.Files], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    fuzz.write(starts[0], tmp_path / "set")
    monkeypatch.setattr(fuzz, "media_in", lambda folder: [folder] * (fuzz.CAMERAS + 1))
    with pytest.raises(AssertionError, match="5 trained on or held out and 0 left out of 6 found"):
        fuzz.examined(tmp_path / "set", tmp_path / "cache")
