"""Cameras and points from pictures: runs `colmap_worker` and reads what it found."""

import json
import os
import subprocess
import sys
import tempfile
from collections.abc import Iterable, Sequence
from dataclasses import dataclass, replace
from importlib.util import find_spec
from pathlib import Path
from typing import NamedTuple

import numpy as np

from kpc.encoder.datasets.capture import opengl_pose
from kpc.encoder.poses.instants import Picture
from kpc.encoder.poses.orientation import looked_at
from kpc.format.common import extras
from kpc.format.common.errors import DatasetError
from kpc.format.common.progress import Progress
from kpc.format.scene.camera_models import FISHEYE_MODELS

# The larger side of pictures in which features are looked for, pixels; more are averaged down.
LARGEST_SIDE = 1600
# Where there are more pictures than MANY, larger than FINE_SIDE, features are not sought at twice their resolution.
MANY, FINE_SIDE = 100, 800
# More views than MANY are first placed by so many tracks in each, the longest ones; all tracks adjust them then.
TRACKS = 300

SEED = 0


@dataclass(frozen=True)
class Pairing:
    """Which pictures are matched.

    Attributes:
        steps: those whose views' numbers differ by one of these; None for all pictures of an instant.
        alike: besides, so many others for each picture: those that look most like it.
        every: these are sought among pictures so many apart.
        by_camera: whether steps lead to views of the same camera only, and so many alike are sought in each camera.
        besides: pairs of views that are matched, too, the first one of the lower number.
        without: views that are not matched at all.
    """

    steps: tuple[int, ...] | None = None
    alike: int = 0
    every: int = 1
    by_camera: bool = False
    besides: tuple[tuple[int, int], ...] = ()
    without: tuple[int, ...] = ()


ALL = Pairing()


@dataclass(frozen=True)
class PlacedView:
    """A view whose camera was found.

    Attributes:
        camera_to_world: (4, 4) float64, OpenGL convention.
        intrinsics: fl_x fl_y cx cy in pixels of the picture.
        distortion: k1 k2 p1 p2 of OpenCV's lens model, or k1 k2 k3 k4 of its fisheye model.
        points: number of points that it sees.
        error: mean distance in pixels between projected points and where they were found.
        is_fisheye: whether the lens model is the fisheye model.
    """

    camera_to_world: np.ndarray
    intrinsics: tuple[float, float, float, float]
    distortion: tuple[float, float, float, float]
    points: int
    error: float
    is_fisheye: bool = False


class Pair(NamedTuple):
    """How the features of two views match.

    Attributes:
        matches: how many do.
        agreeing: how many of these agree with one geometry.
        confirmed: share of those that agree with where the views were placed; None if one was not, or none agrees.
    """

    matches: int
    agreeing: int
    confirmed: float | None


@dataclass(frozen=True)
class Structure:
    """What structure from motion found.

    Attributes:
        views: those that were placed, by number.
        points: (N, 3) float64.
        observations: (M, 4) float64: number of the point, of the view, x and y in its picture.
        pairs: how the features of each two views match.
        apart: views that were not placed with these, but with each other.
        dropped: views that were placed, but see too little of what the others see to be believed.
        is_lens_contradicted: whether clearly more matches agree with a lens of the other kind than the user named.
    """

    views: dict[int, PlacedView]
    points: np.ndarray
    observations: np.ndarray
    pairs: dict[tuple[int, int], Pair]
    apart: tuple[int, ...] = ()
    dropped: tuple[int, ...] = ()
    is_lens_contradicted: bool = False

    @property
    def error(self) -> float:
        """Mean reprojection error over the views, pixels."""
        return float(np.mean([view.error for view in self.views.values()])) if self.views else float("inf")


