"""Space mappings: which place in the planes a point of the world has, and where along a ray the samples lie.

A scene without a mapping is its box: nothing lies outside, and samples are evenly spaced. A `Contraction` puts all of space
into the planes, so that a scene may have surroundings without end; `DeviceCoordinates` put in what a rig sees that faces one
way, as finely far off as near by.
"""

from dataclasses import dataclass

import numpy as np

FAR = 256.0
"""A ray in contracted space ends at so many times `even`. Seen from within the box, what lies farther would move by less than
1/256 of the parallax of the box's far side, and by less than a texel of any plane of up to 256."""

MIN_FORWARD = 1e-4
"""Depth that a ray must gain in a unit of its length to be one that goes forward."""

MIN_DISPARITY = 1e-6
"""Of a ray's disparity at its start: what lies farther counts as that far."""


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

    uniform_distance: float

    @property
    def s_end(self) -> float:
        """Where a ray ends, in s: (2 - 1/FAR) even."""
        return (2 - 1 / FAR) * self.uniform_distance

    def distance(self, s: np.ndarray) -> np.ndarray:
        """t of s >= 0, any shape, in the type of s; beyond the end of a ray as at its end."""
        ahead = np.minimum(s / s.dtype.type(self.uniform_distance), s.dtype.type(2 - 1 / FAR))
        return np.where(ahead <= 1, s, s.dtype.type(self.uniform_distance) / (2 - np.maximum(ahead, 1)))

    def parameter(self, t: np.ndarray) -> np.ndarray:
        """s of t >= 0, infinity included: the inverse of `distance`."""
        beyond = t.dtype.type(self.uniform_distance) / np.maximum(t, t.dtype.type(self.uniform_distance))
        return np.where(t <= self.uniform_distance, t, t.dtype.type(self.uniform_distance) * (2 - beyond))

    def density_scale(self, t: np.ndarray, radius: np.ndarray) -> np.ndarray:
        """What a step counts for the density: (max(1, t/even) / max(1, radius))^2."""
        return np.square(np.maximum(1, t / t.dtype.type(self.uniform_distance)) / np.maximum(1, radius))


@dataclass(frozen=True, eq=False)
class DeviceCoordinates:
    """Normalised device coordinates (NeRF, arXiv:2003.08934, appendix C) in which all three axes have one unit.

    With x, y and the depth z > 0 of a point in the frame of one camera, which stands for all,

        place(p) = (x / z,  y / z,  baseline (1 / near - 1 / z))

    Straight lines stay straight: a scene so mapped is a box as any other, and `aabb`, `step`, the directions that colours
    depend on, and what lies between, are in these coordinates. A texel along any axis is about as many pixels: across, as
    pixels see angles; in depth, as a baseline sees parallax.

    Attributes:
        frame: (3, 4) float64, camera-to-world of that camera, orthonormal, OpenGL convention.
        near: world units, > 0. What is nearer to its plane is not held.
        baseline: world units, > 0. About the width of the rig.
    """

    frame: np.ndarray
    near: float
    baseline: float

    def to_device(self, points: np.ndarray) -> np.ndarray:
        """Coordinates (..., 3) of world points (..., 3) of positive depth."""
        local = (points - self.frame[:, 3]) @ self.frame[:, :3]
        depth = -local[..., 2]
        return np.stack(
            [local[..., 0] / depth, local[..., 1] / depth, self.baseline * (1 / self.near - 1 / depth)], axis=-1
        )

    def to_world(self, places: np.ndarray) -> np.ndarray:
        """World points (..., 3) at coordinates (..., 3), the third below baseline / near: the inverse of `place`."""
        depth = 1 / (1 / self.near - places[..., 2] / self.baseline)
        local = np.stack([places[..., 0] * depth, places[..., 1] * depth, -depth], axis=-1)
        return local @ self.frame[:, :3].T + self.frame[:, 3]

    def rays(self, origins: np.ndarray, directions: np.ndarray) -> "DeviceRays":
        """World rays (N, 3) and (N, 3), from where their depth is `near`, or their origin if that is deeper."""
        dtype = origins.dtype
        eye, axes = self.frame[:, 3].astype(dtype), self.frame[:, :3].astype(dtype)
        o, d = (origins - eye) @ axes, directions @ axes
        forward = -d[:, 2] > MIN_FORWARD
        dz = np.where(forward, -d[:, 2], dtype.type(1))
        start = np.maximum((dtype.type(self.near) + o[:, 2]) / dz, dtype.type(0))
        p = o + start[:, None] * d
        z = np.where(forward, -p[:, 2], dtype.type(1))
        inverse = dtype.type(self.baseline) / z
        begin = np.stack([p[:, 0] / z, p[:, 1] / z, dtype.type(self.baseline / self.near) - inverse], axis=1)
        way = np.stack([d[:, 0] / dz - begin[:, 0], d[:, 1] / dz - begin[:, 1], inverse], axis=1)
        length = np.linalg.norm(way, axis=1)
        way = np.where(forward[:, None], way / length[:, None], np.array([0, 0, -1], dtype))
        begin = np.where(forward[:, None], begin, np.array([0, 0, -1], dtype))
        return DeviceRays(begin, way, length, start, z / dz)


@dataclass(frozen=True)
class DeviceRays:
    """Rays in device coordinates: begin + s way, |way| = 1. One that does not go forward begins before the box and leads away.

    Attributes:
        begin, way: (N, 3).
        length: (N,) s at which a ray is infinitely far.
        start: (N,) its distance t in the world at s = 0; pace: (N,) dt/ds there, times length.
    """

    origins: np.ndarray
    directions: np.ndarray
    s_infinity: np.ndarray
    t_start: np.ndarray
    t_scale: np.ndarray

    def distance(self, s: np.ndarray, rays: np.ndarray | slice = slice(None)) -> np.ndarray:
        """Distances t (n, K) in the world of s (n, K) on n of the rays: depth is depth at the start / (1 - s / length)."""
        share = np.minimum(s / self.s_infinity[rays, None], s.dtype.type(1 - MIN_DISPARITY))
        return self.t_start[rays, None] + self.t_scale[rays, None] * (share / (1 - share))


SpaceMapping = Contraction | DeviceCoordinates


def contract(points: np.ndarray, aabb: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Places (..., 3) of world points in [0, 1]^3, and their radius r (...) before contraction."""
    y = 2 * ((points - aabb[0]) / (aabb[1] - aabb[0])) - 1
    radius = np.abs(y).max(axis=-1)
    beyond = np.maximum(radius, 1)
    scale = (2 - 1 / beyond) / beyond
    return y * (scale / 4)[..., None] + y.dtype.type(0.5), radius


def uncontract(u: np.ndarray, aabb: np.ndarray) -> np.ndarray:
    """World points (..., 3) at places inside (0, 1)^3: the inverse of `contract`."""
    z = 4 * u - 2
    reach = np.maximum(np.abs(z).max(axis=-1), 1)
    y = z / (reach * (2 - reach))[..., None]
    return (aabb[0] + aabb[1]) / 2 + y * (aabb[1] - aabb[0]) / 2
