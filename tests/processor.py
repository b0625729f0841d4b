"""The processor's renderer for tests, without OpenGL."""

import numpy as np

from kpc.format.scene.cameras import Camera
from kpc.format.scene.scene import Scene
from kpc.player.atlas import Layout
from kpc.player.cpu.cpu_renderer import ProcessorRenderer
from kpc.player.cpu.reference import appearance_code
from kpc.player.quality import Quality


def atlas_of(scene: Scene) -> np.ndarray:
    """(height, width, 4) float32: the space planes of a scene as `Layout.of` packs them."""
    layout = Layout.of(scene)
    atlas = np.zeros((*layout.size[::-1], 4), np.float32)
    for block in layout.blocks:
        texels = layout.texels(scene.scales[block.scale][block.plane])
        atlas[block.y : block.y + texels.shape[0], block.x : block.x + texels.shape[1]] = texels
    return atlas


def processor_of(scene: Scene) -> ProcessorRenderer:
    return ProcessorRenderer(scene, Layout.of(scene), lambda: atlas_of(scene))


def draw(
    renderer: ProcessorRenderer,
    camera: Camera,
    time: float,
    quality: Quality,
    *,
    is_moving: bool = True,
    appearance: np.ndarray | None = None,
) -> np.ndarray:
    """(H, W, 4) float32: a copy of the picture's rgba, the top row first."""
    code = appearance_code(renderer.scene, appearance)
    return renderer.draw(camera, time, quality, code, is_moving=is_moving).rgba[::-1].copy()


def psnr(a: np.ndarray, b: np.ndarray) -> float:
    """Peak signal-to-noise ratio of the colours of two pictures, dB."""
    return float(-10 * np.log10(max(np.mean((a[..., :3] - b[..., :3]) ** 2), 1e-12)))
