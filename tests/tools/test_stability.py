"""Errors against float64 at the ends of what the code lets through, and what it refuses beyond."""

import math
from dataclasses import replace
from pathlib import Path

import pytest
import torch

import datasets as make
import gl
from kpc.encoder.cli import kpenc
from kpc.encoder.field.field import Field
from kpc.encoder.field.render import Rays, render_reference
from kpc.format.common.errors import DisplayError
from kpc.player.gl.programs import is_software
from kpc.player.gl.renderer import MOST_SAMPLES, Renderer
from kpc.tools.bench import kpbench, results, tables
from kpc.tools.bench.stability import figure, pictures, stages, sweeps
from kpc.tools.bench.stability.sweeps import Sweep
from scenes import tiny_scene

pytestmark = pytest.mark.usefixtures("one_thread")
SWEEPS = [*stages.sweeps(), *pictures.sweeps()]


@pytest.mark.parametrize("sweep", SWEEPS, ids=lambda sweep: sweep.stage)
def test_errors_are_within_bounds_at_the_ends_of_what_is_let_through(sweep: Sweep) -> None:
    admitted = [value for value in sweep.values if sweep.is_admitted(value)]
    found = sweeps.run(sweep, [admitted[0], admitted[-1]])
    assert found["max_error"] is not None and found["max_error"] <= sweep.bound, found["points"]
    if sweep.stage not in ("product over planes", "quantisation of planes"):
        assert not found["passes"]


def test_the_command_writes_a_record_and_a_panel_for_each_sweep(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    def errors(value: float) -> dict[str, float]:
        return {"numpy": value / 255, "glsl": math.inf if value > 20 else 0.0}

    sweep = Sweep("a stage", "amount of something", (0.1, 0.5, 2.0, 30.0), errors, (0.0, 1.0), "it is refused")
    monkeypatch.setattr(stages, "sweeps", lambda: [sweep])
    monkeypatch.setattr(pictures, "sweeps", lambda: [replace(sweep, stage="another", admitted=(0.0, math.inf))])
    before = torch.get_num_threads()
    assert kpbench.main(["stability", "--out", str(tmp_path / "stability.json")]) == 0
    torch.set_num_threads(before)
    kept, wrong = results.load([tmp_path / "stability.json"])
    assert kept["repeats"] == [{"max_error": pytest.approx(0.5 / 255), "worst": "numpy"}]
    assert kept["passes"] == [2.0, 30.0] and kept["points"][3]["errors"]["glsl"] is None
    assert wrong["settings"]["admitted"] == [0.0, None] and wrong["repeats"][0] == {"max_error": None, "worst": "glsl"}
    printed = capsys.readouterr().err
    assert "a stage  amount of something  up to 1" in printed
    assert "| a stage | amount of something | up to 1 | picture | 2.0e-03 | numpy | 2 |" in tables.markdown([kept])
    titles = [axes.get_title() for axes in figure.draw([kept, wrong]).axes]
    assert titles[:2] == ["a stage", "another"] and (tmp_path / "stability.svg").exists()


def test_boxes_too_far_from_the_origin_for_float32_are_refused(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    make.write_n3dv(tmp_path / "set", frames=2)
    command = [str(tmp_path / "set"), "-o", str(tmp_path / "out.kpc"), "--box", "2e4,0,0,20001,1,1"]
    assert kpenc.main(command) == 1
    assert "the box lies 20,001 times its longest edge away from the origin" in capsys.readouterr().err


def test_rays_of_more_samples_than_a_software_driver_turns_loops_are_refused() -> None:
    scene = tiny_scene(dynamic=False)
    if not is_software(gl.context()):
        pytest.skip("a graphics card has no such limit")
    with pytest.raises(DisplayError, match=r"samples are more than .* --backend reference"):
        Renderer(gl.context(), replace(scene, step=1.2 / MOST_SAMPLES))
    Renderer(gl.context(), replace(scene, step=1.2 / MOST_SAMPLES, occupancy=0 * scene.occupancy > 0)).release()


def test_rays_that_meet_nothing_show_the_background() -> None:
    scene = tiny_scene()
    one = torch.ones(2)
    away = torch.tensor([[0.0, 0.0, 9.0]]).repeat(2, 1)
    rays = Rays(away, torch.tensor([[0.0, 0.0, 1.0]]).repeat(2, 1), 0 * one, 0.5 * one, torch.full((2, 3), 0.25))
    aabb, occupancy = torch.from_numpy(scene.aabb), torch.from_numpy(scene.occupancy)
    rgb, *_ = render_reference(Field.from_scene(scene), rays, aabb, occupancy, scene.step)
    assert torch.equal(rgb, rays.backgrounds)
