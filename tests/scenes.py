"""Small scenes for tests, with every feature of real ones in a few kilobytes."""

from collections.abc import Callable
from dataclasses import replace

import numpy as np

from kpc.format.scene.cameras import Camera
from kpc.format.scene.scene import SPACE_PLANES, TIME_PLANES, Appearance, Clip, Decoder, HybridDecoder, Scene
from kpc.format.scene.space import Contraction, DeviceCoordinates
from kpc.player.atlas import Layout
from kpc.player.gl.renderer import Renderer


def tiny_scene(
    seed: int = 0,
    dynamic: bool = True,
    scales: int = 2,
    channels: int = 8,
    resolution: tuple[int, int, int] = (24, 20, 16),
    time: int = 6,
) -> Scene:
    """Return a scene of smooth random planes in a box of unequal edges, with two cameras.

    Args:
        seed: of the random numbers.
        dynamic: whether it has time planes, which are 1 outside the middle third of their columns.
        scales: number of scales.
        channels: per scale.
        resolution: (Nx, Ny, Nz) of the finest scale; each coarser scale halves it.
        time: rows of every time plane.
    """
    rng = np.random.default_rng(seed)
    aabb = np.array([[-1.0, -0.8, -0.6], [1.2, 0.9, 0.7]], np.float32)
    levels = []
    for scale in range(scales):
        size = {axis: max(2, n >> (scales - 1 - scale)) for axis, n in zip("xyz", resolution, strict=True)} | {
            "t": time
        }
        planes = {}
        for name in SPACE_PLANES + (TIME_PLANES if dynamic else ()):
            shape = (size[name[1]], size[name[0]], channels)
            planes[name] = _bump(rng, *shape) if name in TIME_PLANES else _smooth(rng, *shape)
        levels.append(planes)

    features = scales * channels
    slots = min(time, 3) if dynamic else 1
    decoder = Decoder(
        density_weight=rng.normal(0.0, 4.0 / np.sqrt(features), features).astype(np.float32),
        density_bias=2.0,
        w1=rng.normal(0.0, 0.5, (16, 9)).astype(np.float32),
        b1=rng.normal(0.0, 0.5, 16).astype(np.float32),
        w2=rng.normal(0.0, 2.0 / np.sqrt(16 * features), (3, features, 16)).astype(np.float32),
        b2=rng.normal(0.0, 2.0 / np.sqrt(features), (3, features)).astype(np.float32),
    )
    return Scene(
        aabb=aabb,
        clip=Clip(11, 10.0) if dynamic else Clip(1, 10.0),
        scales=tuple(levels),
        decoder=decoder,
        occupancy=_blob(slots, 8, 10, 12),
        background=np.array([0.9, 0.95, 1.0], np.float32),
        step=0.04,
        cameras=tuple(look_at(eye, (0.1, 0.05, 0.05), 48, 36, 55.0) for eye in [(2.4, 1.0, 2.2), (-1.8, 1.4, 2.6)]),
    )


def with_contraction(scene: Scene) -> Scene:
    """Return the scene in contracted space, surrounded by a wall that extends to infinity.

    Uniform steps end within the near part of the wall, so that samples of both kinds contribute.
    """
    slots = len(scene.occupancy)
    occupancy = np.zeros((slots, 16, 20, 24), bool)
    occupancy[:, 4:12, 5:15, 6:18] = scene.occupancy
    shell = np.ones(occupancy.shape[1:], bool)
    shell[2:-1, 2:-2, 1:-3] = False
    shell[2:6, 3:7, 18] = True  # a separate object outside the box
    return replace(scene, occupancy=occupancy | shell, mapping=Contraction(5.0), step=0.08)


def with_motion(scene: Scene, seed: int = 5, most: float = 0.06) -> Scene:
    """Return a dynamic scene with a random motion grid of 3 x 2 x 4 nodes and displacements of up to `most`."""
    shape = len(scene.scales[0]["xt"]), 3, 2, 4, 3
    return replace(scene, motion=np.random.default_rng(seed).uniform(-most, most, shape).astype(np.float32))


