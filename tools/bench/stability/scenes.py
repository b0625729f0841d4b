"""The scene that sweeps change, its picture in float64, and in everything that draws.

Its planes are smooth, and its density falls towards the faces of the box, so that a sample more or less at a face,
which rounding decides, is not seen.
"""

from collections.abc import Callable
from dataclasses import replace
from functools import cache

import moderngl
import numpy as np
import torch

from kpc.encoder.evaluation.evaluate import SceneRenderer
from kpc.encoder.field.field import Field
from kpc.encoder.field.render import Rays, render_reference
from kpc.format.common.errors import DisplayError
from kpc.format.scene.cameras import Camera
from kpc.format.scene.rig import look_at
from kpc.format.scene.scene import ALL_PLANES, SPACE_PLANES, Clip, Decoder, Scene
from kpc.format.scene.space import DeviceCoordinates
from kpc.player.cpu import reference
from kpc.player.gl.offscreen import describe, open_context
from kpc.player.gl.renderer import Renderer
from kpc.player.quality import LEVELS, Quality

CHANNELS, HIDDEN = 4, 4
# Width and height of pictures, and the log density in the middle of the box and at its faces.
SIZE, DENSE, THIN = (12, 9), 2.5, -7.0
FINEST = replace(LEVELS["finer"], rays_across=1)

Draw = Callable[[Scene, Camera, float], np.ndarray]


def soft_scene(
    resolution: tuple[int, int, int] = (12, 10, 8), rows: int = 6, samples: int = 60, log_density: float = 0.0
) -> Scene:
    """Return a scene in the box [-1/2, 1/2]^3.

    Args:
        resolution: texels along x, y and z.
        rows: of the time planes; 0 for a static scene.
        samples: along an edge of the box.
        log_density: is added to that of all samples.
    """
    rng = np.random.default_rng(0)
    size = dict(zip("xyzt", (*resolution, rows), strict=True))
    planes = {}
    for name in ALL_PLANES if rows else SPACE_PLANES:
        across, along = (np.linspace(0, 1, size[axis]) for axis in name)
        waves = 1 + 0.4 * np.sin(
            np.pi * (rng.uniform(1, 2, CHANNELS) * across[:, None] + rng.uniform(0, 2, CHANNELS))
            + np.pi * rng.uniform(1, 2, CHANNELS) * along[:, None, None]
        )
        if "t" not in name:  # the first channel is the density's: 0 at the faces of the box
            waves[..., 0] = np.sin(np.pi * along)[:, None] * np.sin(np.pi * across)
        planes[name] = waves.astype(np.float32)
    decoder = Decoder(
        density_weight=np.array([DENSE - THIN, 0, 0, 0], np.float32),
        density_bias=THIN + log_density,
        w1=rng.normal(0, 0.5, (HIDDEN, 9)).astype(np.float32),
        b1=rng.normal(0, 0.5, HIDDEN).astype(np.float32),
        w2=rng.normal(0, 0.7, (3, CHANNELS, HIDDEN)).astype(np.float32),
        b2=rng.normal(0, 0.7, (3, CHANNELS)).astype(np.float32),
    )
    return Scene(
        aabb=np.array([[-0.5] * 3, [0.5] * 3], np.float32),
        clip=Clip(max(rows, 1), 10.0),
        scales=(planes,),
        decoder=decoder,
        occupancy=np.ones((1, 4, 4, 4), bool),
        background=np.array([0.9, 0.5, 0.1], np.float32),
        step=1 / samples,
    )


def camera_at(eye: np.ndarray, target: np.ndarray, half_width: float = 0.4, size: tuple[int, int] = SIZE) -> Camera:
    """Return a camera that looks at a target, at whose distance its picture is two `half_width` wide, z being up."""
    offset = np.asarray(eye, np.float64) - target
    distance = np.linalg.norm(offset)
    up = np.array([0.0, 0, 1]) if abs(offset[2]) < 0.9 * distance else np.array([0.0, 1, 0])
    pose = look_at(eye, target, up)
    focal = size[0] / 2 * float(distance) / half_width
    return Camera(*size, focal, focal, size[0] / 2, size[1] / 2, pose)


OUTSIDE = camera_at(np.array([1.1, -1.6, 0.9]), np.zeros(3))


def exact_picture(scene: Scene, camera: Camera, time: float = 0.4, dtype: torch.dtype = torch.float64) -> np.ndarray:
    """Return the colours of a picture's pixels by PyTorch, (N, 3): the truth, in float64."""
    field = Field.from_scene(scene).to(dtype)
    origins, directions = camera.rays(np.float64 if dtype is torch.float64 else np.float32)
    mapping = scene.mapping
    if isinstance(mapping, DeviceCoordinates):
        path = mapping.rays(origins, directions)
        origins, directions, mapping = path.origins, path.directions, None
    one = torch.ones(len(origins), dtype=dtype)
    at = [torch.from_numpy(np.ascontiguousarray(a)).to(dtype) for a in (origins, directions)]
    background = torch.from_numpy(scene.background).to(dtype).expand(len(origins), 3)
    rays = Rays(at[0], at[1], time * one, 0.5 * one, background)
    aabb, occupancy = torch.from_numpy(scene.aabb).to(dtype), torch.from_numpy(scene.occupancy)
    with torch.no_grad():
        rgb, *_ = render_reference(field, rays, aabb, occupancy, scene.step, mapping=mapping)
    return rgb.numpy()


def _numpy(scene: Scene, camera: Camera, time: float) -> np.ndarray:
    return reference.render(scene, camera, time).rgb.reshape(-1, 3)


def _torch(scene: Scene, camera: Camera, time: float) -> np.ndarray:
    return exact_picture(scene, camera, time, torch.float32)


def _kernels(scene: Scene, camera: Camera, time: float) -> np.ndarray:
    origins, directions = camera.rays()
    if isinstance(scene.mapping, DeviceCoordinates):
        path = scene.mapping.rays(origins, directions)
        origins, directions = path.origins, path.directions
    return SceneRenderer(scene).rgb(origins, directions, np.full(len(origins), time, np.float32))


def _renderer(quality: Quality, processor: bool) -> Draw:
    def draw(scene: Scene, camera: Camera, time: float) -> np.ndarray:
        renderer = Renderer(_context(), scene, quality, compute=False, processor=processor)
        try:
            return renderer.render(camera, time).rgb.reshape(-1, 3)
        finally:
            renderer.release()

    return draw


@cache
def _context() -> moderngl.Context:
    return open_context()


@cache
def has_opengl() -> bool:
    """Return whether there is OpenGL to draw by."""
    try:
        _context()
    except DisplayError:
        return False
    return True


def opengl_name() -> str | None:
    """Return the renderer of OpenGL and its version; None where there is none."""
    return describe(_context()) if has_opengl() else None


# Everything that draws, by its name in tables.
RENDERERS: dict[str, Draw] = {
    "numpy": _numpy,
    "torch": _torch,
    "kernels": _kernels,
    "processor": _renderer(FINEST, processor=True),
    "glsl": _renderer(LEVELS["reference"], processor=False),
    "folded": _renderer(FINEST, processor=False),
}
# Those that need OpenGL, and those that draw what the format says at each sample.
OPENGL = ("processor", "glsl", "folded")
EXACT = ("numpy", "torch", "kernels", "glsl")
