"""Rendering in PyTorch: the parts that kernels replace, and the hybrid decoder, whose gradients only PyTorch has."""

from dataclasses import replace

import numpy as np
import pytest
import torch

from gradients import FIELD_KINDS, FieldFunction, bilinear, random_rays, translucent_scene
from kpc.encoder.evaluation.evaluate import SceneRenderer
from kpc.encoder.field.config import TrainConfig
from kpc.encoder.field.field import Field, HybridField, SummedField
from kpc.encoder.field.fused import fused_features, max_samples_per_ray, sample_rays_fused
from kpc.encoder.field.layout import Layout
from kpc.encoder.field.render import Rays, sample_rays, select_reached, shade, weigh_samples
from kpc.encoder.training.cuda_graphs import GraphCache
from kpc.encoder.training.torch_optimiser import DeferredReadback, TorchOptimiser
from kpc.player.cpu import reference
from scenes import tiny_scene, with_hybrid_decoder


@pytest.mark.parametrize("kind", FIELD_KINDS)
def test_fused_samples_equal_those_of_pytorch(kind: tuple[bool, bool, bool]) -> None:
    scene = translucent_scene(*kind)
    rays = random_rays(scene, 403)
    ours = sample_rays_fused(rays, scene.aabb, scene.occupancy, scene.step, scene.mapping)
    theirs = sample_rays(
        rays, torch.from_numpy(scene.aabb), torch.from_numpy(scene.occupancy), scene.step, scene.mapping
    )
    # A sample within rounding of a cell's face may count in one only: rays with equal counts have equal samples.
    counts = [np.bincount(samples.ray.numpy(), minlength=403) for samples in (ours, theirs)]
    same = counts[0] == counts[1]
    assert same.mean() > 0.98 and counts[0].sum() > 403
    mine, other = same[ours.ray], same[theirs.ray]
    np.testing.assert_array_equal(ours.ray[mine], theirs.ray[other])
    for name, tolerance in (("points", 1e-5), ("s", 1e-4), ("length", 0), ("density_scale", 1e-4)):
        np.testing.assert_allclose(
            getattr(ours, name)[mine], getattr(theirs, name)[other], atol=tolerance, rtol=1e-4, err_msg=name
        )
    assert (ours.cell[mine] == theirs.cell[other]).float().mean() > 0.999


@pytest.mark.parametrize("short", [0, 300])
def test_samples_of_fixed_capacity_are_the_same_and_padding_changes_nothing(short: int) -> None:
    scene = translucent_scene()
    # The number of rays is such that samples fill vectors of 16: remainders are rounded differently on one thread.
    rays, field = random_rays(scene, 112), Field.from_scene(scene)
    arguments = rays, torch.from_numpy(scene.aabb), torch.from_numpy(scene.occupancy), scene.step
    wanted = sample_rays(*arguments)
    n = len(wanted.ray) - short
    assert len(wanted.ray) % 16 == 0
    found = sample_rays(
        *arguments, most=max_samples_per_ray(scene.aabb, scene.step), capacity=n + (0 if short else 500)
    )
    for name in ("ray", "points", "s", "length", "density_scale", "cell"):
        assert torch.equal(getattr(found, name)[:n], getattr(wanted, name)[:n]), name
    assert len(found.ray) == n + (0 if short else 500) and not found.length[n:].any() and short < n
    if not short:
        one, two = (weigh_samples(field, rays, s, field.features, scene.extent) for s in (wanted, found))
        assert torch.equal(shade(field, rays, one), shade(field, rays, two)) and torch.equal(
            one.weights, two.weights[:n]
        )
        assert torch.isclose(one.distortion, two.distortion, rtol=1e-5)


def test_mixed_precision_is_within_its_bound_of_float32() -> None:
    """Inputs and weights of layers have a relative error of 2^-9, half a step of bfloat16, and sums are in float32.

    Colours then differ by less than 1 % of the range, and gradients by less than 1 % of the largest of their kind.
    """
    scene = with_hybrid_decoder(translucent_scene())
    rays = random_rays(scene, 203)
    samples = sample_rays(rays, torch.from_numpy(scene.aabb), torch.from_numpy(scene.occupancy), scene.step)
    rgb, gradients = {}, {}
    for mixed in (False, True):
        field = Field.from_scene(scene)
        field.mixed = mixed
        rgb[mixed] = shade(field, rays, weigh_samples(field, rays, samples, field.features, scene.extent))
        rgb[mixed].square().mean().backward()
        gradients[mixed] = {name: p.grad for name, p in field.named_parameters()}
        assert all(p.grad is not None and p.grad.dtype == torch.float32 for p in field.parameters())
    assert not torch.equal(rgb[True], rgb[False])
    assert (rgb[True] - rgb[False]).abs().max() < 0.01
    for name, gradient in gradients[False].items():
        assert (gradient - gradients[True][name]).abs().max() < 0.03 * gradient.abs().max(), name


