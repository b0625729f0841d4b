import json
import os
import shutil
import subprocess
import sys
import time
from collections.abc import Iterator, Mapping
from pathlib import Path
from types import MappingProxyType

import numpy as np
import pytest

from kpc.encoder.coding.scene_writer import write
from kpc.format.coding.quantise import quantise_scene
from kpc.format.common.images import read_image
from kpc.format.container.container import Reader
from kpc.player.sharing.file_server import Handler, serving
from scenes import tiny_scene, with_appearances
from x_server import x_server


@pytest.fixture(scope="module")
def scene_file(tmp_path_factory: pytest.TempPathFactory) -> Path:
    path = tmp_path_factory.mktemp("scene") / "tiny.kpc"
    scene = with_appearances(tiny_scene(4))
    write(quantise_scene(scene, [dict.fromkeys(scale, 0.01) for scale in scene.scales]), path)
    return path


@pytest.fixture(scope="module")
def display() -> Iterator[str]:
    """The display there is, else one of Xvfb's."""
    if os.environ.get("DISPLAY"):
        yield os.environ["DISPLAY"]
        return
    with x_server() as name:
        yield name


@pytest.fixture(scope="module")
def wayland(display: str, tmp_path_factory: pytest.TempPathFactory) -> Iterator[dict[str, str]]:
    """The environment of a compositor without an X server, with two pixels to a screen unit.

    The compositor runs in an X window, for glfw fails without a keyboard and a pointer.
    """
    if shutil.which("weston") is None:
        pytest.skip("no weston (Debian: apt install weston)")
    folder = tmp_path_factory.mktemp("wayland")
    folder.chmod(0o700)
    variables = {"XDG_RUNTIME_DIR": str(folder), "WAYLAND_DISPLAY": "kpc"}
    command = [
        "weston",
        "--backend=x11-backend.so",
        "--socket=kpc",
        "--width=400",
        "--height=300",
        "--scale=2",
        "--idle-time=0",
    ]
    server = subprocess.Popen(
        command,
        env={**os.environ, **variables, "DISPLAY": display},
        stdout=subprocess.DEVNULL,
        stderr=subprocess.DEVNULL,
    )
    try:
        for _ in range(100):
            if (folder / "kpc").exists() or server.poll() is not None:
                break
            time.sleep(0.1)
        if not (folder / "kpc").exists():
            pytest.skip("weston does not start")
        yield variables
    finally:
        server.terminate()
        server.wait()


def kpplay(
    *arguments: object, display: str | None = None, variables: Mapping[str, str] = MappingProxyType({})
) -> subprocess.CompletedProcess[str]:
    env = {k: v for k, v in os.environ.items() if k not in ("DISPLAY", "WAYLAND_DISPLAY", "PYGLFW_LIBRARY")} | (
        {"DISPLAY": display} if display else {}
    ) | dict(variables)  # fmt: skip
    command = [sys.executable, "-W", "error", "-m", "kpc.player.app.kpplay", *map(str, arguments)]
    return subprocess.run(command, capture_output=True, text=True, env=env, timeout=180, check=False)


def test_plays_in_a_window(scene_file: Path, display: str, tmp_path: Path) -> None:
    screenshot, folder = tmp_path / "screenshot.png", tmp_path / "new" / "folder"
    options = ["--size", "400x300", "--frames", 5, "--screenshot", screenshot, "--folder", folder]
    done = kpplay(scene_file, *options, display=display)
    assert done.returncode == 0 and done.stdout == "" and "Traceback" not in done.stderr, done.stderr
    picture = read_image(screenshot).astype(int)
    assert picture.shape == (300, 400, 3) and folder.is_dir()
    background = np.rint(tiny_scene(4).background * 255)
    assert np.abs(picture[:20, -20:] - background).max() <= 1  # the corner is empty
    assert np.abs(picture[150:170, 260:280] - background).max() > 20  # the scene
    assert picture[12:100, 12:100].mean() < 180  # the HUD