def reconstruct(
    pictures: Iterable[Picture],
    names: Sequence[str],
    cameras: Sequence[int],
    features: int,
    pairing: Pairing = ALL,
    lenses: Sequence[Sequence[int]] = (),
    kind: str = "auto",
) -> Structure:
    """Find cameras and points.

    Args:
        pictures: of all views.
        names: of the views.
        cameras: the number of each view's camera; views of one camera share its lens, to begin with.
        features: at most, in each picture.
        pairing: which pictures are matched.
        lenses: numbers of the views' lenses, in each way that may be chosen for them in the end, from the fewest
            lenses on; those of `cameras` if there is none.
        kind: one of `wishes.LENSES`: of what kind all lenses are.

    Raises:
        DatasetError: COLMAP is not installed, or it failed.
    """
    with tempfile.TemporaryDirectory(prefix="kpposes-") as name:
        folder = Path(name)
        described, largest = [], 0
        sizes: dict[int, tuple[int, int]] = {}
        for number, picture in enumerate(pictures):
            factor = -(-max(picture.grey.shape) // LARGEST_SIDE)
            _write_grey(folder / f"{number}.pgm", _smaller(picture.grey, factor))
            if picture.mask is not None:
                np.save(folder / f"{number}-mask.npy", picture.mask[::factor, ::factor])
            largest = max(largest, *(size // factor for size in picture.grey.shape))
            sizes[cameras[picture.view]] = picture.grey.shape[1], picture.grey.shape[0]
            described.append(
                {
                    "view": picture.view,
                    "instant": picture.instant,
                    "file": f"{number}.pgm",
                    "mask": None if picture.mask is None else f"{number}-mask.npy",
                    "scale": factor,
                }
            )
        job = {
            "seed": SEED,
            "lenses": [list(some) for some in lenses or (cameras,)],
            "kind": kind,
            "features": features,
            "tracks": TRACKS if len(names) > MANY else None,
            "threads": os.cpu_count() or 1,
            "pictures": described,
            "views": [{"name": name, "camera": camera} for name, camera in zip(names, cameras, strict=True)],
            "cameras": [{"size": sizes[number]} for number in sorted(sizes)],
            "first_octave": 0 if len(described) > MANY and largest > FINE_SIDE else -1,
            "pairs": _pairs(described, pairing, cameras),
            "compared": _compared(described, pairing, cameras),
            "alike": pairing.alike,
            "groups": [cameras[picture["view"]] if pairing.by_camera else 0 for picture in described],
        }
        (folder / "job.json").write_text(json.dumps(job))
        _run_worker(folder)
        return _read(folder)


def _smaller(grey: np.ndarray, factor: int) -> np.ndarray:
    if factor == 1:
        return grey
    rows, columns = (size // factor for size in grey.shape)
    blocks = grey[: rows * factor, : columns * factor].reshape(rows, factor, columns, factor)
    return np.asarray(blocks.mean((1, 3)).round(), np.uint8)


def _write_grey(file: Path, grey: np.ndarray) -> None:
    """Write a picture, (H, W) uint8, in the portable greymap format."""
    file.write_bytes(b"P5 %d %d 255\n" % (grey.shape[1], grey.shape[0]) + grey.tobytes())


def _pairs(pictures: list[dict], pairing: Pairing, cameras: Sequence[int]) -> list[tuple[int, int]]:
    """Return the pairs of pictures to be matched: those of one instant, or also of views so many apart."""
    steps, besides, found = pairing.steps, set(pairing.besides), []
    for a, one in enumerate(pictures):
        for b in range(a + 1, len(pictures)):
            two = pictures[b]
            first, second = sorted((one["view"], two["view"]))
            near = steps is None or second - first in steps
            near &= not pairing.by_camera or cameras[first] == cameras[second]
            if first in pairing.without or second in pairing.without:
                continue
            if one["instant"] == two["instant"] and first != second and (near or (first, second) in besides):
                found.append((a, b) if one["view"] == first else (b, a))
    return found


def _compared(pictures: list[dict], pairing: Pairing, cameras: Sequence[int]) -> list[int]:
    """Return the pictures among which others that look alike are sought: so many apart, in each camera by itself."""
    if not pairing.alike:
        return []
    counts: dict[int, int] = {}
    found = []
    for number, picture in enumerate(pictures):
        group = cameras[picture["view"]] if pairing.by_camera else 0
        counts[group] = counts.get(group, -1) + 1
        if counts[group] % pairing.every == 0:
            found.append(number)
    return found


def check_installed() -> None:
    """Check, before work that would be lost, that COLMAP is installed.

    Raises:
        DatasetError: it is not.
    """
    if find_spec("pycolmap") is None:
        raise DatasetError(extras.remedy("pycolmap", "kpposes"))


def _run_worker(folder: Path) -> None:
    command = [sys.executable, "-m", "kpc.encoder.poses.colmap_worker", str(folder)]
    # Pairs are matched in threads of their own; those of the matrix product would only get in their way.
    # COLMAP leaves its log in the folder of temporary files, which is that of the job, and removed with it.
    environment = os.environ | {"OPENBLAS_NUM_THREADS": "1", "TMPDIR": str(folder)}
    with (
        (folder / "log").open("w") as log,
        subprocess.Popen(command, stdout=subprocess.PIPE, stderr=log, text=True, env=environment) as process,
    ):
        assert process.stdout is not None
        try:
            _show_progress(process.stdout)
        except BaseException:
            process.kill()
            raise
    if process.returncode:
        said = (folder / "log").read_text(errors="replace")
        last = said.strip().splitlines()[-1:] or ["no message"]
        raise DatasetError(f"COLMAP ended with code {process.returncode} ({last[0][:200]}); try again, or report it")


def _show_progress(lines: Iterable[str]) -> None:
    step, bar = "", None
    try:
        for line in lines:
            try:
                said = json.loads(line)
            except ValueError:
                continue  # COLMAP's own messages
            if said["step"] != step:
                if bar is not None:
                    bar.__exit__(None, None, None)
                step = said["step"]
                bar = Progress(step, said["total"])
            assert bar is not None
            bar.advance(max(said["done"] - bar.done, 0))
    finally:
        if bar is not None:
            bar.__exit__(None, None, None)


def _read(folder: Path) -> Structure:
    found = json.loads((folder / "result.json").read_text())
    arrays = np.load(folder / "result.npz")
    views = {}
    for number, view in found["views"].items():
        camera_from_world = np.array(view["camera_from_world"])  # (3, 4)
        lens, is_fisheye = view["parameters"], view["model"] in FISHEYE_MODELS
        last = ("k3", "k4") if is_fisheye else ("p1", "p2")
        views[int(number)] = PlacedView(
            opengl_pose(camera_from_world[:, :3], camera_from_world[:, 3]),
            (lens.get("fx", lens.get("f")), lens.get("fy", lens.get("f")), lens["cx"], lens["cy"]),
            (lens.get("k1", lens.get("k", 0.0)), lens.get("k2", 0.0), *(lens.get(name, 0.0) for name in last)),
            view["points"],
            float("nan") if view["error"] is None else view["error"],  # of a view without points
            is_fisheye,
        )
    empty = np.zeros((0, 3))
    return Structure(
        views,
        arrays["points"] if "points" in arrays else empty,
        arrays["observations"] if "observations" in arrays else np.zeros((0, 4)),
        {(one, two): Pair(*facts) for one, two, *facts in found["pairs"]},
        tuple(found["apart"]),
        is_lens_contradicted=found["is_lens_contradicted"],
    )


def oriented(structure: Structure, up: np.ndarray, scale: float) -> Structure:
    """Return the structure turned so that `up`, (3,), is z, with its origin where the cameras look, scaled."""
    poses = np.stack([view.camera_to_world for view in structure.views.values()])
    forward = -poses[:, :3, 2].mean(0)
    y = forward - (forward @ up) * up
    if np.linalg.norm(y) < 1e-6:
        y = np.linalg.svd(up[None])[2][1]
    y /= np.linalg.norm(y)
    turn = np.stack([np.cross(y, up), y, up])  # rows: the new x, y and z axes
    origin = looked_at(poses)
    moved = {number: _moved(view.camera_to_world, turn, origin, scale) for number, view in structure.views.items()}
    return replace(
        structure,
        views={number: replace(view, camera_to_world=moved[number]) for number, view in structure.views.items()},
        points=scale * (structure.points - origin) @ turn.T,
    )


def _moved(pose: np.ndarray, turn: np.ndarray, origin: np.ndarray, scale: float) -> np.ndarray:
    moved = np.eye(4)
    moved[:3, :3] = turn @ pose[:3, :3]
    moved[:3, 3] = scale * turn @ (pose[:3, 3] - origin)
    return moved
