"""Sweeps of whole pictures: box, cameras, clip, planes, mappings, motion, density and quantisation."""

import math
from collections.abc import Callable, Iterable, Mapping
from dataclasses import replace

import numpy as np

from kpc.format.coding.quantise import VALUE_LIMIT, quantise_plane
from kpc.format.common.errors import KpcError
from kpc.format.container.scene_layout import AXIS_LIMIT, BOX_LIMIT, FRAME_LIMIT, MOTION_LIMIT, SAMPLE_LIMIT
from kpc.format.scene.cameras import Camera
from kpc.format.scene.motion import DISPLACEMENT_LIMIT, QuantisedMotion
from kpc.format.scene.scene import LOG_DENSITY_LIMIT, TIME_PLANES, Clip, Scene
from kpc.format.scene.space import FARTHEST_BOX, FARTHEST_CAMERA, Contraction, DeviceCoordinates
from kpc.tools.bench.stability.scenes import (
    EXACT,
    OPENGL,
    OUTSIDE,
    RENDERERS,
    camera_at,
    exact_picture,
    has_opengl,
    soft_scene,
)
from kpc.tools.bench.stability.sweeps import LEVEL, Sweep, largest_difference, powers

Shot = tuple[Scene, Camera, float]
Measure = Callable[[float], Mapping[str, float]]
# Distances in longest edges of the box: of the box from the origin, and of a camera.
NEAR_AND_FAR = (0.0, *powers(4, range(7)), FARTHEST_BOX, *powers(4, range(8, 13)))
FROM_NEAR_AND_FAR = (*powers(10, range(4)), FARTHEST_CAMERA, *powers(10, range(4, 9)))
EVERYWHERE = (0.0, math.inf)
# A direction from which no axis of the box is along a ray.
AWAY = np.array([0.5, -0.73, 0.41]) / np.linalg.norm([0.5, -0.73, 0.41])


def sweeps() -> list[Sweep]:
    """Return all sweeps of pictures."""
    return [*_places(), *_clips(), *_mappings(), *_numbers(), *_rays()]


def drawn(
    shots: Callable[[float], Iterable[Shot]], names: Iterable[str] = EXACT
) -> Callable[[float], dict[str, float]]:
    """Return a function that gives each renderer's largest error over the shots of a value."""

    def measure(value: float) -> dict[str, float]:
        errors: dict[str, float] = {}
        for scene, camera, time in shots(value):
            exact = exact_picture(scene, camera, time)
            for name in names:
                if name in OPENGL and not has_opengl():
                    continue
                try:
                    found = RENDERERS[name](scene, camera, time)
                except KpcError:
                    continue  # refused
                errors[name] = max(errors.get(name, 0.0), largest_difference(found, exact))
        return errors

    return measure


def _placed(scene: Scene, edge: float, offset: float = 0.0) -> Scene:
    """Return the scene with its box `edge` wide, and its centre `offset` edges away from the origin along each axis."""
    aabb = ((scene.aabb.astype(np.float64) + offset) * edge).astype(np.float32)
    return replace(scene, aabb=aabb, step=scene.step * edge)


def _seen(scene: Scene, distance: float) -> Shot:
    """Return a shot of a scene, its box filling the picture, from so many edges away."""
    middle, edge = scene.aabb.astype(np.float64).mean(0), scene.extent
    return scene, camera_at(middle + distance * edge * AWAY, middle, 0.4 * edge), 0.4


# --- box and cameras


