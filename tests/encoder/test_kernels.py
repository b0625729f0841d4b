"""The fused kernels agree with their references: the PyTorch field in float64, torch.optim.Adam, the numpy renderer.

Tolerances. In float32 a sample 4 units from the camera is placed to about 2^-22, 5e-7 of the box. In planes of 24
texels whose values change by 1 per texel that is 1e-5 of a feature; with six factors, 16 features and 60 samples it
becomes 1e-4 at worst. Colours must agree to 1e-4, a fortieth of an 8-bit level; gradients to 1e-3 of the largest
element of their array.
"""

import copy
import math
import os
import subprocess
import sys
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch
from numba.core.dispatcher import Dispatcher

from gradients import FIELD_KINDS, FieldFunction, random_rays, translucent_scene
from kpc.encoder.evaluation.evaluate import SceneRenderer
from kpc.encoder.field import kernels
from kpc.encoder.field.config import TrainConfig
from kpc.encoder.field.field import Field
from kpc.encoder.field.fused import (
    ColourBasis,
    colour_gradients,
    count_samples,
    fused_features,
    log_densities,
    march_scene,
    max_samples_per_ray,
    planes_of,
    ray_batch,
    volume_of,
    weigh_cells,
)
from kpc.encoder.field.kernels import compilation
from kpc.encoder.field.kernels.backward import LEAST_PEAK
from kpc.encoder.field.layout import Layout
from kpc.encoder.field.occupancy_grid import STRIDE, STRIDED
from kpc.encoder.field.priors import plane_priors
from kpc.encoder.field.render import Rays, render_reference, shade
from kpc.encoder.training.optimisers import BETA1, BETA2, EPSILON, add_prior_gradients
from kpc.format.container.scene_layout import SAMPLE_LIMIT
from kpc.player.cpu import reference
from kpc.tools.bench.stability.gradients import backpropagate, reference_gradients
from scenes import tiny_scene, with_motion

COLOUR = 1e-4
GRADIENT = 1e-3

KERNEL_MODULES = ("geometry", "planes", "marching", "backward", "points", "directions", "updates")


def assert_peaks_match(ours: np.ndarray, theirs: np.ndarray) -> None:
    """Assert that peaks agree where they matter, and that the kernels keep no others."""
    matter, others = theirs > LEAST_PEAK + COLOUR, theirs < LEAST_PEAK - COLOUR
    assert matter.any() and others.any() and not ours[others].any()
    np.testing.assert_allclose(ours[matter], theirs[matter], atol=COLOUR)


@pytest.mark.parametrize("kind", FIELD_KINDS)
def test_backpropagate_equals_autograd_through_the_reference(kind: tuple[bool, bool, bool]) -> None:
    scene = translucent_scene(*kind)
    rays = random_rays(scene, 403)
    targets = torch.rand(403, 3, generator=torch.Generator().manual_seed(1))
    ours, theirs = backpropagate(scene, rays, targets), reference_gradients(scene, rays, targets)
    assert ours["counts"].sum() == theirs["samples"] > 403
    np.testing.assert_allclose(ours["errors"], theirs["errors"], atol=6 * COLOUR)  # d e^2 = 2 e de, three channels
    assert_peaks_match(ours["peaks"], theirs["peaks"])
    for name in ("theta", "density", "basis", "rays", *(["motion"] if scene.motion is not None else [])):
        largest = np.abs(theirs[name]).max()
        assert largest > 0
        np.testing.assert_allclose(ours[name], theirs[name], atol=GRADIENT * largest, err_msg=name)


