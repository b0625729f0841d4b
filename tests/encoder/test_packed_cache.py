"""The packed cache: exact, read at random in little memory, built part by part, checked, and shared by processes."""

import json
import os
import shutil
import subprocess
import sys
import threading
import tracemalloc
from collections.abc import Callable, Iterator
from pathlib import Path

import numpy as np
import pytest

import datasets as make
from datasets import load
from kpc.encoder.cli.work_folder import clear_work_folder
from kpc.encoder.datasets import PixelCache, cache_lock, decoded_pictures, packed_cache, pixel_cache
from kpc.encoder.datasets.packed_cache import Part, Run, build_packed, open_packed
from kpc.format.common.errors import DatasetError
from kpc.format.common.images import write_image


def filmed(frames: int, width: int = 70, height: int = 45, channels: int = 3, noise: int = 0) -> list[np.ndarray]:
    """Return pictures of a square that moves before a still, textured background, with or without noise."""
    rng = np.random.default_rng(width)
    background = rng.integers(256, size=(height, width, channels), dtype=np.uint8)
    found = []
    for k in range(frames):
        picture = background.copy()
        picture[10:20, 3 * k : 3 * k + 9] = rng.integers(256, size=channels)
        found.append(picture + rng.integers(noise + 1, size=picture.shape, dtype=np.uint8))
    return found


def moving(frames: int, width: int = 33, height: int = 17) -> list[np.ndarray]:
    rng = np.random.default_rng(0)
    return [rng.integers(256, size=(height, width, 3), dtype=np.uint8) for _ in range(frames)]


RIGS = {
    "still": [filmed(9), filmed(9, noise=3)],
    "alpha": [filmed(5, channels=4), filmed(5)],
    "opaque": [[np.insert(picture, 3, 255, axis=2) for picture in filmed(5)]],
    "sizes": [filmed(9), filmed(3, width=16, height=32), filmed(2, width=1, height=50)],
    "moving": [moving(6), moving(5, width=48)],
    "one frame": [filmed(1), filmed(1, width=40)],
}


def parts_of(cameras: list[list[np.ndarray]], decode: Callable[[np.ndarray], np.ndarray] = lambda p: p) -> list[Part]:
    """Return a part for each camera, whose pictures are numbered frame by frame: camera 0, camera 1, camera 0 ..."""
    order = sorted((frame, camera) for camera, pictures in enumerate(cameras) for frame in range(len(pictures)))
    parts = []
    for camera, pictures in enumerate(cameras):
        numbers = tuple(n for n, (_, c) in enumerate(order) if c == camera)

        def pictures_of(pictures: list[np.ndarray] = pictures) -> Iterator[np.ndarray]:
            yield from map(decode, pictures)

        parts.append(Part(f"camera {camera}", (Run(numbers, pictures_of),)))
    return parts


def build(folder: Path, cameras: list[list[np.ndarray]], parts: list[Part] | None = None) -> PixelCache:
    channels = max(picture.shape[2] for pictures in cameras for picture in pictures)
    size = sum(picture.nbytes for pictures in cameras for picture in pictures)
    return build_packed(folder, parts or parts_of(cameras), channels, size, lambda count: None)


