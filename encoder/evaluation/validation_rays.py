"""What coding costs, measured on rays: against what was filmed, and against the pictures of the uncoded model."""

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

VALIDATION_RAYS = 1 << 15
"""Rays on which the loss of coding is measured."""

MAX_DRAWS = 16
"""Times that rays are drawn, to find enough that pass where anything may be."""

ASSUMED_MSE = 1e-3
"""Of the pictures of a .kpc file, which does not know what was filmed: 30 dB, about what moving scenes reach. Errors of coding add
to it, for training leaves none that go with them."""


@dataclass(frozen=True)
class Fidelity:
    """A coded scene on probe rays.

    Attributes:
        psnr: dB, against what was filmed.
        mse: mean squared difference from the uncoded scene's colours, in squares of 8-bit levels.
    """

    psnr: float
    mse: float

    @property
    def agreement_db(self) -> float:
        """PSNR against the uncoded scene, dB."""
        return agreement_db(self.mse)


def agreement_db(error: float) -> float:
    """PSNR of a mean squared error in squares of 8-bit levels, dB; 100 at most."""
    return psnr_from_mse(error / 255**2)


def mse_of_psnr(psnr: float) -> float:
    """The mean squared error of a PSNR, in squares of 8-bit levels."""
    return 255**2 * 10 ** (-psnr / 10)


Measure = Callable[[Scene], Fidelity]


@dataclass(frozen=True)
class ValidationRays:
    """N rays that a scene is judged by.

    Attributes:
        origins, directions: (N, 3), times: (N,) float32, as `kpc.encoder.datasets.pixel_rays` makes them.
        appearances: (N,) int64 numbers of their appearances; None for the look without.
        truth: (N, 3) float32, the colours they should have; None where nobody knows.
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
    def from_training_views(sampler: RaySampler, background: np.ndarray) -> "ValidationRays":
        """Pixels of the training pictures."""
        batch, targets = sampler.draw(np.random.default_rng(1), VALIDATION_RAYS, background)
        rays = (a.numpy() for a in (batch.origins, batch.directions, batch.times))
        return ValidationRays(*rays, None if batch.appearances is None else batch.appearances.numpy(), targets.numpy())

    @staticmethod
    def from_cameras(scene: Scene, count: int | None = None, seed: int | Sequence[int] = 1) -> "ValidationRays":
        """Random pixels of a scene's own cameras, or of some all around it where it has none, at random times."""
        rng, total = np.random.default_rng(seed), VALIDATION_RAYS if count is None else count
        cameras = scene.cameras or orbit_cameras(scene)
        counts = np.bincount(rng.integers(len(cameras), size=total), minlength=len(cameras))
        parts = []
        for camera, count in zip(cameras, counts, strict=True):
            places = rng.random((count, 2)) * (camera.width, camera.height)
            parts.append(camera_rays(camera, places, scene.mapping))
        origins, directions = (np.concatenate(arrays) for arrays in zip(*parts))
        return ValidationRays(origins, directions, rng.random(total, dtype=np.float32), None, None)

    @staticmethod
    def through_occupied(scene: Scene, count: int, seed: int) -> "ValidationRays":
        """As `from_cameras`, in random order, those rays alone that pass where anything may be: the others show the background, whatever planes
        hold. Where DRAWS times as many rays hold too few of them, there are fewer. Soldier fills a fifth of its pictures: learnt and judged
        by such rays its planes are 8 % smaller at equal error of held-out views."""
        renderer, rng, parts, missing = SceneRenderer(scene), np.random.default_rng(seed), [], count
        for number in range(MAX_DRAWS):
            drawn = ValidationRays.from_cameras(scene, count, (seed, number))
            parts.append(drawn.subset(rng.permutation(np.flatnonzero(renderer.hits_occupied(*drawn.rays)))[:missing]))
            missing -= len(parts[-1].times)
            if not missing:
                break
        return ValidationRays(*(np.concatenate(arrays) for arrays in zip(*(part.rays for part in parts))), None, None)

    def subset(self, which: np.ndarray) -> "ValidationRays":
        """Those of its rays, by their numbers."""
        return ValidationRays(*(None if a is None else a[which] for a in (*self.rays, self.appearances, self.truth)))

    def batches(self, count: int) -> "Iterator[ValidationRays]":
        """Its rays, so many at a time."""
        for start in range(0, len(self.times), count):
            yield self.subset(np.arange(start, min(start + count, len(self.times))))

    def measure(self, uncoded: Scene) -> Measure:
        """What judges codings of a scene by its colours on these rays; the scene itself costs nothing to judge."""
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
    """Cameras all around a scene's bounds that see all of them, the z axis upwards."""
    bounds = scene.bounds
    middle, reach = bounds.mean(0), float(np.linalg.norm(bounds[1] - bounds[0]))
    cameras = []
    for k in range(count):
        azimuth, height = 2 * math.pi * k / count, 0.35 * (-1) ** k
        backward = np.array(
            [math.cos(azimuth) * math.cos(height), math.sin(azimuth) * math.cos(height), math.sin(height)]
        )
        right = np.array([-math.sin(azimuth), math.cos(azimuth), 0.0])
        pose = np.eye(4)
        pose[:3] = np.stack([right, np.cross(backward, right), backward, middle + 1.5 * reach * backward], axis=1)
        cameras.append(Camera(640, 480, 600.0, 600.0, 320.0, 240.0, pose))
    return tuple(cameras)
