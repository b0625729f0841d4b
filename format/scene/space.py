"""Space mappings: how points of the world are mapped into the planes, and how samples are spaced along rays.

A scene without a mapping ends with its box and its samples are evenly spaced. `Contraction` maps all of space into the
planes, for scenes with unbounded surroundings; `DeviceCoordinates` maps the view frustum of a forward-facing rig, with
a resolution that falls with depth as that of the images does. (Coordinates of the planes are called u, in [0, 1]^3.)
"""

from dataclasses import dataclass

import numpy as np

# A ray in contracted space ends at FAR times `uniform_distance`. Seen from within the box, anything farther would shift
# by less than 1/256 of the parallax of the box's far side, which is below one texel of planes of up to 256 texels.
FAR = 256.0

# The smallest depth that a ray of device coordinates must gain per unit of length to count as going forward.
MIN_FORWARD = 1e-4

# The smallest disparity of a sample, relative to that at the start of its ray: samples farther off count as this far.
MIN_DISPARITY = 1e-6

# How far, in longest edges of the box, its middle may be from the origin, and a camera from its middle, so that float32
# numbers tell points of the box apart; a few times farther, pictures are off by an 8-bit level (docs/benchmarks.md).
FARTHEST_BOX, FARTHEST_CAMERA = 1e4, 4e3


@dataclass(frozen=True)
class Contraction:
    """The l-infinity version of mip-NeRF 360's contraction (arXiv:2111.12077, eq. 10; arXiv:2301.10241, appendix).

    Space. With c and h the centre and half edges of the scene's box, y = (p - c) / h and r = max |y_i|,

        contract(p) = y  where r <= 1,  (2 - 1/r) y/r  elsewhere           in the cube [-2, 2]^3

    Planes and occupancy grid cover that cube: u = contract(p) / 4 + 1/2. The box is its inner half, undistorted.

    Rays. Samples are uniform in the ray parameter s. With t the distance along the ray and t_u = `uniform_distance`,

        s = t  where t <= t_u,  t_u (2 - t_u/t)  beyond                    a ray ends at t = FAR t_u

    so that samples outside the box are about uniform in the cube, too.

    Density is per unit of length in the cube, measured radially: then it means the same everywhere to the occupancy
    grid, and an infinite ray has a finite optical thickness. That of a step ds is

        tau = sigma / extent * ds * (max(1, t/t_u) / max(1, r))^2          since dt/ds = max(1, t/t_u)^2

    Attributes:
        uniform_distance: t_u, world units, > 0; about the distance from the cameras to the far side of the box.
    """

    uniform_distance: float

    @property
    def s_end(self) -> float:
        """The parameter s at which a ray ends: (2 - 1/FAR) t_u."""
        return (2 - 1 / FAR) * self.uniform_distance

    def distance(self, s: np.ndarray) -> np.ndarray:
        """Return the distances t at ray parameters s >= 0, in their shape and type; s is clamped to `s_end`."""
        ahead = np.minimum(s / s.dtype.type(self.uniform_distance), s.dtype.type(2 - 1 / FAR))
        return np.where(ahead <= 1, s, s.dtype.type(self.uniform_distance) / (2 - np.maximum(ahead, 1)))

    def parameter(self, t: np.ndarray) -> np.ndarray:
        """Return the ray parameters s at distances t >= 0 (infinity allowed): the inverse of `distance`."""
        beyond = t.dtype.type(self.uniform_distance) / np.maximum(t, t.dtype.type(self.uniform_distance))
        return np.where(t <= self.uniform_distance, t, t.dtype.type(self.uniform_distance) * (2 - beyond))

    def density_scale(self, t: np.ndarray, radius: np.ndarray) -> np.ndarray:
        """Return (max(1, t/t_u) / max(1, radius))^2, by which the optical thickness of a step ds is multiplied."""
        return np.square(np.maximum(1, t / t.dtype.type(self.uniform_distance)) / np.maximum(1, radius))


