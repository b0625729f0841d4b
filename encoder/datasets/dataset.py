"""A dataset as training sees it: pictures as a struct of arrays, with random access to pixels."""

from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from pathlib import Path

import numpy as np

from kpc.encoder.datasets.capture import Film, printable
from kpc.encoder.datasets.masks import Masks
from kpc.encoder.datasets.pixel_cache import PixelCache
from kpc.format.common.errors import DatasetError
from kpc.format.scene.cameras import Camera
from kpc.format.scene.scene import Clip

# Pixels whose sides differ by less than this share are square; for others the ratio of focal lengths is shown.
SQUARE_PIXELS = 0.01

# Tolerance in frames for assigning a picture to a frame, since times are float32.
SAME_FRAME = 1e-2

SAME_INSTANT = 0.5 + SAME_FRAME  # frames by which pictures of one instant may differ


@dataclass(frozen=True)
class Pictures:
    """All pictures of a dataset, each an image or a frame of a video, as a struct of arrays of length P.

    Attributes:
        file: name relative to the dataset's folder; that of a video is repeated for its frames.
        camera: (P,) int32, number of the camera; the same for equal pose, intrinsics and distortion.
        time: (P,) float32 in [0, 1] over the clip.
        is_test: (P,) bool, held out from training.
        offset: (P,) int64, index of the first pixel in the cache.
        width, height: (P,) int32, size in the cache, that is after downscaling.
        intrinsics: (P, 4) float64, fl_x fl_y cx cy in pixels of that size.
        distortion: (P, 8) float64, the coefficients DISTORTION_KEYS of OpenCV's lens models.
        is_fisheye: (P,) bool, whether they are those of its fisheye model.
        camera_to_world: (P, 4, 4) float64, OpenGL convention.
        near, far: (P,) float32, depth along the optical axis, NaN if unknown.
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
    is_fisheye: np.ndarray
    camera_to_world: np.ndarray
    near: np.ndarray
    far: np.ndarray

    def __len__(self) -> int:
        return len(self.file)

    def subset(self, numbers: np.ndarray) -> "Pictures":
        """Return the given pictures."""
        chosen = {name: values[numbers] for name, values in vars(self).items() if name != "file"}
        return Pictures(file=tuple(self.file[n] for n in numbers), **chosen)


@dataclass(frozen=True)
class Dataset:
    """A dataset for training, as `load_dataset` returns it.

    Attributes:
        layout: "N3DV", "LLFF", or the NAME of another module in `layouts`.
        path: its folder.
        pictures: cameras, times and sizes of all pictures.
        pixels: the decoded pictures.
        clip: the time axis.
        is_dynamic: whether the clip has more than one frame.
        has_alpha: whether pixels have a fourth channel, straight alpha.
        camera_names: by the numbers in `pictures.camera`.
        masks: which pixels may be used; None if all may.
        left_out: how many images or videos in the folders that were read are not used.
        video_start_s: when the whole clip begins, in the seconds of the videos; None without videos.
        downscale: side of the blocks of pixels of the files that were averaged.
        clocks: of videos by their names: the offset and rate that make their times those of the clip.
        poses_found: whether `kpposes` found the poses.
        films: the videos of the pictures, or from which these were taken, by their names.
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
    left_out: int = 0
    video_start_s: float | None = None
    downscale: int = 1
    clocks: Mapping[str, tuple[float, float]] = field(default_factory=dict)
    poses_found: bool = False
    films: Mapping[str, Film] = field(default_factory=dict)

    @property
    def is_monocular(self) -> bool:
        """Whether most training pictures of a dynamic scene are the only one of their instant, to within half a frame.

        Cameras that are not synchronised show each instant at slightly different times.
        """
        frames = np.sort(self.pictures.time[~self.pictures.is_test].astype(np.float64)) * (self.clip.frame_count - 1)
        steps = np.pad(np.diff(frames), 1, constant_values=np.inf)
        nearest = np.minimum(steps[:-1], steps[1:])  # distance to the nearest other picture
        return self.is_dynamic and 2 * int((nearest <= SAME_INSTANT).sum()) < len(frames)

    def frame_range(self, first: int, last: int) -> "Dataset":
        """Return the frames `first` to `last` (inclusive) of the clip as a clip of their own.

        Raises:
            DatasetError: there is no training picture among them.
        """
        frame = self.pictures.time.astype(np.float64) * max(self.clip.frame_count - 1, 1)
        numbers = np.flatnonzero((frame > first - SAME_FRAME) & (frame < last + SAME_FRAME))
        times = (frame[numbers] - first) / max(last - first, 1)
        chosen = self._some(numbers, np.clip(times, 0, 1), Clip(last - first + 1, self.clip.fps))
        if chosen.pictures.is_test.all():
            raise DatasetError(
                f"{self.path}: frames {first} to {last} contain no training picture; give a longer --group"
            )
        return chosen

    def subsample_frames(self, frame_count: int) -> "Dataset":
        """Return the clip reduced to at most `frame_count` of its frames, evenly spread."""
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
        """Describe the dataset in one line."""
        p = self.pictures
        sizes = sorted(set(zip(p.width.tolist(), p.height.tolist(), strict=True)))
        size = f"{sizes[0][0]}x{sizes[0][1]}" + (f" to {sizes[-1][0]}x{sizes[-1][1]}" if len(sizes) > 1 else "")
        parts = [
            f"{self.layout}: {_count(len(self.camera_names), 'camera')}",
            f"{_count(len(p), 'picture')} of {size}",
            f"{int(p.is_test.sum())} of them held out{self._held_out()}",
        ]
        if self.left_out:
            parts.append(f"{_count(self.left_out, 'file')} left out")
        if self.is_dynamic:
            clip = self.clip
            frames = _count(clip.frame_count, "frame")
            parts.append(f"dynamic, {frames} at {clip.fps:.5g} fps ({clip.total_s:.4g} s)")
            if self.is_monocular:
                parts.append("monocular")
        else:
            parts.append("static")
        if self.has_alpha:
            parts.append("alpha")
        aspect = p.intrinsics[:, 1] / p.intrinsics[:, 0]
        if np.abs(aspect - 1).max() > SQUARE_PIXELS:
            parts.append(f"fl_y / fl_x {aspect[np.abs(aspect - 1).argmax()]:.4g}")
        if p.distortion.any() or p.is_fisheye.any():
            parts.append("fisheye" if p.is_fisheye.any() else "distortion")
        if self.masks is not None:
            area = (p.width.astype(np.int64) * p.height).sum()
            parts.append(f"masks ({1 - self.usable_counts.sum() / area:.1%} ignored)")
        return ", ".join(parts)

    @property
    def usable_counts(self) -> np.ndarray:
        """The number of usable pixels of each picture, (P,) int64."""
        if self.masks is not None:
            return self.masks.counts
        return self.pictures.width.astype(np.int64) * self.pictures.height

    def nth_usable(self, picture: np.ndarray, rank: np.ndarray) -> np.ndarray:
        """Return the pixel, counted row by row, that is usable pixel number `rank` of its picture; all (N,) int64."""
        return rank if self.masks is None else self.masks.nth_usable(picture, rank)

    def is_usable(self, picture: np.ndarray, pixel: np.ndarray) -> np.ndarray:
        """Return whether pixels, counted row by row, of the given pictures are usable; (N,) int64 to (N,) bool."""
        return np.ones(len(pixel), bool) if self.masks is None else self.masks.is_usable(picture, pixel)

    def usable(self, picture: int) -> np.ndarray:
        """Return the usable pixels of a picture, (height, width) bool."""
        if self.masks is not None:
            return self.masks.usable(picture)
        return np.ones((self.pictures.height[picture], self.pictures.width[picture]), bool)

    def camera(self, picture: int) -> Camera:
        """Return the pinhole camera with a picture's pose and intrinsics, without its lens distortion."""
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
        return f" ({printable(names.pop())})" if len(names) == 1 else ""


def _count(number: int, noun: str) -> str:
    return f"{number} {noun}{'' if number == 1 else 's'}"
