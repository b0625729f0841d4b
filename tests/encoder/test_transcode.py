"""Coding finished checkpoints and files anew, without pictures and training; hostile ones are refused."""

import json
import zipfile
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch

import datasets as make
from kpc.encoder.cli import kpenc
from kpc.encoder.cli.work_folder import CHECKPOINT
from kpc.encoder.coding import scene_writer
from kpc.encoder.evaluation.evaluate import SceneRenderer
from kpc.encoder.evaluation.validation_rays import ASSUMED_MSE, ValidationRays, orbit_cameras
from kpc.encoder.field.config import PRESETS, TrainConfig
from kpc.encoder.rdo import codec_model, model_checkpoint, sequential_finetune
from kpc.encoder.rdo.mode_decision import requested_step
from kpc.encoder.rdo.rate_control import Trade
from kpc.format.coding.quantise import quantise_scene
from kpc.format.common.errors import TrainingError
from kpc.format.container import groups, rewriting, scene_io
from kpc.format.scene.metadata import Metadata
from kpc.format.scene.scene import Scene
from kpc.player.cpu import reference
from scenes import VARIANTS, tiny_scene, with_appearances
from training_runs import TINY

pytestmark = pytest.mark.usefixtures("one_thread", "quick_coding", "rounded")

VECTORS = Path(__file__).parents[2] / "spec" / "vectors" / "valid"
Kpenc = Callable[..., dict[str, Any]]