@dataclass(frozen=True, eq=False)
class DeviceCoordinates:
    """Normalised device coordinates (NeRF, arXiv:2003.08934, appendix C), scaled so that all axes have the same unit.

    With x, y and the depth z > 0 of a point in the frame of one camera that stands for the rig,

        to_device(p) = (x / z,  y / z,  baseline (1 / near - 1 / z))

    Straight lines stay straight, so the scene is an ordinary box in these coordinates: `aabb`, `step`, the view
    directions of the decoder and distances between samples are all in them. A texel spans about as many pixels along
    every axis: across, of viewing angle; in depth, of parallax over the baseline.

    Attributes:
        frame: (3, 4) float64, camera-to-world pose of that camera, orthonormal, OpenGL convention.
        near: depth of the near plane, world units, > 0; nothing nearer is represented.
        baseline: world units, > 0; about the width of the rig.
    """

    frame: np.ndarray
    near: float
    baseline: float

    def to_device(self, points: np.ndarray) -> np.ndarray:
        """Return the device coordinates (..., 3) of world points (..., 3) with positive depth."""
        local = (points - self.frame[:, 3]) @ self.frame[:, :3]
        depth = -local[..., 2]
        return np.stack(
            [local[..., 0] / depth, local[..., 1] / depth, self.baseline * (1 / self.near - 1 / depth)], axis=-1
        )

    def to_world(self, points: np.ndarray) -> np.ndarray:
        """Return the world points (..., 3) of device coordinates (..., 3), whose third is below baseline / near."""
        depth = 1 / (1 / self.near - points[..., 2] / self.baseline)
        local = np.stack([points[..., 0] * depth, points[..., 1] * depth, -depth], axis=-1)
        return local @ self.frame[:, :3].T + self.frame[:, 3]

    def rays(
        self,
        origins: np.ndarray,  # (N, 3) float, world
        directions: np.ndarray,  # (N, 3) float, world, unit length
    ) -> "DeviceRays":
        """Map world rays into device coordinates; they start at depth `near`, or at their origin if that is deeper."""
        dtype = origins.dtype
        eye, axes = self.frame[:, 3].astype(dtype), self.frame[:, :3].astype(dtype)
        o, d = (origins - eye) @ axes, directions @ axes
        forward = -d[:, 2] > MIN_FORWARD
        dz = np.where(forward, -d[:, 2], dtype.type(1))
        t_start = np.maximum((dtype.type(self.near) + o[:, 2]) / dz, dtype.type(0))
        p = o + t_start[:, None] * d
        z = np.where(forward, -p[:, 2], dtype.type(1))
        inverse = dtype.type(self.baseline) / z
        start = np.stack([p[:, 0] / z, p[:, 1] / z, dtype.type(self.baseline / self.near) - inverse], axis=1)
        # From the start of a ray to its vanishing point, where it is infinitely far away in the world.
        path = np.stack([d[:, 0] / dz - start[:, 0], d[:, 1] / dz - start[:, 1], inverse], axis=1)
        s_infinity = np.linalg.norm(path, axis=1)
        path = np.where(forward[:, None], path / s_infinity[:, None], np.array([0, 0, -1], dtype))
        start = np.where(forward[:, None], start, np.array([0, 0, -1], dtype))
        return DeviceRays(start, path, s_infinity, t_start, z / dz)


@dataclass(frozen=True)
class DeviceRays:
    """Rays in device coordinates: origins + s directions.

    A ray that does not go forward starts outside the box and leads away from it.

    Attributes:
        origins, directions: (N, 3), the directions of unit length.
        s_infinity: (N,) parameter s at which a ray is infinitely far away in the world.
        t_start: (N,) distance in the world from the original origin to s = 0.
        t_scale: (N,) dt/ds at s = 0, times `s_infinity`.
    """

    origins: np.ndarray
    directions: np.ndarray
    s_infinity: np.ndarray
    t_start: np.ndarray
    t_scale: np.ndarray

    def distance(self, s: np.ndarray, rays: np.ndarray | slice = slice(None)) -> np.ndarray:
        """Return the distances t (n, K) in the world at parameters s (n, K) of n of the rays, selected by `rays`.

        t = t_start + t_scale x / (1 - x),  x = s / s_infinity        (depth = depth at the start / (1 - x))
        """
        share = np.minimum(s / self.s_infinity[rays, None], s.dtype.type(1 - MIN_DISPARITY))
        return self.t_start[rays, None] + self.t_scale[rays, None] * (share / (1 - share))


def edges_away(aabb: np.ndarray, point: np.ndarray) -> float:
    """Return the distance of a point (3,) from the middle of a box (2, 3), in longest edges of the box."""
    low, high = aabb.astype(np.float64)
    return float(np.linalg.norm((low + high) / 2 - point) / (high - low).max())


SpaceMapping = Contraction | DeviceCoordinates


def contract(points: np.ndarray, aabb: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Map world points (..., 3) into the planes by the formula of `Contraction`.

    Args:
        points: (..., 3) float, world units.
        aabb: (2, 3), corners of the box.

    Returns:
        Coordinates u (..., 3) in [0, 1]^3, and the radius r (...) of the points before contraction.
    """
    y = 2 * ((points - aabb[0]) / (aabb[1] - aabb[0])) - 1
    radius = np.abs(y).max(axis=-1)
    beyond = np.maximum(radius, 1)
    scale = (2 - 1 / beyond) / beyond
    return y * (scale / 4)[..., None] + y.dtype.type(0.5), radius


def uncontract(u: np.ndarray, aabb: np.ndarray) -> np.ndarray:
    """Return the world points (..., 3) of coordinates u (..., 3) in (0, 1)^3: the inverse of `contract`."""
    z = 4 * u - 2
    reach = np.maximum(np.abs(z).max(axis=-1), 1)
    y = z / (reach * (2 - reach))[..., None]
    return (aabb[0] + aabb[1]) / 2 + y * (aabb[1] - aabb[0]) / 2
