"""Training with extreme numbers and extreme scenes.

Results are compared with the float64 reference, or must stay finite while training makes progress.
"""

import math
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch

import datasets as make
from gradients import random_rays, translucent_scene
from kpc.encoder.cli.encode_scene import to_scene
from kpc.encoder.datasets import Dataset, load_dataset
from kpc.encoder.evaluation.evaluate import SceneRenderer, evaluate
from kpc.encoder.field import kernels
from kpc.encoder.field.bounds import find_box
from kpc.encoder.field.config import TrainConfig
from kpc.encoder.field.field import Field
from kpc.encoder.field.fused import planes_of
from kpc.encoder.field.layout import Layout
from kpc.encoder.field.priors import plane_priors
from kpc.encoder.field.render import Rays
from kpc.encoder.training.optimisers import add_prior_gradients
from kpc.encoder.training.train import Report, Trainer
from kpc.format.common.errors import DatasetError
from kpc.format.common.images import write_image
from kpc.format.scene.scene import LOG_DENSITY_LIMIT, TERMINATION, Scene
from kpc.tools.bench.stability.gradients import backpropagate, reference_gradients

pytestmark = pytest.mark.usefixtures("one_thread")
CONFIG = TrainConfig(
    resolutions=(8, 16),
    samples_across=48,
    cells_across=16,
    steps=40,
    rays=256,
    samples=12288,
    warmup=5,
    occupancy_start=16,
    occupancy_every=8,
)
BOX = np.array([[-1, -1, -1], [1, 1, 1]], np.float32)


def ignore(_: Report) -> None:
    """Drop a report of training."""


def trained(dataset: Dataset, box: np.ndarray, **changes: object) -> Trainer:
    run = Trainer(dataset, replace(CONFIG, **changes), box, "cpu")  # type: ignore[arg-type]
    run.run(ignore)
    return run


def assert_finite(run: Trainer) -> None:
    for name, parameter in run.field.named_parameters():
        assert bool(torch.isfinite(parameter).all()), name


@pytest.mark.parametrize("bias", [-1e4, -LOG_DENSITY_LIMIT, LOG_DENSITY_LIMIT, 1e4])
def test_log_densities_far_beyond_the_limit_have_finite_gradients(bias: float) -> None:
    """Log density is clipped, so beyond the limit density is constant and its gradient 0."""
    scene = translucent_scene()
    scene = replace(scene, decoder=replace(scene.decoder, density_bias=bias))
    rays = random_rays(scene, 103)
    targets = torch.rand(103, 3, generator=torch.Generator().manual_seed(1))
    ours, theirs = backpropagate(scene, rays, targets), reference_gradients(scene, rays, targets)
    for name in ("theta", "density", "basis", "errors"):
        assert np.isfinite(ours[name]).all() and np.isfinite(theirs[name]).all(), name
        np.testing.assert_allclose(
            ours[name], theirs[name], atol=1e-3 * max(np.abs(theirs[name]).max(), 1e-6), err_msg=name
        )
    if abs(bias) == 1e4:
        assert not ours["density"].any()


@pytest.mark.parametrize("order", range(6))
@pytest.mark.parametrize("large", [0, 3, 6])
def test_products_of_six_values_near_1e_minus_6_and_1e6(large: int, order: int) -> None:
    """The feature, from 1e-36 to 1e36, and its six derivatives are accurate to float32 in any order of the planes."""
    values = np.roll([1.1e6] * large + [0.9e-6] * (6 - large), order)
    field = Field(Layout.of(np.array([[2, 2, 2, 2]]), 1), 1)
    with torch.no_grad():
        for (_, name, *_), value in zip(field.layout.planes(), values, strict=True):
            field.plane(0, name).fill_(float(value))
    planes, layout = planes_of(field), field.layout
    corner = np.zeros((1, 3), np.float32), np.zeros(1, np.float32)
    features = kernels.features(planes, *corner, 1)
    exact = np.prod(values.astype(np.float32).astype(np.float64))
    assert features[0, 0] == pytest.approx(exact, rel=1e-6)
    grad = np.zeros((1, layout.size), np.float32)
    kernels.scatter_features(
        planes, grad, planes.motion[None], np.zeros((0, 4), np.float32), *corner, np.ones((1, 1), np.float32)
    )
    for (_, name, start, *_), value in zip(layout.planes(), values, strict=True):
        assert grad[0, start] == pytest.approx(exact / float(np.float32(value)), rel=1e-5), name


