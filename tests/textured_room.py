"""Films of a textured corner of a room by cameras that stand or move, to find these; a block moves before the walls."""

import functools
from collections.abc import Iterable
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from PIL import Image
from scipy import ndimage

from videos import ffmpeg

SIZE = WIDTH, HEIGHT = 256, 192
FOCAL = 240.0
FPS = 20.0

# Walls: the axis that is across each and where, the axes along it, and the seed of its texture.
WALLS = ((2, 0.0, (0, 1), 1), (1, 1.6, (0, 2), 2), (0, -1.8, (1, 2), 3))
OTHER_WALLS = ((0, 3.5, (1, 2), 4), (2, 3.0, (0, 1), 5), (1, -6.0, (0, 2), 6))
PERIOD = 768  # texels, at 128 a metre: more than is seen, since repeated patterns match wrongly


@dataclass(frozen=True)
class RigCamera:
    """A camera.

    Attributes:
        name: of its film.
        pose: camera to world in the OpenGL convention, (4, 4).
        late: by how many frames its film is late.
        focal: pixels.
        is_fisheye: whether a place's distance from the middle grows with the angle from the axis, not its tangent.
    """

    name: str
    pose: np.ndarray
    late: int = 0
    focal: float = FOCAL
    is_fisheye: bool = False


def rig(count: int = 5, late: tuple[int, ...] = ()) -> list[RigCamera]:
    """Return cameras on an arc of 12 degrees a step, 4 m from the origin, z up."""
    return [
        RigCamera(
            f"cam{number:02d}",
            pose_at(12.0 * (number - (count - 1) / 2), 1.2 + 0.25 * (number % 2)),
            late[number] if late else 0,
        )
        for number in range(count)
    ]


def pose_at(azimuth: float, height: float) -> np.ndarray:
    """Return the pose of a camera 4 m from the vertical axis, at degrees around it, which looks at the middle."""
    angle = np.radians(azimuth)
    centre = np.array([4 * np.sin(angle), -4 * np.cos(angle), height])
    back = (centre - [0, 0, 0.6]) / np.linalg.norm(centre - [0, 0, 0.6])
    right = np.cross([0, 0, 1], back) / np.linalg.norm(np.cross([0, 0, 1], back))
    pose = np.eye(4)
    pose[:3] = np.stack([right, np.cross(back, right), back, centre], axis=1)
    return pose


