"""Appearances of a clip in groups: kpinfo lists them, and kprender knows before the first frame where they lack."""

import json
from pathlib import Path

import numpy as np
import pytest

import kpc
from kpc.encoder.coding.scene_writer import write
from kpc.format.coding.quantise import quantise_scene
from kpc.format.common.images import read_image
from kpc.format.container import groups
from kpc.tools.cli import kpexport, kpinfo, kprender
from scenes import tiny_scene, with_appearances


def clip_of(folder: Path, *names: tuple[str, ...]) -> Path:
    """Write a clip with a group of 11 frames for each of these tuples of appearances."""
    files = []
    for number, some in enumerate(names):
        scene = with_appearances(tiny_scene(4), some) if some else tiny_scene(4)
        files.append(folder / f"{number}.kpc")
        write(quantise_scene(scene, [dict.fromkeys(scale, 0.02) for scale in scene.scales]), files[-1])
    path = folder / "clip.kpc"
    groups.write([groups.GroupInput.of(file, 11 * number) for number, file in enumerate(files)], path)
    return path


@pytest.fixture
def mixed(tmp_path: Path) -> Path:
    return clip_of(tmp_path, ("cam1", "cam2", "cam3"), (), ("cam3", "cam4", "cam2"))


def render(scene: Path, name: str, output: Path, *options: str) -> int:
    size = ("--backend", "reference", "--size", "8x6", *options)
    return kprender.main([str(scene), "--appearance", name, *size, "-o", str(output)])


def test_groups_without_appearances_show_their_average_which_is_said_once(
    mixed: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    frames = tmp_path / "frames"
    assert render(mixed, "cam2", frames, "--step", "8") == 0
    err = capsys.readouterr().err
    assert err.count("kprender: --appearance cam2: shows the average in 1 of 3 groups, which has no appearances") == 1
    clip = kpc.load(mixed)
    for number in (0, 16, 32):
        scene, time = clip.at(number / 32)
        code = scene.appearance("cam2") if scene.appearances else None
        wanted = kpc.render(scene, scene.cameras[0].resized(8, 6), time, code).rgb
        assert np.abs(read_image(frames / f"{number:04d}.png") / 255 - wanted).max() < 1.5 / 255


@pytest.mark.parametrize(("name", "said"), [("cam4", "choose one of cam2, cam3"), ("cam1:cam2:0.5", "cam2, cam3")])
def test_a_name_that_some_groups_lack_is_refused_before_the_first_frame(
    name: str, said: str, mixed: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    frames = tmp_path / "frames"
    assert render(mixed, name, frames) == 2
    err = capsys.readouterr().err
    assert said in err and "in some groups only" in err and err.count("\n") == 1 and not frames.exists()
    assert kpexport.main([str(mixed), "--appearance", name, "--backend", "reference", "-o", str(frames)]) == 2
    assert said in capsys.readouterr().err and not frames.exists()


def test_only_groups_that_are_rendered_must_have_it(mixed: Path, tmp_path: Path) -> None:
    assert render(mixed, "cam1", tmp_path / "x.png", "--time", "0") == 0
    assert render(mixed, "cam4", tmp_path / "x.png", "--time", "1") == 0


def test_groups_may_have_none_in_common(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    clip = clip_of(tmp_path, ("cam1",), ("cam2",))
    assert render(clip, "cam1", tmp_path / "frames") == 2
    assert "the groups have no appearance in common" in capsys.readouterr().err
    assert render(clip_of(tmp_path, (), ()), "cam1", tmp_path / "frames") == 2
    assert "the scene has no appearances; render it without one" in capsys.readouterr().err


def test_kpinfo_lists_what_all_groups_with_appearances_have(mixed: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert kpinfo.main([str(mixed)]) == 0
    assert "appearances 2: cam2, cam3\n" in capsys.readouterr().out
    for file, names in (mixed, ["cam2", "cam3"]), (mixed.with_name("0.kpc"), ["cam1", "cam2", "cam3"]):
        assert kpinfo.main([str(file), "--json"]) == 0
        assert json.loads(capsys.readouterr().out)["files"][0]["appearances"] == names
