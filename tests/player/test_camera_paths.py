import itertools
import json
import math
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from hypothesis.extra import numpy as hnp

from kpc.format.common.errors import DatasetError
from kpc.format.scene.cameras import Camera, View, load_views, save_views
from kpc.format.scene.rotations import quaternion_of, rotation_of
from kpc.player.app.camera_paths import GAP_S, CameraPath
from scenes import look_at

VIEWS = tuple(
    look_at((3 * math.cos(a), 0.7 + 0.2 * a, 3 * math.sin(a)), (0.1, 0.05, 0.05), 48, 36, 50.0 + 10 * a)
    for a in (0.0, 0.9, 2.1, 4.0)
)


def path_of(
    times: tuple[float, ...] = (0.0, 0.2, 0.2, 0.9), ats: tuple[float | None, ...] = (0.0, 1.0, 4.0, 5.0)
) -> CameraPath:
    return CameraPath(
        tuple(
            View(view, time, f"{n}.png", at) for n, (view, time, at) in enumerate(zip(VIEWS, times, ats, strict=False))
        )
    )


@settings(max_examples=50, deadline=None)
@given(hnp.arrays(float, 4, elements=st.floats(-1, 1)).filter(lambda q: np.linalg.norm(q) > 1e-3))
def test_quaternions_and_rotations_are_inverse_to_each_other(q: np.ndarray) -> None:
    rotation = rotation_of(q)
    assert rotation @ rotation.T == pytest.approx(np.eye(3), abs=1e-12) and np.linalg.det(rotation) == pytest.approx(1)
    assert rotation_of(quaternion_of(rotation)) == pytest.approx(rotation, abs=1e-9)


def test_rotations_by_180_degrees_have_a_quaternion() -> None:
    for axis in range(3):
        turn = -np.eye(3)
        turn[axis, axis] = 1
        assert rotation_of(quaternion_of(turn)) == pytest.approx(turn, abs=1e-12)


def test_passes_every_keyframe_exactly() -> None:
    path = path_of()
    for keyframe in path.keyframes:
        camera, time = path.at(keyframe.at_s)
        assert camera.camera_to_world == pytest.approx(keyframe.camera.camera_to_world, abs=1e-9)
        assert (camera.fl_x, camera.fl_y, camera.cx, camera.cy, time) == pytest.approx(
            (keyframe.camera.fl_x, keyframe.camera.fl_y, keyframe.camera.cx, keyframe.camera.cy, keyframe.time)
        )
    assert path.at(-1.0)[1] == 0.0 and path.at(99.0)[1] == pytest.approx(0.9)


def test_the_path_is_smooth_and_takes_the_shorter_rotation() -> None:
    path, step = path_of(), 1e-3
    cameras = [path.at(s)[0] for s in np.arange(0, 5, step)]
    eyes = np.stack([camera.camera_to_world[:3, 3] for camera in cameras])
    axes = np.stack([camera.camera_to_world[:3, :3] for camera in cameras])
    for values in (eyes, axes.reshape(-1, 9)):
        speeds = np.diff(values, axis=0) / step
        assert np.abs(np.diff(speeds, axis=0)).max() < 0.05 * np.abs(speeds).max()  # no kink at a keyframe
    turned = np.arccos(np.clip((np.einsum("nij,nij->n", axes[1:], axes[:-1]) - 1) / 2, -1, 1)).sum()
    direct = [
        np.arccos((np.trace(a.camera_to_world[:3, :3].T @ b.camera_to_world[:3, :3]) - 1) / 2)
        for a, b in itertools.pairwise(VIEWS)
    ]
    assert turned < 1.15 * sum(direct)


def test_time_is_constant_between_equal_times_and_never_decreases() -> None:
    times = [path_of().at(s)[1] for s in np.arange(0, 5, 0.01)]
    assert np.diff(times).min() >= -1e-12 and set(np.round(times[100:400], 9)) == {0.2}


def test_an_earlier_time_is_reached_through_the_end_of_the_clip() -> None:
    times = np.array([path_of((0.5, 0.9, 0.3, 0.4)).at(s)[1] for s in np.arange(0, 5, 0.01)])
    drops = np.flatnonzero(np.diff(times) < 0)
    assert len(drops) == 1 and times[drops[0]] > 0.98 and times[drops[0] + 1] < 0.02
    assert ((times >= 0) & (times <= 1)).all()


def test_a_path_of_one_keyframe_does_not_move() -> None:
    path = CameraPath().with_keyframe(VIEWS[1], 0.3)
    assert path.at(7.0) == (VIEWS[1], 0.3) and len(path.views(30)) == 1 and path.start_s == path.end_s == 0.0


def test_keyframes_are_added_removed_and_spaced() -> None:
    path = CameraPath()
    for view in VIEWS:
        path = path.with_keyframe(view, 0.5)
    assert [keyframe.at_s for keyframe in path.keyframes] == [0, GAP_S, 2 * GAP_S, 3 * GAP_S]
    assert [keyframe.at_s for keyframe in path.without(1).keyframes] == [0, 2 * GAP_S, 3 * GAP_S]
    assert [keyframe.at_s for keyframe in path.spaced(2, 0.5).keyframes] == [0, GAP_S, GAP_S + 0.5, 2 * GAP_S + 0.5]
    assert path.without(0).at(0.0)[0].camera_to_world == pytest.approx(VIEWS[1].camera_to_world)


