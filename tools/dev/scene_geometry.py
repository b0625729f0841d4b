"""Geometry of the generated scene: signed distance functions of its static and moving objects.

World units are metres, z points up. The floor is z = 0; walls stand at x = LEFT, x = RIGHT and y = BACK.
Points are arrays of shape (3, N), distances of shape (N,), both float32. A distance function returns the distance to
the nearest surface or a lower bound of it, so that sphere tracing (Hart, The Visual Computer 12, 1996) never
oversteps a surface.
"""

import math
from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

Distance = Callable[[np.ndarray], np.ndarray]

LEFT, RIGHT, BACK = -1.7, 2.3, 1.5

# Materials; each object consists of one material, except for the ring with its bead.
VASE, PLINTH, CUBE, STAND, BALL, RING, BEAD, FLOOR, BACK_WALL, SIDE_WALL, BOARD = range(11)

BALL_RADIUS = 0.2


@dataclass(frozen=True)
class Content:
    """Which objects the room holds, by material, and which surfaces are textured; the others have a uniform colour."""

    objects: frozenset[int]
    patterns: frozenset[str]


# Scenes of graded complexity with the same room, light, cameras and path of the ball. Of four objects (vase on its
# plinth, cube, ring on its stand, ball) and four patterns they hold all, two of each, or one of each.
CONTENTS = {
    "full": Content(
        frozenset((VASE, PLINTH, CUBE, STAND, RING, BEAD, BALL)), frozenset(("planks", "rug", "mural", "stripes"))
    ),
    "half": Content(frozenset((CUBE, BALL)), frozenset(("planks", "rug"))),
    "quarter": Content(frozenset((BALL,)), frozenset(("rug",))),
}

FULL = CONTENTS["full"]


@dataclass(frozen=True)
class MovingObject:
    """A moving object at one instant: its bounding sphere and its distance functions, overall and by material."""

    centre: np.ndarray  # (3,) float32
    radius: float
    distance: Distance
    materials: tuple[tuple[int, Distance], ...]


def static_distances(points: np.ndarray, content: Content = FULL) -> dict[int, np.ndarray]:
    """Return the distances from points (3, N) to each static material, (N,) each."""
    x, y, z = points
    wall = np.minimum(BACK - y, np.minimum(x - LEFT, RIGHT - x))
    board = np.maximum(z - 0.11, wall - 0.025)
    distances = {
        FLOOR: z,
        BACK_WALL: BACK - y,
        SIDE_WALL: np.minimum(x - LEFT, RIGHT - x),
        BOARD: board,
        PLINTH: _rounded_cylinder(x + 0.98, y - 0.62, z - 0.24, 0.27, 0.24, 0.03),
        VASE: _vase(x + 0.98, y - 0.62, z - 0.48),
        CUBE: _turned_cube(x - 1.16, y - 0.72, z - 0.2),
        STAND: np.minimum(
            _rounded_cylinder(x - 0.28, y - 0.92, z - 0.03, 0.22, 0.03, 0.02),
            _rounded_cylinder(x - 0.28, y - 0.92, z - 0.22, 0.03, 0.22, 0.01),
        ),
    }
    return {m: d for m, d in distances.items() if m in content.objects or m not in FULL.objects}


def static_distance(points: np.ndarray, content: Content = FULL) -> np.ndarray:
    """Return the distance from points (3, N) to the nearest static surface, (N,)."""
    distances = list(static_distances(points, content).values())
    nearest = distances[0]
    for other in distances[1:]:
        nearest = np.minimum(nearest, other)
    return nearest


def caster_distance(points: np.ndarray, content: Content = FULL) -> np.ndarray:
    """Return the distance to the nearest static object that casts shadows; a large number where there is none.

    Floor and walls are left out: they lie behind everything that they could shade.
    """
    distances = static_distances(points, content)
    casting = [distances[m] for m in (PLINTH, VASE, CUBE, STAND) if m in distances]
    return np.minimum.reduce(casting) if casting else np.full(points.shape[1], 1e3, np.float32)


def moving_objects(time: float, content: Content = FULL) -> tuple[MovingObject, ...]:
    """Return the moving objects of `content` at a time in [0, 1].

    The ball bounces twice a clip; the ring makes half a turn, after which it looks the same, so the clip loops.
    """
    radius = BALL_RADIUS
    bounce = (2 * time) % 1.0
    ball = np.array(
        [
            0.1 + 0.3 * math.sin(2 * math.pi * time),
            -0.38 + 0.12 * math.cos(2 * math.pi * time),
            radius + 4 * 0.5 * bounce * (1 - bounce),
        ],
        np.float32,
    )
    ring, angle = np.array([0.28, 0.92, 0.82], np.float32), math.pi * time
    bead = ring + np.array([0, 0, 0.09 * math.sin(2 * math.pi * time)], np.float32)

    def ring_distance(p: np.ndarray) -> np.ndarray:
        x, y, z = p - ring[:, None]
        u, v = (
            x * np.float32(math.cos(angle)) + y * np.float32(math.sin(angle)),
            y * np.float32(math.cos(angle)) - x * np.float32(math.sin(angle)),
        )
        across = np.maximum(np.abs(np.hypot(u, z) - 0.31) - 0.03, 0)
        along = np.maximum(np.abs(v) - 0.06, 0)
        return np.hypot(across, along) - 0.025

    def bead_distance(p: np.ndarray) -> np.ndarray:
        return np.sqrt(((p - bead[:, None]) ** 2).sum(0)) - 0.1

    def ball_distance(p: np.ndarray) -> np.ndarray:
        return np.sqrt(((p - ball[:, None]) ** 2).sum(0)) - radius

    objects = (
        MovingObject(ball, radius, ball_distance, ((BALL, ball_distance),)),
        MovingObject(
            ring,
            0.4,
            lambda p: np.minimum(ring_distance(p), bead_distance(p)),
            ((RING, ring_distance), (BEAD, bead_distance)),
        ),
    )
    return tuple(one for one in objects if one.materials[0][0] in content.objects)


