"""The quality levels."""

import functools
from dataclasses import replace

import numpy as np
import pytest

import gl
from kpc.format.scene.scene import SPACE_PLANES, TERMINATION, TIME_PLANES, Scene
from kpc.player.cpu.reference import box_range, render
from kpc.player.cpu.serving import serves
from kpc.player.gl import renderer as module
from kpc.player.gl.programs import is_software
from kpc.player.gl.renderer import COMPUTE_VERSION, TRIAL_AFTER, Renderer
from kpc.player.quality import DEFAULT, LEVELS, Quality, neighbouring_level
from processor import psnr
from scenes import VARIANTS, look_at, tiny_scene

CAMERA = look_at((2.4, 1.0, 2.2), (0.1, 0.05, 0.05), 64, 48, 70.0)
BOTH = pytest.mark.parametrize("processor", [False, True], ids=["shaders", "processor"])

# Measured PSNR from the reference, dB: the worst of a first picture and of the third that follows it; a picture of
# 64x48 pixels of a scene with abrupt edges, so that levels of a lower resolution are far from it. By shaders, then by
# the processor.
MEASURED_LEVELS = ("fastest", "faster", "fast", "balanced", "fine", "finer")
MEASURED = {
    "box": ((21.9, 21.8), (22.0, 22.0), (23.3, 23.4), (63.6, 36.8), (68.9, 51.3), (75.5, 100)),
    "contracted": ((36.0, 36.0), (36.7, 36.6), (37.5, 37.0), (48.6, 41.5), (55.2, 51.7), (66.4, 100)),
    "displaced": ((21.9, 21.9), (22.1, 22.1), (23.5, 23.5), (63.0, 36.7), (67.1, 51.1), (75.3, 100)),
    "ndc": ((23.9, 23.9), (24.0, 24.0), (25.0, 25.0), (62.3, 62.3), (66.8, 66.8), (70.8, 70.8)),
    "moving area": ((29.6, 29.5), (30.1, 30.1), (31.9, 32.0), (57.2, 44.1), (63.0, 54.1), (75.1, 100)),
    "hybrid": ((24.8, 24.8), (25.1, 25.1), (28.1, 28.1), (52.1, 52.1), (57.8, 57.8), (70.4, 70.4)),
}
MARGIN = 1.0
# The level `reference`. A graphics card filters textures with fractions of 8 bits: 82.4 to 87.5 dB on an NVIDIA H100.
REFERENCE_DB, REFERENCE_ON_A_CARD_DB = 100.0, 80.0


def test_the_table_ends_at_what_the_format_says() -> None:
    names = list(LEVELS)
    assert LEVELS[names[-1]] == Quality() and DEFAULT in names
    assert [neighbouring_level(names[0], n) for n in range(-1, len(names) + 1)] == [names[0], *names, names[-1]]
    assert neighbouring_level("fast", 1) == DEFAULT == neighbouring_level("fine", -1)


FAULTS = [("step", 0.5), ("step", np.nan), ("termination", 0.0), ("termination", 1.0), ("resolution", 0.0),
          ("resolution", 1.5), ("rays_across", 0), ("reprojection_tolerance", -0.1), ("reprojection_tolerance", np.nan),
          ("interpolation_tolerance", -0.1), ("culling_alpha", 1.0), ("grid_termination", -0.1)]  # fmt: skip


@pytest.mark.parametrize(("name", "value"), FAULTS)
def test_settings_that_draw_nothing_are_refused(name: str, value: float) -> None:
    with pytest.raises(ValueError, match=name):
        Quality(**{name: value})  # type: ignore[arg-type]


@functools.cache
def reference_of(variant: str, time: float) -> np.ndarray:
    """Return the reference's picture."""
    return render(VARIANTS[variant](tiny_scene(4)), CAMERA, time).rgb


