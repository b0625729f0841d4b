"""The pixel cache: built once, rebuilt when stale or damaged, and read without becoming resident."""

import errno
import json
import os
import shutil
from pathlib import Path

import numpy as np
import pytest

import datasets as make
from datasets import fails, load
from kpc.encoder.datasets import pixel_cache
from kpc.format.common.errors import DatasetError
from kpc.format.common.images import write_image


def cache_file(tmp_path: Path) -> Path:
    (file,) = (tmp_path / "cache").glob("pixels-*.bin")
    return file


def test_the_cache_is_built_once(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    make.write_n3dv(tmp_path / "set")
    load(tmp_path / "set")
    before = cache_file(tmp_path).stat().st_mtime_ns
    load(tmp_path / "set", holdout="none")
    assert cache_file(tmp_path).stat().st_mtime_ns == before
    assert sorted(f.suffix for f in (tmp_path / "cache").iterdir()) == [".bin", ".json"]


def test_a_stale_or_damaged_cache_is_rebuilt(tmp_path: Path) -> None:
    rig = make.write_nerfstudio(tmp_path / "set")
    load(tmp_path / "set")
    file = cache_file(tmp_path)
    good = file.read_bytes()
    for damaged in (good[:-1], good + b"\0", bytes([good[0] ^ 1]) + good[1:], b""):
        file.write_bytes(damaged)
        load(tmp_path / "set")
        assert file.read_bytes() == good
    for text in ("", "{}", "[]", file.with_suffix(".json").read_text().replace("crc32c", "crc")):
        file.with_suffix(".json").write_text(text)
        load(tmp_path / "set")
        assert json.loads(file.with_suffix(".json").read_text())["channels"] == 3
    write_image(tmp_path / "set" / "images" / "0002.png", 255 - make.picture(rig[2]))
    np.testing.assert_array_equal(load(tmp_path / "set").pixels.picture(2), 255 - make.picture(rig[2]))


@pytest.mark.parametrize("mapped_bytes", [1 << 30, 0])
def test_reading_pixels_with_and_without_a_memory_mapping(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, mapped_bytes: int
) -> None:
    monkeypatch.setattr(pixel_cache, "MAPPED_BYTES", mapped_bytes)
    make.write_blender(tmp_path / "set")
    dataset = load(tmp_path / "set")
    p = dataset.pictures
    rng = np.random.default_rng(0)
    picture = rng.integers(len(p), size=500)
    column, row = rng.integers(p.width[picture]), rng.integers(p.height[picture])
    found = dataset.pixels.read(p.offset[picture] + row.astype(np.int64) * p.width[picture] + column)
    expected = np.stack([dataset.pixels.picture(n)[j, i] for n, j, i in zip(picture, row, column, strict=True)])
    np.testing.assert_array_equal(found, expected)


def test_a_large_cache_does_not_become_resident(tmp_path: Path) -> None:
    """Random reads from a sparse file of 3 GB leave none of it resident."""
    file = tmp_path / "pixels.bin"
    with open(file, "wb") as out:
        out.truncate(3_000_000_000)
    tiles = tuple(pixel_cache.Tile(n * 1_000_000, 1000, 1000, 0) for n in range(1000))
    cache = pixel_cache.FlatCache(file, tiles, 3, 3)
    rng = np.random.default_rng(0)
    before = resident_bytes()
    for _ in range(20):
        assert cache.read(rng.integers(10**9, size=8192)).shape == (8192, 3)
    assert resident_bytes() - before < 50e6


def resident_bytes() -> int:
    if not Path("/proc/self/statm").exists():
        pytest.skip("the system does not report resident memory in /proc")
    return int(Path("/proc/self/statm").read_text().split()[1]) * os.sysconf("SC_PAGE_SIZE")


def test_a_cache_truncated_while_it_is_read(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(pixel_cache, "MAPPED_BYTES", 0)
    make.write_blender(tmp_path / "set")
    dataset = load(tmp_path / "set")
    os.truncate(cache_file(tmp_path), 100)
    with pytest.raises(DatasetError, match="shorter than it was"):
        dataset.pixels.read(np.array([0, 3000]))
    with pytest.raises(DatasetError, match="shorter than it was"):
        dataset.pixels.picture(3)


def test_disk_full(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    make.write_nerfstudio(tmp_path / "set", images=3)
    real, written = os.write, []

    def write(fd: int, data: memoryview) -> int:
        if len(written) == 2:
            raise OSError(errno.ENOSPC, "No space left on device")
        written.append(fd)
        return real(fd, data)

    monkeypatch.setattr(pixel_cache.os, "write", write)
    fails(tmp_path / "set", "disk is full", "--downscale")
    assert not list((tmp_path / "cache").iterdir())
    monkeypatch.setattr(pixel_cache.shutil, "disk_usage", lambda path: shutil._ntuple_diskusage(10, 10, 0))
    written.clear()
    fails(tmp_path / "set", "disk is full")


def test_leftovers_of_killed_builds_are_deleted(tmp_path: Path) -> None:
    make.write_nerfstudio(tmp_path / "set", images=3)
    load(tmp_path / "set")
    file = cache_file(tmp_path)
    old, new = (file.with_name(f".{file.stem}.{name}.bin") for name in ("old", "new"))
    for leftover in (old, new):
        leftover.write_bytes(b"x")
    os.utime(old, (0, 0))
    file.unlink()
    load(tmp_path / "set")
    assert not old.exists() and new.exists()


def test_a_cache_directory_that_cannot_be_created(tmp_path: Path) -> None:
    make.write_nerfstudio(tmp_path / "set", images=3)
    (tmp_path / "cache").write_text("a file")
    with pytest.raises(OSError) as caught:  # cli.run prints it as one line
        load(tmp_path / "set")
    assert caught.value.filename is not None
