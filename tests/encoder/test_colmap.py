"""COLMAP models, binary and text, give the original cameras; damage is reported in one line."""

import os
import shutil
import struct
from pathlib import Path

import numpy as np
import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

import datasets as make
from datasets import all_rays, distorted, fails, load
from kpc.encoder.datasets import pixel_rays
from kpc.encoder.datasets.layouts import colmap, colmap_model
from kpc.format.common.errors import KpcError
from kpc.format.common.images import write_image

POSE = (1.0, 0.0, 0.0, 0.0, 0.1, 0.2, 3.0)
PINHOLE = (40.0, 41.0, 16.5, 11.5)


def model_of(
    folder: Path, cameras: list[make.ColmapCamera], images: list[make.ColmapImage], binary: bool = True
) -> Path:
    """Write a folder with three images and the given model."""
    shutil.rmtree(folder, ignore_errors=True)
    make.write_colmap(folder, images=3)
    shutil.rmtree(folder / "sparse")
    make.write_colmap_model(folder / "sparse" / "0", cameras, images, binary)
    return folder


def three(*names: str, pose: tuple[float, ...] = POSE) -> list[make.ColmapImage]:
    """Return images one unit apart, three unless named."""
    return [
        (k, (*pose[:4], pose[4] + k, *pose[5:]), 1, name, 0) for k, name in enumerate(names or ("0000", "0001", "0002"))
    ]


@pytest.mark.parametrize("binary", [True, False])
@pytest.mark.parametrize(
    "model, lens, distortion",
    [
        ("SIMPLE_PINHOLE", (), (0, 0, 0, 0)),
        ("PINHOLE", (), (0, 0, 0, 0)),
        ("SIMPLE_RADIAL", (0.06,), (0.06, 0, 0, 0)),
        ("RADIAL", (0.06, -0.08), (0.06, -0.08, 0, 0)),
        ("OPENCV", (0.06, -0.08, -0.001, 0.0002), (0.06, -0.08, -0.001, 0.0002)),
        ("FULL_OPENCV", (0.1, 0.2, 1e-3, 2e-3, 0.3, 0.4, 0.5, 0.6), (0.1, 0.2, 1e-3, 2e-3, 0.3, 0.4, 0.5, 0.6)),
        ("SIMPLE_FISHEYE", (), (0, 0, 0, 0)),
        ("FISHEYE", (), (0, 0, 0, 0)),
        ("SIMPLE_RADIAL_FISHEYE", (0.06,), (0.06, 0, 0, 0)),
        ("RADIAL_FISHEYE", (0.06, -0.02), (0.06, -0.02, 0, 0)),
        ("OPENCV_FISHEYE", (0.06, -0.02, 0.01, 0.002), (0.06, -0.02, 0, 0, 0.01, 0.002)),
    ],
)
def test_cameras_of_every_model_are_read(
    tmp_path: Path, binary: bool, model: str, lens: tuple[float, ...], distortion: tuple[float, ...]
) -> None:
    rig = make.write_colmap(tmp_path / "set", binary=binary, model=model, lens=lens)
    dataset = load(tmp_path / "set")
    p = dataset.pictures
    assert (dataset.layout, dataset.is_dynamic, len(p)) == ("COLMAP", False, 10)
    assert p.file == tuple(f"images/{k:04d}.png" for k in range(10))
    assert p.is_test.nonzero()[0].tolist() == [0, 8] and np.isnan(p.near).all() and np.isnan(p.far).all()
    for n, camera in enumerate(rig):
        found = dataset.camera(n)
        np.testing.assert_allclose(found.camera_to_world, camera.camera_to_world, atol=1e-12)
        assert (found.fl_x, found.fl_y, found.cx, found.cy) == (camera.fl_x, camera.fl_y, camera.cx, camera.cy)
        np.testing.assert_array_equal(dataset.pixels.picture(n), make.picture(camera))
    np.testing.assert_array_equal(p.distortion, np.tile((*distortion, *(8 - len(distortion)) * [0]), (10, 1)))
    assert p.is_fisheye.tolist() == ["FISHEYE" in model] * 10
    described = dataset.describe()
    assert ("distortion" in described or "fisheye" in described) == any(distortion) or "FISHEYE" in model
    assert described.startswith("COLMAP: 10 cameras")


