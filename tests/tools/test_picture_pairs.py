"""kpbench pictures: which views are kept, and what their error maps show."""

import base64
import io
import json
from pathlib import Path

import numpy as np
import pytest
from PIL import Image

import datasets as make
from kpc.encoder.coding.scene_writer import encode
from kpc.encoder.evaluation.evaluate import Comparison
from kpc.format.coding.quantise import quantise_scene
from kpc.tools.bench import harness, kpbench, picture_pairs
from kpc.tools.bench.report import page
from scenes import tiny_scene

pytestmark = pytest.mark.usefixtures("one_thread")


def test_the_worst_and_the_median_view_are_kept(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    make.write_n3dv(tmp_path / "set", frames=5, width=40, height=30)
    scene = tiny_scene()
    (tmp_path / "tiny.kpc").write_bytes(
        encode(quantise_scene(scene, [dict.fromkeys(scale, 0.01) for scale in scene.scales]))
    )
    monkeypatch.setattr(harness, "isolated", lambda work, job: work(job))
    monkeypatch.setattr(picture_pairs, "MOST_ACROSS", 20)
    out = tmp_path / "pictures.json"
    assert kpbench.main(["pictures", str(tmp_path / "tiny.kpc"), str(tmp_path / "set"), "--out", str(out)]) == 0
    (found,) = page.read(out)
    assert not found.fault
    (record,) = json.loads(out.read_text())
    worst, median = record["views"]
    (means,) = record["repeats"]
    assert (worst["choice"], median["choice"], means["pictures"]) == ("the worst of 5", "the median of 5", 5)
    assert worst["psnr"] < means["psnr"] and worst["psnr"] < median["psnr"] and worst["frame"] != median["frame"]
    for name in page.SHOWN:
        image = Image.open(io.BytesIO(base64.b64decode(worst[name])))
        assert image.size == (worst["width"], worst["height"]) == (20, 15) and image.format == "WEBP"
    assert "moving" in capsys.readouterr().err


def test_error_maps_have_a_colour_for_each_part_and_none_where_nothing_counts() -> None:
    truth = np.full((1, 4, 3), 0.5, np.float32)
    picture = truth + np.float32([0, 0.1, 0.4, 0.4])[None, :, None]
    usable = np.array([[True, True, True, False]])
    moving = np.array([[False, False, True, True]])
    found = picture_pairs.error_map(Comparison(picture, truth, usable, 0), moving)
    half_still = 0.5 * np.float32(picture_pairs.STILL_COLOUR) / 255
    expected = [[0, 0, 0], half_still, np.float32(picture_pairs.MOVING_COLOUR) / 255, [0, 0, 0]]
    np.testing.assert_allclose(found[0], np.float32(expected), atol=1e-6)