@pytest.fixture(autouse=True)
def short_tuning(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(sequential_finetune, "RAYS", 256)


@pytest.fixture
def kpenc_says(capsys: pytest.CaptureFixture[str]) -> Kpenc:
    """Run kpenc --json on a source; return its result."""

    def call(source: Path, output: Path, *options: str) -> dict[str, Any]:
        capsys.readouterr()
        assert kpenc.main([str(source), "-o", str(output), "--json", "--tune-steps", "0", *options]) == 0
        found: dict[str, Any] = json.loads(capsys.readouterr().out)
        return found

    return call


@pytest.fixture
def refused(capsys: pytest.CaptureFixture[str], tmp_path: Path) -> Callable[..., str]:
    """Run kpenc on a source that it cannot use; return its one line of error, after which no file is left."""

    def call(source: Path, *options: str, code: int = 1) -> str:
        capsys.readouterr()
        assert kpenc.main([str(source), "-o", str(tmp_path / "refused.kpc"), *options]) == code
        out, err = capsys.readouterr()
        assert out == "" and err.count("\n") == 1 and err.startswith("kpenc: ") and "Traceback" not in err
        assert not list(tmp_path.glob("*refused*"))
        return err

    return call


def saved(path: Path, scene: Scene) -> Path:
    """Write a finished checkpoint of a scene."""
    rays = ValidationRays.from_cameras(scene)
    truth = SceneRenderer(scene).rgb(*rays.rays)
    numbers = np.arange(512) % len(scene.appearances) if scene.appearances else None
    model_checkpoint.save_checkpoint(path, scene, replace(rays, truth=truth, appearances=numbers))
    return path


# --- finished checkpoints


@pytest.mark.parametrize(
    "trade", [(), ("--max-loss", "1dB"), ("--quality", "60", "--tune-steps", "4"), ("--psnr", "9dB")]
)
def test_a_checkpoint_gives_the_file_that_training_gave(
    tmp_path: Path, kpenc_says: Kpenc, monkeypatch: pytest.MonkeyPatch, trade: tuple[str, ...]
) -> None:
    monkeypatch.setitem(PRESETS, "draft", replace(TINY, thorough_from=0))  # trials are coded with less effort
    make.write_n3dv(tmp_path / "set", cameras=4)
    keep = ("--keep-checkpoint", str(tmp_path / "model.kpck"))
    trained = kpenc_says(tmp_path / "set", tmp_path / "out.kpc", "--preset", "draft", *keep, *trade)
    again = kpenc_says(tmp_path / "model.kpck", tmp_path / "again.kpc", *trade)
    files = [rewriting.with_metadata(tmp_path / name, Metadata()) for name in ("out.kpc", "again.kpc")]
    assert files[0] == files[1]
    said = (
        "trade",
        "target",
        "evaluated_on",
        "validation_psnr",
        "validation_loss_db",
        "agreement_db",
        "parameters",
        "identity_share",
    )
    assert {key: trained[key] for key in said} == {key: again[key] for key in said}
    assert {p.name for p in tmp_path.iterdir()} == {"set", "out.kpc", "again.kpc", "model.kpck"}


@pytest.mark.parametrize("kind", [*VARIANTS, "still", "appearances", "no cameras"])
def test_every_kind_of_scene_survives_a_checkpoint(tmp_path: Path, kind: str) -> None:
    others = {"still": lambda scene: tiny_scene(2, dynamic=False), "appearances": with_appearances,
              "no cameras": lambda scene: replace(scene, cameras=())}  # fmt: skip
    scene = (VARIANTS | others)[kind](tiny_scene(2))
    steps = [dict.fromkeys(scale, 0.01) for scale in scene.scales]
    back = codec_model.load(saved(tmp_path / "m.kpck", scene))
    assert scene_writer.encode(quantise_scene(back.scene, steps)) == scene_writer.encode(quantise_scene(scene, steps))
    assert back.coded is None and back.validation.measure(scene)(back.scene).mse == 0


def test_a_checkpoint_of_a_run_is_not_a_finished_one(
    tmp_path: Path, kpenc_says: Kpenc, refused: Callable[..., str], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setitem(PRESETS, "draft", TINY)
    make.write_n3dv(tmp_path / "set", cameras=4)
    kpenc_says(tmp_path / "set", tmp_path / "out.kpc", "--preset", "draft", "--keep", "--steps", "2")
    said = refused(tmp_path / "out.kpc.work" / CHECKPOINT)
    assert "no finished checkpoint" in said and "--keep-checkpoint" in said


def test_damaged_checkpoints_are_refused_in_one_line(tmp_path: Path, refused: Callable[..., str]) -> None:
    good, bad = saved(tmp_path / "good.kpck", tiny_scene(2)), tmp_path / "bad.kpck"
    whole = good.read_bytes()
    for content in (
        whole[:1000],
        whole[: len(whole) // 2],
        b"PK" + bytes(100),
        whole[:500] + bytes(3000) + whole[3500:],
    ):
        bad.write_bytes(content)
        assert "not a usable checkpoint" in refused(bad) or "no finished" in refused(bad)
    for content in (b"", b"nonsense", b"\x80\x04cos\nsystem\n"):
        bad.write_bytes(content)
        assert "neither a folder" in refused(bad, code=2)
    with zipfile.ZipFile(good) as archive, zipfile.ZipFile(bad, "w", zipfile.ZIP_DEFLATED) as packed:
        for name in archive.namelist():
            packed.writestr(name, archive.read(name))  # could unpack to any size
    assert "not a usable checkpoint" in refused(bad)


def changes() -> dict[str, Callable[[dict[str, Any]], object]]:
    return {
        "another version": lambda s: s.update(kpc=99),
        "a part missing": lambda s: s.pop("decoder"),
        "no plane": lambda s: s["scales"][0].pop("xy"),
        "a plane of another size": lambda s: s["scales"][0].update(xz=torch.ones(3, 3, 3)),
        "doubles": lambda s: s["scales"][0].update(xy=s["scales"][0]["xy"].double()),
        "NaN in a plane": lambda s: s["scales"][0]["xy"].fill_(float("nan")),
        "a tensor of nothing": lambda s: s.update(
            occupancy=torch.zeros(1, dtype=torch.bool).expand(1, 9999, 9999, 9999)
        ),
        "a box inside out": lambda s: s.update(aabb=s["aabb"].flip(0)),
        "a step of 0": lambda s: s.update(step=0.0),
        "endless rays": lambda s: s.update(step=1e-9),
        "no frames": lambda s: s.update(frame_count=-1),
        "a wide decoder": lambda s: s["decoder"].update(w1=torch.ones(9999, 9)),
        "rays without length": lambda s: s["validation_rays"]["directions"].zero_(),
        "rays of NaN": lambda s: s["validation_rays"]["origins"].fill_(float("nan")),
        "times out of the clip": lambda s: s["validation_rays"]["times"].fill_(2.0),
        "fewer colours than rays": lambda s: s["validation_rays"].update(truth=torch.ones(3, 3)),
        "appearances of nobody": lambda s: s["validation_rays"].update(appearances=torch.ones(512, dtype=torch.int64)),
        "an unknown mapping": lambda s: s.update(mapping={"kind": "Path"}),
        "a camera without focal length": lambda s: s["cameras"].zero_(),
        "a string for a number": lambda s: s.update(step="long"),
        "motion of NaN": lambda s: s.update(motion=torch.full((2, 2, 2, 2, 3), float("nan"))),
    }


@pytest.mark.parametrize("what", changes())
def test_hostile_checkpoints_are_refused_in_one_line(tmp_path: Path, refused: Callable[..., str], what: str) -> None:
    path = saved(tmp_path / "m.kpck", tiny_scene(2))
    state = torch.load(path, weights_only=True)
    changes()[what](state)
    torch.save(state, path)
    said = refused(path)
    assert str(path) in said and ("not a usable checkpoint" in said or "no finished checkpoint" in said)


def test_a_checkpoint_that_cannot_be_written(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    def full(*_: object) -> None:
        raise RuntimeError("unexpected pos 704 vs 598\nmore")

    monkeypatch.setattr(torch, "save", full)
    with pytest.raises(TrainingError, match=r"m\.kpck: the checkpoint cannot be written .*--keep-checkpoint"):
        saved(tmp_path / "m.kpck", tiny_scene(2))
    assert not any(tmp_path.iterdir())


# --- files


@pytest.fixture
def scene_file(tmp_path: Path) -> Path:
    scene = tiny_scene(3)
    scene_writer.write(
        quantise_scene(scene, [dict.fromkeys(scale, 0.002) for scale in scene.scales]), tmp_path / "scene.kpc"
    )
    return tmp_path / "scene.kpc"


def test_a_file_becomes_smaller(searched: None, scene_file: Path, tmp_path: Path, kpenc_says: Kpenc) -> None:
    size = scene_file.stat().st_size
    target = int(0.85 * size)
    result = kpenc_says(scene_file, tmp_path / "smaller.kpc", "--target-size", str(target))
    assert 0.9 * target < result["size_bytes"] == (tmp_path / "smaller.kpc").stat().st_size <= target
    before, after = scene_io.read(scene_file).dequantise(), scene_io.read(tmp_path / "smaller.kpc").dequantise()
    measured = ValidationRays.from_cameras(before).measure(before)(after)
    assert result["agreement_db"] == pytest.approx(measured.agreement_db) and measured.mse > 0
    lost = 10 * np.log10(1 + measured.mse / 255**2 / ASSUMED_MSE)
    assert result["validation_loss_db"] == pytest.approx(lost) and "30 dB" in result["evaluated_on"]


@pytest.mark.parametrize(
    ("target", "why"),
    [
        (("--target-size", "1MB"), "it is small enough (asked for at most 1,000,000 bytes)"),
        (("--lam", "0.0001"), "no file of less cost was found (asked for lam 0.0001)"),  # all that counts is D
    ],
)
def test_a_file_is_copied_where_nothing_is_better(
    scene_file: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str], target: tuple[str, str], why: str
) -> None:
    copy, size = tmp_path / "same.kpc", scene_file.stat().st_size
    assert kpenc.main([str(scene_file), "-o", str(copy), "--tune-steps", "0", *target]) == 0
    assert copy.read_bytes() == scene_file.read_bytes()
    assert capsys.readouterr().out == f"{copy}: {size:,} bytes, a copy of the source, since {why}\n"


@pytest.mark.parametrize("target", ["1MB", "as large"])
def test_a_clip_in_groups_is_copied_with_the_metadata_that_is_given(
    scene_file: Path, tmp_path: Path, kpenc_says: Kpenc, monkeypatch: pytest.MonkeyPatch, target: str
) -> None:
    clip, copy = tmp_path / "clip.kpc", tmp_path / "same.kpc"
    groups.write(groups.group_inputs([scene_file, scene_file]), clip)
    monkeypatch.setattr(codec_model, "estimate_curvature", lambda *_, **__: pytest.fail("searches"))
    size = len(rewriting.with_metadata(clip, Metadata({"title": "A dancer"})))
    wanted = str(size) if target == "as large" else target
    result = kpenc_says(clip, copy, "--target-size", wanted, "--title", "A dancer")
    assert result["is_copy"] and copy.read_bytes() == rewriting.with_metadata(clip, Metadata({"title": "A dancer"}))


@pytest.mark.parametrize("is_grouped", [False, True])
def test_a_size_below_what_no_step_shrinks_is_refused_before_the_search(
    scene_file: Path,
    tmp_path: Path,
    refused: Callable[..., str],
    monkeypatch: pytest.MonkeyPatch,
    is_grouped: bool,
) -> None:
    scene = replace(scene_io.read(scene_file), occupancy=np.random.default_rng(0).random((1, 32, 32, 32)) < 0.5)
    scene_writer.write(scene, scene_file)
    if is_grouped:
        later = tmp_path / "later.kpc"
        scene_file.rename(later)
        scene_writer.write(replace(scene, occupancy=scene.occupancy[:, :1]), tmp_path / "early.kpc")
        groups.write(groups.group_inputs([tmp_path / "early.kpc", later]), scene_file)
    monkeypatch.setattr(codec_model, "estimate_curvature", None)  # measuring what errors cost takes minutes
    assert "occupancy, cameras, metadata, sound) takes" in refused(scene_file, "--target-size", "4KB")


def test_a_group_that_cannot_keep_to_its_share_is_named(
    scene_file: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    groups.write(groups.group_inputs([scene_file, scene_file]), tmp_path / "clip.kpc")

    def fail(*arguments: object) -> None:
        raise TrainingError("9 bytes is the smallest size of this model")

    monkeypatch.setattr(codec_model, "code", fail)
    assert kpenc.main([str(tmp_path / "clip.kpc"), "-o", str(tmp_path / "out.kpc"), "--max-loss", "0.1dB"]) == 1
    said = capsys.readouterr().err.splitlines()[-1]
    assert said.startswith("kpenc: group 0 of 2, with the planes that it shares with others: 9 bytes is the smallest")


def test_a_file_cannot_be_coded_to_a_psnr(scene_file: Path, refused: Callable[..., str]) -> None:
    assert "checkpoint" in refused(scene_file, "--psnr", "30dB", code=2)


def test_relative_steps_are_kept(scene_file: Path, tmp_path: Path, kpenc_says: Kpenc) -> None:
    kpenc_says(scene_file, tmp_path / "smaller.kpc", "--max-loss", "0.02dB")
    steps = [
        [requested_step(p) / requested_step(scene.scales[0]["xy"])[0] for scale in scene.scales for p in scale.values()]
        for scene in (scene_io.read(scene_file), scene_io.read(tmp_path / "smaller.kpc"))
    ]
    np.testing.assert_allclose(
        np.concatenate(steps[0]), np.concatenate(steps[1]), rtol=2**-6
    )  # each to 8 significant bits


@pytest.mark.parametrize("name", ["none.kpc", "none.kpck"])
def test_a_file_that_is_not_there_is_no_folder(tmp_path: Path, name: str, capsys: pytest.CaptureFixture[str]) -> None:
    with pytest.raises(SystemExit):
        kpenc.main([str(tmp_path / name), "-o", str(tmp_path / "out.kpc")])
    assert capsys.readouterr().err.endswith(f"{tmp_path / name}: no such file (see kpenc --help)\n")


def test_damaged_files_are_refused_in_one_line(scene_file: Path, refused: Callable[..., str]) -> None:
    whole = bytearray(scene_file.read_bytes())
    whole[-3] ^= 1
    scene_file.write_bytes(whole)
    assert "damaged" in refused(scene_file)


# --- the command line


def test_options_of_training_are_refused(scene_file: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    for words in (["--steps", "3"], ["--preset", "fast"], ["--resume"], ["--dry-run"], ["--keep-checkpoint", "m.kpck"]):
        with pytest.raises(SystemExit, match="2"):
            kpenc.main([str(scene_file), "-o", str(tmp_path / "x.kpc"), *words])
        assert f"{words[0]}: {scene_file} is trained already" in capsys.readouterr().err


def test_a_video_alone_is_not_taken_for_a_trained_scene(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    (tmp_path / "cam00.mp4").write_bytes(b"film")
    with pytest.raises(SystemExit, match="2"):
        kpenc.main([str(tmp_path / "cam00.mp4"), "-o", str(tmp_path / "x.kpc"), "--preset", "fast"])
    assert "cam00.mp4: neither a folder of videos or images, nor" in capsys.readouterr().err


def test_a_source_is_never_overwritten(scene_file: Path, capsys: pytest.CaptureFixture[str]) -> None:
    before = scene_file.read_bytes()
    assert kpenc.main([str(scene_file), "-o", str(scene_file), "--quality", "10"]) == 2
    assert "is the source, too" in capsys.readouterr().err and scene_file.read_bytes() == before


def test_the_result_is_printed(scene_file: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert kpenc.main([str(scene_file), "-o", str(tmp_path / "x.kpc"), "--lam", "3"]) == 0
    out, _ = capsys.readouterr()
    assert out.count("\n") == 1 and all(
        words in out for words in ("asked for lam 3; reached ", " bytes, ", "uncoded pictures")
    )


@pytest.mark.parametrize(
    "words",
    [
        ["--quality", "0"],
        ["--quality", "101"],
        ["--quality", "nan"],
        ["--lam", "-1"],
        ["--lam", "x"],
        ["--quality", "5", "--lam", "1"],
    ],
)
def test_invalid_targets_are_refused(words: list[str], tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    with pytest.raises(SystemExit, match="2"):
        kpenc.main([str(tmp_path), "-o", str(tmp_path / "x.kpc"), *words])
    assert words[0] in capsys.readouterr().err


# --- what no training makes, but files may hold


@pytest.mark.parametrize("axis", ["x", "y", "z", "t"])
def test_planes_of_one_texel_are_coded_again(axis: str) -> None:
    """A plane of one texel along an axis is constant along it, and so is one of two equal texels."""
    scene = tiny_scene()
    thin = {
        name: plane[: 1 if axis == name[1] else None, : 1 if axis == name[0] else None]
        for name, plane in scene.scales[0].items()
    }
    whole = quantise_scene(
        replace(scene, scales=(thin, scene.scales[1])), [dict.fromkeys(planes, 0.01) for planes in scene.scales]
    )
    with pytest.raises(ValueError, match="single texel"):
        SceneRenderer(whole.dequantise())
    source = codec_model.model_from_file(whole)
    camera = scene.cameras[0]
    origins, directions = camera.rays()
    times = np.full(len(origins), 0.4, np.float32)
    shown = SceneRenderer(source.scene).rgb(origins, directions, times).reshape(camera.height, camera.width, 3)
    np.testing.assert_allclose(shown, reference.render(whole.dequantise(), camera, 0.4).rgb, atol=2e-3)
    coded = codec_model.code(source, Trade(), TrainConfig().prune_share, 1)
    assert coded.loss_db <= 0.15 and scene_io.read(coded.data).scales[0].keys() == thin.keys()


@pytest.mark.parametrize(
    "name",
    ["appearances", "occupancy-one", "contracted", "device-coordinates", "dynamic", "hybrid-moved", "limits-large"],
)
def test_files_of_all_kinds_are_coded_again(name: str) -> None:
    source = codec_model.model_from_file(scene_io.read(VECTORS / f"{name}.kpc"))
    coded = codec_model.code(source, Trade(), TrainConfig().prune_share, 1)
    assert coded.loss_db <= 0.15 and len(scene_writer.encode(scene_io.read(coded.data))) == coded.size_bytes
    assert coded.size_bytes <= len(scene_writer.encode(source.coded))  # type: ignore[arg-type]


# --- validation rays


def test_orbit_cameras_see_the_whole_scene() -> None:
    scene = replace(tiny_scene(4), cameras=())
    corners = np.stack(np.meshgrid(*scene.bounds.T), -1).reshape(-1, 3)
    for camera in orbit_cameras(scene):
        local = (corners - camera.camera_to_world[:3, 3]) @ camera.camera_to_world[:3, :3]
        pixel = local[:, :2] / -local[:, 2:] * (camera.fl_x, -camera.fl_y) + (camera.cx, camera.cy)
        assert (local[:, 2] < 0).all() and (pixel > 0).all() and (pixel < (camera.width, camera.height)).all()
        np.testing.assert_allclose(
            camera.camera_to_world[:3, :3].T @ camera.camera_to_world[:3, :3], np.eye(3), atol=1e-12
        )


def test_rays_through_occupied_cells_come_from_all_cameras() -> None:
    scene = tiny_scene(4)
    rays, others = (ValidationRays.through_occupied(scene, 2000, seed) for seed in (1, 2))
    assert len(rays.times) == 2000 and SceneRenderer(scene).hits_occupied(*rays.rays).all()
    assert not SceneRenderer(scene).hits_occupied(*ValidationRays.from_cameras(scene, 2000).rays).all()
    eyes = [tuple(np.float32(camera.camera_to_world[:3, 3])) for camera in scene.cameras]
    assert {tuple(origin) for origin in rays.origins[:200]} == set(eyes)
    assert not np.array_equal(rays.times, others.times)


def test_fewer_rays_where_few_pass_through_occupied_cells() -> None:
    scene = tiny_scene(4)
    nothing = replace(scene, occupancy=np.zeros_like(scene.occupancy))
    assert ValidationRays.through_occupied(nothing, 100, seed=1).origins.shape == (0, 3)
    speck = np.zeros_like(scene.occupancy)
    speck[:, 4, 5, 6] = True
    few = ValidationRays.through_occupied(replace(scene, occupancy=speck), 100, seed=1)
    assert 0 < len(few.times) < 100


def test_rays_of_cameras_go_through_their_pixels() -> None:
    scene = tiny_scene(4)
    rays = ValidationRays.from_cameras(scene)
    assert rays.truth is None and len(rays.times) == 512 and 0 <= rays.times.min() < rays.times.max() < 1
    eyes = {tuple(np.float32(camera.camera_to_world[:3, 3])) for camera in scene.cameras}
    assert {tuple(origin) for origin in rays.origins} == eyes