def _places() -> list[Sweep]:
    everything = (*EXACT, "processor")
    inside = soft_scene(log_density=-1.0)
    along = np.array([0.07, 0.05, 0.03])

    def turned(angle: float) -> list[Shot]:
        """Return shots of one pixel along each axis, turned away from it by an angle."""
        found = []
        for axis in range(3):
            direction = np.roll([1.0, angle, angle], axis)
            camera = camera_at(along - direction * 1.5, along, 0.4, (1, 1))
            found.append((inside, camera, 0.4))
        return found

    def within(place: float) -> list[Shot]:
        """Return a shot from so many half edges from the middle towards a face, looking at the opposite one."""
        eye = np.array([0.02, 0.03, 0.5 * place])
        return [(inside, camera_at(eye, np.array([0.05, -0.08, -0.5 - place]), 0.8 * (1 + place)), 0.4)]

    return [
        Sweep(
            "box",
            "longest edge, world units",
            powers(10, range(-10, 11, 2)),
            drawn(lambda edge: [_seen(_placed(soft_scene(), edge), 2.0)], everything),
            (1 / BOX_LIMIT, BOX_LIMIT),
            "files hold edges of 2^-30 to 2^30; others are refused",
        ),
        Sweep(
            "box away from the origin",
            "distance, longest edges",
            NEAR_AND_FAR,
            drawn(lambda offset: [_seen(_placed(soft_scene(), 1.0, offset / math.sqrt(3)), 2.0)], everything),
            (0.0, FARTHEST_BOX),
            "kpenc refuses boxes that are farther away",
        ),
        Sweep(
            "camera far away",
            "distance, longest edges",
            FROM_NEAR_AND_FAR,
            drawn(lambda distance: [_seen(soft_scene(), distance)], everything),
            (0.0, FARTHEST_CAMERA),
            "kprender refuses cameras that are farther away",
        ),
        Sweep(
            "camera inside",
            "half edges from the middle",
            (0.0, 0.5, 0.999, 1.0, 1.001, 1.5),
            drawn(within, everything),
            EVERYWHERE,
            "rays begin at the camera, or where they enter the box",
        ),
        Sweep(
            "camera along an axis",
            "angle, radians",
            (0.0, *powers(10, (-30, -12, -9, -7, -6, -4, -2))),
            drawn(turned, everything),
            EVERYWHERE,
            "a direction's component counts as at least 1e-12",
        ),
    ]


# --- time


