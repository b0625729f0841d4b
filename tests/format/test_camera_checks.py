"""Cameras are checked alike wherever they enter, and refused in one line that says what is wrong."""

import json
import math
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from kpc.encoder.datasets.rays import undistort
from kpc.format.common.errors import DatasetError
from kpc.format.container.scene_layout import BOX_LIMIT
from kpc.format.scene.camera_checks import (
    DISTORTION_KEYS,
    NO_DISTORTION,
    NUMBER_LIMIT,
    check_depths,
    check_lens,
    check_pose,
    distort,
    number_of,
)
from kpc.format.scene.cameras import MAX_SIDE, load_views

NAN, INF = math.nan, math.inf
SIZE, LENS = (640, 480), (500.0, 510.0, 320.0, 240.0)
TURNED = np.array([[0.0, 0, 1, 2], [1, 0, 0, -3], [0, 1, 0, 4], [0, 0, 0, 1]])


def full(*coefficients: float) -> tuple[float, ...]:
    """Return coefficients with those that follow as 0."""
    return (*coefficients, *NO_DISTORTION[len(coefficients) :])


def refused(*words: str) -> Any:
    """Expect a one-line refusal that begins with the place and holds one of the words."""
    return pytest.raises(DatasetError, match=rf"(?s)\Ahere: [^\n]*({'|'.join(words)})[^\n]*\Z")


@pytest.mark.parametrize(
    ("size", "lens", "distortion", "words"),
    [
        (SIZE, (NAN, 510.0, 320.0, 240.0), (0, 0, 0, 0), "fl_x holds NaN"),
        (SIZE, (500.0, 510.0, 320.0, INF), (0, 0, 0, 0), "cy holds NaN"),
        (SIZE, LENS, (NAN, 0, 0, 0), "k1 holds NaN"),
        (SIZE, LENS, (0, 0, 0, -INF), "p2 holds NaN"),
        (SIZE, (0.0, 510.0, 320.0, 240.0), (0, 0, 0, 0), "must be positive"),
        (SIZE, (1e-9, 1e-9, 320.0, 240.0), (0, 0, 0, 0), "does not fit"),
        (SIZE, (0.8, 1.0, 0.5, 0.5), (0, 0, 0, 0), "in pixels"),
        (SIZE, (1e9, 1e9, 320.0, 240.0), (0, 0, 0, 0), "does not fit"),
        (SIZE, (5e-324, 500.0, 320.0, 240.0), (0, 0, 0, 0), "does not fit"),
        (SIZE, (500.0, 500.0, 1e6, 240.0), (0, 0, 0, 0), "far outside"),
        (SIZE, (40.0, 500.0, 320.0, 240.0), (0, 0, 0, 0), "differ more"),
        ((0, 480), LENS, (0, 0, 0, 0), "empty"),
        ((1e12, 480), LENS, (0, 0, 0, 0), "too large"),
        (SIZE, LENS, (-2.0, 0, 0, 0), "folds"),
        (SIZE, LENS, (0, 0, 0.9, 0), "folds"),
        (SIZE, LENS, (1e300, -1e300, 0, 0), "folds"),
        (SIZE, LENS, (1e30, 0, 0, 0), "stretches"),
    ],
)
def test_lenses_that_are_none(size: Any, lens: Any, distortion: Any, words: str) -> None:
    with refused(words):
        check_lens("here", size, lens, full(*distortion))


@pytest.mark.parametrize(
    ("size", "lens", "distortion"),
    [
        (SIZE, LENS, (0.0578421, -0.0805099, -0.000980296, 0.00015575)),  # a telephone
        (SIZE, (300.0, 300.0, 320.0, 240.0), (-0.28, 0.08, 1e-3, -1e-3)),  # a wide action camera
        (SIZE, (500.0, 500.0, -900.0, 3000.0), (0, 0, 0, 0)),  # a crop, whose principal point lies outside
        (SIZE, (300.0, 300.0, -100.0, 240.0), (0.05, 0, 0, 0)),
        ((1, 1), (1.0, 1.0, 0.5, 0.5), (0, 0, 0, 0)),
        (SIZE, (6e7, 6e7, 320.0, 240.0), (0, 0, 0, 0)),  # nearly orthographic
    ],
)
def test_lenses_of_real_cameras_are_accepted(size: Any, lens: Any, distortion: Any) -> None:
    check_lens("here", size, lens, full(*distortion))


