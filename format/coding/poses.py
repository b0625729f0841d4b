"""POSES, the codec of cameras: position and rotation of each in 14 bytes (spec/kpc-format.md, "POSES").

    count, lens count (u16) | exponent (i8) | corner (i32[3]) | lenses, 20 bytes each | rotations and positions, 7 + 7
    bytes each

Positions are integer multiples of a power of two, from the corner of the box around all of them. A rotation is a unit
quaternion without its largest component, which is positive and follows from the others. What this saves is in
docs/design/entropy-coding.md.
"""

import struct
from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from kpc.format.common.errors import FormatError
from kpc.format.scene.cameras import Camera
from kpc.format.scene.rotations import quaternion_of

HEAD = struct.Struct("<HHb3i")  # count, lens count (1, shared by all, or one each), exponent, corner
LENS = struct.Struct("<HH4f")  # width, height, fl_x, fl_y, cx, cy
# Bytes of a rotation, and of a position: three numbers of BITS; above those of a rotation, which component is left out.
WORD = 7
BITS = 18
# sqrt(1/2) in a rotation: right angles are exact, and a picture of 1000 pixels is turned by about a hundredth of one
# at most.
ROOT = (1 << BITS - 1) - 1
NOTHING = 1 << BITS - 1  # 0 in a rotation
EXACT = 1 << 24  # magnitude of integers that are exact in float32
FINEST, COARSEST = -126, 30  # exponents of positions
SKEW_TOLERANCE = 1e-3  # of the products of a pose's axes, which are 0 and 1 in a rotation


def are_rigid(cameras: Sequence[Camera]) -> bool:
    """Return whether the axes of all poses are rotations, so that `round_poses` may round them."""
    axes = _poses(cameras)[:, :, :3]
    products = axes.transpose(0, 2, 1) @ axes
    return bool((np.abs(products - np.eye(3)) < SKEW_TOLERANCE).all() and (np.linalg.det(axes) > 0).all())


def round_poses(cameras: Sequence[Camera]) -> tuple[Camera, ...]:
    """Return cameras, which must be `are_rigid`, with poses as they come back from a file."""
    exponent, corner, words = _as_words(_poses(cameras))
    return tuple(
        replace(camera, camera_to_world=np.vstack([pose, [0, 0, 0, 1]]))
        for camera, pose in zip(cameras, _from_words(exponent, corner, words), strict=True)
    )


def encode_poses(cameras: Sequence[Camera]) -> bytes | None:
    """Encode cameras; None where their poses are not those of `round_poses`.

    Raises:
        struct.error: a number does not fit its field.
    """
    if not are_rigid(cameras):
        return None
    exponent, corner, words = _as_words(_poses(cameras))
    if not np.array_equal(_from_words(exponent, corner, words), _poses(cameras)):
        return None
    lenses = [LENS.pack(c.width, c.height, c.fl_x, c.fl_y, c.cx, c.cy) for c in cameras]
    if len(set(lenses)) == 1:
        lenses = lenses[:1]
    packed = words.astype("<u8").reshape(-1, 1).view(np.uint8)[:, :WORD]
    return HEAD.pack(len(cameras), len(lenses), exponent, *corner.tolist()) + b"".join(lenses) + packed.tobytes()


