"""Cameras with fisheye lenses are placed from their pictures alone; what is found of the lens is read back."""

import json
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from textured_room import aligned, looks, pose_at, rig, write_pictures, write_walk

pytest.importorskip("pycolmap", reason="needs pycolmap, of the extra poses")
pytest.importorskip("scipy", reason="needs scipy, of the extra poses")

from kpc.encoder.cli import kpposes
from kpc.encoder.datasets import load_dataset
from kpc.encoder.datasets.rays import pixel_rays

FOCAL = 120.0  # 122 degrees across, 153 degrees from corner to corner
CAMERAS = [replace(camera, focal=FOCAL, is_fisheye=True) for camera in rig(5)]


@pytest.fixture(scope="module")
def pictures(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A folder of pictures, and nothing else."""
    folder = tmp_path_factory.mktemp("fisheye") / "pictures"
    write_pictures(folder, CAMERAS)
    return folder


@pytest.fixture(scope="module")
def file(pictures: Path) -> Path:
    """What `kpposes` writes about it."""
    file = pictures / "transforms.json"
    assert kpposes.main([str(pictures), "-o", str(file)]) == 0
    return file


def test_all_are_placed_and_their_lens_is_found(file):
    frames = json.loads(file.read_text())["frames"]
    poses = np.array([frame["transform_matrix"] for frame in frames])
    centres, angle = aligned(poses, np.stack([camera.pose for camera in CAMERAS]))
    assert centres < 0.005 and angle < 0.2
    assert {frame["camera_model"] for frame in frames} == {"OPENCV_FISHEYE"}
    assert frames[0]["fl_x"] == pytest.approx(FOCAL, rel=0.01)


def test_other_readers_see_the_model_and_the_size(file):
    document = json.loads(file.read_text())
    assert document["camera_model"] == "OPENCV_FISHEYE"
    assert {(frame["w"], frame["h"]) for frame in document["frames"]} == {(256, 192)}


@pytest.mark.parametrize("kind, model", [("pinhole", "OPENCV"), ("fisheye", "OPENCV_FISHEYE")])
def test_the_user_says_of_what_kind_lenses_are(tmp_path, kind, model):
    write_pictures(tmp_path / "wide", [replace(camera, focal=200.0, is_fisheye=kind == "pinhole") for camera in rig(5)])
    assert kpposes.main([str(tmp_path / "wide"), "-o", str(tmp_path / "found.json"), "--lens", kind]) == 0
    frames = json.loads((tmp_path / "found.json").read_text())["frames"]
    assert {frame.get("camera_model", "OPENCV") for frame in frames} == {model}


@pytest.mark.parametrize("is_fisheye", [False, True])
def test_it_is_said_if_lenses_are_clearly_of_the_other_kind(tmp_path, capsys, is_fisheye):
    write_pictures(tmp_path / "wide", [replace(camera, is_fisheye=is_fisheye) for camera in CAMERAS])
    true, other = ("fisheye", "pinhole") if is_fisheye else ("pinhole", "fisheye")
    warning = f"warning: clearly more matches agree with a {true} than with a {other}; try again without --lens {other}"
    for given in (true, other):
        kpposes.main([str(tmp_path / "wide"), "-o", str(tmp_path / "found.json"), "--lens", given])
        assert (warning in capsys.readouterr().err) == (given == other)


def test_the_lens_of_a_carried_camera_is_found(tmp_path, capsys):
    places = [replace(CAMERAS[0], pose=pose_at(angle, 1.2 + 0.01 * angle)) for angle in np.linspace(-25, 25, 16)]
    write_walk(tmp_path / "walk" / "walk.mp4", places, 10.0)
    assert kpposes.main([str(tmp_path / "walk"), "-o", str(tmp_path / "walk.json"), "--rig", "moving"]) == 0
    said = capsys.readouterr().out
    assert "16 pictures" in said and "px, fisheye" in said
    frames = json.loads((tmp_path / "walk.json").read_text())["frames"]
    assert frames[0]["fl_x"] == pytest.approx(FOCAL, rel=0.03)
    centres, angle = aligned(np.array([f["transform_matrix"] for f in frames]), np.stack([one.pose for one in places]))
    assert centres < 0.01 and angle < 0.5


def test_rays_of_the_dataset_are_those_of_the_lens(file, tmp_path):
    dataset = load_dataset(file.parent, cache_dir=tmp_path)
    shown = dataset.pictures
    assert shown.is_fisheye.all()
    row, column = (axis.ravel() for axis in np.mgrid[: shown.height[0] : 16, : shown.width[0] : 16])
    _, found = pixel_rays(shown, np.zeros(len(row), int), column, row)
    true = looks(CAMERAS[0])[row, column] @ shown.camera_to_world[0][:3, :3].T
    assert np.degrees(np.arccos(np.clip((found * true).sum(1), -1, 1))).max() < 0.5


def test_the_page_shows_epipolar_lines_of_such_lenses(file):
    page = (file.parent / "cameras.html").read_text()
    assert page.count("<img") == len(CAMERAS)
    assert page.count('<polyline class="check"') == page.count('<circle class="check"') > 0
