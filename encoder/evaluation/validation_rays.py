"""Rays on which the loss of coding is measured.

The loss is measured against the filmed colours where they are known, and against the renderings of the uncoded model.
Mean squared errors (MSE) are on the 8-bit scale: colours in [0, 1] are multiplied by 255 first.
"""

import math
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass

import numpy as np

from kpc.encoder.datasets import camera_rays
from kpc.encoder.evaluation.evaluate import SceneRenderer
from kpc.encoder.training.sampler import RaySampler
from kpc.format.common.fidelity import psnr, psnr_from_mse
from kpc.format.scene.cameras import Camera
from kpc.format.scene.scene import Scene

VALIDATION_RAYS = 1 << 15  # rays on which the loss of coding is measured
MAX_DRAWS = 16  # attempts at drawing enough rays that pass through occupied cells

# Assumed MSE of the pictures of a .kpc file, on the scale [0, 1], since a file does not know what was filmed: 30 dB,
# which moving scenes typically reach. Coding errors add to it, because training leaves no errors correlated with them.
ASSUMED_MSE = 1e-3


@dataclass(frozen=True)
class Fidelity:
    """Fidelity of a coded scene on validation rays.

    Attributes:
        psnr: PSNR against the filmed colours, dB.
        mse: mean squared difference from the uncoded scene's colours, on the 8-bit scale.
    """

    psnr: float
    mse: float

    @property
    def agreement_db(self) -> float:
        """PSNR against the uncoded scene, dB."""
        return agreement_db(self.mse)


def agreement_db(mse: float) -> float:
    """Return the PSNR in dB of an MSE on the 8-bit scale, at most 100."""
    return psnr_from_mse(mse / 255**2)


def mse_of_psnr(psnr: float) -> float:
    """Return the MSE on the 8-bit scale of a PSNR in dB: 255^2 * 10^(-psnr / 10)."""
    return 255**2 * 10 ** (-psnr / 10)


Measure = Callable[[Scene], Fidelity]  # judges a coded scene


@dataclass(frozen=True)
class ValidationRays:
    """N rays on which a scene is judged.

    Attributes:
        origins: (N, 3) float32, in the space of the planes (`kpc.encoder.datasets.rays`).
        directions: (N, 3) float32 unit vectors.
        times: (N,) float32 in [0, 1].
        appearances: (N,) int64 indices of appearance embeddings; None for the average appearance.
        truth: (N, 3) float32 filmed colours in [0, 1]; None where they are not known.
    """

    origins: np.ndarray
    directions: np.ndarray
    times: np.ndarray
    appearances: np.ndarray | None
    truth: np.ndarray | None

    @property
    def rays(self) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        return self.origins, self.directions, self.times

    @staticmethod
    def from_training_views(sampler: RaySampler, background: np.ndarray, effort: float = 1.0) -> "ValidationRays":
        """Draw random pixels of the training pictures, a share `effort` of VALIDATION_RAYS."""
        batch, targets = sampler.draw(np.random.default_rng(1), int(effort * VALIDATION_RAYS), background)
        origins, directions, times = (a.numpy() for a in (batch.origins, batch.directions, batch.times))
        appearances = None if batch.appearances is None else batch.appearances.numpy()
        return ValidationRays(origins, directions, times, appearances, targets.numpy())

    @staticmethod
    def from_cameras(scene: Scene, count: int | None = None, seed: int | Sequence[int] = 1) -> "ValidationRays":
        """Draw random pixels of a scene's own cameras at random times; of `orbit_cameras` where it has none."""
        rng, total = np.random.default_rng(seed), VALIDATION_RAYS if count is None else count
        cameras = scene.cameras or orbit_cameras(scene)
        counts = np.bincount(rng.integers(len(cameras), size=total), minlength=len(cameras))
        parts = []
        for camera, count in zip(cameras, counts, strict=True):
            pixels = rng.random((count, 2)) * (camera.width, camera.height)
            parts.append(camera_rays(camera, pixels, scene.mapping))
        origins, directions = (np.concatenate(arrays) for arrays in zip(*parts, strict=True))
        return ValidationRays(origins, directions, rng.random(total, dtype=np.float32), None, None)

    @staticmethod
    def through_occupied(scene: Scene, count: int, seed: int) -> "ValidationRays":
        """Draw rays as `from_cameras` does, in random order, but keep only those that pass through occupied cells.

        All other rays show the background whatever the planes hold. Fewer than `count` rays are returned where
        MAX_DRAWS times as many do not suffice (docs/design/rate-distortion.md, "Which rays are drawn").
        """
        renderer, rng, parts, missing = SceneRenderer(scene), np.random.default_rng(seed), [], count
        for number in range(MAX_DRAWS):
            drawn = ValidationRays.from_cameras(scene, count, (seed, number))
            hits = np.flatnonzero(renderer.hits_occupied(*drawn.rays))
            parts.append(drawn.subset(rng.permutation(hits)[:missing]))
            missing -= len(parts[-1].times)
            if not missing:
                break
        origins, directions, times = (
            np.concatenate(arrays) for arrays in zip(*(part.rays for part in parts), strict=True)
        )
        return ValidationRays(origins, directions, times, None, None)

    def subset(self, indices: np.ndarray) -> "ValidationRays":
        """Return the rays with the given indices."""
        origins, directions, times = (a[indices] for a in self.rays)
        appearances, truth = (None if a is None else a[indices] for a in (self.appearances, self.truth))
        return ValidationRays(origins, directions, times, appearances, truth)

    def batches(self, count: int) -> "Iterator[ValidationRays]":
        """Yield the rays in batches of at most `count`."""
        for start in range(0, len(self.times), count):
            yield self.subset(np.arange(start, min(start + count, len(self.times))))

    def measure(self, uncoded: Scene) -> Measure:
        """Return a function that judges codings of `uncoded` by their colours on these rays.

        Judging `uncoded` itself takes no rendering.
        """
        expected = self._colours(uncoded)

        def measure(scene: Scene) -> Fidelity:
            colours = expected if scene is uncoded else self._colours(scene)
            mse = float(np.mean(np.square(colours - expected), dtype=np.float64))
            found = psnr(colours, self.truth) if self.truth is not None else psnr_from_mse(ASSUMED_MSE + mse)
            return Fidelity(found, 255**2 * mse)

        return measure

    def _colours(self, scene: Scene) -> np.ndarray:
        renderer = SceneRenderer(scene)
        return renderer.rgb(*self.rays, renderer.codes(self.appearances))


def orbit_cameras(scene: Scene, count: int = 12) -> tuple[Camera, ...]:
    """Return cameras on a circle around a scene's bounds that see all of it, with the z axis upwards."""
    bounds = scene.bounds
    centre, diagonal = bounds.mean(0), float(np.linalg.norm(bounds[1] - bounds[0]))
    cameras = []
    for k in range(count):
        azimuth, elevation = 2 * math.pi * k / count, 0.35 * (-1) ** k
        backward = np.array(
            [math.cos(azimuth) * math.cos(elevation), math.sin(azimuth) * math.cos(elevation), math.sin(elevation)]
        )
        right = np.array([-math.sin(azimuth), math.cos(azimuth), 0.0])
        pose = np.eye(4)
        position = centre + 1.5 * diagonal * backward
        pose[:3] = np.stack([right, np.cross(backward, right), backward, position], axis=1)
        cameras.append(Camera(640, 480, 600.0, 600.0, 320.0, 240.0, pose))
    return tuple(cameras)
