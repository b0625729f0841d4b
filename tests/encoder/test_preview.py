"""The preview of a run: its picture, what moves in it, and the box."""

from pathlib import Path

import numpy as np
import pytest
from PIL import ImageFont

from kpc.encoder.datasets import Dataset
from kpc.encoder.evaluation import preview as module
from kpc.encoder.evaluation.ground_truth import ground_truth
from kpc.encoder.evaluation.preview import BOX_COLOUR, CAPTION_HEIGHT, Preview, box_edges
from kpc.format.common.images import read_image
from training_runs import trainer


def test_a_preview_shows_the_scene_beside_the_truth(moving: Dataset, tmp_path: Path) -> None:
    run, path = trainer(moving), tmp_path / "out.preview.png"
    preview = Preview(moving, path)
    assert moving.pictures.is_test[preview.number]
    preview.update(run, 7)
    image = read_image(path)
    height, width = moving.pictures.height[preview.number], moving.pictures.width[preview.number]
    length = ImageFont.load_default().getlength(preview.caption(np.zeros_like(preview.truth), 7))
    assert length > 2 * width  # the caption makes the picture wider
    assert image.shape == (height + CAPTION_HEIGHT, pytest.approx(length, abs=12), 3)
    ink = np.flatnonzero(image[height:].any(axis=(0, 2)))
    assert image.shape[1] - 12 < ink[-1] < image.shape[1] - 1  # to its last letter
    truth = (255 * ground_truth(moving, preview.number) + 0.5).astype(np.uint8)
    shown = image[:height, width : 2 * width]
    is_box = (shown == BOX_COLOUR).all(axis=-1)
    np.testing.assert_array_equal(shown[~is_box], truth[~is_box])
    path.unlink()
    preview.update(run, 8)  # too soon for another
    assert not path.exists()
    assert preview.caption(preview.truth, 1200) == "step 1,200, PSNR 100.0 dB"
    preview.moving[:5] = True
    assert preview.caption(preview.truth, 1200) == "step 1,200, moving 100.0 dB, still 100.0 dB"


def test_large_pictures_are_previewed_small(moving: Dataset, tmp_path: Path, monkeypatch) -> None:  # type: ignore[no-untyped-def]
    monkeypatch.setattr(module, "SIDE", 10)
    preview = Preview(moving, tmp_path / "out.preview.png")
    assert max(preview.truth.shape[:2]) <= 10
    preview.write(trainer(moving), 1)
    assert read_image(preview.path).shape[0] == preview.truth.shape[0] + CAPTION_HEIGHT


def test_edges_of_the_box_end_at_its_corners(moving: Dataset) -> None:
    """A small box in the middle of the view: twelve edges, whose extent is that of the projected corners."""
    small = np.array([[-0.1] * 3, [0.1] * 3], np.float32)
    lines = np.array(box_edges(moving, 0, small, 2))
    assert lines.shape == (12 * 32, 2, 2)
    camera = moving.camera(0)
    corners = np.stack(np.meshgrid(*small.T), axis=-1).reshape(-1, 3)
    local = (corners - camera.camera_to_world[:3, 3]) @ camera.camera_to_world[:3, :3]
    x = (camera.cx - camera.fl_x * local[:, 0] / local[:, 2]) / 2
    np.testing.assert_allclose([lines[..., 0].min(), lines[..., 0].max()], [x.min(), x.max()], atol=1e-6)
