"""OpenGL against the numpy reference."""

import math
from dataclasses import replace
from pathlib import Path
from typing import ClassVar

import moderngl
import numpy as np
import pytest
from PIL import Image
from test_glsl import cubic

import gl
from kpc.encoder.rdo.prune import keep_channels
from kpc.format.common.errors import DisplayError
from kpc.format.container import scene_io
from kpc.format.scene.cameras import Camera
from kpc.format.scene.rig import Rig
from kpc.format.scene.scene import TIME_PLANES, Scene
from kpc.player.cpu.reference import Part, Rendering, render
from kpc.player.gl import folding, programs
from kpc.player.gl.folding import folded_layout
from kpc.player.gl.presentation import DisplayMode
from kpc.player.gl.renderer import Renderer
from kpc.player.quality import LEVELS, Quality
from kpc.player.viewpoints import fit_camera
from scenes import VARIANTS, look_at, tiny_scene, with_appearances, with_contraction, with_hybrid_decoder, with_motion

CENTRE = (0.1, 0.05, 0.05)
CAMERAS = {
    "outside": look_at((2.4, 1.0, 2.2), CENTRE, 64, 48, 70.0),
    "inside": look_at((0.1, 0.3, 0.4), (0.4, -0.2, 0.0), 64, 48, 40.0),
    "along an axis": look_at((0.1, 0.05, 3.0), CENTRE, 65, 49, 90.0),
    "off centre": Camera(64, 48, 80.0, 60.0, 20.0, 40.0, look_at((-2.4, 0.3, 1.8), CENTRE, 1, 1, 1).camera_to_world),
    "looking away": look_at((3.0, 0.0, 0.0), (9.0, 1.0, 0.0), 16, 12, 20.0),
}

FOLDED = Quality(folded=True, termination=1 / 64)


def shown_on(screen: moderngl.Framebuffer) -> np.ndarray:
    """(height, width, 3) float64 in [0, 1], the top row first."""
    width, height = screen.size
    return np.frombuffer(screen.read(components=3, alignment=1), np.uint8).reshape(height, width, 3)[::-1] / 255


def check(got: Rendering, wanted: Rendering) -> None:
    """Within 1/255 at 99.9 % of the pixels, PSNR at least 50 dB; depth and samples go with them."""
    error = np.abs(got.rgb - wanted.rgb)
    assert np.mean(error.max(axis=-1) <= 1 / 255) >= 0.999
    assert np.mean(error**2) <= 1e-5
    assert np.mean(np.abs(got.opacity - wanted.opacity) <= 1 / 255) >= 0.999
    assert np.mean(got.samples == wanted.samples) >= 0.99
    assert np.array_equal(np.isinf(got.depth), got.opacity == 0)
    solid = (wanted.opacity > 0.5) & (got.opacity > 0.5)
    assert np.mean(np.abs(got.depth[solid] - wanted.depth[solid]) < 2e-3) >= 0.999 if solid.any() else True


def view_independent(scene: Scene) -> Scene:
    return replace(scene, decoder=replace(scene.decoder, w2=np.zeros_like(scene.decoder.w2)))


@pytest.mark.parametrize("view", CAMERAS)
@pytest.mark.parametrize("part", Part)
@pytest.mark.parametrize("space", VARIANTS)
def test_gives_the_reference_picture(view: str, part: Part, space: str) -> None:
    scene = VARIANTS[space](tiny_scene(4))
    wanted = render(scene, CAMERAS[view], 0.62, part=part)
    check(Renderer(gl.context(), scene).render(CAMERAS[view], 0.62, part=part), wanted)
    if view not in ("looking away",) and part is Part.FULL:
        assert wanted.opacity.max() > 0.9


