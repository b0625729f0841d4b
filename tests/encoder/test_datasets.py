"""Every dataset layout is recognised and read correctly; every fault is reported in one line."""

import errno
import os
import random
import shutil
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from PIL import Image

import datasets as make
from datasets import fails, load
from kpc.encoder.datasets import load_dataset
from kpc.encoder.datasets.capture import natural_key
from kpc.encoder.datasets.decoded_pictures import downscale_picture
from kpc.format.common.films import write_video
from kpc.format.common.images import write_image

DATA = Path(__file__).resolve().parents[3] / "shared" / "data"


def test_n3dv(tmp_path: Path) -> None:
    rig = make.write_n3dv(tmp_path / "set")
    dataset = load(tmp_path / "set")
    p = dataset.pictures
    assert (dataset.layout, dataset.is_dynamic, dataset.has_alpha, len(p)) == ("N3DV", True, False, 12)
    assert (dataset.clip.frame_count, dataset.clip.fps) == (4, make.FPS)
    assert dataset.camera_names == ("cam00", "cam01", "cam02")
    np.testing.assert_allclose(p.time, np.tile([0, 1 / 3, 2 / 3, 1], 3), atol=1e-7)
    np.testing.assert_array_equal(p.is_test, [True] * 4 + [False] * 8)
    assert (p.near == 1).all() and (p.far == 6).all()
    for n in range(len(p)):
        camera, found = rig[p.camera[n]], dataset.camera(n)
        np.testing.assert_allclose(found.camera_to_world, camera.camera_to_world, atol=1e-12)
        assert (found.fl_x, found.fl_y, found.cx, found.cy) == (camera.fl_x, camera.fl_y, camera.cx, camera.cy)
        error = dataset.pixels.picture(n).astype(float) - make.picture(camera, float(p.time[n]))
        assert np.abs(error).mean() < 2  # crf 1, plus half a step of each of Y, Cb and Cr
    description = dataset.describe()
    for words in ("N3DV", "3 cameras", "12 pictures of 32x24", "cam00", "dynamic, 4 frames at 8 fps"):
        assert words in description


@pytest.mark.parametrize(
    "holdout, tests", [(None, {"cam00"}), ("none", set()), ("cam02", {"cam02"}), ("cam01.mp4", {"cam01"})]
)
def test_holdout_of_videos(tmp_path: Path, holdout: str | None, tests: set[str]) -> None:
    make.write_n3dv(tmp_path / "set")
    dataset = load(tmp_path / "set", holdout=holdout)
    p = dataset.pictures
    assert {dataset.camera_names[c] for c in p.camera[p.is_test]} == tests
    fails(tmp_path / "set", "cam07", "cam00, cam01", holdout="cam07")


def test_videos_of_one_frame_are_a_static_scene(tmp_path: Path) -> None:
    make.write_n3dv(tmp_path / "set", frames=1)
    dataset = load(tmp_path / "set")
    assert not dataset.is_dynamic and dataset.clip.duration_s == 0 and (dataset.pictures.time == 0).all()
    assert "static" in dataset.describe()


def test_natural_order() -> None:
    names = ["", "2", "10", "a", "a0", "a1", "a01b", "a2", "a10", "a10b2", "a10b10", "a" + "9" * 5000, "b", "x\u00b21"]
    shuffled = random.Random(0).sample(names, len(names))
    assert sorted(shuffled, key=natural_key) == names


def test_llff_images(tmp_path: Path) -> None:
    make.write_llff(tmp_path / "set")
    dataset = load(tmp_path / "set")
    assert (dataset.layout, dataset.is_dynamic) == ("LLFF", False)
    np.testing.assert_array_equal(np.flatnonzero(dataset.pictures.is_test), [0, 8])
    assert load(tmp_path / "set", holdout="view3").pictures.is_test.tolist() == [k == 3 for k in range(9)]


