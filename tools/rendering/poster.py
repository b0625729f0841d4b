"""The picture that stands for a scene before it plays: its opening view, in the shape that players have by default."""

import argparse

import numpy as np

from kpc.format.common.errors import DisplayError
from kpc.format.container.groups import GroupedScene
from kpc.format.scene.rig import Rig
from kpc.format.scene.scene import Scene
from kpc.format.scene.view_limits import OPENING_ASPECT
from kpc.player.cpu.reference import Part
from kpc.player.viewpoints import fit_camera
from kpc.tools.rendering.content import renderer_of

# Width in pixels; without OpenGL, where a picture of that size takes minutes.
SIDE, SLOW_SIDE = 1200, 480


def render_poster(loaded: Scene | GroupedScene) -> np.ndarray:
    """Render the view that a scene opens with, at the time that it opens with.

    Returns:
        (H, W, 3) uint8.
    """
    scene, _ = loaded.at(0.0)
    opening = scene.metadata.opening
    camera, time = (Rig.of(scene).cameras[0], 0.0) if opening is None else (opening.camera, opening.time)
    options = argparse.Namespace(
        appearance=None, backend="gl", quality="reference", content=None, background=None, part=Part.FULL
    )
    try:
        render, _ = renderer_of(loaded, options, [time])
        side = SIDE
    except DisplayError:
        options.backend = "reference"
        render, _ = renderer_of(loaded, options, [time])
        side = SLOW_SIDE
    picture = render(fit_camera(camera, side, round(side / OPENING_ASPECT)), time)
    return np.round(np.clip(picture.rgb, 0, 1) * 255).astype(np.uint8)