@pytest.mark.parametrize(
    "scene",
    [
        tiny_scene(6, dynamic=False),
        tiny_scene(7, scales=3, channels=5, resolution=(40, 12, 28), time=2),
        tiny_scene(8, scales=1, channels=3, resolution=(2, 3, 2), time=1),
        replace(tiny_scene(9), occupancy=np.ones((1, 1, 1, 1), bool)),
        replace(tiny_scene(9), occupancy=np.zeros((2, 300, 2, 3), bool)),
        with_contraction(tiny_scene(6, dynamic=False)),
        replace(with_contraction(tiny_scene(9)), occupancy=np.zeros((2, 300, 2, 3), bool)),
        with_motion(with_contraction(tiny_scene(6)), most=0.5),
        view_independent(tiny_scene(6)),
        keep_channels(tiny_scene(4, scales=3), (np.array([1, 4, 6]), np.array([0]), np.arange(8))),
    ],
    ids=[
        "static",
        "uneven",
        "few texels",
        "one cell",
        "nothing",
        "contracted",
        "nothing anywhere",
        "thrown about",
        "one colour",
        "pruned",
    ],
)
def test_scenes_of_all_shapes(scene: Scene) -> None:
    renderer = Renderer(gl.context(), scene)
    for time in (0.0, 0.5, 1.0):
        check(renderer.render(CAMERAS["outside"], time), render(scene, CAMERAS["outside"], time))


@pytest.mark.parametrize("hidden", [16, 5, 1])
@pytest.mark.parametrize("part", Part)
def test_appearances_are_those_of_the_reference(part: Part, hidden: int) -> None:
    scene = tiny_scene(4)
    d = scene.decoder
    narrow = replace(d, w1=d.w1[:hidden], b1=d.b1[:hidden] + 2, w2=16 / hidden * d.w2[..., :hidden])
    scene = with_appearances(replace(scene, decoder=narrow))
    renderer, pictures = Renderer(gl.context(), scene), []
    between = scene.interpolate_appearance("dawn.jpg", "dusk.jpg", 0.5)
    for code in (None, *(appearance.code for appearance in scene.appearances), between):
        got, wanted = (
            render_it(CAMERAS["outside"], 0.62, part=part, appearance=code)
            for render_it in (renderer.render, lambda *a, **k: render(scene, *a, **k))
        )
        check(got, wanted)
        pictures.append(got.rgb)
    average, _, noon, dusk, _ = pictures
    assert all(np.abs(a - b).max() > 4 / 255 for a, b in ((average, noon), (average, dusk), (noon, dusk)))
    with pytest.raises(ValueError, match="shape"):
        renderer.render(CAMERAS["outside"], 0.62, appearance=np.zeros(hidden + 1, np.float32))
    with pytest.raises(ValueError, match="0 appearances"):
        Renderer(gl.context(), tiny_scene(4)).render(CAMERAS["outside"], 0.62, appearance=np.zeros(16, np.float32))


def test_appearances_of_a_hybrid_scene_are_those_of_the_reference() -> None:
    scene = with_appearances(with_hybrid_decoder(tiny_scene(4)))
    renderer, pictures = Renderer(gl.context(), scene), []
    for code in (None, scene.appearance("noon.jpg")):
        got = renderer.render(CAMERAS["outside"], 0.62, appearance=code)
        check(got, render(scene, CAMERAS["outside"], 0.62, appearance=code))
        pictures.append(got.rgb)
    assert np.abs(pictures[0] - pictures[1]).max() > 4 / 255


@pytest.mark.parametrize("part", Part)
def test_an_appearance_is_shown_on_the_screen(part: Part) -> None:
    ctx, scene = gl.context(), with_appearances(tiny_scene(4))
    screen, renderer, camera = ctx.framebuffer([ctx.texture((64, 48), 4)]), Renderer(ctx, scene), CAMERAS["outside"]
    for code in (None, scene.appearance("dusk.jpg")):
        renderer.show(screen, camera, 0.62, part=part, appearance=code)
        shown = shown_on(screen)
        assert np.abs(shown - renderer.render(camera, 0.62, part=part, appearance=code).rgb.clip(0, 1)).max() < 1 / 255


@pytest.mark.parametrize("share", [0.25, 0.5])
def test_a_picture_is_blended_over_the_screen_by_its_opacity(share: float) -> None:
    ctx, one, other = gl.context(), tiny_scene(4), tiny_scene(5)
    screen, camera = ctx.framebuffer([ctx.texture((64, 48), 4)]), CAMERAS["outside"]
    pictures = []
    for scene, part in ((one, 1.0), (other, share)):
        renderer = Renderer(ctx, scene)
        renderer.show(screen, camera, 0.62, opacity=part)
        pictures.append(renderer.render(camera, 0.62).rgb.clip(0, 1))
    shown = np.frombuffer(screen.read(components=4, alignment=1), np.uint8).reshape(48, 64, 4)[::-1] / 255
    assert np.abs(pictures[0] - pictures[1]).max() > 0.2
    assert np.abs(shown[..., :3] - (1 - share) * pictures[0] - share * pictures[1]).max() < 1.5 / 255
    assert (shown[..., 3] == 1).all()
    renderer.show(screen, camera, 0.62)  # and what comes next covers it
    shown = shown_on(screen)
    assert np.abs(shown - pictures[1]).max() < 1 / 255


