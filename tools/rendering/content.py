"""What pictures show: the scene by one of two renderers, its background, what moves, and the mean of many samples."""

import argparse
from collections.abc import Callable, Iterable, Sequence
from dataclasses import replace

import numpy as np

from kpc.format.common.errors import UsageError
from kpc.format.common.images import linear_from_srgb, srgb_from_linear
from kpc.format.common.progress import in_parts, part
from kpc.format.common.text import notice
from kpc.format.container.groups import GroupedScene
from kpc.format.scene.cameras import Camera
from kpc.format.scene.scene import Scene
from kpc.player.cpu import reference
from kpc.player.cpu.reference import Rendering
from kpc.player.quality import LEVELS
from kpc.tools.rendering.appearances import Chosen, appearance_in
from kpc.tools.rendering.bands import in_bands
from kpc.tools.rendering.clean_plate import CleanPlates, matte, motion_colours

# Renders a camera's picture at a time in [0, 1] over the clip.
Render = Callable[[Camera, float], Rendering]
# Pixels that are drawn at once by OpenGL in software, within a second; smaller bands would take more time in all.
SOFTWARE_PIXELS = 1 << 15
# Contents that are drawn over black, not over the scene's background.
BLACK_BEHIND = ("moving", "matte")
# Draws a scene, one of those needed at a time of the clip, at a time of its own.
Draw = Callable[[Scene, Camera, float, Sequence[Scene]], Rendering]


def renderer_of(
    loaded: Scene | GroupedScene,
    options: argparse.Namespace,
    times: Iterable[float],
    say: Callable[[str], None] = notice,
) -> tuple[Render, str]:
    """Return a function that renders a picture over the background of the options, and the name of the renderer.

    With a transparent background colours are multiplied by opacity. The appearance of the options is looked for in all
    that is shown at these times before anything is rendered; `say` is called with what users should know of it.
    """
    if options.backend == "reference" and options.quality != "reference":
        raise UsageError(f"--quality {options.quality}: is of the gl backend; leave it out, or --backend reference")
    chosen = appearance_in(loaded, options.appearance, times, say)
    make_drawing = _reference_drawing if options.backend == "reference" else _gl_drawing
    draw, name = make_drawing(options, chosen)
    needed: list[Scene] = []
    plates = CleanPlates(lambda scene, camera, time: draw(scene, camera, time, needed))

    def render(camera: Camera, time: float) -> Rendering:
        parts, pictures = loaded.blend_at(time), []
        needed[:] = [scene for scene, *_ in parts]
        for scene, local_time, share in in_parts(parts):
            if options.content == "plate":
                picture = plates.of(scene, camera)
            elif options.content is None:
                picture = draw(scene, camera, local_time, needed)
            else:
                count = plates.pictures_of(scene, camera)
                with part(count / (count + 1)):
                    plate = plates.of(scene, camera)
                with part(1 / (count + 1)):
                    picture = draw(scene, camera, local_time, needed)
                picture = _what_moves(scene, picture, matte(picture, plate), options.content)
            if options.background is not None:
                uncovered = (1 - picture.opacity)[..., None]
                behind = np.zeros(3, np.float32) if options.content in BLACK_BEHIND else scene.background
                picture = replace(picture, rgb=picture.rgb + uncovered * (options.background - behind))
            pictures.append((picture, share))
        return reference.blend(pictures)

    return render, name


def _what_moves(scene: Scene, picture: Rendering, share: np.ndarray, content: str) -> Rendering:
    """Show of a picture what moves, given how much of each pixel does: as a map, a matte, or cut out over black."""
    if content == "map":
        return motion_colours(picture, share)
    if content == "matte":
        return replace(picture, rgb=np.repeat(share[..., None], 3, axis=2), opacity=share)
    covering = picture.rgb - (1 - picture.opacity)[..., None] * scene.background
    return replace(picture, rgb=share[..., None] * covering, opacity=share * picture.opacity)


def _gl_drawing(options: argparse.Namespace, chosen: Chosen) -> tuple[Draw, str]:
    from kpc.player.gl import offscreen  # here, since the reference backend works without moderngl
    from kpc.player.gl.programs import is_software
    from kpc.player.gl.renderer import Renderer

    ctx = offscreen.open_context()
    is_slow = is_software(ctx) and not LEVELS[options.quality].folded  # pixels of other levels depend on others
    renderers: list[Renderer] = []

    def draw(scene: Scene, camera: Camera, time: float, needed: Sequence[Scene]) -> Rendering:
        for unused in [one for one in renderers if all(one.scene is not other for other in needed)]:
            unused.release()
            renderers.remove(unused)
        renderer = next((one for one in renderers if one.scene is scene), None)
        if renderer is None:
            renderers.append(renderer := Renderer(ctx, scene, LEVELS[options.quality]))
        appearance = chosen(scene)

        def drawn(camera: Camera) -> Rendering:
            return renderer.render(camera, time, part=options.part, appearance=appearance)

        return in_bands(drawn, camera, SOFTWARE_PIXELS) if is_slow else drawn(camera)

    return draw, offscreen.describe(ctx)


def _reference_drawing(options: argparse.Namespace, chosen: Chosen) -> tuple[Draw, str]:
    def draw(scene: Scene, camera: Camera, time: float, needed: Sequence[Scene]) -> Rendering:
        appearance = chosen(scene)

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
