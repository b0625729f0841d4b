"""Functions of the shaders, each against its twin in numpy, in float64, on 65,536 random inputs."""

import numpy as np
import pytest

import gl
from kpc.format.scene.motion import displace
from kpc.format.scene.scene import LOG_DENSITY_LIMIT
from kpc.format.scene.space import Contraction, contract
from kpc.player.cpu.reference import sigmoid
from kpc.player.gl.programs import is_software
from scenes import look_at

N = 1 << 16
RNG = np.random.default_rng(0)
EVEN = 5.0
CAMERA = look_at((0.4, -1.0, 3.0), (0.1, 0.05, 0.05), 64, 48, 70.0)


def columns(*values: np.ndarray | float) -> np.ndarray:
    """(N, 4) of up to four columns."""
    return np.stack([np.broadcast_to(value, N) for value in (*values, 0.0, 0.0, 0.0)[:4]], axis=1).astype(np.float32)


def lens() -> str:
    c, rows = CAMERA, CAMERA.camera_to_world[:3, :3].T.ravel()
    return (f"const vec4 lens = vec4({c.fl_x:.9e}, {c.fl_y:.9e}, {c.cx:.9e}, {c.cy:.9e});\n"
            f"const mat3 axes = mat3({', '.join(f'{x:.9e}' for x in rows)});\n"
            f"const vec3 eye = vec3({', '.join(f'{x:.9e}' for x in CAMERA.camera_to_world[:3, 3])});\n")  # fmt: skip


def test_rays_go_through_their_pixels() -> None:
    i, j = RNG.uniform(0, 64, N), RNG.uniform(0, 48, N)
    local = np.stack([(i - CAMERA.cx) / CAMERA.fl_x, -(j - CAMERA.cy) / CAMERA.fl_y, -np.ones(N)], axis=1)
    directions = local / np.linalg.norm(local, axis=1, keepdims=True) @ CAMERA.camera_to_world[:3, :3].T
    glsl = '#include "ray.glsl"\n' + lens()
    got = gl.evaluate(glsl, "vec4(camera_direction(a.xy, 48.0, lens, axes), 0.0)", columns(i, 48 - j))[:, :3]
    np.testing.assert_allclose(got, directions, atol=1e-6)


def test_distances_in_contracted_space() -> None:
    mapping = Contraction(EVEN)
    s = RNG.uniform(0, float(mapping.s_end), N)
    glsl = '#include "ray.glsl"\n#include "space.glsl"\n'
    t = gl.evaluate(glsl, "vec4(distance_of(a.x, 5.0))", columns(s), CONTRACTED=1)[:, 0]
    # Near the end t is even / (2 - s / even), which multiplies an error of s by (t / even)^2.
    np.testing.assert_allclose(t, mapping.distance(s), rtol=1e-4)
    back = gl.evaluate(glsl, "vec4(parameter_of(a.x, 5.0))", columns(t), CONTRACTED=1)[:, 0]
    np.testing.assert_allclose(back, mapping.parameter(t.astype(np.float64)), rtol=1e-6)
    y = RNG.normal(size=(N, 3)) * 10 ** RNG.uniform(-1, 3, (N, 1))
    u = gl.evaluate(glsl, "vec4(contracted(a.xyz), 0.0)", columns(*y.T), CONTRACTED=1)[:, :3]
    wanted, radius = contract(y, np.array([[-1.0, -1, -1], [1, 1, 1]]))
    np.testing.assert_allclose(u, 4 * wanted - 2, atol=1e-6)
    stretch = gl.evaluate(glsl, "vec4(density_scale(a.xyz, b.x, 5.0))", columns(*y.T), columns(t), CONTRACTED=1)[:, 0]
    np.testing.assert_allclose(stretch, mapping.density_scale(t.astype(np.float64), radius), rtol=1e-5)


@pytest.mark.parametrize("tau", [1e-6, 1e-2, 1.0])
def test_densities_from_1e_minus_10_to_1e10(tau: float) -> None:
    log_density = RNG.uniform(-1.2 * LOG_DENSITY_LIMIT, 1.2 * LOG_DENSITY_LIMIT, N)
    assert np.exp(log_density).min() < 1e-10 and np.exp(log_density).max() > 1e10
    alpha = gl.evaluate('#include "decoder.glsl"', "vec4(alpha_of(a.x, a.y))", columns(log_density, tau))[:, 0]
    wanted = -np.expm1(-np.exp(np.clip(log_density, -LOG_DENSITY_LIMIT, LOG_DENSITY_LIMIT)) * np.float32(tau))
    # exp(x) errs by x 2^-23 of itself, which at most e^-1 of alpha follows; 1 - exp by 2^-24.
    np.testing.assert_allclose(alpha, wanted, atol=4e-6)
    assert alpha.min() >= 0 and alpha.max() <= 1