def test_scenes_without_appearances_have_no_code_in_the_shader() -> None:
    for scene, held in (
        (tiny_scene(4), False),
        (with_appearances(tiny_scene(4)), True),
        (with_appearances(view_independent(tiny_scene(4))), False),
    ):
        renderer = Renderer(gl.context(), scene)
        renderer.render(CAMERAS["outside"], 0.62)
        (program,) = (
            program for (name, *_), (program, _) in renderer._programs._programs.items() if name == "march.glsl"
        )
        assert (program.get("appearance", None) is not None) == held
        if not held and scene.appearances:  # view-independent colour, whatever the code
            check(
                renderer.render(CAMERAS["outside"], 0.62, appearance=scene.appearance("dawn.jpg")),
                render(scene, CAMERAS["outside"], 0.62, appearance=scene.appearance("dawn.jpg")),
            )


def test_sparse_occupancy_loses_no_sample() -> None:
    """Long empty stretches are crossed in a few jumps; the lattice must stay where it is."""
    rng = np.random.default_rng(0)
    occupancy = rng.random((1, 40, 50, 60)) < 0.002
    scene = replace(tiny_scene(3), occupancy=occupancy, step=0.007)
    check(Renderer(gl.context(), scene).render(CAMERAS["outside"], 0.3), render(scene, CAMERAS["outside"], 0.3))


def test_one_renderer_serves_many_sizes_and_times() -> None:
    scene = tiny_scene(4)
    renderer = Renderer(gl.context(), scene)
    for width, height, time in [
        (40, 30, 0.1),
        (31, 17, 0.9),
        (1, 1, 0.4),
        (40, 30, 0.1),
        (8, 9, 0),
        (10, 9, 0),
        (11, 9, 0),
    ]:
        camera = CAMERAS["outside"].resized(width, height)
        got = renderer.render(camera, time)
        assert got.rgb.shape == (height, width, 3)
        check(got, render(scene, camera, time))
    assert renderer.memory_bytes > 1000


@pytest.mark.parametrize("processor", [False, True], ids=["shaders", "processor"])
@pytest.mark.parametrize("space", VARIANTS)
def test_folded_levels_are_exact_where_nothing_moves_and_close_where_it_does(space: str, processor: bool) -> None:
    still, moving = tiny_scene(6, dynamic=False), VARIANTS[space](tiny_scene(4))
    still = with_contraction(still) if space == "contracted" else still
    check(
        Renderer(gl.context(), still, Quality(folded=True), processor=processor).render(CAMERAS["outside"], 0.0),
        render(still, CAMERAS["outside"], 0.0),
    )
    renderer = Renderer(gl.context(), moving, FOLDED, processor=processor)
    for time in (0.2, 0.7):
        got, wanted = renderer.render(CAMERAS["outside"], time), render(moving, CAMERAS["outside"], time)
        assert -10 * np.log10(np.mean((got.rgb - wanted.rgb) ** 2)) > 50
        # A ray that ends early counts what is left of its light as spent.
        assert got.samples.sum() < 0.95 * wanted.samples.sum()
        dense = wanted.opacity > 63 / 64
        assert dense.any() and (got.opacity[wanted.opacity > 0.995] == 1).all()
        assert np.median(np.abs(got.depth[dense] / wanted.depth[dense] - 1)) < 1 / 64
    renderer.quality = Quality()
    check(renderer.render(CAMERAS["outside"], 0.7), render(moving, CAMERAS["outside"], 0.7))