def _clips() -> list[Sweep]:
    def frames(count: float) -> list[Shot]:
        """Return shots of the first frame, the last, and others of a clip whose time planes have a row a frame."""
        scene = replace(soft_scene((6, 5, 4), rows=max(int(count), 2)), clip=Clip(int(count), 25.0))
        last = max(int(count) - 1, 1)
        times = sorted({0.0, 1 / last, int(count) // 3 / last, (last - 1) / last, 1.0})
        return [(scene, OUTSIDE, time) for time in times]

    def noisy(rows: float) -> list[Shot]:
        """Return shots between rows, of time planes that have nothing to do from row to row."""
        scene, count = soft_scene((6, 5, 4), rows=int(rows)), int(rows) - 1
        rng = np.random.default_rng(1)
        planes = {
            name: rng.uniform(0.5, 1.5, plane.shape).astype(np.float32) if name in TIME_PLANES else plane
            for name, plane in scene.scales[0].items()
        }
        return [(replace(scene, scales=(planes,)), OUTSIDE, (k + 0.37) / count) for k in {0, count // 2, count - 1}]

    return [
        Sweep(
            "frames",
            "frames of a clip",
            (1, 2, 10, 100, 1000, 10_000),
            drawn(frames, ("numpy", "torch", "kernels", "glsl")),
            (1, FRAME_LIMIT),
            "times beyond [0, 1] are refused; files hold 2^24 frames",
        ),
        Sweep(
            "rows",
            "rows of time planes",
            powers(4, range(1, 9)),
            drawn(noisy, ("numpy", "torch", "kernels", "glsl")),
            (1, AXIS_LIMIT),
            "files hold 16,384 rows",
        ),
    ]


# --- mappings of space, and motion


def _mappings() -> list[Sweep]:
    def contracted(edge: float) -> list[Shot]:
        scene = soft_scene(log_density=1.0)
        return [_seen(replace(_placed(scene, edge), mapping=Contraction(1.5 * edge), step=0.03 * edge), 0.9)]

    def surroundings(distance: float) -> list[Shot]:
        scene = replace(soft_scene(log_density=1.0), mapping=Contraction(1.5), step=0.03)
        return [_seen(scene, distance)]

    def ndc(ratio: float) -> list[Shot]:
        """Return a shot of device coordinates whose box reaches from depth 1 to `ratio`."""
        frame = np.concatenate([np.eye(3), np.zeros((3, 1))], axis=1)
        aabb = np.array([[-0.5, -0.5, 0], [0.5, 0.5, 1 - 1 / ratio]], np.float32)
        scene = replace(soft_scene(), aabb=aabb, mapping=DeviceCoordinates(frame, 1.0, 1.0), step=1 / 60)
        return [(scene, camera_at(np.array([0.2, 0.1, 0.3]), np.array([0.1, 0.1, -5.0]), 2.0), 0.4)]

    def displaced(size: float) -> list[Shot]:
        rng = np.random.default_rng(2)
        motion = np.zeros((3, 4, 4, 4, 3), np.float32)
        motion[:, 1:3, 1:3, 1:3] = size * rng.uniform(-1, 1, (3, 2, 2, 2, 3))
        return [(replace(soft_scene(), motion=motion), OUTSIDE, 0.4)]

    def noded(nodes: float) -> list[Shot]:
        rng = np.random.default_rng(3)
        motion = 0.05 * rng.uniform(-1, 1, (2, 3, 3, int(nodes), 3)).astype(np.float32)
        return [(replace(soft_scene(), motion=motion), OUTSIDE, 0.4)]

    four = ("numpy", "torch", "kernels", "glsl")
    return [
        Sweep(
            "contraction",
            "longest edge, world units",
            powers(10, range(-8, 9, 4)),
            drawn(contracted, four),
            (1 / BOX_LIMIT, BOX_LIMIT),
            "as for boxes",
        ),
        Sweep(
            "contraction, camera outside",
            "distance, longest edges",
            powers(10, range(7)),
            drawn(surroundings, four),
            EVERYWHERE,
            "density counts by contracted length, which ends",
        ),
        Sweep(
            "NDC",
            "farthest over nearest depth",
            powers(10, range(1, 9)),
            drawn(ndc, four),
            EVERYWHERE,
            "disparity is at least 1e-6",
        ),
        Sweep(
            "motion grid",
            "displacement, edges",
            powers(4, range(-6, 6)),
            *(
                drawn(displaced, (*four, "processor")),
                (0.0, DISPLACEMENT_LIMIT),
                "files hold 1,024 edges",
            ),
        ),
        Sweep(
            "motion grid, nodes",
            "nodes along an axis",
            (2, 8, 32, 128, 256),
            drawn(noded, (*four, "processor")),
            (2, MOTION_LIMIT),
            "files hold 256",
        ),
    ]


# --- numbers of planes and of the decoder


def _numbers() -> list[Sweep]:
    return [
        Sweep(
            "interpolation",
            "texels along an axis",
            powers(4, range(1, 9)),
            drawn(_texels),
            (1, AXIS_LIMIT),
            "files hold 16,384",
        ),
        Sweep(
            "textures",
            "size of the numbers of planes",
            powers(10, range(-8, 9, 2)),
            drawn(_scaled, (*EXACT, "processor", "folded")),
            (0.0, VALUE_LIMIT**2),
            "folded planes are float32 where float16 cannot hold them",
        ),
        Sweep(
            "decoder",
            "terms that cancel in a sum of 1",
            powers(10, range(8)),
            drawn(_cancelling),
            (0.0, VALUE_LIMIT),
            "weights are float16, whose pairs cannot cancel more closely",
        ),
        Sweep(
            "folding",
            "change between texels",
            (0.003, 0.01, 0.03, 0.1, 0.3, 1.0),
            drawn(_steep, ("folded",)),
            (0.0, 0.1),
            "not kept: kpbench player measures it for each scene; the level `reference` does not fold",
        ),
        Sweep(
            "quantisation of planes",
            "bits",
            tuple(float(bits) for bits in range(1, 17)),
            _quantised_planes,
            (8, 16),
            "planes hold 8 bits; rate control says how many of them pictures need",
            bound=2 * LEVEL,
        ),
        Sweep(
            "quantisation of motion",
            "bits",
            tuple(float(bits) for bits in range(1, 17)),
            _quantised_motion,
            (8, 16),
            "16 bits; rate control coarsens the step where pictures allow",
        ),
    ]


def _rays() -> list[Sweep]:
    return [
        Sweep(
            "truncated exponential",
            "log density that is added",
            (-40, -20, -10, -5, 0, 5, 10, 20, 40),
            drawn(_dense),
            (-math.inf, math.inf),
            f"log density is clipped to {LOG_DENSITY_LIMIT:g}",
        ),
        Sweep(
            "compositing",
            "samples on a ray",
            (*powers(8, range(1, 6)), SAMPLE_LIMIT, 4 * SAMPLE_LIMIT),
            drawn(_sampled, (*EXACT, "processor")),
            (1, SAMPLE_LIMIT),
            "files with more are refused",
        ),
    ]


def _texels(count: float) -> list[Shot]:
    """Return a shot of a plane of so many texels along x that differ at random."""
    scene, rng = soft_scene((int(count), 4, 4), rows=2), np.random.default_rng(4)
    planes = dict(scene.scales[0])
    noise = rng.uniform(-0.4, 0.4, (1, int(count), planes["xy"].shape[2] - 1)).astype(np.float32)
    planes["xy"] = planes["xy"] + np.concatenate([np.zeros_like(noise[..., :1]), noise], axis=2)
    return [(replace(scene, scales=(planes,)), OUTSIDE, 0.4)]


def _scaled(factor: float) -> list[Shot]:
    """Return a shot of planes of large or small numbers, whose decoder makes up for that: the picture stays."""
    scene = soft_scene((48, 40, 32), rows=2)
    planes = {name: plane * np.float32(factor) if name == "xy" else plane for name, plane in scene.scales[0].items()}
    d, less = scene.decoder, np.float32(1 / factor)
    decoder = replace(d, density_weight=less * d.density_weight, w2=less * d.w2, b2=less * d.b2)
    return [(replace(scene, scales=(planes,), decoder=decoder), OUTSIDE, 0.4)]


def _cancelling(size: float) -> list[Shot]:
    """Return a shot whose colours are small differences of large terms: two equal channels of opposite weights."""
    scene = soft_scene()
    planes = {name: np.repeat(plane, 2, axis=2) for name, plane in scene.scales[0].items()}
    d, sign = scene.decoder, np.float32(size) * np.tile([1, -1], scene.decoder.w2.shape[1]).astype(np.float32)
    half = np.repeat(d.b2, 2, axis=1) / 2
    decoder = replace(
        d, density_weight=np.repeat(d.density_weight, 2) / 2, w2=np.repeat(d.w2, 2, axis=1) / 2, b2=half + sign
    )
    return [(replace(scene, scales=(planes,), decoder=decoder), OUTSIDE, 0.4)]


def _steep(change: float) -> list[Shot]:
    """Return a shot whose time planes change at random from texel to texel."""
    scene, rng = soft_scene((24, 20, 16)), np.random.default_rng(6)
    planes = {
        name: (1 + change * rng.uniform(-1, 1, plane.shape)).astype(np.float32) if name in TIME_PLANES else plane
        for name, plane in scene.scales[0].items()
    }
    return [(replace(scene, scales=(planes,)), OUTSIDE, 0.4)]


def _dense(log_density: float) -> list[Shot]:
    """Return a shot of the scene, denser or thinner."""
    return [(soft_scene(log_density=log_density), OUTSIDE, 0.4)]


def _sampled(count: float) -> list[Shot]:
    """Return a shot of two pixels along a diagonal of the box, which is so many samples long."""
    scene = soft_scene((4, 4, 4), rows=0, samples=math.ceil(count / math.sqrt(3)))
    camera = camera_at(np.full(3, 1.2), np.zeros(3), 0.05, (2, 1))
    return [(scene, camera, 0.0)]


def _quantised_planes(bits: float) -> Mapping[str, float]:
    """Return the error of pictures of planes whose range is divided into 2^bits - 1 steps."""
    scene = soft_scene()
    planes = {}
    for name, plane in scene.scales[0].items():
        steps = np.ptp(plane.reshape(-1, plane.shape[2]), axis=0) / (2**bits - 1)
        coded = quantise_plane(plane, np.maximum(steps, 1e-9).astype(np.float32), identity=name in TIME_PLANES)
        planes[name] = coded.dequantise()
    exact = exact_picture(scene, OUTSIDE)
    return {"stored": largest_difference(exact_picture(replace(scene, scales=(planes,)), OUTSIDE), exact)}


def _quantised_motion(bits: float) -> Mapping[str, float]:
    """Return the error of pictures of a motion grid whose range is divided into 2^bits - 1 steps."""
    rng = np.random.default_rng(5)
    motion = rng.uniform(-0.05, 0.05, (3, 3, 3, 3, 3)).astype(np.float32)
    step = 0.1 / (2**bits - 1)
    coded = QuantisedMotion(np.rint(motion / step).clip(-32768, 32767).astype(np.int16), step)
    scene = soft_scene()
    exact = exact_picture(replace(scene, motion=motion), OUTSIDE)
    found = exact_picture(replace(scene, motion=coded.dequantise()), OUTSIDE)
    return {"stored": largest_difference(found, exact)}
