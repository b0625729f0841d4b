"""The reference renderer against the normative text, done ray by ray and sample by sample in float64."""

import math
from dataclasses import replace

import numpy as np
import pytest

from kpc.format.common.errors import UsageError
from kpc.format.scene.cameras import Camera
from kpc.format.scene.scene import ALL_PLANES, SPACE_PLANES, TERMINATION, Scene
from kpc.player.cpu import reference
from kpc.player.cpu.reference import Part, render, render_rays
from scenes import look_at, tiny_scene, with_appearances


def plain_bilinear(plane: np.ndarray, u: float, v: float) -> np.ndarray:
    rows, columns, _ = plane.shape
    x, y = u * (columns - 1), v * (rows - 1)
    i, j = min(int(x), max(columns - 2, 0)), min(int(y), max(rows - 2, 0))
    f, g = x - i, y - j
    i1, j1 = min(i + 1, columns - 1), min(j + 1, rows - 1)
    p = plane.astype(np.float64)
    return (1 - g) * ((1 - f) * p[j, i] + f * p[j, i1]) + g * ((1 - f) * p[j1, i] + f * p[j1, i1])


def plain_ray(
    scene: Scene, o: np.ndarray, d: np.ndarray, time: float, static: bool
) -> tuple[np.ndarray, float, float, int]:
    o, d, aabb = o.astype(float), d.astype(float), scene.aabb.astype(float)
    near, far = 0.0, math.inf
    for a in range(3):
        if d[a] == 0.0:
            if not aabb[0, a] <= o[a] <= aabb[1, a]:
                far = -math.inf
            continue
        t0, t1 = sorted([(aabb[0, a] - o[a]) / d[a], (aabb[1, a] - o[a]) / d[a]])
        near, far = max(near, t0), min(far, t1)

    x, y, z = d
    code = np.array([x, y, z, x * x, y * y, z * z, x * y, y * z, z * x])
    basis = scene.decoder.w2 @ np.maximum(scene.decoder.w1 @ code + scene.decoder.b1, 0) + scene.decoder.b2
    slots, nz, ny, nx = scene.occupancy.shape
    slot = min(int(time * slots), slots - 1)
    rgb, trans, depth, count, k = np.zeros(3), 1.0, 0.0, 0, 0
    while trans >= TERMINATION:
        t = near + (k + 0.5) * scene.step
        k += 1
        if t >= far:
            break
        u = (o + t * d - aabb[0]) / (aabb[1] - aabb[0])
        cell = [min(max(int(u[a] * n), 0), n - 1) for a, n in enumerate((nx, ny, nz))]
        if not scene.occupancy[slot, cell[2], cell[1], cell[0]]:
            continue
        at = {"x": u[0], "y": u[1], "z": u[2], "t": time}
        names = SPACE_PLANES if static or not scene.is_dynamic else ALL_PLANES
        f = np.concatenate(
            [
                np.prod([plain_bilinear(scale[name], at[name[0]], at[name[1]]) for name in names], axis=0)
                for scale in scene.scales
            ]
        )
        sigma = math.exp(min(max(f @ scene.decoder.density_weight + scene.decoder.density_bias, -20), 20))
        weight = trans * (1 - math.exp(-sigma * scene.step / scene.extent))
        rgb += weight / (1 + np.exp(-basis @ f))
        depth += weight * t
        trans -= weight
        count += 1
    return rgb + trans * scene.background, depth / (1 - trans) if trans < 1 else math.inf, 1 - trans, count