@BOTH
@pytest.mark.parametrize("variant", VARIANTS)
def test_every_level_is_as_near_to_the_reference_as_measured(variant: str, processor: bool) -> None:
    scene = VARIANTS[variant](tiny_scene(4))
    renderer = Renderer(gl.context(), scene, processor=processor)
    assert (renderer._processor is not None) == (processor and serves(scene))
    measured = dict(zip(MEASURED_LEVELS, MEASURED[variant], strict=True))
    exact = REFERENCE_DB if is_software(gl.context()) else REFERENCE_ON_A_CARD_DB
    for name, renderer.quality in LEVELS.items():
        bound = exact if name == "reference" else measured[name][processor] - MARGIN
        for time in (0.62, 0.63, 0.64, 0.65):
            got = renderer.render(CAMERA, time)
            assert psnr(got.rgb, reference_of(variant, time)) > bound, (name, time)


@pytest.mark.parametrize("variant", VARIANTS)
def test_compute_shaders_draw_the_same(variant: str) -> None:
    ctx, scene = gl.context(), VARIANTS[variant](tiny_scene(4))
    if ctx.version_code < COMPUTE_VERSION:
        pytest.skip("this OpenGL has no compute shaders")
    camera = CAMERA.resized(61, 43)  # no whole number of work groups
    renderer = Renderer(ctx, scene, processor=False)
    for name in ("reference", "finer", "fine", "balanced"):
        pictures, renderer.quality = [], LEVELS[name]
        for renderer.compute in (False, True):
            pictures.append(renderer.render(camera, 0.3))
        one, other = pictures
        assert np.mean(np.abs(one.rgb - other.rgb).max(axis=2) < 1 / 255) > 0.999 and psnr(one.rgb, other.rgb) > 55, (
            name
        )
        assert np.mean(one.samples == other.samples) > 0.99
    renderer.check()


def test_a_card_tries_both_kinds_of_shaders_once_and_keeps_the_faster(monkeypatch: pytest.MonkeyPatch) -> None:
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
    assert not Renderer(ctx, tiny_scene(4)).compute or not module.is_software(ctx)


def test_the_faster_of_both_kinds_of_shaders_is_found_by_drawing(monkeypatch: pytest.MonkeyPatch) -> None:
    ctx, ticks = gl.context(), {False: 1.0, True: 2.0}
    if ctx.version_code < COMPUTE_VERSION:
        pytest.skip("this OpenGL has no compute shaders")
    renderer, now, draw = Renderer(ctx, tiny_scene(4)), [0.0], None
    draw = renderer._shaders.draw

    def timed(*args, compute: bool, **more) -> None:
        draw(*args, compute=compute, **more)
        now[0] += ticks[compute]

    monkeypatch.setattr(renderer._shaders, "draw", timed)
    monkeypatch.setattr(module.clock, "perf_counter", lambda: now[0])
    assert not renderer.is_compute_faster(CAMERA, 0.5)
    ticks[True] = 0.5
    assert renderer.is_compute_faster(CAMERA, 0.5) and not renderer.compute


@BOTH
@pytest.mark.parametrize("level", ["balanced", "fine", "reference"])
def test_what_was_drawn_from_far_away_is_whole_from_near(level: str, processor: bool) -> None:
    ctx, scene = gl.context(), tiny_scene(4)
    far = look_at((24.0, 10.0, 22.0), (0.1, 0.05, 0.05), 64, 48, 70.0)
    near, shown = look_at((0.9, 0.5, 0.8), (0.1, 0.05, 0.05), 64, 48, 40.0), []
    for cameras in ((far, near), (near,)):
        renderer, screen = Renderer(ctx, scene, LEVELS[level], processor=processor), ctx.simple_framebuffer((64, 48), 4)
        for camera in cameras:
            renderer.show(screen, camera, 0.4)
        shown.append(np.frombuffer(screen.read(components=3), np.uint8).astype(int))
    assert np.abs(shown[0] - shown[1]).max() <= 1 and np.ptp(shown[0]) > 50


