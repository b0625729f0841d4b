"""The generated default scene: a corner of a room, a glossy vase, a bouncing ball and a turning ring.

`python -m kpc.tools.dev.scenegen DIR` writes it as a rig of cameras would film it (N3DV layout), with exact pictures
from cameras outside the rig (with `--content half` or `quarter`, a room with fewer objects):

    cam00.mp4 ...         one H.264 video per camera; cam00 is the central one
    poses_bounds.npy      N x 17, the LLFF convention
    gt/cameras.json       novel views (and cam00), OpenGL camera-to-world, with times; gt/*.png are their pictures

The scene consists of signed distance functions that are sphere-traced in numpy; it needs no download and no OpenGL.
"""

import argparse
import json
import math
import multiprocessing
import os
import sys
from collections.abc import Iterator
from concurrent.futures import ProcessPoolExecutor
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from kpc.format.common import cli
from kpc.format.common.errors import UsageError
from kpc.format.common.films import write_video
from kpc.format.common.images import srgb_from_linear, write_image
from kpc.format.common.progress import progress
from kpc.format.scene.cameras import Camera
from kpc.format.scene.rig import look_at
from kpc.tools.dev.processes import end_with_parent
from kpc.tools.dev.scene_geometry import CONTENTS, moving_objects
from kpc.tools.dev.scene_shading import StaticView
from kpc.tools.dev.scene_textures import Textures

# The point that all cameras look at.
TARGET = (0.02, 0.1, 0.56)

# Azimuth and elevation in degrees and distance in metres of cam00.
CENTRAL = (14.0, 12.0, 3.55)


@dataclass(frozen=True)
class Options:
    """What to write; the help of the command line describes each field."""

    seed: int = 0
    cameras: int = 12
    frames: int = 30
    width: int = 192
    height: int = 144
    fps: float = 12.0
    samples: int = 3
    content: str = "full"  # a key of CONTENTS


def _camera(eye: np.ndarray, options: Options) -> Camera:
    """Return a camera at `eye` (3,) that looks at TARGET with z up; it is about 50 degrees wide."""
    pose = look_at(eye, np.array(TARGET), np.array([0.0, 0.0, 1.0]))
    focal = 1.06 * options.width
    return Camera(options.width, options.height, focal, focal, options.width / 2, options.height / 2, pose)


def _at(azimuth: float, elevation: float, distance: float, options: Options) -> Camera:
    """Return a camera by its angles in degrees: azimuth 0 looks along +y, elevation 0 is level."""
    a, e = math.radians(azimuth), math.radians(elevation)
    offset = distance * np.array([math.sin(a) * math.cos(e), -math.cos(a) * math.cos(e), math.sin(e)])
    return _camera(np.array(TARGET) + offset, options)


def rig(options: Options) -> list[Camera]:
    """Return cam00 and the others in two rows around it.

    The rig is 0.4 of its distance to the scene wide; positions are jittered by half a degree.
    """
    rng = np.random.default_rng(options.seed)
    cameras = [_at(*CENTRAL, options)]
    others = options.cameras - 1
    for k in range(others):
        across = -11 + 22 * k / max(others - 1, 1)
        up = 5.5 if k % 2 else -5.5
        azimuth, elevation = np.array((across, up)) + rng.uniform(-0.5, 0.5, 2)
        cameras.append(
            _at(CENTRAL[0] + azimuth, CENTRAL[1] + elevation, CENTRAL[2] + rng.uniform(-0.05, 0.05), options)
        )
    return cameras


def novel_cameras(options: Options) -> list[Camera]:
    """Return four cameras between those of the rig."""
    return [
        _at(CENTRAL[0] + a, CENTRAL[1] + e, CENTRAL[2], options)
        for a, e in ((-6.3, 1.5), (5.1, 2.8), (8.0, -1.2), (-2.2, -3.4))
    ]


class FixedCamera:
    """A camera that does not move and renders pictures at any time."""

    def __init__(self, camera: Camera, options: Options) -> None:
        self.camera, self.samples = camera, options.samples
        self.textures = Textures(options.seed, CONTENTS[options.content])
        fine = camera.resized(camera.width * options.samples, camera.height * options.samples)
        origins, directions = fine.rays()
        self.view = StaticView(self.textures, np.ascontiguousarray(origins.T), np.ascontiguousarray(directions.T))

    def picture(self, time: float) -> np.ndarray:
        """Render the picture at a time in [0, 1], uint8 (height, width, 3).

        The samples^2 rays of a pixel are averaged after the tone curve, so that bright edges stay smooth.
        """
        linear = self.view.radiance(time)
        shown = srgb_from_linear(1.12 * linear / (1 + 0.18 * linear))
        s, w, h = self.samples, self.camera.width, self.camera.height
        return np.rint(255 * shown.reshape(3, h, s, w, s).mean((2, 4))).astype(np.uint8).transpose(1, 2, 0)

    def depths(self) -> tuple[float, float]:
        """Return the least and greatest depth along the optical axis over the clip."""
        forward = -self.camera.camera_to_world[:3, 2]
        depth = self.view.t * (self.view.directions.T @ forward.astype(np.float32))
        centre = self.camera.camera_to_world[:3, 3]
        near = min(
            float((moving.centre - centre) @ forward) - moving.radius
            for t in np.linspace(0, 1, 64)
            for moving in moving_objects(t, self.textures.content)
        )
        return min(near, float(depth.min())), float(depth.max())


