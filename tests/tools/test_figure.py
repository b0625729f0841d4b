"""The dancing figure: it loads as D-NeRF's scenes do, rays hit its parts, and the box that is found holds its hands."""

from pathlib import Path

import numpy as np
import pytest

from kpc.encoder.datasets import load_dataset
from kpc.encoder.field.config import TrainConfig
from kpc.encoder.training.tight_bounds import trim_box
from kpc.format.common.images import read_image
from kpc.tools.dev import figure
from kpc.tools.dev.figure import Options, cameras, entry, parts, picture

SMALL = Options(pictures=40, tests=2, size=64, samples=1)


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("figure") / "small"
    arguments = [str(folder), "--pictures", "40", "--tests", "2", "--size", "64", "--samples", "1"]
    assert figure.main(arguments) == 0
    return folder


def extent() -> tuple[np.ndarray, np.ndarray]:
    """Return the corners, (3,) each, of what the figure reaches in the pictures that are trained on."""
    shown = [part for k in range(SMALL.pictures) for part in parts(k / (SMALL.pictures - 1))]
    ends = np.array([(part.start, part.end) for part in shown])
    radii = np.array([part.radius for part in shown])[:, None, None]
    return (ends - radii).min((0, 1)), (ends + radii).max((0, 1))


def test_it_loads_as_a_single_object_of_one_moving_camera(folder: Path, tmp_path: Path) -> None:
    dataset = load_dataset(folder, tmp_path, progress=False)
    described = "Blender: 42 cameras, 42 pictures of 64x64, 2 of them held out, dynamic"
    assert described in dataset.describe() and dataset.has_alpha
    for n, camera in enumerate(cameras(SMALL.pictures, SMALL, 0)):
        np.testing.assert_allclose(dataset.camera(n).camera_to_world, camera.camera_to_world, atol=1e-6)
    np.testing.assert_array_equal(read_image(folder / "train" / "r_039.png"), picture(dataset.camera(39), 1.0, SMALL))


def test_rays_enter_a_capsule_at_its_surface() -> None:
    part = parts(0.3)[2]
    rng = np.random.default_rng(0)
    origin = np.array([2.0, -1.0, 0.5])
    aims = part.start + rng.uniform(-0.4, 0.8, (500, 1)) * part.turn[:, 2] + rng.normal(0, 0.05, (500, 3))
    directions = (aims - origin) / np.linalg.norm(aims - origin, axis=1, keepdims=True)

    def distance(points: np.ndarray) -> np.ndarray:
        height = np.clip((points - part.start) @ part.turn[:, 2], 0, part.length)
        return np.linalg.norm(points - part.start - height[..., None] * part.turn[:, 2], axis=-1) - part.radius

    t = entry(part, origin, directions)
    hit = np.isfinite(t)
    assert 50 < hit.sum() < 450
    np.testing.assert_allclose(distance(origin + t[hit, None] * directions[hit]), 0, atol=1e-9)
    along = np.linspace(0, 5, 4001)
    least = distance(origin + along[:, None, None] * directions).min(0)
    assert (least[~hit] > 0).all() and (least[hit] < 1e-3).all()


@pytest.mark.usefixtures("one_thread")
def test_the_box_holds_limbs_that_move_fast(folder: Path, tmp_path: Path) -> None:
    """The coarse field has not found hands that are elsewhere in each picture; their silhouettes show where they go."""
    dataset = load_dataset(folder, tmp_path, progress=False)
    config = TrainConfig(steps=1500, rays=256, samples=12288, warmup=5)
    large = np.array([[-2, -2, -2], [2, 2, 2]], np.float32)
    box, _ = trim_box(dataset, config, large, lambda report: None)
    low, high = extent()
    assert (box[0] < low + 0.1).all() and (high - 0.1 < box[1]).all()
    assert np.prod(box[1] - box[0]) < 2 * np.prod(high - low)


@pytest.mark.parametrize("option", ["--pictures=1", "--size=4", "--samples=0", "--turns=nan", "--seed=-1"])
def test_impossible_figures_are_refused(tmp_path: Path, option: str, capsys: pytest.CaptureFixture[str]) -> None:
    assert figure.main([str(tmp_path / "out"), option]) == 2
    assert capsys.readouterr().err.startswith("figure: ") and not (tmp_path / "out").exists()
