"""Sequential fine-tuning (`kpc.encoder.rdo.sequential_finetune`): planes compensate errors of those coded before."""

from collections.abc import Callable, Sequence
from dataclasses import replace
from functools import partial

import numpy as np
import pytest

from kpc.encoder.coding import scene_writer
from kpc.encoder.evaluation.evaluate import pad_channels, unpad_decoder
from kpc.encoder.evaluation.validation_rays import ValidationRays
from kpc.encoder.rdo import sequential_finetune
from kpc.encoder.rdo.distortion import PlaneKey
from kpc.encoder.rdo.mode_decision import quantise_by_cost
from kpc.encoder.rdo.sequential_finetune import (
    SPREAD,
    code_sequentially,
    coding_order,
    quantise_sequentially,
    step_factors,
    steps_per_group,
    total_steps,
)
from kpc.format.coding.quantise import QuantisedScene, quantise_scene
from kpc.format.container import scene_io
from kpc.format.scene.scene import TIME_PLANES, Decoder, Scene
from scenes import tiny_scene, with_appearances, with_hybrid_decoder, with_motion, with_moving_area

pytestmark = pytest.mark.usefixtures("one_thread")
STEP = 0.2


@pytest.fixture(autouse=True)
def few_rays(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(sequential_finetune, "RAYS", 512)


def choose(scene: Scene, group: Sequence[PlaneKey] | None = None) -> QuantisedScene:
    steps = [{name: np.full(plane.shape[2], STEP) for name, plane in scale.items()} for scale in scene.scales]
    return quantise_by_cost(scene, steps, only=group, block_sides=(8,))


def round_off(scene: Scene, group: Sequence[PlaneKey] | None = None) -> QuantisedScene:
    """Do as `choose` without a search, which takes most of the time."""
    return quantise_scene(scene, [dict.fromkeys(scale, STEP) for scale in scene.scales])


def error(scene: Scene, quantised: QuantisedScene) -> float:
    return ValidationRays.from_cameras(scene, 4096, seed=77).measure(scene)(quantised.dequantise()).mse


def test_every_plane_is_coded_once_the_finest_first() -> None:
    scene = tiny_scene(scales=3)
    groups = coding_order(scene)
    assert [{s for s, _ in group} for group in groups] == [{s} for s in (2, 2, 2, 1, 1, 1, 0, 0, 0, 2, 1, 0)]
    assert sorted(plane for group in groups for plane in group) == sorted(
        (s, name) for s in range(3) for name in scene.scales[s]
    )
    both = coding_order(with_moving_area(scene))  # scales 1 and 2 are of one resolution to it
    assert [{s for s, _ in group} for group in both] == [{1, 2}] * 3 + [{0}] * 3 + [{1, 2}, {0}]
    assert sorted(plane for group in both for plane in group) == sorted(plane for group in groups for plane in group)
    assert coding_order(tiny_scene(dynamic=False, scales=1)) == [[(0, "xy")], [(0, "xz")], [(0, "yz")]]


def test_planes_coded_first_have_the_coarsest_steps() -> None:
    scene = tiny_scene(scales=2)
    factors = step_factors(scene)
    in_order = [factors[plane] for group in coding_order(scene) for plane in group]
    assert in_order == sorted(in_order, reverse=True) and len(in_order) == 12
    assert in_order[0] == 1 / in_order[-1] == 2**SPREAD and factors[0, "xt"] == factors[0, "zt"]


@pytest.mark.parametrize("make", [tiny_scene, partial(tiny_scene, dynamic=False), lambda: with_motion(tiny_scene())])
def test_fine_tuning_reduces_the_error_of_pictures(make: Callable[[], Scene]) -> None:
    scene = make()
    plain, better = choose(scene), quantise_sequentially(scene, scene, choose, 60)
    assert error(scene, better) < 0.96 * error(scene, plain)
    assert scene_io.read(scene_writer.encode(better)).parameter_count == plain.parameter_count


def test_the_first_group_is_not_fine_tuned_and_only_planes_and_decoder_change() -> None:
    scene = with_motion(tiny_scene())
    plain, better = choose(scene), quantise_sequentially(scene, scene, choose, 40)
    assert np.array_equal(better.scales[-1]["xy"].symbols, plain.scales[-1]["xy"].symbols)
    assert not np.array_equal(better.scales[0]["xy"].symbols, plain.scales[0]["xy"].symbols)
    assert (
        better.motion is not None
        and plain.motion is not None
        and np.array_equal(better.motion.symbols, plain.motion.symbols)
    )
    assert np.array_equal(better.occupancy, plain.occupancy) and isinstance(better.decoder, Decoder)
    assert not np.array_equal(better.decoder.w2, plain.decoder.w2)  # type: ignore[union-attr]


def test_steps_are_few_after_short_training() -> None:
    scene = tiny_scene(scales=2)
    assert [steps_per_group(trained, scene, 100) for trained in (0, 40, 1500, 3750, 30_000)] == [0, 1, 40, 100, 100]
    assert steps_per_group(30_000, scene, 0) == 0
    assert total_steps(scene, 40) == 300 and total_steps(tiny_scene(scales=1, dynamic=False), 40) == 100


@pytest.mark.parametrize("steps", [0, 1])
def test_few_steps_or_none_work(steps: int) -> None:
    scene = tiny_scene()
    planes = code_sequentially(
        scene, scene, lambda candidate, group: {(s, name): candidate.scales[s][name] for s, name in group}, steps
    )
    assert planes.scales[-1]["xy"].tobytes() == scene.scales[-1]["xy"].tobytes()
    assert (planes.scales[0]["xt"].tobytes() == scene.scales[0]["xt"].tobytes()) == (steps == 0)


def test_an_empty_scene_is_not_fine_tuned() -> None:
    scene = tiny_scene()
    scene = replace(scene, occupancy=np.zeros_like(scene.occupancy))
    plain, same = choose(scene), quantise_sequentially(scene, scene, choose, 5)
    for s, scale in enumerate(plain.scales):
        assert all(np.array_equal(plane.symbols, same.scales[s][name].symbols) for name, plane in scale.items())


def test_progress_is_shown_on_request(monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]) -> None:
    for name in ("FIRST_LINE_S", "LINE_EVERY_S"):
        monkeypatch.setattr(f"kpc.format.common.progress.{name}", 0.0)
    scene = tiny_scene(scales=1, dynamic=False)
    quantise_sequentially(scene, scene, choose, 4)
    assert capsys.readouterr() == ("", "")
    quantise_sequentially(scene, scene, choose, 4, shown=True)
    out, err = capsys.readouterr()
    assert out == "" and err.splitlines()[-1].startswith("fine-tuning: 10/10 steps, 0 s left")


