"""Nothing of a dataset is silently misread: the order of poses, keys that matter, and what is left out."""

import json
import math
import re
import shutil
from pathlib import Path
from typing import Any

import numpy as np
import pytest

import datasets as make
from datasets import fails, load
from kpc.encoder.datasets.capture import natural_key
from kpc.encoder.datasets.layouts.transforms_keys import INFORMATION, READ, REFUSED, WITHOUT_EFFECT
from kpc.format.common.images import write_image
from kpc.format.scene.camera_models import COLMAP_NUMBERS, PARAMETERS

ENCODING = Path(__file__).resolve().parents[2] / "docs" / "encoding.md"
USABLE = np.indices((24, 32))[1] >= 12


def said(capsys: pytest.CaptureFixture[str]) -> str:
    """Return the one line on stderr."""
    (line,) = capsys.readouterr().err.splitlines()
    return line


def renumber(folder: Path, names: list[str]) -> None:
    """Rename the files of a folder, in order of their names."""
    for file, name in zip(sorted(folder.glob("*.[pm][np][g4]")), names, strict=True):
        file.rename(folder / name)


# Order


@pytest.mark.parametrize("by, word", [(None, "plain"), (natural_key, "natural")])
@pytest.mark.parametrize("first", [0, 1])
def test_rows_belong_to_unpadded_names_in_the_order_that_fits(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], by: Any, word: str, first: int
) -> None:
    """Whichever order wrote the rows, each picture keeps the pose that it was rendered from."""
    rig = make.write_llff(tmp_path / "set", images=12)
    names = [f"{first + k}.png" for k in range(12)]
    (tmp_path / "set/images/view10.png").rename(tmp_path / "set/images/view91.png")
    (tmp_path / "set/images/view11.png").rename(tmp_path / "set/images/view92.png")
    renumber(tmp_path / "set/images", names)
    rows = [names.index(name) for name in sorted(names, key=by)]
    np.save(tmp_path / "set/poses_bounds.npy", make.poses_bounds([rig[k] for k in rows]))
    p = load(tmp_path / "set").pictures
    assert len(p) == 12 and f"in the {word} order of names" in said(capsys)
    for file, pose in zip(p.file, p.camera_to_world, strict=True):
        np.testing.assert_allclose(pose, rig[names.index(Path(file).name)].camera_to_world, atol=1e-12)


