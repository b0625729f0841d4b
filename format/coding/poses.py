"""Cameras under codec 2: of each where it is and how it is turned, in 14 bytes (spec, section 9).

    count, lenses (u16) | exponent (i8) | corner (i32[3]) | lenses, 20 bytes each | turns and places, 7 + 7 bytes each

Places are whole multiples of a power of two beyond the corner of the box around all of them. A turn is a unit quaternion without its largest
number, which is positive and follows from the others. Twelve float32 numbers say the same in 48 bytes, of which zstd leaves 40: the cameras
of shelf_hand take 485 bytes in place of 1,319.
"""

import struct
from collections.abc import Sequence
from dataclasses import replace

import numpy as np
from kpc.format.common.errors import FormatError
from kpc.format.scene.cameras import Camera
from kpc.format.scene.rotations import quaternion_of

HEAD = struct.Struct("<HHb3i")
"""count, lenses (one that all share, or one each), exponent, corner"""
LENS = struct.Struct("<HH4f")
"""width, height, fl_x, fl_y, cx, cy"""
WORD = 7
"""Bytes of a turn, and of a place: three numbers of BITS; above those of a turn, which of the quaternion's is left out."""
BITS = 18
ROOT = (1 << BITS - 1) - 1
"""sqrt(1/2) in a turn: right angles are exact, and a picture of a thousand pixels is turned by a hundredth of one at most, or little more."""
NOTHING = 1 << BITS - 1
"""0 in a turn."""
EXACT = 1 << 24
"""Magnitude of whole numbers that are exact in float32."""
FINEST, COARSEST = -126, 30
"""Exponents of places."""
SKEWED = 1e-3
"""How far products of a pose's axes may be from those of a turn."""


def are_rigid(cameras: Sequence[Camera]) -> bool:
    """Whether poses are turns and places, and so may be `round_poses`."""
    axes = _poses(cameras)[:, :, :3]
    products = axes.transpose(0, 2, 1) @ axes
    return bool((np.abs(products - np.eye(3)) < SKEWED).all() and (np.linalg.det(axes) > 0).all())


def round_poses(cameras: Sequence[Camera]) -> tuple[Camera, ...]:
    """`are_rigid` cameras with poses as they come back from a file."""
    exponent, corner, words = _as_words(_poses(cameras))
    return tuple(
        replace(camera, camera_to_world=np.vstack([pose, [0, 0, 0, 1]]))
        for camera, pose in zip(cameras, _from_words(exponent, corner, words), strict=True)
    )


def encode_poses(cameras: Sequence[Camera]) -> bytes | None:
    """Code cameras; None where their poses are not `round_poses`.

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
    words_told = words.astype("<u8").reshape(-1, 1).view(np.uint8)[:, :WORD]
    return HEAD.pack(len(cameras), len(lenses), exponent, *corner.tolist()) + b"".join(lenses) + words_told.tobytes()


def decode_poses(body: bytes, most: int) -> list[tuple[float, ...]]:
    """Undo `encode_poses`: of each camera the numbers of its lens, then 12 of its pose, as codec 0 has them.

    Args:
        most: cameras that there may be.

    Raises:
        FormatError: the body is cut, too long, or says what only a damaged one would.
    """
    if len(body) < HEAD.size:
        raise FormatError("came: cut off within its head")
    count, lens_count, exponent, *corner = HEAD.unpack_from(body)
    if not 0 < count <= most:
        raise FormatError(f"came: {count} cameras (1 to {most} allowed)")
    if lens_count not in (1, count) or not FINEST <= exponent <= COARSEST:
        raise FormatError(
            f"came: {lens_count} lenses of {count} cameras, or places in multiples of 2^{exponent}, make no sense"
        )
    start = HEAD.size + lens_count * LENS.size
    if len(body) != start + 2 * WORD * count:
        raise FormatError(f"came: {len(body):,} bytes are not those of {count} cameras and {lens_count} lenses")
    lenses = list(LENS.iter_unpack(body[HEAD.size : start])) * (count // lens_count)
    told = np.frombuffer(body, np.uint8, offset=start).reshape(-1, WORD)
    words = np.pad(told, ((0, 0), (0, 8 - WORD))).view("<u8").reshape(count, 2)
    poses = _from_words(exponent, np.array(corner, np.int64), words)
    return [(*lens, *pose) for lens, pose in zip(lenses, poses.reshape(count, 12).tolist(), strict=True)]


def _poses(cameras: Sequence[Camera]) -> np.ndarray:
    """(N, 3, 4) float64."""
    return np.stack([camera.camera_to_world[:3] for camera in cameras])


def _as_words(poses: np.ndarray) -> tuple[int, np.ndarray, np.ndarray]:
    """Exponent and (3,) int64 corner of places, and (N, 2) uint64: turns and places of (N, 3, 4) poses."""
    places = poses[:, :, 3]
    extent, reach = float(np.ptp(places, axis=0).max()), float(np.abs(places).max())
    least = max(extent / ((1 << BITS) - 1), reach / EXACT, 2.0**FINEST)
    exponent = int(np.ceil(np.log2(least)))
    multiples = np.rint(np.ldexp(places, -exponent)).astype(np.int64)
    if np.ptp(multiples, axis=0).max() >> BITS:  # rounding made it one more
        exponent += 1
        multiples = np.rint(np.ldexp(places, -exponent)).astype(np.int64)
    corner = multiples.min(0)

    quaternions = quaternion_of(poses[:, :, :3])
    largest = np.abs(quaternions).argmax(1)
    quaternions *= np.sign(quaternions[np.arange(len(poses)), largest])[:, None]
    others = quaternions[np.arange(4) != largest[:, None]].reshape(-1, 3)
    turns = np.rint(others * (np.sqrt(2) * ROOT)).astype(np.int64) + NOTHING
    words = np.stack(
        [_joined(turns) | largest.astype(np.uint64) << np.uint64(3 * BITS), _joined(multiples - corner)], axis=1
    )
    return exponent, corner, words


def _joined(numbers: np.ndarray) -> np.ndarray:
    """(N,) uint64 of (N, 3) numbers of BITS, the first lowest."""
    shifted: np.ndarray = numbers.astype(np.uint64) << np.arange(0, 3 * BITS, BITS, dtype=np.uint64)
    return np.bitwise_or.reduce(shifted, axis=1)


def _parted(words: np.ndarray) -> np.ndarray:
    """What `_joined` undoes, (N, 3) int64."""
    return (words[:, None] >> np.arange(0, 3 * BITS, BITS, dtype=np.uint64) & np.uint64((1 << BITS) - 1)).astype(
        np.int64
    )


def _from_words(exponent: int, corner: np.ndarray, words: np.ndarray) -> np.ndarray:
    """(N, 3, 4) float64 poses, of float32 numbers.

    Raises:
        FormatError: three numbers of a quaternion leave nothing for the fourth, or bits are set that mean nothing.
    """
    words = words.astype(np.uint64)
    largest, others = (words[:, 0] >> np.uint64(3 * BITS)).astype(np.int64), _parted(words[:, 0]) - NOTHING
    rest = 2 * ROOT**2 - (others**2).sum(1)
    if (rest < 0).any() or (words[:, 1] >> np.uint64(3 * BITS)).any():
        raise FormatError("came: a turn or a place is none")
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
    places = np.ldexp((corner + _parted(words[:, 1])).astype(np.float64), exponent)
    poses = np.concatenate([np.moveaxis(axes, -1, 0) / ROOT**2, places[:, :, None]], axis=2)
    single: np.ndarray = poses.astype(np.float32).astype(np.float64) + 0.0  # no 0 has a sign
    return single