@pytest.mark.parametrize("session", [{}, {"XDG_SESSION_TYPE": "wayland"}], ids=["unset", "set"])
def test_plays_without_an_x_server(
    scene_file: Path, wayland: dict[str, str], session: dict[str, str], tmp_path: Path
) -> None:
    screenshot = tmp_path / "screenshot.png"
    done = kpplay(
        scene_file, "--size", "300x200", "--frames", 20, "--screenshot", screenshot, variables={**wayland, **session}
    )
    assert done.returncode == 0 and done.stdout == "" and "Traceback" not in done.stderr, done.stderr
    picture = read_image(screenshot).astype(int)
    assert picture.shape == (400, 600, 3)  # what the compositor counts
    assert picture[24:200, 24:200].mean() < 180  # the HUD


def test_plays_from_a_server(scene_file: Path, display: str, tmp_path: Path) -> None:
    screenshot = tmp_path / "screenshot.png"
    with serving(scene_file.parent) as url:
        options = ["--size", "400x300", "--memory", "50MB", "--frames", 3, "--screenshot", screenshot]
        done = kpplay(f"{url}/tiny.kpc", *options, display=display)
    assert done.returncode == 0 and done.stdout == done.stderr == "", done.stderr
    background = np.rint(tiny_scene(4).background * 255)
    assert np.abs(read_image(screenshot).astype(int)[150:170, 260:280] - background).max() > 20


def test_a_failing_server_is_reported_in_the_window(scene_file: Path, display: str, tmp_path: Path) -> None:
    class Failing(Handler):
        """Sends small ranges, and nothing after the first picture."""

        def do_GET(self) -> None:
            first, last = map(int, self.headers["Range"].removeprefix("bytes=").split("-"))
            if first >= 6000:
                self.send_error(404)
                return
            self.headers.replace_header("Range", f"bytes={first}-{min(last, first + 1999)}")
            super().do_GET()

    pictures = [tmp_path / "whole.png", tmp_path / "failed.png"]
    for handler, screenshot in zip((Handler, Failing), pictures, strict=True):
        with serving(scene_file.parent, handler=handler) as url:
            done = kpplay(
                f"{url}/tiny.kpc", "--size", "400x300", "--frames", 2, "--screenshot", screenshot, display=display
            )
        errors = done.stderr.splitlines()
        assert done.returncode == len(errors) == int(handler is Failing), done.stderr
        assert all(line.startswith("kpplay: loading stopped: ") for line in errors)
    whole, failed = (
        read_image(screenshot).astype(int)[22:38, 250:390] for screenshot in pictures
    )  # where the message is, right of the HUD
    assert failed.max() > 200 > 100 > failed.min() and np.abs(whole - failed).max() > 100


def test_a_file_that_is_cut_off_plays_as_far_as_it_goes(scene_file: Path, display: str, tmp_path: Path) -> None:
    cut, picture = tmp_path / "cut.kpc", tmp_path / "cut.png"
    reader = Reader(scene_file)
    cut.write_bytes(scene_file.read_bytes()[: reader.index[-2].offset + 10])
    done = kpplay(cut, "--size", "400x300", "--frames", 2, "--screenshot", picture, display=display)
    assert done.returncode == 0 and picture.is_file(), done.stderr
    assert f"kpplay: {cut}: cut off at " in done.stderr and "; what is there is played" in done.stderr
    cut.write_bytes(scene_file.read_bytes()[: reader.index[1].offset + 1])
    done = kpplay(cut, display=display)
    assert done.returncode == 1 and "cut off at" in done.stderr and "is not there" in done.stderr


def test_long_playback_allocates_nothing_on_the_card(scene_file: Path, display: str) -> None:
    command = [
        sys.executable,
        "-m",
        "kpc.tools.bench.kpbench",
        "steady",
        str(scene_file),
        "--size",
        "200x150",
        "--frames",
        "40",
    ]
    env = {**os.environ, "DISPLAY": display}
    done = subprocess.run(command, capture_output=True, text=True, env=env, timeout=60, check=False)
    assert done.returncode == 0, done.stderr
    (record,) = json.loads(done.stdout)
    (run,) = record["repeats"]
    assert run["gpu_objects_created"] == 0 and run["peak_bytes"] - run["first_bytes"] < 1 << 24 < run["first_bytes"]
    assert "MB at end" in done.stderr and record["renderer"]