def fog(steps: int, optical_depth: float) -> tuple[Scene, Rays]:
    """Return a box of homogeneous fog and a ray along x that crosses it in `steps` steps."""
    scene = translucent_scene(dynamic=False)
    scene = replace(
        scene,
        aabb=BOX,
        occupancy=np.ones_like(scene.occupancy),
        step=2.0 / steps,
        decoder=replace(
            scene.decoder,
            density_weight=np.zeros_like(scene.decoder.density_weight),
            density_bias=math.log(optical_depth),
        ),
    )
    one = torch.ones(1)
    return scene, Rays(
        torch.tensor([[-2.0, 0.1, 0.2]]), torch.tensor([[1.0, 0, 0]]), 0 * one, 0.5 * one, torch.ones(1, 3)
    )


@pytest.mark.parametrize("optical_depth", [1e-3, 1.0, 9.0])
def test_transmittance_over_4096_samples(optical_depth: float) -> None:
    """The product of 4096 factors errs by at most half a unit in the last place each: 4096 * 2^-24 = 2.4e-4."""
    scene, ray = fog(4096, optical_depth)
    renderer = SceneRenderer(scene)
    _, opacity, _ = renderer.render(ray.origins.numpy(), ray.directions.numpy(), ray.times.numpy())
    tau, trans = optical_depth / 4096, 1.0
    for _ in range(4096):
        if trans < TERMINATION:
            break
        trans *= math.exp(-tau)
    assert 1 - float(opacity[0]) == pytest.approx(trans, rel=3e-4)
    black = replace(
        scene, decoder=replace(scene.decoder, w2=0 * scene.decoder.w2, b2=np.full_like(scene.decoder.b2, -40.0))
    )
    ours, theirs = (f(black, ray, torch.zeros(1, 3)) for f in (backpropagate, reference_gradients))
    assert ours["counts"][0] == theirs["samples"] >= min(4096, math.floor(-math.log(TERMINATION) / tau))
    assert ours["density"][-1] == pytest.approx(theirs["density"][-1], rel=5e-3)


def test_time_planes_at_identity_get_the_gradient_of_the_pictures() -> None:
    """Time planes start at 1, where their L1 prior has a kink and gradient 0; the data gradient must not vanish."""
    scene = translucent_scene()
    ones = tuple({name: np.ones_like(p) if "t" in name else p for name, p in scale.items()} for scale in scene.scales)
    scene = replace(scene, scales=ones)
    rays = random_rays(scene, 203)
    ours = backpropagate(scene, rays, torch.zeros(203, 3))
    field = Field.from_scene(scene)
    prior, variation = np.zeros(field.layout.size, np.float32), TrainConfig().variation(1.0)
    add_prior_gradients(field, field.theta.detach().numpy(), prior, TrainConfig(), variation, 1.0)
    sum(plane_priors(field, TrainConfig(), variation).values()).backward()
    for _, name, start, rows, columns in field.layout.planes():
        part = slice(start, start + rows * columns * field.layout.channels)
        if "t" in name:
            assert np.abs(ours["theta"][part]).max() > 0, name
            assert not prior[part].any() and not field.theta.grad[part].any(), name


def resized(dataset: Dataset, factor: float, near: float, far: float) -> Dataset:
    """Return the same scene in units `factor` times as small, with near and far depths."""
    p, poses = dataset.pictures, dataset.pictures.camera_to_world.copy()
    poses[:, :3, 3] *= factor
    count = len(p)
    bounds = (np.full(count, near * factor, np.float32), np.full(count, far * factor, np.float32))
    return replace(dataset, pictures=replace(p, camera_to_world=poses, near=bounds[0], far=bounds[1]))


