"""The files of other programs describe one and the same rig, and what they describe badly is refused in one line."""

import json
from pathlib import Path
from typing import Any

import numpy as np
import pytest

import datasets as make
import rigs
from datasets import fails, load, write_mask
from kpc.encoder.datasets import Dataset, pixel_rays
from kpc.encoder.datasets.capture import fits
from rigs import CAMERAS, HEIGHT, POINTS, WIDTH, WRITERS

# Pixels by which rays may miss the points: float32 at a focal length of 48 and a distance of 3.
MISSED = 0.01


def missed(dataset: Dataset, number: int, camera: int, fisheye: bool) -> float:
    """Return how far rays through the projected points of a camera miss the points at most, in pixels of a picture."""
    column, row, depth = rigs.projected(CAMERAS[camera], fisheye)
    origins, directions = pixel_rays(dataset.pictures, np.full(len(POINTS), number), column, row)
    points, scale = (POINTS, 1.0)
    if dataset.layout == "Nerfies":
        points, scale = (POINTS - rigs.CENTRE) * rigs.SCALE, rigs.SCALE
    along = ((points - origins) * directions).sum(1, keepdims=True)
    assert (along > 0).all()
    return float((np.linalg.norm(origins + along * directions - points, axis=1) / (depth * scale)).max() * rigs.K[0, 0])


@pytest.mark.parametrize("layout", WRITERS)
def test_every_layout_gives_the_rig(tmp_path: Path, layout: str, capsys: pytest.CaptureFixture[str]) -> None:
    write, name, fisheye = WRITERS[layout]
    write(tmp_path / "set")
    dataset = load(tmp_path / "set")
    p = dataset.pictures
    assert dataset.layout == name and dataset.left_out == 0 and p.is_fisheye.tolist() == [fisheye] * len(p)
    frames = len(p) // 3
    assert len(p) == 3 * frames and dataset.clip.frame_count == (3 if layout == "nerfies" else frames)
    for camera in range(3):
        for n in range(camera * frames, (camera + 1) * frames):
            assert (p.width[n], p.height[n]) == (WIDTH, HEIGHT)
            assert missed(dataset, n, camera, fisheye) < MISSED
    assert all(line.isprintable() for line in capsys.readouterr().err.splitlines())


def test_times_names_and_held_out_cameras(tmp_path: Path) -> None:
    rigs.write_easymocap(tmp_path / "set")
    dataset = load(tmp_path / "set")
    assert dataset.camera_names == ("00", "01", "010") and dataset.pictures.time.tolist() == [0, 1] * 3
    assert "6 pictures of 40x30, 2 of them held out (00), dynamic, 2 frames" in dataset.describe()
    assert load(tmp_path / "set", holdout="010").pictures.is_test.tolist() == [False] * 4 + [True] * 2
    assert not load(tmp_path / "set", holdout="none").pictures.is_test.any()
    fails(tmp_path / "set", "no file or folder is named 'x'", holdout="x")
    rigs.write_nerfies(tmp_path / "nerfies")
    p = load(tmp_path / "nerfies").pictures
    assert p.time.tolist() == [0, 0.5, 1] and p.is_test.tolist() == [False, False, True]
    assert p.near.tolist() == [np.float32(0.1)] * 3 and load(tmp_path / "nerfies").clip.fps == 15
    assert load(tmp_path / "nerfies", holdout="left1_000000").pictures.is_test.tolist() == [True, False, False]
    rigs.write_caliscope(tmp_path / "caliscope")
    assert load(tmp_path / "caliscope", holdout="1").pictures.is_test.tolist() == [
        False,
        False,
        True,
        True,
        False,
        False,
    ]


def test_videos_of_one_name_in_the_folders_of_their_cameras(tmp_path: Path) -> None:
    rigs.write_opencv_json(tmp_path / "set")
    rigs.write_videos(tmp_path / "set/videos", ["cam0", "cam1", "cam2"])
    for k in range(3):
        (tmp_path / f"set/cam{k}.png").unlink()
        (tmp_path / f"set/videos/cam{k}").mkdir()
        (tmp_path / f"set/videos/cam{k}.mp4").rename(tmp_path / f"set/videos/cam{k}/video.mp4")
    p = load(tmp_path / "set", holdout="cam1").pictures
    assert p.file == tuple(f"videos/cam{k}/video.mp4" for k in (0, 0, 1, 1, 2, 2))
    assert p.is_test.tolist() == [False, False, True, True, False, False]


