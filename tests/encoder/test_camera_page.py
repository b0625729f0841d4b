"""The page that shows cameras."""

import re
from dataclasses import replace
from html.parser import HTMLParser
from pathlib import Path

import numpy as np
import pytest

import datasets as make
from kpc.encoder.evaluation.camera_page import Check, Curve, ShownCamera, write_camera_page, write_page_of_dataset

VOID = ("meta", "img")


class Reader(HTMLParser):
    """Reads a page: its text, pictures and drawings; every element must be closed."""

    def __init__(self, page: str) -> None:
        super().__init__()
        self.open: list[str] = []
        self.text = ""
        self.sources: list[str] = []
        self.drawn = ""
        self.feed(page)
        assert not self.open

    def handle_starttag(self, tag: str, attrs: list[tuple[str, str | None]]) -> None:
        values = dict(attrs)
        self.sources += [values["src"] or ""] if "src" in values else []
        self.drawn += " ".join(values.get(key) or "" for key in ("d", "points", "cx", "cy"))
        if tag not in VOID:
            self.open.append(tag)

    def handle_startendtag(self, tag: str, attrs: list[tuple[str, str | None]]) -> None:
        self.handle_starttag(tag, attrs)
        self.handle_endtag(tag)

    def handle_endtag(self, tag: str) -> None:
        assert self.open.pop() == tag

    def handle_data(self, data: str) -> None:
        self.text += data + "\n"


@pytest.fixture
def shown() -> list[ShownCamera]:
    """Two placed cameras and one that is not, with a name that would be an element."""
    lens, size, picture = (32.0, 32.0, 16.0, 12.0), (32, 24), np.full((24, 32, 3), 90, np.uint8)
    placed = [camera.camera_to_world for camera in make.ring(2)]
    return [
        ShownCamera("<b>left", placed[0], lens, size, ("1.00",), picture),
        ShownCamera("right", placed[1], lens, size, ("2.00",), picture),
        ShownCamera("lost", None, lens, size, ("not placed",)),
    ]


def test_everything_is_in_one_file(tmp_path: Path, shown: list[ShownCamera]) -> None:
    times = np.arange(9) / 30
    curves = [Curve("left", times, np.arange(9.0)), Curve("right", times + 0.1, np.zeros(9))]
    points = np.random.default_rng(0).standard_normal((5000, 3))
    file = tmp_path / "cameras.html"
    write_camera_page(file, "Cameras of <x>", ["a & b"], shown, ["error px"], points, curves)
    page = file.read_text()
    read = Reader(page)
    assert all(source.startswith("data:image/jpeg;base64,") for source in read.sources)
    assert len(read.sources) == 2
    assert "script" not in page and "url(" not in page
    for text in ("Cameras of <x>", "a & b", "<b>left", "not placed", "2.00"):
        assert text in read.text
    assert page.count("<polyline") == 2 and page.count("<circle") < 2 * 2600
    assert "nan" not in read.drawn and "inf" not in read.drawn


def test_epipolar_lines_are_drawn_on_pictures(tmp_path: Path, shown: list[ShownCamera]) -> None:
    check = Check((7.0, 9.5), np.array([[1.0, 2.0], [30.5, 20.0]]))
    write_camera_page(tmp_path / "cameras.html", "x", [], [replace(shown[0], checks=(check, check)), shown[1]])
    page = (tmp_path / "cameras.html").read_text()
    assert "Circles: points that were found." in Reader(page).text
    assert page.count('points="1.0,2.0 30.5,20.0"') == page.count('cx="7.0" cy="9.5"') == 2
    assert page.count('viewBox="0 0 32 24"') == 1


def test_a_dataset_is_shown(tmp_path: Path) -> None:
    make.write_nerfstudio(tmp_path / "set", 4)
    write_page_of_dataset(tmp_path / "cameras.html", make.load(tmp_path / "set"), ["a line"])
    read = Reader((tmp_path / "cameras.html").read_text())
    assert len(read.sources) == 4 and "0003" in read.text
    numbers = [float(number) for number in re.findall(r"-?\d+\.\d", read.drawn)]
    assert max(numbers) < 441 and min(numbers) > -1


def test_one_camera_is_shown(tmp_path: Path, shown: list[ShownCamera]) -> None:
    write_camera_page(tmp_path / "cameras.html", "one", [], shown[:1])
    assert "nan" not in Reader((tmp_path / "cameras.html").read_text()).drawn


def test_drawings_have_up_above(tmp_path: Path, shown: list[ShownCamera]) -> None:
    """Two cameras one above the other, which both look down, are at one place as seen from above."""
    sine, cosine = np.sin(np.radians(50)), np.cos(np.radians(50))
    pose = np.eye(4)
    pose[:3, :3] = [[1, 0, 0], [0, sine, -cosine], [0, cosine, sine]]
    above = pose + np.eye(4, k=1) * [[0], [0], [1], [0]]
    cameras = [replace(camera, pose=at) for camera, at in zip(shown, (pose, above), strict=False)]
    eyes = {}
    for name, up in (("known", np.array([0.0, 0.0, 1.0])), ("by the cameras", None)):
        write_camera_page(tmp_path / "cameras.html", "x", [], cameras, up=up)
        first = (tmp_path / "cameras.html").read_text().partition("From the side")[0]
        eyes[name] = re.findall(r'class="camera" d="M([\d.-]+ [\d.-]+)L', first)
    assert len(eyes["known"]) == 2 and len(set(eyes["known"])) == 1
    assert len(set(eyes["by the cameras"])) == 2
