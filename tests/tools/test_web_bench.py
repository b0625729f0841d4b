"""Counting what pictures in a browser look up."""

from pathlib import Path

import numpy as np
import pytest

import kpc
from kpc.format.container import groups
from kpc.format.scene.rig import Rig
from kpc.player.cpu.reference import render
from kpc.player.quality import LEVELS
from kpc.player.viewpoints import fit_camera
from kpc.tools.bench import web_bench, web_loading, web_page
from partial_scenes import coded
from scenes import tiny_scene


def test_look_ups_are_those_of_the_samples(tmp_path: Path) -> None:
    reason = web_page.missing()
    if reason is not None:
        pytest.skip(reason)
    data, size = coded(tiny_scene(4)), (48, 36)
    (tmp_path / "scene.kpc").write_bytes(data)
    name, found = web_bench.measure(web_bench.Drawing(tmp_path / "scene.kpc", size, is_timed=False))
    assert "SwiftShader" in name and {(level, 1.0) for level in LEVELS} <= set(found)
    scene = kpc.load(data)
    samples = render(scene, fit_camera(Rig.of(scene).cameras[0], *size), web_bench.COMPARED_TIME).samples
    exact, folded = found["reference", 1.0], found["finer", 1.0]
    assert exact["samples_per_ray"] == pytest.approx(samples.mean(), rel=0.01)
    # Two scales of eight channels are four layers; a sample looks up three planes of each, and as many rows.
    assert exact["texels_per_pixel"] == pytest.approx(24 * samples.mean(), rel=0.01)
    assert folded["texels_per_pixel"] < exact["texels_per_pixel"] and folded["psnr"] > 45
    assert exact["cells_per_ray"] >= exact["samples_per_ray"]
    assert {device for record in found.values() for device in record["chosen_on"]} == set(web_bench.DEVICES)


def test_the_end_of_the_clip_that_is_sought_in_does_not_come_with_its_beginning() -> None:
    scene = tiny_scene(4)
    clip = web_loading.sought_in(coded(scene), scene.clip.frame_count)
    assert len(clip) > web_loading.SOUGHT_BYTES
    found = groups.Groups(clip)
    assert found.timeline.clip.frame_count == scene.clip.frame_count * len(found)
    assert [entry.kind for entry in found.reader.index] == ["GRUP"] * len(found)


def test_the_other_player_shows_as_many_bytes() -> None:
    scene = tiny_scene(4)
    splats = web_loading.splats_of(scene, 20)
    assert splats.nbytes == 20 * 32
    assert np.all((splats["place"] >= scene.aabb[0]) & (splats["place"] <= scene.aabb[1]))
    assert np.all(splats["extent"] > 0) and splats["colour"][:, :3].std() > 1
