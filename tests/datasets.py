"""Tiny datasets of every layout for tests: a shaded sphere seen by a few cameras over a few frames."""

import json
import struct
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from kpc.encoder.datasets import Dataset, Pictures, load_dataset, pixel_rays
from kpc.format.common.errors import DatasetError, KpcError, MediaError
from kpc.format.common.films import write_video
from kpc.format.common.images import write_image
from kpc.format.scene.camera_models import COLMAP_NUMBERS, PARAMETERS
from kpc.format.scene.cameras import Camera

# Frame rate of the videos.
FPS = 8.0


def look_at(eye: tuple[float, float, float], width: int = 32, height: int = 24) -> Camera:
    """Return a camera that looks at the origin, with z up and about 45 degrees of horizontal view."""
    back = np.asarray(eye, float) / np.linalg.norm(eye)
    right = np.cross([0.0, 0.0, 1.0], back)
    right /= np.linalg.norm(right)
    pose = np.eye(4)
    pose[:3] = np.stack([right, np.cross(back, right), back, np.asarray(eye, float)], axis=1)
    return Camera(width, height, 1.2 * width, 1.2 * width, width / 2, height / 2, pose)


def ring(count: int, **size: int) -> list[Camera]:
    """Return cameras on an arc around the origin."""
    angles = np.linspace(-0.5, 0.5, count)
    return [look_at((3 * np.sin(a), -3 * np.cos(a), 0.8), **size) for a in angles]


def picture(camera: Camera, time: float = 0.0, alpha: bool = False) -> np.ndarray:
    """Render a sphere whose radius grows with time, on a shaded or transparent background, as uint8 (H, W, 3 or 4)."""
    origins, directions = camera.rays()
    along = -(origins * directions).sum(1)
    beside = np.linalg.norm(origins + directions * along[:, None], axis=1)
    inside = beside < 0.5 + 0.3 * time
    colours = np.where(inside[:, None], 128 + 100 * directions, 60 + 40 * directions[:, 2:])
    pixels = np.concatenate([colours, 255.0 * inside[:, None]], axis=1)[:, : 4 if alpha else 3]
    return np.rint(pixels).astype(np.uint8).reshape(camera.height, camera.width, -1)


def poses_bounds(cameras: list[Camera], near: float = 1.0, far: float = 6.0) -> np.ndarray:
    """Return the rows of an LLFF file: [down right backwards centre | (h w f)], near, far."""
    rows = []
    for c in cameras:
        right, up, back, centre = c.camera_to_world[:3].T
        rows.append([*np.stack([-up, right, back, centre, [c.height, c.width, c.fl_x]], axis=1).ravel(), near, far])
    return np.array(rows)


def write_n3dv(folder: Path, cameras: int = 3, frames: int = 4, **size: int) -> list[Camera]:
    """Write synchronised videos in the layout of Neural 3D Video."""
    folder.mkdir(parents=True, exist_ok=True)
    rig = ring(cameras, **size)
    for k, camera in enumerate(rig):
        times = [f / max(frames - 1, 1) for f in range(frames)]
        write_video(folder / f"cam{k:02d}.mp4", (picture(camera, t) for t in times), FPS, crf=1, pix_fmt="yuv444p")
    np.save(folder / "poses_bounds.npy", poses_bounds(rig))
    return rig


def write_llff(folder: Path, images: int = 9) -> list[Camera]:
    """Write images in the layout of LLFF."""
    (folder / "images").mkdir(parents=True, exist_ok=True)
    rig = ring(images)
    for k, camera in enumerate(rig):
        write_image(folder / "images" / f"view{k}.png", picture(camera))
    np.save(folder / "poses_bounds.npy", poses_bounds(rig))
    return rig


def write_blender(folder: Path, dynamic: bool = True, alpha: bool = True) -> None:
    """Write images in the layout of NeRF-synthetic, or of D-NeRF if dynamic."""
    for split, count in (("train", 5), ("val", 2), ("test", 3)):
        (folder / split).mkdir(parents=True, exist_ok=True)
        frames = []
        for k, camera in enumerate(ring(count, width=20, height=20)):
            time = k / (count - 1)
            write_image(folder / split / f"r_{k:03d}.png", picture(camera, time if dynamic else 0.0, alpha))
            frames.append(
                {
                    "file_path": f"./{split}/r_{k:03d}",
                    "rotation": 0.0,
                    "transform_matrix": camera.camera_to_world.tolist(),
                }
            )
            if dynamic:
                frames[-1]["time"] = time
        angle = 2 * np.arctan(20 / 2 / camera.fl_x)
        (folder / f"transforms_{split}.json").write_text(json.dumps({"camera_angle_x": angle, "frames": frames}))


