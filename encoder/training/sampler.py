"""Draws the rays of a training step: random pixels of the training pictures."""

import math

import numpy as np
import torch

from kpc.encoder.datasets import Dataset, pixel_rays
from kpc.encoder.field.render import Rays
from kpc.encoder.training.importance import TileWeights
from kpc.encoder.training.refinement import DrawnPixels, Refinement
from kpc.format.scene.space import SpaceMapping


class RaySampler:
    """Draws usable pixels of pictures, uniformly or by weights, and makes their rays.

    Attributes:
        train: (T,) int64, the pictures to draw from.
        frames: (P, 4) int64, columns from and to and rows from and to around the opaque part of each such picture;
            None without alpha, and with masks, which need not agree with it.
    """

    # Margin around the opaque part, as a share of a picture's longer side: an outline is learnt from both of its sides.
    MARGIN = 0.03

    def __init__(
        self,
        dataset: Dataset,
        mapping: SpaceMapping | None = None,
        appearances: np.ndarray | None = None,
        cameras: Refinement | None = None,
        train: np.ndarray | None = None,
    ) -> None:
        """Prepare to draw.

        Args:
            dataset: with the pictures.
            mapping: of the scene.
            appearances: (P,) int64 as from `assign_appearances`, or None where there are none.
            cameras: as corrected; None for those of the dataset.
            train: the pictures to draw from; None for all that are not held out.
        """
        self.dataset, self.mapping, self.appearances, self.cameras = dataset, mapping, appearances, cameras
        self.train = np.flatnonzero(~dataset.pictures.is_test) if train is None else train
        self.ends = np.cumsum(dataset.usable_counts[self.train])
        times, ranks = np.unique(dataset.pictures.time, return_inverse=True)
        self._ranks = ranks.astype(np.min_scalar_type(len(times)))  # numbers of 16 bits are sorted ten times as fast
        self.frames: np.ndarray | None = None
        if dataset.has_alpha and dataset.masks is None:
            self.frames = np.array([self._frame(dataset.pixels.picture(int(p))[..., 3]) for p in self.train], np.int64)
            sizes = (self.frames[:, 1] - self.frames[:, 0]) * (self.frames[:, 3] - self.frames[:, 2])
            self.frame_ends = np.cumsum(sizes)

    def draw(
        self,
        rng: np.random.Generator,
        count: int,
        background: np.ndarray | None = None,
        object_rays: float = 0.0,
        weights: TileWeights | None = None,
    ) -> tuple[Rays, torch.Tensor]:
        """Draw rays, as `draw_pixels` and `rays`; return them and the colours (N, 3) that they should have."""
        return self.rays(rng, self.draw_pixels(rng, count, object_rays, weights), background)

    def draw_pixels(
        self, rng: np.random.Generator, count: int, object_rays: float = 0.0, weights: TileWeights | None = None
    ) -> DrawnPixels:
        """Draw N pixels, ordered by time.

        Args:
            count: N.
            object_rays: share of the pixels that are drawn from `frames`, where there are any.
            weights: by which the others are drawn; None for uniform.
        """
        pictures = self.dataset.pictures
        within = 0 if self.frames is None or not self.frame_ends[-1] else round(object_rays * count)
        if weights is not None:
            picture, row, column = weights.draw(rng, count - within)
        else:
            which, rank = _pick(rng, self.ends, count - within)
            picture = self.train[which]
            row, column = np.divmod(self.dataset.nth_usable(picture, rank), pictures.width[picture])
        if within and self.frames is not None:
            which, rank = _pick(rng, self.frame_ends, within)
            left, right, top, _ = self.frames[which].T
            below, beside = np.divmod(rank, right - left)
            picture = np.concatenate([self.train[which], picture])
            row, column = np.concatenate([top + below, row]), np.concatenate([left + beside, column])
        # Rays of one time read the same rows of the space-time planes, which then stay in the cache.
        order = np.argsort(self._ranks[picture], kind="stable")
        return DrawnPixels(picture[order], row[order], column[order])

    def rays(
        self, rng: np.random.Generator, pixels: DrawnPixels, background: np.ndarray | None = None
    ) -> tuple[Rays, torch.Tensor]:
        """Return the rays of N pixels, and the colours (N, 3) that they should have.

        `background` is RGB (3,), or None for a random one for each ray.
        """
        pictures, (picture, row, column), count = self.dataset.pictures, pixels, len(pixels.picture)
        if self.cameras is None:
            origins, directions = pixel_rays(pictures, picture, column, row, self.mapping)
            times = pictures.time[picture]
        else:
            (origins, directions), times = self.cameras.rays(pixels), self.cameras.times(picture)
        inside = row * pictures.width[picture] + column
        colours = self.dataset.pixels.read(pictures.offset[picture] + inside).astype(np.float32) / np.float32(255)
        if self.cameras is not None:
            colours[:, :3] /= self.cameras.exposures(picture)
        if background is None:
            backgrounds = rng.random((count, 3), dtype=np.float32)
        else:
            backgrounds = np.broadcast_to(background, (count, 3))
        targets = colours[:, :3]
        if self.dataset.has_alpha:
            targets = targets * colours[:, 3:] + backgrounds * (1 - colours[:, 3:])
        jitters = rng.random(count, dtype=np.float32)
        numbers = None if self.appearances is None else self.appearances[picture]
        batch = Rays.from_arrays(origins, directions, times, jitters, backgrounds, appearances=numbers)
        return batch, torch.from_numpy(targets)

    def _frame(self, alpha: np.ndarray) -> tuple[int, int, int, int]:
        """Return the row of `frames` of a picture with alpha (H, W)."""
        rows, columns = np.flatnonzero(alpha.any(1)), np.flatnonzero(alpha.any(0))
        if not len(rows):
            return 0, 0, 0, 0
        (height, width), margin = alpha.shape, math.ceil(self.MARGIN * max(alpha.shape))
        return (
            max(columns[0] - margin, 0),
            min(columns[-1] + 1 + margin, width),
            max(rows[0] - margin, 0),
            min(rows[-1] + 1 + margin, height),
        )


def _pick(rng: np.random.Generator, ends: np.ndarray, count: int) -> tuple[np.ndarray, np.ndarray]:
    """Draw `count` numbers below ends[-1]: which of several consecutive ranges each is in, and its rank there."""
    pixel = rng.integers(ends[-1], size=count)
    which = np.searchsorted(ends, pixel, side="right")
    return which, pixel - np.where(which > 0, ends[which - 1], 0)