def assert_exact(cache: PixelCache, cameras: list[list[np.ndarray]], folder: Path) -> None:
    """Compare with a flat cache of the same pictures: all of them, parts of them, and pixels at random."""
    order = [p for _, _, p in sorted((k, c, p) for c, some in enumerate(cameras) for k, p in enumerate(some))]
    channels = max(picture.shape[2] for picture in order)
    flat = pixel_cache.build_cache(folder / "flat.bin", "", order, channels, 0)
    assert cache.tiles == flat.tiles and cache.channels == flat.channels
    rng = np.random.default_rng(0)
    for n, tile in enumerate(flat.tiles):
        top, bottom = sorted(rng.integers(tile.height + 1, size=2).tolist())
        np.testing.assert_array_equal(cache.picture(n), flat.picture(n))
        np.testing.assert_array_equal(cache.picture(n, top, bottom), flat.picture(n, top, bottom))
    chosen = rng.permutation(len(order))[: len(order) // 2 + 1]
    pixels = rng.integers(sum(tile.width * tile.height for tile in flat.tiles), size=2000)
    for some, expected in ((cache, flat), (cache.subset(chosen), flat.subset(chosen))):
        np.testing.assert_array_equal(some.read(pixels), expected.read(pixels))
        np.testing.assert_array_equal(some.picture(0), expected.picture(0))
        assert some.tiles == expected.tiles
    assert cache.read(pixels[:0]).shape == (0, flat.channels)


@pytest.fixture(autouse=True)
def small_groups(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(packed_cache, "MOST", 4)
    monkeypatch.setattr(packed_cache, "FEWEST", 1)


@pytest.mark.parametrize("rig", RIGS)
def test_pictures_come_back_exactly(tmp_path: Path, rig: str) -> None:
    assert_exact(build(tmp_path / "cache", RIGS[rig]), RIGS[rig], tmp_path)
    opened = open_packed(tmp_path / "cache", parts_of(RIGS[rig]), 4 if rig in ("alpha", "opaque") else 3)
    assert opened is not None
    assert_exact(opened, RIGS[rig], tmp_path)


def test_what_is_still_is_stored_once(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(packed_cache, "MOST", 64)
    cameras = [filmed(16, width=320, height=240)]
    cache = build(tmp_path / "cache", cameras)
    background, picture_bytes = cameras[0][0].nbytes, 6 * packed_cache.block_bytes(3) + 400  # 400: positions of blocks
    assert cache.disk_bytes < background + 16 * (picture_bytes + 4 * 300)
    assert "compressed to" in cache.describe()
    still = [[cameras[0][0]] * 16]
    shutil.rmtree(tmp_path / "cache")
    assert build(tmp_path / "cache", still).disk_bytes < background + 16 * 4 * 302


def test_memory_does_not_grow_with_the_cache(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Building holds a group of pictures a worker, and reading holds the blocks of the pixels that it returns."""
    monkeypatch.setattr(os, "cpu_count", lambda: 1)
    cameras = [moving(100, width=160, height=160)]
    raw, group = sum(picture.nbytes for picture in cameras[0]), 4 * cameras[0][0].nbytes
    tracemalloc.start()
    try:
        cache = build(tmp_path / "cache", cameras)
        assert tracemalloc.get_traced_memory()[1] < 6 * group < raw / 4
        tracemalloc.reset_peak()
        before = tracemalloc.get_traced_memory()[0]
        for seed in range(20):
            cache.read(np.random.default_rng(seed).integers(raw // 3, size=200))
        assert tracemalloc.get_traced_memory()[0] - before < 100_000
        assert tracemalloc.get_traced_memory()[1] - before < 200 * 4 * packed_cache.block_bytes(3) < raw / 10
    finally:
        tracemalloc.stop()


@pytest.mark.parametrize("decoded", [0, 3, 5, 7, 14])
def test_an_interrupted_build_goes_on(tmp_path: Path, monkeypatch: pytest.MonkeyPatch, decoded: int) -> None:
    monkeypatch.setattr(os, "cpu_count", lambda: 1)
    cameras = [filmed(5, width=20 + k) for k in range(3)]
    seen: list[int] = []

    def decode(picture: np.ndarray) -> np.ndarray:
        if len(seen) == decoded:
            raise KeyboardInterrupt
        seen.append(0)
        return picture

    with pytest.raises(KeyboardInterrupt):
        build(tmp_path / "cache", cameras, parts_of(cameras, decode))
    assert not list((tmp_path / "cache").glob(".*"))
    (tmp_path / "cache" / ".0001.killed.bin").touch()
    again: list[int] = []
    parts = parts_of(cameras, lambda picture: again.append(0) or picture)  # type: ignore[func-returns-value]
    cache = build(tmp_path / "cache", cameras, parts)
    assert len(again) == 15 - decoded // 5 * 5
    assert sorted(p.name for p in (tmp_path / "cache").iterdir()) == sorted(
        f"{n:04d}.{suffix}" for n in range(3) for suffix in ("bin", "json")
    )
    assert_exact(cache, cameras, tmp_path)


def test_an_error_of_one_part_ends_the_build(tmp_path: Path) -> None:
    cameras = [filmed(5, width=20 + k) for k in range(3)]

    def decode(picture: np.ndarray) -> np.ndarray:
        if picture.shape[1] == 21:
            raise DatasetError("it cannot be decoded")
        return picture

    with pytest.raises(DatasetError, match="cannot be decoded"):
        build(tmp_path / "cache", cameras, parts_of(cameras, decode))
    assert not list((tmp_path / "cache").glob(".*")) and not (tmp_path / "cache" / "0001.bin").exists()


def test_damaged_and_foreign_parts_are_rebuilt(tmp_path: Path) -> None:
    cameras, folder = [filmed(4), filmed(4, width=30)], tmp_path / "cache"
    build(folder, cameras)
    file, description = folder / "0001.bin", folder / "0001.json"
    data, text, other = file.read_bytes(), description.read_text(), (folder / "0000.bin").stat().st_mtime_ns
    flipped = [data[:k] + bytes([data[k] ^ 4]) + data[k + 1 :] for k in (0, len(data) // 2, len(data) - 1)]
    numbers = json.loads(text)
    numbers["pictures"][0][0] += 1
    damages = [(file, damaged) for damaged in (*flipped, data[:-1], data + b"\0", b"")]
    texts = ["", "[]", "{}", text.replace("camera 1", "camera 2"), json.dumps(numbers)]
    for path, damaged in (*damages, *((description, text.encode()) for text in texts)):
        path.write_bytes(damaged)
        assert open_packed(folder, parts_of(cameras), 3) is None
        build(folder, cameras)
        assert file.read_bytes() == data and description.read_text() == text
    for path in (file, description):
        path.unlink()
        assert_exact(build(folder, cameras), cameras, tmp_path)
    assert (folder / "0000.bin").stat().st_mtime_ns == other


def test_damage_while_the_cache_is_read(tmp_path: Path) -> None:
    cameras, folder = [filmed(4, noise=3)], tmp_path / "cache"
    cache = build(folder, cameras)
    pixels = np.arange(4 * 45 * 70)
    with open(folder / "0000.bin", "r+b") as file:
        file.seek(cameras[0][0].nbytes)
        file.write(b"\xff" * 5000)
    for read in (lambda: cache.read(pixels), lambda: cache.picture(0)):
        with pytest.raises(DatasetError, match="damaged; delete it"):
            read()
    os.truncate(folder / "0000.bin", 10)
    for read in (lambda: cache.read(pixels), lambda: cache.picture(0)):
        with pytest.raises(DatasetError, match="damaged; delete it"):
            read()


def test_a_disk_that_is_full(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(pixel_cache.shutil, "disk_usage", lambda path: shutil._ntuple_diskusage(10, 10, 0))
    with pytest.raises(DatasetError, match=r"disk is full.*--cache"):
        build(tmp_path / "cache", RIGS["still"])


def test_videos_and_their_changes(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """A rig is packed if it is too large to be mapped; only videos that change are decoded again."""
    make.write_n3dv(tmp_path / "set", cameras=2, frames=8)
    flat = load(tmp_path / "set", holdout="none")
    monkeypatch.setattr(pixel_cache, "MAPPED_BYTES", 0)
    packed = load(tmp_path / "set", holdout="none")
    (folder,) = (path for path in (tmp_path / "cache").iterdir() if path.is_dir())
    assert packed.pixels.path == folder and packed.pixels.tiles == flat.pixels.tiles
    pixels = np.random.default_rng(0).integers(16 * 32 * 24, size=500)
    np.testing.assert_array_equal(packed.pixels.read(pixels), flat.pixels.read(pixels))
    before = [(folder / name).stat().st_mtime_ns for name in ("0000.bin", "0001.bin")]
    os.utime(tmp_path / "set" / "cam01.mp4", (1, 1))
    load(tmp_path / "set", holdout="none")
    after = [(folder / name).stat().st_mtime_ns for name in ("0000.bin", "0001.bin")]
    assert after[0] == before[0] and after[1] != before[1]


def test_images_of_still_cameras_with_masks(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Images that two cameras took in turn are two runs; those of a camera that moves stay as they are."""
    times = [k / 15 for k in range(16)]
    rig = make.write_nerfstudio(tmp_path / "set", images=16, times=times)
    file = tmp_path / "set" / "transforms.json"
    (tmp_path / "set" / "masks").mkdir()
    write_image(tmp_path / "set" / "masks" / "0003.png", np.eye(24, 32, dtype=np.uint8) * 255)
    monkeypatch.setattr(pixel_cache, "MAPPED_BYTES", 0)
    assert not load(tmp_path / "set").pixels.path.is_dir()
    make.edit_json(
        file,
        lambda document: [
            frame.update(transform_matrix=rig[k % 2].camera_to_world.tolist())
            for k, frame in enumerate(document["frames"])
        ],
    )
    dataset = load(tmp_path / "set")
    assert len(list(dataset.pixels.path.glob("*.bin"))) == 2 and dataset.masks is not None
    assert dataset.usable_counts[3] == 24 and dataset.usable_counts[4] == 24 * 32
    for k in range(16):
        np.testing.assert_array_equal(dataset.pixels.picture(k), make.picture(rig[k], times[k]))


def test_one_of_two_encodes_decodes(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    make.write_n3dv(tmp_path / "set", cameras=2, frames=3)
    decoded: list[Path] = []
    real = decoded_pictures.read_video

    def read_video(path: Path, *args: object) -> Iterator[np.ndarray]:
        decoded.append(path)
        return real(path, *args)  # type: ignore[arg-type]

    monkeypatch.setattr(decoded_pictures, "read_video", read_video)
    threads = [threading.Thread(target=load, args=(tmp_path / "set",), kwargs={"holdout": "none"}) for _ in range(3)]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join()
    assert len(decoded) == 2 and sorted(p.suffix for p in (tmp_path / "cache").iterdir()) == [".bin", ".json"]


def test_a_lock_is_waited_for_and_taken_over(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Another process holds the lock until this one says that it waits, and is killed then."""
    code = "import sys, filelock as f; x = f.FileLock(sys.argv[1]); x.acquire(); print(flush=True); sys.stdin.read()"
    words, said = [sys.executable, "-c", code, str(tmp_path / "x.lock")], []
    with subprocess.Popen(words, stdin=subprocess.PIPE, stdout=subprocess.PIPE) as owner:

        def end(text: str) -> None:
            said.append(text)
            owner.kill()

        monkeypatch.setattr(cache_lock, "notice", end)
        assert owner.stdout is not None and owner.stdout.readline()
        with cache_lock.exclusive(tmp_path / "x.lock"):
            assert owner.wait() != 0
    assert len(said) == 1 and "waiting" in said[0] and not list(tmp_path.iterdir())


def test_a_cache_of_its_own_is_not_cleared(tmp_path: Path) -> None:
    (tmp_path / "pixels-1").mkdir()
    (tmp_path / "pixels-2.bin").touch()
    (tmp_path / "group-0000.kpc").touch()
    clear_work_folder(tmp_path, cache=tmp_path)
    assert sorted(p.name for p in tmp_path.iterdir()) == ["pixels-1", "pixels-2.bin"]
    clear_work_folder(tmp_path)
    assert not tmp_path.exists()


def test_downscale_auto(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    make.write_nerfstudio(tmp_path / "set", images=3)
    for most, factor in ((32, 1), (31, 2), (10, 4)):
        dataset = load(tmp_path / "set", most_across=most)
        assert dataset.downscale == factor and dataset.pictures.width[0] == 32 // factor
        assert f"--downscale {factor} (auto: {most} at most" in capsys.readouterr().err
