"""A scene at another place in the world: moved, turned and scaled, with the same pictures from cameras that move along.

    p' = factor * turn p + shift

The symbols of a scene stay as they are; a box that is turned has its planes transposed and mirrored. The planes of a
scene in device coordinates lie in the frame of its reference camera, which may be turned by any angle.
"""

from collections.abc import Iterable
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
import numpy.typing as npt

from kpc.format.coding.quantise import QuantisedPlane, QuantisedScene
from kpc.format.common.errors import UsageError
from kpc.format.container.scene_layout import BOX_LIMIT
from kpc.format.scene.cameras import Camera
from kpc.format.scene.metadata import Metadata, camera_document, rounded
from kpc.format.scene.motion import QuantisedMotion
from kpc.format.scene.scene import ALL_PLANES, TIME_PLANES, AnyDecoder
from kpc.format.scene.space import Contraction, DeviceCoordinates, SpaceMapping

AXES = "xyz"
# Relative change of an edge of the box by rounding to float32 that moving it may bring.
EDGE_TOLERANCE = 1e-4


@dataclass(frozen=True)
class Placement:
    """Where a scene is put.

    Attributes:
        turn: (3, 3) rotation.
        factor: of lengths, > 0.
        shift: (3,) world units after scaling.
    """

    turn: np.ndarray
    factor: float
    shift: np.ndarray

    def points(self, points: np.ndarray) -> np.ndarray:
        """Return where points (..., 3) are put."""
        return np.asarray(self.factor * (points @ self.turn.T) + self.shift)

    def camera(self, camera: Camera) -> Camera:
        """Return the camera that sees after placing what `camera` saw before."""
        pose = np.eye(4)
        pose[:3, :3] = self.turn @ camera.camera_to_world[:3, :3]
        pose[:3, 3] = self.points(camera.camera_to_world[:3, 3])
        return replace(camera, camera_to_world=pose)

    @property
    def is_turned(self) -> bool:
        """Whether directions change."""
        return not np.array_equal(self.turn, np.eye(3))


def axis_turn(axis: str, degrees: float) -> np.ndarray:
    """Return the rotation around an axis, (3, 3); exact for quarter turns.

    Args:
        axis: "x", "y" or "z".
        degrees: counter-clockwise seen from the tip of the axis.
    """
    first, second = [k for k in range(3) if k != AXES.index(axis)] if axis != "y" else (2, 0)
    quarter = round(degrees / 90)
    cosine, sine = float(np.cos(np.radians(degrees))), float(np.sin(np.radians(degrees)))
    if degrees == 90 * quarter:
        cosine, sine = [(1.0, 0.0), (0.0, 1.0), (-1.0, 0.0), (0.0, -1.0)][quarter % 4]
    turn = np.eye(3)
    turn[first, first] = turn[second, second] = cosine
    turn[first, second], turn[second, first] = -sine, sine
    return turn


def placed(scene: QuantisedScene, placement: Placement) -> QuantisedScene:
    """Return a scene at another place.

    Raises:
        UsageError: its box cannot be turned by this angle, or is too small for where it is moved to; or it would be
            larger or smaller than a file holds.
    """
    cameras = tuple(placement.camera(camera) for camera in scene.cameras)
    _check_fits(placement, [camera.camera_to_world[:3, 3] for camera in cameras])
    scene = replace(scene, cameras=cameras, metadata=placed_metadata(scene.metadata, placement))
    if isinstance(scene.mapping, DeviceCoordinates):
        return replace(scene, mapping=_placed_frame(scene.mapping, placement))
    if placement.is_turned:
        scene = _turned(scene, placement.turn)
    aabb = (placement.factor * scene.aabb.astype(np.float64) + placement.shift).astype(np.float32)
    _check_fits(placement, aabb)
    if (smallest := placement.factor * np.diff(scene.aabb, axis=0).min()) < 1 / BOX_LIMIT:
        raise UsageError(
            f"--scale {placement.factor:g}: an edge of the box would be {smallest:.3g}; a file holds lengths from "
            f"{1 / BOX_LIMIT:.3g}; choose a larger factor"
        )
    edges, wanted = aabb[1] - aabb[0], placement.factor * (scene.aabb[1].astype(np.float64) - scene.aabb[0])
    if not (np.abs(edges - wanted) <= EDGE_TOLERANCE * wanted).all():
        raise UsageError("--move: so far from the origin the box would lose its shape by rounding; scale it up first")
    mapping: SpaceMapping | None = scene.mapping
    if isinstance(mapping, Contraction):
        mapping = Contraction(placement.factor * mapping.uniform_distance)
    return replace(scene, aabb=aabb, step=placement.factor * scene.step, mapping=mapping)


def placed_metadata(metadata: Metadata, placement: Placement) -> Metadata:
    """Return metadata in the world after placing."""
    document = metadata.document
    changed: dict[str, Any] = {}
    if (opening := metadata.opening) is not None:
        changed["opening"] = document["opening"] | {"camera": camera_document(placement.camera(opening.camera))}
    if "up" in document:
        changed["up"] = rounded(placement.turn @ np.array(document["up"], float))
    if "view_limits" in document:
        limits = document["view_limits"]
        changed["view_limits"] = limits | {
            "focus": rounded(placement.points(np.array(limits["focus"], float))),
            "forward": rounded(placement.turn @ np.array(limits["forward"], float)),
            "distance": rounded([placement.factor * distance for distance in limits["distance"]]),
            "reach": rounded([placement.factor * limits["reach"]])[0],
        }
        _check_fits(placement, [changed["view_limits"]["focus"], changed["view_limits"]["distance"]])
    if "metres_per_unit" in document:
        changed["metres_per_unit"] = rounded([document["metres_per_unit"] / placement.factor])[0]
    return metadata.with_members(**changed)


