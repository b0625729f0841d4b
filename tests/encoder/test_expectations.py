"""What is said of how a dataset was filmed, before it is trained on."""

from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
from scipy import ndimage

import datasets as make
from kpc.encoder.evaluation.expectations import Expectations, expect
from kpc.encoder.field.bounds import find_box
from kpc.format.common.images import write_image

NOISE = np.random.default_rng(0).integers(40, 216, (24, 32, 3), dtype=np.uint8)


def expected(
    folder: Path, cameras: int, change: Callable[[int], np.ndarray] = lambda _: NOISE, is_static: bool = False
) -> Expectations:
    """Return what is expected of cameras on an arc of 57 degrees, half of which film each of two instants.

    Args:
        folder: for their pictures.
        change: returns the picture of a camera.
        is_static: whether they are photographs of one instant instead.
    """
    times = None if is_static else [0.0] * (cameras // 2) + [1.0] * (cameras - cameras // 2)
    files = [f"images/{number:04d}.png" for number in range(cameras)]
    make.write_nerfstudio(folder, cameras, times, near=1.5, far=4.5, train_filenames=files, test_filenames=[])
    for number, file in enumerate(files):
        write_image(folder / file, change(number))
    dataset = make.load(folder)
    return expect(dataset, find_box(dataset.pictures, dataset.has_alpha), None)


def test_a_dense_rig_is_described_without_warning(tmp_path: Path) -> None:
    found = expected(tmp_path / "set", 10)
    assert list(found.warnings()) == []
    assert found.is_rig and len(found.names) == 10
    aside = np.degrees(1 / 9) * 3 / np.hypot(3, 0.8)  # on the circle at the cameras' height
    assert found.neighbours == pytest.approx(np.full(10, aside), rel=0.01)
    assert found.seen[0] > found.seen[1] >= found.seen[2] > 0.2
    assert "10 cameras; 6.15 degrees from the next" in found.paragraph()
    assert "exposures of neighbours within 0.0 stops; none of 10 blurred" in found.paragraph()


def test_too_sparse_a_rig_is_warned_of(tmp_path: Path) -> None:
    assert not list(expected(tmp_path / "four", 4).warnings())  # 18 degrees apart
    sparse = expected(tmp_path / "two", 2, is_static=True)
    assert sparse.neighbours == pytest.approx([55, 55], abs=1)
    (line,) = sparse.warnings()
    assert "55 degrees from the next" in line and "5 to 12 degrees" in line


def test_a_camera_with_another_exposure_is_named(tmp_path: Path) -> None:
    (line,) = expected(tmp_path / "set", 6, lambda number: NOISE // 2 if number == 2 else NOISE).warnings()
    assert line.startswith("0002 is 1.0 stops darker than 0001 beside it") and "exposure locked" in line


def test_a_blurred_camera_is_named(tmp_path: Path) -> None:
    smooth = ndimage.gaussian_filter(NOISE.astype(float), (1.5, 1.5, 0))
    blurred = np.clip(128 + 3 * (smooth - 128), 0, 255).astype(np.uint8)
    (line,) = expected(tmp_path / "set", 6, lambda number: blurred if number == 4 else NOISE).warnings()
    assert line.startswith("less sharp than the others") and "0004" in line