@pytest.mark.parametrize(
    ("dynamic", "part", "time"),
    [
        (True, Part.FULL, 0.37),
        (True, Part.FULL, 1.0),
        (True, Part.STATIC, 0.37),
        (False, Part.FULL, 0.0),
    ],
)
def test_renders_as_the_normative_text_says(dynamic: bool, part: Part, time: float) -> None:
    scene = tiny_scene(3, dynamic=dynamic)
    origins, directions = scene.cameras[0].rays()
    chosen = np.random.default_rng(0).choice(len(origins), 120, replace=False)
    got = render_rays(scene, origins[chosen], directions[chosen], time, part=part)
    assert got.opacity.max() > 0.9 and got.opacity.min() == 0.0
    for n, ray in enumerate(chosen):
        rgb, depth, opacity, count = plain_ray(scene, origins[ray], directions[ray], time, part is Part.STATIC)
        if got.samples[n] != count:
            continue  # a sample on a cell's face may round to either side
        # float32 positions: 1e-6 of the box, times the field's steepness
        assert got.rgb[n] == pytest.approx(rgb, abs=2e-4)
        assert got.opacity[n] == pytest.approx(opacity, abs=2e-4)
        if opacity > 0.05:
            assert got.depth[n] == pytest.approx(depth, abs=2e-3)
    counts = [plain_ray(scene, origins[r], directions[r], time, part is Part.STATIC)[3] for r in chosen]
    assert np.mean(np.array(counts) == got.samples) > 0.97


def test_rays_along_the_axes_and_from_inside() -> None:
    scene = tiny_scene(1)
    centre = scene.aabb.mean(axis=0)
    origins = np.array([centre, centre, [-5, centre[1], centre[2]], [-5, 5, centre[2]], scene.aabb[0] - 1], np.float32)
    directions = np.array([[1, 0, 0], [0, 0, -1], [1, 0, 0], [1, 0, 0], [0, -1, 0]], np.float32)
    got = render_rays(scene, origins, directions, 0.5)
    for n in range(5):
        rgb, _, _, count = plain_ray(scene, origins[n], directions[n], 0.5, False)
        assert got.rgb[n] == pytest.approx(rgb, abs=2e-4) and got.samples[n] == count
    assert np.all(got.samples[:3] > 0) and np.all(got.samples[3:] == 0)
    assert np.all(np.isinf(got.depth[3:])) and np.allclose(got.rgb[3:], scene.background)


def test_the_size_of_blocks_of_rays_does_not_change_the_picture(monkeypatch: pytest.MonkeyPatch) -> None:
    scene = tiny_scene(2)
    whole = render(scene, scene.cameras[1], 0.25)
    monkeypatch.setattr(reference, "RAYS_AT_ONCE", 77)
    monkeypatch.setattr(reference, "STEPS_AT_ONCE", 5)
    pieces = render(scene, scene.cameras[1], 0.25)
    assert np.abs(whole.rgb - pieces.rgb).max() < 1e-5
    assert np.array_equal(whole.samples, pieces.samples)


def test_the_dynamic_part_is_the_difference() -> None:
    scene = tiny_scene(2)
    full, static, dynamic = (render(scene, scene.cameras[0], 0.4, part=part).rgb for part in Part)
    assert np.array_equal(dynamic, np.abs(full - static)) and dynamic.max() > 0.02
    frozen = tiny_scene(2, dynamic=False)
    assert render(frozen, frozen.cameras[0], 0.0, part=Part.DYNAMIC).rgb.max() == 0.0


def test_a_scene_of_one_texel_and_one_cell() -> None:
    scene = tiny_scene(0, dynamic=True, scales=1, channels=3, resolution=(2, 2, 2), time=1)
    eye = look_at((3.0, 0.0, 0.0), (0.0, 0.0, 0.0), 5, 4, 6.0)
    picture = render(scene, eye, 1.0)
    assert picture.rgb.shape == (4, 5, 3) and np.all(np.isfinite(picture.rgb))


def test_bilinear_and_linear_meet_texels_at_corners() -> None:
    plane = np.random.default_rng(0).random((4, 6, 3), np.float32)
    u, v = np.meshgrid(np.linspace(0, 1, 6, dtype=np.float32), np.linspace(0, 1, 4, dtype=np.float32))
    assert reference.bilinear(plane, u.ravel(), v.ravel()) == pytest.approx(plane.reshape(-1, 3), abs=1e-6)
    assert reference.sample_linear(plane[0], np.float32(0.5)) == pytest.approx((plane[0, 2] + plane[0, 3]) / 2)