def aligned(found: np.ndarray, true: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return the largest distance of centres as a share of the rig's extent, and angle in degrees, after alignment."""
    u, _, v = np.linalg.svd(sum(true[:, :3, :3] @ found[:, :3, :3].transpose(0, 2, 1)))
    turn = u @ np.diag([1, 1, np.linalg.det(u @ v)]) @ v
    a, b = found[:, :3, 3] @ turn.T, true[:, :3, 3]
    a, b = a - a.mean(0), b - b.mean(0)
    centres = np.linalg.norm(a * (a * b).sum() / (a * a).sum() - b, axis=1).max()
    trace = np.einsum("nij,nij->n", true[:, :3, :3], turn @ found[:, :3, :3])
    return centres / np.linalg.norm(np.ptp(b, axis=0)), np.degrees(np.arccos(np.clip((trace - 1) / 2, -1, 1))).max()


def write_films(folder: Path, cameras: list[RigCamera], frames: int) -> None:
    """Write the film of each camera as NAME.mp4; one that is late lacks the first frames of the take."""
    folder.mkdir(parents=True, exist_ok=True)
    for camera in cameras:
        still = _walls(camera)
        frames_of = (_with_block(still, camera, number / FPS) for number in range(camera.late, frames))
        _write_film(folder / f"{camera.name}.mp4", frames_of, FPS)


def write_walk(file: Path, places: list[RigCamera], fps: float, start_s: float = 0.0) -> None:
    """Write the film of a camera that is at another place in each frame; the first is taken at `start_s`."""
    file.parent.mkdir(parents=True, exist_ok=True)
    frames = (_with_block(_walls(one), one, start_s + number / fps) for number, one in enumerate(places))
    _write_film(file, frames, fps)


def _write_film(file: Path, frames: Iterable[np.ndarray], fps: float) -> None:
    source = ("-f", "rawvideo", "-pix_fmt", "rgb24", "-s", f"{WIDTH}x{HEIGHT}", "-r", fps, "-i", "pipe:")
    raw = b"".join(frame.tobytes() for frame in frames)
    ffmpeg(*source, "-c:v", "libx264", "-crf", 8, "-pix_fmt", "yuv420p", file, frames=raw)


def write_pictures(folder: Path, cameras: list[RigCamera]) -> None:
    """Write what each camera sees where nothing moves, as NAME.png."""
    folder.mkdir(parents=True, exist_ok=True)
    for camera in cameras:
        Image.fromarray(_walls(camera).astype(np.uint8)).save(folder / f"{camera.name}.png")


@functools.cache
def _texture(seed: int) -> np.ndarray:
    """Return (PERIOD, PERIOD, 3) uint8 blobs of several sizes."""
    noise = np.random.default_rng(seed).standard_normal((PERIOD, PERIOD, 3))
    blobs = sum(4 * ndimage.gaussian_filter(noise, (s, s, 0)) * s for s in (1.5, 3.0, 6.0))
    return np.clip(128 + 35 * blobs, 0, 255).astype(np.uint8)


def _walls(camera: RigCamera) -> np.ndarray:
    """Return the picture of floor, back and side wall, (H, W, 3) float64, by intersecting rays with the three.

    A fisheye lens sees the rest of the room, too.
    """
    rays = looks(camera) @ camera.pose[:3, :3].T
    centre, picture, nearest = camera.pose[:3, 3], np.zeros((HEIGHT, WIDTH, 3)), np.full((HEIGHT, WIDTH), np.inf)
    for axis, level, along, seed in WALLS + (OTHER_WALLS if camera.is_fisheye else ()):
        with np.errstate(divide="ignore"):
            depth = (level - centre[axis]) / rays[..., axis]
        hit = (depth > 0) & (depth < nearest)
        place = (centre + np.where(hit, depth, 0.0)[..., None] * rays)[..., along] * 128
        column, row = np.moveaxis(place.astype(int) % PERIOD, -1, 0)
        colours = _texture(seed)[row, column]
        picture[hit], nearest[hit] = colours[hit], depth[hit]
    return picture


def looks(camera: RigCamera) -> np.ndarray:
    """Return where the pixels look in the camera's frame, (H, W, 3) float64."""
    y, x = np.mgrid[:HEIGHT, :WIDTH] + 0.5
    right, up = (x - WIDTH / 2) / camera.focal, -(y - HEIGHT / 2) / camera.focal
    if not camera.is_fisheye:
        return np.stack([right, up, -np.ones_like(x)], axis=-1)
    angle = np.hypot(right, up)
    share = np.sinc(angle / np.pi)
    return np.stack([right * share, up * share, -np.cos(angle)], axis=-1)


def _with_block(still: np.ndarray, camera: RigCamera, time: float) -> np.ndarray:
    """Return a frame, (H, W, 3) uint8: a bright block jumps about above the floor, faster at times."""
    phase = 2.5 * time + 0.9 * np.sin(3.1 * time) + 0.4 * np.sin(7.3 * time)
    place = np.array([0.8 * np.sin(phase), 0.4 * np.cos(1.7 * phase), 0.7 + 0.2 * np.sin(2.3 * phase)])
    seen = np.linalg.inv(camera.pose) @ [*place, 1]
    u, v = (WIDTH / 2 - camera.focal * seen[0] / seen[2], HEIGHT / 2 + camera.focal * seen[1] / seen[2])
    side = int(0.45 * camera.focal / -seen[2])
    block = np.asarray(Image.fromarray(_texture(9)).resize((side, side)))
    frame = still.copy()
    left, top = int(u - side / 2), int(v - side / 2)
    part = frame[max(top, 0) : top + side, max(left, 0) : left + side]
    part[...] = 255 - block[: part.shape[0], : part.shape[1]] // 2
    return frame.astype(np.uint8)