@pytest.mark.parametrize("factor", [1e-4, 1.0, 1e6])
def test_the_unit_of_length_does_not_matter(moving: Dataset, factor: float) -> None:
    """Density is per longest edge of the box, so the same pictures train the same planes in any unit."""
    unscaled = trained(moving, BOX)
    scaled = trained(resized(moving, factor, np.nan, np.nan), BOX * np.float32(factor))
    ours, theirs = evaluate(to_scene(scaled), moving_with(moving, scaled)), evaluate(to_scene(unscaled), moving)
    assert_finite(scaled)
    assert ours is not None and theirs is not None and ours.psnr == pytest.approx(theirs.psnr, abs=0.5)


def moving_with(dataset: Dataset, run: Trainer) -> Dataset:
    return replace(dataset, pictures=run.dataset.pictures)


def test_near_and_far_differ_by_a_factor_of_a_million(moving: Dataset) -> None:
    far = resized(moving, 1.0, 1e-3, 1e3)
    box = find_box(far.pictures, has_alpha=True)
    assert np.isfinite(box).all() and (box[1] - box[0]).max() > 1e3
    assert_finite(trained(far, box, steps=12))


@pytest.mark.parametrize("frames", [1, 10_000])
def test_clips_of_one_and_of_ten_thousand_frames(moving: Dataset, frames: int) -> None:
    clip = replace(moving.clip, frame_count=frames)
    run = trained(replace(moving, clip=clip, is_dynamic=frames > 1), BOX, steps=12, resolutions=(4,), channels=2)
    assert_finite(run)
    rows = run.field.layout.resolution[0, 3]
    assert rows == (0 if frames == 1 else math.ceil(10_000 / CONFIG.frames_per_row))


def images_of(folder: Path, pixels: np.ndarray, cameras: int = 4) -> Dataset:
    """Return a ring of cameras with the same picture."""
    make.write_nerfstudio(folder / "set", images=cameras)
    for image in sorted((folder / "set" / "images").iterdir()):
        write_image(image, pixels)
    return load_dataset(folder / "set", folder / "cache", holdout="none", progress=False)


@pytest.mark.parametrize("rgba", [(0, 0, 0), (255, 255, 255), (9, 9, 9, 0), (255, 255, 255, 255)])
def test_uniform_pictures_are_reproduced(tmp_path: Path, rgba: tuple[int, ...]) -> None:
    """All black, all white, all transparent: training reproduces the colour at the centre of the picture."""
    camera = make.look_at((0, -3, 0.8))
    dataset = images_of(tmp_path, np.full((camera.height, camera.width, len(rgba)), rgba, np.uint8))
    run = trained(dataset, BOX, steps=120)
    assert_finite(run)
    scene = to_scene(run)
    picture = SceneRenderer(scene).picture(dataset, 0)
    expected = 255.0 if len(rgba) == 4 and rgba[3] == 0 else float(rgba[0])  # transparent ones lie on white
    centre = picture[8:16, 12:20].mean()
    assert np.isfinite(picture).all() and 255 * centre == pytest.approx(expected, abs=0.5)


def test_pictures_of_one_pixel_are_reproduced(tmp_path: Path) -> None:
    rig = [replace(c, width=1, height=1, fl_x=2.0, fl_y=2.0, cx=0.5, cy=0.5) for c in make.ring(4)]
    many = images_of(tmp_path, np.full((24, 32, 3), 80, np.uint8))
    p = many.pictures
    n = len(p)
    one = np.ones(n, np.int32)
    small = replace(p, width=one, height=one, intrinsics=np.array([[c.fl_x, c.fl_y, c.cx, c.cy] for c in rig]))
    run = trained(replace(many, pictures=small), BOX, steps=120)
    assert_finite(run)
    assert 255 * SceneRenderer(to_scene(run)).picture(run.dataset, 0) == pytest.approx(80, abs=2)


def test_identical_cameras_are_refused(tmp_path: Path) -> None:
    make.write_nerfstudio(tmp_path / "set", images=4)

    def stack(document: dict[str, list[dict[str, object]]]) -> None:
        for frame in document["frames"]:
            frame["transform_matrix"] = document["frames"][0]["transform_matrix"]

    make.edit_json(tmp_path / "set" / "transforms.json", stack)
    with pytest.raises(DatasetError, match="does not move"):
        load_dataset(tmp_path / "set", tmp_path / "cache", progress=False)