def test_results_are_reproducible() -> None:
    scene = tiny_scene()
    assert scene_writer.encode(quantise_sequentially(scene, scene, choose, 5)) == scene_writer.encode(
        quantise_sequentially(scene, scene, choose, 5)
    )


def test_what_is_made_for_an_area_stays_in_it() -> None:
    """And what stands still gets no time rows."""
    scene = with_moving_area(tiny_scene())
    tuned = code_sequentially(scene, scene, lambda candidate, group: {}, 4)
    for before, after in zip(scene.scales, tuned.scales, strict=True):
        for name, plane in before.items():
            assert after[name].shape == plane.shape
            if name in TIME_PLANES:
                assert (plane != 1).any() or (after[name] == 1).all()
            else:
                assert not after[name][plane == 0].any() and (after[name] != plane).any()


def test_view_independent_colour_stays_so() -> None:
    scene = tiny_scene()
    scene = replace(scene, decoder=replace(scene.decoder, w2=np.zeros_like(scene.decoder.w2)))  # type: ignore[arg-type]
    assert not quantise_sequentially(scene, scene, choose, 5).decoder.w2.any()


def test_unequal_scales_appearances_and_the_hybrid_decoder() -> None:
    whole = tiny_scene()
    scales = ({name: plane[..., :5] for name, plane in whole.scales[0].items()}, whole.scales[1])
    narrow = replace(whole, scales=scales)
    narrow = replace(narrow, decoder=unpad_decoder(narrow, whole.decoder))
    assert unpad_decoder(narrow, pad_channels(narrow).decoder).w2.tobytes() == narrow.decoder.w2.tobytes()
    for scene in (narrow, with_appearances(whole), with_hybrid_decoder(whole)):
        plain, better = round_off(scene), quantise_sequentially(scene, scene, round_off, 10)
        assert error(scene, better) < error(scene, plain)
        assert [a.code.tolist() for a in better.appearances] == [a.code.tolist() for a in plain.appearances]
        scene_io.read(scene_writer.encode(better))
