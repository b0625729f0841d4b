"""Corrections of cameras: their gradients, what they recover, what they leave alone, and how they are kept."""

import json
from collections.abc import Callable
from dataclasses import asdict, replace
from functools import partial
from pathlib import Path

import numpy as np
import pytest
import torch

import kpc.encoder.training.refinement as refinement_module
from datasets import write_n3dv, write_nerfstudio
from kpc.encoder.cli import kpenc
from kpc.encoder.cli.options import Options
from kpc.encoder.cli.report import describe_corrections
from kpc.encoder.datasets import Dataset, Pictures, load_dataset, pixel_rays
from kpc.encoder.evaluation.evaluate import SceneRenderer
from kpc.encoder.field.config import PRESETS
from kpc.encoder.field.field import Field
from kpc.encoder.field.fused import fused_features
from kpc.encoder.field.render import Rays
from kpc.encoder.training.refinement import (
    DrawnPixels,
    Refinement,
    moved_poses,
    with_corrections,
    without_similarity,
)
from kpc.format.common.errors import TrainingError
from kpc.format.container import scene_io
from kpc.format.scene.cameras import Camera
from kpc.format.scene.scene import TIME_PLANES, Clip, Scene
from kpc.format.scene.space import Contraction
from kpc.tools.bench.stability import gradients
from kpc.tools.bench.stability.gradients import backpropagate
from scenes import in_device_coordinates, look_at, tiny_scene, with_motion
from training_runs import CONFIG, TINY, ignore, torch_twin, trained, trainer

ALL = replace(CONFIG, refine="all")

STEPS, RAYS = 60, 400


def pictures_of(cameras: list[Camera], frames: int, distortion: tuple[float, ...] = (0.0,) * 8) -> Pictures:
    """Return pictures of cameras that stand still, the last of them held out."""
    camera = np.repeat(np.arange(len(cameras)), frames).astype(np.int32)
    count = len(camera)
    intrinsics = np.array([(c.fl_x, c.fl_y, c.cx, c.cy) for c in cameras])[camera]
    return Pictures(
        file=tuple(f"cam{c}.mp4" for c in camera),
        camera=camera,
        time=np.tile(np.linspace(0, 1, frames), len(cameras)).astype(np.float32),
        is_test=camera == len(cameras) - 1,
        offset=np.zeros(count, np.int64),
        width=np.full(count, cameras[0].width, np.int32),
        height=np.full(count, cameras[0].height, np.int32),
        intrinsics=intrinsics,
        distortion=np.tile(distortion, (count, 1)),
        is_fisheye=np.zeros(count, bool),
        camera_to_world=np.stack([c.camera_to_world for c in cameras])[camera],
        near=np.full(count, np.nan, np.float32),
        far=np.full(count, np.nan, np.float32),
    )


def dataset_of(pictures: Pictures, frames: int = 11) -> Dataset:
    """Return a dataset of pictures without pixels."""
    names = tuple(f"cam{c}" for c in np.unique(pictures.camera))
    return Dataset(
        "N3DV",
        Path("rig"),
        pictures,
        None,
        Clip(frames, 10.0),
        frames > 1,
        False,
        names,  # type: ignore[arg-type]
    )


def rig(count: int = 5) -> list[Camera]:
    """Return cameras on an arc before `tiny_scene`."""
    eyes = [(3 * np.cos(a), 3 * np.sin(a), 1.2 + 0.5 * np.sin(3 * a)) for a in np.linspace(0.2, 1.4, count)]
    return [look_at(eye, (0.1, 0.05, 0.05), 48, 36, 55.0) for eye in eyes]


def draw(dataset: Dataset, chosen: np.ndarray, count: int, seed: int) -> DrawnPixels:
    """Return random pixels of some pictures."""
    rng = np.random.default_rng(seed)
    return DrawnPixels(rng.choice(chosen, count), rng.integers(36, size=count), rng.integers(48, size=count))


