"""Warming up of the processor's renderer, after which all of its kernels are compiled or loaded.

As a program it reads a pickled scene from its standard input, `python -m kpc.player.cpu.kernel_warm_up`, and so fills
numba's cache for another process.
"""

import contextlib
import os
import pickle
import sys
from dataclasses import replace

import numpy as np

from kpc.format.scene.rig import Rig
from kpc.format.scene.scene import Scene
from kpc.player.atlas import Layout
from kpc.player.cpu.cpu_renderer import ProcessorRenderer
from kpc.player.cpu.reference import appearance_code
from kpc.player.quality import LEVELS

# (width, height) of the pictures, and a factor of the focal length so that pixels are smaller than texels: else no
# picture is drawn coarse to fine.
SIZE, ZOOM = (64, 48), 64.0
# Pictures in a row at each level, each predicted from the one before it.
PICTURES = 3
# How much lower the priority of the program is than that of the window.
NICENESS = 5


def warm_up_kernels(scene: Scene) -> None:
    """Draw small pictures of a scene at all levels that the processor draws."""
    layout = Layout.of(scene)
    atlas = np.zeros((*layout.size[::-1], 4), np.float32)
    renderer = ProcessorRenderer(scene, layout, lambda: atlas)
    camera, code = Rig.of(scene).cameras[0].resized(*SIZE), appearance_code(scene, None)
    camera = replace(camera, fl_x=ZOOM * camera.fl_x, fl_y=ZOOM * camera.fl_y)
    for quality in LEVELS.values():
        for number in range(PICTURES if quality.folded else 0):
            pose = camera.camera_to_world.copy()
            pose[:3, 3] += 1e-3 * scene.extent * number
            view, time = replace(camera, camera_to_world=pose), 0.01 * number
            renderer.draw(view, time, quality, code, is_moving=scene.is_dynamic)
            renderer.draw(view, time, quality, code, is_moving=False)


if __name__ == "__main__":
    with contextlib.suppress(AttributeError, OSError):
        os.nice(NICENESS)
    warm_up_kernels(pickle.load(sys.stdin.buffer))