@pytest.mark.parametrize("axis", [0, 1])
def test_a_fold_counts_within_the_picture_only(axis: int) -> None:
    """With k1 = -0.3 the map r (1 + k1 r^2) turns back at r = sqrt(1 / 0.9), which it moves to 2 / 3 of that."""
    fold = math.sqrt(1 / 0.9) * 2 / 3
    for reach, folds in ((0.98 * fold, False), (1.01 * fold, True)):
        size = [2.0, 2.0]
        size[axis] = 2 * math.sqrt((500 * reach) ** 2 - 1)  # from the centre to a corner
        lens = (500.0, 500.0, size[0] / 2, size[1] / 2)
        if folds:
            with refused("folds"):
                check_lens("here", (size[0], size[1]), lens, full(-0.3))
        else:
            check_lens("here", (size[0], size[1]), lens, full(-0.3))


@pytest.mark.parametrize("coefficient", range(8))
def test_every_coefficient_may_fold(coefficient: int) -> None:
    """A negative numerator of the rational model folds, and so does a positive denominator."""
    distortion = tuple((3.0 if k > 4 else -3.0) if k == coefficient else 0.0 for k in range(8))
    with refused("folds"):
        check_lens("here", SIZE, (200.0, 200.0, 320.0, 240.0), distortion)


def test_fisheye_lenses() -> None:
    """Equidistant, a picture of 640 pixels across shows 640 / 100 radians at a focal length of 100: more than there is.

    A pinhole would show 145 degrees at that focal length.
    """
    check_lens("here", SIZE, (160.0, 160.0, 320.0, 240.0), NO_DISTORTION, is_fisheye=True)  # 143 degrees at the corner
    check_lens("here", SIZE, (400.0, 400.0, 320.0, 240.0), full(-0.02, 0.01, 0, 0, -0.004, 0.001), is_fisheye=True)
    with refused("more than 170 degrees"):
        check_lens("here", SIZE, (100.0, 100.0, 320.0, 240.0), NO_DISTORTION, is_fisheye=True)
    with refused("fisheye distortion k1 -0.4 folds"):
        check_lens("here", SIZE, (300.0, 300.0, 320.0, 240.0), full(-0.4), is_fisheye=True)


SCALES = {
    "k1 k2 p1 p2": [1.0, 1.0, 0.1, 0.1, 0, 0, 0, 0],
    "rational": [1.0, 1.0, 0.1, 0.1, 0.5, 1.0, 1.0, 0.5],
    "fisheye": [0.3, 0.2, 0, 0, 0.1, 0.1, 0, 0],
}


@pytest.mark.parametrize("model", SCALES)
@pytest.mark.parametrize("seed", range(60))
def test_accepted_lenses_are_inverted_over_the_whole_picture(seed: int, model: str) -> None:
    rng = np.random.default_rng(seed)
    coefficients = rng.normal(0, 1, 8) * SCALES[model] * 10 ** rng.uniform(-2, 1)
    is_fisheye = model == "fisheye"
    fl_x, fl_y, cx, cy = lens = (*rng.uniform(200, 900, 2), rng.uniform(-100, 740), rng.uniform(-100, 580))
    try:
        check_lens("here", SIZE, lens, tuple(coefficients), is_fisheye)
    except DatasetError:
        return
    i, j = (axis.ravel() for axis in np.meshgrid(np.linspace(0, 640, 33), np.linspace(0, 480, 25)))
    x, y = (i - cx) / fl_x, (j - cy) / fl_y
    u, v = undistort(x, y, np.tile(coefficients, (len(x), 1)), np.full(len(x), is_fisheye))
    back_x, back_y, (xx, yy, xy) = distort(u, v, tuple(coefficients), is_fisheye)
    np.testing.assert_allclose(np.stack([back_x, back_y]), np.stack([x, y]), atol=1e-9)
    assert (xx * yy - xy * xy > 0).all()  # on the branch that holds the principal point


@pytest.mark.parametrize(
    ("change", "words"),
    [
        (np.diag([-1.0, 1, 1, 1]), "mirrored"),
        (np.diag([2.0, 2, 2, 1]), "scaled"),
        (np.diag([1.0, 1.1, 1, 1]), "scaled"),
        (np.array([[1.0, 0.1, 0, 0], [0, 1, 0, 0], [0, 0, 1, 0], [0, 0, 0, 1]]), "skewed"),
        (np.diag([0.0, 0, 0, 1]), "scaled"),
        (np.diag([1.0, 1, 1, NAN]), "NaN"),
        (np.diag([1.0, 1, 1, 2]), "last row"),
        (np.array([[1.0, 0, 0, 1e30], [0, 1, 0, 0], [0, 0, 1, 0], [0, 0, 0, 1]]), "larger than"),
        (np.eye(4)[:2], "shape"),
    ],
)
def test_poses_that_do_more_than_turn_and_shift(change: np.ndarray, words: str) -> None:
    with refused(words):
        check_pose("here", change @ TURNED)