def test_gradients_are_summed_in_float32() -> None:
    """A thousand of 1/4096 after one of 1: a float16 sum would stay at 1."""
    plane = torch.ones(2, 2, 1, requires_grad=True)
    u = torch.zeros(1001)
    g = torch.full((1001, 1), 1 / 4096)
    g[0] = 1
    (bilinear(plane, u, u) * g).sum().backward()
    assert plane.grad is not None and plane.grad[0, 0, 0] == 1 + 1000 / 4096


@pytest.mark.skipif(not torch.cuda.is_available(), reason="no CUDA device here")
@pytest.mark.parametrize("hybrid_decoder", [False, True])
def test_a_step_on_a_gpu_never_synchronises(hybrid_decoder: bool) -> None:
    scene = with_hybrid_decoder(translucent_scene()) if hybrid_decoder else translucent_scene()
    field = Field.from_scene(scene).cuda()
    config = TrainConfig(hybrid=hybrid_decoder)
    optimiser = TorchOptimiser(field, config, scene.occupancy.shape[1:])
    rays, targets = random_rays(scene, 203), torch.rand(203, 3)
    arguments = scene.aabb, scene.occupancy, scene.step, scene.extent
    losses = [optimiser.step(k, 0.0, 0.1, rays, targets, *arguments)[0] for k in range(DeferredReadback.LATE + 2)]
    torch.cuda.set_sync_debug_mode("error")
    try:
        losses += [optimiser.step(k, 0.0, 0.1, rays, targets, *arguments)[0] for k in range(20)]
    finally:
        torch.cuda.set_sync_debug_mode("default")
    assert losses[-1] < losses[0]


@pytest.mark.skipif(not torch.cuda.is_available(), reason="no CUDA device here")
@pytest.mark.parametrize("moved", [False, True])
def test_a_captured_step_on_a_gpu_equals_an_eager_one(moved: bool, monkeypatch: pytest.MonkeyPatch) -> None:
    scene = translucent_scene(True, False, moved)
    rays, targets = random_rays(scene, 203), torch.rand(203, 3)
    arguments = scene.aabb, scene.occupancy, scene.step, scene.extent
    found = []
    for records in (True, False):
        if not records:
            monkeypatch.setattr(GraphCache, "run", lambda self, key, inputs, work: work(*inputs))
        field = Field.from_scene(scene).cuda()
        optimiser = TorchOptimiser(field, TrainConfig(learning_rate=1e-3), scene.occupancy.shape[1:])
        losses = [optimiser.step(k, 0.0, 1.0, rays, targets, *arguments)[0] for k in range(60)]
        assert bool(optimiser._graphs.captured) == records
        found.append((losses[-1], field.theta.detach().cpu(), optimiser.peaks()))
    (loss, theta, peaks), (wanted_loss, wanted_theta, wanted_peaks) = found
    assert loss == pytest.approx(wanted_loss, rel=1e-3)
    torch.testing.assert_close(theta, wanted_theta, rtol=0, atol=2e-3)
    np.testing.assert_allclose(peaks, wanted_peaks, atol=1e-3)


@pytest.mark.parametrize("moved", [False, True])
def test_samples_that_are_not_reached_contribute_nothing(moved: bool) -> None:
    scene = translucent_scene(True, False, moved)
    rays, field = random_rays(scene, 203), Field.from_scene(scene).double()
    rays = rays.map(torch.Tensor.double)
    samples = sample_rays(rays, torch.from_numpy(scene.aabb).double(), torch.from_numpy(scene.occupancy), scene.step)
    whole = weigh_samples(field, rays, samples, field.features, scene.extent)
    assert not whole.reached.all()
    shown = shade(field, rays, whole)
    shown.square().sum().backward()
    wanted, field.theta.grad = field.theta.grad, None
    count = int(whole.reached.sum())
    for room in (count, count + 100):
        some = select_reached(samples, whole.reached, room)
        assert len(some.ray) == room and (some.ray.diff() >= 0).all()
        weighed = weigh_samples(field, rays, some, field.features, scene.extent)
        found = shade(field, rays, weighed)
        torch.testing.assert_close(found, shown)
        torch.testing.assert_close(weighed.distortion, whole.distortion)
        found.square().sum().backward()
        torch.testing.assert_close(field.theta.grad, wanted)
        field.theta.grad = None


def test_rays_through_empty_space_have_no_samples() -> None:
    scene = translucent_scene()
    rays = random_rays(scene, 13)
    away = replace(rays, origins=rays.origins + 100)
    samples = sample_rays_fused(away, scene.aabb, scene.occupancy, scene.step)
    assert len(samples.ray) == 0
    field = Field.from_scene(with_hybrid_decoder(scene))
    weighed = weigh_samples(field, away, samples, fused_features(field), scene.extent)
    assert (
        torch.equal(shade(field, away, weighed), away.backgrounds)
        and not weighed.opacity.any()
        and float(weighed.distortion.detach()) == 0
    )