@pytest.mark.parametrize("in_ndc", [False, True])
def test_gradients_of_corrections_match_finite_differences(in_ndc: bool) -> None:
    """A linear function of the rays, whose cameras are changed one after the other.

    Rays are float32: 200 of them, rounded to 2^-24, and a step of 1e-3 make an error of about 1e-3.
    """
    pictures = pictures_of(rig(), 4, (0.05, -0.02, 1e-3, 0, 0, 0, 0, 0))
    mapping = in_device_coordinates(tiny_scene()).mapping if in_ndc else None
    refinement = Refinement(dataset_of(pictures), ALL, np.array([0.1, 0.2, 0.0]), mapping)
    pixels = draw(refinement.dataset, np.flatnonzero(pictures.camera == 3), 200, 0)
    g, step, units = np.random.default_rng(1).normal(size=(200, 10)), 1e-3, (np.full(6, 0.01), np.full(3, 0.01))
    units[0][3:] *= refinement.distance
    unit = refinement.unit[pixels.picture]
    world = refinement._in_world(pixels, unit, g)
    camera = refinement._camera_slopes(pixels, unit, g, *world).sum(0)[:6] / units[0]
    lens = refinement._lens_slopes(pixels, unit, *world).sum(0) / units[1]

    def value(views: Pictures) -> float:
        rays = pixel_rays(views, unit, pixels.column, pixels.row, mapping)
        return float((np.float64(np.concatenate(rays, axis=1)) * g[:, :6]).sum())

    def slope(change: Callable[[Pictures, float], Pictures]) -> float:
        views = refinement.views
        return (value(change(views, step)) - value(change(views, -step))) / (2 * step)

    for k in range(6):

        def move(views: Pictures, by: float, k: int = k) -> Pictures:
            return replace(
                views, camera_to_world=moved_poses(views.camera_to_world, by * np.eye(6)[[k] * 5], refinement.centre)
            )

        assert camera[k] == pytest.approx(slope(move), abs=0.01, rel=2e-3)

    def zoom(views: Pictures, by: float) -> Pictures:
        return replace(views, intrinsics=views.intrinsics * [1 + by, 1 + by, 1, 1])

    def bend(views: Pictures, by: float, k: int) -> Pictures:
        return replace(views, distortion=views.distortion + by * np.eye(8)[k])

    expected = [slope(zoom), *(slope(partial(bend, k=k)) for k in (0, 1))]
    np.testing.assert_allclose(lens, expected, atol=0.01, rtol=5e-3)


@pytest.mark.parametrize("moved", [False, True])
def test_features_have_gradients_of_points_and_times(moved: bool) -> None:
    scene = with_motion(tiny_scene()) if moved else tiny_scene()
    field, rng = Field.from_scene(scene), np.random.default_rng(0)
    points, times = (torch.from_numpy(rng.random(size, np.float32)).requires_grad_() for size in ((300, 3), 300))
    weights = torch.from_numpy(rng.normal(size=(300, field.layout.features)).astype(np.float32))
    (fused_features(field)(points, times) * weights).sum().backward()
    ours = torch.cat([points.grad, times.grad[:, None]], dim=1)
    points.grad = times.grad = None
    (field.features(points, times) * weights).sum().backward()
    theirs = torch.cat([points.grad, times.grad[:, None]], dim=1)
    assert float(theirs.abs().min(0).values.max()) < float(theirs.abs().max())
    torch.testing.assert_close(ours, theirs, atol=1e-3 * float(theirs.abs().max()), rtol=0)


def smooth_scene() -> Scene:
    """Return a view-independent scene that fades at the sides of its box, where samples come and go as rays move."""
    scene = tiny_scene()

    def fading(plane: np.ndarray) -> np.ndarray:
        rows, columns = (np.sin(np.linspace(0, np.pi, n)) for n in plane.shape[:2])
        return np.float32(plane * np.sqrt(np.outer(rows, columns))[..., None])

    scales = tuple({n: p if n in TIME_PLANES else fading(p) for n, p in scale.items()} for scale in scene.scales)
    weight = 1.2 * np.abs(scene.decoder.density_weight)
    decoder = replace(scene.decoder, density_weight=weight, density_bias=-4.0, w2=0 * scene.decoder.w2)
    return replace(scene, scales=scales, decoder=decoder, occupancy=np.ones_like(scene.occupancy[:1]), step=0.06)


