"""A dataset as training sees it: pictures as a struct of arrays, pixels by index, rays made when they are drawn."""

import hashlib
import math
import os
import sys
from collections.abc import Iterator
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
from kpc.encoder.datasets.capture import Capture, CapturedView
from kpc.encoder.datasets.layouts import blender, colmap, llff, nerfstudio
from kpc.encoder.datasets.masks import FOLDER, Masks, find_masks, load_masks
from kpc.encoder.datasets.pixel_cache import PixelCache, build_cache, fingerprint_of, open_cache
from kpc.format.common.errors import DatasetError, MediaError
from kpc.format.common.media import read_image, read_video
from kpc.format.common.progress import Progress
from kpc.format.scene.cameras import Camera
from kpc.format.scene.scene import Clip
from kpc.format.scene.space import DeviceCoordinates, SpaceMapping

LAYOUTS = (llff, blender, nerfstudio, colmap)
"""The first that recognises a folder reads it: what a sparse model was exported to goes before the model."""

ASSUMED_FPS = 30.0
"""Of images with times, where the dataset does not tell."""

SAME_FRAME = 1e-2
"""Frames that a picture may lie beside its own; times are float32."""


@dataclass(frozen=True)
class Pictures:
    """All pictures of a dataset, one row each: a video's frame or an image.

    Attributes:
        file: name relative to the dataset's folder; a video's is repeated.
        camera: (P,) int32, equal where pose and intrinsics are.
        time: (P,) float32 in [0, 1] over the clip.
        is_test: (P,) bool, held out from training.
        offset: (P,) int64, first pixel in the cache.
        width, height: (P,) int32, pixels in the cache, that is after downscaling.
        intrinsics: (P, 4) float64, fl_x fl_y cx cy, pixels of that raster.
        distortion: (P, 4) float64, k1 k2 p1 p2 of OpenCV's model.
        camera_to_world: (P, 4, 4) float64, OpenGL convention.
        near, far: (P,) float32, depth along the optical axis, NaN where unknown.
    """

    file: tuple[str, ...]
    camera: np.ndarray
    time: np.ndarray
    is_test: np.ndarray
    offset: np.ndarray
    width: np.ndarray
    height: np.ndarray
    intrinsics: np.ndarray
    distortion: np.ndarray
    camera_to_world: np.ndarray
    near: np.ndarray
    far: np.ndarray

    def __len__(self) -> int:
        return len(self.file)

    def subset(self, numbers: np.ndarray) -> "Pictures":
        """These alone."""
        chosen = {name: values[numbers] for name, values in vars(self).items() if name != "file"}
        return Pictures(file=tuple(self.file[n] for n in numbers), **chosen)