@settings(max_examples=60, deadline=None)
@given(
    st.lists(
        st.tuples(
            hnp.arrays(float, 4, elements=st.floats(-1, 1)).filter(lambda q: np.linalg.norm(q) > 1e-2),
            st.floats(0, 1),
            st.floats(1e-3, 1e3),
        ),
        min_size=2,
        max_size=6,
    ),
    st.lists(st.floats(0, 1), min_size=1, max_size=8),
)
def test_every_interpolated_camera_is_valid(keys: list[tuple[np.ndarray, float, float]], shares: list[float]) -> None:
    path = CameraPath()
    for quaternion, time, gap in keys:
        pose = np.eye(4)
        pose[:3, :3] = rotation_of(quaternion)
        path = path.with_keyframe(replace(VIEWS[0], camera_to_world=pose), time, gap)
    for share in shares:
        camera, time = path.at(share * path.end_s)
        axes = camera.camera_to_world[:3, :3]
        assert axes.T @ axes == pytest.approx(np.eye(3), abs=1e-6) and np.linalg.det(axes) > 0 and 0 <= time <= 1


def test_frames_of_a_video_are_evenly_spaced_and_include_both_ends() -> None:
    views = path_of().views(10)
    assert len(views) == 51 and views[10].time == pytest.approx(0.2) and views[-1].time == pytest.approx(0.9)
    assert views[0].camera.camera_to_world == pytest.approx(VIEWS[0].camera_to_world, abs=1e-9)


def test_a_path_survives_saving_and_loading(tmp_path: Path) -> None:
    path = path_of()
    path.save(tmp_path / "path.json")
    got = CameraPath.load(tmp_path / "path.json")
    assert len(load_views(tmp_path / "path.json")) == 4
    for one, other in zip(got.keyframes, path.keyframes, strict=True):
        assert (one.time, one.at_s, one.file, one.camera.fl_x, one.camera.width) == (
            other.time, other.at_s, other.file, other.camera.fl_x, other.camera.width
        )  # fmt: skip
        assert np.array_equal(one.camera.camera_to_world, other.camera.camera_to_world)


def test_views_without_times_are_evenly_spaced(tmp_path: Path) -> None:
    save_views(tmp_path / "c.json", [View(view, 0.1, "a.png") for view in VIEWS])
    assert "at" not in json.loads((tmp_path / "c.json").read_text())["frames"][0]
    assert CameraPath.load(tmp_path / "c.json").end_s == 3 * GAP_S


def test_keyframes_are_resized_to_the_first() -> None:
    path = CameraPath((View(VIEWS[0], 0, "a", 0.0), View(VIEWS[1].resized(96, 72), 0, "b", 1.0)))
    assert path.at(1.0)[0].fl_x == pytest.approx(VIEWS[1].fl_x) and path.at(1.0)[0].width == 48


MIRRORED = np.diag([-1.0, 1, 1, 1])


@pytest.mark.parametrize(("poses", "ats", "words"), [
    ([np.eye(4), np.eye(4)], [1.0, 1.0], "give it an `at` above 1, up to 86400"),
    ([np.eye(4), np.eye(4)], [2.0, 1.0], "does not follow"),
    ([np.eye(4)], [-1.0], "keyframe 1"),
    ([np.eye(4)], [math.nan], "at is NaN"),
    ([np.eye(4), np.eye(4)], [0.0, 1e9], "keyframe 2"),
    ([np.eye(4), MIRRORED], [0.0, 1.0], "mirrored"),
    ([np.diag([2.0, 2, 2, 1])], [0.0], "scaled"),
    ([np.full((4, 4), np.nan)], [0.0], "NaN"),
    ([np.eye(4)], ["soon"], "frame 0"),
])  # fmt: skip
def test_an_invalid_path_is_refused(tmp_path: Path, poses: list[np.ndarray], ats: list[float], words: str) -> None:
    frames = [{"transform_matrix": pose.tolist(), "at": at} for pose, at in zip(poses, ats, strict=False)]
    (tmp_path / "bad.json").write_text(json.dumps({"w": 4, "h": 4, "fl_x": 4, "frames": frames}))
    with pytest.raises(DatasetError, match=words) as caught:
        CameraPath.load(tmp_path / "bad.json")
    assert "bad.json" in str(caught.value) and "\n" not in str(caught.value)


@pytest.mark.parametrize(("text", "words"), [
    ("[" * 100_000, "not JSON"),
    ('{"w": Infinity, "h": 1, "fl_x": 1, "frames": [{}]}', "frame 0"),
    ('{"w": 1e9, "h": 1, "fl_x": 1, "frames": [{"transform_matrix": 0}]}', "too large"),
    ('{"frames": {"a": 1}}', "list of frames"),
    ("[]", "list of frames"),
    ("\udcff", "not JSON"),
])  # fmt: skip
def test_an_invalid_camera_file_is_refused(tmp_path: Path, text: str, words: str) -> None:
    (tmp_path / "bad.json").write_bytes(text.encode(errors="surrogateescape"))
    with pytest.raises(DatasetError, match=words):
        load_views(tmp_path / "bad.json")


def test_a_camera_file_that_is_too_large_is_refused(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("kpc.format.scene.cameras.MAX_FILE_BYTES", 1 << 10)
    (tmp_path / "big.json").write_text(" " * 2000)
    with pytest.raises(DatasetError, match="larger"):
        load_views(tmp_path / "big.json")


def test_a_camera_with_nan_is_refused() -> None:
    pose = np.eye(4)
    pose[1, 3] = np.nan
    with pytest.raises(DatasetError, match="NaN"):
        Camera(4, 4, 4.0, 4.0, 2.0, 2.0, pose)