def write_nerfstudio(folder: Path, images: int = 10, times: list[float] | None = None, **document: Any) -> list[Camera]:
    """Write images in the layout of nerfstudio; `document` adds or replaces keys of transforms.json."""
    (folder / "images").mkdir(parents=True, exist_ok=True)
    rig = ring(images)
    frames = []
    for k, camera in enumerate(rig):
        write_image(folder / "images" / f"{k:04d}.png", picture(camera, times[k] if times else 0.0))
        frames.append({"file_path": f"images/{k:04d}.png", "transform_matrix": camera.camera_to_world.tolist()})
        if times:
            frames[-1]["time"] = times[k]
    c = rig[0]
    head = {"w": c.width, "h": c.height, "fl_x": c.fl_x, "fl_y": c.fl_y, "cx": c.cx, "cy": c.cy, "frames": frames}
    (folder / "transforms.json").write_text(json.dumps(head | document))
    return rig


def write_unbounded(folder: Path, images: int = 40) -> list[Camera]:
    """Write images of a ball of radius 0.7 under an infinitely distant sky, from all around and several heights."""
    (folder / "images").mkdir(parents=True, exist_ok=True)
    rig, frames = [], []
    for k in range(images):
        angle, height = 2 * np.pi * k / images, (0.4, 1.2, -0.3)[k % 3]
        rig.append(look_at((3 * np.sin(angle), -3 * np.cos(angle), height), width=40, height=30))
        origins, directions = rig[-1].rays()
        along = -(origins * directions).sum(1)
        beside = np.linalg.norm(origins + directions * along[:, None], axis=1)
        hit = origins + directions * (along - np.sqrt(np.maximum(0.49 - beside**2, 0)))[:, None]
        sky = 128 + 100 * np.sin(6 * directions @ np.array([[1, 0.3, 0], [0, 1, 0.5], [0.6, -0.8, 1]]))
        pixels = np.where(beside[:, None] < 0.7, 128 + 170 * hit, sky)
        write_image(folder / "images" / f"{k:04d}.png", np.rint(pixels).astype(np.uint8).reshape(30, 40, 3))
        frames.append({"file_path": f"images/{k:04d}.png", "transform_matrix": rig[-1].camera_to_world.tolist()})
    c = rig[0]
    head = {"w": c.width, "h": c.height, "fl_x": c.fl_x, "fl_y": c.fl_y, "cx": c.cx, "cy": c.cy, "frames": frames}
    (folder / "transforms.json").write_text(json.dumps(head))
    return rig


def write_varying_exposure(folder: Path, images: int = 32, own_lens: bool = True, unequal: bool = True) -> list[Camera]:
    """Write images of a patterned ball of radius 0.7 on a transparent background, from all around.

    Args:
        unequal: whether each image has an exposure and white balance of its own, from a fixed seed.
        own_lens: whether each image has a focal length of its own.
    """
    (folder / "images").mkdir(parents=True, exist_ok=True)
    rng, rig, frames = np.random.default_rng(11), [], []
    for k in range(images):
        angle, height = 2 * np.pi * k / images, (0.4, 1.2, -0.3)[k % 3]
        camera = look_at((2.4 * np.sin(angle), -2.4 * np.cos(angle), height), width=32, height=32)
        focal = camera.fl_x * (1 + 0.002 * k * own_lens)
        rig.append(Camera(32, 32, focal, focal, 16, 16, camera.camera_to_world))
        gain = rng.uniform(0.45, 1.0) * rng.uniform(0.75, 1.0, 3) if unequal else np.full(3, 0.65)
        origins, directions = rig[-1].rays()
        along = -(origins * directions).sum(1)
        beside = np.linalg.norm(origins + directions * along[:, None], axis=1)
        hit = origins + directions * (along - np.sqrt(np.maximum(0.49 - beside**2, 0)))[:, None]
        pattern = 150 + 100 * np.sin(5 * hit @ np.array([[1, 0.3, 0], [0, 1, 0.5], [0.6, -0.8, 1]]))
        pixels = np.concatenate([gain * pattern, 255.0 * (beside < 0.7)[:, None]], axis=1)
        write_image(folder / "images" / f"{k:04d}.png", np.rint(pixels).astype(np.uint8).reshape(32, 32, 4))
        frames.append(
            {"file_path": f"images/{k:04d}.png", "transform_matrix": camera.camera_to_world.tolist(), "fl_x": focal}
        )
    (folder / "transforms.json").write_text(
        json.dumps({"w": 32, "h": 32, "cx": 16, "cy": 16, "fl_x": 1, "frames": frames})
    )
    return rig


