"""Inputs that once failed, made anew from a small clip, are read as they should be or refused in the right words.

The scripts that make them lie beside the repository in shared/cases, one folder each.
"""

import functools
import importlib
import os
import runpy
import socket
import subprocess
import sys
import time as clock
import warnings
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import pytest
from PIL import Image

import datasets as make
from kpc.encoder.datasets import Dataset, load_dataset, pixel_rays
from kpc.encoder.datasets.capture import natural_key
from kpc.format.common.films import write_video
from kpc.tools.cli import kpinfo, kprender
from kpc.tools.dev import scenegen

REPOSITORY = Path(__file__).resolve().parents[1]
CASES = REPOSITORY.parent / "shared" / "cases"
SCENE = REPOSITORY / "samples" / "default.kpc"

# What the scripts expect of the clip.
CAMERAS, FRAMES, WIDTH, HEIGHT, FPS = 12, 30, 192, 144, 12.0
STILL = 15  # the frame of the scripts' pictures

# Cases that other tests cover.
ELSEWHERE = {"p1-keys-on-other-keyboards": "keys are typed on an X server in tests/player/test_keyboard.py"}

# Greatest mean difference of two decoders of a frame, and of pictures that were coded again; on the 8-bit scale.
SAME, SIMILAR = 3.0, 5.0

pytestmark = pytest.mark.skipif(not CASES.is_dir(), reason="shared/cases is not here")


@dataclass(frozen=True)
class Clip:
    """The clip of which cases are made: its folder, and itself as the encoder reads it."""

    folder: Path
    dataset: Dataset

    def picture(self, camera: int, frame: int) -> np.ndarray:
        """Return a frame of a camera, (height, width, 3) float."""
        return self.dataset.pixels.picture(FRAMES * camera + frame).astype(float)

    def pose(self, camera: int) -> np.ndarray:
        return self.dataset.pictures.camera_to_world[FRAMES * camera]