@dataclass(frozen=True)
class Dataset:
    """What `load_dataset` found.

    Attributes:
        layout: "N3DV", "LLFF", "Blender", "nerfstudio" or "COLMAP".
        has_alpha: pixels have four channels, the last a straight alpha; else three.
        camera_names: by the number in `pictures.camera`.
        masks: which pixels may be used, None where all may.
    """

    layout: str
    path: Path
    pictures: Pictures
    pixels: PixelCache
    clip: Clip
    is_dynamic: bool
    has_alpha: bool
    camera_names: tuple[str, ...]
    masks: Masks | None = None

    @property
    def is_monocular(self) -> bool:
        """Whether no two pictures to train on show the same instant of a clip."""
        times = self.pictures.time[~self.pictures.is_test]
        return self.is_dynamic and len(np.unique(times)) == len(times)

    def frame_range(self, first: int, last: int) -> "Dataset":
        """Frames `first` to `last` of the clip, as a clip of their own.

        Raises:
            DatasetError: no picture to train on is of them.
        """
        frame = self.pictures.time.astype(np.float64) * max(self.clip.frame_count - 1, 1)
        numbers = np.flatnonzero((frame > first - SAME_FRAME) & (frame < last + SAME_FRAME))
        times = (frame[numbers] - first) / max(last - first, 1)
        chosen = self._some(numbers, np.clip(times, 0, 1), Clip(last - first + 1, self.clip.fps))
        if chosen.pictures.is_test.all():
            raise DatasetError(
                f"{self.path}: frames {first} to {last} hold no picture to train on; give a longer --group"
            )
        return chosen

    def subsample_frames(self, frame_count: int) -> "Dataset":
        """The clip at no more than so many of its frames, evenly spread."""
        clip = self.clip
        if clip.frame_count <= frame_count:
            return self
        kept = np.linspace(0, clip.frame_count - 1, frame_count).round()
        frame = self.pictures.time.astype(np.float64) * (clip.frame_count - 1)
        numbers = np.flatnonzero(np.isin(np.rint(frame), kept))
        return self._some(
            numbers, self.pictures.time[numbers], Clip(frame_count, clip.fps * frame_count / clip.frame_count)
        )

    def _some(self, numbers: np.ndarray, times: np.ndarray, clip: Clip) -> "Dataset":
        return replace(
            self,
            pictures=replace(self.pictures.subset(numbers), time=times.astype(np.float32)),
            pixels=self.pixels.subset(numbers),
            clip=clip,
            is_dynamic=clip.frame_count > 1,
            masks=None if self.masks is None else self.masks.subset(numbers),
        )

    def describe(self) -> str:
        """What was found, in one line."""
        p = self.pictures
        sizes = sorted(set(zip(p.width.tolist(), p.height.tolist())))
        size = f"{sizes[0][0]}x{sizes[0][1]}" + (f" to {sizes[-1][0]}x{sizes[-1][1]}" if len(sizes) > 1 else "")
        parts = [
            f"{self.layout}: {_count(len(self.camera_names), 'camera')}",
            f"{_count(len(p), 'picture')} of {size}",
            f"{int(p.is_test.sum())} held out{self._held_out()}",
        ]
        if self.is_dynamic:
            clip = self.clip
            frames = _count(clip.frame_count, "frame")
            parts.append(f"dynamic, {frames} at {clip.fps:.5g} fps ({clip.duration_s:.4g} s)")
            if self.is_monocular:
                parts.append("one view at a time")
        else:
            parts.append("static")
        if self.has_alpha:
            parts.append("alpha")
        if p.distortion.any():
            parts.append("distortion")
        if self.masks is not None:
            area = (p.width.astype(np.int64) * p.height).sum()
            parts.append(f"masks ({1 - self.usable_counts.sum() / area:.1%} ignored)")
        return ", ".join(parts)

    @property
    def usable_counts(self) -> np.ndarray:
        """(P,) int64, how many pixels of each picture may be used."""
        if self.masks is not None:
            return self.masks.counts
        return self.pictures.width.astype(np.int64) * self.pictures.height

    def nth_usable(self, picture: np.ndarray, rank: np.ndarray) -> np.ndarray:
        """Pixels, counted row by row, that are usable number `rank` of their pictures: both (N,), as the result, int64."""
        return rank if self.masks is None else self.masks.nth_usable(picture, rank)

    def is_usable(self, picture: np.ndarray, pixel: np.ndarray) -> np.ndarray:
        """Of pixels counted row by row, (N,) as their pictures, whether they may be used: (N,) bool."""
        return np.ones(len(pixel), bool) if self.masks is None else self.masks.is_usable(picture, pixel)

    def usable(self, picture: int) -> np.ndarray:
        """Which pixels of a picture may be used: (height, width) bool."""
        if self.masks is not None:
            return self.masks.usable(picture)
        return np.ones((self.pictures.height[picture], self.pictures.width[picture]), bool)

    def camera(self, picture: int) -> Camera:
        """The pinhole camera with a picture's intrinsics and without its distortion."""
        p = self.pictures
        fl_x, fl_y, cx, cy = p.intrinsics[picture]
        return Camera(
            int(p.width[picture]),
            int(p.height[picture]),
            float(fl_x),
            float(fl_y),
            float(cx),
            float(cy),
            p.camera_to_world[picture],
        )

    def _held_out(self) -> str:
        names = {self.camera_names[c] for c in self.pictures.camera[self.pictures.is_test]}
        return f" ({names.pop()})" if len(names) == 1 else ""


def load_dataset(
    path: str | os.PathLike[str],
    cache_dir: str | os.PathLike[str],
    *,
    holdout: str | None = None,
    downscale: int = 1,
    progress: bool = True,
) -> Dataset:
    """Recognise a folder by its content, decode it (once: the cache is kept and reused), and describe its cameras.

    Args:
        cache_dir: made if need be; holds one pixels-*.bin a dataset and downscale.
        holdout: a file to hold out, "none", or None for what is the layout's custom.
        downscale: every block of downscale^2 pixels is averaged to one; what is left over right and below is cut off.
            One pixel that is masked out masks its block out.

    Raises:
        DatasetError: the folder is none, is of no known layout, contradicts itself, its masks leave nothing to train on,
            or the cache's disk is full.
        MediaError: a video, image or mask cannot be read.
    """
    root = Path(path)
    try:
        capture = _recognise(root, holdout)
        _check(root, capture, downscale)
        return _load(root, capture, find_masks(root, capture.views), Path(cache_dir), downscale, progress)
    except PermissionError as error:
        raise DatasetError(f"{error.filename or root}: no permission; chmod it or run as its owner") from error


