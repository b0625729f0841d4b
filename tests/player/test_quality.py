"""The settings of a picture, and the ladder of them."""

from dataclasses import replace

import gl
import numpy as np
import pytest
from kpc.format.scene.cameras import Camera
from kpc.format.scene.scene import SPACE_PLANES, TERMINATION, TIME_PLANES, Scene
from kpc.player.cpu.cpu_renderer import probes_of
from kpc.player.cpu.reference import Part, box_range, render
from kpc.player.gl import renderer as module
from kpc.player.gl.renderer import COMPUTE_VERSION, TRIAL_AFTER, Renderer
from kpc.player.quality import DEFAULT, LEVELS, Quality, neighbouring_level
from scenes import VARIANTS, look_at, tiny_scene, with_appearances

CAMERA = look_at((2.4, 1.0, 2.2), (0.1, 0.05, 0.05), 64, 48, 70.0)


@pytest.fixture(autouse=True, params=[False, True], ids=["shaders", "processor"])
def who_marches(request: pytest.FixtureRequest, monkeypatch: pytest.MonkeyPatch) -> None:
    """What a processor would march itself, shaders march elsewhere."""
    monkeypatch.setattr(module, "marches_itself", lambda ctx: request.param and module.is_software(ctx))


def psnr(a: np.ndarray, b: np.ndarray) -> float:
    return float(-10 * np.log10(max(np.mean((a - b) ** 2), 1e-12)))


def test_the_ladder_ends_at_what_the_format_says() -> None:
    names = list(LEVELS)
    assert LEVELS[names[-1]] == Quality() and DEFAULT in names
    assert [neighbouring_level(names[0], n) for n in range(-1, len(names) + 1)] == [names[0], *names, names[-1]]


@pytest.mark.parametrize("fault", [{"step": 0.5}, {"step": np.nan}, {"termination": 0.0}, {"termination": 1.0}, {"resolution": 0.0},
                                   {"resolution": 1.5}, {"rays_across": 0}, {"reprojection_tolerance": -0.1}, {"reprojection_tolerance": np.nan}])  # fmt: skip
def test_settings_that_draw_nothing_are_refused(fault: dict[str, float]) -> None:
    with pytest.raises(ValueError, match=next(iter(fault))):
        Quality(**fault)  # type: ignore[arg-type]


@pytest.mark.parametrize("space", VARIANTS)
def test_every_rung_draws_the_scene_and_the_last_exactly(space: str) -> None:
    scene = VARIANTS[space](tiny_scene(4))
    renderer, wanted = Renderer(gl.context(), scene), render(scene, CAMERA, 0.62)
    for name, quality in LEVELS.items():
        renderer.quality = quality
        got = renderer.render(CAMERA, 0.62)
        assert got.rgb.shape == wanted.rgb.shape
        assert psnr(got.rgb, wanted.rgb) > (60 if name == "reference" else 20), name


@pytest.mark.parametrize("space", VARIANTS)
def test_compute_shaders_draw_the_same(space: str) -> None:
    ctx, scene = gl.context(), VARIANTS[space](tiny_scene(4))
    if ctx.version_code < COMPUTE_VERSION:
        pytest.skip("this OpenGL has no compute shaders")
    camera = CAMERA.resized(61, 43)  # no whole number of work groups
    renderer, pictures = Renderer(ctx, scene), {}
    bent = LEVELS["balanced"]
    qualities = {
        "reference": LEVELS["reference"],
        "fine": replace(LEVELS["fine"], interpolation_tolerance=0.0),
        "balanced": replace(bent, interpolation_tolerance=0.0),
        "bent": bent,
    }
    for renderer.compute in (False, True):
        for name, renderer.quality in qualities.items():
            pictures[name, renderer.compute] = renderer.render(camera, 0.3)
    renderer.check()
    assert (
        psnr(pictures["bent", False].rgb, pictures["bent", True].rgb) > 50
    )  # a block that bends by just so much may go either way
    for name in ("reference", "balanced", "fine"):
        one, other = pictures[name, False], pictures[name, True]
        assert np.mean(np.abs(one.rgb - other.rgb).max(axis=2) < 1 / 255) > 0.999 and psnr(one.rgb, other.rgb) > 55, (
            name
        )
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