@pytest.fixture(scope="module")
def clip(tmp_path_factory: pytest.TempPathFactory) -> Clip:
    """Film the default scene with a ray for every sixteen pixels and enlarge it, since all rays take minutes."""
    folder = tmp_path_factory.mktemp("clip")
    cameras = scenegen.rig(scenegen.Options(cameras=CAMERAS, width=WIDTH, height=HEIGHT))
    coarse = scenegen.Options(cameras=CAMERAS, width=WIDTH // 4, height=HEIGHT // 4, samples=1)
    for k, camera in enumerate(scenegen.rig(coarse)):
        film = scenegen.FixedCamera(camera, coarse)
        pictures = (Image.fromarray(film.picture(n / (FRAMES - 1))) for n in range(FRAMES))
        enlarged = (np.asarray(picture.resize((WIDTH, HEIGHT), Image.Resampling.BICUBIC)) for picture in pictures)
        write_video(folder / f"cam{k:02d}.mp4", enlarged, FPS)
    np.save(folder / "poses_bounds.npy", make.poses_bounds(cameras, 2.0, 6.0))
    return Clip(folder, load_dataset(folder, tmp_path_factory.mktemp("cache"), progress=False))


@pytest.fixture(scope="module")
def decoded_once() -> Iterator[None]:
    """Have the scripts decode each film of the clip once: most make pictures of its frames."""
    with pytest.MonkeyPatch.context() as patch:
        patch.syspath_prepend(CASES)
        common = importlib.import_module("common")
        patch.setattr(common, "frames", functools.cache(common.frames))
        yield
    del sys.modules["common"]


def run_script(name: str, clip: Clip, out: Path) -> None:
    """Run the script of a case in `out`, in this process."""
    script = CASES / name / "make.py"
    with pytest.MonkeyPatch.context() as patch, warnings.catch_warnings(action="ignore"):
        patch.chdir(out)
        patch.setattr(sys, "argv", [str(script), str(clip.folder), str(out)])
        patch.setattr(sys, "path", [*sys.path])
        runpy.run_path(str(script))


Check = Callable[[Dataset, Clip], None]
Outcome = Callable[[Path, Clip, pytest.CaptureFixture[str]], None]


def reads(description: str, *checks: Check, log: str = "") -> Outcome:
    """Expect that a folder is read, described like this in the log, with one more line that contains `log`, if any."""

    def outcome(folder: Path, clip: Clip, capsys: pytest.CaptureFixture[str]) -> None:
        dataset = make.load(folder)
        printed = capsys.readouterr().err.splitlines()
        assert dataset.describe() == description
        assert len(printed) == bool(log) and all(log in line for line in printed), printed
        for check in checks:
            check(dataset, clip)

    return outcome


def refused(*words: str) -> Outcome:
    return lambda folder, clip, capsys: make.fails(folder, *words)


def by_camera(dataset: Dataset) -> list[int]:
    """Return the first picture of each camera; names are numbered by camera, padded or not."""
    firsts = range(0, len(dataset.pictures), len(dataset.pictures) // CAMERAS)
    return sorted(firsts, key=lambda n: natural_key(dataset.pictures.file[n]))


def stills(dataset: Dataset, clip: Clip) -> None:
    """Assert that each camera has its own picture."""
    cameras_are_those_of_the_clip(dataset, clip)
    for k, number in enumerate(by_camera(dataset)):
        errors = [np.abs(dataset.pixels.picture(number) - clip.picture(j, STILL)).mean() for j in range(CAMERAS)]
        assert np.argmin(errors) == k and errors[k] < SAME


def fisheye_shows_the_clip(dataset: Dataset, clip: Clip) -> None:
    """Assert that rays of the equidistant pictures hit what those of the clip's pinholes show there."""
    row, column = (axis.ravel() for axis in np.mgrid[40:104:4, 50:142:4])
    for n in by_camera(dataset)[:2]:
        origins, directions = pixel_rays(dataset.pictures, np.full(len(row), n), column, row)
        local = directions @ dataset.pictures.camera_to_world[n, :3, :3]
        fl_x, fl_y, cx, cy = clip.dataset.pictures.intrinsics[0]
        x, y = cx - fl_x * local[:, 0] / local[:, 2], cy + fl_y * local[:, 1] / local[:, 2]
        source = clip.picture(by_camera(dataset).index(n), STILL)[np.floor(y).astype(int), np.floor(x).astype(int)]
        assert np.abs(dataset.pixels.picture(n)[row, column, :3] - source).mean() < SIMILAR
        np.testing.assert_allclose(origins[0], clip.pose(by_camera(dataset).index(n))[:3, 3], atol=1e-6)


def cameras_are_those_of_the_clip(dataset: Dataset, clip: Clip) -> None:
    for k, n in enumerate(by_camera(dataset)):
        np.testing.assert_allclose(dataset.pictures.camera_to_world[n], clip.pose(k), atol=1e-6)
        focal = clip.dataset.pictures.intrinsics[0, :2] * (
            dataset.pictures.width[n] / WIDTH,
            dataset.pictures.height[n] / HEIGHT,
        )
        np.testing.assert_allclose(dataset.pictures.intrinsics[n, :2], focal, rtol=1e-6)


def grey(dataset: Dataset, clip: Clip) -> None:
    for k in range(CAMERAS):
        wanted = np.asarray(Image.fromarray(clip.picture(k, STILL).astype(np.uint8)).convert("L"), float)
        assert np.abs(dataset.pixels.picture(k) - wanted[..., None]).mean() < SAME


def first_two_are_held_out(dataset: Dataset, clip: Clip) -> None:
    assert np.flatnonzero(dataset.pictures.is_test).tolist() == [0, 1]


def left_half_is_masked(dataset: Dataset, clip: Clip) -> None:
    assert not dataset.usable(3)[:, : WIDTH // 2].any() and dataset.usable(3)[:, WIDTH // 2 :].all()


def squeezed(dataset: Dataset, clip: Clip) -> None:
    assert set(dataset.pictures.width) == set(dataset.pictures.height) == {HEIGHT}


def frames(*shown: Sequence[int], seconds: Callable[[int], float] = lambda n: n / FPS) -> Check:
    """Expect these frames of the clip, of every camera or of even and odd ones, at times in proportion to `seconds`."""

    def check(dataset: Dataset, clip: Clip) -> None:
        cameras_are_those_of_the_clip(dataset, clip)
        all_seconds = [seconds(n) for some in shown for n in some]
        first, last = min(all_seconds), max(all_seconds)
        assert dataset.clip.duration_s == pytest.approx(last - first, abs=2e-3)
        number = 0
        for k in range(CAMERAS):
            for n in shown[k % len(shown)]:
                wanted = (seconds(n) - first) / (last - first)
                assert dataset.pictures.time[number] == pytest.approx(wanted, abs=1e-3)
                if k < 4:
                    picture = dataset.pixels.picture(number)
                    near = [m for m in range(n - 2, n + 3) if 0 <= m < FRAMES]
                    errors = [np.abs(picture - clip.picture(k, m)).mean() for m in near]
                    assert near[np.argmin(errors)] == n and min(errors) < SIMILAR
                number += 1
        assert number == len(dataset.pictures)

    return check


def films_of_any_kind(dataset: Dataset, clip: Clip) -> None:
    """Colours and sides are right, at any size."""
    cameras_are_those_of_the_clip(dataset, clip)
    for k in range(CAMERAS):
        picture = dataset.pixels.picture(FRAMES * k + STILL)
        wanted = clip.picture(k, STILL).astype(np.uint8)
        resized = Image.fromarray(wanted).resize((picture.shape[1], picture.shape[0]), Image.Resampling.BOX)
        assert np.abs(picture - np.asarray(resized, float)).mean() < SIMILAR


def kpinfo_reads(mode: str, userinfo: str) -> Outcome:
    """Expect that kpinfo reads the sample scene from the case's server, which has manners of its own."""

    def outcome(folder: Path, clip: Clip, capsys: pytest.CaptureFixture[str]) -> None:
        with socket.socket() as free:
            free.bind(("127.0.0.1", 0))
            port = free.getsockname()[1]
        server = next((CASES / folder.name).glob("server.py"))
        with subprocess.Popen(
            [sys.executable, "-B", server, mode, SCENE, str(port)], stderr=subprocess.DEVNULL
        ) as process:
            try:
                wait_for(port)
                assert kpinfo.main([f"http://{userinfo}127.0.0.1:{port}/scene.kpc"]) == 0
            finally:
                process.kill()
        from_url = capsys.readouterr().out
        assert kpinfo.main([str(SCENE)]) == 0
        from_file = capsys.readouterr().out
        assert from_url.splitlines()[1:] == from_file.splitlines()[1:] and "p%40ss" not in from_url

    return outcome


def wait_for(port: int) -> None:
    """Wait until a server accepts connections."""
    for _ in range(300):
        try:
            socket.create_connection(("127.0.0.1", port), timeout=1).close()
        except ConnectionRefusedError:
            clock.sleep(0.1)
        else:
            return
    pytest.fail("the server of the case does not start")


def render(*words: object) -> int:
    """Run kprender on the sample scene at a tiny size and return its exit code."""
    try:
        return kprender.main([str(SCENE), "--size", "8x6", "--backend", "reference", *map(str, words)])
    except SystemExit as error:  # argparse
        return int(error.code or 0)


def suffixes_say_what_is_written(folder: Path, clip: Clip, capsys: pytest.CaptureFixture[str]) -> None:
    for name, beginning in (("clip.webm", b"\x1a\x45\xdf\xa3"), ("clip.mov", b""), ("still.jpg", b"\xff\xd8")):
        still = ["--time", 0.5] if name.startswith("still") else ["--orbit", 2]
        assert render(*still, "-o", folder / name) == 0
        assert (folder / name).read_bytes().startswith(beginning)
    capsys.readouterr()
    assert render("-o", folder / "clip.gif") == 2
    assert ".gif is not written" in capsys.readouterr().err and not (folder / "clip.gif").exists()


def only_cameras_are_rendered(folder: Path, clip: Clip, capsys: pytest.CaptureFixture[str]) -> None:
    assert render("--cameras", folder / "transforms.json", "-o", folder / "good") == 0
    assert sorted(p.name for p in (folder / "good").rglob("*.png")) == ["0001.png", "0003.png", "0005.png"]
    capsys.readouterr()
    for option, name, words in (
        ("--cameras", "mirrored.json", "mirrored"),
        ("--path", "mirrored.json", "mirrored"),
        ("--cameras", "fisheye.json", "OPENCV_FISHEYE"),
    ):
        assert render(option, folder / name, "-o", folder / "bad.mp4") == 1
        assert words in capsys.readouterr().err and not (folder / "bad.mp4").exists()


EARLY, LATE = [n for n in range(FRAMES) if not 4 <= n <= 8], [n for n in range(FRAMES) if not 20 <= n <= 24]
ALL_STILLS = "12 cameras, 12 pictures of 192x144, 2 of them held out, static"
VIDEOS = "N3DV: 12 cameras, {} pictures of {}, {} of them held out (cam00), dynamic, {} frames at {} fps ({} s)"
JITTER = VIDEOS.format(360, "192x144", 30, 30, 12.208, 2.457)

EXPECTED: dict[str, Outcome] = {
    "c1-one-line-an-image": reads(f"COLMAP: {ALL_STILLS}", stills),
    "c4-fine": reads(f"COLMAP: {ALL_STILLS}".replace("2 of them held out", "2 of them held out (früh (1))"), stills),
    "h1-user-and-password": kpinfo_reads("basic", "user:p%40ss@"),
    "h3-small-file-416": kpinfo_reads("strict", ""),
    "i1-sixteen-bit-grey": reads(f"nerfstudio: {ALL_STILLS}", cameras_are_those_of_the_clip, grey),
    "i2-pictures-of-another-suffix": reads(f"nerfstudio: {ALL_STILLS}", stills),
    "i4-files-a-mac-leaves": reads(f"LLFF: {ALL_STILLS}", stills),
    "i6-unpadded-names": reads(f"LLFF: {ALL_STILLS}", stills, log="rows belong to files in the plain order of names"),
    "l1-names-that-are-not-utf8": reads(f"nerfstudio: {ALL_STILLS}", stills),
    "r1-suffix-that-is-no-film": suffixes_say_what_is_written,
    "r3-cameras-that-are-none": only_cameras_are_rendered,
    "t1-mask-path": reads(f"nerfstudio: {ALL_STILLS}, masks (50.0% ignored)", stills, left_half_is_masked),
    "t11-fine": reads(f"nerfstudio: {ALL_STILLS}", stills, log="keys without effect"),
    "t3-camera-angle-y": reads(
        f"nerfstudio: {ALL_STILLS}, fl_y / fl_x 1.333".replace("192x", "144x"), cameras_are_those_of_the_clip, squeezed
    ),
    "t5-fisheye-of-another-name": reads(f"nerfstudio: {ALL_STILLS}, fisheye", fisheye_shows_the_clip),
    "t7-validation-list": reads(f"nerfstudio: {ALL_STILLS}", stills, first_two_are_held_out),
    "t9-nan-distortion": refused("k1 is NaN"),
    "v1-cut-without-reencoding": reads(
        VIDEOS.format(300, "192x144", 25, 25, 12, 2.083),
        frames(range(5, FRAMES)),
    ),
    "v3-variable-frame-rate": reads(
        JITTER, frames(range(FRAMES), seconds=lambda n: (n * 7500 + 4500 * np.sin(n * 1.7)) / 90000)
    ),
    "v10-odd-but-fine": reads(
        VIDEOS.format(360, "96x72 to 192x144", 30, 30, 12, 2.5),
        films_of_any_kind,
    ),
    "v5-field-order-swapped": reads(
        VIDEOS.format(180, "192x144", 15, 15, 6, 2.5),
        frames(range(0, FRAMES, 2)),
        log="interlaced; deinterlaced",
    ),
    "v8-frames-dropped-at-different-times": reads(
        VIDEOS.format(300, "192x144", 25, 30, 12, 2.5),
        frames(LATE, EARLY),
        log="videos lack frames at different times",
    ),
}
FOLDERS = sorted(path.name for path in CASES.iterdir() if (path / "case.md").is_file()) if CASES.is_dir() else []


@pytest.mark.usefixtures("decoded_once")
@pytest.mark.parametrize("name", [name for name in FOLDERS if name not in ELSEWHERE])
def test_a_case(name: str, clip: Clip, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert name in EXPECTED, f"shared/cases/{name} has no expectation here; add it to EXPECTED"
    out = tmp_path / name
    out.mkdir()
    if (CASES / name / "make.py").is_file():
        run_script(name, clip, out)
    capsys.readouterr()
    inner = [Path(os.fsdecode(entry)) for entry in out.iterdir()]
    EXPECTED[name](inner[0] if len(inner) == 1 and inner[0].is_dir() else out, clip, capsys)
