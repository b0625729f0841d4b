"""Where something may move: where all cameras that stand still see a change at once, and nowhere else."""

from pathlib import Path

import datasets as make
import numpy as np
import pytest

from kpc.encoder import movers
from kpc.encoder.box import cell_centres, seen_cells
from kpc.encoder.config import TrainConfig
from kpc.encoder.datasets import Dataset, load_dataset
from kpc.encoder.movers import moving_cells
from kpc.encoder.train import Trainer
from kpc.format.cameras import Camera
from kpc.format.media import write_image

BOX = np.array([[-1, -1, -1], [1, 1, 1]], np.float32)
SHAPE = (20, 20, 20)
TIMES = 8
RADIUS = 0.2


def centre(time: float) -> np.ndarray:
    """Of the ball: along x from one side to the other, and nowhere twice."""
    return np.array([-0.6 + 1.2 * time, 0.1, -0.1])


def film(folder: Path, cameras: list[Camera], shown: int | None = None, masked: bool = False, flash: int = -1) -> Dataset:
    """A white ball before grey, as discs; the first `shown` cameras see it, the others an empty picture. All is lighter at time `flash`."""
    (folder / "set/images").mkdir(parents=True)
    frames = []
    for k, camera in enumerate(cameras):
        for t in range(TIMES):
            time = t / (TIMES - 1)
            pose = camera.camera_to_world
            at = pose[:3, :3].T @ (centre(time) - pose[:3, 3])
            row, column = np.mgrid[: camera.height, : camera.width] + 0.5
            x, y = camera.cx - camera.fl_x * at[0] / at[2], camera.cy + camera.fl_y * at[1] / at[2]
            disc = np.hypot(column - x, row - y) < RADIUS * camera.fl_x / -at[2]
            picture = np.full((camera.height, camera.width, 3), 150 if t == flash else 60, np.uint8)
            if shown is None or k < shown:
                picture[disc] = 240
            write_image(folder / f"set/images/{k}_{t}.png", picture)
            if masked:
                make.write_mask(folder / f"set/masks/{k}_{t}.png", ~disc)
            frames.append({"file_path": f"images/{k}_{t}.png", "transform_matrix": pose.tolist(), "time": time,
                           "w": camera.width, "h": camera.height, "fl_x": camera.fl_x, "fl_y": camera.fl_y,
                           "cx": camera.cx, "cy": camera.cy})  # fmt: skip
    (folder / "set/transforms.json").write_text(make.json.dumps({"test_filenames": [], "frames": frames}))
    return load_dataset(folder / "set", folder / "cache", progress=False)


def rig() -> list[Camera]:
    return make.ring(6, width=192, height=192)


@pytest.fixture(scope="module")
def filmed(tmp_path_factory: pytest.TempPathFactory) -> Dataset:
    return film(tmp_path_factory.mktemp("ball"), rig())


def distance(slot: int) -> np.ndarray:
    """Of the middle of each cell from the ball at the only picture of a slot, in the shape of the grid."""
    found: np.ndarray = np.linalg.norm(cell_centres(BOX, SHAPE) - centre(slot / (TIMES - 1)), axis=1).reshape(SHAPE)
    return found


def test_the_ball_is_found_at_each_instant_and_little_else(filmed: Dataset) -> None:
    cells = moving_cells(filmed, BOX, SHAPE, TIMES)
    assert cells.shape == (TIMES, *SHAPE) and cells.dtype == bool
    for slot in range(TIMES):
        assert cells[slot][distance(slot) < 0.9 * RADIUS].mean() > 0.97
        assert cells[slot].mean() < 0.05 and cells[slot][distance(slot) < 2 * RADIUS].sum() > 0.7 * cells[slot].sum()


def test_a_slot_holds_all_that_its_pictures_show(filmed: Dataset) -> None:
    each, halves = moving_cells(filmed, BOX, SHAPE, TIMES), moving_cells(filmed, BOX, SHAPE, 2)
    assert (halves[0] >= each[: TIMES // 2].any(0)).all() and (halves[1] >= each[TIMES // 2 :].any(0)).all()
    assert not halves[0][distance(TIMES - 1) < RADIUS].any()


@pytest.mark.parametrize("shown, found", [(6, True), (5, True), (4, False), (1, False), (0, False)])
def test_three_quarters_of_the_cameras_must_agree(tmp_path: Path, shown: int, found: bool) -> None:
    cells = moving_cells(film(tmp_path, rig(), shown), BOX, SHAPE, TIMES)
    assert cells[:, 10, 10, 10].any() == cells.any() == found


def test_what_is_masked_out_tells_nothing(tmp_path: Path) -> None:
    assert not moving_cells(film(tmp_path, rig(), masked=True), BOX, SHAPE, TIMES).any()


def test_where_light_changes_nothing_is_told(tmp_path: Path) -> None:
    flashed = moving_cells(film(tmp_path, rig(), flash=3), BOX, SHAPE, TIMES)
    assert flashed.any((1, 2, 3)).tolist() == [slot != 3 for slot in range(TIMES)]


def test_bands_make_no_difference(filmed: Dataset, monkeypatch: pytest.MonkeyPatch) -> None:
    whole = moving_cells(filmed, BOX, SHAPE, TIMES)
    monkeypatch.setattr(movers, "ROWS", movers.TILE)
    np.testing.assert_array_equal(moving_cells(filmed, BOX, SHAPE, TIMES), whole)


@pytest.mark.usefixtures("one_thread")
@pytest.mark.parametrize("stay", [True, False])
def test_training_takes_samples_where_something_may_move(filmed: Dataset, stay: bool) -> None:
    """All density is taken away; updates then empty every other cell."""
    config = TrainConfig(resolutions=(16,), cells_across=20, steps=100, movers_stay_open=stay)
    trainer = Trainer(filmed, config, BOX, "cpu")
    trainer.field.density.data[:] = 0
    trainer.field.density.data[-1] = -20
    for _ in range(100):
        trainer.grid.update(lambda points, times: np.full(len(points), -20.0, np.float32), np.zeros(SHAPE, np.float32), trainer.rng)
    expected = moving_cells(filmed, BOX, SHAPE, TIMES) & seen_cells(filmed.pictures, BOX, SHAPE)
    assert expected.any() and not trainer.grid.occupied.any()
    np.testing.assert_array_equal(np.broadcast_to(trainer.grid.marched, expected.shape), expected & stay)
    assert (trainer.grid.over_time(trainer.density_at, trainer.rng, TIMES) == 0).all()