# Camera models by name, with their numbers in binary files.
COLMAP_MODELS = {name: number for number, name in COLMAP_NUMBERS.items()}


def quaternion(rotation: np.ndarray) -> np.ndarray:
    """Return w x y z of a (3, 3) rotation by the method of Bar-Itzhack (2000)."""
    (a, b, c), (d, e, f), (g, h, i) = rotation
    matrix = np.array(
        [
            [a + e + i, h - f, c - g, d - b],
            [h - f, a - e - i, b + d, c + g],
            [c - g, b + d, e - a - i, f + h],
            [d - b, c + g, f + h, i - a - e],
        ]
    )
    return np.linalg.eigh(matrix)[1][:, -1]


def colmap_pose(camera_to_world: np.ndarray) -> tuple[float, ...]:
    """Convert an OpenGL pose into quaternion and translation of x_camera = R x_world + t, y down and z forward."""
    rotation = (camera_to_world[:3, :3] * [1, -1, -1]).T
    return (*quaternion(rotation).tolist(), *(-rotation @ camera_to_world[:3, 3]).tolist())


# Number, model, width, height and parameters.
ColmapCamera = tuple[int, str, int, int, Sequence[float]]

# Number, quaternion and translation, number of the camera, name, and number of points observed.
ColmapImage = tuple[int, Sequence[float], int, str, int]


def write_colmap_model(
    folder: Path, cameras: Sequence[ColmapCamera], images: Sequence[ColmapImage], binary: bool = True
) -> None:
    """Write the files of a COLMAP model, binary or text."""
    folder.mkdir(parents=True, exist_ok=True)
    if not binary:
        lines = ["# Camera list", *(f"{n} {model} {w} {h} {_words(params)}" for n, model, w, h, params in cameras)]
        (folder / "cameras.txt").write_text("\n".join(lines) + "\n")
        lines = ["# Image list with two lines of data per image"]
        for n, pose, camera, name, points in images:
            lines += [f"{n} {_words(pose)} {camera} {name}", " ".join(["1.5 2.5 -1"] * points)]
        (folder / "images.txt").write_text("\n".join(lines) + "\n")
        return
    data = struct.pack("<Q", len(cameras))
    for n, model, w, h, params in cameras:
        data += struct.pack(f"<IiQQ{len(params)}d", n, COLMAP_MODELS[model], w, h, *params)
    (folder / "cameras.bin").write_bytes(data)
    data = struct.pack("<Q", len(images))
    for n, pose, camera, name, points in images:
        data += struct.pack("<I7dI", n, *pose, camera) + name.encode() + b"\0" + struct.pack("<Q", points)
        data += struct.pack("<ddQ", 1.5, 2.5, 2**64 - 1) * points
    (folder / "images.bin").write_bytes(data)


def write_colmap(
    folder: Path, images: int = 10, binary: bool = True, model: str = "PINHOLE", lens: Sequence[float] = ()
) -> list[Camera]:
    """Write images and their COLMAP model, with images numbered in reverse order.

    Args:
        model: COLMAP's camera model.
        lens: its parameters after focal length and principal point.
    """
    (folder / "images").mkdir(parents=True, exist_ok=True)
    rig = ring(images)
    for k, camera in enumerate(rig):
        write_image(folder / "images" / f"{k:04d}.png", picture(camera))
    c = rig[0]
    focal = (c.fl_x, c.fl_y) if PARAMETERS.get(model, "fx").startswith("fx") else (c.fl_x,)
    camera = (7, model, c.width, c.height, (*focal, c.cx, c.cy, *lens))
    posed = [(images - k, colmap_pose(c.camera_to_world), 7, f"{k:04d}.png", k % 3) for k, c in enumerate(rig)]
    write_colmap_model(folder / "sparse" / "0", [camera], posed, binary)
    return rig