# --- following the picture before


TOLERANCE = 5 / 255
FOLLOWING = Quality(reprojection_tolerance=TOLERANCE)


def played(renderer: Renderer, cameras: list[Camera], times: np.ndarray) -> np.ndarray:
    """The last of the pictures."""
    for camera, time in zip(cameras, times, strict=True):
        picture = renderer.render(camera, float(time)).rgb
    return picture


def doubted(renderer: Renderer) -> float:
    """Share of the blocks of the last picture that were marched whole."""
    (target,) = [target for key, target in renderer._targets.items() if key[2] == module.DOUBTS]
    return float(np.frombuffer(target.seen.read(), np.float32)[::4].mean())


def around(angles: np.ndarray) -> list[Camera]:
    return [look_at((2.4 * np.cos(a), 1.0, 2.2 * np.cos(a)), (0.1, 0.05, 0.05), 128, 96, 140.0) for a in angles]


@pytest.mark.parametrize(
    ("space", "size"),
    [*((space, (64, 48)) for space in VARIANTS), *(("box", size) for size in ((33, 17), (1, 1), (4096, 1), (3, 64)))],
)
def test_while_a_clip_plays_only_what_has_changed_is_marched_again(space: str, size: tuple[int, int]) -> None:
    scene, camera, times = VARIANTS[space](tiny_scene(4)), CAMERA.resized(*size), np.linspace(0.4, 0.5, 9)
    renderer, whole = Renderer(gl.context(), scene, FOLLOWING), Renderer(gl.context(), scene)
    wanted = whole.render(camera, 0.5).rgb
    assert psnr(played(renderer, [camera] * 9, times), wanted) > 40
    # Of a picture that is wrong all over everything is marched again, up to every edge.
    target = renderer._target(Part.FULL, size)
    target.framebuffer.clear(9.0, 9.0, 9.0, 9.0)
    target.drawn = module.EVERYWHERE
    assert np.abs(renderer.render(camera, 0.51).rgb - whole.render(camera, 0.51).rgb).max() < 1e-5
    # Pictures after a jump follow, too; at the same time, and of another size, they follow none.
    assert psnr(renderer.render(camera, 0.95).rgb, whole.render(camera, 0.95).rgb) > 40
    for time, other in ((0.95, camera), (0.96, camera.resized(20, 30))):
        assert np.abs(renderer.render(other, time).rgb - whole.render(other, time).rgb).max() < 1e-5


@pytest.mark.parametrize("rung", ["balanced", "fine", "reference"])
def test_what_was_seen_from_far_away_is_whole_from_near(rung: str) -> None:
    """Of a picture's targets, as much is shown as was drawn into them."""
    ctx, scene = gl.context(), tiny_scene(4)
    renderer, shown = Renderer(ctx, scene, LEVELS[rung]), []
    far, near = (
        look_at((24.0, 10.0, 22.0), (0.1, 0.05, 0.05), 64, 48, 70.0),
        look_at((0.9, 0.5, 0.8), (0.1, 0.05, 0.05), 64, 48, 40.0),
    )
    for drawer, cameras in ((renderer, (far, near)), (Renderer(ctx, scene, LEVELS[rung]), (near,))):
        screen = ctx.simple_framebuffer((64, 48), 4)
        for camera in cameras:
            drawer.show(screen, camera, 0.4)
        shown.append(np.frombuffer(screen.read(components=3), np.uint8).astype(int))
    assert renderer._covered(near) is None and (not renderer._is_software or renderer._covered(far) is not None)
    assert np.abs(shown[0] - shown[1]).max() <= 1 and np.ptp(shown[0]) > 50


def test_where_nothing_changes_nothing_but_probes_is_marched() -> None:
    renderer = Renderer(gl.context(), tiny_scene(4), FOLLOWING)
    first, *_, last = (renderer.render(CAMERA, time, part=Part.STATIC).rgb for time in (0.4, 0.41, 0.42, 0.43))
    assert np.abs(last - first).max() < 1e-5 and doubted(renderer) == 0


