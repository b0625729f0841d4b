"""The generated scene: files load, cameras and objects are where they should be, culling changes nothing."""

import hashlib
import json
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from kpc.encoder.datasets import load_dataset, pixel_rays
from kpc.format.common.images import read_image
from kpc.format.scene.cameras import Camera, load_views
from kpc.tools.dev import scene_geometry, scenegen
from kpc.tools.dev.scene_geometry import BALL, BEAD, CONTENTS, RING, moving_objects
from kpc.tools.dev.scenegen import FixedCamera, Options, novel_cameras, rig

TINY = Options(cameras=3, frames=3, width=40, height=30, samples=1)


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("scene") / "tiny"
    arguments = [str(folder), "--cameras", "3", "--frames", "3", "--size", "40x30", "--samples", "1"]
    assert scenegen.main(arguments) == 0
    return folder


def project(camera: Camera, point: np.ndarray) -> tuple[float, float]:
    """Return column and row in pixels from the left and top edges."""
    right, up, back = camera.camera_to_world[:3, :3].T @ (point - camera.camera_to_world[:3, 3])
    return camera.cx - camera.fl_x * right / back, camera.cy + camera.fl_y * up / back


def test_files_load_as_a_dataset(folder: Path, tmp_path: Path) -> None:
    dataset = load_dataset(folder, tmp_path, progress=False)
    described = "N3DV: 3 cameras, 9 pictures of 40x30, 3 of them held out (cam00), dynamic, 3 frames at 12 fps"
    assert described in dataset.describe()
    for n, camera in enumerate(rig(TINY)):
        np.testing.assert_allclose(dataset.camera(3 * n).camera_to_world, camera.camera_to_world, atol=1e-12)
    shots = load_views(folder / "gt" / "cameras.json")
    assert {s.file.split("_")[0] for s in shots} == {"cam00", "novel00", "novel01", "novel02", "novel03"}
    for shot in shots:
        assert read_image(folder / "gt" / shot.file).shape == (30, 40, 3)
    first = next(s for s in shots if s.file == "cam00_f000.png")
    np.testing.assert_allclose(first.camera.camera_to_world, dataset.camera(0).camera_to_world, atol=1e-12)
    error = dataset.pixels.picture(0).astype(float) - read_image(folder / "gt" / first.file)
    assert 10 * np.log10(255**2 / np.mean(error**2)) > 36  # crf 14


def test_the_ball_is_where_the_poses_say(folder: Path, tmp_path: Path) -> None:
    """The centroid of the ball's colour lies at its projected centre, up to the pixel grid and the shading."""
    dataset = load_dataset(folder, tmp_path, progress=False)
    p = dataset.pictures
    for n in range(len(p)):
        picture = dataset.pixels.picture(n).astype(float)
        column, row = project(dataset.camera(n), moving_objects(float(p.time[n]))[0].centre)
        coral = (
            (picture[..., 0] > 120)
            & (picture[..., 0] > 1.6 * picture[..., 1])
            & (picture[..., 0] > 1.6 * picture[..., 2])
        )
        j, i = np.nonzero(coral)
        assert len(i) >= 4
        assert np.hypot(i.mean() + 0.5 - column, j.mean() + 0.5 - row) < 1.5


def test_surfaces_lie_between_near_and_far(folder: Path, tmp_path: Path) -> None:
    """Along the loader's own rays, depth stays between near and far, and far is a tight bound."""
    dataset = load_dataset(folder, tmp_path, progress=False)
    p = dataset.pictures
    for n in range(0, len(p), 3):
        row, column = np.divmod(np.arange(40 * 30), 40)
        origins, directions = (a.T.copy() for a in pixel_rays(p, np.full(1200, n), column, row))
        far = np.full(1200, 20, np.float32)
        t = scene_geometry.sphere_trace(scene_geometry.static_distance, origins, directions, 0 * far, far)
        assert np.isfinite(t).all()  # every ray ends on a surface
        depth = t * (directions.T @ -p.camera_to_world[n, :3, 2].astype(np.float32))
        assert p.near[n] < depth.min() and depth.max() < p.far[n] < 1.2 * depth.max()


def test_rig_is_forward_facing() -> None:
    cameras = rig(Options())
    centres = np.array([c.camera_to_world[:3, 3] for c in cameras])
    distance = np.linalg.norm(centres - scenegen.TARGET, axis=1)
    assert 0.3 < np.ptp(centres @ cameras[0].camera_to_world[:3, 0]) / distance.mean() < 0.5
    for camera in (*cameras, *novel_cameras(Options())):
        np.testing.assert_allclose(project(camera, np.array(scenegen.TARGET)), (camera.cx, camera.cy), atol=1e-9)
    assert np.linalg.norm(centres - centres[0], axis=1)[1:].min() > 0.2


def test_distance_functions_never_overstep() -> None:
    """|d(p) - d(q)| <= |p - q| up to the fillet of the vase, so that sphere tracing misses no surface."""
    rng = np.random.default_rng(0)
    p = rng.uniform([-1.7, -1.5, 0], [2.2, 1.5, 1.6], (20000, 3)).T.astype(np.float32)
    step = rng.normal(size=p.shape).astype(np.float32)
    step *= 0.01 / np.linalg.norm(step, axis=0)
    for distance in (scene_geometry.static_distance, *(moving.distance for moving in moving_objects(0.3))):
        assert np.abs(distance(p + step) - distance(p)).max() < 0.01 * 1.05


