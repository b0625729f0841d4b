"""Space mappings: which place in the planes a point of the world has, and where along a ray the samples lie.

A scene without a mapping is its box: nothing lies outside, and samples are evenly spaced. A `Contraction` puts all of space
into the planes, so that a scene may have surroundings without end.
"""

from dataclasses import dataclass

import numpy as np

FAR = 256.0
"""A ray in contracted space ends at so many times `even`. Seen from within the box, what lies farther would move by less than
1/256 of the parallax of the box's far side, and by less than a texel of any plane of up to 256."""


@dataclass(frozen=True)
class Contraction:
    """The l-infinity version of mip-NeRF 360's contraction (arXiv:2111.12077, eq. 10; K-Planes, arXiv:2301.10241, appendix).

    With c and h the centre and the half edges of the scene's box, y = (p - c) / h and r = max |y_i|,

        contract(p) = y  where r <= 1,  (2 - 1/r) y/r  elsewhere           in the cube [-2, 2]^3

    Planes and occupancy cover that cube: u = contract(p) / 4 + 1/2. The box itself takes its inner half, undistorted.

    Samples are evenly spaced in s, where the distance t along a ray is contracted by the same rule: s = t up to `even`, then
    s = even (2 - even/t). Where rays leave the box, they so move at an even pace through the cube, too; they end at FAR even.

    Density is per unit of length in the cube, measured outwards, so that it means the same to the occupancy grid everywhere
    and that a ray without end has a finite optical depth: the optical thickness of a step ds is

        tau = sigma / extent * ds * (max(1, t/even) / max(1, r))^2         since dt/ds = max(1, t/even)^2

    Attributes:
        even: world units, > 0. About the distance from the cameras to the far side of the box: within it steps are even.
    """

    even: float

    @property
    def end(self) -> float:
        """Where a ray ends, in s: (2 - 1/FAR) even."""
        return (2 - 1 / FAR) * self.even

    def distance(self, s: np.ndarray) -> np.ndarray:
        """t of s >= 0, any shape, in the type of s; beyond the end of a ray as at its end."""
        ahead = np.minimum(s / s.dtype.type(self.even), s.dtype.type(2 - 1 / FAR))
        return np.where(ahead <= 1, s, s.dtype.type(self.even) / (2 - np.maximum(ahead, 1)))

    def progress(self, t: np.ndarray) -> np.ndarray:
        """s of t >= 0, infinity included: the inverse of `distance`."""
        beyond = t.dtype.type(self.even) / np.maximum(t, t.dtype.type(self.even))
        return np.where(t <= self.even, t, t.dtype.type(self.even) * (2 - beyond))

    def stretch(self, t: np.ndarray, radius: np.ndarray) -> np.ndarray:
        """What a step counts for the density: (max(1, t/even) / max(1, radius))^2."""
        return np.square(np.maximum(1, t / t.dtype.type(self.even)) / np.maximum(1, radius))


def contract(points: np.ndarray, aabb: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Places (..., 3) of world points in [0, 1]^3, and their radius r (...) before contraction."""
    y = 2 * ((points - aabb[0]) / (aabb[1] - aabb[0])) - 1
    radius = np.abs(y).max(axis=-1)
    beyond = np.maximum(radius, 1)
    scale = (2 - 1 / beyond) / beyond
    return y * (scale / 4)[..., None] + y.dtype.type(0.5), radius


def expand(u: np.ndarray, aabb: np.ndarray) -> np.ndarray:
    """World points (..., 3) at places inside (0, 1)^3: the inverse of `contract`."""
    z = 4 * u - 2
    reach = np.maximum(np.abs(z).max(axis=-1), 1)
    y = z / (reach * (2 - reach))[..., None]
    return (aabb[0] + aabb[1]) / 2 + y * (aabb[1] - aabb[0]) / 2
