"""One small rig, written as each of the programs that calibrate rigs writes it."""

import json
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

import numpy as np

import datasets as make
from kpc.format.common.films import write_video
from kpc.format.common.images import write_image
from kpc.format.scene.cameras import Camera

WIDTH, HEIGHT = 40, 30

# OpenCV's matrix, whose first pixel has its centre at 0, and k1 k2 p1 p2 k3 of a real lens.
K = np.array([[48.0, 0, 20.4], [0, 46.0, 13.8], [0, 0, 1]])
DIST = (-0.28, 0.11, 1e-3, -5e-4, -0.02)
FISHEYE = (-0.04, 0.02, -0.01, 0.002)

CAMERAS = make.ring(3, width=WIDTH, height=HEIGHT)
POINTS = np.random.default_rng(0).uniform(-0.6, 0.6, (20, 3))


def extrinsics(camera: Camera) -> tuple[np.ndarray, np.ndarray]:
    """Return OpenCV's R (3, 3) and t (3,): x_camera = R x_world + t."""
    rotation = (camera.camera_to_world[:3, :3] * [1, -1, -1]).T
    return rotation, -rotation @ camera.camera_to_world[:3, 3]


def rodrigues(rotation: np.ndarray) -> np.ndarray:
    """Return the axis times the angle of a rotation by less than half a turn, (3,)."""
    across = np.array(
        [rotation[2, 1] - rotation[1, 2], rotation[0, 2] - rotation[2, 0], rotation[1, 0] - rotation[0, 1]]
    )
    angle = np.arccos((np.trace(rotation) - 1) / 2)
    return angle * across / np.linalg.norm(across)


def projected(camera: Camera, fisheye: bool = False) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Project the points as OpenCV documents it: columns and rows of pixels, and depths, (N,) each."""
    rotation, translation = extrinsics(camera)
    x, y, z = (POINTS @ rotation.T + translation).T
    u, v = make.distorted(x / z, y / z, np.array([FISHEYE if fisheye else DIST]), fisheye)
    return K[0, 0] * u + K[0, 2], K[1, 1] * v + K[1, 2], z


def write_images(folder: Path, names: Sequence[str], frames: int = 1) -> None:
    """Write images, names[k] of camera k: a folder of frames if there are several."""
    for name, camera in zip(names, CAMERAS, strict=True):
        for n in range(frames):
            file = folder / name / f"{n:06d}.png" if frames > 1 else folder / f"{name}.png"
            file.parent.mkdir(parents=True, exist_ok=True)
            write_image(file, make.picture(camera, n / max(frames - 1, 1)))


def write_videos(folder: Path, names: Sequence[str]) -> None:
    """Write a video of two frames of each camera."""
    folder.mkdir(parents=True, exist_ok=True)
    for name, camera in zip(names, CAMERAS, strict=True):
        write_video(folder / f"{name}.mp4", (make.picture(camera, t) for t in (0.0, 1.0)), make.FPS)


def opencv_yaml(values: dict[str, Any]) -> str:
    """Return a document of OpenCV's FileStorage: arrays are matrices, lists hold names, the rest are scalars."""
    lines = ["%YAML:1.0", "---"]
    for key, value in values.items():
        if isinstance(value, list):
            lines += [f"{key}:", *(f'  - "{name}"' for name in value)]
        elif isinstance(value, np.ndarray):
            matrix = np.atleast_2d(value if value.ndim == 2 else value[:, None])
            data = ", ".join(f"{number:.17g}" for number in matrix.ravel())
            lines += [f"{key}: !!opencv-matrix", f"  rows: {matrix.shape[0]}", f"  cols: {matrix.shape[1]}"]
            lines += ["  dt: d", f"  data: [{data}]"]
        else:
            lines.append(f"{key}: {value}")
    return "\r\n".join(lines) + "\r\n"


def write_easymocap(folder: Path, frames: int = 2, **more: Any) -> None:
    """Write intri.yml and extri.yml with Rodrigues vectors, and folders of images; `more` adds to intri.yml."""
    names = ["00", "01", "010"]
    intri: dict[str, Any] = {"names": names}
    extri: dict[str, Any] = {"names": names}
    for name, camera in zip(names, CAMERAS, strict=True):
        rotation, translation = extrinsics(camera)
        intri |= {f"K_{name}": K, f"H_{name}": f"{HEIGHT}.0", f"W_{name}": WIDTH, f"D_{name}": np.array(DIST)}
        extri |= {f"R_{name}": rodrigues(rotation), f"T_{name}": translation}
    folder.mkdir(parents=True, exist_ok=True)
    (folder / "intri.yml").write_text(opencv_yaml(intri | more))
    (folder / "extri.yml").write_text(opencv_yaml(extri))
    write_images(folder / "images", names, frames)


