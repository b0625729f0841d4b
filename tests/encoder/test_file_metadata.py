"""What kpenc writes of a file: where it comes from, how it was made, and from where to look at it."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

import datasets as make
from kpc.encoder.cli import kpenc
from kpc.encoder.cli.metadata import describe, hash_dataset, reserve_figures, with_figures, with_view
from kpc.encoder.cli.options import Options, parse
from kpc.encoder.coding import scene_writer
from kpc.encoder.datasets import Dataset
from kpc.encoder.rdo.rate_control import Trade
from kpc.format.coding.quantise import quantise_scene
from kpc.format.container import scene_io
from kpc.format.container.metadata_chunk import pack_metadata
from kpc.format.scene.metadata import Metadata
from kpc.format.scene.rig import Rig
from kpc.format.scene.view_limits import find_view, view_members
from kpc.player.cpu import reference
from kpc.tools.vectors.metadata_vectors import FULL
from scenes import VARIANTS, tiny_scene

pytestmark = pytest.mark.usefixtures("one_thread", "quick_coding")


def scene_of_five():
    scene = tiny_scene(scales=1, channels=4, resolution=(10, 8, 6), time=3)
    rig = Rig.of(scene)
    return replace(scene, cameras=tuple(rig.camera(azimuth, 0.5, 3.0) for azimuth in (0.0, -0.4, -0.2, 0.2, 0.4)))


@pytest.fixture(scope="module")
def dataset(tmp_path_factory: pytest.TempPathFactory) -> Dataset:
    folder = tmp_path_factory.mktemp("metadata")
    make.write_n3dv(folder / "set", cameras=3, frames=2)
    return make.load(folder / "set")


def test_a_file_says_how_it_was_made(dataset: Dataset) -> None:
    options, *_ = parse(
        ["set", "-o", "out.kpc", "--title", "Me", "--seed", "5", "--tune-steps", "3", "--quality", "50", "--author", ""]
    )
    found = describe(options, dataset, scene_of_five(), [0, 2], "0" * 64)
    made = found.provenance
    assert found.title == "Me" and "author" not in found.document
    assert made["seed"] == 5 and made["encoder"].startswith("kpc ")
    assert made["options"] == {"tune_steps": 3, "quality": 50} and made["layout"] == "N3DV"
    assert found.camera_names == ("cam00", "cam01") and "transparent" not in found.document
    pack_metadata(found)  # a reader accepts it


def test_up_is_that_of_kpposes_if_it_found_the_cameras(dataset: Dataset) -> None:
    options, *_ = parse(["set", "-o", "out.kpc"])
    scene = scene_of_five()
    given, found = (
        describe(options, replace(dataset, poses_found=known), scene, [0, 2], "0" * 64) for known in (False, True)
    )
    assert given.up == pytest.approx(Rig.of(scene).up, abs=1e-3) and given.up != pytest.approx([0, 0, 1], abs=0.5)
    assert found.up == pytest.approx([0, 0, 1])
    pack_metadata(found)  # limits are perpendicular to it


def test_the_hash_of_a_dataset_is_that_of_its_files_and_cameras(dataset: Dataset) -> None:
    known = hash_dataset(dataset)
    assert known == hash_dataset(dataset)
    moved = replace(dataset.pictures, camera_to_world=dataset.pictures.camera_to_world + 1e-9)
    assert hash_dataset(replace(dataset, pictures=moved)) != known
    file = dataset.path / dataset.pictures.file[0]
    content = file.read_bytes()
    try:
        file.write_bytes(content + b"x")
        assert hash_dataset(dataset) != known
    finally:
        file.write_bytes(content)


def test_figures_are_added_and_leave_room_in_a_target_size() -> None:
    result = {"test_pictures": 2, "test_psnr": 30.123456789, "test_ssim": 0.9, "coding_loss_db": float("nan")}
    result |= {"test_psnr_moving": 25.5, "test_psnr_still": None}
    found = with_figures(Metadata(FULL), result).provenance
    assert found["held_out"] == {"pictures": 2, "psnr_db": 30.12346, "ssim": 0.9, "moving_psnr_db": 25.5}
    assert "coding_loss_db" not in found
    assert "held_out" not in with_figures(Metadata(FULL), result | {"test_pictures": 0}).provenance
    asked = Options(Path("a"), Path("b"), trade=Trade(target_bytes=1000))
    assert reserve_figures(asked).trade.target_bytes == 800
    without = Metadata(FULL).with_provenance(held_out=None, coding_loss_db=None)
    assert len(pack_metadata(Metadata(FULL))) - len(pack_metadata(without)) < 200


@pytest.mark.parametrize("variant", ["box", "contracted", "ndc"])
def test_the_view_is_that_which_the_reference_renderer_finds(variant: str) -> None:
    scene = VARIANTS[variant](scene_of_five())

    def look(camera):
        seen = reference.render_rays(scene, *camera.rays(), 0.5)
        return seen.depth, seen.opacity

    expected, found = Metadata(view_members(scene, *find_view(scene, look))), with_view(Metadata(), scene, None)
    assert found.up == pytest.approx(expected.up, abs=1e-3)
    assert ("view_limits" in found.document) == ("view_limits" in expected.document)
    if found.view_limits is not None and expected.view_limits is not None:
        # a picture that hardly holds for one renderer may hardly not hold for the other: one step of angles
        assert np.degrees(found.view_limits.azimuth) == pytest.approx(np.degrees(expected.view_limits.azimuth), abs=5.1)
    none = with_view(Metadata(), scene, "none")
    assert "view_limits" not in none.document and none.up == pytest.approx(found.up)


def test_coding_a_file_again_keeps_what_it_says(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    scene = replace(scene_of_five(), metadata=Metadata(FULL))
    scene_writer.write(quantise_scene(scene, [dict.fromkeys(scene.scales[0], 0.05)]), tmp_path / "in.kpc")
    options = ["--quality", "40", "--tune-steps", "0", "--title", "New", "--view-limits", "reach=0.5,distance=50:60"]
    options += ["--author", ""]
    assert kpenc.main([str(tmp_path / "in.kpc"), "-o", str(tmp_path / "out.kpc"), *options]) == 0
    said = [line for line in capsys.readouterr().err.splitlines() if "limits" in line]
    outside = "the opening view lies outside the limits of its elevation and distance, and players move it within"
    assert said == [f"kpenc: {outside}; kpedit --open-at sets another"]
    found = scene_io.read(tmp_path / "out.kpc").metadata
    assert "author" in FULL and "author" not in found.document
    changed = ("title", "view_limits", "provenance", "author")
    assert {k: v for k, v in found.document.items() if k not in changed} == {
        k: v for k, v in FULL.items() if k not in changed
    }
    limits = {"reach": 0.5, "distance": [50, 60]}
    assert found.title == "New" and found.document["view_limits"] == FULL["view_limits"] | limits
    assert "held_out" not in found.provenance and len(found.provenance["history"]) == 2
    assert "quality 40" in found.provenance["history"][-1]