def test_weights_and_remaining_transmittance_sum_to_the_transmittance() -> None:
    alphas = np.array([[0.5, 0.0, 0.999, 0.5, 0.5], [0.1, 0.2, 0.0, 0.0, 0.3]], np.float32)
    weights, trans, reached = reference.composite(alphas, np.array([1.0, 0.5], np.float32))
    assert weights.sum(axis=1) + trans == pytest.approx([1.0, 0.5], abs=1e-6)
    assert reached[0].tolist() == [True, True, True, False, False] and weights[0, 3:].tolist() == [0, 0]
    assert reached[1].all()


@pytest.mark.parametrize("time", [-0.1, 1.1, math.nan])
def test_times_outside_the_clip_are_refused(time: float) -> None:
    scene = tiny_scene(0)
    with pytest.raises(ValueError, match="outside"):
        render(scene, Camera(2, 2, 1, 1, 1, 1, np.eye(4)), time)


@pytest.mark.parametrize("part", Part)
def test_an_appearance_is_a_change_of_the_hidden_bias_and_of_colour_alone(part: Part) -> None:
    scene = with_appearances(tiny_scene(4))
    camera, code = scene.cameras[0].resized(24, 18), scene.appearance("noon.jpg")
    average, shown = (render(scene, camera, 0.3, part=part, appearance=a) for a in (None, code))
    biased = replace(scene, decoder=replace(scene.decoder, b1=scene.decoder.b1 + code))
    np.testing.assert_allclose(shown.rgb, render(biased, camera, 0.3, part=part).rgb, atol=1e-5)
    assert np.abs(shown.rgb - average.rgb).max() > 0.05
    for name in ("depth", "opacity", "samples"):
        np.testing.assert_array_equal(getattr(shown, name), getattr(average, name))
    zero = render(scene, camera, 0.3, part=part, appearance=np.zeros_like(code))
    np.testing.assert_array_equal(zero.rgb, average.rgb)


def test_codes_that_do_not_fit_the_decoder_are_refused() -> None:
    scene = with_appearances(tiny_scene(4))
    with pytest.raises(ValueError, match="shape"):
        render(scene, scene.cameras[0], 0.3, appearance=np.zeros(15, np.float32))
    with pytest.raises(ValueError, match="0 appearances"):
        render(tiny_scene(4), scene.cameras[0], 0.3, appearance=np.zeros(16, np.float32))


def test_appearances_by_name_and_between_two() -> None:
    scene = with_appearances(tiny_scene(4))
    dawn, noon, _ = (appearance.code for appearance in scene.appearances)
    assert scene.appearance("noon.jpg") is noon
    np.testing.assert_array_equal(scene.interpolate_appearance("dawn.jpg", "noon.jpg", 0), dawn)
    np.testing.assert_array_equal(scene.interpolate_appearance("dawn.jpg", "noon.jpg", 1), noon)
    np.testing.assert_allclose(
        scene.interpolate_appearance("dawn.jpg", "noon.jpg", 0.25), 0.75 * dawn + 0.25 * noon, atol=1e-6
    )
    with pytest.raises(UsageError, match=r"'night.jpg'.*dawn.jpg, noon.jpg, dusk.jpg$"):
        scene.appearance("night.jpg")
    with pytest.raises(UsageError, match=r"no appearances.*without one"):
        tiny_scene(4).appearance("noon.jpg")
    with pytest.raises(UsageError, match=r"7.jpg \(1 more; kpinfo --json lists all\)$"):
        with_appearances(tiny_scene(4), tuple(f"{k}.jpg" for k in range(9))).appearance("noon.jpg")