@pytest.mark.parametrize("moved", [False, True])
@pytest.mark.parametrize("dynamic", [False, True])
def test_fused_features_equal_those_of_pytorch_with_their_gradient(dynamic: bool, moved: bool) -> None:
    scene = translucent_scene(dynamic, False, moved and dynamic)
    ours, theirs = Field.from_scene(scene), Field.from_scene(scene).double()
    generator = torch.Generator().manual_seed(0)
    points, times = torch.rand(500, 3, generator=generator), torch.rand(500, generator=generator)
    g = torch.randn(500, ours.layout.features, generator=generator)
    found, wanted = fused_features(ours)(points, times), theirs.features(points.double(), times.double())
    np.testing.assert_allclose(found.detach(), wanted.detach(), rtol=1e-4, atol=1e-5)
    (found * g).sum().backward()
    (wanted * g.double()).sum().backward()
    for name in ("theta", *(["motion"] if ours.motion is not None else [])):
        mine, other = getattr(ours, name).grad, getattr(theirs, name).grad
        np.testing.assert_allclose(mine, other, atol=1e-3 * float(other.abs().max()), err_msg=name)


def test_the_hybrid_decoders_gradient_matches_finite_differences() -> None:
    generator = torch.Generator().manual_seed(3)
    field = HybridField(Layout.of(np.array([[3, 3, 2, 2]]), 2), 3, generator).double()
    aabb = torch.tensor([[-1.0, -1.0, -0.5], [1.0, 1.0, 0.5]], dtype=torch.float64)
    directions = torch.nn.functional.normalize(torch.randn(4, 3, generator=generator, dtype=torch.float64), dim=1)
    chances = (torch.rand(4, generator=generator).double() for _ in range(2))
    rays = Rays(-2 * directions, directions, *chances, torch.rand(4, 3, generator=generator).double())
    samples = sample_rays(rays, aabb, torch.ones(1, 2, 2, 2), 0.3)
    parameters = dict(field.named_parameters())

    def rendered() -> tuple[torch.Tensor, torch.Tensor]:
        weighed = weigh_samples(field, rays, samples, field.features, 2.0)
        return shade(field, rays, weighed), weighed.distortion

    def rendered_by_parameters(*values: torch.Tensor) -> tuple[torch.Tensor, torch.Tensor]:
        changed = {f"field.{name}": value for name, value in zip(parameters, values, strict=True)}
        return torch.func.functional_call(FieldFunction(field, rendered), changed, ())  # type: ignore[no-any-return]

    values = tuple(p.detach().clone().requires_grad_() for p in parameters.values())
    assert torch.autograd.gradcheck(rendered_by_parameters, values)
    rgb, _ = rendered_by_parameters(*values)
    for name, gradient in zip(parameters, torch.autograd.grad(rgb.square().sum(), values), strict=True):
        assert gradient.abs().max() > 0, name


@pytest.mark.parametrize("kind", FIELD_KINDS)
def test_pictures_of_a_hybrid_scene_equal_the_references(kind: tuple[bool, bool, bool]) -> None:
    scene = with_hybrid_decoder(translucent_scene(*kind))
    renderer = SceneRenderer(scene)
    for camera in scene.cameras:
        origins, directions = camera.rays()
        theirs = reference.render_rays(scene, origins, directions, 0.3)
        rgb, opacity, depth = renderer.render(origins, directions, np.full(len(origins), 0.3))
        # A sample within rounding of a cell's face may count here and not there; few rays have one.
        assert np.mean(np.abs(rgb - theirs.rgb).max(1) > 1e-4) < 0.005
        assert np.abs(rgb - theirs.rgb).max() < 0.3
        assert np.mean(np.abs(opacity - theirs.opacity) > 1e-4) < 0.005
        there = theirs.opacity > 0.01
        assert np.mean(np.abs(depth[there] - theirs.depth[there]) > 0.01) < 0.01


def test_a_hybrid_field_converts_to_a_scene_and_back() -> None:
    scene = with_hybrid_decoder(tiny_scene())
    field = Field.from_scene(scene)
    assert isinstance(field, HybridField)
    for name, weights in vars(field.export_decoder()).items():
        np.testing.assert_array_equal(weights, getattr(scene.decoder, name), err_msg=name)


def test_a_summed_field_adds_its_planes() -> None:
    field = SummedField(Layout.of(np.array([[4, 3, 2, 3]]), 2), 2, torch.Generator().manual_seed(0))
    assert not field.plane(0, "xt").any() and field.plane(0, "xy").all()
    points, times = torch.rand(9, 3), torch.rand(9)
    axis = {"x": points[:, 0], "y": points[:, 1], "z": points[:, 2], "t": times}
    wanted = sum(
        bilinear(field.plane(0, name), axis[name[0]], axis[name[1]]) for name in ("xy", "xz", "yz", "xt", "yt", "zt")
    )
    torch.testing.assert_close(field.features(points, times), wanted)
    assert fused_features(field)(points, times).equal(field.features(points, times))