def test_a_transposed_pose_is_named() -> None:
    with refused("transposed"):
        check_pose("here", TURNED.T)


def test_poses_come_back_with_unit_axes() -> None:
    assert np.array_equal(check_pose("here", TURNED), TURNED) and np.array_equal(check_pose("here", TURNED[:3]), TURNED)
    rounded = TURNED.copy()
    rounded[:3, :3] *= 1.003
    np.testing.assert_allclose(check_pose("here", rounded), TURNED, atol=1e-15)
    assert NUMBER_LIMIT <= BOX_LIMIT  # a file holds every camera that is accepted


@pytest.mark.parametrize(
    "ends", [(1.0, 1.0), (2.0, 1.0), (0.0, 1.0), (-1.0, 1.0), (1.0, INF), (-1.0, NAN), (NAN, -1.0)]
)
def test_depth_ranges_that_are_none(ends: tuple[float, float]) -> None:
    with refused("near"):
        check_depths("here", *ends)


def test_unknown_depths_are_accepted() -> None:
    for ends in ((1.0, 2.0), (NAN, NAN), (1.0, NAN), (NAN, 2.0)):
        check_depths("here", *ends)


@pytest.mark.parametrize("text", ["NaN", "-Infinity", "1e400", '"5"', "true", "null", "[1]", "1" + 400 * "0", "1e30"])
def test_numbers_of_a_document(text: str) -> None:
    with refused("missing", "not a number", "NaN, infinite or larger"):
        number_of("here", json.loads(f'{{"k": {text}}}'), "k", 1.0)


FRAME = {"w": 48, "h": 36, "fl_x": 40.0, "transform_matrix": TURNED.tolist()}


@pytest.mark.parametrize(
    ("change", "words"),
    [
        ({"transform_matrix": (TURNED @ np.diag([-1.0, 1, 1, 1])).tolist()}, "mirrored"),
        ({"transform_matrix": TURNED.ravel().tolist()}, "not 4x4"),
        ({"transform_matrix": [["1", 0, 0, 0], [0, 1, 0, 0], [0, 0, 1, 0]]}, "not a number"),
        ({"camera_model": "OPENCV_FISHEYE", "k1": 0.2}, "OPENCV_FISHEYE"),
        ({"camera_model": "SIMPLE_RADIAL_FISHEYE"}, "SIMPLE_RADIAL_FISHEYE is not rendered"),
        ({"camera_model": "FOV"}, "FOV is not supported"),
        ({"camera_model": ["PINHOLE"]}, "not supported"),
        ({"is_fisheye": True}, "fisheye"),
        ({"k3": 0.1}, "not rendered"),
        ({"distortion_params": [0, 0, 0, 0, 0, 1e-3]}, "not rendered"),
        ({"camera_type": "equirectangular"}, "equirectangular"),
        ({"k1": 0.1}, "not rendered"),
        ({"K1": 0.1}, "the key 'K1' is not read; write it k1"),
        ({"lens": "fish-eye"}, "lens: fish-eye is not supported"),
        ({"vr180": 1}, "vr180 is not supported"),
        ({"w": "48"}, "not a number"),
        ({"w": True}, "not a number"),
        ({"w": 48.5}, "whole pixels"),
        ({"w": MAX_SIDE + 1}, "too large"),
        ({"h": 0}, "empty"),
        ({"fl_x": 1e-9}, "does not fit"),
        ({"time": NAN}, "time is NaN"),
        ({"at": INF}, "at is NaN"),
    ],
)
def test_camera_files_are_refused_in_one_line(tmp_path: Path, change: dict[str, Any], words: str) -> None:
    file = tmp_path / "c.json"
    file.write_text(json.dumps({"camera_model": "OPENCV", **dict.fromkeys(DISTORTION_KEYS, 0.0), "frames": [FRAME]}))
    assert load_views(file)[0].camera.fl_x == 40.0
    file.write_text(json.dumps({"title": "Fisheye", "frames": [FRAME | {"file": "fisheye/vr180.png"}]}))
    assert load_views(file)[0].file == "fisheye/vr180.png"
    file.write_text(json.dumps({"frames": [FRAME, FRAME | change]}))
    with pytest.raises(DatasetError, match=rf"c\.json frame 1: [^\n]*{words}[^\n]*\Z"):
        load_views(file)


@pytest.mark.parametrize("name", [{}, {"file": None}, {"file": ""}])
def test_views_without_a_name_are_numbered(tmp_path: Path, name: dict[str, Any]) -> None:
    nameless = {key: value for key, value in FRAME.items() if key != "file"}
    (tmp_path / "c.json").write_text(json.dumps({"frames": [FRAME, nameless | name]}))
    assert load_views(tmp_path / "c.json")[1].file == "0001.png"