def test_the_error_of_faint_samples_without_colour_is_bounded() -> None:
    """Samples of weight below 1e-4 have no colour: the error is at most that times `max_samples_per_ray`."""
    scene = tiny_scene()
    rays = random_rays(scene, 203)
    targets = torch.rand(203, 3, generator=torch.Generator().manual_seed(1))
    ours, theirs = backpropagate(scene, rays, targets), reference_gradients(scene, rays, targets)
    colour = 1e-4 * max_samples_per_ray(scene.aabb, scene.step)
    np.testing.assert_allclose(ours["errors"], theirs["errors"], atol=6 * colour)
    for name in ("theta", "density"):
        difference = np.linalg.norm(ours[name] - theirs[name]) / np.linalg.norm(theirs[name])
        assert difference < colour, (name, difference)


def test_drawn_samples_have_the_gradient_of_all_on_average() -> None:
    """Compare sums over rays and over the texels of a plane; those of the density's weights cancel most."""
    scene = translucent_scene()
    rays, targets = random_rays(scene, 1500), torch.zeros(1500, 3)
    every, drawn = (backpropagate(scene, rays, targets, full_weight=weight) for weight in (0.0, 0.25))
    np.testing.assert_array_equal(drawn["errors"], every["errors"])
    np.testing.assert_array_equal(drawn["peaks"], every["peaks"])
    assert (drawn["basis"] != every["basis"])[every["counts"] > 2].mean() > 0.9  # some of their samples were not drawn
    layout = Field.from_scene(scene).layout
    starts = [start for _, _, start, _, _ in layout.planes()]
    for g in (every, drawn):
        g["theta"] = np.add.reduceat(g["theta"].reshape(-1, layout.channels), np.array(starts) // layout.channels)
        g |= {name: g[name].sum(0) for name in ("basis", "rays")}
    for name, most in {"theta": 0.03, "basis": 0.03, "rays": 0.03, "density": 0.25}.items():
        assert np.linalg.norm(drawn[name] - every[name]) < most * np.linalg.norm(every[name]), name


@pytest.mark.parametrize("kind", FIELD_KINDS)
def test_colour_gradients_and_weights_equal_those_of_pytorch(kind: tuple[bool, bool, bool]) -> None:
    scene = translucent_scene(*kind)
    field, rays = Field.from_scene(scene), random_rays(scene, 203)
    factors = np.random.default_rng(2).choice(np.array([-1, 1], np.float32), (203, 3))
    samples, weighed = march_scene(field, rays, scene)
    colours = shade(field, rays, weighed)
    wanted = [field.theta] if field.motion is None else [field.theta, field.motion]
    theirs = torch.autograd.grad((torch.from_numpy(factors) * colours).sum(), wanted)
    for one, other in zip(colour_gradients(field, rays, scene, factors), theirs, strict=True):
        np.testing.assert_allclose(one, other.numpy(), atol=GRADIENT * float(other.abs().max()))
    ray, cells, weights = weigh_cells(field, rays, scene)
    reached = weighed.reached.numpy()
    np.testing.assert_array_equal(ray, samples.ray.numpy()[reached])
    np.testing.assert_array_equal(cells, samples.cell.numpy()[reached])
    np.testing.assert_allclose(weights, weighed.weights.detach().numpy()[reached], atol=COLOUR)


def test_samples_with_a_stride_absorb_as_much_on_average() -> None:
    """Rays take every STRIDE-th step through a box that is thin enough for its absorption to be all but linear."""
    scene = translucent_scene()
    scene = replace(scene, decoder=replace(scene.decoder, density_bias=-4.0), occupancy=np.ones((1, 4, 4, 4), np.uint8))
    field, rays = Field.from_scene(scene), random_rays(scene, 1500)
    whole = weigh_cells(field, rays, scene)
    strided = weigh_cells(field, rays, replace(scene, occupancy=np.full((1, 4, 4, 4), STRIDED, np.uint8)))
    assert len(strided[0]) == pytest.approx(len(whole[0]) / STRIDE, rel=0.02)
    assert strided[2].sum() == pytest.approx(whole[2].sum(), rel=0.02)


def test_the_number_of_workers_changes_only_rounding() -> None:
    scene = translucent_scene()
    rays, targets = random_rays(scene, 103), torch.zeros(103, 3)
    one, three = backpropagate(scene, rays, targets, workers=1), backpropagate(scene, rays, targets, workers=3)
    np.testing.assert_array_equal(one["errors"], three["errors"])
    np.testing.assert_array_equal(one["basis"], three["basis"])
    np.testing.assert_array_equal(one["peaks"], three["peaks"])
    # A sum of at most 103 * 60 float32 terms in another order.
    np.testing.assert_allclose(one["theta"], three["theta"], atol=1e-5 * np.abs(one["theta"]).max())


def test_compiled_and_cached_kernels_give_equal_results(tmp_path: Path) -> None:
    """The first process compiles a kernel, the second loads it from numba's cache; reordered sums would differ.

    The kernel that compiles fastest and has a sum stands for all, as they are compiled with the same flags.
    """
    modules = [getattr(kernels, name) for name in KERNEL_MODULES]
    functions = [f for module in modules for f in vars(module).values() if isinstance(f, Dispatcher)]
    assert len(functions) > 20 and all(f.targetoptions["fastmath"] == compilation.FASTMATH for f in functions)
    field, rng = Field.from_scene(tiny_scene()), np.random.default_rng(0)
    planes, density = planes_of(field), field.density.detach().numpy()
    at = rng.random((500, 3), np.float32), rng.random(500, np.float32)
    np.savez(tmp_path / "in.npz", planes.theta, planes.places, planes.intervals, planes.areas, density, *at)
    script = (
        "import sys, numpy\nfrom kpc.encoder.field import kernels\n"
        "theta, places, intervals, areas, density, points, times = numpy.load(sys.argv[1]).values()\n"
        "motion = numpy.zeros((0, 1, 1, 1, 3), numpy.float32)\n"
        f"planes = kernels.PlaneSet(theta, places, intervals, {planes.channels}, areas, motion)\n"
        "logs = kernels.log_densities(planes, density, points, times, 2)\n"
        "sys.stdout.buffer.write(logs.tobytes())"
    )
    command, env = (
        [sys.executable, "-c", script, tmp_path / "in.npz"],
        os.environ | {"NUMBA_CACHE_DIR": str(tmp_path / "cache")},
    )
    compiled, cached = (subprocess.run(command, env=env, check=True, stdout=subprocess.PIPE).stdout for _ in range(2))
    assert len(list(tmp_path.glob("cache/**/points.log_densities-*.nbc"))) == 1
    assert len(compiled) == 2000 and compiled == cached


def test_rays_that_miss_the_box_show_the_background() -> None:
    scene = translucent_scene()
    rays = random_rays(scene, 13)
    away = replace(rays, origins=rays.origins + 100)
    ours = backpropagate(scene, away, away.backgrounds)
    assert not ours["counts"].any() and not ours["errors"].any() and not ours["theta"].any() and not ours["basis"].any()


@pytest.mark.parametrize("contracted", [False, True])
def test_marching_ends_on_rays_that_are_none(contracted: bool) -> None:
    """Directions of 0 and NaN leave no box, and in a step that is too small s no longer grows."""
    scene = translucent_scene(contracted=contracted)
    rays = random_rays(scene, 6)
    rays.directions[:2], rays.directions[2], rays.origins[3] = 0, math.nan, math.nan
    for occupied in (False, True):
        occupancy = np.full_like(scene.occupancy, occupied)
        for step in (scene.step, 1e-12):
            counts = count_samples(rays, scene.aabb, occupancy, step, scene.mapping)
            assert (counts <= SAMPLE_LIMIT + 2).all() and (occupied or not counts.any())


def test_the_reference_gradient_matches_finite_differences() -> None:
    generator = torch.Generator().manual_seed(3)
    field = Field(Layout.of(np.array([[3, 3, 2, 2]]), 2), 2, generator).double()
    aabb = torch.tensor([[-1.0, -1.0, -0.5], [1.0, 1.0, 0.5]], dtype=torch.float64)
    directions = torch.nn.functional.normalize(torch.randn(4, 3, generator=generator, dtype=torch.float64), dim=1)
    rays = Rays(
        -2 * directions,
        directions,
        *(torch.rand(4, generator=generator).double() for _ in range(2)),
        torch.rand(4, 3, generator=generator).double(),
    )
    theta = (0.5 + torch.rand(field.layout.size, generator=generator, dtype=torch.float64)).requires_grad_()
    density = torch.randn(3, generator=generator, dtype=torch.float64).requires_grad_()

    def colours(theta: torch.Tensor, density: torch.Tensor) -> torch.Tensor:
        def rendered(*_: object) -> torch.Tensor:
            return render_reference(field, rays, aabb, torch.ones(1, 2, 2, 2), 0.3)[0]

        return torch.func.functional_call(
            FieldFunction(field, rendered), {"field.theta": theta, "field.density": density}, ()
        )

    assert torch.autograd.gradcheck(colours, (theta, density))


@pytest.mark.parametrize("kind", FIELD_KINDS)
def test_render_equals_the_players_reference(kind: tuple[bool, bool, bool]) -> None:
    scene = translucent_scene(*kind)
    renderer = SceneRenderer(scene)
    for time in (0.0, 0.3, 0.5, 1.0):
        for camera in scene.cameras:
            origins, directions = camera.rays()
            theirs = reference.render_rays(scene, origins, directions, time)
            ours = renderer.rgb(origins, directions, np.full(len(origins), time))
            # A sample within rounding of a cell's face may count here and not there; few rays have one.
            assert np.mean(np.abs(ours - theirs.rgb).max(1) > COLOUR) < 0.002
            assert np.abs(ours - theirs.rgb).max() < 0.3


def test_render_returns_opacity_depth_and_counts() -> None:
    scene = translucent_scene()
    field, camera = Field.from_scene(scene), scene.cameras[0]
    origins, directions = camera.rays()
    n = len(origins)
    batch = Rays.from_arrays(origins, directions, np.full(n, 0.4), np.full(n, 0.5), np.tile(scene.background, (n, 1)))
    _, opacity, depth, counts = kernels.render(
        planes_of(field),
        field.density.detach().numpy(),
        volume_of(scene.aabb, scene.occupancy, scene.step, scene.mapping),
        ray_batch(batch),
        field.basis(batch.directions).detach().numpy(),
        max_samples_per_ray(scene.aabb, scene.step),
        4,
    )
    theirs = reference.render_rays(scene, origins, directions, 0.4)
    hit = theirs.opacity > 0.05
    assert 0.1 < hit.mean() < 0.9
    assert np.mean(np.abs(opacity - theirs.opacity) > COLOUR) < 0.002
    assert np.mean(np.abs(depth - theirs.depth)[hit] > 4 * COLOUR) < 0.002  # depth reaches 4 units
    assert np.mean(counts != theirs.samples) < 0.002


@pytest.mark.parametrize("moved", [False, True])
def test_log_densities(moved: bool) -> None:
    scene = with_motion(tiny_scene()) if moved else tiny_scene()
    field = Field.from_scene(scene)
    rng = np.random.default_rng(0)
    points, times = rng.random((500, 3), np.float32), rng.random(500, np.float32)
    points[:4], times[:4] = [[0, 0, 0], [1, 1, 1], [0, 1, 0], [1, 0, 1]], [0, 1, 1, 0]
    reference_field = field.double()
    features = reference_field.features(torch.from_numpy(points).double(), torch.from_numpy(times).double())
    expected = reference_field.decode(features)[0].detach().numpy()
    np.testing.assert_allclose(log_densities(Field.from_scene(scene), points, times), expected, atol=COLOUR)


@pytest.mark.parametrize("channels", [1, 3, 8, 13, 24])
@pytest.mark.parametrize("dynamic", [False, True])
def test_features_and_their_gradients_for_any_number_of_channels(channels: int, dynamic: bool) -> None:
    """The kernels take channels by vectors of eight, and the rest one by one; points beyond the box are clamped."""
    rng = np.random.default_rng(channels)
    sizes = np.array([[5, 4, 3, 4 if dynamic else 0], [9, 7, 6, 5 if dynamic else 0]])
    field = Field(Layout.of(sizes, channels), 2, torch.Generator().manual_seed(0))
    with torch.no_grad():
        field.theta += torch.from_numpy(rng.normal(0, 0.3, field.theta.numel()).astype(np.float32))
    points, times = rng.uniform(-0.1, 1.1, (64, 3)).astype(np.float32), rng.random(64).astype(np.float32)
    found = []
    for features in (fused_features(field), field.features):
        at = torch.from_numpy(points).requires_grad_(), torch.from_numpy(times)
        out = features(*at)
        (gradient,) = torch.autograd.grad((out * torch.arange(1, out.shape[1] + 1)).sum(), field.theta)
        found.append((out.detach(), gradient))
    for ours, theirs in zip(*found, strict=True):
        torch.testing.assert_close(ours, theirs, rtol=0, atol=1e-5 * float(theirs.abs().max()))


@pytest.mark.parametrize("coded", ["scene", "rays", "both"])
@pytest.mark.parametrize("view_dependent", [False, True])
def test_colour_bases_and_their_gradients_equal_those_of_pytorch(coded: str, view_dependent: bool) -> None:
    """With a mask on the features of the first of two scales, and as many channels as fill no vector.

    Without numbers of appearances, or without codes, rays have no code.
    """
    rng, generator = np.random.default_rng(0), torch.Generator().manual_seed(0)
    layout = Layout.of(np.array([[3, 3, 3, 0], [5, 5, 5, 0]]), 13)
    field = Field(layout, 5, generator, appearances=0 if coded == "rays" else 3)
    with torch.no_grad():
        for parameter in [field.w2, *([field.codes] if field.codes is not None else [])]:
            parameter += torch.from_numpy(rng.normal(0, 1, parameter.shape).astype(np.float32))
    numbers = None if coded == "scene" else torch.from_numpy(rng.integers(0, 3, 40))
    rays = replace(random_rays(tiny_scene(), 40), appearances=numbers)
    mask = torch.from_numpy(rng.integers(0, 3, 13).astype(np.float32))
    basis = ColourBasis(field, rays, mask.numpy(), view_dependent)
    g = rng.normal(0, 1, basis.values.shape).astype(np.float32)
    g_rays = np.ones((40, kernels.RAY_GRADIENTS), np.float32)
    basis.set_gradients(g, g_rays, wants_rays=True)

    twin, directions = copy.deepcopy(field).double(), rays.directions.double().requires_grad_()
    twin.zero_grad()
    theirs = twin.basis(directions, twin.appearance_codes(rays.appearances)) if view_dependent else twin.b2[None]
    theirs = theirs[..., :13] * mask
    theirs.backward(torch.from_numpy(g).double())
    np.testing.assert_allclose(basis.values, theirs.detach().numpy(), atol=1e-5)
    assert field.codes is None or (field.codes.grad is not None) == (view_dependent and coded == "both")
    for name in ("b2", "w2", "w1", "b1", "codes") if view_dependent else ("b2",):
        if (expected := getattr(twin, name)) is not None and expected.grad is not None:
            np.testing.assert_allclose(getattr(field, name).grad.numpy(), expected.grad.numpy(), atol=1e-4)
    if view_dependent and directions.grad is not None:
        np.testing.assert_allclose(g_rays[:, 3:6] - 1, directions.grad.numpy(), atol=1e-4)
    assert (g_rays[:, [0, 1, 2, 6, 7, 8, 9]] == 1).all()
    with torch.no_grad():
        field.b1[2] = math.nan
    assert np.isnan(ColourBasis(field, rays, np.ones(13, np.float32), view_dependent).values).all() == view_dependent


def test_log_densities_are_clipped() -> None:
    scene = tiny_scene()
    for bias, limit in ((1e6, 20.0), (-1e6, -20.0)):
        field = Field.from_scene(replace(scene, decoder=replace(scene.decoder, density_bias=bias)))
        assert (log_densities(field, np.full((3, 3), 0.5), np.zeros(3)) == limit).all()


WEIGHTS = {"space_variation": 0.3, "transient_variation": 0.4, "time_smoothness": 0.7, "sparse_transients": 0.2}


@pytest.mark.parametrize("alone", [None, *WEIGHTS])
@pytest.mark.parametrize("late", [False, True])
@pytest.mark.parametrize("dynamic", [True, False])
def test_prior_kernels_have_the_gradient_of_the_torch_priors(dynamic: bool, late: bool, alone: str | None) -> None:
    """All of them together, and each on its own."""
    field = Field.from_scene(tiny_scene(dynamic=dynamic))
    with torch.no_grad():
        field.theta += 0.1 * torch.randn(field.layout.size, generator=torch.Generator().manual_seed(0))
        field.theta[-50:] = 1.0  # the kink of |1 - P|, where the gradient is 0 by agreement
    config = TrainConfig(**{name: weight if alone in (None, name) else 0.0 for name, weight in WEIGHTS.items()})
    variation = replace(config, robust_space_variation=config.space_variation).variation(float(late))
    assert (variation.steep > 0) is late
    grad = np.ones(field.layout.size, np.float32)
    add_prior_gradients(field, field.theta.detach().numpy(), grad, config, variation, 4.0)
    field = field.double()
    (4 * sum(plane_priors(field, config, variation).values())).backward()
    expected = field.theta.grad.numpy()
    # `grad` held 1 before: what is added is rounded to 2^-24 of that, a few times.
    np.testing.assert_allclose(grad - 1, expected, atol=8 * 2.0**-24 + 1e-6 * np.abs(expected).max())


def test_adam_equals_pytorchs() -> None:
    n, workers = 40_000, 3
    rng = np.random.default_rng(0)
    theta = rng.normal(size=n).astype(np.float32)
    parameter = torch.nn.Parameter(torch.from_numpy(theta.copy()).double())
    optimiser = torch.optim.Adam([parameter], lr=1.0, betas=(BETA1, BETA2), eps=EPSILON)
    mean, square = np.zeros(n, np.float32), np.zeros(n, np.float32)
    for number in range(1, 6):
        rate = 0.05 / number
        grad = rng.normal(size=(workers, n)).astype(np.float32)
        grad[:, :100] = 0  # never reached: 0 / eps must not move them
        parameter.grad = torch.from_numpy(grad.sum(0, dtype=np.float64))
        optimiser.param_groups[0]["lr"] = rate
        optimiser.step()
        kernels.adam(theta, grad, mean, square, rate, BETA1, BETA2, EPSILON, number)
        assert not grad.any()
    # Five steps of at most 0.05, each rounded to 1e-5 of itself or so; where gradients cancel, a little worse.
    expected = parameter.detach().numpy()
    assert (theta[:100] == expected[:100].astype(np.float32)).all()
    np.testing.assert_allclose(theta, expected, atol=1e-5)
    np.testing.assert_allclose(square, optimiser.state[parameter]["exp_avg_sq"].numpy(), rtol=1e-4, atol=1e-9)


def test_max_samples_per_ray_exceeds_the_diagonal() -> None:
    aabb = np.array([[0, 0, 0], [1, 2, 3]], np.float32)
    assert max_samples_per_ray(aabb, 0.1) >= math.sqrt(14) / 0.1 + 1