def decode_poses(body: bytes, most: int) -> list[tuple[float, ...]]:
    """Undo `encode_poses`: return the fields of each camera under RAW, those of its lens and 12 of its pose.

    Args:
        most: number of cameras allowed.

    Raises:
        FormatError: the body is cut off, too long or damaged.
    """
    if len(body) < HEAD.size:
        raise FormatError("came: cut off within its head")
    count, lens_count, exponent, *corner = HEAD.unpack_from(body)
    if not 0 < count <= most:
        raise FormatError(f"came: {count} cameras (1 to {most} allowed)")
    if lens_count not in (1, count) or not FINEST <= exponent <= COARSEST:
        raise FormatError(
            f"came: {lens_count} lenses of {count} cameras, or positions in multiples of 2^{exponent}, make no sense"
        )
    start = HEAD.size + lens_count * LENS.size
    if len(body) != start + 2 * WORD * count:
        raise FormatError(f"came: {len(body):,} bytes are not those of {count} cameras and {lens_count} lenses")
    lenses = list(LENS.iter_unpack(body[HEAD.size : start])) * (count // lens_count)
    packed = np.frombuffer(body, np.uint8, offset=start).reshape(-1, WORD)
    words = np.pad(packed, ((0, 0), (0, 8 - WORD))).view("<u8").reshape(count, 2)
    poses = _from_words(exponent, np.array(corner, np.int64), words)
    return [(*lens, *pose) for lens, pose in zip(lenses, poses.reshape(count, 12).tolist(), strict=True)]


def _poses(cameras: Sequence[Camera]) -> np.ndarray:
    """Return (N, 3, 4) float64."""
    return np.stack([camera.camera_to_world[:3] for camera in cameras])


def _as_words(poses: np.ndarray) -> tuple[int, np.ndarray, np.ndarray]:
    """Return the exponent and the (3,) int64 corner of positions, and (N, 2) uint64 rotations and positions."""
    positions = poses[:, :, 3]
    extent, reach = float(np.ptp(positions, axis=0).max()), float(np.abs(positions).max())
    least = max(extent / ((1 << BITS) - 1), reach / EXACT, 2.0**FINEST)
    exponent = int(np.ceil(np.log2(least)))
    multiples = np.rint(np.ldexp(positions, -exponent)).astype(np.int64)
    if np.ptp(multiples, axis=0).max() >> BITS:  # rounding has made the extent one too large
        exponent += 1
        multiples = np.rint(np.ldexp(positions, -exponent)).astype(np.int64)
    corner = multiples.min(0)

    quaternions = quaternion_of(poses[:, :, :3])
    largest = np.abs(quaternions).argmax(1)
    quaternions *= np.sign(quaternions[np.arange(len(poses)), largest])[:, None]
    others = quaternions[np.arange(4) != largest[:, None]].reshape(-1, 3)
    rotations = np.rint(others * (np.sqrt(2) * ROOT)).astype(np.int64) + NOTHING
    words = np.stack(
        [_pack(rotations) | largest.astype(np.uint64) << np.uint64(3 * BITS), _pack(multiples - corner)], axis=1
    )
    return exponent, corner, words


def _pack(numbers: np.ndarray) -> np.ndarray:
    """Pack (N, 3) numbers of BITS into (N,) uint64, the first lowest."""
    shifted: np.ndarray = numbers.astype(np.uint64) << np.arange(0, 3 * BITS, BITS, dtype=np.uint64)
    return np.bitwise_or.reduce(shifted, axis=1)


def _unpack(words: np.ndarray) -> np.ndarray:
    """Undo `_pack`: return (N, 3) int64."""
    return (words[:, None] >> np.arange(0, 3 * BITS, BITS, dtype=np.uint64) & np.uint64((1 << BITS) - 1)).astype(
        np.int64
    )


def _from_words(exponent: int, corner: np.ndarray, words: np.ndarray) -> np.ndarray:
    """Return (N, 3, 4) float64 poses, of float32 numbers.

    Raises:
        FormatError: three components of a quaternion leave nothing for the fourth, or unused bits are set.
    """
    words = words.astype(np.uint64)
    largest, others = (words[:, 0] >> np.uint64(3 * BITS)).astype(np.int64), _unpack(words[:, 0]) - NOTHING
    rest = 2 * ROOT**2 - (others**2).sum(1)
    if (rest < 0).any() or (words[:, 1] >> np.uint64(3 * BITS)).any():
        raise FormatError("came: a rotation or a position is out of range")
    quaternions, squares = np.empty((len(words), 4)), np.empty((len(words), 4), np.int64)
    is_largest = np.arange(4) == largest[:, None]
    quaternions[is_largest], squares[is_largest] = np.sqrt(rest), rest
    quaternions[~is_largest], squares[~is_largest] = others.reshape(-1), (others**2).reshape(-1)
    (w, x, y, z), (_, xx, yy, zz) = quaternions.T, squares.T
    axes = np.array(
        [
            [ROOT**2 - (yy + zz), x * y - w * z, x * z + w * y],
            [x * y + w * z, ROOT**2 - (xx + zz), y * z - w * x],
            [x * z - w * y, y * z + w * x, ROOT**2 - (xx + yy)],
        ]
    )
    positions = np.ldexp((corner + _unpack(words[:, 1])).astype(np.float64), exponent)
    poses = np.concatenate([np.moveaxis(axes, -1, 0) / ROOT**2, positions[:, :, None]], axis=2)
    single: np.ndarray = poses.astype(np.float32).astype(np.float64) + 0.0  # rotations -0 into 0
    return single