def write_panoptic(folder: Path) -> None:
    """Write a calibration in centimetres with a camera of low resolution, and videos."""
    names, cameras = ["00_00", "00_01", "00_10"], []
    for name, camera in zip(names, CAMERAS, strict=True):
        rotation, translation = extrinsics(camera)
        own = {"name": name, "type": "hd", "resolution": [WIDTH, HEIGHT], "K": K.tolist(), "distCoef": DIST}
        cameras.append(own | {"R": rotation.tolist(), "t": (100 * translation)[:, None].tolist()})
    cameras.insert(0, cameras[0] | {"name": "01_01", "type": "vga", "resolution": [20, 15]})
    folder.mkdir(parents=True, exist_ok=True)
    (folder / "calibration_dance.json").write_text(json.dumps({"cameras": cameras}))
    write_videos(folder / "hdVideos", [f"hd_{name}" for name in names])


def table(name: str, camera: Camera, fisheye: bool = False, matrix: bool = False) -> str:
    """Return a table of TOML as Caliscope and Anipose write it, with a Rodrigues vector or a matrix."""
    rotation, translation = extrinsics(camera)
    turned = rotation.tolist() if matrix else rodrigues(rotation).tolist()
    return (
        f"[{name}]\nsize = [{WIDTH}, {HEIGHT}]\nmatrix = {K.tolist()}\ntranslation = {translation.tolist()}\n"
        f"distortions = {list(FISHEYE if fisheye else DIST)}\nrotation = {turned}\n"
        f"fisheye = {str(fisheye).lower()}\n"
    )


def write_caliscope(folder: Path) -> None:
    """Write a workspace with matrices, a camera to be ignored and one without a pose, and one recording."""
    tables = [table(f"cameras.{k}", camera, matrix=True) for k, camera in enumerate(CAMERAS)]
    ignored = table("cameras.7", CAMERAS[0]) + "ignore = true\n"
    folder.mkdir(parents=True, exist_ok=True)
    unposed = f"[cameras.8]\nsize = [{WIDTH}, {HEIGHT}]\n"
    (folder / "camera_array.toml").write_text("\n".join([*tables, ignored, unposed]))
    write_videos(folder / "recordings" / "walk", [f"cam_{k}" for k in range(3)])


def write_anipose(folder: Path) -> None:
    """Write fisheye cameras with Rodrigues vectors, in a folder of their own, and images named as Anipose's videos."""
    tables = [f'{table(f"cam_{k}", camera, fisheye=True)}name = "{"ABC"[k]}"\n' for k, camera in enumerate(CAMERAS)]
    (folder / "calibration").mkdir(parents=True, exist_ok=True)
    (folder / "calibration/calibration.toml").write_text("\n".join(tables) + "[metadata]\nerror = 0.1\n")
    write_images(folder, [f"2019-08-02-vid01-cam{letter}" for letter in "ABC"], frames=2)


def write_qualisys(folder: Path) -> None:
    """Write a calibration of larger sensors, of which a part is filmed, in millimetres and parts of pixels."""
    cameras = []
    for k, camera in enumerate(CAMERAS):
        x, y, z = 1000 * camera.camera_to_world[:3, 3]
        axes = camera.camera_to_world[:3, :3].T  # rows: right, up, backwards
        turned = " ".join(f'r{i + 1}{j + 1}="{axes[i, j]:.17g}"' for i in range(3) for j in range(3))
        intrinsic = " ".join(
            f'{key}="{value:.17g}"'
            for key, value in {
                "sensorMaxU": 64 * 64 - 1,
                "sensorMaxV": 64 * 48 - 1,
                "skew": 0,
                "focalLengthU": 64 * K[0, 0],
                "focalLengthV": 64 * K[1, 1],
                "centerPointU": 64 * (K[0, 2] + 0.5 + 10),
                "centerPointV": 64 * (K[1, 2] + 0.5 + 6),
                "radialDistortion1": DIST[0],
                "radialDistortion2": DIST[1],
                "radialDistortion3": DIST[4],
                "tangentalDistortion1": DIST[2],
                "tangentalDistortion2": DIST[3],
            }.items()
        )
        cameras.append(
            f'<camera serial="2100{k}" calibrated="true" viewrotation="0">'
            f'<fov_video left="10" top="6" right="{10 + WIDTH - 1}" bottom="{6 + HEIGHT - 1}"/>'
            f'<transform x="{x:.17g}" y="{y:.17g}" z="{z:.17g}" {turned}/><intrinsic {intrinsic}/></camera>'
        )
    cameras.append('<camera serial="21009" calibrated="false"></camera>')
    folder.mkdir(parents=True, exist_ok=True)
    (folder / "room.qca.txt").write_text(f"<calibration><cameras>{''.join(cameras)}</cameras></calibration>")
    write_images(folder, [f"Miqus_{k}_2100{k}" for k in range(3)], frames=2)


