"""What pictures show: the scene by one of two renderers, its background, what moves, and the mean of many samples."""

import argparse
import functools
from collections.abc import Callable, Iterable, Sequence
from dataclasses import replace

import numpy as np

from kpc.format.common.errors import UsageError
from kpc.format.common.images import linear_from_srgb, srgb_from_linear
from kpc.format.common.progress import in_parts, part
from kpc.format.common.text import notice
from kpc.format.container.groups import GroupedScene
from kpc.format.scene.cameras import Camera
from kpc.format.scene.scene import Clip, Scene
from kpc.player.cpu import reference
from kpc.player.cpu.reference import Rendering
from kpc.player.quality import LEVELS
from kpc.tools.rendering.appearances import appearance_in
from kpc.tools.rendering.bands import in_bands
from kpc.tools.rendering.clean_plate import CleanPlates, matte, motion_colours
from kpc.tools.rendering.composition import in_depth_order, played_clip, same_moment

# Renders a camera's picture at a time in [0, 1] over the clip.
Render = Callable[[Camera, float], Rendering]
# Pixels that are drawn at once by OpenGL in software, within a second; smaller bands would take more time in all.
SOFTWARE_PIXELS = 1 << 15
# Contents that are drawn over black, not over the scene's background.
BLACK_BEHIND = ("moving", "matte")
BLACK = np.zeros(3, np.float32)
# Scenes, times in them and shares, as `Scene.blend_at` returns them.
Blended = list[tuple[Scene, float, float]]
# Draws a scene, one of those needed at a time of the clip, at a time of its own, with an appearance or the average.
Draw = Callable[[Scene, Camera, float, Sequence[Scene], np.ndarray | None], Rendering]


def renderer_of(
    loaded: Scene | GroupedScene,
    options: argparse.Namespace,
    times: Iterable[float],
    say: Callable[[str], None] = notice,
    others: Sequence[Scene | GroupedScene] = (),
) -> tuple[Render, str]:
    """Return a function that renders a picture over the background of the options, and the name of the renderer.

    With a transparent background colours are multiplied by opacity. The appearance of the options is looked for in all
    that is shown at these times before anything is rendered; `say` is called with what users should know of it. Other
    clips that begin together with this one are drawn whole, with their average appearance. Times are in [0, 1] over
    `played_clip` of all of them.
    """
    if options.backend == "reference" and options.quality != "reference":
        raise UsageError(f"--quality {options.quality}: is of the gl backend; leave it out, or --backend reference")
    chosen = appearance_in(loaded, options.appearance, times, say)
    make_drawing = _reference_drawing if options.backend == "reference" else _gl_drawing
    draw, name = make_drawing(options)
    needed: list[Scene] = []
    played = played_clip(loaded.clip, [other.clip for other in others])
    is_over_black = options.content in BLACK_BEHIND
    background = BLACK if others else options.background

    def drawn(scene: Scene, camera: Camera, time: float) -> Rendering:
        return draw(scene, camera, time, needed, chosen(scene))

    plates = CleanPlates(drawn)

    def shown(scene: Scene, camera: Camera, time: float) -> Rendering:
        if options.content == "plate":
            return plates.of(scene, camera)
        if options.content is None:
            return drawn(scene, camera, time)
        count = plates.pictures_of(scene, camera)
        with part(count / (count + 1)):
            plate = plates.of(scene, camera)
        with part(1 / (count + 1)):
            picture = drawn(scene, camera, time)
        return _what_moves(scene, picture, matte(picture, plate), options.content)

    def render(camera: Camera, time: float) -> Rendering:
        (parts, *beside), pictures = _blended([loaded, *others], played, time), []
        needed[:] = [scene for blended in (parts, *beside) for scene, *_ in blended]
        for scene, local_time, share in in_parts(parts):
            picture = shown(scene, camera, local_time)
            if background is not None:
                picture = _over(picture, BLACK if is_over_black else scene.background, background)
            pictures.append((picture, share))
        return reference.blend(pictures)

    def drawn_whole(blended: Blended, camera: Camera) -> Rendering:
        pictures = [(scene, draw(scene, camera, at, needed, None), share) for scene, at, share in blended]
        return reference.blend([(_over(picture, scene.background, BLACK), share) for scene, picture, share in pictures])

    def render_together(camera: Camera, time: float) -> Rendering:
        parts, *beside = _blended([loaded, *others], played, time)
        whole = [functools.partial(drawn_whole, blended, camera) for blended in beside]
        layers = [draw_layer() for draw_layer in in_parts([functools.partial(render, camera, time), *whole])]
        behind = options.background
        if behind is None:
            own = np.sum([share * scene.background for scene, _, share in parts], axis=0)
            behind = BLACK if is_over_black else own
        return _over(in_depth_order(layers), BLACK, behind)

    return render_together if others else render, name


def _blended(clips: Sequence[Scene | GroupedScene], played: Clip, time: float) -> list[Blended]:
    """Return what is blended of each of several clips, which begin together, at a time over the one that is played."""
    return [clip.blend_at(same_moment(time, played, clip.clip)) for clip in clips]


