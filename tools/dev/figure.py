"""A generated figure that dances alone: twelve thin rigid parts, one picture at a time, from cameras all around.

`python -m kpc.tools.dev.figure DIR` writes it in the layout of D-NeRF, with straight alpha:

    transforms_train.json, train/*.png    pictures at even times, each from another place on the upper hemisphere
    transforms_test.json, test/*.png      pictures from other places, at times between

Parts are capsules, which rays hit in closed form, textured in their own coordinates; a lamp and the sky light them.
"""

import argparse
import json
import math
import multiprocessing
import os
import sys
from concurrent.futures import ProcessPoolExecutor
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from kpc.format.common import cli
from kpc.format.common.errors import UsageError
from kpc.format.common.images import srgb_from_linear, write_image
from kpc.format.common.progress import progress
from kpc.format.scene.cameras import Camera
from kpc.format.scene.rig import look_at
from kpc.tools.dev.processes import end_with_parent
from kpc.tools.editing.placing import axis_turn

# Distance of the cameras from the origin, which they look at, in metres, and their angles of view and elevation.
DISTANCE = 3.2
ANGLE_OF_VIEW = math.radians(39.6)
ELEVATIONS = (math.radians(3), math.radians(75))

LAMP = np.array([0.5, -0.6, 0.62]) / np.linalg.norm([0.5, -0.6, 0.62])


@dataclass(frozen=True)
class Options:
    """What to write; the help of the command line describes each field."""

    seed: int = 0
    pictures: int = 80
    tests: int = 20
    size: int = 200
    samples: int = 3
    turns: float = 2.0


@dataclass(frozen=True)
class Part:
    """A capsule: all points within `radius` of the segment from `start` to `start + length * turn[:, 2]`.

    Attributes:
        start: (3,) metres.
        turn: (3, 3), the axes of the part's own coordinates as columns.
        colour: (3,) linear RGB.
    """

    start: np.ndarray
    turn: np.ndarray
    length: float
    radius: float
    colour: tuple[float, float, float]

    @property
    def end(self) -> np.ndarray:
        """The other end of the segment, (3,)."""
        return self.start + self.length * self.turn[:, 2]


def _about(axis: str, angle: float) -> np.ndarray:
    """Return the rotation (3, 3) by an angle in radians about "x", "y" or "z"."""
    return axis_turn(axis, math.degrees(angle))


def parts(time: float, turns: float = Options.turns) -> list[Part]:
    """Return the figure at a time in [0, 1]: torso, head, and two arms and legs of two and three parts.

    Arms and legs swing `turns` times a clip about shoulders, elbows, hips, knees and ankles, while the figure turns to
    either side, bends and jumps.
    """
    beat = 2 * math.pi * turns * time
    hip = np.array([0.12 * math.sin(beat / 2), 0.08 * math.sin(beat), 0.12 * math.sin(beat) ** 2 - 0.08])
    body = _about("z", 0.9 * math.sin(beat / 2))
    torso = Part(hip, body @ _about("y", 0.22 * math.sin(beat)), 0.5, 0.12, (0.55, 0.12, 0.1))
    neck = torso.end + 0.2 * torso.turn[:, 2]
    head = Part(neck, torso.turn @ _about("x", 0.3 * math.sin(beat)), 0.1, 0.13, (0.75, 0.5, 0.35))
    found = [torso, head]
    for side in (-1, 1):
        swing = math.sin(beat + side * math.pi / 2)
        shoulder = torso.end + side * 0.2 * torso.turn[:, 0]
        down = torso.turn @ _about("x", math.pi)
        upper_turn = down @ _about("y", side * (1.1 + 0.9 * swing)) @ _about("x", 0.5 * swing)
        upper = Part(shoulder, upper_turn, 0.34, 0.055, (0.1, 0.3, 0.6))
        lower = Part(upper.end, upper.turn @ _about("x", -0.7 - 0.6 * swing), 0.34, 0.045, (0.7, 0.55, 0.1))
        thigh_turn = body @ _about("x", math.pi) @ _about("x", 0.7 * swing) @ _about("y", side * 0.2)
        thigh = Part(hip + side * 0.11 * body[:, 0], thigh_turn, 0.4, 0.07, (0.12, 0.4, 0.16))
        shin = Part(thigh.end, thigh.turn @ _about("x", 0.6 - 0.55 * swing), 0.4, 0.05, (0.4, 0.14, 0.45))
        foot = Part(shin.end, shin.turn @ _about("x", 1.4 + 0.3 * swing), 0.16, 0.045, (0.05, 0.05, 0.06))
        found += [upper, lower, thigh, shin, foot]
    return found