def test_steady_playback_allocates_and_compiles_nothing() -> None:
    ctx, scene = gl.context(), tiny_scene(4)
    screen, renderer = ctx.simple_framebuffer((64, 48), 4), Renderer(ctx, scene, LEVELS[DEFAULT])
    for n in range(2 * TRIAL_AFTER):
        renderer.show(screen, CAMERA, 0.4 + n / 100)
        if n == TRIAL_AFTER:  # a card has tried both kinds of shaders by now
            made = renderer.memory_bytes, renderer._programs.names(), set(renderer._targets)
    assert (renderer.memory_bytes, renderer._programs.names(), set(renderer._targets)) == made


@BOTH
def test_planes_that_arrive_are_drawn(processor: bool) -> None:
    scene, finer = tiny_scene(4), tiny_scene(5)
    renderer = Renderer(gl.context(), scene, Quality(folded=True), processor=processor)
    renderer.render(CAMERA, 0.4)
    for s, scale in enumerate(finer.scales):
        for plane in SPACE_PLANES:
            renderer.put(s, plane, renderer.layout.texels(scale[plane]))
    same_times = [
        {**new, **{p: old[p] for p in TIME_PLANES}} for new, old in zip(finer.scales, scene.scales, strict=True)
    ]
    wanted = Renderer(
        gl.context(), replace(scene, scales=tuple(same_times)), Quality(folded=True), processor=processor
    ).render(CAMERA, 0.4)
    assert np.array_equal(renderer.render(CAMERA, 0.4).rgb, wanted.rgb)


# --- what is far away


@pytest.mark.parametrize("way", ["fragment", "compute", "processor"])
def test_what_is_far_away_is_a_mean_of_rays(way: str) -> None:
    ctx, scene = gl.context(), tiny_scene(4, resolution=(96, 80, 64))
    if way == "compute" and ctx.version_code < COMPUTE_VERSION:
        pytest.skip("this OpenGL has no compute shaders")
    camera = look_at((24.0, 10.0, 22.0), (0.1, 0.05, 0.05), 32, 24, 70.0)
    many = render(scene, camera.resized(32 * 12, 24 * 12), 0.62).rgb.reshape(24, 12, 32, 12, 3).mean((1, 3))
    errors = {}
    for across in (1, 2, 4):
        quality = Quality(folded=way == "processor", rays_across=across)
        renderer = Renderer(ctx, scene, quality, compute=way == "compute", processor=way == "processor")
        assert renderer.rays_across(camera) == across
        errors[across] = np.abs(renderer.render(camera, 0.62).rgb - many).mean()
    assert errors[4] < 0.5 * errors[2] < 0.5 * 0.7 * errors[1]


def test_a_pixel_has_as_many_rays_as_it_spans_texels(monkeypatch: pytest.MonkeyPatch) -> None:
    scene = tiny_scene(4, resolution=(33, 17, 17))
    renderer, middle = Renderer(gl.context(), scene, Quality(rays_across=4)), scene.aabb.mean(0)
    texel = scene.extent / 32
    for texels, across in ((0.5, 1), (1.9, 1), (2.1, 2), (3.1, 3), (50, 4)):
        away = 100 * texels * texel  # a pixel is a hundredth of the distance
        camera = look_at(tuple(middle + np.array([0, 0, away])), tuple(middle), 64, 48, 70.0)
        camera = replace(camera, fl_x=100.0, fl_y=100.0)
        assert renderer.rays_across(camera) == across
    monkeypatch.setattr(module, "MOST_PIXELS", 64 * 48 * 5)
    assert renderer.rays_across(camera) == 2
    renderer.quality = Quality()
    assert renderer.rays_across(camera) == 1
    for space in ("contracted", "ndc"):
        assert Renderer(gl.context(), VARIANTS[space](tiny_scene(4)), Quality(rays_across=4)).rays_across(camera) == 1


# --- extremes