def test_rays_pass_through_points_projected_by_the_model(tmp_path: Path) -> None:
    """Project as COLMAP documents it: x right, y down, z forward, the centre of the first pixel at 0.5."""
    lens = (0.06, -0.08, -0.001, 0.0002)
    make.write_colmap(tmp_path / "set", model="OPENCV", lens=lens)
    dataset = load(tmp_path / "set")
    points = np.random.default_rng(0).uniform(-0.5, 0.5, (20, 3))
    for k in (1, 6):
        *q, tx, ty, tz = make.colmap_pose(make.ring(10)[k].camera_to_world)
        w, v = q[0], np.array(q[1:])
        rotated = points + 2 * np.cross(v, np.cross(v, points) + w * points)  # q p q*
        x, y, z = np.add(rotated, [tx, ty, tz]).T
        assert (z > 0).all()
        u, v = distorted(x / z, y / z, np.array([lens]))
        camera = dataset.camera(k)
        column, row = camera.fl_x * u + camera.cx - 0.5, camera.fl_y * v + camera.cy - 0.5
        origins, directions = pixel_rays(dataset.pictures, np.full(20, k), column, row)
        along = ((points - origins) * directions).sum(1, keepdims=True)
        assert (along > 0).all() and np.abs(origins + along * directions - points).max() < 1e-5


@given(st.lists(st.floats(-1, 1), min_size=4, max_size=4).filter(lambda q: 0.1 < np.linalg.norm(q)), st.floats(0.1, 9))
def test_quaternions_of_any_length_give_the_same_rotation(q: list[float], length: float) -> None:
    pose = colmap_model._camera_to_world("here", (*(length * np.array(q)), 1.0, 2.0, 3.0))
    rotation = pose[:3, :3] * [1, -1, -1]
    np.testing.assert_allclose(rotation.T @ rotation, np.eye(3), atol=1e-12)
    assert np.linalg.det(rotation) == pytest.approx(1)
    np.testing.assert_allclose(rotation.T @ pose[:3, 3], [-1, -2, -3], atol=1e-12)
    found = make.quaternion(rotation.T)
    assert abs(found @ q) == pytest.approx(np.linalg.norm(q))  # q and -q are the same rotation


def test_binary_precedes_text_and_sparse_0_precedes_sparse(tmp_path: Path) -> None:
    folder = tmp_path / "set"
    rig = make.write_colmap(folder)
    (folder / "sparse" / "0" / "cameras.txt").write_text("damaged")
    (folder / "sparse" / "0" / "images.txt").write_text("damaged")
    (folder / "sparse" / "cameras.bin").write_bytes(b"damaged")
    (folder / "sparse" / "images.bin").write_bytes(b"damaged")
    np.testing.assert_allclose(load(folder).camera(3).camera_to_world, rig[3].camera_to_world, atol=1e-12)
    for name in ("cameras", "images"):
        (folder / "sparse" / "0" / f"{name}.bin").rename(folder / "sparse" / f"{name}.bin")
        (folder / "sparse" / "0" / f"{name}.txt").unlink()
    np.testing.assert_allclose(load(folder).camera(3).camera_to_world, rig[3].camera_to_world, atol=1e-12)
    (folder / "sparse" / "cameras.bin").unlink()
    fails(folder, "no dataset layout recognised", "sparse/0", "COLMAP")


def test_exported_layouts_precede_the_model(tmp_path: Path) -> None:
    for write, layout in ((make.write_nerfstudio, "nerfstudio"), (make.write_llff, "LLFF")):
        write(tmp_path / layout)
        make.write_colmap_model(tmp_path / layout / "sparse" / "0", [], [])
        assert load(tmp_path / layout).layout == layout


@pytest.mark.parametrize("binary", [True, False])
def test_subfolders_spaces_order_and_several_cameras(tmp_path: Path, binary: bool) -> None:
    names = ["b/view 10.png", "b/view 9.png", "a/view 1.png"]
    small = (8, "SIMPLE_PINHOLE", 64, 48, (80.0, 33.0, 23.0))  # calibrated at twice the size
    images = three(*names)
    images[0] = (*images[0][:2], 8, *images[0][3:])
    folder = model_of(tmp_path / "set", [(1, "PINHOLE", 32, 24, PINHOLE), small], images, binary)
    for k, name in enumerate(names):
        (folder / "images" / name).parent.mkdir(exist_ok=True)
        (folder / "images" / f"{k:04d}.png").rename(folder / "images" / name)
    p = load(folder, holdout="view 9").pictures
    assert p.file == ("images/a/view 1.png", "images/b/view 9.png", "images/b/view 10.png")
    assert p.is_test.tolist() == [False, True, False]
    np.testing.assert_array_equal(p.intrinsics, [PINHOLE, PINHOLE, (40.0, 40.0, 16.5, 11.5)])
    np.testing.assert_allclose(p.camera_to_world[:, 0, 3], [-2.1, -1.1, -0.1])