def entry(part: Part, origin: np.ndarray, directions: np.ndarray) -> np.ndarray:
    """Return where rays enter a capsule, in units of their direction, (N,); infinity where they miss it.

    A capsule is a cylinder with a ball at either end. A ray enters it where it first enters one of the three, the
    cylinder counted between the centres of the balls alone. Rays have to start outside.

    Args:
        part: the capsule.
        origin: (3,), where all rays start.
        directions: (N, 3), of unit length.
    """
    axis = part.turn[:, 2]
    offset = origin - part.start
    along_ray, along_offset = directions @ axis, offset @ axis
    first = _first_root(
        1 - along_ray**2,
        directions @ offset - along_ray * along_offset,
        offset @ offset - along_offset**2 - part.radius**2,
    )
    with np.errstate(invalid="ignore"):
        height = along_offset + first * along_ray
        nearest = np.where((height >= 0) & (height <= part.length), first, np.inf)
    for centre in (part.start, part.end):
        offset = origin - centre
        nearest = np.minimum(nearest, _first_root(1.0, directions @ offset, offset @ offset - part.radius**2))
    return nearest


def _first_root(a: np.ndarray | float, half_b: np.ndarray, c: float) -> np.ndarray:
    """Return the smaller root of a t^2 + 2 half_b t + c, infinity where there is none that is positive."""
    with np.errstate(invalid="ignore", divide="ignore"):
        root = (-half_b - np.sqrt(half_b**2 - a * c)) / a
    return np.where(root > 0, root, np.inf)


def radiance(part: Part, points: np.ndarray) -> np.ndarray:
    """Return the linear colours (N, 3) of points (N, 3) on a part: bands along it, fields around it, lit by Lambert."""
    local = (points - part.start) @ part.turn
    height = np.clip(local[:, 2], 0, part.length)
    normal = (points - part.start - height[:, None] * part.turn[:, 2]) / part.radius
    bands = np.sin(2 * math.pi * local[:, 2] / 0.11) * np.sin(3 * np.arctan2(local[:, 1], local[:, 0]) + 0.5)
    albedo = np.array(part.colour) * (1 + 0.6 * np.tanh(4 * bands))[:, None]
    lit = 0.35 + 0.15 * normal[:, 2] + 0.8 * np.maximum(normal @ LAMP, 0)
    shown: np.ndarray = albedo * lit[:, None]
    return shown


def picture(camera: Camera, time: float, options: Options) -> np.ndarray:
    """Render the figure at a time in [0, 1], uint8 (size, size, 4) with straight alpha.

    A pixel's colour is the mean of those of its samples^2 rays that hit, after the transfer curve.
    """
    s, size = options.samples, options.size
    origins, directions = camera.resized(size * s, size * s).rays()
    figure = parts(time, options.turns)
    distances = np.stack([entry(part, origins[0].astype(float), directions.astype(float)) for part in figure])
    nearest, which = distances.min(0), distances.argmin(0)
    colours = np.zeros((len(directions), 3))
    for n, part in enumerate(figure):
        hit = np.flatnonzero((which == n) & np.isfinite(nearest))
        colours[hit] = srgb_from_linear(radiance(part, origins[hit] + directions[hit] * nearest[hit, None]))
    pixels = np.concatenate([colours, np.isfinite(nearest)[:, None]], axis=1)
    mean = pixels.reshape(size, s, size, s, 4).mean((1, 3))
    mean[..., :3] /= np.maximum(mean[..., 3:], 1e-9)
    return np.rint(255 * mean).astype(np.uint8)