@dataclass(frozen=True)
class _Job:
    """What one process renders: the video of a camera (none where `times` is empty) and some of its frames as PNG."""

    camera: Camera
    name: str
    times: list[float]
    stills: list[int]
    options: Options
    folder: Path

    def time(self, frame: int) -> float:
        return frame / max(self.options.frames - 1, 1)


def generate(target: str | os.PathLike[str], options: Options) -> None:
    """Write the scene into the folder `target`, which is made if need be; the module's head lists the files.

    Raises:
        MediaError: ffmpeg cannot write.
        OSError: the folder cannot be written.
    """
    folder = Path(target)
    (folder / "gt").mkdir(parents=True, exist_ok=True)
    last = options.frames - 1
    times = [k / max(last, 1) for k in range(options.frames)]
    stills = sorted({0, options.frames // 4, options.frames // 2, 3 * options.frames // 4, last})
    cameras = rig(options)
    jobs = [
        _Job(camera, f"cam{k:02d}", times, stills if k == 0 else [], options, folder)
        for k, camera in enumerate(cameras)
    ]
    jobs += [
        _Job(camera, f"novel{k:02d}", [], stills[1:-1] or stills, options, folder)
        for k, camera in enumerate(novel_cameras(options))
    ]
    with ProcessPoolExecutor(
        min(os.cpu_count() or 1, len(jobs)), multiprocessing.get_context("spawn"), end_with_parent
    ) as pool:
        depths = list(progress(pool.map(_film, jobs), "filming", len(jobs), "camera"))
    rows = [
        _poses_bounds(camera, *bounds) for camera, bounds in zip(cameras, depths, strict=False)
    ]  # novel views have no row
    with cli.atomic_write(folder / "poses_bounds.npy") as aside:
        np.save(aside, np.array(rows))
    frames = [
        {
            "file": f"{job.name}_f{k:03d}.png",
            "time": job.time(k),
            "frame": k,
            "camera": job.name,
            "transform_matrix": job.camera.camera_to_world.tolist(),
        }
        for job in jobs
        for k in job.stills
    ]
    c = cameras[0]
    document = {"w": c.width, "h": c.height, "fl_x": c.fl_x, "fl_y": c.fl_y, "cx": c.cx, "cy": c.cy, "frames": frames}
    with cli.atomic_write(folder / "gt" / "cameras.json") as aside:
        aside.write_text(json.dumps(document, indent=1))


def _film(job: _Job) -> tuple[float, float]:
    """Write one camera's video and stills; return its least and greatest depth."""
    film = FixedCamera(job.camera, job.options)
    for k in job.stills:
        write_image(job.folder / "gt" / f"{job.name}_f{k:03d}.png", film.picture(job.time(k)))
    if job.times:
        frames: Iterator[np.ndarray] = (film.picture(time) for time in job.times)
        write_video(job.folder / f"{job.name}.mp4", frames, job.options.fps, crf=14, pix_fmt="yuv444p")
    return film.depths()


def _poses_bounds(camera: Camera, least: float, greatest: float) -> np.ndarray:
    """Return LLFF's 17 numbers: [down right backwards centre | (h w f)], 0.9 of the least depth, 1.1 of the largest."""
    right, up, back, centre = camera.camera_to_world[:3].T
    columns = np.stack([-up, right, back, centre, [camera.height, camera.width, camera.fl_x]], axis=1)
    return np.concatenate([columns.ravel(), [0.9 * least, 1.1 * greatest]])


def main(argv: list[str] | None = None) -> int:
    """Run the command and return its exit code."""
    return cli.run(_command, "scenegen", argv)


def _parser() -> argparse.ArgumentParser:
    default = Options()
    parser = cli.Parser("scenegen", description="Write the generated default scene: posed videos and ground truth.")
    cli.add_version_option(parser)
    parser.add_argument("folder", metavar="DIR", help="the folder to write; it is made if need be")
    parser.add_argument(
        "--seed", type=int, default=default.seed, help="seed of textures and camera jitter (default %(default)s)"
    )
    parser.add_argument(
        "--cameras", type=int, default=default.cameras, help="number of cameras in the rig (default %(default)s)"
    )
    parser.add_argument(
        "--frames", type=int, default=default.frames, help="number of frames in the clip (default %(default)s)"
    )
    parser.add_argument(
        "--size", default=f"{default.width}x{default.height}", help="size of a frame, WxH (default %(default)s)"
    )
    parser.add_argument("--fps", type=float, default=default.fps, help="frames per second (default %(default)s)")
    parser.add_argument(
        "--samples", type=int, default=default.samples, help="rays across each side of a pixel (default %(default)s)"
    )
    parser.add_argument(
        "--content",
        choices=tuple(CONTENTS),
        default=default.content,
        help="which share of all objects and textures the room holds (default %(default)s)",
    )
    return parser


def _command(argv: list[str]) -> None:
    given = _parser().parse_args(argv)
    try:
        width, height = (int(n) for n in given.size.lower().split("x"))
    except ValueError as error:
        raise UsageError(f"--size {given.size}: write it as 192x144") from error
    if (
        given.cameras < 2
        or given.frames < 1
        or given.samples < 1
        or min(width, height) < 8
        or not given.fps > 0
        or given.seed < 0
    ):
        raise UsageError(
            "at least 2 cameras, 1 frame, 1 sample, 8x8 pixels, a positive fps and a seed of at least 0 are needed"
        )
    options = Options(given.seed, given.cameras, given.frames, width, height, given.fps, given.samples, given.content)
    generate(given.folder, options)
    print(given.folder)


if __name__ == "__main__":
    sys.exit(main())
