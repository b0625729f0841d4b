"""The pictures of a dataset, decoded, downscaled, and cached in the layout that suits their size."""

import itertools
from collections.abc import Iterator, Sequence
from pathlib import Path

import numpy as np

from kpc.encoder.datasets import pixel_cache
from kpc.encoder.datasets.capture import CapturedView
from kpc.encoder.datasets.packed_cache import Part, Run, build_packed, open_packed, part_fingerprint
from kpc.encoder.datasets.pixel_cache import PixelCache, build_cache, fingerprint_of, open_cache
from kpc.encoder.datasets.video import read_video
from kpc.format.common.errors import DatasetError
from kpc.format.common.images import read_image, read_mask
from kpc.format.common.progress import Progress

# A background pays off for cameras of at least so many pictures.
FEWEST_OF_CAMERA = 8

# The most parts of a packed cache, each of which is an open file.
MOST_PARTS = 256


def cached_pixels(
    root: Path,
    views: Sequence[CapturedView],
    frames: Sequence[range],
    path: Path,
    downscale: int,
    progress: bool,
) -> PixelCache:
    """Open the cache of decoded pictures if it is up to date, else build it.

    Up to `pixel_cache.MAPPED_BYTES`, pictures are stored as they are, which is fastest; so are those of cameras that
    move. Others are packed.

    Args:
        root: the dataset's folder.
        views: of the dataset.
        frames: of each view that are used.
        path: of the cache without suffix: that of a folder, or with .bin that of a file.
        downscale: side of the blocks of pixels that become one.
        progress: whether to report progress on stderr.

    Raises:
        DatasetError: the disk is full.
        MediaError: a video or image cannot be read.
    """
    channels = 4 if any(view.has_alpha for view in views) else 3
    raw_bytes = channels * sum(
        (view.width // downscale) * (view.height // downscale) * len(some)
        for view, some in zip(views, frames, strict=True)
    )
    count = sum(map(len, frames))
    cameras = _cameras(views, frames)
    of_still = sum(size for size in (sum(len(frames[v]) for v in some) for some in cameras) if size >= FEWEST_OF_CAMERA)
    if raw_bytes > pixel_cache.MAPPED_BYTES and 2 * of_still > count:
        parts = _parts(root, views, frames, cameras, channels, downscale)
        packed = open_packed(path, parts, channels)
        if packed is not None:
            return packed
        with Progress(f"decoding {root.name}", count, "picture", shown=progress) as bar:
            return build_packed(path, parts, channels, raw_bytes, bar.advance)
    file = path.with_suffix(".bin")
    sources = [source for view in views for source in _sources(root, view)]
    fingerprint = fingerprint_of(sources, [(some.start, some.stop) for some in frames], downscale)
    flat = open_cache(file, fingerprint)
    if flat is not None:
        return flat
    with Progress(f"decoding {root.name}", count, "picture", shown=progress) as bar:

        def pictures() -> Iterator[np.ndarray]:
            for view, some in zip(views, frames, strict=True):
                for picture in _decoded(view, some, downscale):
                    yield picture
                    bar.advance()

        return build_cache(file, fingerprint, pictures(), channels, raw_bytes)


def _cameras(views: Sequence[CapturedView], frames: Sequence[range]) -> list[list[int]]:
    """Return the numbers of the views of each camera and picture size; a video is the only view of its camera."""
    found: dict[object, list[int]] = {}
    for number, view in enumerate(views):
        pose = view.camera_to_world.tobytes()
        camera = (pose, view.intrinsics, tuple(view.distortion), view.width, view.height)
        found.setdefault(number if view.video else camera, []).append(number)
    return list(found.values())


def _parts(
    root: Path,
    views: Sequence[CapturedView],
    frames: Sequence[range],
    cameras: Sequence[Sequence[int]],
    channels: int,
    downscale: int,
) -> list[Part]:
    """Divide the pictures into parts of a packed cache: one for a camera, or for several where there are many."""
    ends = np.cumsum([len(some) for some in frames])
    count = min(len(cameras), MOST_PARTS)
    bounds = [k * len(cameras) // count for k in range(count + 1)]
    parts = []
    for begin, end in itertools.pairwise(bounds):
        runs, sources = [], []
        for some in cameras[begin:end]:
            numbers = tuple(int(n) for v in some for n in range(ends[v] - len(frames[v]), ends[v]))
            runs.append(Run(numbers, _Decoder([(views[v], frames[v]) for v in some], downscale)))
            sources += [(*source, frames[v].start, frames[v].stop) for v in some for source in _sources(root, views[v])]
        parts.append(Part(part_fingerprint(sources, channels, downscale), tuple(runs)))
    return parts


class _Decoder:
    """Decodes the pictures of some views, one after the other, whenever it is called."""

    def __init__(self, sources: Sequence[tuple[CapturedView, range]], downscale: int) -> None:
        self.sources, self.downscale = sources, downscale

    def __call__(self) -> Iterator[np.ndarray]:
        for view, frames in self.sources:
            yield from _decoded(view, frames, self.downscale)


def _sources(root: Path, view: CapturedView) -> list[tuple[str, int, int, bool]]:
    """Return what identifies the content of a view: names, sizes and times of its files, and whether it is turned."""
    found = []
    for file, upright in ((view.file, view.upright), (view.foreground, False)):
        if file is not None:
            stat = file.stat()
            found.append((file.relative_to(root).as_posix(), stat.st_size, stat.st_mtime_ns, upright))
    return found


def _decoded(view: CapturedView, frames: range, downscale: int) -> Iterator[np.ndarray]:
    """Yield the image of a view, or the given frames of its video, downscaled."""
    if view.video is None:
        picture = read_image(view.file, upright=view.upright)
        pictures = iter([picture if view.foreground is None else _on_nothing(picture, view.foreground)])
    else:
        pictures = read_video(view.file, view.video, frames.start, frames.stop)
    for picture in pictures:
        yield downscale_picture(picture, downscale)


def _on_nothing(picture: np.ndarray, foreground: Path) -> np.ndarray:
    """Return a picture, (H, W, 3 or 4) uint8, with alpha 0 where a mask shows no foreground, (H, W, 4)."""
    shown = read_mask(foreground)
    if shown.shape != picture.shape[:2]:
        raise DatasetError(
            f"{foreground}: is {shown.shape[1]}x{shown.shape[0]}, but its picture is {picture.shape[1]}x"
            f"{picture.shape[0]}; make the mask anew at that size"
        )
    alpha = np.where(shown, picture[..., 3] if picture.shape[2] == 4 else 255, 0).astype(np.uint8)
    return np.concatenate([picture[..., :3], alpha[..., None]], axis=2)


def downscale_picture(picture: np.ndarray, factor: int) -> np.ndarray:
    """Average blocks of factor^2 pixels; the remainder on the right and below is cropped.

    Colours are weighted by straight alpha, rgb = sum(rgb a) / sum(a); fully transparent blocks take the unweighted
    mean.

    Args:
        picture: (H, W, 3 or 4) uint8.
        factor: side of a block, pixels.
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
    """Sum (H, factor, W, factor, C) uint32 to (H, W, C); adding slices is several times faster than sum((1, 3))."""
    total = np.zeros_like(blocks[:, 0, :, 0])
    for j, i in np.ndindex(blocks.shape[1], blocks.shape[3]):
        total += blocks[:, j, :, i]
    return total