def write_opencv_json(folder: Path) -> None:
    """Write one JSON document of all cameras, and stills named after them."""
    cameras = {}
    for k, camera in enumerate(CAMERAS):
        rotation, translation = extrinsics(camera)
        own = {"camera_matrix": K.tolist(), "dist_coeffs": [list(DIST)], "image_size": [WIDTH, HEIGHT]}
        cameras[f"cam{k}"] = own | {
            "R": rotation.tolist(),
            "rvec": rodrigues(rotation).tolist(),
            "T": translation.tolist(),
        }
    folder.mkdir(parents=True, exist_ok=True)
    (folder / "cameras.json").write_text(json.dumps({"cameras": cameras}))
    write_images(folder, list(cameras))


def write_opencv_yaml(folder: Path) -> None:
    """Write a document of OpenCV's FileStorage for each camera, and folders of images."""
    (folder / "calib").mkdir(parents=True, exist_ok=True)
    for k, camera in enumerate(CAMERAS):
        rotation, translation = extrinsics(camera)
        own = {"K": K, "dist": np.array(DIST), "R": rotation, "t": translation, "width": WIDTH, "height": HEIGHT}
        (folder / f"calib/left{k}.yml").write_text(opencv_yaml(own))
    write_images(folder / "images", [f"left{k}" for k in range(3)], frames=2)


# How the world of `write_nerfies` becomes the scene: (point - centre) * scale.
CENTRE, SCALE = np.array([0.3, -0.2, 0.1]), 0.25


def write_nerfies(folder: Path) -> None:
    """Write a moving camera at three instants, images of two scales, and a scaled scene."""
    names = ["left1_000000", "left1_000001", "right1_000002"]
    for directory in ("camera", "rgb/1x", "rgb/2x"):
        (folder / directory).mkdir(parents=True, exist_ok=True)
    for name, camera in zip(names, CAMERAS, strict=True):
        pixels = make.picture(camera)
        write_image(folder / f"rgb/2x/{name}.png", pixels[::2, ::2])
        write_image(folder / f"rgb/1x/{name}.png", pixels)
        document = {
            "orientation": extrinsics(camera)[0].tolist(),
            "position": camera.camera_to_world[:3, 3].tolist(),
            "focal_length": K[0, 0],
            "pixel_aspect_ratio": K[1, 1] / K[0, 0],
            "principal_point": [K[0, 2] + 0.5, K[1, 2] + 0.5],
            "skew": 0.0,
            "radial_distortion": [DIST[0], DIST[1], DIST[4]],
            "tangential_distortion": [DIST[2], DIST[3]],
            "image_size": [WIDTH, HEIGHT],
        }
        (folder / f"camera/{name}.json").write_text(json.dumps(document))
    times = {name: {"warp_id": 5 * k, "camera_id": 0} for k, name in enumerate(names)}
    documents = {
        "dataset": {"count": 3, "ids": names, "train_ids": names[:2], "val_ids": names[2:]},
        "metadata": times,
        "scene": {"scale": SCALE, "center": CENTRE.tolist(), "near": 0.1, "far": 2.0},
        "extra": {"fps": 15},
    }
    for name, document in documents.items():
        (folder / f"{name}.json").write_text(json.dumps(document))


# Every layout: what writes it, its name, and whether its cameras are fisheyes.
WRITERS: dict[str, tuple[Callable[[Path], None], str, bool]] = {
    "easymocap": (write_easymocap, "EasyMocap", False),
    "panoptic": (write_panoptic, "Panoptic Studio", False),
    "caliscope": (write_caliscope, "Caliscope", False),
    "anipose": (write_anipose, "Anipose", True),
    "qualisys": (write_qualisys, "Qualisys", False),
    "opencv-json": (write_opencv_json, "OpenCV", False),
    "opencv-yaml": (write_opencv_yaml, "OpenCV", False),
    "nerfies": (write_nerfies, "Nerfies", False),
}