def test_blender(tmp_path: Path) -> None:
    make.write_blender(tmp_path / "set")
    dataset = load(tmp_path / "set")
    p = dataset.pictures
    assert (dataset.layout, dataset.is_dynamic, dataset.has_alpha, len(p)) == ("Blender", True, True, 8)
    assert dataset.clip.frame_count == 5
    np.testing.assert_array_equal(p.is_test, [False] * 5 + [True] * 3)
    np.testing.assert_allclose(p.time, [0, 0.25, 0.5, 0.75, 1, 0, 0.5, 1])
    camera = make.ring(5, width=20, height=20)[1]
    np.testing.assert_array_equal(dataset.pixels.picture(1), make.picture(camera, 0.25, alpha=True))
    assert dataset.camera(1).fl_x == pytest.approx(camera.fl_x)
    assert len(load(tmp_path / "set", holdout="none").pictures) == 10  # the val split, too, is trained on


def test_blender_static_without_alpha(tmp_path: Path) -> None:
    make.write_blender(tmp_path / "set", dynamic=False, alpha=False)
    dataset = load(tmp_path / "set")
    assert not dataset.is_dynamic and not dataset.has_alpha and dataset.pixels.picture(0).shape == (20, 20, 3)


def test_fully_opaque_alpha_is_dropped(tmp_path: Path) -> None:
    rig = make.write_nerfstudio(tmp_path / "set")
    for k, camera in enumerate(rig):
        opaque = np.concatenate([make.picture(camera), np.full((24, 32, 1), 255, np.uint8)], axis=2)
        write_image(tmp_path / "set" / "images" / f"{k:04d}.png", opaque)
    for _ in range(2):  # built, then opened
        dataset = load(tmp_path / "set")
        assert not dataset.has_alpha
        np.testing.assert_array_equal(dataset.pixels.picture(3), make.picture(rig[3]))
        assert dataset.pixels.read(np.array([5, 900])).shape == (2, 3)


def test_nerfstudio_holds_out_every_eighth(tmp_path: Path) -> None:
    make.write_nerfstudio(tmp_path / "set")
    dataset = load(tmp_path / "set")
    assert (dataset.layout, dataset.is_dynamic) == ("nerfstudio", False)
    np.testing.assert_array_equal(np.flatnonzero(dataset.pictures.is_test), [0, 8])


def test_nerfstudio_split_time_and_depths(tmp_path: Path) -> None:
    names = [f"images/{k:04d}.png" for k in range(10)]
    make.write_nerfstudio(
        tmp_path / "set",
        times=[k / 9 for k in range(10)],
        near=0.5,
        far=4.5,
        fps=12,
        train_filenames=names[:7],
        test_filenames=["./" + names[8]],
    )
    dataset = load(tmp_path / "set")
    p = dataset.pictures
    assert p.file == (*names[:7], names[8])  # 7 and 9 are in neither list
    np.testing.assert_array_equal(p.is_test, [False] * 7 + [True])
    assert (p.near == 0.5).all() and (p.far == 4.5).all() and dataset.clip.fps == 12
    assert dataset.clip.frame_count == 8  # the step suggests 10, but there are only 8 pictures


def test_frames_may_override_intrinsics(tmp_path: Path) -> None:
    make.write_nerfstudio(tmp_path / "set")
    make.edit_json(tmp_path / "set" / "transforms.json", lambda d: d["frames"][4].update(fl_x=99.0, cx=15.0, k1=0.1))
    dataset = load(tmp_path / "set")
    assert dataset.pictures.intrinsics[4].tolist() == [99.0, 38.4, 15.0, 12.0]
    assert dataset.pictures.distortion[4].tolist() == [0.1, *7 * [0]]
    assert len(dataset.camera_names) == 10 and dataset.pictures.camera.tolist() == list(range(10))


