"""Contraction and device coordinates: formulas, inverses, extremes, and all implementations against float64."""

from dataclasses import replace

import numpy as np
import pytest
import torch

import gl
from kpc.encoder.field import render as in_pytorch
from kpc.encoder.field.kernels import geometry
from kpc.format.scene.scene import Scene
from kpc.format.scene.space import FAR, MIN_DISPARITY, Contraction, DeviceCoordinates, contract, uncontract
from kpc.player.cpu.reference import render, sample_positions
from scenes import in_device_coordinates, look_at, tiny_scene, with_contraction

AABB = np.array([[-1.0, -0.5, 2.0], [3.0, 1.5, 2.5]])
RNG = np.random.default_rng(0)


def points(count: int, most: float) -> np.ndarray:
    """Return world points at all scales, up to `most` half edges from the centre of the box."""
    directions = RNG.normal(size=(count, 3))
    y = directions / np.abs(directions).max(1, keepdims=True) * most ** RNG.uniform(-1, 1, (count, 1))
    return AABB.mean(0) + y * (AABB[1] - AABB[0]) / 2


def contract_reference(p: np.ndarray) -> np.ndarray:
    """Contract a single point by the formula."""
    y = (p - AABB.mean(0)) / ((AABB[1] - AABB[0]) / 2)
    r = np.abs(y).max()
    return (y if r <= 1 else (2 - 1 / r) * y / r) / 4 + 0.5


def test_contract_equals_the_formula() -> None:
    p = points(500, 1e6)
    u, radius = contract(p, AABB)
    np.testing.assert_allclose(u, [contract_reference(q) for q in p], atol=1e-12)
    assert (u > 0).all() and (u < 1).all() and radius.max() > 1e5 and radius.min() < 1e-5


def test_the_box_is_the_undistorted_inner_half() -> None:
    p = AABB[0] + RNG.random((100, 3)) * (AABB[1] - AABB[0])
    np.testing.assert_allclose(contract(p, AABB)[0], 0.25 + (p - AABB[0]) / (AABB[1] - AABB[0]) / 2, atol=1e-12)


def test_uncontract_inverts_contract() -> None:
    p = points(500, 1e6)
    u, radius = contract(p, AABB)
    # Near the border u is 1 - 1/(4 r), rounded to 2^-53, so r is known with a relative error of 4 r 2^-53.
    np.testing.assert_array_less(np.abs(uncontract(u, AABB) - p).max(1), 1e-14 * (1 + radius) ** 2)


def test_contraction_is_continuous_at_the_faces_of_the_box() -> None:
    p = points(200, 1.0)
    y = (p - AABB.mean(0)) / (AABB[1] - AABB[0]) * 2
    on_a_face = y / np.abs(y).max(1, keepdims=True)
    inside, outside = (AABB.mean(0) + k * on_a_face * (AABB[1] - AABB[0]) / 2 for k in (1 - 1e-9, 1 + 1e-9))
    np.testing.assert_allclose(contract(inside, AABB)[0], contract(outside, AABB)[0], atol=2e-9)


@pytest.mark.parametrize("uniform", [1e-3, 1.0, 1e6])
def test_parameter_and_distance_invert_each_other(uniform: float) -> None:
    mapping = Contraction(uniform)
    t = uniform * np.logspace(-6, np.log10(FAR), 1000)
    s = mapping.parameter(t)
    np.testing.assert_allclose(s, [d if d <= uniform else uniform * (2 - uniform / d) for d in t], rtol=1e-12)
    np.testing.assert_allclose(mapping.distance(s), t, rtol=1e-12)
    assert (np.diff(s) > 0).all() and s[-1] == pytest.approx(mapping.s_end)
    single = mapping.distance(s.astype(np.float32))
    # s / t_u is known to 2^-23, and 2 - s / t_u is as small as 1 / FAR.
    np.testing.assert_allclose(single, t, rtol=2 * FAR * 2.0**-23)
    assert single.dtype == np.float32
    assert mapping.parameter(np.array([1e6 * uniform, np.inf])) == pytest.approx([(2 - 1e-6) * uniform, 2 * uniform])
    assert mapping.distance(np.array([3 * uniform])) == pytest.approx(FAR * uniform)