def fog(density: float, step: float = 0.04) -> Scene:
    """Everywhere of the same density, per longest edge of the box; with surroundings, in them too."""
    scene = tiny_scene(4, dynamic=False)
    even = replace(
        scene.decoder, density_weight=np.zeros_like(scene.decoder.density_weight), density_bias=float(np.log(density))
    )
    return replace(scene, decoder=even, step=step, occupancy=np.ones_like(scene.occupancy))


@pytest.mark.parametrize("density", [1e-10, 1e-3, 1.0, 100.0, 1e10])
@pytest.mark.parametrize("step", [0.04, 0.0007])
@BOTH
def test_fog_of_any_density_against_float64(density: float, step: float, processor: bool) -> None:
    """Up to thousands of samples; from within the box, from far outside, and along an axis. The product of n factors
    errs by n 2^-24; rays end with their transmittance at the termination."""
    scene = fog(density, step)
    size = (scene.aabb[1] - scene.aabb[0]).astype(np.float64)
    for eye, target in (
        ((0.1, 0.05, 3.0), (0.1, 0.05, 0.0)),
        ((0.1, 0.05, 0.05), (5.0, 0.05, 0.05)),
        ((800.0, 0.05, 0.05), (0, 0.05, 0.05)),
    ):
        camera = look_at(eye, target, 1, 1, 50.0)
        origins, directions = camera.rays()
        near, far = box_range(scene.aabb, origins, directions)
        samples = np.ceil((far[0] - near[0]) / step - 0.5)
        left = np.exp(-np.minimum(density, np.exp(20.0)) * step / size.max() * samples)
        for name in ("reference", "finer", "fine", "balanced"):
            quality = replace(LEVELS[name], rays_across=1)  # the pixel sees more than the box
            got = Renderer(gl.context(), scene, quality, processor=processor).render(camera, 0.0).opacity[0, 0]
            error = 1e-6 + samples * 2.0**-22 + density * step / size.max() * left * 2
            expected = 1.0 if quality.termination > TERMINATION and left < quality.termination else 1 - left
            spent = TERMINATION if left < TERMINATION else 0.0
            near_end = quality.termination if abs(left - quality.termination) < 2 * error else 0.0
            assert abs(got - expected) <= error + spent + near_end, (name, eye, got, expected)


@pytest.mark.parametrize("edges", [(0.0, 1.0, 1.0), (1.0, 1.0, 1e-6)])
@BOTH
def test_boxes_without_a_volume_show_the_background(edges: tuple[float, float, float], processor: bool) -> None:
    scene = replace(tiny_scene(4), aabb=np.array([[0, 0, 0], edges], np.float32))
    for name, quality in LEVELS.items():
        got = Renderer(gl.context(), scene, quality, processor=processor).render(CAMERA, 1.0)
        assert np.isfinite(got.rgb).all() and np.abs(got.rgb - scene.background).max() < 0.02, name


@pytest.mark.parametrize("factor", [1e-7, 1e6])
def test_folded_planes_that_float16_cannot_hold_are_float32(factor: float) -> None:
    """The decoder makes up for large or small numbers, so that pictures are the same; they come after the first one, as
    where a scene is still being loaded.
    """
    scene, quality = tiny_scene(4), replace(LEVELS["finer"], rays_across=1)
    expected = Renderer(gl.context(), scene, quality, processor=False).render(CAMERA, 0.4).rgb
    d, less = scene.decoder, np.float32(1 / factor)
    decoder = replace(d, density_weight=less * d.density_weight, w2=less * d.w2, b2=less * d.b2)
    renderer = Renderer(gl.context(), replace(scene, decoder=decoder), quality, processor=False)
    renderer.render(CAMERA, 0.4)
    assert renderer.plane_dtype == "f2"
    for number, planes in enumerate(scene.scales):
        planes["xy"][:] *= np.float32(factor)
        renderer.put(number, "xy", renderer.layout.texels(planes["xy"]))
    assert renderer.plane_dtype == "f4"
    assert np.abs(renderer.render(CAMERA, 0.4).rgb - expected).max() < 2 / 255
