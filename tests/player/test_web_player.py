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
from kpc.format.common.fidelity import psnr
from kpc.format.container import groups
from kpc.format.container.groups import GroupInput
from kpc.format.scene.cameras import Camera
from kpc.format.scene.rig import Rig
from kpc.format.scene.scene import Scene
from kpc.player.app.controls import OrbitView
from kpc.player.cpu.reference import render
from kpc.player.sharing.file_server import Handler, Link, serving
from kpc.player.viewpoints import presets
from kpc.tools.bench import web_page

SAMPLE = Path(__file__).parent.parent.parent / "samples" / "default.kpc"
SCRIPT = web_page.WEB / "tests" / "element_browser.mjs"
SCENARIOS = re.findall(r"^ *scenario\(['`](.+)['`], async", SCRIPT.read_text(encoding="utf-8"), re.MULTILINE)
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
        self.fault, _, rest = self.path.lstrip("/").rpartition("/")
        self.path, self.is_shared = f"/{rest}", self.fault != "refused"
        with self.lock:
            self.count = self.requests[self.fault] = self.requests.get(self.fault, 0) + 1
        if self.fault == "moved":
            self.send_response(HTTPStatus.FOUND)
            self.send_header("Location", self.path)
            self.send_header("Content-Length", "0")
            self.end_headers()
            return
        if self.fault == "replaced" and self.count > 1:
            self.path = "/other.kpc"
        if self.fault in ("whole", "packed"):
            del self.headers["Range"]
        # Browsers that ask for a range accept nothing compressed.
        if self.fault == "packed" and "gzip" in self.headers.get("Accept-Encoding", ""):
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


@pytest.fixture(scope="module")
def address(tmp_path_factory: pytest.TempPathFactory) -> Iterator[str]:
    """Serve the built player, scenes and files that are none."""
    folder = tmp_path_factory.mktemp("site")
    data = SAMPLE.read_bytes()
    for built in (web_page.WEB / "dist").glob("*.js"):
        (folder / built.name).write_bytes(built.read_bytes())
    (folder / "scene.kpc").write_bytes(data)
    for name, count in ("long.kpc", 3), ("other.kpc", 4):
        groups.write([GroupInput.of(data, 30 * number) for number in range(count)], folder / name)
    (folder / "text.kpc").write_text("<!doctype html><title>Not here</title>" * 9)
    (folder / "draft.kpc").write_bytes(data[:10] + bytes(2) + data[12:])
    (folder / "half.kpc").write_bytes(data[:40_000] + bytes(len(data) - 40_000))
    Image.new("RGB", (64, 48), (40, 90, 140)).save(folder / "poster.png")
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
    picture = np.asarray(Image.open(io.BytesIO(base64.b64decode(value["picture"]))).convert("RGB")) / 255
    scene = kpc.load(SAMPLE)
    assert isinstance(scene, Scene)
    opening = scene.metadata.opening
    assert opening is not None
    np.testing.assert_allclose(view_of(value["camera"]), numbers_of(scene, opening.camera), atol=2e-4)
    height, width = picture.shape[:2]
    wanted = render(scene, opening.camera.resized(width, height), 1.3 * 12 / 29).rgb.clip(0, 1)
    assert psnr(picture, wanted) >= 45
