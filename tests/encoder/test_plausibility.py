"""A dataset that is not what it seems is doubted in one line; a good one is not."""

import json
import shutil
from pathlib import Path

import numpy as np
import pytest
from PIL import Image

import datasets as make
from datasets import load
from kpc.encoder.datasets.plausibility import doubts
from kpc.format.common.images import write_image


def lines_of(folder: Path, **options: object) -> list[str]:
    """Return the doubts about a dataset, each of which must be one printable line."""
    found = list(doubts(load(folder, **options)))
    assert all(line.isprintable() for line in found)
    return found


def images_of(folder: Path) -> list[Path]:
    return sorted((folder / "images").iterdir())


def test_good_data_raises_no_doubt(tmp_path: Path) -> None:
    writers = [make.write_n3dv, make.write_llff, make.write_nerfstudio, make.write_colmap]
    for number, write in enumerate(writers):
        write(tmp_path / f"{number}")
        assert lines_of(tmp_path / f"{number}") == []


@pytest.mark.parametrize("value", [0, 128, 255])
def test_pictures_of_one_colour(tmp_path: Path, value: int) -> None:
    make.write_nerfstudio(tmp_path / "set")
    for file in images_of(tmp_path / "set"):
        write_image(file, np.full((24, 32, 3), value, np.uint8))
    (line,) = lines_of(tmp_path / "set")
    assert "all pictures" in line and "one colour" in line


def test_a_small_thing_before_one_colour_is_no_flat_picture(tmp_path: Path) -> None:
    make.write_nerfstudio(tmp_path / "set")
    pixels = np.full((24, 32, 3), 9, np.uint8)
    for number, file in enumerate(images_of(tmp_path / "set")):
        pixels[1, number] = 200  # between the rows that are looked at
        write_image(file, pixels)
    assert lines_of(tmp_path / "set") == []


def test_some_black_pictures(tmp_path: Path) -> None:
    make.write_nerfstudio(tmp_path / "set")
    for file in images_of(tmp_path / "set")[3:5]:
        write_image(file, np.zeros((24, 32, 3), np.uint8))
    (line,) = lines_of(tmp_path / "set")
    assert "2 of 10" in line and "0003.png" in line and "0004.png" in line


def test_pictures_that_are_transparent(tmp_path: Path) -> None:
    make.write_blender(tmp_path / "set")
    for file in (tmp_path / "set").glob("*/*.png"):
        write_image(file, np.zeros((20, 20, 4), np.uint8))
    line, *others = lines_of(tmp_path / "set")
    assert "all pictures" in line and "transparent" in line
    assert len(others) == 1 and "same pose" in others[0]  # this set tests where it trains


def test_a_test_split_that_is_the_training_split(tmp_path: Path) -> None:
    make.write_blender(tmp_path / "set")
    shutil.copy(tmp_path / "set" / "transforms_train.json", tmp_path / "set" / "transforms_test.json")
    line, _ = lines_of(tmp_path / "set")
    assert "5 of 5 test pictures" in line


def test_cameras_that_show_the_same(tmp_path: Path) -> None:
    make.write_n3dv(tmp_path / "set", cameras=4)
    shutil.copy(tmp_path / "set" / "cam01.mp4", tmp_path / "set" / "cam02.mp4")
    (line,) = lines_of(tmp_path / "set")
    assert "cam01 and cam02" in line
    (line,) = lines_of(tmp_path / "set", holdout="cam02")
    assert "4 of 4 test pictures" in line and "cam02.mp4" in line


def test_a_test_picture_that_is_trained_on(tmp_path: Path) -> None:
    make.write_nerfstudio(tmp_path / "set")
    files = images_of(tmp_path / "set")
    shutil.copy(files[2], files[8])
    (line,) = lines_of(tmp_path / "set")
    assert "1 of 2 test pictures" in line and "0008.png" in line


def test_cameras_that_coincide(tmp_path: Path) -> None:
    make.write_nerfstudio(tmp_path / "set")

    def repeat(document: dict) -> None:
        document["frames"][5]["transform_matrix"] = document["frames"][4]["transform_matrix"]

    make.edit_json(tmp_path / "set" / "transforms.json", repeat)
    (line,) = lines_of(tmp_path / "set")
    assert "same pose" in line and "0004.png" in line


def test_principal_points_and_depths(tmp_path: Path) -> None:
    make.write_nerfstudio(tmp_path / "set", cx=-40.0)
    make.edit_json(tmp_path / "set" / "transforms.json", lambda d: d["frames"][1].update(near=1.0, far=9.0))
    outside, some = lines_of(tmp_path / "set")
    assert "principal point lies outside of 10 pictures" in outside and "1 of 10 pictures only" in some
    document = json.loads((tmp_path / "set" / "transforms.json").read_text())
    assert document["frames"][1]["near"] == 1.0


def test_a_picture_that_was_encoded_twice(tmp_path: Path) -> None:
    make.write_nerfstudio(tmp_path / "set")
    files = images_of(tmp_path / "set")
    for number, file in enumerate(files):
        noise = np.random.default_rng(9 if number == 1 else number).integers(0, 256, (8, 8, 3), np.uint8)
        write_image(file, np.kron(noise, np.ones((3, 4, 1), np.uint8)))
    Image.open(files[9]).save(files[1], "JPEG", quality=95, subsampling=0)
    (line,) = lines_of(tmp_path / "set")
    assert "0001 and 0009" in line and "nearly the same picture" in line


def test_pictures_of_a_camera_that_fills_12_of_16_bits(tmp_path: Path) -> None:
    make.write_nerfstudio(tmp_path / "set")
    for number, file in enumerate(images_of(tmp_path / "set")):
        values = np.random.default_rng(number).integers(0, 1 << 12, (24, 32)).astype(np.uint16)
        Image.fromarray(values).save(file)
    (line,) = lines_of(tmp_path / "set")
    assert "nearly black: no value exceeds 15 of 255" in line


def test_one_end_of_the_depth_range(tmp_path: Path) -> None:
    make.write_nerfstudio(tmp_path / "set", near=1.0)
    (line,) = lines_of(tmp_path / "set")
    assert "near and far are known for 0 of 10 pictures" in line