def cameras(number: int, options: Options, stream: int) -> list[Camera]:
    """Return cameras at random places on the upper hemisphere; `stream` is 0 for those of training, 1 for tests."""
    rng = np.random.default_rng((options.seed, stream))
    focal = options.size / 2 / math.tan(ANGLE_OF_VIEW / 2)
    found = []
    for azimuth, share in zip(rng.uniform(0, 2 * math.pi, number), rng.uniform(0, 1, number), strict=True):
        low, high = (math.sin(e) for e in ELEVATIONS)
        elevation = math.asin(low + (high - low) * share)  # as many cameras for each area of the sphere
        back = np.array(
            [
                math.cos(azimuth) * math.cos(elevation),
                math.sin(azimuth) * math.cos(elevation),
                math.sin(elevation),
            ]
        )
        pose = look_at(DISTANCE * back, np.zeros(3), np.array([0.0, 0.0, 1.0]))
        found.append(Camera(options.size, options.size, focal, focal, options.size / 2, options.size / 2, pose))
    return found


@dataclass(frozen=True)
class _Job:
    camera: Camera
    time: float
    file: Path
    options: Options


def generate(target: str | os.PathLike[str], options: Options) -> None:
    """Write the dataset into the folder `target`, which is made if need be; the module's head lists the files.

    Raises:
        OSError: the folder cannot be written.
    """
    folder = Path(target)
    jobs = []
    for stream, (split, number) in enumerate((("train", options.pictures), ("test", options.tests))):
        (folder / split).mkdir(parents=True, exist_ok=True)
        times = [k / max(number - 1, 1) if split == "train" else (k + 0.5) / number for k in range(number)]
        views = cameras(number, options, stream)
        jobs += [
            _Job(camera, time, folder / split / f"r_{k:03d}.png", options)
            for k, (camera, time) in enumerate(zip(views, times, strict=True))
        ]
        frames = [
            {
                "file_path": f"./{split}/r_{k:03d}",
                "time": time,
                "transform_matrix": camera.camera_to_world.tolist(),
            }
            for k, (camera, time) in enumerate(zip(views, times, strict=True))
        ]
        with cli.atomic_write(folder / f"transforms_{split}.json") as aside:
            aside.write_text(json.dumps({"camera_angle_x": ANGLE_OF_VIEW, "frames": frames}, indent=1))
    with ProcessPoolExecutor(
        min(os.cpu_count() or 1, len(jobs)), multiprocessing.get_context("spawn"), end_with_parent
    ) as pool:
        for _ in progress(pool.map(_render, jobs), "rendering", len(jobs), "picture"):
            pass


def _render(job: _Job) -> None:
    write_image(job.file, picture(job.camera, job.time, job.options))


def main(argv: list[str] | None = None) -> int:
    """Run the command and return its exit code."""
    return cli.run(_command, "figure", argv)


def _parser() -> argparse.ArgumentParser:
    default = Options()
    parser = cli.Parser("figure", description="Write a generated dancing figure, one picture at a time.")
    cli.add_version_option(parser)
    parser.add_argument("folder", metavar="DIR", help="the folder to write; it is made if need be")
    for name, meaning in (
        ("seed", "seed of the cameras' places"),
        ("pictures", "number of pictures to train on"),
        ("tests", "number of test pictures"),
        ("size", "side of a picture in pixels"),
        ("samples", "rays across each side of a pixel"),
    ):
        parser.add_argument(
            f"--{name}", type=int, default=getattr(default, name), help=f"{meaning} (default %(default)s)"
        )
    parser.add_argument(
        "--turns", type=float, default=default.turns, help="how often limbs swing in a clip (default %(default)s)"
    )
    return parser


def _command(argv: list[str]) -> None:
    given = _parser().parse_args(argv)
    if given.seed < 0 or min(given.pictures, given.tests) < 2 or given.size < 8 or given.samples < 1:
        raise UsageError("a seed of at least 0, 2 pictures of either kind, 8 pixels and 1 sample are needed")
    if not math.isfinite(given.turns):
        raise UsageError(f"--turns {given.turns}: it has to be a finite number")
    generate(given.folder, Options(given.seed, given.pictures, given.tests, given.size, given.samples, given.turns))
    print(given.folder)


if __name__ == "__main__":
    sys.exit(main())