def test_masks_of_easymocap_are_alpha(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    """Elsewhere what a mask leaves out is not trained on; here it is the background, which is known to be nothing."""
    rigs.write_easymocap(tmp_path / "set")
    shown = np.indices((HEIGHT, WIDTH))[1] >= 12
    for name in ("00", "01", "010"):
        for n in range(2):
            write_mask(tmp_path / f"set/masks/{name}/{n:06d}.png", shown)
    dataset = load(tmp_path / "set")
    assert dataset.has_alpha and dataset.masks is None and dataset.left_out == 0
    np.testing.assert_array_equal(dataset.pixels.picture(3)[..., 3], 255 * shown)
    assert "masks of the foreground" in capsys.readouterr().err
    (tmp_path / "set/masks/01/000001.png").unlink()
    assert load(tmp_path / "set").pixels.picture(3)[..., 3].min() == 255
    assert "1 of 6 pictures has none: 000001.png" in capsys.readouterr().err
    write_mask(tmp_path / "set/masks/01/000001.png", shown[:-1])
    fails(tmp_path / "set", "is 40x29, but its picture is 40x30")


def test_what_is_there_twice_is_said(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    """Videos beside images, a second calibration, and cameras and pictures that belong to none."""
    rigs.write_easymocap(tmp_path / "set", n_00="0.1", bounds_00=np.eye(3), rdist_00=np.zeros(4))
    rigs.write_videos(tmp_path / "set/videos", ["00", "01", "11"])
    rigs.write_easymocap(tmp_path / "set/optimized")
    (tmp_path / "set/videos/making of.mp4").write_bytes((tmp_path / "set/videos/00.mp4").read_bytes())
    dataset = load(tmp_path / "set")
    printed = capsys.readouterr().err
    assert "optimized/intri.yml is not" in printed and "without effect: n, bounds" in printed
    assert "images in images are read; left out: videos in videos" in printed  # three cameras, not two
    for k in range(3):
        (tmp_path / f"set/images/{('00', '01', '010')[k]}").rename(tmp_path / f"old{k}")
    dataset = load(tmp_path / "set", holdout="none")
    printed = capsys.readouterr().err
    assert "1 of 3 cameras has no video or images and is left out: 010" in printed
    assert "2 of 4 files found belong to no camera" in printed and "videos/11.mp4, videos/making of.mp4" in printed
    assert dataset.camera_names == ("00", "01")


def test_two_layouts_in_one_folder_are_named(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    rigs.write_easymocap(tmp_path / "set")
    rigs.write_panoptic(tmp_path / "set")
    assert load(tmp_path / "set").layout == "EasyMocap"
    assert "read as EasyMocap; what is there in the layout of Panoptic Studio is not" in capsys.readouterr().err


@pytest.mark.parametrize("size", [(WIDTH, HEIGHT), (2 * WIDTH, 2 * HEIGHT), (3 * WIDTH, 3 * HEIGHT)])
def test_calibrations_of_another_raster_are_scaled(tmp_path: Path, size: tuple[int, int]) -> None:
    """About the picture's corner, not the centre of its first pixel."""
    rigs.write_easymocap(tmp_path / "set")
    factor = size[0] / WIDTH
    scaled = factor * rigs.K + (factor - 1) / 2 * np.array([[0, 0, 1], [0, 0, 1], [0, 0, 0]])
    scaled[2, 2] = 1
    values = {
        f"{key}_{n}": v for n in ("00", "01", "010") for key, v in (("K", scaled), ("W", size[0]), ("H", size[1]))
    }
    text = (tmp_path / "set/intri.yml").read_text().split("K_00")[0]
    values |= {f"D_{n}": np.array(rigs.DIST) for n in ("00", "01", "010")}
    (tmp_path / "set/intri.yml").write_text(text + rigs.opencv_yaml(values).split("---")[1])
    assert max(missed(load(tmp_path / "set"), n, n // 2, False) for n in range(6)) < MISSED


@pytest.mark.parametrize(
    "declared, actual, expected",
    [
        ((1920, 1088), (1920, 1080), False),  # the coded rows of H.264, of which 8 are cropped
        ((1080, 1920), (1088, 1920), False),
        ((1088, 1934), (1080, 1920), True),  # 1919.8 rows
        ((4946, 3286), (1237, 822), True),  # a quarter, rounded up
        ((640, 480), (480, 640), False),
    ],
)
def test_rounding_of_sizes(declared: tuple[float, float], actual: tuple[int, int], expected: bool) -> None:
    assert fits(declared, actual) == expected


def test_another_aspect_ratio_is_refused(tmp_path: Path) -> None:
    """Coded pictures of 1088 rows are cropped to 1080, not scaled."""
    rigs.write_easymocap(tmp_path / "set", W_00=1920, H_00=1096)
    fails(tmp_path / "set", "is 40x30", "camera 00 is for 1920x1096, another aspect ratio")


BAD_YAML: list[tuple[str, str, str, str]] = [
    ("intri.yml", "K_01:", "K_xx:", "camera 01: K is missing"),
    ("intri.yml", "48, 0, 20", "48, 9, 20", "K is not fx 0 cx"),
    ("intri.yml", "48, 0, 20", ".Nan, 0, 20", "K holds .Nan, which is no number"),
    ("intri.yml", "48, 0, 20", "48, 20", "K holds 8 numbers, not 9"),
    ("intri.yml", "data: [48", "data: &a [*a, 48", "not YAML"),
    ("intri.yml", '"00"', '"../x"', "camera ../x: t is missing"),
    ("intri.yml", '  - "010"', '  - "01"', "names a camera twice"),
    ("intri.yml", "K_01:", "K_00:", "the key 'K_00' is there twice"),
    ("intri.yml", "---", "--- [", "not YAML"),
    ("extri.yml", "T_010:", "T_01:", "'T_01' is there twice"),
    ("extri.yml", "rows: 3", "rows: [", "not YAML"),
    ("extri.yml", "names", "\x00", "not YAML"),
    ("intri.yml", "%YAML:1.0", "[" * 5000, "nested too deeply"),
    ("extri.yml", "", "- a list", "holds no cameras"),
    ("extri.yml", "", "# a very long comment\n" * 30000, "larger than 512 KiB"),
]


@pytest.mark.parametrize("file, old, new, words", BAD_YAML)
def test_malformed_documents_of_easymocap(tmp_path: Path, file: str, old: str, new: str, words: str) -> None:
    rigs.write_easymocap(tmp_path / "set", frames=1)
    with (tmp_path / "set" / file).open(newline="") as opened:
        text = opened.read()
    assert old in text
    (tmp_path / "set" / file).write_text(text.replace(old, new, 1) if old else new)
    fails(tmp_path / "set", words)


def edited(folder: Path, layout: str, file: str, change: Any) -> Path:
    """Write a layout, and change its JSON document in place, or a text by (old, new)."""
    WRITERS[layout][0](folder)
    text = (folder / file).read_text()
    if isinstance(change, tuple):
        assert change[0] in text
        (folder / file).write_text(text.replace(*change))
    else:
        document = json.loads(text)
        change(document)
        (folder / file).write_text(json.dumps(document))
    return folder


@pytest.mark.parametrize(
    "layout, file, change, words",
    [
        ("panoptic", "calibration_dance.json", lambda d: d.update(cameras={"distCoef": 1}), "lists no cameras"),
        ("panoptic", "calibration_dance.json", lambda d: d["cameras"][1].pop("t"), "camera 1: t is missing"),
        ("panoptic", "calibration_dance.json", lambda d: d["cameras"][1].update(name="00_01"), "no name of its own"),
        ("panoptic", "calibration_dance.json", lambda d: d["cameras"][1].update(R=[2, 0, 0] * 3), "scaled"),
        ("caliscope", "camera_array.toml", ("[cameras.0]", "[cameras.1]"), "not TOML"),
        ("caliscope", "camera_array.toml", ("fisheye = false", 'fisheye = "no"'), "neither true nor false"),
        ("caliscope", "camera_array.toml", ("fisheye = false", "fisheye = true"), "dist holds 5 numbers, not 0 or 4"),
        ("caliscope", "camera_array.toml", ("rotation", "rotated"), "no camera has a pose"),
        ("anipose", "calibration/calibration.toml", ('"B"', '"A"'), "no name of its own"),
        ("anipose", "calibration/calibration.toml", ("fisheye", "offset = [4, 0]\nfisheye"), "offset of a crop"),
        ("qualisys", "room.qca.txt", ("<calibration>", '<!DOCTYPE a [<!ENTITY b "c">]><calibration>'), "document type"),
        ("qualisys", "room.qca.txt", ("</cameras>", ""), "not XML"),
        ("qualisys", "room.qca.txt", ("<transform", "<transforms"), "camera 21000: has no transform"),
        ("qualisys", "room.qca.txt", ('skew="0"', 'skew="1"'), "skew"),
        ("qualisys", "room.qca.txt", ('"21001"', '"21000"'), "no serial number of its own"),
        ("opencv-json", "cameras.json", lambda d: d["cameras"]["cam1"].update(rvec=[0, 0, 0]), "two rotations that"),
        ("opencv-json", "cameras.json", lambda d: d["cameras"]["cam1"].update(K=[0]), "two values of K"),
        ("opencv-json", "cameras.json", lambda d: d["cameras"]["cam1"].update(dist_coeffs=[1e-3] * 12), "thin prism"),
        ("opencv-yaml", "calib/left1.yml", ("width: 40", "width: 4e300"), "beyond"),
        ("nerfies", "dataset.json", lambda d: d.update(train_ids=["../x"]), "leads out of the folder"),
        ("nerfies", "dataset.json", lambda d: d.update(train_ids=[], val_ids=[]), "list nothing"),
        ("nerfies", "metadata.json", lambda d: d["left1_000001"].pop("warp_id"), "no warp_id"),
        ("nerfies", "scene.json", lambda d: d.update(scale=0), "scale 0 is not positive"),
        ("nerfies", "camera/left1_000001.json", lambda d: d.update(skew=1), "skew"),
        ("nerfies", "camera/left1_000001.json", lambda d: d.pop("image_size"), "image_size is missing"),
    ],
)  # fmt: skip
def test_malformed_documents(tmp_path: Path, layout: str, file: str, change: Any, words: str) -> None:
    fails(edited(tmp_path / "set", layout, file, change), Path(file).name.split(".")[0], words)


def test_which_file_is_whose_is_never_guessed(tmp_path: Path) -> None:
    rigs.write_opencv_json(tmp_path / "set")
    (tmp_path / "set/cam1.png").rename(tmp_path / "set/other.png")
    (tmp_path / "set/cam0.png").rename(tmp_path / "set/walk-cam0.png")
    (tmp_path / "set/cam2.png").rename(tmp_path / "set/walk-cam02.png")
    (tmp_path / "set/walk-cam00.png").write_bytes((tmp_path / "set/walk-cam0.png").read_bytes())
    fails(tmp_path / "set", "camera cam0 may have filmed walk-cam0.png and walk-cam00.png")
    for file in list((tmp_path / "set").glob("*cam*.png")):
        file.unlink()
    (tmp_path / "set/videos").mkdir()
    (tmp_path / "set/videos/walk.mp4").write_bytes(b"")
    fails(tmp_path / "set", "none of its 3 cameras (cam0, cam1, cam2) has a video or images in videos/")


def test_folders_of_no_camera_are_named(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    """What is not read is no reason to refuse what is, however its files are called."""
    rigs.write_opencv_json(tmp_path / "set")
    rigs.write_images(tmp_path / "set/extra", ["cam0", "cam00", "cam2"])
    rigs.write_images(tmp_path / "set/images", ["cam0", "cam00", "cam2"])
    rigs.write_videos(tmp_path / "set/videos", ["one", "two", "three"])
    assert load(tmp_path / "set").pictures.file == ("cam0.png", "cam1.png", "cam2.png")
    line = capsys.readouterr().err
    assert "images in the folder itself are read; left out: videos in videos, " in line and ", extra" in line


def test_instants_go_by_numbers_else_by_order(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    """Numbers of frames count; times of day, as in names of ZJU-MoCap, do not."""
    rigs.write_easymocap(tmp_path / "set", frames=4)
    (tmp_path / "set/images/01/000002.png").unlink()
    p = load(tmp_path / "set").pictures
    np.testing.assert_allclose(p.time[4:7], [0, 1 / 3, 1])
    for name in ("00", "01", "010"):
        for n, ms in enumerate((592, 632, 20, 60)):
            if (file := tmp_path / f"set/images/{name}/00000{n}.png").exists():
                file.rename(file.with_name(f"Camera_{n}_2019-08-23_16-08-{50 + n // 2}.{ms:03d}.png"))
    fails(tmp_path / "set", "01 has 3 images, 00 4", "name the images by their instants")
    (tmp_path / "set/images/00/Camera_2_2019-08-23_16-08-51.020.png").unlink()
    (tmp_path / "set/images/010/Camera_2_2019-08-23_16-08-51.020.png").unlink()
    capsys.readouterr()
    assert load(tmp_path / "set").pictures.time.tolist() == [0, 0.5, 1] * 3
    assert "do not number the instants, so that their order does" in capsys.readouterr().err


def test_a_calibration_without_a_size_is_doubted(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    """One for pictures of twice the size puts the principal point into a corner."""
    rigs.write_opencv_json(tmp_path / "set")

    def double(document: Any) -> None:
        for camera in document["cameras"].values():
            del camera["image_size"]
            camera["camera_matrix"] = (2 * np.array(camera["camera_matrix"]) - np.diag([0, 0, 1])).tolist()

    make.edit_json(tmp_path / "set/cameras.json", double)
    (tmp_path / "set/cameras.json").rename(tmp_path / "set/calibration.json")
    load(tmp_path / "set")
    assert "the principal point of cam0 lies at 103% of the width and 94% of the height" in capsys.readouterr().err


def test_several_recordings_are_refused(tmp_path: Path) -> None:
    rigs.write_caliscope(tmp_path / "set")
    rigs.write_videos(tmp_path / "set/recordings/run", ["cam_0", "cam_1", "cam_2"])
    fails(tmp_path / "set", "has 2 recordings (run, walk)", "copy camera_array.toml")