@pytest.mark.parametrize("uniform", [0.7, 40.0])
def test_all_implementations_place_samples_alike(uniform: float) -> None:
    """numpy, PyTorch and numba in float32 against float64; GLSL is compared by pictures in test_renderer."""
    scene = replace(with_contraction(tiny_scene(0)), mapping=Contraction(uniform))
    origins, directions = (a[::60] for a in scene.cameras[0].rays())
    s = np.linspace(0, scene.mapping.s_end, 50, dtype=np.float32)[None].repeat(len(origins), 0)
    exact = sample_positions(scene, *(a.astype(np.float64) for a in (origins, directions, s)))
    assert exact[0].max() == pytest.approx(FAR * uniform) and exact[0].min() == 0
    for name, got in {
        "numpy": sample_positions(scene, origins, directions, s),
        "torch": _torch(scene, origins, directions, s),
        "kernels": _kernels(scene, origins, directions, s),
    }.items():
        for found, expected, tolerance in zip(got, exact, (2 * FAR * 2.0**-23, 0, 1e-3), strict=True):
            np.testing.assert_allclose(found, expected, rtol=tolerance, atol=2e-5 if not tolerance else 0, err_msg=name)


def _torch(scene: Scene, origins: np.ndarray, directions: np.ndarray, s: np.ndarray) -> tuple[np.ndarray, ...]:
    o, d, *rest = map(torch.from_numpy, (origins, directions, s, scene.aabb))
    nothing = torch.zeros(len(o))
    u, stretch = in_pytorch.plane_coordinates(in_pytorch.Rays(o, d, nothing, nothing, nothing), *rest, scene.mapping)
    return scene.mapping.distance(s), u.numpy(), stretch.numpy()


def _kernels(scene: Scene, origins: np.ndarray, directions: np.ndarray, s: np.ndarray) -> tuple[np.ndarray, ...]:
    uniform, inverse = np.float32(scene.mapping.uniform_distance), 1 / (scene.aabb[1] - scene.aabb[0])
    t, u, stretch = np.empty_like(s), np.empty((*s.shape, 3), np.float32), np.empty_like(s)
    for ray, k in np.ndindex(s.shape):
        t[ray, k] = geometry.ray_distance(s[ray, k], uniform)
        *u[ray, k], radius = geometry.ray_point(origins[ray], directions[ray], t[ray, k], scene.aabb, inverse, uniform)
        stretch[ray, k] = geometry.density_scale(t[ray, k], radius, uniform)
    return t, u, stretch


def test_the_density_scale_integrates_to_the_contracted_length() -> None:
    """Density is per unit of radial length in the cube: the sum over steps is the length of the contracted ray."""
    aabb = np.array([[-1, -1, -1], [1, 1, 1]], np.float64)
    scene = replace(with_contraction(tiny_scene(0)), aabb=aabb, mapping=Contraction(2.0))
    step = 1e-4
    s = (np.arange(int(scene.mapping.s_end / step))[None] + 0.5) * step
    _, _, stretch = sample_positions(scene, np.zeros((1, 3)), np.array([[1.0, 0, 0]]), s)
    # From the centre to 1, then 2 - 1/t up to t = FAR t_u.
    assert (stretch * step).sum() == pytest.approx(2 - 1 / (2 * FAR), rel=1e-4)