@pytest.mark.parametrize("time", [0.0, 0.4])
def test_culling_changes_nothing(monkeypatch: pytest.MonkeyPatch, time: float) -> None:
    """Bounding spheres as large as the room turn culling off; only the sampling of penumbras may differ."""
    culled = FixedCamera(rig(TINY)[0], TINY).picture(time)

    def everywhere(time: float, *content: scene_geometry.Content) -> tuple[scene_geometry.MovingObject, ...]:
        return tuple(replace(moving, radius=6.0) for moving in moving_objects(time, *content))

    monkeypatch.setattr("kpc.tools.dev.scene_shading.moving_objects", everywhere)
    whole = FixedCamera(rig(TINY)[0], TINY).picture(time)
    difference = np.abs(culled.astype(int) - whole)
    assert difference.max() <= 12 and (difference > 2).mean() < 0.01


def test_both_moving_objects_move_and_the_rest_is_static() -> None:
    film = FixedCamera(rig(TINY)[0], TINY)
    a, b = film.picture(0.1).astype(int), film.picture(0.35)
    moved = np.abs(a - b).max(2) > 3
    assert 0.02 < moved.mean() < 0.35
    for moving in moving_objects(0.1):
        column, row = project(film.camera, moving.centre)
        r = moving.radius * film.camera.fl_x / 3.5
        assert moved[int(row - r) : int(row + r), int(column - r) : int(column + r)].any()
    np.testing.assert_array_equal(film.picture(0.0), film.picture(1.0))  # the clip loops


def test_the_same_seed_gives_the_same_files(folder: Path, tmp_path: Path) -> None:
    assert (
        scenegen.main([str(tmp_path / "again"), "--cameras", "3", "--frames", "3", "--size", "40x30", "--samples", "1"])
        == 0
    )
    assert digests(tmp_path / "again") == digests(folder)
    first, second = (
        FixedCamera(rig(o)[1], o).picture(0.0)
        for o in (TINY, Options(seed=1, cameras=3, width=40, height=30, samples=1))
    )
    assert (first != second).any()


def digests(folder: Path) -> dict[str, str]:
    return {
        str(f.relative_to(folder)): hashlib.sha256(f.read_bytes()).hexdigest()
        for f in sorted(folder.rglob("*"))
        if f.is_file()
    }


@pytest.mark.parametrize(
    "arguments", [["--size", "big"], ["--size", "4x4"], ["--cameras", "1"], ["--frames", "0"], ["--fps", "0"]]
)
def test_usage_errors(tmp_path: Path, arguments: list[str], capsys: pytest.CaptureFixture[str]) -> None:
    assert scenegen.main([str(tmp_path / "x"), *arguments]) == 2
    assert len(capsys.readouterr().err.splitlines()) == 1
    assert not (tmp_path / "x").exists()


def test_folder_that_cannot_be_made(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    (tmp_path / "file").write_text("x")
    assert scenegen.main([str(tmp_path / "file" / "x"), "--frames", "1"]) == 1
    assert len(capsys.readouterr().err.splitlines()) == 1


def test_ground_truth_json_is_what_the_renderers_read(folder: Path) -> None:
    document = json.loads((folder / "gt" / "cameras.json").read_text())
    assert {"w", "h", "fl_x", "fl_y", "cx", "cy", "frames"} == set(document)
    assert all({"file", "time", "transform_matrix"} <= set(frame) for frame in document["frames"])


def test_smaller_contents_are_parts_of_the_same_room() -> None:
    """Half of the objects and patterns, and a quarter; what stays looks the same except for missing shadows."""
    moving = {name: len(moving_objects(0.3, content)) for name, content in CONTENTS.items()}
    assert moving == {"full": 2, "half": 1, "quarter": 1}
    camera, pictures = rig(TINY)[0], {}
    walls = {scene_geometry.FLOOR, scene_geometry.BACK_WALL, scene_geometry.SIDE_WALL, scene_geometry.BOARD}
    for name, content in CONTENTS.items():
        film = FixedCamera(camera, replace(TINY, content=name))
        pictures[name] = film.picture(0.3).astype(int)
        shown = set(np.unique(film.view.material))
        assert shown - content.objects == walls
        assert shown & content.objects == content.objects - {BALL, RING, BEAD}
        assert len(content.patterns) == {"full": 4, "half": 2, "quarter": 1}[name]
    # The rug lies in the lower middle of the picture, the ball above it.
    same = [np.abs(pictures[name] - pictures["full"]).max(2)[22:27, 12:26] for name in ("half", "quarter")]
    assert all((difference <= 2).mean() > 0.9 for difference in same)
    detail = {name: np.abs(np.diff(picture, axis=1)).mean() for name, picture in pictures.items()}
    assert detail["full"] > detail["half"] > detail["quarter"]


def test_contents_are_chosen_on_the_command_line(tmp_path: Path) -> None:
    words = ["--cameras", "2", "--frames", "1", "--size", "24x16", "--samples", "1"]
    for name in CONTENTS:
        assert scenegen.main([str(tmp_path / name), *words, "--content", name]) == 0
    assert scenegen.main([str(tmp_path / "default"), *words]) == 0
    assert digests(tmp_path / "default") == digests(tmp_path / "full")
    assert len({digests(tmp_path / name)["gt/cam00_f000.png"] for name in CONTENTS}) == 3
