"""The settings of a picture, and the ladder of them."""

from dataclasses import replace

import gl
import numpy as np
import pytest
from scenes import SPACES, look_at, tiny_scene

from kpc.format.cameras import Camera
from kpc.format.scene import TERMINATION, Scene
from kpc.player import renderer as module
from kpc.player.quality import DEFAULT, LADDER, Quality, climbed
from kpc.player.reference import Part, box_range, render
from kpc.player.renderer import COMPUTE_VERSION, TRIAL_AFTER, Renderer

CAMERA = look_at((2.4, 1.0, 2.2), (0.1, 0.05, 0.05), 64, 48, 70.0)


def psnr(a: np.ndarray, b: np.ndarray) -> float:
    return float(-10 * np.log10(max(np.mean((a - b) ** 2), 1e-12)))


def test_the_ladder_ends_at_what_the_format_says() -> None:
    names = list(LADDER)
    assert LADDER[names[-1]] == Quality() and DEFAULT in names
    assert [climbed(names[0], n) for n in range(-1, len(names) + 1)] == [names[0], *names, names[-1]]


@pytest.mark.parametrize("fault", [{"step": 0.5}, {"step": np.nan}, {"termination": 0.0}, {"termination": 1.0}, {"resolution": 0.0},
                                   {"resolution": 1.5}, {"scales": 0}])  # fmt: skip
def test_settings_that_draw_nothing_are_refused(fault: dict[str, float]) -> None:
    with pytest.raises(ValueError, match=next(iter(fault))):
        Quality(**fault)  # type: ignore[arg-type]


@pytest.mark.parametrize("space", SPACES)
def test_every_rung_draws_the_scene_and_the_last_exactly(space: str) -> None:
    scene = SPACES[space](tiny_scene(4))
    renderer, wanted = Renderer(gl.context(), scene), render(scene, CAMERA, 0.62)
    for name, quality in LADDER.items():
        renderer.quality = quality
        got = renderer.render(CAMERA, 0.62)
        assert got.rgb.shape == wanted.rgb.shape
        assert psnr(got.rgb, wanted.rgb) > (60 if name == "reference" else 20), name


@pytest.mark.parametrize("space", SPACES)
def test_compute_shaders_draw_the_same(space: str) -> None:
    ctx, scene = gl.context(), SPACES[space](tiny_scene(4))
    if ctx.version_code < COMPUTE_VERSION:
        pytest.skip("this OpenGL has no compute shaders")
    camera = CAMERA.resized(61, 43)  # no whole number of work groups
    renderer, pictures = Renderer(ctx, scene), {}
    for renderer.compute in (False, True):
        for name in ("reference", "balanced", "fine"):
            renderer.quality = LADDER[name]
            pictures[name, renderer.compute] = renderer.render(camera, 0.3)
    renderer.check()
    for name in ("reference", "balanced", "fine"):
        one, other = pictures[name, False], pictures[name, True]
        assert np.mean(np.abs(one.rgb - other.rgb).max(axis=2) < 1 / 255) > 0.999 and psnr(one.rgb, other.rgb) > 55, name
        assert np.mean(one.samples == other.samples) > 0.99


def test_a_card_tries_both_kinds_of_shaders_once_and_keeps_to_the_faster(monkeypatch: pytest.MonkeyPatch) -> None:
    ctx = gl.context()
    if ctx.version_code < COMPUTE_VERSION:
        pytest.skip("this OpenGL has no compute shaders")
    monkeypatch.setattr(module, "is_software", lambda ctx: False)
    asked = []
    monkeypatch.setattr(Renderer, "is_compute_faster", lambda self, camera, time: asked.append(time) or True)
    renderer = Renderer(ctx, tiny_scene(4))
    for n in range(TRIAL_AFTER + 3):
        assert renderer.compute == (n >= TRIAL_AFTER)
        renderer.march(CAMERA, n / 100)
    assert asked == [(TRIAL_AFTER - 1) / 100]
    monkeypatch.undo()
    assert renderer.is_compute_faster(CAMERA, 0.5) in (True, False) and renderer.compute
    assert not Renderer(ctx, tiny_scene(4)).compute