def in_device_coordinates(scene: Scene) -> Scene:
    """Return the scene in device coordinates, up to a depth of 50.

    Their camera lies between the scene's cameras and in front of them, so rays start on both sides of its near plane.
    """
    frame = look_at((0.3, 0.9, 2.1), (0.1, 0.05, 0.05), 1, 1, 1.0).camera_to_world[:3]
    aabb = np.array([[-0.8, -0.7, 0.1], [0.9, 0.6, 2 * (1 / 0.8 - 1 / 50)]], np.float32)
    return replace(scene, mapping=DeviceCoordinates(frame, 0.8, 2.0), aabb=aabb)


def with_hybrid_decoder(scene: Scene, seed: int = 6, width: int = 6, hidden: int = 7) -> Scene:
    """Return the scene with a random hybrid decoder, whose widths are not multiples of four."""
    rng = np.random.default_rng(seed)
    F = scene.decoder.w2.shape[1]
    shapes = HybridDecoder.shapes(F, width, hidden)
    weights = {
        name: rng.normal(0.0, 2.0 / np.sqrt(shape[-1]), shape).astype(np.float32) for name, shape in shapes.items()
    }
    return replace(scene, decoder=HybridDecoder(density_bias=3.5, **weights))


def with_appearances(
    scene: Scene, names: tuple[str, ...] = ("dawn.jpg", "noon.jpg", "dusk.jpg"), seed: int = 7
) -> Scene:
    """Return the scene with an appearance for each name, with random codes of mean 0."""
    codes = np.random.default_rng(seed).normal(0, 1, (len(names), len(scene.decoder.b1)))
    codes = (codes - codes.mean(0)).astype(np.float32)
    return replace(scene, appearances=tuple(Appearance(name, code) for name, code in zip(names, codes, strict=True)))


def view_independent(scene: Scene) -> Scene:
    """Return the scene with view-independent colour."""
    return replace(scene, decoder=replace(scene.decoder, w2=0 * scene.decoder.w2))


def unequal_scales() -> Scene:
    """Return a scene whose scales differ in channels, time rows and size; the first is the finer one along y."""
    coarse, fine = (
        tiny_scene(1, channels=13, resolution=(12, 44, 10), time=4),
        tiny_scene(2, channels=19, resolution=(23, 20, 15), time=7),
    )
    scales = coarse.scales[-1], fine.scales[-1]
    rng, features = np.random.default_rng(3), 32
    decoder = replace(
        fine.decoder,
        density_weight=rng.normal(0, 0.8, features).astype(np.float32),
        w2=np.zeros((3, features, 16), np.float32),
        b2=rng.normal(0, 0.4, (3, features)).astype(np.float32),
    )
    return replace(fine, scales=scales, decoder=decoder)


def one_texel_deep() -> Scene:
    """Return a view-independent scene with one texel along z."""
    scene = tiny_scene(5, scales=1, channels=30, resolution=(9, 20, 2))
    planes = {
        name: plane[:1] if name in ("xz", "yz") else plane[:, :1] if name == "zt" else plane
        for name, plane in scene.scales[0].items()
    }
    return view_independent(replace(scene, scales=(planes,)))


def linear_per_cell(scene: Scene) -> Scene:
    """Make the field linear between corners, in place: only "xy" varies in space, the time planes do not.

    A grid of values at texel corners then represents it exactly.
    """
    for name in ("xz", "yz"):
        scene.scales[0][name][:] = 1.0
    for name in ("xt", "yt", "zt"):
        scene.scales[0][name][:] = scene.scales[0][name][:, :1]
    return scene