def test_cameras_clocks_and_exposures_are_recovered_before_a_known_scene(monkeypatch: pytest.MonkeyPatch) -> None:
    """Two cameras are moved, one is late and one early, one bright and one dark; a held-out one is turned.

    The scene stays as it is, so the disturbances of the trained cameras have nothing in common.
    """
    monkeypatch.setattr(gradients, "DISTORTION", 0.0)
    monkeypatch.setattr(refinement_module, "STEP", refinement_module.ALIGN_STEP)  # as the scene is finished
    scene, cameras, frames = smooth_scene(), rig(), 11
    truth = dataset_of(pictures_of(cameras, frames))
    poses, centre, camera = np.stack([c.camera_to_world for c in cameras]), scene.aabb.mean(0), truth.pictures.camera
    twist = np.outer([1, -1, 0, 0, 1], [0.008, 0.008, -0.006, 0.03, -0.02, 0.02])
    late, gain = np.array([0, 0, 0.5, -0.5, 0])[camera], np.array([1, 1, 1.1, 1 / 1.1, 1])[camera]
    given = moved_poses(poses, twist, centre)
    disturbed = replace(truth, pictures=replace(truth.pictures, camera_to_world=given[camera]))
    refinement = Refinement(disturbed, ALL, centre, None)
    renderer = SceneRenderer(scene)
    for learnt in (range(4), [4]):
        for number in range(STEPS):
            pixels = draw(truth, np.flatnonzero(np.isin(camera, learnt)), RAYS, number)
            shown = np.clip(truth.pictures.time + late / (frames - 1), 0, 1)[pixels.picture]
            targets = renderer.rgb(*pixel_rays(truth.pictures, pixels.picture, pixels.column, pixels.row), shown)
            targets = targets * gain[pixels.picture, None] / refinement.exposures(pixels.picture)
            times, backgrounds = refinement.times(pixels.picture), np.tile(scene.background, (RAYS, 1))
            rays = Rays.from_arrays(*refinement.rays(pixels), times, np.full(RAYS, 0.5), backgrounds)
            found = backpropagate(scene, rays, torch.from_numpy(np.float32(targets)), workers=1)["rays"]
            rate = 0.5 * (1 + np.cos(np.pi * number / STEPS))
            if learnt == [4]:
                refinement.align(pixels, found, rate)
            else:
                refinement.step(pixels, targets, found, rate)
    corrections, now = refinement.corrections(), refinement.views.camera_to_world
    np.testing.assert_allclose([one.late_frames for one in corrections], [0, 0, 0.5, -0.5, 0], atol=0.1)
    np.testing.assert_allclose([one.exposure[1] for one in corrections], [1, 1, 1.1, 1 / 1.1, 1], atol=0.02)
    before, after = (np.linalg.norm(p[:, :3, 3] - poses[:, :3, 3], axis=1)[[0, 1, 4]] for p in (given, now))
    assert (after < 0.3 * before).all()


def test_steps_have_nothing_in_common_with_a_similarity() -> None:
    rng = np.random.default_rng(0)
    arms, common = rng.normal(size=(6, 3)), rng.normal(size=6)
    similarity = common + np.concatenate([np.zeros((6, 3)), 0.7 * arms], axis=1)
    np.testing.assert_allclose(without_similarity(similarity, arms), 0, atol=1e-12)
    twist = rng.normal(size=(6, 6))
    rest = without_similarity(twist, arms)
    np.testing.assert_allclose(without_similarity(twist + similarity, arms), rest, atol=1e-12)
    assert np.linalg.norm(rest) > 0.5 * np.linalg.norm(twist)


@pytest.mark.parametrize("refine", ["cameras", "all"])
def test_refined_runs_resume_bitwise_and_keep_what_cameras_have_in_common(
    moving: Dataset, tmp_path: Path, refine: str
) -> None:
    changes = {"steps": 40, "refine": refine}
    whole, first, second = trained(moving, **changes), trainer(moving, **changes), trainer(moving, **changes)
    with pytest.raises(KeyboardInterrupt):
        first.run(ignore, interrupted=lambda: first.step == 25)
    first.save(tmp_path / "c.kpck")
    second.resume(tmp_path / "c.kpck")
    second.run(ignore)
    assert torch.equal(whole.field.theta, second.field.theta)
    whole.align_held_out()
    second.align_held_out()
    ours, theirs = (run.refined_dataset().pictures for run in (whole, second))
    for name in ("camera_to_world", "intrinsics", "distortion", "time"):
        np.testing.assert_array_equal(getattr(ours, name), getattr(theirs, name))
    assert torch.equal(whole.field.theta, second.field.theta)  # which alignment leaves as it is
    moved = np.abs(ours.camera_to_world - moving.pictures.camera_to_world).max((1, 2))
    assert (moved > 1e-6).all()  # held-out pictures, too
    train = ~ours.is_test
    shifts = (ours.camera_to_world - moving.pictures.camera_to_world)[train, :3, 3]
    centres = np.unique(shifts, axis=0)
    assert np.abs(centres.mean(0)).max() < 0.2 * np.abs(centres).max()
    with pytest.raises(TrainingError, match="--refine was"):
        trainer(moving, steps=40).resume(tmp_path / "c.kpck")


