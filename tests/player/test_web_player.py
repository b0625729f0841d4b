"""<kpc-player> in headless Chromium, drawn by SwiftShader: player/web/tests/element_browser.mjs does what users do."""

import base64
import gzip
import io
import json
import re
import subprocess
import threading
from collections.abc import Iterator
from http import HTTPStatus
from pathlib import Path
from typing import IO, Any, ClassVar
from urllib.parse import unquote

import numpy as np
import pytest
from PIL import Image

import kpc
from kpc.encoder.coding.opus import encode_sound
from kpc.format.common.fidelity import psnr
from kpc.format.common.images import linear_from_srgb, srgb_from_linear
from kpc.format.scene.cameras import Camera
from kpc.format.scene.rig import Rig
from kpc.format.scene.scene import Scene
from kpc.format.scene.sound import SAMPLE_RATE
from kpc.player.app.controls import OrbitView
from kpc.player.cpu.reference import render, render_rays
from kpc.player.sharing.file_server import Handler, Link, serving
from kpc.player.viewpoints import presets
from kpc.tools.bench import web_page
from kpc.tools.cli import kpshare
from kpc.tools.vectors.group_vectors import packed
from sounds import decoded, sweep, write_clip_with_sound

SAMPLE = Path(__file__).parent.parent.parent / "samples" / "default.kpc"
SCRIPT = web_page.WEB / "tests" / "element_browser.mjs"
SCRIPTS = [SCRIPT, *(SCRIPT.with_name(f"{name}_browser.mjs") for name in ("headset", "scrolling", "three"))]
SCENARIOS = re.findall(
    r"^ *scenario\(['`](.+)['`], async", "".join(script.read_text(encoding="utf-8") for script in SCRIPTS), re.MULTILINE
)
# A browser that hangs is ended.
TIMEOUT_S = 400
# Pictures of pages, to be looked at.
SCREENSHOTS = web_page.WEB / "build" / "screenshots"