def sphere_trace(
    distance: Distance,
    origins: np.ndarray,  # (3, N) float32
    directions: np.ndarray,  # (3, N) float32, unit length
    start: np.ndarray,  # (N,) ray parameters
    end: np.ndarray,  # (N,) ray parameters
) -> np.ndarray:
    """Return the ray parameter of the first surface between `start` and `end`, (N,) float32; infinity without one."""
    t = start.astype(np.float32)
    found = np.full(t.shape, np.inf, np.float32)
    active = np.flatnonzero(t < end)
    for _ in range(120):
        if not active.size:
            break
        d = distance(origins[:, active] + directions[:, active] * t[active])
        hit = d < 3e-4 * np.maximum(t[active], 1)
        found[active[hit]] = t[active[hit]]
        t[active] += d
        active = active[~hit & (t[active] < end[active])]
    return found


def normals(distance: Distance, points: np.ndarray) -> np.ndarray:
    """Return unit normals (3, N): the gradient of the distance by differences over the corners of a tetrahedron."""
    total = np.zeros_like(points)
    for corner in ((1, -1, -1), (-1, -1, 1), (-1, 1, -1), (1, 1, 1)):
        step = np.array(corner, np.float32)[:, None]
        total += step * distance(points + step * np.float32(1e-3))
    return total / np.maximum(np.linalg.norm(total, axis=0), 1e-9)


def sphere_intervals(
    moving: MovingObject, origins: np.ndarray, directions: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """Return where rays enter and leave the bounding sphere, (N,) each; the entry exceeds the exit for a miss."""
    offset = moving.centre[:, None] - origins
    along = (offset * directions).sum(0)
    half = (moving.radius + 0.01) ** 2 - ((offset**2).sum(0) - along**2)
    root = np.sqrt(np.maximum(half, 0))
    return np.where(half > 0, np.maximum(along - root, 0.02), np.inf), np.where(half > 0, along + root, -np.inf)


def smoothstep(x: np.ndarray, low: float, high: float) -> np.ndarray:
    """Return 0 up to `low`, 1 from `high` on, and 3 s^2 - 2 s^3 between."""
    s = np.clip((x - low) / (high - low), 0, 1)
    return s * s * (3 - 2 * s)


def _rounded_cylinder(
    x: np.ndarray, y: np.ndarray, z: np.ndarray, radius: float, half_height: float, edge: float
) -> np.ndarray:
    across, along = np.hypot(x, y) - (radius - edge), np.abs(z) - (half_height - edge)
    outside = np.hypot(np.maximum(across, 0), np.maximum(along, 0))
    return outside + np.minimum(np.maximum(across, along), 0) - edge


def _turned_cube(x: np.ndarray, y: np.ndarray, z: np.ndarray) -> np.ndarray:
    c, s = np.float32(math.cos(0.5)), np.float32(math.sin(0.5))
    u, v = np.abs(x * c + y * s) - 0.16, np.abs(y * c - x * s) - 0.16
    w = np.abs(z) - 0.16
    outside = np.sqrt(np.maximum(u, 0) ** 2 + np.maximum(v, 0) ** 2 + np.maximum(w, 0) ** 2)
    return outside + np.minimum(np.maximum(u, np.maximum(v, w)), 0) - 0.04


def _vase(x: np.ndarray, y: np.ndarray, z: np.ndarray) -> np.ndarray:
    """Return the distance to a body and a neck joined by a fillet, a foot, and a lip."""
    r = np.hypot(x, y)
    body = np.hypot(r, (z - 0.24) * 0.95) - 0.24
    neck = np.hypot(r, z - np.clip(z, 0.3, 0.6)) - 0.055
    lip = np.hypot(r - 0.085, z - 0.63) - 0.028
    foot = np.maximum(r - 0.12, np.abs(z - 0.02) - 0.02)
    return _blend(np.minimum(_blend(body, neck, 0.16), foot), lip, 0.05)


def _blend(a: np.ndarray, b: np.ndarray, width: float) -> np.ndarray:
    """Return the polynomial smooth minimum, a union with a fillet of the given width."""
    h = np.maximum(width - np.abs(a - b), 0) / width
    return np.minimum(a, b) - h * h * (width / 4)