@pytest.mark.parametrize("mapping", [None, Contraction(4.0)])
@pytest.mark.parametrize("other", [{}, {"motion_cells": 3}, {"view_dependent": False}])
def test_both_optimisers_find_the_same_gradients_of_rays(
    moving: Dataset, mapping: Contraction | None, other: dict[str, object]
) -> None:
    run = trainer(moving, mapping, refine="cameras", **other)
    run.run_until(10)
    batch, targets = run.sampler.draw(run.rng, 256)
    plain = torch_twin(run)
    args = (10, 0.5, 0.0, batch, targets, run.aabb, run.grid.active, run.step_length, run.extent)
    run.optimiser.step(*args)
    plain.step(*args)
    ours, theirs = run.optimiser.ray_gradients, plain.ray_gradients
    for part in (slice(3), slice(3, 6), slice(6, 7), slice(7, 10)):
        # Samples of weight below 1e-4 have no colour in the kernels.
        assert np.linalg.norm(ours[:, part] - theirs[:, part]) < 0.02 * np.linalg.norm(theirs[:, part])


def test_corrections_are_kept_as_json_and_described(moving: Dataset) -> None:
    run = trained(moving, steps=20, refine="all")
    assert run.cameras is not None
    corrections = run.cameras.corrections()
    kept = json.loads(json.dumps([asdict(one) for one in corrections]))
    again, refined = with_corrections(moving, kept).pictures, run.refined_dataset().pictures
    for name in ("camera_to_world", "intrinsics", "time"):
        np.testing.assert_array_equal(getattr(again, name), getattr(refined, name))
    table = describe_corrections(corrections, 0.1).splitlines()
    assert len(table) == 2 + len(corrections) and "turned degrees" in table[1]
    many = describe_corrections(corrections * 40, 0.1)
    assert "median" in many and "largest" in many and len(many.splitlines()) == 4


@pytest.mark.parametrize(
    ("wanted", "made_by", "clock", "found"),
    [
        ("auto", None, 0.0, "none"),
        ("auto", "kpposes", 0.0, "cameras"),
        ("auto", "kpposes", 0.1, "all"),
        ("none", "kpposes", 0.1, "none"),
        ("all", None, 0.0, "all"),
    ],
)
def test_cameras_that_were_found_are_refined(
    tmp_path: Path, wanted: str, made_by: str | None, clock: float, found: str
) -> None:
    write_nerfstudio(tmp_path / "set", **({} if made_by is None else {"made_by": made_by}))
    dataset = load_dataset(tmp_path / "set", tmp_path / "cache", progress=False)
    dataset = replace(dataset, clocks={"cam00.mp4": (clock, 1.0)})
    options = Options(Path("set"), Path("out.kpc"), refine=wanted)
    assert options.refine_of(dataset)[0] == options.config(dataset).refine == found
    if wanted == "auto" and made_by is not None:
        beside = ", and the clocks of the videos differ" if clock else ""
        assert options.refine_of(dataset)[1] == f"the poses were found, not given{beside}; --refine overrides"


@pytest.mark.usefixtures("quick_coding", "rounded")
def test_kpenc_refines_cameras_as_asked(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setitem(PRESETS, "draft", TINY)
    write_n3dv(tmp_path / "set")

    def run(*options: str) -> tuple[int, str, str]:
        arguments = [str(tmp_path / "set"), "-o", str(tmp_path / "out.kpc"), "--preset", "draft", "--test-views", "1"]
        return kpenc.main([*arguments, *options]), *capsys.readouterr()

    code, out, err = run("--json", "--steps", "12", "--refine", "all")
    result = json.loads(out)
    assert code == 0 and result["refine"] == "all" and "clocks and exposures are refined (as given)" in err
    assert "corrections of the cameras" in err
    file = scene_io.read(tmp_path / "out.kpc")
    assert file.metadata.provenance["options"]["refine"] == "all"
    stored, refined = (
        np.array(sorted(np.ravel(pose).tolist() for pose in poses))
        for poses in ([c.camera_to_world for c in file.cameras], [c["camera_to_world"] for c in result["corrections"]])
    )
    np.testing.assert_allclose(stored, refined, atol=2e-5)  # rounded in the file
    assert all(one["turned_degrees"] > 0 for one in result["corrections"])
    code, out, err = run("--steps", "1")
    assert code == 0 and "cameras: not refined (the poses were given; --refine overrides)" in err
    assert "aligned with the scene" not in out