# --- interlaced


INTERLACED = Quality(interlaced=True)


def played(renderer: Renderer, cameras: list[Camera], times: np.ndarray) -> np.ndarray:
    """The last of the pictures."""
    for camera, time in zip(cameras, times, strict=True):
        picture = renderer.render(camera, float(time)).rgb
    return picture


@pytest.mark.parametrize(
    ("space", "size"), [*((space, (64, 48)) for space in SPACES), *(("box", size) for size in ((33, 17), (1, 1), (4096, 1), (1, 64)))]
)
def test_while_a_clip_plays_half_the_pixels_are_new_and_the_rest_follow(space: str, size: tuple[int, int]) -> None:
    scene, camera, times = SPACES[space](tiny_scene(4)), CAMERA.resized(*size), np.linspace(0.4, 0.5, 5)
    renderer, whole = Renderer(gl.context(), scene, INTERLACED), Renderer(gl.context(), scene)
    got, wanted = played(renderer, [camera] * 5, times), whole.render(camera, 0.5).rgb
    y, x = np.mgrid[: size[1], : size[0]]
    new = [np.abs(got - wanted)[::-1][(x + y) % 2 == parity].max(initial=0) < 1e-5 for parity in (0, 1)]
    assert any(new) and psnr(got, wanted) > (40 if min(size) > 16 else 24)
    # One after a jump, one at the same time, and one of another size follow none.
    for time, other in ((0.95, camera), (0.95, camera), (0.96, camera.resized(20, 30))):
        assert np.abs(renderer.render(other, time).rgb - whole.render(other, time).rgb).max() < 1e-5


def test_a_camera_that_moves_takes_the_picture_along() -> None:
    scene, times = tiny_scene(4, resolution=(48, 40, 32)), np.linspace(0.4, 0.5, 6)
    cameras = [look_at((2.4 * np.cos(a), 1.0, 2.2 * np.cos(a)), (0.1, 0.05, 0.05), 128, 96, 140.0) for a in np.arange(6) * 0.02]
    renderer, whole = Renderer(gl.context(), scene, INTERLACED), Renderer(gl.context(), scene)
    wanted = whole.render(cameras[-1], 0.5).rgb
    got = psnr(played(renderer, cameras, times), wanted)
    assert got > 33
    # Were it not taken along but left where it was, it would be worse.
    assert got > psnr(whole.render(cameras[-2], 0.5).rgb, wanted) + 2
    # What comes out of nowhere, a look the other way, is made of its neighbours.
    behind = look_at((-1.8, 1.4, 2.6), (0.1, 0.05, 0.05), 128, 96, 140.0)
    assert psnr(renderer.render(behind, 0.51).rgb, whole.render(behind, 0.51).rgb) > 20


def test_what_moves_and_what_stays_are_interlaced_each_for_itself() -> None:
    scene, times = tiny_scene(4), np.linspace(0.4, 0.5, 5)
    renderer, whole = Renderer(gl.context(), scene, INTERLACED), Renderer(gl.context(), scene)
    for time in times:
        got = renderer.render(CAMERA, float(time), part=Part.DYNAMIC)
    assert psnr(got.rgb, whole.render(CAMERA, 0.5, part=Part.DYNAMIC).rgb) > 38


def test_steady_playback_makes_nothing_new() -> None:
    ctx, scene = gl.context(), tiny_scene(4)
    screen, renderer = ctx.simple_framebuffer((64, 48), 4), Renderer(ctx, scene, LADDER[DEFAULT])
    for n in range(12):
        renderer.show(screen, CAMERA, 0.4 + n / 100)
        if n == 3:
            made = renderer.memory_bytes, set(renderer._programs), set(renderer._targets)
    assert (renderer.memory_bytes, set(renderer._programs), set(renderer._targets)) == made