def _words(numbers: Sequence[float]) -> str:
    return " ".join(repr(float(number)) for number in numbers)


def write_mask(file: Path, usable: np.ndarray) -> None:
    """Write a mask as an 8-bit grey image, 255 where the (H, W) bool array is set."""
    file.parent.mkdir(parents=True, exist_ok=True)
    write_image(file, np.where(usable, 255, 0).astype(np.uint8))


def edit_json(file: Path, change: Any) -> None:
    """Load a JSON file, let `change` modify the document in place, and save it."""
    document = json.loads(file.read_text())
    change(document)
    file.write_text(json.dumps(document))


def load(folder: Path, **options: object) -> Dataset:
    """Load a dataset with its cache beside it."""
    return load_dataset(folder, folder.parent / "cache", progress=False, **options)


def fails(folder: Path, *words: str, **options: object) -> None:
    """Assert that loading raises a one-line error that contains all these words."""
    with pytest.raises(KpcError) as caught:
        load(folder, **options)
    message = str(caught.value)
    assert isinstance(caught.value, (DatasetError, MediaError))
    assert "\n" not in message and all(word in message for word in words), message


def pictures_of(
    cameras: list[Camera], near: float = np.nan, far: float = np.nan, tests: tuple[int, ...] = ()
) -> Pictures:
    """Return the pictures of pinhole cameras, without files."""
    n = len(cameras)
    return Pictures(
        file=tuple(f"{k}.png" for k in range(n)),
        camera=np.arange(n, dtype=np.int32),
        time=np.zeros(n, np.float32),
        is_test=np.isin(np.arange(n), tests),
        offset=np.zeros(n, np.int64),
        width=np.array([c.width for c in cameras], np.int32),
        height=np.array([c.height for c in cameras], np.int32),
        intrinsics=np.array([[c.fl_x, c.fl_y, c.cx, c.cy] for c in cameras]),
        distortion=np.zeros((n, 8)),
        is_fisheye=np.zeros(n, bool),
        camera_to_world=np.stack([c.camera_to_world for c in cameras]),
        near=np.full(n, near, np.float32),
        far=np.full(n, far, np.float32),
    )


def all_rays(dataset: Dataset, picture: int) -> tuple[np.ndarray, np.ndarray]:
    """Return the rays of all pixels of a picture."""
    camera = dataset.camera(picture)
    row, column = np.divmod(np.arange(camera.width * camera.height), camera.width)
    return pixel_rays(dataset.pictures, np.full(len(row), picture), column, row)


def distorted(
    x: np.ndarray, y: np.ndarray, coefficients: np.ndarray, fisheye: bool = False
) -> tuple[np.ndarray, np.ndarray]:
    """Project slopes through a lens as OpenCV documents it.

    Args:
        x, y: (N,) slopes, y down.
        coefficients: (N or 1, 4 to 8) k1 k2 p1 p2 k3 k4 k5 k6, or (N or 1, 4) k1 k2 k3 k4 of a fisheye lens.
    """
    if fisheye:
        k1, k2, k3, k4 = coefficients.T
        slope = np.hypot(x, y)
        a = np.arctan(slope)
        share = (a + k1 * a**3 + k2 * a**5 + k3 * a**7 + k4 * a**9) / np.maximum(slope, 1e-12)
        return x * share, y * share
    k1, k2, p1, p2, k3, k4, k5, k6 = np.pad(coefficients, ((0, 0), (0, 8 - coefficients.shape[1]))).T
    r2 = x * x + y * y
    radial = (1 + k1 * r2 + k2 * r2**2 + k3 * r2**3) / (1 + k4 * r2 + k5 * r2**2 + k6 * r2**3)
    return x * radial + 2 * p1 * x * y + p2 * (r2 + 2 * x * x), y * radial + p1 * (r2 + 2 * y * y) + 2 * p2 * x * y