def test_kpbench_measures_a_window(scene_file: Path, display: str) -> None:
    command = [
        sys.executable,
        "-m",
        "kpc.tools.bench.kpbench",
        "window",
        str(scene_file),
        "--size",
        "320x240",
        "--seconds",
        "1",
        "--turn",
        "20",
    ]
    done = subprocess.run(
        command, capture_output=True, text=True, env={**os.environ, "DISPLAY": display}, timeout=60, check=False
    )
    assert done.returncode == 0, done.stderr
    (record,) = json.loads(done.stdout)
    (run,) = record["repeats"]
    assert run["raster"] == "320x240" and run["raster_share"] == 1 and run["psnr"] >= run["psnr_min"] > 30, (
        run
    )  # so small a scene needs no less
    assert 5 < run["fps"] and "PSNR to reference dB" in done.stderr


def test_without_a_display_kprender_is_named(scene_file: Path) -> None:
    done = kpplay(scene_file)
    assert done.returncode == 1 and done.stderr.count("\n") == 1
    assert done.stderr.startswith("kpplay: cannot open a window") and "kprender" in done.stderr


@pytest.mark.parametrize(
    ("arguments", "code", "words"),
    [
        (["nowhere.kpc"], 1, "nowhere.kpc"),
        (["http://127.0.0.1:9/nowhere.kpc"], 1, "http://127.0.0.1:9/nowhere.kpc"),
        (["{scene}", "--memory", "1MB"], 1, "--memory"),
        (["{scene}", "--size", "7x7"], 2, "--size"),
        (["{scene}", "--frames", "0"], 2, "--frames"),
        (["{scene}", "--screenshot", "nowhere/x.png"], 2, "choose another place with --screenshot"),
        (["{scene}", "--screenshot", "x.bmp"], 2, "x.bmp"),
        (["{scene}", "--screenshot", "x.jpg"], 2, "x.jpg"),
        (["{scene}", "--screenshot", "x.png/"], 2, "x.png/"),
        (["{scene}", "--folder", "{scene}"], 2, "is a file, not a folder"),
        (["{scene}", "--folder", "{scene}/below"], 2, "is a file, not a folder"),
        (["{scene}", "--path", "nowhere.json"], 1, "nowhere.json"),
        (["{scene}", "--path", "{scene}"], 1, "tiny.kpc"),
        (["{scene}", "--quality", "perfect"], 2, "fastest"),
        (["{scene}", "--target-fps", "0"], 2, "--target-fps"),
        (["{scene}", "--target-fps", "9", "--quality", "fast"], 2, "not allowed with"),
    ],
)
def test_bad_input_is_reported_before_a_window_opens(
    scene_file: Path, arguments: list[str], code: int, words: str
) -> None:
    done = kpplay(*[a.format(scene=scene_file) for a in arguments])
    assert done.returncode == code and words in done.stderr and "Traceback" not in done.stderr


def test_every_key_and_drag(scene_file: Path, display: str, tmp_path: Path) -> None:
    """In a process of its own: with Mesa none can hold both a GLX and an EGL context, and other tests use EGL."""
    command = [sys.executable, "-W", "error", str(Path(__file__).parents[1] / "press_every_key.py"), str(scene_file)]
    env = {**os.environ, "DISPLAY": display, "XDG_CONFIG_HOME": str(tmp_path / "settings")}
    done = subprocess.run(command, capture_output=True, text=True, env=env, cwd=tmp_path, timeout=180, check=False)
    assert done.returncode == 0, done.stderr
    *shown, reset, unwritten = done.stderr.splitlines()
    assert [line for line in shown if "cannot be written" not in line] == [  # errors that the window shows, too
        "kpplay: text.kpc: not a .kpc file",
        "kpplay: none.kpc: No such file or directory",
        "kpplay: none.json: No such file or directory",
        "kpplay: text.kpc.JSON: No such file or directory",
        "kpplay: text.kpc: not a .kpc file",
    ]
    assert reset == "kpplay: the graphics card was reset; restart kpplay, or update the graphics driver"
    assert unwritten.startswith("kpplay: settings were not saved")
    saved = list(tmp_path.glob("tiny-*.png"))
    assert len(saved) == 1 and read_image(saved[0]).shape == (330, 420, 3)