def test_intrinsics_are_scaled_to_the_size_of_the_images(tmp_path: Path) -> None:
    """The calibration is for 64x48, the images are 32x24."""
    make.write_nerfstudio(tmp_path / "set", w=64, h=48, fl_x=80.0, fl_y=82.0, cx=33.0, cy=23.0)
    np.testing.assert_allclose(load(tmp_path / "set").pictures.intrinsics[0], [40.0, 41.0, 16.5, 11.5])


def test_missing_images_are_named_in_one_line(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    make.write_nerfstudio(tmp_path / "set")
    for k in (2, 5):
        (tmp_path / "set" / "images" / f"{k:04d}.png").unlink()
    dataset = load(tmp_path / "set")
    (line,) = capsys.readouterr().err.splitlines()
    assert "2 of 10 frames" in line and "images/0002.png, images/0005.png" in line
    np.testing.assert_array_equal(np.flatnonzero(dataset.pictures.is_test), [0])  # every eighth of the existing ones


def test_times_outside_the_unit_interval_are_scaled(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    times = [12.0, 10.0, 11.0, 14.0, 13.0, 15.0, 19.0, 18.0, 17.0, 16.0]  # unsorted, in frames
    make.write_nerfstudio(tmp_path / "set", times=times)
    dataset = load(tmp_path / "set", holdout="none")
    np.testing.assert_allclose(dataset.pictures.time, (np.array(times) - 10) / 9, atol=1e-7)
    assert dataset.clip.frame_count == 10
    assert "10 to 19; scaled" in capsys.readouterr().err


def test_equal_times_make_a_static_scene(tmp_path: Path) -> None:
    make.write_nerfstudio(tmp_path / "set", times=[0.5] * 10)
    dataset = load(tmp_path / "set")
    assert not dataset.is_dynamic and dataset.clip.frame_count == 1


def test_fewer_frames_in_one_video(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    rig = make.write_n3dv(tmp_path / "set")
    write_video(
        tmp_path / "set" / "cam01.mp4",
        (make.picture(rig[1], t) for t in (0, 1 / 3)),
        make.FPS,
        crf=1,
        pix_fmt="yuv444p",
    )
    dataset = load(tmp_path / "set")
    assert dataset.clip.frame_count == 2 and len(dataset.pictures) == 6
    assert dataset.pictures.time.tolist() == [0, 1] * 3
    (line,) = capsys.readouterr().err.splitlines()
    assert "2 (cam01.mp4) to 4 frames" in line
    error = dataset.pixels.picture(5).astype(float) - make.picture(rig[2], 1 / 3)
    assert np.abs(error).mean() < 2


def test_folders_that_are_not_datasets(tmp_path: Path) -> None:
    fails(tmp_path / "none", "no such directory")
    (tmp_path / "file").write_text("x")
    fails(tmp_path / "file", "not a directory")
    (tmp_path / "empty").mkdir()
    fails(tmp_path / "empty", "empty directory")
    (tmp_path / "other").mkdir()
    (tmp_path / "other" / "notes.txt").write_text("x")
    fails(tmp_path / "other", "poses_bounds.npy", "transforms_train.json", "transforms.json")


def test_no_permission(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    make.write_llff(tmp_path / "set")

    def refuse(path: Path) -> None:
        raise PermissionError(errno.EACCES, "Permission denied", str(path))

    monkeypatch.setattr(Path, "iterdir", refuse)  # root may read everything, so the refusal is simulated
    fails(tmp_path / "set", "no permission")


def test_malformed_poses_bounds(tmp_path: Path) -> None:
    folder = tmp_path / "set"
    make.write_n3dv(folder)
    good = np.load(folder / "poses_bounds.npy")

    def with_poses(rows: np.ndarray) -> Path:
        np.save(folder / "poses_bounds.npy", rows)
        return folder

    def changed(row: int, column: int, value: float) -> Path:
        rows = good.copy()
        rows[row, column] = value
        return with_poses(rows)

    fails(with_poses(good[:2]), "poses_bounds.npy", "2 poses for 3 videos")
    fails(with_poses(good[:, :15]), "poses_bounds.npy", "N x 17")
    fails(with_poses(good.astype(complex)), "N x 17")
    fails(changed(1, 3, np.nan), "row 1", "NaN")
    fails(changed(2, 14, 0.0), "row 2", "focal length")
    fails(changed(2, 14, np.nan), "row 2", "fl_x")
    fails(changed(0, 4, 0.0), "row 0", "empty")
    fails(changed(0, 0, 9.0), "row 0", "not a rotation")
    fails(changed(1, 15, -1.0), "row 1", "near")
    fails(changed(1, 16, 0.5), "row 1", "far")
    fails(changed(1, 9, 99.0), "another aspect ratio")
    np.save(folder / "poses_bounds.npy", good)
    damaged = (folder / "poses_bounds.npy").read_bytes().replace(b"}", b"(", 1)
    (folder / "poses_bounds.npy").write_bytes(damaged)
    fails(folder, "poses_bounds.npy", "not a numpy array")
    (folder / "poses_bounds.npy").write_bytes(b"not numpy")
    fails(folder, "poses_bounds.npy", "not a numpy array")
    np.save(folder / "poses_bounds.npy", np.array([{"a": 1}], object), allow_pickle=True)
    fails(folder, "poses_bounds.npy", "not a numpy array")


def test_poses_without_pictures(tmp_path: Path) -> None:
    (tmp_path / "set").mkdir()
    np.save(tmp_path / "set" / "poses_bounds.npy", make.poses_bounds(make.ring(3)))
    fails(tmp_path / "set", "cam*.mp4")


def test_a_file_that_is_not_a_video(tmp_path: Path) -> None:
    make.write_n3dv(tmp_path / "set")
    (tmp_path / "set" / "cam01.mp4").write_bytes(b"text")
    fails(tmp_path / "set", "cam01.mp4")


@pytest.mark.parametrize("scale", [1e-6, 1e6])
def test_small_and_large_scenes_have_several_cameras(tmp_path: Path, scale: float) -> None:
    make.write_nerfstudio(tmp_path / "set", images=3)

    def rescale(document: dict[str, Any]) -> None:
        for frame in document["frames"]:
            for row in frame["transform_matrix"][:3]:
                row[3] *= scale

    make.edit_json(tmp_path / "set" / "transforms.json", rescale)
    assert len(load(tmp_path / "set").camera_names) == 3


def test_names_that_cannot_be_printed_are_escaped(tmp_path: Path) -> None:
    make.write_llff(tmp_path / "set", images=3)
    folder = tmp_path / "set" / "images"
    (folder / "view0.png").rename(folder / "a\x1b[31m.png")
    assert load(tmp_path / "set").describe().isprintable()
    (folder / "a\x1b[31m.png").write_bytes(b"no image")
    fails(tmp_path / "set", "a\\x1b[31m.png")


def test_images_beside_videos_are_counted(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    make.write_n3dv(tmp_path / "set")
    write_image(tmp_path / "set" / "poster.png", np.zeros((4, 4, 3), np.uint8))
    assert "1 file left out" in load(tmp_path / "set").describe()
    assert "1 of 4 files found" in capsys.readouterr().err


def test_a_truncated_video(tmp_path: Path) -> None:
    make.write_n3dv(tmp_path / "set")
    video = tmp_path / "set" / "cam01.mp4"
    video.write_bytes(video.read_bytes()[:-400])
    fails(tmp_path / "set", "cam01.mp4", "of its 4 frames decode")
    assert not list((tmp_path / "cache").glob("*"))


@pytest.mark.parametrize("frames", [1, 4])
def test_a_single_static_camera_is_refused(tmp_path: Path, frames: int) -> None:
    make.write_n3dv(tmp_path / "set", cameras=2, frames=frames)
    fails(tmp_path / "set", "a single camera that does not move", "cam01.mp4")
    make.write_n3dv(tmp_path / "one", cameras=1, frames=frames)
    fails(tmp_path / "one", "every picture is held out")
    fails(tmp_path / "one", "a single camera that does not move", holdout="none")


@pytest.mark.parametrize(
    "key, value, words",
    [
        ("fl_x", 0.0, "focal length"),
        ("fl_x", None, "fl_x"),
        ("fl_x", "long", "fl_x"),
        ("w", 0, "empty"),
        ("h", 99, "another aspect ratio"),
        ("frames", [], "no frames"),
        ("frames", "none", "no frames"),
        ("camera_model", "THIN_PRISM_FISHEYE", "THIN_PRISM_FISHEYE"),
        ("k4", 0.5, "k4 of a camera model"),
        ("train_filenames", 3, "train_filenames"),
        ("test_filenames", [1], "test_filenames"),
        ("fps", 0, "fps"),
        ("fps", 1001, "fps 1001"),
        ("frames", [{"file_path": "images/0000.png"}], "transform_matrix"),
        ("frames", [7], "frame 0"),
    ],
)
def test_malformed_transforms(tmp_path: Path, key: str, value: object, words: str) -> None:
    make.write_nerfstudio(tmp_path / "set", images=3, **{key: value})
    fails(tmp_path / "set", "transforms.json", words)


@pytest.mark.parametrize(
    "pose",
    [
        [[1, 2], [3, 4]],
        "text",
        np.zeros((4, 4)).tolist(),
        (np.eye(4) * np.nan).tolist(),
        [[1], [2, 3]],
        np.diag([-1.0, 1, 1, 1]).tolist(),
    ],
)
def test_malformed_pose(tmp_path: Path, pose: object) -> None:
    make.write_nerfstudio(tmp_path / "set", images=3)
    make.edit_json(tmp_path / "set" / "transforms.json", lambda d: d["frames"][1].update(transform_matrix=pose))
    fails(tmp_path / "set", "transforms.json frame 1")


@pytest.mark.parametrize("text", ["", "{", "[1, 2]", "null", "[" * 100000, '{"frames": 1}', "\x00"])
def test_broken_json(tmp_path: Path, text: str) -> None:
    (tmp_path / "set").mkdir()
    (tmp_path / "set" / "transforms.json").write_text(text)
    fails(tmp_path / "set", "transforms.json")


@pytest.mark.parametrize(
    "name", ["../secret.png", "/etc/secret.png", "images/../../secret.png", "..\\secret.png", "a\0b"]
)
def test_file_path_must_not_leave_the_folder(tmp_path: Path, name: str) -> None:
    make.write_nerfstudio(tmp_path / "set", images=3)
    write_image(tmp_path / "secret.png", make.picture(make.ring(1)[0]))
    make.edit_json(tmp_path / "set" / "transforms.json", lambda d: d["frames"][1].update(file_path=name))
    fails(tmp_path / "set", "transforms.json", "leads out of")


def test_times_for_some_images_only(tmp_path: Path) -> None:
    make.write_nerfstudio(tmp_path / "set", times=[k / 9 for k in range(10)])
    make.edit_json(tmp_path / "set" / "transforms.json", lambda d: d["frames"][3].pop("time"))
    fails(tmp_path / "set", "0003.png", "time")
    make.edit_json(tmp_path / "set" / "transforms.json", lambda d: d["frames"][3].update(time=float("nan")))
    fails(tmp_path / "set", "frame 3", "time is NaN")


def test_no_image_exists(tmp_path: Path) -> None:
    make.write_nerfstudio(tmp_path / "set", images=3)
    shutil.rmtree(tmp_path / "set" / "images")
    fails(tmp_path / "set", "none of its 3 images")


def test_damaged_image(tmp_path: Path) -> None:
    make.write_nerfstudio(tmp_path / "set", images=3)
    image = tmp_path / "set" / "images" / "0001.png"
    image.write_bytes(image.read_bytes()[:-300])
    fails(tmp_path / "set", "0001.png")
    assert not list((tmp_path / "cache").iterdir())


def test_too_much_downscaling(tmp_path: Path) -> None:
    make.write_nerfstudio(tmp_path / "set", images=3)
    fails(tmp_path / "set", "cannot be downscaled by 25", downscale=25)
    fails(tmp_path / "set", "cannot be downscaled by 12", downscale=12)  # to pictures of a pixel or two
    fails(tmp_path / "set", "cannot be downscaled by 0", downscale=0)


@pytest.mark.parametrize("factor", [2, 3, 5])
def test_downscaling_averages_blocks(factor: int) -> None:
    picture = np.random.default_rng(0).integers(0, 256, (16, 23, 3), dtype=np.uint8)
    small = downscale_picture(picture, factor)
    h, w = 16 // factor, 23 // factor
    exact = picture[: h * factor, : w * factor].reshape(h, factor, w, factor, 3).mean((1, 3))
    assert small.shape == (h, w, 3) and np.abs(small - exact).max() <= 0.5


def test_downscaling_weights_colours_by_alpha() -> None:
    picture = np.random.default_rng(0).integers(0, 256, (8, 8, 4), dtype=np.uint8)
    picture[:2, :2, 3] = 0
    blocks = picture.reshape(4, 2, 4, 2, 4).astype(float)
    alpha = blocks[..., 3:].sum((1, 3))
    with np.errstate(invalid="ignore"):
        exact = np.where(
            alpha > 0, (blocks[..., :3] * blocks[..., 3:]).sum((1, 3)) / alpha, blocks[..., :3].mean((1, 3))
        )
    small = downscale_picture(picture, 2)
    assert np.abs(small[..., :3] - exact).max() <= 0.5
    assert np.abs(small[..., 3:] - alpha / 4).max() <= 0.5


@pytest.mark.skipif(not (DATA / "fox").is_dir(), reason="shared/data is not here")
@pytest.mark.parametrize(
    "name, words, pictures, tests",
    [
        ("soldier", "Blender: 120 cameras, 120 pictures of 200x200", 120, 20),
        ("shelf_hand", "dynamic, 86 frames", 86, 11),
        ("fox", "static, distortion", 50, 7),
    ],
)
def test_real_datasets(tmp_path: Path, name: str, words: str, pictures: int, tests: int) -> None:
    dataset = load_dataset(DATA / name, tmp_path, downscale=8 if name == "fox" else 1, progress=False)
    assert words in dataset.describe()
    assert (len(dataset.pictures), int(dataset.pictures.is_test.sum())) == (pictures, tests)


def test_files_that_systems_leave_are_no_pictures(tmp_path: Path) -> None:
    """AppleDouble files have the suffix of the picture that they belong to, and are listed with it."""
    make.write_llff(tmp_path / "llff")
    for name in ("._view0.png", ".view1.png.Xa1b", "Thumbs.db", "desktop.ini", ".DS_Store"):
        (tmp_path / "llff/images" / name).write_bytes(bytes.fromhex("0005160700020000") + b"Mac OS X" + bytes(50))
    assert len(load(tmp_path / "llff").pictures) == 9
    make.write_n3dv(tmp_path / "n3dv")
    (tmp_path / "n3dv/._cam00.mp4").write_bytes(bytes(70))
    assert load(tmp_path / "n3dv").pictures.is_test.sum() == 4


def test_sixteen_bit_grey(tmp_path: Path) -> None:
    """Every sample counts by its high byte; Pillow's own conversion would make all of them white."""
    rig = make.write_nerfstudio(tmp_path / "set", images=4)
    grey = [make.picture(camera)[..., 0] for camera in rig]
    for k, levels in enumerate(grey):
        Image.fromarray(levels.astype(np.uint16) * 256 + 77).save(tmp_path / f"set/images/{k:04d}.png")
    dataset = load(tmp_path / "set")
    for k, levels in enumerate(grey):
        np.testing.assert_array_equal(dataset.pixels.picture(k), np.repeat(levels[..., None], 3, axis=2))


@pytest.mark.parametrize("listed", [".webp", ".WEBP", ""])
@pytest.mark.parametrize("suffix", [".webp", ".TIFF", ".Bmp"])
def test_pictures_of_any_suffix(tmp_path: Path, suffix: str, listed: str) -> None:
    """The list may write the suffix in another case, or leave it out."""
    rig = make.write_nerfstudio(tmp_path / "set", images=3)
    for k in range(3):
        file = tmp_path / f"set/images/{k:04d}.png"
        Image.open(file).save(file.with_suffix(suffix), quality=95)
        file.unlink()
    name = {".webp": suffix.lower(), ".WEBP": suffix.upper()}.get(listed, "")
    make.edit_json(
        tmp_path / "set/transforms.json",
        lambda d: [f.update(file_path=f["file_path"].replace(".png", name)) for f in d["frames"]],
    )
    dataset = load(tmp_path / "set")
    assert np.abs(dataset.pixels.picture(2).astype(int) - make.picture(rig[2])).mean() < 3


@pytest.mark.parametrize("suffix, words", [(".nef", "images of the suffix .nef"), ("", "images without a suffix")])
def test_files_that_exist_are_not_said_to_be_missing(tmp_path: Path, suffix: str, words: str) -> None:
    make.write_nerfstudio(tmp_path / "set", images=3)
    (tmp_path / "set/images/0001.png").rename(tmp_path / f"set/images/0001{suffix}")
    make.edit_json(tmp_path / "set/transforms.json", lambda d: d["frames"][1].update(file_path=f"images/0001{suffix}"))
    fails(tmp_path / "set", f"images/0001{suffix} exists", words, "convert it to PNG")


def test_names_of_accented_letters(tmp_path: Path) -> None:
    """Macs decompose them, so that a list and the names in an archive may differ."""
    make.write_nerfstudio(tmp_path / "set", images=3)
    (tmp_path / "set/images/0001.png").rename(tmp_path / "set/images/cafe\u0301.png")
    make.edit_json(tmp_path / "set/transforms.json", lambda d: d["frames"][1].update(file_path="images/caf\u00e9.png"))
    assert len(load(tmp_path / "set").pictures) == 3


@pytest.mark.parametrize(
    "declared, upright, words",
    [
        ((24, 32), True, "are turned by their EXIF orientation"),
        ((32, 24), False, "are used as stored"),
        (None, False, "are used as stored"),
    ],
)
def test_exif_orientation(
    tmp_path: Path, declared: tuple[int, int] | None, upright: bool, words: str, capsys: pytest.CaptureFixture[str]
) -> None:
    """Images are turned only if the calibration is for the turned size; masks of either size fit then."""
    rig = make.write_nerfstudio(tmp_path / "set", images=3)
    exif = Image.Exif()
    exif[0x0112] = 6  # a quarter turn clockwise shows it upright
    usable = np.arange(24 * 32).reshape(24, 32) % 5 > 0
    for k in range(2):
        file = tmp_path / f"set/images/{k:04d}.png"
        Image.open(file).save(file, exif=exif)
    make.write_mask(tmp_path / "set/masks/0000.png", np.rot90(usable, -1) if upright else usable)
    Image.fromarray(usable).save(tmp_path / "set/masks/0001.png", exif=exif)
    Image.open(tmp_path / "set/images/0002.png").rotate(-90 * upright, expand=True).save(
        tmp_path / "set/images/0002.png"
    )

    def declare(document: dict[str, object]) -> None:
        if declared is None:
            del document["w"], document["h"]
        else:
            document["w"], document["h"] = declared

    make.edit_json(tmp_path / "set/transforms.json", declare)
    dataset = load(tmp_path / "set")
    lines = [line for line in capsys.readouterr().err.splitlines() if "EXIF" in line]
    assert len(lines) == 1 and "2 images" in lines[0] and words in lines[0]
    for k in range(2):
        expected = make.picture(rig[k])
        np.testing.assert_array_equal(dataset.pixels.picture(k), np.rot90(expected, -1) if upright else expected)
        np.testing.assert_array_equal(dataset.usable(k), np.rot90(usable, -1) if upright else usable)


def test_exif_orientation_of_llff(tmp_path: Path) -> None:
    """The size in poses_bounds.npy decides in the same way."""
    make.write_llff(tmp_path / "set", images=3)
    exif = Image.Exif()
    exif[0x0112] = 8
    for k in range(3):
        file = tmp_path / f"set/images/view{k}.png"
        Image.open(file).rotate(-90, expand=True).save(file, exif=exif)
    dataset = load(tmp_path / "set")
    assert dataset.pictures.width.tolist() == [32] * 3


def not_utf8(folder: Path, name: bytes = b"caf\xe9") -> Path:
    """Rename a file or folder to a name that is not UTF-8, as old archives unpack; skip where the disk has none."""
    renamed = Path(os.fsdecode(os.fsencode(folder.parent) + b"/" + name))
    try:
        folder.rename(renamed)
    except OSError:
        pytest.skip("this file system holds Unicode names only")
    return renamed


@pytest.mark.parametrize("write", [make.write_n3dv, make.write_llff, make.write_blender, make.write_colmap])
def test_folders_of_names_that_are_not_utf8(tmp_path: Path, write: Callable[[Path], object]) -> None:
    write(tmp_path / "set")
    dataset = load(not_utf8(tmp_path / "set"))
    assert len(dataset.pictures) == len(load(dataset.path).pictures)  # the second from the cache


@pytest.mark.parametrize("binary", [False, True])
def test_pictures_of_names_that_are_not_utf8(tmp_path: Path, binary: bool) -> None:
    """They are found by their bytes, and called by names with replaced letters."""
    make.write_colmap(tmp_path / "set", images=3, binary=binary)
    not_utf8(tmp_path / "set/images/0001.png", b"\xe91.png")
    file = tmp_path / f"set/sparse/0/images.{'bin' if binary else 'txt'}"
    file.write_bytes(file.read_bytes().replace(b"0001.png", b"\xe91.png"))
    dataset = load(tmp_path / "set")
    assert "images/\ufffd1.png" in dataset.pictures.file and "\ufffd1" in dataset.camera_names


@pytest.mark.parametrize("encoding", ["utf-8-sig", "utf-16"])
def test_byte_order_marks(tmp_path: Path, encoding: str) -> None:
    make.write_nerfstudio(tmp_path / "nerfstudio", images=3)
    make.write_colmap(tmp_path / "colmap", images=3, binary=False)
    folder = tmp_path / "colmap/sparse/0"
    for file in (tmp_path / "nerfstudio/transforms.json", folder / "cameras.txt", folder / "images.txt"):
        file.write_text(file.read_text(), encoding=encoding)
    assert len(load(tmp_path / "nerfstudio").pictures) == len(load(tmp_path / "colmap").pictures) == 3


def test_lists_in_the_encoding_of_the_names(tmp_path: Path) -> None:
    make.write_nerfstudio(tmp_path / "set", images=4)
    not_utf8(tmp_path / "set/images/0001.png", b"\xe91.png")
    file = tmp_path / "set/transforms.json"
    file.write_bytes(file.read_bytes().replace(b"0001.png", b"\xe91.png"))
    assert len(load(tmp_path / "set").pictures) == 4
    file.write_bytes(file.read_bytes().replace(b"\xe91.png", rb"\ud8001.png"))  # no name of a file, but valid JSON
    assert len(load(tmp_path / "set").pictures) == 3
