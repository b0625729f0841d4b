"""The work folder belongs to one encode at a time."""

import errno
from collections.abc import Callable
from pathlib import Path

import pytest
from filelock import FileLock

import datasets as make
from kpc.encoder.cli import kpenc
from kpc.encoder.cli.options import Options
from kpc.encoder.cli.work_folder import LOCK, locked
from kpc.format.common.errors import DatasetError, TrainingError


@pytest.mark.parametrize("command", [kpenc.encode, kpenc.dry_run])
def test_another_run_is_kept_out(tmp_path: Path, command: Callable[[Options], object]) -> None:
    """It would remove what this one keeps there, or this one what it does."""
    options = Options(tmp_path / "dataset", tmp_path / "out.kpc")
    with locked(options.work_dir):
        (options.work_dir / "mine").write_bytes(b"")
        with pytest.raises(TrainingError, match=r"out.kpc.work: another kpenc is at work there; .*--work"):
            command(options)
        assert {path.name for path in options.work_dir.iterdir()} == {LOCK, "mine"}
    with pytest.raises(DatasetError, match="dataset: no such directory"):
        command(options)
    assert [path.name for path in options.work_dir.iterdir()] == ["mine"]


@pytest.mark.parametrize("option", ["work", "cache"])
def test_folders_without_permission(tmp_path: Path, option: str, monkeypatch: pytest.MonkeyPatch) -> None:
    acquire = FileLock.acquire

    def refuse(self: FileLock, **options: float) -> object:
        if Path(self.lock_file).parent.name == option:
            raise PermissionError(errno.EACCES, "Permission denied", self.lock_file)
        return acquire(self, **options)

    monkeypatch.setattr(FileLock, "acquire", refuse)
    make.write_n3dv(tmp_path / "dataset")
    options = Options(tmp_path / "dataset", tmp_path / "out.kpc", **{option: tmp_path / option})
    with pytest.raises((TrainingError, DatasetError), match=f"{option}.*: no permission to write there; .*--{option}"):
        kpenc.encode(options)