def test_variations_of_the_text_format(tmp_path: Path) -> None:
    """Comments and empty lines between records, many or no points, and a last line without a line break."""
    folder = model_of(tmp_path / "set", [], [], binary=False)
    (folder / "sparse/0/cameras.txt").write_text("# one\n\n#two\n  1 PINHOLE 32 24 40 41 16.5 11.5  \r\n")
    (folder / "sparse/0/images.txt").write_text(
        "# one\n\n1 1 0 0 0 0 0 3 1 0000.png\n\n# between\n2 1 0 0 0 1 0 3 1 0001.png\n1 2 3 4 5 6 7 8 9 10 11 12\n"
        "\n3 1 0 0 0 2 0 3 1 0002.png"
    )
    dataset = load(folder)
    np.testing.assert_allclose(dataset.pictures.camera_to_world[:, 0, 3], [0, -1, -2])


def test_missing_images_are_named_in_one_line(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    make.write_colmap(tmp_path / "set")
    (tmp_path / "set/images/0004.png").unlink()
    assert len(load(tmp_path / "set").pictures) == 9
    (line,) = capsys.readouterr().err.splitlines()
    assert "1 of 10" in line and "0004.png" in line
    images = three("0000.png", "gone\n\x1b[2J.png", "0002.png", "0001.png", "x" * 300 + ".png")
    load(model_of(tmp_path / "set", [(1, "PINHOLE", 32, 24, PINHOLE)], images))
    (line,) = capsys.readouterr().err.splitlines()
    assert "2 of 5" in line and "gone\\n" in line and "\x1b" not in line
    shutil.rmtree(tmp_path / "set" / "images")
    fails(tmp_path / "set", "images.bin", "none of its 5 images exists")


@pytest.mark.parametrize("binary", [True, False])
@pytest.mark.parametrize(
    "camera, words",
    [
        (
            (1, "OPENCV_FISHEYE", 32, 24, (40.0, 40.0, 16.0, 12.0, 0.0, 0.0, -99.0, 0.0)),
            ("camera 1", "fisheye", "folds"),
        ),
        ((1, "FOV", 32, 24, (40.0, 40.0, 16.0, 12.0, 0.9)), ("camera 1", "FOV is not supported")),
        ((1, "PINHOLE", 32, 24, (40.0, np.nan, 16.0, 12.0)), ("camera 1", "NaN")),
        ((1, "OPENCV", 32, 24, (*PINHOLE, 0.0, np.inf, 0.0, 0.0)), ("camera 1", "NaN or infinity")),
        ((1, "PINHOLE", 32, 24, (40.0, -40.0, 16.0, 12.0)), ("camera 1", "must be positive")),
        ((1, "PINHOLE", 0, 24, PINHOLE), ("camera 1", "empty")),
        ((1, "PINHOLE", 1 << 63, 24, PINHOLE), ("camera 1", "too large")),
        ((1, "OPENCV", 32, 24, (*PINHOLE, -9.0, 0.0, 0.0, 0.0)), ("camera 1", "folds")),
        ((1, "PINHOLE", 24, 32, PINHOLE), ("another aspect ratio",)),
        ((2, "PINHOLE", 32, 24, PINHOLE), ("camera 1 is missing from the model",)),
    ],
)
def test_invalid_cameras_are_refused(
    tmp_path: Path, binary: bool, camera: make.ColmapCamera, words: tuple[str, ...]
) -> None:
    fails(model_of(tmp_path / "set", [camera], three(), binary), *words)


@pytest.mark.parametrize("binary", [True, False])
@pytest.mark.parametrize(
    "pose",
    [
        (0.0,) * 7,
        (np.nan, *POSE[1:]),
        (*POSE[:6], np.inf),
        (1e308,) * 7,
        (0.9, 0.1, 0.3, 0.2, 1.7e308, 1.7e308, 1.7e308),
    ],
)
def test_invalid_poses_are_refused(tmp_path: Path, binary: bool, pose: tuple[float, ...]) -> None:
    images = [*three()[:2], (5, pose, 1, "0002.png", 0)]
    folder = model_of(tmp_path / "set", [(1, "PINHOLE", 32, 24, PINHOLE)], images, binary)
    fails(folder, "image 5", "pose")


@pytest.mark.parametrize("binary", [True, False])
def test_duplicates_and_empty_models_are_refused(tmp_path: Path, binary: bool) -> None:
    camera = (1, "PINHOLE", 32, 24, PINHOLE)
    suffix = ".bin" if binary else ".txt"
    fails(model_of(tmp_path / "set", [camera, camera], three(), binary), f"cameras{suffix}", "camera 1 is listed twice")
    images = three("0000.png", "0001.png", "0001.png")
    fails(model_of(tmp_path / "set", [camera], images, binary), f"images{suffix}", "image 2 (0001.png) is listed twice")
    images = [(4, *image[1:]) for image in three()]
    fails(model_of(tmp_path / "set", [camera], images, binary), "image 4", "is listed twice")
    fails(model_of(tmp_path / "set", [camera], [], binary), f"images{suffix}", "lists no images")


@pytest.mark.parametrize("binary", [True, False])
@pytest.mark.parametrize(
    "name", ["../secret.png", "/secret.png", "a/../../secret.png", "..\\secret.png", "../images/0001.png", "."]
)
def test_names_must_not_leave_the_folder(tmp_path: Path, binary: bool, name: str) -> None:
    images = three("0000.png", name, "0002.png")
    folder = model_of(tmp_path / "set", [(1, "PINHOLE", 32, 24, PINHOLE)], images, binary)
    write_image(folder / "secret.png", make.picture(make.ring(1)[0]))
    fails(folder, "images." + ("bin" if binary else "txt"), "leads out of")


@pytest.mark.parametrize(
    "text, words",
    [
        ("", "image 0: its camera 1 is missing from the model"),
        ("1", "a line of 1 words"),
        ("1 PINHOLE", "a line of 2 words"),
        ("1 PINHOLE 32 24 40 41", "2 parameters, but PINHOLE has 4"),
        ("x PINHOLE 32 24 40 41 16 12", "not a COLMAP model"),
        ("\0\xff", "not a COLMAP model"),
        ("1 PINHOLE 32 24 40 41 16 twelve", "not a COLMAP model"),
        (f"1 PINHOLE {'9' * 400} 24 40 41 16 12", "not a COLMAP model"),
        (f"1 PINHOLE {'9' * 5000} 24 40 41 16 12", "not a COLMAP model"),
        ("1 PIN\x1b[2J 32 24 40 41 16 12", "camera model 'PIN\\x1b[2J' is not supported"),
    ],
)
def test_malformed_text_of_cameras(tmp_path: Path, text: str, words: str) -> None:
    folder = model_of(tmp_path / "set", [], three(), binary=False)
    (folder / "sparse/0/cameras.txt").write_text(text)
    fails(folder, words)


@pytest.mark.parametrize(
    "text",
    [
        "1",
        "1 1 0 0 0 0 0 3 1",
        "1 1 0 0 0 0 0 3 x 0000.png",
        "1 1 0 0 0 0 zero 3 1 0000.png",
        "\0" * 99,
        "# nothing\n\n",
    ],
)
def test_malformed_text_in_images(tmp_path: Path, text: str) -> None:
    folder = model_of(tmp_path / "set", [(1, "PINHOLE", 32, 24, PINHOLE)], [], binary=False)
    (folder / "sparse/0/images.txt").write_text(text)
    fails(folder, "images.txt", "export")


def test_absurd_counts_are_refused(tmp_path: Path) -> None:
    """Nothing is allocated by a count from the file."""
    folder = tmp_path / "set"
    make.write_colmap(folder, images=3)
    cameras, images = folder / "sparse/0/cameras.bin", folder / "sparse/0/images.bin"
    for file in (cameras, images):
        good = file.read_bytes()
        for count in (4, 1 << 40, (1 << 64) - 1):
            file.write_bytes(struct.pack("<Q", count) + good[8:])
            fails(folder, file.name, "it ends early")
        file.write_bytes(good)
    good = images.read_bytes()
    points = 8 + 64 + len("0000.png") + 1
    for count in (1, 1 << 40, 1 << 60, (1 << 64) - 1):
        images.write_bytes(good[:points] + struct.pack("<Q", count) + good[points + 8 :])
        fails(folder, "images.bin")
    images.write_bytes(good[: 8 + 64] + b"a" * 5000)
    fails(folder, "images.bin", "a name of more than 4096 bytes")
    cameras.write_bytes(struct.pack("<QIiQQ", 1, 1, 77, 32, 24))
    fails(folder, "cameras.bin", "camera 1", "number 77")


@pytest.fixture(scope="module")
def valid_model(tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, bytes, bytes]:
    folder = tmp_path_factory.mktemp("model") / "set"
    make.write_colmap(folder, images=4, model="OPENCV", lens=(0.1, 0.0, 0.0, 0.0))
    model = folder / "sparse" / "0"
    return folder, (model / "cameras.bin").read_bytes(), (model / "images.bin").read_bytes()


def read_or_refuse(folder: Path, cameras: bytes, images: bytes) -> bool:
    """Return whether the model is read; a refusal must be one printable line."""
    (folder / "sparse/0/cameras.bin").write_bytes(cameras)
    (folder / "sparse/0/images.bin").write_bytes(images)
    try:
        colmap.read(folder, None)
    except KpcError as error:
        assert "\n" not in str(error) and str(error).isprintable()
        return False
    return True


def test_every_truncation_is_refused(
    valid_model: tuple[Path, bytes, bytes], capsys: pytest.CaptureFixture[str]
) -> None:
    folder, cameras, images = valid_model
    assert read_or_refuse(folder, cameras, images)
    assert not any(read_or_refuse(folder, cameras[:n], images) for n in range(len(cameras)))
    assert not any(read_or_refuse(folder, cameras, images[:n]) for n in range(len(images)))


@settings(suppress_health_check=[HealthCheck.function_scoped_fixture], max_examples=300, deadline=None)
@given(st.booleans(), st.lists(st.tuples(st.integers(0, 2000), st.integers(0, 255)), min_size=1, max_size=8))
def test_altered_bytes_give_a_dataset_or_a_one_line_error(
    valid_model: tuple[Path, bytes, bytes], in_images: bool, changes: list[tuple[int, int]]
) -> None:
    folder, cameras, images = valid_model
    data = bytearray(images if in_images else cameras)
    for position, value in changes:
        data[position % len(data)] = value
    read_or_refuse(folder, *((cameras, bytes(data)) if in_images else (bytes(data), images)))


@settings(suppress_health_check=[HealthCheck.function_scoped_fixture], max_examples=200, deadline=None)
@given(st.booleans(), st.binary(max_size=300))
def test_random_bytes_give_a_one_line_error(
    valid_model: tuple[Path, bytes, bytes], in_images: bool, noise: bytes
) -> None:
    folder, cameras, images = valid_model
    assert not read_or_refuse(folder, *((cameras, noise) if in_images else (noise, images)))


def test_names_that_are_not_valid_text(tmp_path: Path) -> None:
    """A name is bytes, and the string that Python decodes them to must still find the file."""
    folder = model_of(tmp_path / "set", [(1, "PINHOLE", 32, 24, PINHOLE)], three("0000.png", "0001.png", "0002.png"))
    try:
        os.rename(folder / "images" / "0001.png", os.fsencode(folder / "images") + b"/0\xff01.png")
    except OSError:
        pytest.skip("the file system accepts valid text only")
    images = folder / "sparse/0/images.bin"
    images.write_bytes(images.read_bytes().replace(b"0001.png", b"0\xff01.png"))
    assert len(load(folder).pictures) == 3


def test_rays_equal_those_of_nerfstudio(tmp_path: Path) -> None:
    lens = {"k1": 0.06, "k2": -0.08, "p1": -0.001, "p2": 0.0002}
    make.write_nerfstudio(tmp_path / "json", **lens)
    make.write_colmap(tmp_path / "model", model="OPENCV", lens=tuple(lens.values()))
    ours, theirs = load(tmp_path / "model", downscale=2), load(tmp_path / "json", downscale=2)
    np.testing.assert_array_equal(ours.pictures.is_test, theirs.pictures.is_test)
    for n in range(10):
        for a, b in zip(all_rays(ours, n), all_rays(theirs, n), strict=True):
            np.testing.assert_allclose(a, b, atol=1e-6)