def test_bounds_on_the_contracted_speed_hold() -> None:
    """Skipping of empty cells (occupancy.glsl) needs |d contract / dt| <= 4/3 v, and <= (v + 2 w) / r^2 outside the
    box."""
    n, m = 200, 4000
    aabb = np.array([[-1, -1, -1], [1, 1, 1]], np.float64)
    rng = np.random.default_rng(0)  # of its own: not all draws have a ray that comes close to the bound
    start = rng.normal(size=(n, 3)) * 10 ** rng.uniform(-1, 1.5, (n, 1))
    rate = rng.normal(size=(n, 3)) * 10 ** rng.uniform(-1, 1, (n, 1))
    rate[:3], start[3] = np.eye(3), 0
    t = np.concatenate([np.linspace(0, 20, m // 2), np.logspace(1.4, 4, m // 2)])
    u, radius = contract(start[:, None] + t[:, None] * rate[:, None], aabb)
    rates = np.abs(np.diff(4 * u, axis=1)).max(-1) / np.diff(t)
    speed = np.abs(rate).max(1)[:, None]
    turn = np.abs(np.cross(start, rate)).max(1)[:, None]
    least = np.minimum(radius[:, 1:], radius[:, :-1])
    assert (rates <= 4 / 3 * speed * (1 + 1e-9)).all() and (rates > 1.2 * speed).any()
    # The radius is convex along a ray, so away from its minimum it is smallest at an end of the interval.
    turning = np.abs(np.arange(m - 1) + 0.5 - radius.argmin(1)[:, None]) < 1
    outside = (least > 1) & ~turning
    bound = (speed + 2 * turn) / np.maximum(least, 1) ** 2
    assert (rates <= bound * (1 + 1e-9))[outside].all() and (rates > 0.5 * bound)[outside].any()


def test_glsl_skips_empty_space_without_missing_samples() -> None:
    """Few cells are occupied; all samples in them must be found, from viewpoints inside, outside and far away."""
    from kpc.player.gl.renderer import Renderer

    scene = with_contraction(tiny_scene(3))
    occupancy = RNG.random((1, 40, 50, 60)) < 0.002
    scene = replace(scene, occupancy=occupancy, step=0.01)
    renderer = Renderer(gl.context(), scene)
    for eye in ((2.4, 1.0, 2.2), (0.1, 0.2, 0.3), (-9.0, 2.0, 4.0), (60.0, 20.0, -80.0)):
        camera = look_at(eye, (0.1, 0.05, 0.05), 48, 36, 30.0)
        got, wanted = renderer.render(camera, 0.3), render(scene, camera, 0.3)
        assert wanted.samples.max() > 3
        assert np.mean(got.samples == wanted.samples) > 0.99  # samples on faces of cells may round to either side
        assert abs(int(got.samples.sum()) - int(wanted.samples.sum())) < 2e-3 * wanted.samples.sum() + 2


def device_coordinates(near: float = 0.5, baseline: float = 1.5) -> DeviceCoordinates:
    return DeviceCoordinates(look_at((0.5, -1.0, 2.0), (0.0, 0.2, -1.0), 1, 1, 1.0).camera_to_world[:3], near, baseline)


def points_before(ndc: DeviceCoordinates, count: int) -> np.ndarray:
    """Return world points at depths from `near` to 1e4 times that."""
    depth = ndc.near * 10 ** RNG.uniform(0, 4, count)
    local = np.stack([*(depth * RNG.uniform(-1, 1, (2, count))), -depth], axis=1)
    return local @ ndc.frame[:, :3].T + ndc.frame[:, 3]


def test_device_coordinates_are_image_position_and_parallax() -> None:
    ndc = device_coordinates()
    points = points_before(ndc, 300)
    right, up, back, eye = ndc.frame.T
    for point, found in zip(points, ndc.to_device(points), strict=True):
        depth = -(point - eye) @ back
        assert found[:2] == pytest.approx([(point - eye) @ right / depth, (point - eye) @ up / depth])
        # A pinhole camera one baseline to the right sees the point shifted by baseline / depth.
        shifted = (point - eye - ndc.baseline * right) @ right / depth
        assert found[2] == pytest.approx(ndc.baseline / ndc.near - (found[0] - shifted), abs=1e-9)
    np.testing.assert_allclose(ndc.to_world(ndc.to_device(points)), points, rtol=1e-9, atol=1e-9)


def test_rays_stay_straight_and_keep_their_distances() -> None:
    ndc = device_coordinates()
    eyes = ndc.frame[:, 3] + RNG.uniform(-0.7, 0.7, (200, 3))  # before, on and behind the near plane
    directions = points_before(ndc, 200) - eyes
    directions /= np.linalg.norm(directions, axis=1, keepdims=True)
    directions = directions[(forward := -(directions @ ndc.frame[:, 2]) > 0.05)]
    eyes = eyes[forward]
    path = ndc.rays(eyes, directions)
    np.testing.assert_allclose(np.linalg.norm(path.directions, axis=1), 1)
    s = path.s_infinity[:, None] * np.array([0.0, 0.1, 0.5, 0.9, 0.999])
    t = path.distance(s)
    world = eyes[:, None] + t[..., None] * directions[:, None]
    np.testing.assert_allclose(
        ndc.to_device(world), path.origins[:, None] + s[..., None] * path.directions[:, None], atol=1e-9
    )
    depths = (ndc.frame[:, 3] - world) @ ndc.frame[:, 2]
    own = (ndc.frame[:, 3] - eyes) @ ndc.frame[:, 2]
    np.testing.assert_allclose(depths[:, 0], np.maximum(own, ndc.near))
    assert (own > ndc.near).any() and (own < 0).any()
    assert (path.distance(path.s_infinity[:, None] * 2) < np.inf).all()  # capped
    assert np.allclose(
        path.distance(path.s_infinity[:, None]), path.t_start[:, None] + path.t_scale[:, None] * (1 / MIN_DISPARITY - 1)
    )


def test_rays_in_single_precision() -> None:
    ndc = device_coordinates()
    eyes = ndc.frame[:, 3] + RNG.uniform(-0.4, 0.4, (500, 3))
    directions = points_before(ndc, 500) - eyes
    directions /= np.linalg.norm(directions, axis=1, keepdims=True)
    exact, single = ndc.rays(eyes, directions), ndc.rays(eyes.astype(np.float32), directions.astype(np.float32))
    far = -(directions @ ndc.frame[:, 2]) > 0.1
    np.testing.assert_allclose(single.origins[far], exact.origins[far], atol=2e-5)
    np.testing.assert_allclose(single.directions[far], exact.directions[far], atol=2e-4)
    assert single.origins.dtype == single.directions.dtype == np.float32


@pytest.mark.parametrize("dtype", [np.float32, np.float64])
def test_rays_that_do_not_go_forward_show_the_background(dtype: type) -> None:
    scene = in_device_coordinates(tiny_scene(0))
    assert isinstance(scene.mapping, DeviceCoordinates)
    right, _, back, eye = scene.mapping.frame.T
    directions = np.array([back, right, right - 1e-5 * back]).astype(dtype)
    path = scene.mapping.rays(np.tile(eye, (3, 1)).astype(dtype), directions)
    assert (
        np.isfinite(path.origins).all()
        and np.isfinite(path.directions).all()
        and np.isfinite(path.distance(np.ones((3, 1), dtype))).all()
    )
    behind = look_at(tuple(eye), tuple(eye + back), 8, 6, 5.0)
    picture = render(scene, behind, 0.5)
    assert not picture.opacity.any() and not picture.samples.any() and np.isinf(picture.depth).all()


def test_depth_is_in_world_units() -> None:
    scene = in_device_coordinates(tiny_scene(4))
    camera = scene.cameras[0]
    picture = render(scene, camera, 0.5)
    origins, directions = camera.rays()
    solid = (picture.opacity > 0.99).ravel()
    ends = (origins + picture.depth.ravel()[:, None] * directions)[solid]
    mapped_ends = scene.mapping.to_device(ends.astype(np.float64))
    assert solid.sum() > 20
    assert (mapped_ends >= scene.aabb[0] - 0.1).all() and (mapped_ends <= scene.aabb[1] + 0.1).all()


def test_bounds_contain_the_box() -> None:
    scene = in_device_coordinates(tiny_scene(4))
    inside = scene.aabb[0] + RNG.random((500, 3)) * (scene.aabb[1] - scene.aabb[0])
    world, bounds = scene.mapping.to_world(inside), scene.bounds
    assert (world >= bounds[0]).all() and (world <= bounds[1]).all()
    assert np.array_equal(tiny_scene(4).bounds, tiny_scene(4).aabb)