def with_moving_area(scene: Scene) -> Scene:
    """Return the scene with coarser scales that stand still and a finest one that is 0 outside a part of the box, as
    `kpenc --layers auto` makes them."""
    *coarser, finest = map(dict, scene.scales)
    for scale in coarser:
        scale.update({name: np.ones_like(scale[name][:2]) for name in TIME_PLANES if name in scale})
    finest.update({name: 3 * finest[name] - 2 for name in TIME_PLANES if name in finest})  # it alone moves
    for name in SPACE_PLANES:
        rows, columns, _ = finest[name].shape
        inside = np.zeros((rows, columns, 1), np.float32)
        inside[rows // 4 : rows - rows // 5, columns // 5 : columns - columns // 4] = 1
        finest[name] = finest[name] * inside
    return replace(scene, scales=(*coarser, finest))


# The box with an explicit decoder, and every alternative to it.
VARIANTS: dict[str, Callable[[Scene], Scene]] = {
    "box": lambda scene: scene,
    "contracted": with_contraction,
    "displaced": with_motion,
    "ndc": in_device_coordinates,
    "hybrid": with_hybrid_decoder,
    "moving area": with_moving_area,
}


def without_planes(scene: Scene) -> Scene:
    """Return the scene with all planes 1, as before any of them has been received."""
    return replace(
        scene, scales=tuple({name: np.ones_like(plane) for name, plane in scale.items()} for scale in scene.scales)
    )


def stream_planes(renderer: Renderer, early: Scene, scene: Scene) -> None:
    """Fill in planes as streaming does: upload space planes in parts, and change those of time in `early` in place."""
    for number, scale in enumerate(scene.scales):
        for name in SPACE_PLANES:
            renderer.put(number, name, Layout.texels(scale[name][3:]), 3)
            renderer.put(number, name, Layout.texels(scale[name][:3]))
        for name in TIME_PLANES:
            early.scales[number][name][:] = scale[name]
    renderer.refresh()


def look_at(
    eye: tuple[float, float, float], target: tuple[float, float, float], width: int, height: int, focal: float
) -> Camera:
    """Return a camera at `eye` that looks at `target`, with +y up."""
    back = np.subtract(eye, target) / np.linalg.norm(np.subtract(eye, target))
    right = np.cross([0.0, 1.0, 0.0], back)
    right /= np.linalg.norm(right)
    pose = np.eye(4)
    pose[:3] = np.stack([right, np.cross(back, right), back, np.asarray(eye, float)], axis=1)
    return Camera(width, height, focal, focal, width / 2, height / 2, pose)


def _smooth(rng: np.random.Generator, rows: int, columns: int, channels: int) -> np.ndarray:
    """Interpolate 5 x 5 random knots from [0.3, 1.5] bilinearly."""
    knots = rng.uniform(0.3, 1.5, (5, 5, channels))
    return np.einsum("rk,cl,klm->rcm", _hats(rows), _hats(columns), knots).astype(np.float32)


def _hats(size: int) -> np.ndarray:
    position = np.linspace(0.0, 4.0, size)[:, None]
    return np.maximum(0.0, 1.0 - np.abs(position - np.arange(5)))


def _bump(rng: np.random.Generator, rows: int, columns: int, channels: int) -> np.ndarray:
    """Return a time plane of 1, except for the middle third of its columns, which oscillate in time."""
    amplitude = rng.uniform(-0.5, 0.5, channels)
    phase = rng.uniform(0.0, 2.0 * np.pi, channels)
    t = np.linspace(0.0, 1.0, rows)[:, None, None]
    middle = np.abs(np.linspace(-1.0, 1.0, columns)) < 1.0 / 3.0
    wave = 1.0 + amplitude * np.sin(2.0 * np.pi * t + phase)
    return np.where(middle[None, :, None], wave, 1.0).astype(np.float32)


def _blob(slots: int, nz: int, ny: int, nx: int) -> np.ndarray:
    """Return the occupancy of an ellipsoid that moves along x from slot to slot."""
    z, y, x = np.meshgrid(*((np.arange(n) + 0.5) / n - 0.5 for n in (nz, ny, nx)), indexing="ij")
    centres = np.linspace(-0.1, 0.1, slots) if slots > 1 else [0.0]
    return np.stack([(x - c) ** 2 + y**2 + z**2 < 0.42**2 for c in centres])