def pixel_rays(
    pictures: Pictures, picture: np.ndarray, column: np.ndarray, row: np.ndarray, mapping: SpaceMapping | None = None
) -> tuple[np.ndarray, np.ndarray]:
    """Rays through pixel centres: (N,) picture, column and row to origins and unit directions, both (N, 3) float32.

    d = normalise(R [x, -y, -1]),  (x, y) = undistort((column + 0.5 - cx) / fl_x, (row + 0.5 - cy) / fl_y)

    In world coordinates, or in device coordinates where that is the mapping.
    """
    fl_x, fl_y, cx, cy = pictures.intrinsics[picture].T
    x, y = (column + 0.5 - cx) / fl_x, (row + 0.5 - cy) / fl_y
    distortion = pictures.distortion[picture]
    if distortion.any():
        x, y = undistort(x, y, distortion)
    return _through(x, y, pictures.camera_to_world[picture], mapping)


def camera_rays(
    camera: Camera, places: np.ndarray, mapping: SpaceMapping | None = None
) -> tuple[np.ndarray, np.ndarray]:
    """As `pixel_rays`, through (N, 2) places on the raster of a pinhole camera, pixels from the left and top edges."""
    x, y = ((places - (camera.cx, camera.cy)) / (camera.fl_x, camera.fl_y)).T
    return _through(x, y, camera.camera_to_world[None], mapping)


def _through(
    x: np.ndarray, y: np.ndarray, pose: np.ndarray, mapping: SpaceMapping | None
) -> tuple[np.ndarray, np.ndarray]:
    """Rays of (N,) slopes in the frames of (N or 1, 4, 4) cameras."""
    directions = pose[:, :3, 0] * x[:, None] - pose[:, :3, 1] * y[:, None] - pose[:, :3, 2]
    directions /= np.linalg.norm(directions, axis=1, keepdims=True)
    origins = np.broadcast_to(pose[:, :3, 3], directions.shape)
    if isinstance(mapping, DeviceCoordinates):
        path = mapping.rays(origins, directions)
        origins, directions = path.origins, path.directions
    return origins.astype(np.float32), directions.astype(np.float32)