def test_rows_that_were_sorted_without_regard_to_case(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    rig = make.write_llff(tmp_path / "set", images=9)
    names = [f"{'img' if k % 3 else 'IMG'}{k}.png" for k in range(9)]
    renumber(tmp_path / "set/images", names)
    p = load(tmp_path / "set").pictures
    assert "without regard to case, by which" in said(capsys)
    for file, pose in zip(p.file, p.camera_to_world, strict=True):
        np.testing.assert_allclose(pose, rig[names.index(Path(file).name)].camera_to_world, atol=1e-12)


def test_rows_of_unpadded_videos(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    """Too few of them to tell one order from the other are taken in LLFF's."""
    rig = make.write_n3dv(tmp_path / "set", cameras=3, frames=1)
    renumber(tmp_path / "set", ["cam0.mp4", "cam10.mp4", "cam9.mp4"])
    dataset = load(tmp_path / "set")
    assert dataset.camera_names == ("cam0", "cam10", "cam9")
    np.testing.assert_allclose(dataset.camera(1).camera_to_world, rig[1].camera_to_world, atol=1e-12)
    line = said(capsys)
    assert "plain" in line and "row 1 to cam10.mp4, not to cam9.mp4" in line and "rename the files" in line


def test_padded_names_need_no_decision(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    make.write_n3dv(tmp_path / "set", frames=1)
    load(tmp_path / "set")
    assert not capsys.readouterr().err


# Keys


def nerfstudio(folder: Path, change: Any = None, **document: Any) -> Path:
    """Write a nerfstudio dataset of ten images anew, and change its document."""
    shutil.rmtree(folder, ignore_errors=True)
    make.write_nerfstudio(folder, **document)
    if change:
        make.edit_json(folder / "transforms.json", change)
    return folder


def each(**keys: Any) -> Any:
    """Return a change that adds keys to every frame; in texts, {} is its number."""

    def change(document: dict[str, Any]) -> None:
        for number, frame in enumerate(document["frames"]):
            frame.update({k: v.format(f"{number:04d}") if isinstance(v, str) else v for k, v in keys.items()})

    return change


def without(*names: str, **added: Any) -> Any:
    """Return a change that removes keys of the document and adds others."""

    def change(document: dict[str, Any]) -> None:
        for name in names:
            del document[name]
        document.update(added)

    return change


@pytest.mark.parametrize("name", ["seg/{}.png", "./seg/{}", "seg\\{}.png"])
def test_mask_path_is_read(tmp_path: Path, name: str) -> None:
    folder = nerfstudio(tmp_path / "set", each(mask_path=name))
    for k in range(10):
        make.write_mask(folder / f"seg/{k:04d}.png", USABLE)
    dataset = load(folder)
    assert "masks (37.5% ignored)" in dataset.describe() and "left out" not in dataset.describe()
    np.testing.assert_array_equal(dataset.usable(3), USABLE)


def test_dynamic_masks_of_instant_ngp_mark_what_is_ignored(tmp_path: Path) -> None:
    folder = nerfstudio(tmp_path / "set")
    for k in range(10):
        make.write_mask(folder / f"images/dynamic_mask_{k:04d}.png", ~USABLE)
    dataset = load(folder)
    np.testing.assert_array_equal(dataset.usable(3), USABLE)
    assert dataset.left_out == 0


def test_masks_of_some_images_and_masks_that_contradict(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    folder = nerfstudio(tmp_path / "set", lambda d: d["frames"][3].update(mask_path="masks/0003.png"))
    fails(folder, "frame 3", "mask_path masks/0003.png", "copy it there")
    make.write_mask(folder / "masks/0003.png", USABLE)
    np.testing.assert_array_equal(load(folder).usable(3), USABLE)  # one mask, found in both ways
    assert "9 of 10 images have no mask" in said(capsys)
    make.write_mask(folder / "masks/0003.png.png", ~USABLE)
    fails(folder, "two masks", "remove one")
    (folder / "masks/0003.png.png").unlink()
    make.write_mask(folder / "images/dynamic_mask_0003.png", ~USABLE)
    fails(folder, "two masks", "remove one")
    fails(nerfstudio(folder, each(mask_path="../{}.png")), "leads out of")
    fails(nerfstudio(folder, each(mask_path=7)), "mask_path 7")


@pytest.mark.parametrize(
    "keys, fl_x, fl_y",
    [
        ({"camera_angle_x": 1.0, "camera_angle_y": 0.5}, 16 / math.tan(0.5), 12 / math.tan(0.25)),
        ({"camera_angle_y": 0.5}, 12 / math.tan(0.25), 12 / math.tan(0.25)),
        ({"fl_x": 30.0, "camera_angle_y": 0.5}, 30.0, 12 / math.tan(0.25)),
        ({"fl_y": 30.0}, 30.0, 30.0),
        ({"x_fov": 90.0, "y_fov": 60.0}, 16.0, 12 * math.sqrt(3)),
    ],
)
def test_focal_lengths_and_angles(tmp_path: Path, keys: dict[str, float], fl_x: float, fl_y: float) -> None:
    """As instant-ngp has them: each axis by itself, and one for both where the other is missing."""
    dataset = load(nerfstudio(tmp_path / "set", without("fl_x", "fl_y", **keys)))
    np.testing.assert_allclose(dataset.pictures.intrinsics[0, :2], [fl_x, fl_y])
    assert ("fl_y / fl_x" in dataset.describe()) == (fl_x != fl_y)


def test_angles_that_contradict_focal_lengths_are_named(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    """As Blender exports them: its vertical angle belongs to the sensor, not to the picture."""
    angles = {"camera_angle_x": 2 * math.atan(16 / 38.4), "camera_angle_y": 0.5}
    p = load(nerfstudio(tmp_path / "set", without(**angles))).pictures
    assert p.intrinsics[0, :2].tolist() == [38.4, 38.4]
    assert "fl_y is 38.4, but 46.9958 by camera_angle_y; fl_y is used" in said(capsys)
    # Pictures that were reduced after the calibration, without a word in the document.
    load(nerfstudio(tmp_path / "set", without("w", "h", "fl_y", "cx", "cy", fl_x=76.8, x_fov=45.2397)))
    assert "fl_x is 76.8, but 38.4 by x_fov" in said(capsys)


def test_a_frame_overrides_the_document_in_other_words(tmp_path: Path) -> None:
    def change(document: dict[str, Any]) -> None:
        document.update(k1=0.2, k2=0.1)
        document["frames"][1].update(camera_angle_x=1.0, k1=0.3)
        document["frames"][2].update(distortion_params=[0.05, 0, 0, 0, 0.01, 0.02], w=64, h=48)

    p = load(nerfstudio(tmp_path / "set", change)).pictures
    np.testing.assert_allclose(p.intrinsics[1], [16 / math.tan(0.5), 38.4, 16, 12])
    np.testing.assert_allclose(p.intrinsics[2], [19.2, 19.2, 8, 6])
    np.testing.assert_array_equal(p.distortion[:3, :4], [[0.2, 0.1, 0, 0], [0.3, 0.1, 0, 0], [0.05, 0, 0.01, 0.02]])


@pytest.mark.parametrize(
    "model", ["perspective", "PINHOLE", "simple_radial", "OPENCV", "FULL_OPENCV", "fisheye", "OPENCV_FISHEYE", None]
)
def test_understood_camera_models(tmp_path: Path, model: str | None) -> None:
    p = load(nerfstudio(tmp_path / "set", camera_model=model, k1=0.1, k3=0)).pictures
    assert len(p) == 10 and p.is_fisheye.all() == p.is_fisheye.any() == ("FISHEYE" in (model or "").upper())


def test_exports_of_polycam_and_record3d(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    """As nerfstudio converts them: each frame of Polycam has intrinsics of its own; those of Record3D share theirs."""
    lens = {"fl_x": 50.0, "fl_y": 49.0, "cx": 15.0, "cy": 12.5, "w": 32, "h": 24}
    folder = nerfstudio(tmp_path / "set", without(*lens, camera_model="OPENCV", orientation_override="none"))
    make.edit_json(folder / "transforms.json", each(**lens, depth_file_path="./depths/frame_{}.png"))
    np.testing.assert_array_equal(load(folder).pictures.intrinsics, [[50, 49, 15, 12.5]] * 10)
    assert "depth_file_path" in (line := said(capsys)) and "orientation_override" in line
    folder = nerfstudio(folder, each(file_path="images/{}.png"), camera_model="OPENCV")
    assert len(load(folder).pictures) == 10 and not capsys.readouterr().err


def test_fisheye_of_instant_ngp(tmp_path: Path) -> None:
    for keys in ({"is_fisheye": True}, {"is_fisheye": True, "camera_model": "OPENCV"}):
        p = load(nerfstudio(tmp_path / "set", **keys, distortion_params=[0.1, 0.01, 2e-3, 3e-3, 0, 0])).pictures
        assert p.is_fisheye.all() and p.distortion[0].tolist() == [0.1, 0.01, 0, 0, 2e-3, 3e-3, 0, 0]


@pytest.mark.parametrize(
    "keys, words",
    [
        ({"camera_model": "THIN_PRISM_FISHEYE"}, "THIN_PRISM_FISHEYE is not supported; undistort"),
        ({"camera_model": "VR180_L"}, "VR180_L is not supported"),
        ({"camera_name": [3]}, "camera_name is no text; correct it"),
        ({"camera_model": "a model of 2031"}, "a model of 2031 is not supported"),
        ({"camera_type": "fisheye", "p1": 0.1}, "p1 of a camera model that is a fisheye"),
        ({"is_fisheye": True, "camera_model": "PINHOLE"}, "is_fisheye contradicts camera model PINHOLE"),
        ({"latlong": True}, "latlong is not supported"),
        ({"ftheta_p1": 0.3}, "ftheta_p1 is not supported"),
        ({"from_na": True}, "from_na is not supported"),
        ({"distortion_params": [0, 0, 0, 0.1, 0, 0]}, "k4 of a camera model that is no FULL_OPENCV"),
        ({"distortion_params": [0.1]}, "distortion_params"),
        ({"k5": 0.1}, "k5 of a camera model that is no FULL_OPENCV"),
        ({"camera_angle_y": 0.0, "fl_y": None}, "fl_y"),
        ({"y_fov": 200}, "y_fov 200"),
        ({"h": None}, "h is missing"),
    ],
)
def test_what_is_not_understood_is_refused(tmp_path: Path, keys: dict[str, Any], words: str) -> None:
    """Once for the whole document, once for one frame."""
    removed = ["fl_y"] if "y_fov" in keys else []
    fails(nerfstudio(tmp_path / "set", without(*removed, **keys)), "transforms.json", words)
    fails(nerfstudio(tmp_path / "set", lambda d: d["frames"][1].update(keys)), "frame 1", words)


@pytest.mark.parametrize(
    "keys, words",
    [
        ({"lens": "Fish-Eye"}, "lens: Fish-Eye"),
        ({"distortion_model": "fisheye"}, "distortion_model: fisheye"),
        ({"vr180": True}, "vr180 is not supported"),
        ({"K1": 0.1}, "the key 'K1' is not read; write it k1"),
        ({" fl_x": 9.0}, "the key ' fl_x' is not read; write it fl_x"),
    ],
)
def test_unknown_keys_that_matter_are_refused(tmp_path: Path, keys: dict[str, Any], words: str) -> None:
    make.write_nerfstudio(tmp_path / "set", **keys)
    fails(tmp_path / "set", words)
    make.write_nerfstudio(tmp_path / "frames")
    make.edit_json(tmp_path / "frames/transforms.json", lambda d: d["frames"][3].update(keys))
    fails(tmp_path / "frames", "frame 3", words)


def test_more_that_is_refused(tmp_path: Path) -> None:
    folder = nerfstudio(tmp_path / "set", without("fl_x", "fl_y"))
    fails(folder, "fl_x is missing")
    fails(nerfstudio(folder, without("h")), "only one of w and h")
    folder = nerfstudio(folder)
    (folder / "images/rays_0002.dat").write_bytes(b"")
    fails(folder, "frame 2", "rays_0002.dat")
    make.edit_json(folder / "transforms.json", without(enable_ray_loading=False))
    assert len(load(folder).pictures) == 10
    text = (folder / "transforms.json").read_text()
    (folder / "transforms.json").write_text(text.replace('{"w"', '{"fl_x": 1, "w"'))
    fails(folder, "not JSON", "'fl_x' is there twice")


def test_two_frames_of_one_image_are_refused(tmp_path: Path) -> None:
    """Two poses of one picture contradict each other, and one of them would be held out, the other trained on."""
    folder = nerfstudio(tmp_path / "set", lambda d: d["frames"][7].update(file_path="images\\0003"))
    fails(folder, "frames 3 and 7 have the same image", "remove one")


def test_keys_without_effect_are_named_once(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    folder = nerfstudio(tmp_path / "set", each(colmap_im_id=1, depth_file_path="d", weather="fair"))
    make.edit_json(folder / "transforms.json", without(aabb_scale=16, applied_transform=[], ligth="on"))
    load(folder)
    assert said(capsys).split("effect: ")[1] == (
        "applied_transform (the poses already contain it); aabb_scale (the box follows from the cameras); "
        "depth_file_path (neither points nor depth pictures are used); ligth, weather (unknown)"
    )


def test_backslashes_no_suffix_and_absolute_paths(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    """Names mean the same file however they are written, in frames and in lists."""
    folder = nerfstudio(tmp_path / "set")

    def change(document: dict[str, Any]) -> None:
        frames = document["frames"]
        frames[0]["file_path"] = "images\\0000"
        frames[1]["file_path"] = str(folder / "images/0001.png")
        frames[2]["transform_matrix"] = frames[2]["transform_matrix"][:3]
        document["val_filenames"] = [str(folder / "images/0000"), ".\\images\\0001.png", "images/0002"]

    make.edit_json(folder / "transforms.json", change)
    p = load(folder).pictures
    assert p.file == tuple(f"images/{k:04d}.png" for k in range(10)) and not capsys.readouterr().err
    assert p.is_test.nonzero()[0].tolist() == [0, 1, 2]


NAMES = [f"images/{k:04d}.png" for k in range(10)]


@pytest.mark.parametrize(
    "train, val, test, held_out, left_out, words",
    [
        (NAMES[2:], NAMES[:2], [], [0, 1], [], None),
        (None, NAMES[:2], [], [0, 1], [], None),
        ([], [], [], [], [], None),
        (NAMES[3:], None, None, [0, 1, 2], [], None),
        (None, NAMES[:2], NAMES[2:4], [2, 3], [0, 1], "2 pictures are in val_filenames beside test_filenames and left"),
        (NAMES[3:8], NAMES[:2], NAMES[2:3], [2], [0, 1, 8, 9], "4 pictures are not in train_filenames nor test_file"),
        (NAMES[3:8], NAMES[:2], None, [0, 1], [2, 8, 9], "3 pictures are not in train_filenames nor val_filenames"),
        (NAMES, None, NAMES[:1], [0], [], "1 picture is in two of its lists and held out"),
        (None, None, ["images/0004.png", "gone.png"], [4], [], "1 name in test_filenames has no frame: gone.png"),
    ],
)
def test_lists_of_pictures(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], train: Any, val: Any, test: Any, held_out: list[int],
    left_out: list[int], words: str | None,
) -> None:  # fmt: skip
    folder = nerfstudio(tmp_path / "set", train_filenames=train, val_filenames=val, test_filenames=test)
    dataset = load(folder)
    names = [name for k, name in enumerate(NAMES) if k not in left_out]
    assert list(dataset.pictures.file) == names and dataset.left_out == len(left_out)
    assert [names[k] for k in dataset.pictures.is_test.nonzero()[0]] == [NAMES[k] for k in held_out]
    error = capsys.readouterr().err
    assert words in error and len(error.splitlines()) == 1 if words else not error
    assert len(load(folder, holdout="none").pictures) == 10


def test_a_list_of_other_names_is_refused(tmp_path: Path) -> None:
    folder = nerfstudio(tmp_path / "set", test_filenames=["0001.png", "0002.png"])
    fails(folder, "test_filenames names no frame (0001.png, 0002.png)")
    fails(nerfstudio(folder, val_filenames=["/elsewhere/0001.png"]), "leads out of")


def test_the_documented_keys_are_those_of_the_table() -> None:
    """docs/encoding.md names each key in the row of what becomes of it."""
    table = ENCODING.read_text().split("| what becomes of a key | keys |")[1].split("\n\n")[0].splitlines()[2:]
    read, without_effect, information, refused = (set(re.findall(r"`(\w+)`", row)) for row in table)
    assert (read, information) == (READ, INFORMATION)
    assert without_effect == {name for names in WITHOUT_EFFECT.values() for name in names}
    assert refused == {name for names in REFUSED.values() for name in names}


@pytest.mark.parametrize("number", [*(n for n, name in COLMAP_NUMBERS.items() if name not in PARAMETERS), 4711, -1])
def test_colmap_models_that_are_not_understood_are_named(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, number: int
) -> None:
    monkeypatch.setitem(make.COLMAP_MODELS, "OPENCV", number)
    make.write_colmap(tmp_path / "set", images=3, model="OPENCV", lens=(0,) * 5)
    fails(tmp_path / "set", f"camera model {COLMAP_NUMBERS.get(number, f'number {number}')} is not supported")


# What is left out


def rewrite_images(folder: Path, change: Any) -> None:
    """Replace the text of a model's images.txt."""
    file = folder / "sparse/0/images.txt"
    file.write_text(change(file.read_text()))


def test_images_txt_without_lines_of_points(tmp_path: Path) -> None:
    """Written by hand, with one line an image: all are read, also names that are numbers."""
    rig = make.write_colmap(tmp_path / "set", images=9, binary=False)
    rewrite_images(tmp_path / "set", lambda text: re.sub(r"\n(1.5 2.5 -1 ?)*(?=\n)", "", text).replace(".png", ""))
    assert len((tmp_path / "set/sparse/0/images.txt").read_text().splitlines()) == 1 + 9
    p = load(tmp_path / "set").pictures
    np.testing.assert_allclose(p.camera_to_world, [c.camera_to_world for c in rig], atol=1e-12)


def test_points_and_missing_points_may_mix(tmp_path: Path) -> None:
    """Points whose first x is an integer look like the beginning of an image, and are none."""
    make.write_colmap(tmp_path / "set", images=4, binary=False)
    lines = [line for line in (tmp_path / "set/sparse/0/images.txt").read_text().splitlines() if ".png" in line]
    points = ["7 1 2 0.5 3 4 1e-3 5 6 9.5 7 -1", "", None, "1 2 3"]
    text = "".join(f"{line}\n" + ("" if p is None else f"{p}\n") for line, p in zip(lines, points, strict=True))
    rewrite_images(tmp_path / "set", lambda _: text)
    assert len(load(tmp_path / "set").pictures) == 4
    rewrite_images(tmp_path / "set", lambda _: text.replace("1e-3", "one"))
    fails(tmp_path / "set", "images.txt", "not a COLMAP model")


def test_odd_names_and_files_of_rigs(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    make.write_colmap(tmp_path / "set", images=3, binary=False)
    for k in range(3):
        (tmp_path / f"set/images/cam {k}").mkdir()
        (tmp_path / f"set/images/{k:04d}.png").rename(tmp_path / f"set/images/cam {k}/früh (1).png")
    rewrite_images(tmp_path / "set", lambda text: re.sub(r"\d{3}(\d).png", r"cam \1/früh (1).png", text))
    for name in ("rigs.txt", "frames.txt"):
        (tmp_path / "set/sparse/0" / name).write_text("# empty\n")
    assert len(load(tmp_path / "set").pictures) == 3 and not capsys.readouterr().err


def test_the_largest_model_is_read_and_the_others_are_named(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    """What the model does not name is counted; hidden and system files are not."""
    rig = make.write_colmap(tmp_path / "set", images=8)
    posed = [(k, make.colmap_pose(c.camera_to_world), 1, f"{k:04d}.png", 2) for k, c in enumerate(rig)]
    camera = (1, "PINHOLE", 32, 24, (38.4, 38.4, 16, 12))
    make.write_colmap_model(tmp_path / "set/sparse/0", [camera], posed[:3])
    make.write_colmap_model(tmp_path / "set/sparse/1", [camera], posed[3:], binary=False)
    for name in ("._0001.png", "Thumbs.db", ".trash/0001.png", "notes.txt"):
        (tmp_path / "set/images" / name).parent.mkdir(exist_ok=True)
        (tmp_path / "set/images" / name).write_bytes(b"")
    dataset = load(tmp_path / "set")
    first, second = capsys.readouterr().err.splitlines()
    assert "sparse/1/images.txt (5)" in first and "left out: sparse/0/images.bin (3)" in first
    assert "3 of 8 files found" in second and "images/0000.png, images/0001.png, images/0002.png" in second
    assert "5 pictures of 32x24, 1 of them held out (0003), 3 files left out" in dataset.describe()


def test_missing_images_are_asked_for_where_they_are_looked_for(tmp_path: Path) -> None:
    """The remedy works when it is followed."""
    make.write_colmap(tmp_path / "set", images=3)
    (tmp_path / "set/images").rename(tmp_path / "pictures")
    fails(tmp_path / "set", f"copy them to {tmp_path / 'set' / 'images'}")
    shutil.copytree(tmp_path / "pictures", tmp_path / "set/images")
    assert len(load(tmp_path / "set").pictures) == 3


def test_other_videos_pictures_and_splits_are_counted(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    make.write_n3dv(tmp_path / "n3dv", frames=1)
    shutil.copy(tmp_path / "n3dv/cam00.mp4", tmp_path / "n3dv/making of.MP4")
    assert "1 of them held out (cam00), 1 file left out" in load(tmp_path / "n3dv").describe()
    assert "1 of 4 files found" in (line := said(capsys)) and "making of.MP4" in line

    make.write_nerfstudio(tmp_path / "nerfstudio", images=3)
    write_image(tmp_path / "nerfstudio/images/0007.png", make.picture(make.ring(1)[0]))
    assert "1 file left out" in load(tmp_path / "nerfstudio").describe() and "images/0007.png" in said(capsys)

    make.write_blender(tmp_path / "blender")
    assert "2 files left out" in load(tmp_path / "blender").describe()
    assert "transforms_val.json: 2 pictures are left out" in said(capsys)
    assert "left out" not in load(tmp_path / "blender", holdout="none").describe()


def test_a_second_layout_is_named(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    make.write_nerfstudio(tmp_path / "set", images=3)
    make.write_colmap_model(tmp_path / "set/sparse/0", [], [])
    assert load(tmp_path / "set").layout == "nerfstudio"
    assert "read as nerfstudio" in (line := said(capsys)) and "COLMAP" in line
    (tmp_path / "set/transforms.json").write_text(json.dumps({}))
    fails(tmp_path / "set", "no frames")