def _over(picture: Rendering, behind: np.ndarray, background: np.ndarray) -> Rendering:
    """Put another background, (3,), in the place of the one that is behind a picture."""
    uncovered = (1 - picture.opacity)[..., None]
    return replace(picture, rgb=picture.rgb + uncovered * (background - behind))


def _what_moves(scene: Scene, picture: Rendering, share: np.ndarray, content: str) -> Rendering:
    """Show of a picture what moves, given how much of each pixel does: as a map, a matte, or cut out over black."""
    if content == "map":
        return motion_colours(picture, share)
    if content == "matte":
        return replace(picture, rgb=np.repeat(share[..., None], 3, axis=2), opacity=share)
    covering = picture.rgb - (1 - picture.opacity)[..., None] * scene.background
    return replace(picture, rgb=share[..., None] * covering, opacity=share * picture.opacity)


def _gl_drawing(options: argparse.Namespace) -> tuple[Draw, str]:
    from kpc.player.gl import offscreen  # here, since the reference backend works without moderngl
    from kpc.player.gl.programs import is_software
    from kpc.player.gl.renderer import Renderer

    ctx = offscreen.open_context()
    is_slow = is_software(ctx) and not LEVELS[options.quality].folded  # pixels of other levels depend on others
    renderers: list[Renderer] = []

    def draw(
        scene: Scene, camera: Camera, time: float, needed: Sequence[Scene], appearance: np.ndarray | None
    ) -> Rendering:
        for unused in [one for one in renderers if all(one.scene is not other for other in needed)]:
            unused.release()
            renderers.remove(unused)
        renderer = next((one for one in renderers if one.scene is scene), None)
        if renderer is None:
            renderers.append(renderer := Renderer(ctx, scene, LEVELS[options.quality]))

        def drawn(camera: Camera) -> Rendering:
            return renderer.render(camera, time, part=options.part, appearance=appearance)

        return in_bands(drawn, camera, SOFTWARE_PIXELS) if is_slow else drawn(camera)

    return draw, offscreen.describe(ctx)


def _reference_drawing(options: argparse.Namespace) -> tuple[Draw, str]:
    def draw(
        scene: Scene, camera: Camera, time: float, needed: Sequence[Scene], appearance: np.ndarray | None
    ) -> Rendering:
        def drawn(camera: Camera) -> Rendering:
            return reference.render(scene, camera, time, part=options.part, appearance=appearance)

        return in_bands(drawn, camera, reference.RAYS_AT_ONCE)

    return draw, "reference renderer (numpy)"


def mean_picture(
    render: Render, instants: Sequence[tuple[Camera, float]], samples: int, is_transparent: bool
) -> Rendering:
    """Render a picture as the mean, in linear light, of several instants and of several samples a pixel.

    Depth is not averaged, which would invent surfaces between near and far ones: it is that of one sample, at the
    middle of the pixel or beside it, and of the middle instant.

    Args:
        render: renders one instant.
        instants: cameras and times.
        samples: along each side of a pixel.
        is_transparent: whether colours are multiplied by opacity.
    """
    if len(instants) == 1 and samples == 1:
        return render(*instants[0])
    light: list[np.ndarray] = []
    opacity: list[np.ndarray] = []
    middle, total = None, 0
    for number, (camera, time) in enumerate(in_parts(instants)):
        width, height = camera.width * samples, camera.height * samples
        fine = render(camera.resized(width, height) if samples > 1 else camera, time)
        cells = camera.height, samples, camera.width, samples
        light.append(linear_colours(fine, is_transparent).reshape(*cells, 3).mean(axis=(1, 3)))
        opacity.append(fine.opacity.reshape(cells).mean(axis=(1, 3)))
        total = total + fine.samples.reshape(cells).sum(axis=(1, 3))
        if number == len(instants) // 2:
            middle = fine.depth[samples // 2 :: samples, samples // 2 :: samples]
    assert middle is not None
    mean, mean_opacity = np.mean(light, axis=0), np.mean(opacity, axis=0)
    covered = np.maximum(mean_opacity, 1e-12)[..., None] if is_transparent else 1.0
    rgb = srgb_from_linear(mean / covered) * (mean_opacity[..., None] if is_transparent else 1.0)
    return Rendering(rgb.astype(np.float32), middle, mean_opacity.astype(np.float32), np.asarray(total))


def straight_colours(picture: Rendering) -> np.ndarray:
    """Divide colours that are multiplied by opacity by it, (H, W, 3) in [0, 1]; 0 where nothing is."""
    opacity = picture.opacity[..., None]
    divided = np.divide(picture.rgb, opacity, out=np.zeros_like(picture.rgb), where=opacity > 1e-6)
    return np.clip(divided, 0, 1)


def linear_colours(picture: Rendering, is_transparent: bool) -> np.ndarray:
    """Return colours in linear light by the inverse sRGB curve, (H, W, 3) float64; multiplied by opacity if the
    picture's are."""
    rgb = np.clip(straight_colours(picture) if is_transparent else picture.rgb, 0, 1).astype(np.float64)
    linear = linear_from_srgb(rgb)
    return linear * picture.opacity[..., None] if is_transparent else linear