def undistort(x: np.ndarray, y: np.ndarray, distortion: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Invert OpenCV's model by Newton's method, on (N,) normalised coordinates (y down) with (N, 4) k1 k2 p1 p2.

    x_d = x (1 + k1 r^2 + k2 r^4) + 2 p1 x y + p2 (r^2 + 2 x^2)
    y_d = y (1 + k1 r^2 + k2 r^4) + p1 (r^2 + 2 y^2) + 2 p2 x y

    Where the model folds over (far outside what was calibrated) the iteration stays bounded; its result means nothing.
    """
    k1, k2, p1, p2 = distortion.T
    u, v = x, y
    for _ in range(12):
        r2 = u * u + v * v
        radial = 1 + r2 * (k1 + r2 * k2)
        slope = 2 * (k1 + 2 * k2 * r2)
        error_x = u * radial + 2 * p1 * u * v + p2 * (r2 + 2 * u * u) - x
        error_y = v * radial + p1 * (r2 + 2 * v * v) + 2 * p2 * u * v - y
        xx = radial + u * u * slope + 2 * p1 * v + 6 * p2 * u
        yy = radial + v * v * slope + 6 * p1 * v + 2 * p2 * u
        xy = u * v * slope + 2 * p1 * u + 2 * p2 * v
        determinant = xx * yy - xy * xy
        determinant = np.where(np.abs(determinant) < 1e-6, 1e-6, determinant)
        step_u = np.clip((yy * error_x - xy * error_y) / determinant, -1, 1)
        step_v = np.clip((xx * error_y - xy * error_x) / determinant, -1, 1)
        u, v = u - step_u, v - step_v
        if max(np.abs(step_u).max(initial=0), np.abs(step_v).max(initial=0)) < 1e-10:
            break
    return u, v


def _recognise(root: Path, holdout: str | None) -> Capture:
    if not root.is_dir():
        problem = "not a directory" if root.exists() else "no such directory"
        raise DatasetError(f"{root}: {problem}; name a folder of posed videos or images")
    if not any(root.iterdir()):
        raise DatasetError(f"{root}: empty directory; name a folder of posed videos or images")
    for layout in LAYOUTS:
        if layout.recognise(root):
            return layout.read(root, holdout)
    raise DatasetError(
        f"{root}: no dataset layout recognised: there is no poses_bounds.npy (N3DV, LLFF), "
        "no transforms_train.json (Blender, D-NeRF), no transforms.json (nerfstudio, instant-ngp) "
        "and no sparse/0 with cameras and images (COLMAP)"
    )


def _check(root: Path, capture: Capture, downscale: int) -> None:
    train = [view for view in capture.views if not view.is_test]
    if not train:
        raise DatasetError(
            f"{root}: every picture is held out, none is left to train on; give --holdout none or add cameras"
        )
    centres = np.stack([view.camera_to_world[:3, 3] for view in train])
    if np.ptp(centres, axis=0).max() <= 1e-6 * max(1.0, np.abs(centres).max()):
        raise DatasetError(
            f"{root}: a single camera that does not move ({train[0].file.name}): depth cannot be told from one place; "
            "add cameras"
        )
    for view in capture.views:
        if downscale < 1 or min(view.width, view.height) < downscale:
            raise DatasetError(
                f"{view.file}: {view.width}x{view.height} cannot be downscaled by {downscale}; lower --downscale"
            )


def _load(
    root: Path, capture: Capture, mask_files: list[Path | None], cache_dir: Path, downscale: int, progress: bool
) -> Dataset:
    views, frame_count = capture.views, _common_frames(root, capture.views)
    lengths = [frame_count if view.video else 1 for view in views]
    of_view = np.repeat(np.arange(len(views)), lengths)  # the view of each picture
    frame = np.concatenate([np.arange(n) for n in lengths])
    place = hashlib.sha256(f"{root.resolve()} {downscale}".encode()).hexdigest()[:12]
    cache = _cached_pixels(root, views, frame_count, cache_dir / f"pixels-{place}.bin", downscale, progress)
    masks = load_masks(root, views, mask_files, cache_dir / f"pixels-{place}-masks.bin", downscale, progress)
    times, clip = _times(root, capture, of_view, frame, frame_count)
    intrinsics = np.array([v.intrinsics for v in views])[of_view] / downscale
    distortion = np.array([v.distortion for v in views])[of_view]
    poses = np.stack([v.camera_to_world for v in views])[of_view]
    files = tuple(views[v].file.relative_to(root).as_posix() for v in of_view)
    camera, first = _distinct(np.concatenate([poses.reshape(-1, 16), intrinsics, distortion], axis=1))
    pictures = Pictures(
        file=files,
        camera=camera,
        time=times.astype(np.float32),
        is_test=np.array([v.is_test for v in views])[of_view],
        offset=np.array([t.offset for t in cache.tiles], np.int64),
        width=np.array([t.width for t in cache.tiles], np.int32),
        height=np.array([t.height for t in cache.tiles], np.int32),
        intrinsics=intrinsics,
        distortion=distortion,
        camera_to_world=poses,
        near=np.array([v.near for v in views], np.float32)[of_view],
        far=np.array([v.far for v in views], np.float32)[of_view],
    )
    names = tuple(Path(files[p]).stem for p in first)
    if masks is not None and not masks.counts[~pictures.is_test].any():
        raise DatasetError(
            f"{root / FOLDER}: 0 stands for ignored, and that is every pixel to train on; invert the masks or move them away"
        )
    is_dynamic = clip.frame_count > 1
    return Dataset(capture.layout, root, pictures, cache, clip, is_dynamic, cache.channels == 4, names, masks)


def _common_frames(root: Path, views: tuple[CapturedView, ...]) -> int:
    """Frames that all videos have; 1 where there are none."""
    videos = {view.file.name: view.video for view in views if view.video}
    rates = {round(video.fps, 3) for video in videos.values()}
    if len(rates) > 1:
        raise DatasetError(f"{root}: videos run at {min(rates):g} to {max(rates):g} fps; bring them to one rate")
    counts = {name: video.frame_count for name, video in videos.items()}
    fewest, most = min(counts.values(), default=1), max(counts.values(), default=1)
    if fewest < most:
        short = min(counts, key=lambda name: counts[name])
        print(
            f"{root}: videos have {fewest} ({short}) to {most} frames; the first {fewest} of each are used",
            file=sys.stderr,
        )
    return fewest


def _times(
    root: Path, capture: Capture, of_view: np.ndarray, frame: np.ndarray, frame_count: int
) -> tuple[np.ndarray, Clip]:
    """Time of each picture in [0, 1], and the clip.

    Videos: frame / (frames - 1). Images: as told, if within [0, 1]; else shifted and scaled to reach from 0 to 1. Their
    clip has as many frames as the median step between times of training fits into it.
    """
    if capture.views[0].video:
        return frame / max(frame_count - 1, 1), Clip(frame_count, float(capture.fps or ASSUMED_FPS))
    told = [view.time for view in capture.views]
    if all(time is None for time in told):
        return np.zeros(len(of_view)), Clip(1, ASSUMED_FPS)
    if any(time is None or not math.isfinite(time) for time in told):
        number = next(k for k, time in enumerate(told) if time is None or not math.isfinite(time))
        name = capture.views[number].file.name
        raise DatasetError(
            f"{root}: {name} has no usable time while other images have; give every frame a time, or none"
        )
    times = np.array(told, np.float64)
    low, high = times.min(), times.max()
    if low < 0 or high > 1:
        print(f"{root}: times run from {low:g} to {high:g}; scaled to [0, 1]", file=sys.stderr)
        times = (times - low) / (high - low) if high > low else np.zeros_like(times)
    steps = np.diff(np.unique(np.round(times[[not view.is_test for view in capture.views]], 6)))
    count = min(1 + round(1 / float(np.median(steps))), len(times)) if len(steps) else 1
    return times, Clip(count, float(capture.fps or ASSUMED_FPS))


def _distinct(rows: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Numbers rows by their first appearance, equal ones alike: (P,) int32, and where each number first appears."""
    _, first, inverse = np.unique(np.round(rows, 9), axis=0, return_index=True, return_inverse=True)
    order = np.argsort(first)
    rank = np.empty_like(order)
    rank[order] = np.arange(len(order))
    return rank[inverse.ravel()].astype(np.int32), first[order]


def _cached_pixels(
    root: Path, views: tuple[CapturedView, ...], frame_count: int, file: Path, downscale: int, progress: bool
) -> PixelCache:
    sources = [
        (view.file.relative_to(root).as_posix(), view.file.stat().st_size, view.file.stat().st_mtime_ns)
        for view in views
    ]
    fingerprint = fingerprint_of(sources, frame_count, downscale)
    cache = open_cache(file, fingerprint)
    if cache is not None:
        return cache
    total = sum(frame_count if view.video else 1 for view in views)
    channels = 4 if any(view.has_alpha for view in views) else 3
    pixels = sum(
        (view.width // downscale) * (view.height // downscale) * (frame_count if view.video else 1) for view in views
    )
    with Progress(f"decoding {root.name}", total, "picture", shown=progress) as bar:

        def pictures() -> Iterator[np.ndarray]:
            for view in views:
                for picture in _decoded(view, frame_count):
                    yield downscale_picture(picture, downscale)
                    bar.advance()

        return build_cache(file, fingerprint, pictures(), channels, pixels * channels)


def _decoded(view: CapturedView, frame_count: int) -> Iterator[np.ndarray]:
    if view.video is None:
        yield read_image(view.file)
        return
    count = 0
    for count, picture in enumerate(read_video(view.file, view.video, frame_count), start=1):
        yield picture
    if count != frame_count:
        raise MediaError(f"{view.file}: {count} of its {view.video.frame_count} frames decode; encode or copy it anew")


def downscale_picture(picture: np.ndarray, factor: int) -> np.ndarray:
    """Average blocks of factor^2 pixels of a uint8 (H, W, 3 or 4) picture; what is left over right and below goes.

    Straight alpha weighs its colours: rgb = sum(rgb a) / sum(a); where a block is all transparent, the plain mean.
    """
    if factor == 1:
        return picture
    height, width = picture.shape[0] // factor, picture.shape[1] // factor
    shape = (height, factor, width, factor, picture.shape[2])
    blocks = picture[: height * factor, : width * factor].reshape(shape).astype(np.uint32)
    area = factor * factor
    mean = (_block_sum(blocks) + area // 2) // area
    if picture.shape[2] == 4:
        alpha = _block_sum(blocks[..., 3:])
        rgb = _block_sum(blocks[..., :3] * blocks[..., 3:])
        mean[..., :3] = np.where(alpha > 0, (rgb + alpha // 2) // np.maximum(alpha, 1), mean[..., :3])
    return mean.astype(np.uint8)


def _block_sum(blocks: np.ndarray) -> np.ndarray:
    """(H, factor, W, factor, C) uint32 to (H, W, C); adding slices is several times faster than sum((1, 3))."""
    total = np.zeros_like(blocks[:, 0, :, 0])
    for j, i in np.ndindex(blocks.shape[1], blocks.shape[3]):
        total += blocks[:, j, :, i]
    return total


def _count(number: int, noun: str) -> str:
    return f"{number} {noun}{'' if number == 1 else 's'}"