def test_the_sigmoid_is_that_of_the_reference() -> None:
    x = RNG.normal(size=(N, 3)) * 10 ** RNG.uniform(-3, 3, (N, 1))
    got = gl.evaluate('#include "decoder.glsl"', "vec4(sigmoid(a.xyz), 0.0)", columns(*x.T))[:, :3]
    np.testing.assert_allclose(got, sigmoid(x.astype(np.float32).astype(np.float64)), atol=2e-6)


def test_positions_are_in_the_same_cells_as_in_the_reference() -> None:
    """Cells of places, on the faces between them only may they differ; what they hold."""
    count = np.array([12, 10, 8])
    u = RNG.uniform(-0.1, 1.1, (N, 3))
    glsl = '#include "ray.glsl"\n#include "space.glsl"\n#include "occupancy.glsl"\n' + (
        "const vec3 many = vec3(12.0, 10.0, 8.0);\n"
        "Walk walk = Walk(vec3(0.0), vec3(1.0), vec3(1.0), many, 1.0 / many, 0.0, 1.0, 0.1, 1.0, 0.0);\n"
    )
    cells = gl.evaluate(glsl, "vec4(cell_of(walk, a.xyz), 0.0)", columns(*u.T))[:, :3]
    wanted = np.clip(np.floor(u * count), 0, count - 1)
    assert (np.abs(u * count - np.rint(u * count))[cells != wanted] < 1e-5).all() and np.mean(cells != wanted) < 1e-4


def cubic(picture: np.ndarray, x: np.ndarray, y: np.ndarray) -> np.ndarray:
    """Catmull and Rom's, from the left and from below, without the corners of the sixteen; float64."""
    height, width = picture.shape[:2]
    taps = []
    for at, size in ((x * width - 0.5, width), (y * height - 0.5, height)):
        first, f = np.floor(at).astype(int), at - np.floor(at)
        away = np.abs(f[:, None] - np.arange(-1, 3))
        weights = np.where(away < 1, 1.5 * away**3 - 2.5 * away**2 + 1, -0.5 * away**3 + 2.5 * away**2 - 4 * away + 2)
        taps.append((np.clip(first[:, None] + np.arange(-1, 3), 0, size - 1), weights))
    (i, across), (j, up) = taps
    weights = up[:, :, None] * across[:, None, :]
    weights[:, [0, 0, 3, 3], [0, 3, 0, 3]] = 0
    return np.einsum(
        "nji,njic->nc",
        weights / weights.sum((1, 2), keepdims=True),
        picture[j[:, :, None], i[:, None, :]].astype(np.float64),
    )


def test_colours_between_pixels_follow_the_cubic() -> None:
    x, y, picture = (
        RNG.uniform(-0.01, 1.01, N).astype(np.float32),
        RNG.random(N, np.float32),
        RNG.random((N, 4), np.float32),
    )
    x[:2], y[:2] = (0.5 / 256, 1.0), (0.5 / 256, 0.0)
    got = gl.evaluate('#include "cubic.glsl"\n', "vec4(cubic(from_b, a.xy), 0.0)", columns(x, y), picture)
    wanted = cubic(picture.reshape(256, 256, 4)[..., :3], x.astype(np.float64), y.astype(np.float64))
    # A place in float32 errs by up to 2^-17 of a pixel, and colours turn by less than three times as much.
    np.testing.assert_allclose(got[:, :3], wanted, atol=1e-4)
    np.testing.assert_allclose(got[0, :3], picture[0, :3], atol=1e-6)


@pytest.mark.parametrize("nodes", [(4, 3, 5), (2, 2, 2)])
def test_positions_are_displaced(nodes: tuple[int, int, int]) -> None:
    rng = np.random.default_rng(9)
    u, offsets = rng.random((N, 3), np.float32), rng.uniform(-0.3, 0.3, (*nodes, 3)).astype(np.float32)
    grid = np.concatenate([offsets, np.zeros((*nodes, 1))], axis=-1)
    counts = "vec3({}.0, {}.0, {}.0)".format(*nodes[::-1])
    got = gl.evaluate(
        '#include "motion.glsl"\n', f"vec4(displaced(grid, {counts}, a.xyz), 0.0)", columns(*u.T), grid=grid
    )[:, :3]
    # A graphics card filters with fractions of 8 bits: 0.0040 on an NVIDIA H100, with offsets of up to 0.3.
    np.testing.assert_allclose(got, displace(u, offsets), atol=2e-6 if is_software(gl.context()) else 0.006)