# --- shared look-ups, scales, extremes


@pytest.mark.parametrize("space", SPACES)
def test_sharing_look_ups_of_coarser_scales_is_close(space: str) -> None:
    scene = SPACES[space](tiny_scene(4, scales=3, resolution=(48, 40, 32)))
    renderer, wanted = Renderer(gl.context(), scene, Quality(share=2.0)), render(scene, CAMERA, 0.62)
    got = renderer.render(CAMERA, 0.62)
    assert renderer._scales_shared() == (1 if space == "contracted" else 2)
    assert psnr(got.rgb, wanted.rgb) > 45 and np.mean(got.samples == wanted.samples) > 0.98


def test_fewer_scales_are_a_coarser_picture() -> None:
    scene, pictures = tiny_scene(4, scales=3), []
    for scales in (1, 2, 3, 9, None):
        pictures.append(Renderer(gl.context(), scene, Quality(scales=scales)).render(CAMERA, 0.62).rgb)
    one, two, three, *more = pictures
    assert all(np.array_equal(three, picture) for picture in more)
    assert min(psnr(one, two), psnr(two, three), psnr(one, three)) < 40


def fog(density: float, step: float = 0.04) -> Scene:
    """Everywhere of the same density, per longest edge of the box; with surroundings, in them too."""
    scene = tiny_scene(4, dynamic=False)
    even = replace(scene.decoder, density_weight=np.zeros_like(scene.decoder.density_weight), density_bias=float(np.log(density)))
    return replace(scene, decoder=even, step=step, occupancy=np.ones_like(scene.occupancy))


@pytest.mark.parametrize("density", [1e-10, 1e-3, 1.0, 100.0, 1e10])
@pytest.mark.parametrize("step", [0.04, 0.0007])
def test_fog_of_any_density_against_float64(density: float, step: float) -> None:
    """Up to thousands of samples; from within the box, from far outside, and along an axis. The product of n factors errs by
    n 2^-24; rays end with their transmittance at the termination."""
    scene = fog(density, step)
    size = (scene.aabb[1] - scene.aabb[0]).astype(np.float64)
    for eye, target in (((0.1, 0.05, 3.0), (0.1, 0.05, 0.0)), ((0.1, 0.05, 0.05), (5.0, 0.05, 0.05)), ((800.0, 0.05, 0.05), (0, 0.05, 0.05))):
        camera = look_at(eye, target, 1, 1, 50.0)
        origins, directions = camera.rays()
        near, far = box_range(scene.aabb, origins, directions)
        samples = np.ceil((far[0] - near[0]) / step - 0.5)
        left = np.exp(-np.minimum(density, np.exp(20.0)) * step / size.max() * samples)
        for name in ("reference", "finer", "fine", "balanced"):
            quality = LADDER[name]
            got = Renderer(gl.context(), scene, quality).render(camera, 0.0).opacity[0, 0]
            error = 1e-6 + samples * 2.0**-22 + density * step / size.max() * left * 2
            expected = 1.0 if quality.termination > TERMINATION and left < quality.termination else 1 - left
            spent = TERMINATION if left < TERMINATION else 0.0
            near_end = quality.termination if abs(left - quality.termination) < 2 * error else 0.0
            assert abs(got - expected) <= error + spent + near_end, (name, eye, got, expected)


@pytest.mark.parametrize("edges", [(0.0, 1.0, 1.0), (1.0, 1.0, 1e-6)])
def test_boxes_without_a_volume_show_the_background(edges: tuple[float, float, float]) -> None:
    scene = replace(tiny_scene(4), aabb=np.array([[0, 0, 0], edges], np.float32))
    for name, quality in LADDER.items():
        got = Renderer(gl.context(), scene, quality).render(CAMERA, 1.0)
        assert np.isfinite(got.rgb).all() and np.abs(got.rgb - scene.background).max() < 0.02, name