def _check_fits(placement: Placement, numbers: Iterable[npt.ArrayLike]) -> None:
    """Raise a UsageError if coordinates or lengths of a scene that is put elsewhere exceed what a file holds."""
    largest = max((float(np.abs(number).max()) for number in numbers), default=0.0)
    if largest > BOX_LIMIT:
        option = "--move" if placement.factor == 1 else f"--scale {placement.factor:g}"
        raise UsageError(
            f"{option}: the scene would reach to {largest:.3g}; a file holds coordinates and lengths up to "
            f"{BOX_LIMIT:.3g}; choose less"
        )


def _placed_frame(mapping: DeviceCoordinates, placement: Placement) -> DeviceCoordinates:
    frame = np.column_stack([placement.turn @ mapping.frame[:, :3], placement.points(mapping.frame[:, 3])])
    return DeviceCoordinates(frame, placement.factor * mapping.near, placement.factor * mapping.baseline)


def _turned(scene: QuantisedScene, turn: np.ndarray) -> QuantisedScene:
    """Return a scene in a box turned by quarter turns around the origin."""
    source = np.abs(turn).argmax(1)  # the old axis along which each new one lies
    sign = turn[np.arange(3), source]
    if not np.array_equal(np.abs(turn), np.eye(3)[source]):
        raise UsageError(
            "--turn: the planes of this scene lie along the axes of its box, so it can be turned by multiples of 90 "
            "degrees; say with --up which way is up instead"
        )
    corners = sign * scene.aabb[:, source]
    return replace(
        scene,
        aabb=np.stack([corners.min(0), corners.max(0)]).astype(np.float32),
        scales=tuple(
            {name: _turned_plane(scale, name, source, sign) for name in ALL_PLANES if name in scale}
            for scale in scene.scales
        ),
        decoder=_turned_decoder(scene.decoder, source, sign),
        occupancy=_turned_grid(scene.occupancy, source, sign),
        motion=None if scene.motion is None else _turned_motion(scene.motion, source, sign),
    )


def _turned_plane(scale: Any, name: str, source: np.ndarray, sign: np.ndarray) -> QuantisedPlane:
    """Return the plane of a name after turning; its symbols are those of an old plane, transposed and mirrored."""
    across, down = name[0], name[1]
    column = source[AXES.index(across)]
    flips = [slice(None, None, int(sign[AXES.index(axis)])) if axis in AXES else slice(None) for axis in (down, across)]
    if name in TIME_PLANES:
        old, is_transposed = scale[AXES[column] + "t"], False
    else:
        row = source[AXES.index(down)]
        old, is_transposed = scale[AXES[min(row, column)] + AXES[max(row, column)]], column > row
    symbols, coded = old.symbols, old.coded
    if is_transposed:
        symbols, coded = symbols.swapaxes(0, 1), coded.T
    return QuantisedPlane(
        np.ascontiguousarray(symbols[tuple(flips)]),
        old.step,
        old.offset,
        np.ascontiguousarray(coded[tuple(flips)]),
        stores_map=old.stores_map,
    )


def _turned_grid(grid: np.ndarray, source: np.ndarray, sign: np.ndarray) -> np.ndarray:
    """Return a grid [t, z, y, x, ...] after turning."""
    order = [0, *(3 - source[axis] for axis in (2, 1, 0)), *range(4, grid.ndim)]
    flips = slice(None), *(slice(None, None, int(sign[axis])) for axis in (2, 1, 0))
    return np.ascontiguousarray(grid.transpose(order)[flips])


def _turned_motion(motion: QuantisedMotion, source: np.ndarray, sign: np.ndarray) -> QuantisedMotion:
    symbols = _turned_grid(motion.symbols, source, sign)[..., source].astype(np.int32) * sign.astype(np.int32)
    return QuantisedMotion(np.clip(symbols, -32768, 32767).astype(np.int16), motion.step)


def _turned_decoder(decoder: AnyDecoder, source: np.ndarray, sign: np.ndarray) -> AnyDecoder:
    """Return a decoder whose weights of the view direction (x, y, z, xx, yy, zz, xy, yz, zx) are turned along."""
    pairs = [(0, 1), (1, 2), (2, 0)]
    w1 = np.zeros_like(decoder.w1)
    for new in range(3):
        w1[:, new] = sign[new] * decoder.w1[:, source[new]]
        w1[:, 3 + new] = decoder.w1[:, 3 + source[new]]
    for number, (a, b) in enumerate(pairs):
        old = next(k for k, pair in enumerate(pairs) if set(pair) == {source[a], source[b]})
        w1[:, 6 + number] = sign[a] * sign[b] * decoder.w1[:, 6 + old]
    return replace(decoder, w1=w1)