def test_every_pixel_is_a_probe_by_turns() -> None:
    x, y = np.mgrid[:16, :16].reshape(2, -1)
    seen = np.zeros((62, 63), int)
    for turn in range(16):
        numbers = np.stack([x, y, x, y], 1).astype(np.float32)
        places = gl.evaluate(
            '#include "probes.glsl"\n', f"vec4(probe_of(a.xy, {turn}, vec2(63.0, 62.0)), 0.0, 0.0)", numbers
        )
        column, row = places[:, :2].astype(int).T
        assert (column // 4 == x).all() and (row // 4 == y).all()
        np.add.at(seen, (row, column), 1)
        by_processor = probes_of(turn, 0, 0, 16, 16, (63, 62)).swapaxes(0, 1).reshape(-1, 2)
        np.testing.assert_array_equal(by_processor, np.stack([row, column], 1))
    assert (seen[:60, :60] == 1).all() and (seen > 0).all()


@pytest.mark.parametrize("tiles", [None, module.SPREAD])
def test_every_probe_has_a_texel_of_its_own(tiles: module.Tiles | None) -> None:
    x, y = np.mgrid[:128, :64].reshape(2, -1)
    blocks = np.stack([x, y, x, y], 1).astype(np.float32)
    tile, square = (tiles.tile, tiles.square) if tiles else (module.MORE_THAN_A_RASTER,) * 2
    places = gl.evaluate(
        '#include "tiles.glsl"\n', "vec4(texel_of(a.xy), block_of(texel_of(a.xy)))", blocks, TILE=tile, SQUARE=square
    )
    assert np.array_equal(places[:, 2:], blocks[:, :2]) and len(np.unique(places[:, :2], axis=0)) == 128 * 64
    across, up = tiles.raster((128, 64)) if tiles else (128, 64)
    assert (places[:, :2] < (across, up)).all() and places[:, 0].max() >= across - square


@pytest.mark.parametrize("size", [(64, 48), (170, 90), (321, 1)])
@pytest.mark.parametrize("covered", [False, True])
def test_probes_see_the_same_wherever_they_lie(
    monkeypatch: pytest.MonkeyPatch, size: tuple[int, int], covered: bool
) -> None:
    """Spread over tiles, all of them or those in sight of what is occupied; or side by side."""
    monkeypatch.setattr(module, "MOST_COVERED", float(covered))
    scene, camera, pictures = tiny_scene(4), CAMERA.resized(*size), []
    for tiles in (module.SPREAD, None):
        monkeypatch.setattr(module, "SPREAD", tiles)
        renderer = Renderer(gl.context(), scene, FOLLOWING)
        renderer._is_software = True
        pictures.append(played(renderer, [camera] * 5, np.linspace(0.4, 0.46, 5)))
        assert (renderer._covered(camera) is not None) == covered
    assert np.abs(pictures[0] - pictures[1]).max() < 1e-5 and np.ptp(pictures[0]) > 0.1


def test_nothing_is_left_behind_by_what_moves() -> None:
    """A block of colour that crosses the picture: at no time is much of it where it was before, nor does it stay after the loop."""
    scene = tiny_scene(4, resolution=(48, 40, 32))
    renderer, whole = Renderer(gl.context(), scene, FOLLOWING), Renderer(gl.context(), scene)
    camera, changed = CAMERA.resized(128, 96), 0.0
    first = whole.render(camera, 0.0).rgb
    for time in (*np.linspace(0, 1, 60), *np.linspace(0, 0.2, 12)):
        error = np.abs(
            renderer.render(camera, float(time)).rgb - (wanted := whole.render(camera, float(time)).rgb)
        ).max(axis=2)
        changed = max(changed, float(np.mean(np.abs(wanted - first).max(axis=2) > 8 * TOLERANCE)))
        assert np.mean(error > 2 * TOLERANCE) < 0.02 and np.mean(error > 8 * TOLERANCE) < 0.001, time
    assert changed > 0.05


def test_a_camera_that_moves_takes_the_picture_along() -> None:
    scene, times = tiny_scene(4, resolution=(48, 40, 32)), np.linspace(0.4, 0.5, 12)
    cameras = around(np.arange(12) * 0.02)
    renderer, whole = Renderer(gl.context(), scene, FOLLOWING), Renderer(gl.context(), scene)
    wanted = whole.render(cameras[-1], 0.5).rgb
    assert psnr(played(renderer, cameras, times), wanted) > 40


def test_a_picture_is_predicted_from_where_its_places_were_seen() -> None:
    whole = Renderer(gl.context(), tiny_scene(4, resolution=(48, 40, 32)))
    cameras = [look_at((2.4 + x, 1.0, 2.2 - x), (0.1 + x, 0.05, 0.05 - x), 128, 96, 1000.0) for x in (0.0, 0.02)]
    old, new = (whole._target(Part.FULL, (128, 96), number) for number in (module.PICTURE, module.OTHER_PICTURE))
    before = whole.render(cameras[0], 0.5).rgb
    predicted = module.read(whole._predicted(old, new, *cameras))
    wanted = whole.render(cameras[1], 0.5)
    assert psnr(predicted[0], wanted.rgb) > psnr(before, wanted.rgb) + 10
    both = (predicted[2] > 0.9) & (wanted.opacity > 0.9)
    assert np.median(np.abs(predicted[1] - wanted.depth)[both]) < 0.01 and both.any()


def test_a_camera_that_looks_elsewhere_sees_what_is_there() -> None:
    scene = tiny_scene(4, resolution=(48, 40, 32))
    renderer, whole = Renderer(gl.context(), scene, FOLLOWING), Renderer(gl.context(), scene)
    behind = look_at((-1.8, 1.4, 2.6), (0.1, 0.05, 0.05), 128, 96, 140.0)
    got = played(renderer, [*around(np.zeros(2)), behind], np.array([0.4, 0.41, 0.42]))
    assert psnr(got, whole.render(behind, 0.42).rgb) > 35


def test_a_picture_follows_none_of_another_quality_nor_appearance_nor_of_a_scene_less_refined() -> None:
    scene = with_appearances(tiny_scene(4, scales=3))
    dawn, dusk = (scene.appearance(name) for name in ("dawn.jpg", "dusk.jpg"))
    renderer, whole = Renderer(gl.context(), scene, FOLLOWING), Renderer(gl.context(), scene)

    def differs(time: float, code: np.ndarray) -> float:
        got, wanted = (r.render(CAMERA, time, appearance=code).rgb for r in (renderer, whole))
        return float(np.abs(got - wanted).max())

    assert differs(0.40, dawn) < 1e-5 < differs(0.41, dawn) and differs(0.42, dusk) < 1e-5
    renderer.quality = replace(FOLLOWING, step=2.0)
    renderer.render(CAMERA, 0.43, appearance=dusk)
    renderer.quality = FOLLOWING
    assert differs(0.44, dusk) < 1e-5 < differs(0.45, dusk)
    refined = 0.9 * scene.scales[1]["xy"]
    for r in (renderer, whole):
        r.put(1, "xy", r.layout.texels(refined))
    assert differs(0.46, dusk) < 1e-5 < differs(0.47, dusk)
    scene.scales[0]["xt"][...] *= 0.9
    for r in (renderer, whole):
        r.refresh()
    assert differs(0.48, dusk) < 1e-5 < differs(0.49, dusk)


def test_what_arrives_is_folded_anew() -> None:
    scene, finer = tiny_scene(4), tiny_scene(5)
    renderer = Renderer(gl.context(), scene, Quality(folded=True))
    renderer.render(CAMERA, 0.4)
    for s, scale in enumerate(finer.scales):
        for plane in SPACE_PLANES:
            renderer.put(s, plane, renderer.layout.texels(scale[plane]))
    same_times = [
        {**new, **{p: old[p] for p in TIME_PLANES}} for new, old in zip(finer.scales, scene.scales, strict=True)
    ]
    wanted = Renderer(gl.context(), replace(scene, scales=tuple(same_times)), Quality(folded=True)).render(CAMERA, 0.4)
    assert np.array_equal(renderer.render(CAMERA, 0.4).rgb, wanted.rgb)


def test_what_is_drawn_in_between_is_not_followed() -> None:
    renderer, whole = Renderer(gl.context(), tiny_scene(4), FOLLOWING), Renderer(gl.context(), tiny_scene(4))
    renderer.render(CAMERA, 0.4)
    renderer.quality = Quality()
    renderer.march(CAMERA, 0.4, program="cells.glsl")
    renderer.quality = FOLLOWING
    assert np.abs(renderer.render(CAMERA, 0.41).rgb - whole.render(CAMERA, 0.41).rgb).max() < 1e-5


@pytest.mark.parametrize("others", [module.LATELY - 1, module.LATELY])
def test_a_picture_of_some_time_ago_is_not_followed(others: int) -> None:
    renderer, whole = Renderer(gl.context(), tiny_scene(4), FOLLOWING), Renderer(gl.context(), tiny_scene(4))
    renderer.render(CAMERA, 0.4)
    for k in range(others):
        renderer.render(CAMERA.resized(20, 30), 0.41 + 0.01 * k)
    is_whole = np.abs(renderer.render(CAMERA, 0.5).rgb - whole.render(CAMERA, 0.5).rgb).max() < 1e-5
    assert is_whole == (others >= module.LATELY)


def test_after_a_jump_only_what_follows_badly_is_whole(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(module, "MOST_DOUBTED", 0.0)
    renderer = Renderer(gl.context(), tiny_scene(4), LEVELS["balanced"])
    for time, alone in ((0.1, 0), (0.9, 0), (0.91, module.ALONE_FOR), (0.92, module.ALONE_FOR - 1)):
        renderer.render(CAMERA, time)
        (shot,) = renderer._shots.values()
        assert shot.alone == alone


def test_what_moves_and_what_stays_follow_each_their_own() -> None:
    scene, times = tiny_scene(4), np.linspace(0.4, 0.5, 5)
    renderer, whole = Renderer(gl.context(), scene, FOLLOWING), Renderer(gl.context(), scene)
    for time in times:
        got = renderer.render(CAMERA, float(time), part=Part.DYNAMIC)
    assert psnr(got.rgb, whole.render(CAMERA, 0.5, part=Part.DYNAMIC).rgb) > 38


def test_compute_shaders_follow_the_same_way() -> None:
    ctx, scene, pictures = gl.context(), tiny_scene(4), []
    if ctx.version_code < COMPUTE_VERSION:
        pytest.skip("this OpenGL has no compute shaders")
    for compute in (False, True):
        renderer = Renderer(ctx, scene, FOLLOWING)
        renderer.compute = compute
        pictures.append(played(renderer, [CAMERA.resized(61, 43)] * 9, np.linspace(0.4, 0.5, 9)))
        renderer.check()
    assert psnr(*pictures) > 50


def test_steady_playback_makes_nothing_new() -> None:
    ctx, scene = gl.context(), tiny_scene(4)
    screen, renderer = ctx.simple_framebuffer((64, 48), 4), Renderer(ctx, scene, LEVELS[DEFAULT])
    for n in range(12):
        renderer.show(screen, CAMERA, 0.4 + n / 100)
        if n == 3:
            made = renderer.memory_bytes, set(renderer._programs), set(renderer._targets)
    assert (renderer.memory_bytes, set(renderer._programs), set(renderer._targets)) == made


@pytest.mark.parametrize("software", [True, False])
def test_where_all_is_in_doubt_pictures_are_whole_for_a_while(monkeypatch: pytest.MonkeyPatch, software: bool) -> None:
    monkeypatch.setattr(module, "MOST_DOUBTED", 0.0)
    renderer = Renderer(gl.context(), tiny_scene(4), LEVELS["balanced"])
    whole = Renderer(gl.context(), tiny_scene(4), replace(LEVELS["balanced"], reprojection_tolerance=0.0))
    renderer._is_software = whole._is_software = software
    turns = []
    for k in range(2 + 2 * (module.ALONE_FOR + 1)):
        time = 0.2 + 0.01 * k
        got, wanted = renderer.render(CAMERA, time), whole.render(CAMERA, time)
        (shot,) = renderer._shots.values()
        turns.append(shot.turn)
        if shot.turn == 0:
            np.testing.assert_array_equal(got.rgb, wanted.rgb)
    assert (turns == [0, *([1] + module.ALONE_FOR * [0]) * 2, 1]) == software
    assert software or turns == list(range(len(turns)))


# --- coarse to fine


@pytest.mark.parametrize("size", [(128, 96), (127, 61), (16, 200), (1, 1), (4096, 1), (9, 8)])
@pytest.mark.parametrize("software", [True, False])
def test_interpolated_pixels_are_off_by_no_more_than_may_be(size: tuple[int, int], software: bool) -> None:
    scene, camera = tiny_scene(4), replace(CAMERA.resized(*size), fl_x=140.0, fl_y=140.0)
    pictures, shares = {}, {}
    blurs = (0.0, 1e-6, 0.002, 0.01, 1.0)
    for blur in blurs:
        renderer = Renderer(gl.context(), scene, Quality(interpolation_tolerance=blur))
        renderer._is_software, draw = software, renderer._draw_alone
        renderer._draw_alone = lambda *args, blur=blur, draw=draw: shares.setdefault(blur, draw(*args))
        pictures[blur] = renderer.render(camera, 0.4)
        coarse = [key for key in renderer._targets if key[2] == module.COARSE]
        assert bool(coarse) == (blur > 0 and min(size) >= 2 * module.BLOCK)
    whole = pictures[0.0]
    if min(size) < 2 * module.BLOCK:
        assert all(np.array_equal(each.rgb, whole.rgb) for each in pictures.values())
        return
    off = {blur: np.sqrt(np.mean((each.rgb - whole.rgb) ** 2)) for blur, each in pictures.items()}
    # Cells end this scene abruptly: of edges so sharp bends tell less than half, and slivers are met by no coarser ray at all.
    assert all(off[blur] < 4 * blur + 1.5e-3 for blur in blurs)
    assert list(off.values()) == sorted(off.values()) and all(
        shares[more] <= shares[less] for less, more in zip(blurs[1:], blurs[2:])
    )
    assert off[1.0] > 4 * off[0.002] and (not software or shares[1e-6] > 2 * shares[1.0])
    assert np.abs(pictures[0.01].opacity - whole.opacity).mean() < 0.01


@pytest.mark.parametrize("size", [(40, 28), (41, 27), (8, 9)])
def test_how_far_blocks_are_off_is_told_by_bends(size: tuple[int, int]) -> None:
    renderer, few = Renderer(gl.context(), tiny_scene(4)), tuple(-(-side // 2) for side in size)
    blocks = tuple(-(-side // 4) for side in size)
    rays, missed = renderer._target(Part.FULL, few, module.COARSE), renderer._target(Part.FULL, blocks, module.DOUBTS)
    colours = np.random.default_rng(7).random((few[1], few[0], 4), np.float32)
    rays.seen.write(colours)
    rays.seen.use(module.SEEN_UNIT)
    bent, vertices = renderer._program("bent.glsl", renderer.layout)
    module._set(bent, seen_coarse=module.SEEN_UNIT, size=tuple(map(float, size)))
    renderer._draw(missed.framebuffer, vertices)
    got = np.frombuffer(missed.seen.read(), np.float32).reshape(blocks[1], blocks[0], 4)

    padded = np.pad(colours[..., :3].astype(float), ((1, 1), (1, 1), (0, 0)), "edge")
    here = padded[1:-1, 1:-1]
    bends = np.abs(padded[1:-1, :-2] + padded[1:-1, 2:] - 2 * here) + np.abs(
        padded[:-2, 1:-1] + padded[2:, 1:-1] - 2 * here
    )
    columns, rows = (
        np.minimum((2 * np.arange(2 * n) + 1) * fewer // side, fewer - 1) for n, fewer, side in zip(blocks, few, size)
    )
    squares = np.mean((bends / 8) ** 2, axis=2)[rows[:, None], columns]
    wanted = squares.reshape(blocks[1], 2, blocks[0], 2).mean((1, 3))
    np.testing.assert_allclose(got, np.repeat(wanted[..., None], 4, axis=2), rtol=1e-4)


def test_what_was_drawn_before_is_gone() -> None:
    """A processor draws, and empties, only where there is something."""
    scene = tiny_scene(4, resolution=(33, 17, 17))
    renderer, blurred = (
        Renderer(gl.context(), scene, Quality(reprojection_tolerance=0.02)),
        Quality(interpolation_tolerance=0.005),
    )
    for number, away in enumerate(((2.0, 1.0), (-3.0, 4.0), (0.5, -9.0), (6.0, 2.0))):
        camera = look_at((away[0], away[1], 3.0), (0.1 * number - 0.2, 0.0, 0.0), 96, 64, 70.0)
        for quality in (blurred, Quality(reprojection_tolerance=0.02), blurred):
            renderer.quality = quality
            for time in (0.3, 0.31):
                alone = Renderer(gl.context(), scene, replace(quality, reprojection_tolerance=0.0))
                alone._covered = lambda camera: None  # all of the picture
                assert psnr(renderer.render(camera, time).rgb, alone.render(camera, time).rgb) > (
                    60 if quality is blurred else 40
                )

    shown = []
    for screen in (gl.context().simple_framebuffer((201, 97)), gl.context().simple_framebuffer((201, 97))):
        renderer, cameras = (
            Renderer(gl.context(), scene, blurred),
            [look_at((x, 1.0, 3.0), (0.3, 0.2, 0.0), 96, 64, 70.0) for x in (9.0, -2.0, 2.0)],
        )
        if shown:  # all of it, and nothing before
            renderer._covered, cameras = lambda camera: None, cameras[-1:]
        for camera in cameras:
            renderer.show(screen, camera, 0.3)
        shown.append(np.frombuffer(screen.read(), np.uint8).astype(int))
    assert np.abs(shown[0] - shown[1]).max() <= 1 and len(np.unique(shown[0])) > 50


def test_each_texel_is_met_by_a_ray() -> None:
    """A picture with less than a ray a texel goes before none."""
    scene = tiny_scene(4, resolution=(33, 17, 17))
    renderer, texel, middle = (
        Renderer(gl.context(), scene, Quality(interpolation_tolerance=2.0)),
        scene.extent / 32,
        scene.aabb.mean(0),
    )
    for texels, coarser in ((0.51, 0), (0.49, 1), (0.26, 1), (0.24, 2)):
        camera = look_at(tuple(middle + np.array([0, 0, 100 * texels * texel])), tuple(middle), 64, 48, 70.0)
        renderer.render(replace(camera, fl_x=100.0, fl_y=100.0), 0.5)
        assert sum(key[2] == module.COARSE for key in renderer._targets) == coarser
        renderer._targets.clear()


@pytest.mark.parametrize("space", ["contracted", "ndc"])
def test_where_space_is_mapped_texels_are_counted_along_a_ray(space: str) -> None:
    scene = VARIANTS[space](tiny_scene(4))
    renderer, whole = (
        Renderer(gl.context(), scene, Quality(interpolation_tolerance=0.0005)),
        Renderer(gl.context(), scene),
    )
    once, twice = (module.texels_spanned(scene, CAMERA.resized(64 * k, 48 * k)) for k in (1, 2))
    assert 0.1 < once < 0.5 and twice == pytest.approx(once / 2, rel=0.01)  # tiny scenes have 8 to 12 texels across
    camera = CAMERA.resized(128, 96)
    assert psnr(renderer.render(camera, 0.5).rgb, whole.render(camera, 0.5).rgb) > 50
    assert any(key[2] == module.COARSE for key in renderer._targets)


# --- what is far away


@pytest.mark.parametrize("compute", [False, True])
def test_what_is_far_away_is_a_mean_of_rays(compute: bool) -> None:
    ctx, scene = gl.context(), tiny_scene(4, resolution=(96, 80, 64))
    if compute and ctx.version_code < COMPUTE_VERSION:
        pytest.skip("this OpenGL has no compute shaders")
    camera = look_at((24.0, 10.0, 22.0), (0.1, 0.05, 0.05), 32, 24, 70.0)
    many = render(scene, camera.resized(32 * 12, 24 * 12), 0.62).rgb.reshape(24, 12, 32, 12, 3).mean((1, 3))
    errors = {}
    for across in (1, 2, 4):
        renderer = Renderer(ctx, scene, Quality(rays_across=across))
        renderer.compute = compute
        assert renderer.rays_across(camera) == across
        errors[across] = np.abs(renderer.render(camera, 0.62).rgb - many).mean()
    assert errors[4] < 0.5 * errors[2] < 0.5 * 0.7 * errors[1]


def test_rays_a_pixel_follow_what_it_spans(monkeypatch: pytest.MonkeyPatch) -> None:
    scene = tiny_scene(4, resolution=(33, 17, 17))
    renderer, middle = Renderer(gl.context(), scene, Quality(rays_across=4)), scene.aabb.mean(0)
    texel = scene.extent / 32
    for texels, across in ((0.5, 1), (1.9, 1), (2.1, 2), (3.1, 3), (50, 4)):
        away = 100 * texels * texel  # a pixel is a hundredth of the distance
        camera = look_at(tuple(middle + np.array([0, 0, away])), tuple(middle), 64, 48, 70.0)
        camera = replace(camera, fl_x=100.0, fl_y=100.0)
        assert renderer.rays_across(camera) == across
    monkeypatch.setattr(module, "PIXELS_MARCHED", 64 * 48 * 5)
    assert renderer.rays_across(camera) == 2
    renderer.quality = Quality()
    assert renderer.rays_across(camera) == 1
    for space in ("contracted", "ndc"):
        assert Renderer(gl.context(), VARIANTS[space](tiny_scene(4)), Quality(rays_across=4)).rays_across(camera) == 1


# --- shared look-ups, scales, extremes


def fog(density: float, step: float = 0.04) -> Scene:
    """Everywhere of the same density, per longest edge of the box; with surroundings, in them too."""
    scene = tiny_scene(4, dynamic=False)
    even = replace(
        scene.decoder, density_weight=np.zeros_like(scene.decoder.density_weight), density_bias=float(np.log(density))
    )
    return replace(scene, decoder=even, step=step, occupancy=np.ones_like(scene.occupancy))


@pytest.mark.parametrize("density", [1e-10, 1e-3, 1.0, 100.0, 1e10])
@pytest.mark.parametrize("step", [0.04, 0.0007])
def test_fog_of_any_density_against_float64(density: float, step: float) -> None:
    """Up to thousands of samples; from within the box, from far outside, and along an axis. The product of n factors errs by
    n 2^-24; rays end with their transmittance at the termination."""
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
            quality = replace(
                LEVELS[name], rays_across=1
            )  # the ray in the middle of a pixel that sees more than the box
            got = Renderer(gl.context(), scene, quality).render(camera, 0.0).opacity[0, 0]
            error = 1e-6 + samples * 2.0**-22 + density * step / size.max() * left * 2
            expected = 1.0 if quality.termination > TERMINATION and left < quality.termination else 1 - left
            spent = TERMINATION if left < TERMINATION else 0.0
            near_end = quality.termination if abs(left - quality.termination) < 2 * error else 0.0
            assert abs(got - expected) <= error + spent + near_end, (name, eye, got, expected)


@pytest.mark.parametrize("edges", [(0.0, 1.0, 1.0), (1.0, 1.0, 1e-6)])
def test_boxes_without_a_volume_show_the_background(edges: tuple[float, float, float]) -> None:
    scene = replace(tiny_scene(4), aabb=np.array([[0, 0, 0], edges], np.float32))
    for name, quality in LEVELS.items():
        got = Renderer(gl.context(), scene, quality).render(CAMERA, 1.0)
        assert np.isfinite(got.rgb).all() and np.abs(got.rgb - scene.background).max() < 0.02, name


def test_folded_planes_in_half_floats_are_near_those_in_floats(monkeypatch: pytest.MonkeyPatch) -> None:
    """On graphics cards; a processor is told here that it is one."""
    ctx, scene = gl.context(), tiny_scene(4)
    exact = Renderer(ctx, scene, LEVELS["finer"])
    exact.casts = False
    monkeypatch.setattr(module, "is_software", lambda ctx: False)
    half = Renderer(ctx, scene, LEVELS["finer"], compute=False)
    assert (exact.plane_dtype, half.plane_dtype) == ("f4", "f2")
    wanted, found = exact.render(CAMERA, 0.4).rgb, half.render(CAMERA, 0.4).rgb
    assert half.memory_bytes < exact.memory_bytes and not np.array_equal(found, wanted)
    assert np.abs(found - wanted).max() < 0.01
    # What float16 cannot hold is cut off, not infinite.
    bright = replace(
        scene, scales=tuple({name: 1e4 * plane for name, plane in scale.items()} for scale in scene.scales)
    )
    assert np.isfinite(Renderer(ctx, bright, LEVELS["finer"], compute=False).render(CAMERA, 0.4).rgb).all()
