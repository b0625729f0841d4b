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

from kpc.format.core.decoding import decode_poses
from kpc.format.scene.cameras import Camera
from kpc.format.scene.rotations import quaternion_of

HEAD = struct.Struct("<HHb3i")  # count, lens count (1, shared by all, or one each), exponent, corner
LENS = struct.Struct("<HH4f")  # width, height, fl_x, fl_y, cx, cy
RAW_CAMERA = 68  # bytes of a camera under RAW: its lens, and 12 float32 of its pose
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
    poses = _decoded(_stored(_poses(cameras), [bytes(LENS.size)]), len(cameras))
    return tuple(
        replace(camera, camera_to_world=np.vstack([pose, [0, 0, 0, 1]]))
        for camera, pose in zip(cameras, poses, strict=True)
    )


def encode_poses(cameras: Sequence[Camera]) -> bytes | None:
    """Encode cameras; None where their poses are not those of `round_poses`.

    Raises:
        struct.error: a number does not fit its field.
    """
    if not are_rigid(cameras):
        return None
    lenses = [LENS.pack(c.width, c.height, c.fl_x, c.fl_y, c.cx, c.cy) for c in cameras]
    body = _stored(_poses(cameras), lenses[:1] if len(set(lenses)) == 1 else lenses)
    return body if np.array_equal(_decoded(body, len(cameras)), _poses(cameras)) else None


def _stored(poses: np.ndarray, lenses: Sequence[bytes]) -> bytes:
    """Return the stored bytes of (N, 3, 4) poses, which are rounded, and of one lens or N."""
    exponent, corner, words = _as_words(poses)
    packed = words.astype("<u8").reshape(-1, 1).view(np.uint8)[:, :WORD]
    return HEAD.pack(len(poses), len(lenses), exponent, *corner.tolist()) + b"".join(lenses) + packed.tobytes()


def _decoded(body: bytes, count: int) -> np.ndarray:
    """Return the (N, 3, 4) float64 poses that stored bytes stand for."""
    raw = np.frombuffer(decode_poses(body, 2 + RAW_CAMERA * count), np.uint8, offset=2).reshape(count, RAW_CAMERA)
    return raw[:, LENS.size :].copy().view("<f4").astype(np.float64).reshape(count, 3, 4)


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