@pytest.mark.parametrize("space", VARIANTS)
def test_every_display_mode_and_part_is_shown_on_a_screen_of_another_size(space: str) -> None:
    ctx, scene = gl.context(), VARIANTS[space](tiny_scene(4))
    screen = ctx.framebuffer([ctx.texture((70, 50), 4)])
    renderer, pictures = Renderer(ctx, scene), {}
    for look in DisplayMode:
        for part in Part:
            renderer.show(screen, CAMERAS["outside"], 0.62, part=part, mode=look, depths=(2.0, 4.0), most_samples=20.0)
            pictures[look, part] = 255 * shown_on(screen)
    renderer.check()
    for (look, part), picture in pictures.items():
        assert picture.std() > 3, (look, part)
    whole = np.frombuffer(
        (render(scene, CAMERAS["outside"].resized(70, 50), 0.62).rgb * 255).astype(np.uint8), np.uint8
    )
    assert (
        np.mean(np.abs(pictures[DisplayMode.COLOUR, Part.FULL].astype(float).ravel() - whole)) < 6
    )  # a stretched, filtered copy


@pytest.mark.parametrize(("limits", "words"), [
    ({"GL_MAX_TEXTURE_SIZE": 32}, "plane xy of scale 2 needs a texture of 48x20, .* takes 32"),
    ({"GL_MAX_TEXTURE_SIZE": 48}, "all planes, of which plane xy of scale 2 is the largest, needs"),
    ({"GL_MAX_3D_TEXTURE_SIZE": 11}, "the occupancy grid needs a texture of 12x10x8, .* takes 11"),
    ({"GL_MAX_3D_TEXTURE_SIZE": 12}, "the motion grid needs a texture of 4x2x13"),
])  # fmt: skip
def test_a_scene_too_large_for_the_card_is_refused_by_name(
    limits: dict[str, int], words: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    ctx, scene = gl.context(), with_motion(tiny_scene(4))
    if "motion" in words:
        scene = replace(scene, motion=np.zeros((6, 13, 2, 4, 3), np.float32))
    for name, limit in limits.items():
        monkeypatch.setitem(ctx.info, name, limit)
    with pytest.raises(DisplayError, match=f"{words}.*--backend reference"):
        Renderer(ctx, scene)


@pytest.mark.parametrize("size", [(4096, 1), (1, 4096), (1, 1)])
def test_pictures_of_extreme_shapes(size: tuple[int, int]) -> None:
    scene = tiny_scene(4)
    camera = Camera(*size, 70.0 if size[0] == 1 else 40.0 * size[0] / 48, 70.0, size[0] / 2, size[1] / 2,
                    CAMERAS["outside"].camera_to_world)  # fmt: skip
    for time in (0.0, 1.0):
        check(Renderer(gl.context(), scene).render(camera, time), render(scene, camera, time))


@pytest.mark.parametrize("time", [-0.1, 1.1, math.nan])
def test_times_outside_the_clip_are_refused(time: float) -> None:
    with pytest.raises(ValueError, match="outside"):
        Renderer(gl.context(), tiny_scene(4)).render(CAMERAS["outside"], time)


def test_a_decoder_too_large_for_a_shader_is_refused() -> None:
    scene = tiny_scene(4)
    wide = replace(scene.decoder, w1=np.zeros((2000, 9)), b1=np.zeros(2000), w2=np.ones((3, 16, 2000)))
    with pytest.raises(DisplayError, match="weights"):
        Renderer(gl.context(), replace(scene, decoder=wide))


def test_planes_that_fit_only_without_upsampling_are_folded_so(monkeypatch: pytest.MonkeyPatch) -> None:
    ctx, scene = gl.context(), tiny_scene(4)
    monkeypatch.setitem(ctx.info, "GL_MAX_TEXTURE_SIZE", max(Renderer(ctx, scene).layout.size))
    renderer = Renderer(ctx, scene, FOLDED, processor=False)
    assert folded_layout(renderer._textures) is renderer.layout
    error = renderer.render(CAMERAS["outside"], 0.7).rgb - render(scene, CAMERAS["outside"], 0.7).rgb
    assert -10 * np.log10(np.mean(error**2)) > 40


def test_planes_are_folded_again_only_with_other_rows(monkeypatch: pytest.MonkeyPatch) -> None:
    moving = tiny_scene(4)
    still = {name: np.ones_like(plane) if name in TIME_PLANES else plane for name, plane in moving.scales[0].items()}
    scene = replace(moving, scales=(still, moving.scales[1]))
    renderer, drawn = Renderer(gl.context(), scene, FOLDED, processor=False), []

    def draw(*arguments: object) -> None:
        drawn.append(arguments)
        programs.draw(*arguments)

    def blocks_for(time: float) -> int:
        drawn.clear()
        picture = renderer.render(CAMERAS["outside"], time)
        count = len(drawn)
        first = Renderer(gl.context(), scene, FOLDED, processor=False)
        assert np.array_equal(picture.rgb, first.render(CAMERAS["outside"], time).rgb)
        return count

    monkeypatch.setattr(folding, "draw", draw)
    # upsampled and folded; then those of the scale that moves
    assert [blocks_for(time) for time in (0.2, 0.2, 0.7, 0.2)] == [6 + 6, 0, 3, 3]
    for factor, count in ((0.5, 1), (1e5, 6)):  # one plane; all in float32, since float16 does not hold them
        scene.scales[1]["xt"][:] *= factor
        renderer.refresh()
        assert blocks_for(0.2) == count


def test_a_picture_too_large_for_the_card_is_refused() -> None:
    renderer = Renderer(gl.context(), tiny_scene(4))
    with pytest.raises(DisplayError, match=r"no room for a picture of 99999x2 .*smaller size"):
        renderer.render(CAMERAS["outside"].resized(99999, 2), 0.0)
    _ = renderer.ctx.error  # reading the card's error clears it


def test_an_error_of_the_card_is_reported() -> None:
    class Card:
        error = "GL_OUT_OF_MEMORY"
        info: ClassVar = {"GL_RENDERER": "some card"}

    renderer = Renderer(gl.context(), tiny_scene(4))
    renderer.ctx = Card()
    with pytest.raises(DisplayError, match=r"GL_OUT_OF_MEMORY on some card; .*smaller size"):
        renderer.check()


VECTORS = Path(__file__).parents[2] / "spec" / "vectors" / "valid"
WHOLE = sorted(path.stem for path in VECTORS.glob("*.kpc") if "prefix" not in path.stem and "groups" not in path.stem)
TOO_LARGE = {"limits-axes": "texture of 16384x16391", "limits-hybrid": "weights"}


@pytest.mark.parametrize("name", WHOLE)
def test_conformance_files_are_drawn_at_every_level(name: str) -> None:
    """Planes of one texel or thousands, one row of time or many: whatever a file may hold."""
    scene = scene_io.read(VECTORS / f"{name}.kpc").dequantise()
    if name == "limits-axes" and gl.context().info["GL_MAX_TEXTURE_SIZE"] > 16384:
        pytest.skip("this card takes planes that are too large for others")
    if name in TOO_LARGE:
        with pytest.raises(DisplayError, match=TOO_LARGE[name]):
            Renderer(gl.context(), scene)
        return
    camera = fit_camera(Rig.of(scene).cameras[0], 32, 24)
    renderer = Renderer(gl.context(), scene)
    for quality in LEVELS.values():
        renderer.quality = quality
        drawn = renderer.render(camera, 0.4)
        assert np.isfinite(drawn.rgb).all()
    check(drawn, render(scene, camera, 0.4))
    renderer.release()


def test_a_small_picture_is_enlarged_by_a_cubic() -> None:
    """A screen of four times the pixels shows what the cubic makes of the small picture."""
    ctx, scene, camera = gl.context(), tiny_scene(4), CAMERAS["outside"]
    renderer, screens = Renderer(ctx, scene), {}
    for scale in (1, 2):
        screens[scale] = ctx.simple_framebuffer((camera.width * scale, camera.height * scale), 4)
        renderer.show(screens[scale], camera, 0.62)
    small, large = (shown_on(screen) for screen in screens.values())
    x, y = ((np.arange(2 * n) + 0.5) / (2 * n) for n in (camera.width, camera.height))
    places = np.stack(np.meshgrid(x, y), -1).reshape(-1, 2)
    wanted = cubic(small, *places.T).reshape(large.shape).clip(0, 1)
    assert np.abs(large - wanted).max() < 1.01 / 255

    straight = (
        np.asarray(
            Image.fromarray((255 * small).round().astype(np.uint8)).resize(screens[2].size, Image.Resampling.BILINEAR)
        )
        / 255
    )
    assert np.abs(straight - wanted).max() > 4 / 255

    for share in (0.25, 1.0):  # and over what is there
        screens[2].clear(0.2, 0.4, 0.6, 1.0)
        renderer.show(screens[2], camera, 0.62, opacity=share)
        np.testing.assert_allclose(
            shown_on(screens[2]), share * large + (1 - share) * np.array([0.2, 0.4, 0.6]), atol=1.5 / 255
        )