class Faulty(Handler):
    """Serves files well, and in a folder whose name is a fault with that fault."""

    fault = ""
    requests: ClassVar[dict[str, int]] = {}
    lock: ClassVar[threading.Lock] = threading.Lock()
    slow: ClassVar[Link] = Link(rate=60_000.0)

    def do_GET(self) -> None:
        if self.path.startswith("/page.html?"):
            self.answer_with(unquote(self.path.partition("?")[2]).encode(), "Content-Type", "text/html")
            return
        if self.path.startswith("/gallery/"):
            super().do_GET()
            return
        self.fault, _, rest = self.path.lstrip("/").rpartition("/")
        self.path, self.is_shared = f"/{rest}", self.fault != "refused"
        with self.lock:
            self.count = self.requests[self.fault] = self.requests.get(self.fault, 0) + 1
        if self.fault in ("moved", "away"):
            site = "" if self.fault == "moved" else f"http://localhost:{self.connection.getsockname()[1]}/refused"
            self.send_response(HTTPStatus.FOUND)
            self.send_header("Location", site + self.path)
            self.send_header("Content-Length", "0")
            self.end_headers()
            return
        if self.fault == "replaced" and self.count > 1:
            self.path = "/other.kpc"
        if self.fault == "whole":
            del self.headers["Range"]
        # Browsers that ask for a range accept nothing compressed, and refuse this answer.
        if self.fault == "packed":
            packed = gzip.compress(Path(self.translate_path(self.path)).read_bytes())
            self.answer_with(packed, "Content-Encoding", "gzip")
            return
        super().do_GET()

    def answer_with(self, body: bytes, header: str, value: str) -> None:
        self.send_response(HTTPStatus.OK)
        self.send_header(header, value)
        self.send_header("Content-Length", str(len(body)))
        self.end_headers()
        self.wfile.write(body)

    def send(self, file: IO[bytes], count: int) -> None:
        if self.fault == "slow":
            self.shared = self.slow
        if self.fault == "cut" and self.count % 3:
            super().send(file, count // 2)
            self.close_connection = True
            self.connection.shutdown(2)
            return
        super().send(file, count)


# Four seconds on both sides; the clip is in two groups, of which the second takes over after two.
RECORDING = encode_sound(np.stack([sweep(5.0), sweep(5.0, 3000.0, 200.0)], axis=1))


@pytest.fixture(scope="module")
def address(tmp_path_factory: pytest.TempPathFactory) -> Iterator[str]:
    """Serve the built player, scenes and files that are none."""
    folder = tmp_path_factory.mktemp("site")
    data = SAMPLE.read_bytes()
    packages = web_page.WEB / "node_modules"
    served = [*(web_page.WEB / "dist").glob("*.js"), *(web_page.WEB / "examples").iterdir()]
    for file in (*served, *(packages / "three" / "build").glob("three.[cm]*.js")):
        (folder / file.name).write_bytes(file.read_bytes())
    (folder / "scene.kpc").write_bytes(data)
    for name, count in ("long.kpc", 3), ("other.kpc", 4):
        # Each group has planes of its own, so that they are still to be fetched while the first one plays.
        (folder / name).write_bytes(packed([(30 * number, 30, data) for number in range(count)]))
    write_clip_with_sound(folder / "sound.kpc", RECORDING)
    (folder / "text.kpc").write_text("<!doctype html><title>Not here</title>" * 9)
    (folder / "draft.kpc").write_bytes(data[:10] + bytes(2) + data[12:])
    (folder / "half.kpc").write_bytes(data[:40_000] + bytes(len(data) - 40_000))
    for name, whole, count in ("stub", "scene", 10_000), ("cut", "scene", 30_000), ("cut-clip", "long", 70_000):
        (folder / f"{name}.kpc").write_bytes((folder / f"{whole}.kpc").read_bytes()[:count])
    Image.new("RGB", (64, 48), (40, 90, 140)).save(folder / "poster.png")
    scenes = tmp_path_factory.mktemp("scenes")
    for name in "one.kpc", "two 2.kpc":
        (scenes / name).write_bytes(data)
    with pytest.MonkeyPatch.context() as patch:
        for side in "SIDE", "SLOW_SIDE":
            patch.setattr(f"kpc.tools.rendering.poster.{side}", 16)
        assert kpshare.main(["--gallery", str(scenes), "-o", str(folder / "gallery")]) == 0
    with serving(folder, handler=Faulty) as url:
        yield url


@pytest.fixture(scope="module")
def results(address: str) -> dict[str, Any]:
    """Return what each scenario found, and its error."""
    reason = web_page.missing()
    if reason is not None:
        pytest.skip(reason)
    SCREENSHOTS.mkdir(parents=True, exist_ok=True)
    command: list[str | Path] = ["node", SCRIPT, address, str(web_page.browser()), SCREENSHOTS]
    done = subprocess.run(command, capture_output=True, cwd=web_page.WEB, text=True, timeout=TIMEOUT_S)
    assert done.returncode == 0, done.stderr[-4000:]
    return dict(json.loads(done.stdout.splitlines()[-1]))


def names() -> list[str]:
    """Return the names of all scenarios, those of loops by what they begin with."""
    return [name.partition("$")[0] for name in SCENARIOS]


@pytest.mark.parametrize("name", names())
def test_scenario(name: str, results: dict[str, Any]) -> None:
    found = [result for each, result in results.items() if each.startswith(name)]
    assert found
    assert [result["error"] for result in found if result["error"] is not None] == []


def pixels_of(picture: str) -> np.ndarray:
    """Return a PNG in base64 as (H, W, 3) in [0, 1]."""
    return np.asarray(Image.open(io.BytesIO(base64.b64decode(picture))).convert("RGB")) / 255


def view_of(text: str) -> np.ndarray:
    """Return the numbers of a camera in words: eye, point that it looks at, vertical angle of view in degrees."""
    return np.array([float(number) for number in text.split()])


def numbers_of(scene: Scene, camera: Camera) -> list[float]:
    view = OrbitView.of(Rig.of(scene), camera)
    return [*view.eye, *view.focus, float(np.degrees(2 * np.arctan(camera.height / 2 / camera.fl_y)))]


def test_viewpoints_are_those_of_the_desktop_player(results: dict[str, Any]) -> None:
    views = results["knows the viewpoints of the desktop player"]["value"]
    scene = kpc.load(SAMPLE)
    assert isinstance(scene, Scene)
    opening = scene.metadata.opening
    assert opening is not None
    cameras = {"opening": opening.camera, **presets(scene)}
    cameras |= dict(zip(scene.metadata.camera_names, scene.cameras, strict=True))
    assert list(views) == list(cameras)
    for name, camera in cameras.items():
        np.testing.assert_allclose(view_of(views[name]), numbers_of(scene, camera), atol=2e-4)


def test_the_picture_is_that_of_the_reference(results: dict[str, Any]) -> None:
    value = results["draws what the reference draws"]["value"]
    picture = pixels_of(value["picture"])
    scene = kpc.load(SAMPLE)
    assert isinstance(scene, Scene)
    opening = scene.metadata.opening
    assert opening is not None
    np.testing.assert_allclose(view_of(value["camera"]), numbers_of(scene, opening.camera), atol=2e-4)
    height, width = picture.shape[:2]
    wanted = render(scene, opening.camera.resized(width, height), 1.3 * 12 / 29).rgb.clip(0, 1)
    assert psnr(picture, wanted) >= 45


def test_each_eye_sees_its_own_picture_and_controllers_move_it(results: dict[str, Any]) -> None:
    found = results["shows the clip in a headset"]["value"]
    opening, turned, dragged = (pixels_of(found[name]) for name in ("opening", "turned", "dragged"))
    left, right = np.split(opening, 2, axis=1)
    width = left.shape[1]
    apart = [np.abs(left[:, shift:] - right[:, : width - shift]).mean() for shift in range(12)]
    # Eyes 63 mm apart see what is 1.5 m away, in pictures of a right angle, so many pixels apart.
    assert abs(int(np.argmin(apart)) - 0.063 / 1.5 * width / 2) < 1.5 and apart[0] > 1.3 * min(apart)

    def centre(picture: np.ndarray) -> np.ndarray:
        """Return where the scene is on grey ground in the left eye's picture: row and column."""
        rows, columns = np.nonzero(np.abs(picture[:, :width] - 0.5).max(axis=-1) > 0.05)
        return np.array([rows.mean(), columns.mean()])

    assert centre(turned)[1] < centre(opening)[1] - 5
    assert centre(dragged)[0] < centre(turned)[0] - 3


def rays_of(found: dict[str, Any], shot: dict[str, Any]) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return where rays of a picture of three.js begin and end, (H, W, 3) world units, and (N, 4, 4) matrices of the
    clip and of the squares in it."""
    inverse, pose = (np.reshape(shot[name], (4, 4)).T for name in ("inverse", "camera"))
    x = (np.arange(found["width"]) + 0.5) / found["width"] * 2 - 1
    y = 1 - (np.arange(found["height"]) + 0.5) / found["height"] * 2
    near, far = (1, 0) if shot["isReversed"] else (-1, 1)
    ends = []
    for z in (near, far):
        places = np.stack([*np.meshgrid(x, y), *np.broadcast_arrays(z, 1.0, np.ones((len(y), len(x))))[:2]], axis=-1)
        world = places @ (pose @ inverse).T
        ends.append(world[..., :3] / world[..., 3:])
    matrices = [found["object"], *(square["matrix"] for square in found["squares"])]
    return ends[0], ends[1], np.reshape(matrices, (-1, 4, 4)).transpose(0, 2, 1)


def within(points: np.ndarray, matrix: np.ndarray) -> np.ndarray:
    """Return points of the world in the space of an object."""
    inverse = np.linalg.inv(matrix)
    return np.asarray(points @ inverse[:3, :3].T + inverse[:3, 3])


@pytest.mark.parametrize("name", ["perspective", "orthographic", "reversed", "target"])
def test_meshes_of_three_hide_and_are_hidden(name: str, results: dict[str, Any]) -> None:
    found = results["draws a clip among meshes of three.js"]["value"]
    shot = found["drawn"][name]
    picture = pixels_of(shot["picture"])
    begin, end, (clip, *squares) = rays_of(found, shot)
    shape = begin.shape[:2]
    way = np.full(shape, np.inf)  # to the nearest opaque square, in shares of the way from begin to end, as the next
    wanted = np.broadcast_to(np.array([0x20, 0x40, 0x60]) / 255, (*shape, 3)).copy()
    hits = []
    for square, matrix in zip(found["squares"], squares, strict=True):
        a, b = within(begin, matrix), within(end, matrix)
        share = a[..., 2] / (a[..., 2] - b[..., 2])
        at = a + share[..., None] * (b - a)
        hits.append(np.where(np.abs(at[..., :2]).max(axis=-1) < square["size"] / 2, share, np.inf))
        if square["opacity"] == 1:
            nearer = hits[-1] < way
            wanted[nearer], way[nearer] = square["colour"], hits[-1][nearer]
    # Rays of the clip begin where three's camera is, or far away; its near plane is before the clip.
    a, b = within(begin, clip), within(end, clip)
    length = np.linalg.norm(b - a, axis=-1)
    directions = ((b - a) / length[..., None]).reshape(-1, 3).astype(np.float32)
    scene = kpc.load(SAMPLE)
    assert isinstance(scene, Scene)
    limits = (np.minimum(way, 1) * length).ravel().astype(np.float32)
    drawn = render_rays(scene, a.reshape(-1, 3).astype(np.float32), directions, 1.3 * 12 / 29, limits=limits)
    through = 1 - drawn.opacity.reshape(*shape, 1)
    light = linear_from_srgb if name == "target" else np.asarray  # what colours are blended in
    own = (drawn.rgb.reshape(*shape, 3) - through * scene.background) / np.maximum(1 - through, 1e-6)
    wanted = (1 - through) * light(own) + through * light(wanted)
    depth = np.where(drawn.opacity.reshape(shape) >= 0.5, drawn.depth.reshape(shape) / length, np.inf)
    last = found["squares"][-1]
    is_seen = hits[-1] < np.minimum(depth, way)
    wanted[is_seen] += last["opacity"] * (np.array(last["colour"]) - wanted[is_seen])
    wanted = (srgb_from_linear(wanted) if name == "target" else wanted).clip(0, 1)
    error = np.abs(light(picture) - light(wanted)).max(axis=-1)
    assert shot["error"] == 0 and found["hits"] == 1
    # Three opaque squares, a part of one behind the clip, and a part of the one that can be seen through.
    assert [int((hit < np.inf).sum()) > 50 for hit in hits] == [True] * 4
    assert (hits[2] < np.inf)[~is_seen & (through[..., 0] < 0.1)].sum() > 50 and is_seen.sum() > 50
    # Edges of squares, of which "target" has smooth ones, are all that is off, in the light that is blended.
    assert np.mean(error <= 2 / 255) >= (0.95 if name == "target" else 0.98)
    assert psnr(picture, wanted) >= (27 if name == "target" else 34)


def test_the_sound_is_that_of_the_recording(results: dict[str, Any]) -> None:
    started = results["plays the sound once the user has done something"]["value"]
    recording, blocks = decoded(RECORDING)[: round(3.9 * SAMPLE_RATE)], list[int]()
    expected = [recording[first : first + SAMPLE_RATE] for first in range(0, len(recording), SAMPLE_RATE)]
    due = 0
    for one in started:
        found = np.frombuffer(base64.b64decode(one["samples"]), "<f4").reshape(2, -1).T
        errors = [np.abs(found - each).max() if found.shape == each.shape else np.inf for each in expected]
        assert min(errors) < 0.005  # where groups change, too
        blocks.append(int(np.argmin(errors)))
        if one["offset"] == 0 and len(blocks) > 1:
            assert abs(one["at"] - due) < 1e-3 and blocks[-1] == (blocks[-2] + 1) % len(expected)
        else:  # it began with the clip
            began_s = blocks[-1] + one["offset"] / SAMPLE_RATE
            assert abs(began_s - one["currentTime"]) < 0.3
        due = one["at"] + len(found) - one["offset"]
    assert set(blocks) == set(range(len(expected)))
