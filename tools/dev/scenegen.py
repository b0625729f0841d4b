"""The embedded default scene: a corner of a room, a glossy vase, a bouncing ball and a turning ring.

`python -m kpc.tools.dev.scenegen DIR` writes it as a rig of cameras would film it (N3DV layout), with exact pictures from
cameras the rig does not have (with `--content half` or `quarter` a room that holds less):

    cam00.mp4 ...         one H.264 video a camera; cam00 is central
    poses_bounds.npy      N x 17, the LLFF convention
    gt/cameras.json       unseen cameras (and cam00), OpenGL camera-to-world, with times; gt/*.png what they see

The scene is given by distance functions and ray marched in numpy: no download, no OpenGL. World: metres, z up. What
stands still is marched once a camera; a frame then touches only rays, shadows and reflections that something moving can
reach.
"""

import argparse
import json
import math
import multiprocessing
import os
import sys
from collections.abc import Callable, Iterator
from concurrent.futures import ProcessPoolExecutor
from dataclasses import dataclass
from functools import cached_property, partial
from pathlib import Path

import numpy as np
from kpc.format.common import cli
from kpc.format.common.errors import UsageError
from kpc.format.common.media import srgb_from_linear, write_image, write_video
from kpc.format.common.progress import progress
from kpc.format.scene.cameras import Camera
from kpc.tools.dev.processes import end_with_parent

Distance = Callable[[np.ndarray], np.ndarray]
"""Distance from points (3, N) to the nearest surface, (N,), or a lower bound of it."""

LEFT, RIGHT, BACK = -1.7, 2.3, 1.5
"""The walls: x = LEFT, x = RIGHT, y = BACK. The floor is z = 0."""

TARGET = (0.02, 0.1, 0.56)
"""Where all cameras look."""

LIGHT = (1.9, -2.4, 3.4)
PENUMBRA = 7.0
"""Of shadows: the light looks 1 / 7 as wide as it is far."""

REACH = 0.3
"""How far off a thing still darkens a corner (ambient occlusion)."""

VASE, PLINTH, CUBE, STAND, BALL, RING, BEAD, FLOOR, BACK_WALL, SIDE_WALL, BOARD = range(11)


@dataclass(frozen=True)
class Content:
    """What the room holds, by material, and which of its surfaces bear a pattern; the others are of one colour."""

    things: frozenset[int]
    patterns: frozenset[str]


GRADES = {
    "full": Content(
        frozenset((VASE, PLINTH, CUBE, STAND, RING, BEAD, BALL)), frozenset(("planks", "rug", "mural", "stripes"))
    ),
    "half": Content(frozenset((CUBE, BALL)), frozenset(("planks", "rug"))),
    "quarter": Content(frozenset((BALL,)), frozenset(("rug",))),
}
"""Graded complexity. Of four things (the vase on its plinth, the cube, the ring on its stand, the ball) and four patterns: all,
two of each, one of each. Room, light, rig and the ball's path are the same."""

FULL = GRADES["full"]


@dataclass(frozen=True)
class Options:
    """What to write; see the command line's help."""

    seed: int = 0
    cameras: int = 12
    frames: int = 30
    width: int = 192
    height: int = 144
    fps: float = 12.0
    samples: int = 3
    content: str = "full"
    """Of GRADES."""


# --- what is where


@dataclass(frozen=True)
class Mover:
    """A thing that moves: the sphere that contains it at a time, and its distance function there."""

    centre: np.ndarray
    radius: float
    distance: Distance
    materials: tuple[tuple[int, Distance], ...]


def still(p: np.ndarray, content: Content = FULL) -> dict[int, np.ndarray]:
    """Distances to all that stands still, by material."""
    x, y, z = p
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
    return {m: d for m, d in distances.items() if m in content.things or m not in FULL.things}


def still_distance(p: np.ndarray, content: Content = FULL) -> np.ndarray:
    distances = list(still(p, content).values())
    nearest = distances[0]
    for other in distances[1:]:
        nearest = np.minimum(nearest, other)
    return nearest


def movers(time: float, content: Content = FULL) -> tuple[Mover, ...]:
    """The ball (two bounces a clip) and the ring (half a turn a clip, so that the clip loops), as far as they are there."""
    radius = 0.2
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

    things = (
        Mover(ball, radius, ball_distance, ((BALL, ball_distance),)),
        Mover(
            ring,
            0.4,
            lambda p: np.minimum(ring_distance(p), bead_distance(p)),
            ((RING, ring_distance), (BEAD, bead_distance)),
        ),
    )
    return tuple(thing for thing in things if thing.materials[0][0] in content.things)


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
    """A body and a neck that flow into each other, and a lip."""
    r = np.hypot(x, y)
    body = np.hypot(r, (z - 0.24) * 0.95) - 0.24
    neck = np.hypot(r, z - np.clip(z, 0.3, 0.6)) - 0.055
    lip = np.hypot(r - 0.085, z - 0.63) - 0.028
    foot = np.maximum(r - 0.12, np.abs(z - 0.02) - 0.02)
    return _blend(np.minimum(_blend(body, neck, 0.16), foot), lip, 0.05)


def _blend(a: np.ndarray, b: np.ndarray, width: float) -> np.ndarray:
    """Minimum with a fillet: polynomial, of the given width."""
    h = np.maximum(width - np.abs(a - b), 0) / width
    return np.minimum(a, b) - h * h * (width / 4)


# --- what it looks like


@dataclass(frozen=True)
class Paint:
    """Colours of surfaces: procedural, smooth at the scale of a centimetre or two, chosen by the seed."""

    seed: int
    content: Content = FULL

    def albedo(self, material: int, p: np.ndarray, time: float) -> np.ndarray:
        """Linear colour (3, N) of points (3, N) on a material."""
        x, y, z = p
        if material == FLOOR:
            return self._floor(x, y)
        if material == BACK_WALL:
            return self._mural(x, z)
        if material == SIDE_WALL:
            if "stripes" not in self.content.patterns:
                return _plain((0.58, 0.49, 0.355), p)
            stripe = _smooth(np.sin(2 * np.pi * y / 0.5), -0.25, 0.25)
            base = _mix((0.64, 0.55, 0.41), (0.52, 0.43, 0.30), stripe)
            return base * (1 + 0.06 * self.noise(x * 5, y * 5 + z, z * 5 - y))
        if material == PLINTH:
            veins = self.noise(x * 4 + 2 * self.noise(x * 3, y * 3, z * 3), y * 4, z * 4)
            return _mix((0.74, 0.72, 0.69), (0.50, 0.49, 0.48), _smooth(veins, 0.05, 0.7))
        if material == CUBE:
            rings = np.sin(26 * np.hypot(x - 1.0 + 0.08 * self.noise(x * 4, y * 4, z * 4), z + 0.15))
            return _mix((0.50, 0.27, 0.12), (0.36, 0.17, 0.07), _smooth(rings, -0.8, 0.8))
        if material == BALL:
            return self._ball(p, time)
        if material == RING:
            return _plain((0.80, 0.47, 0.06), p)
        colour = {
            VASE: (0.012, 0.10, 0.115),
            STAND: (0.09, 0.09, 0.10),
            BEAD: (0.07, 0.30, 0.42),
            BOARD: (0.80, 0.77, 0.70),
        }[material]
        return _plain(colour, p)

    def _floor(self, x: np.ndarray, y: np.ndarray) -> np.ndarray:
        wood = (
            self._planks(x, y)
            if "planks" in self.content.patterns
            else _plain((0.43, 0.24, 0.115), np.stack([x, x, x]))
        )
        if "rug" not in self.content.patterns:
            return wood
        r = np.hypot(x - 0.1, (y + 0.25) * 1.15)
        rug = _mix((0.045, 0.085, 0.20), (0.62, 0.56, 0.44), _smooth(np.sin(r * 2 * np.pi / 0.34 + 0.4), -0.3, 0.3))
        rug = rug * (1 + 0.12 * self.noise(x * 12, y * 12, x * 0))
        return _mix_arrays(rug, wood, _smooth(r, 0.88, 0.90))

    def _planks(self, x: np.ndarray, y: np.ndarray) -> np.ndarray:
        plank = np.floor(x / 0.26)
        along = y + 0.7 * self._hash(plank, plank * 0 + 5, plank * 0)
        board = np.floor(along / 1.3)
        tone = self._hash(plank, board, plank * 0 + 9)
        grain = self.noise(x * 14, y * 1.6, plank)
        wood = _mix((0.38, 0.20, 0.095), (0.52, 0.30, 0.145), 0.25 + 0.5 * tone + 0.22 * grain)
        seam = np.minimum(_edge(x / 0.26) * 0.26, _edge(along / 1.3) * 1.3)
        return wood * (0.62 + 0.38 * _smooth(seam, 0.002, 0.020))

    def _mural(self, x: np.ndarray, z: np.ndarray) -> np.ndarray:
        """Hills under a sun."""
        if "mural" not in self.content.patterns:
            return _plain((0.265, 0.40, 0.43), np.stack([x, x, x]))
        wall = _mix((0.24, 0.37, 0.40), (0.29, 0.43, 0.46), _smooth(z, 0.6, 2.0))
        sun = _smooth(np.hypot(x - 0.72, z - 1.28), 0.33, 0.35)
        wall = _mix_arrays(np.array([[0.80], [0.33], [0.13]], np.float32), wall, sun)
        hills = (
            (0.92, 0.20, 1.9, 0.3, (0.58, 0.40, 0.20)),
            (0.66, 0.16, 2.6, 1.9, (0.25, 0.32, 0.17)),
            (0.38, 0.12, 2.1, 4.0, (0.06, 0.15, 0.15)),
        )
        for height, swing, rate, phase, colour in hills:
            line = height + swing * np.sin(rate * x + phase + 0.7 * self.seed)
            wall = _mix_arrays(np.array(colour, np.float32)[:, None], wall, _smooth(z - line, -0.012, 0.012))
        return wall * (1 + 0.07 * self.noise(x * 6 + z, z * 6 - x, x * 0 + 3))

    def _ball(self, p: np.ndarray, time: float) -> np.ndarray:
        """Coral with two cream bands; it turns once a clip about a leaning axis."""
        local = (p - movers(time)[0].centre[:, None]) / 0.2
        turn = 2 * math.pi * time
        x, y, z = local
        u = x * math.cos(turn) + y * math.sin(turn)
        height = (0.85 * z + 0.52 * u).astype(np.float32)
        bands = _smooth(np.abs(np.abs(height) - 0.36), 0.10, 0.16)
        return _mix_arrays(
            np.array([[0.82], [0.75], [0.60]], np.float32), np.array([[0.78], [0.13], [0.075]], np.float32), bands
        )

    def noise(self, x: np.ndarray, y: np.ndarray, z: np.ndarray) -> np.ndarray:
        """Value noise in [-1, 1], smooth, one feature a unit."""
        cells = [np.floor(a) for a in (x, y, z)]
        fx, fy, fz = (_smooth(a - c, 0, 1) for a, c in zip((x, y, z), cells))
        total = np.zeros_like(fx)
        for corner in range(8):
            i, j, k = corner & 1, corner >> 1 & 1, corner >> 2
            weight = (fx if i else 1 - fx) * (fy if j else 1 - fy) * (fz if k else 1 - fz)
            total = total + weight * self._hash(cells[0] + i, cells[1] + j, cells[2] + k)
        return 2 * total - 1

    def _hash(self, i: np.ndarray, j: np.ndarray, k: np.ndarray) -> np.ndarray:
        """A number in [0, 1) for each triple of whole numbers."""
        h = (
            i.astype(np.int64) * 73856093
            ^ j.astype(np.int64) * 19349663
            ^ k.astype(np.int64) * 83492791
            ^ (self.seed + 1) * 2654435761
        )
        h = (h ^ h >> 13) * 1274126177 & 0xFFFFFFFF
        return ((h ^ h >> 16) & 0xFFFF).astype(np.float32) / np.float32(65536)


def _smooth(x: np.ndarray, low: float, high: float) -> np.ndarray:
    s = np.clip((x - low) / (high - low), 0, 1)
    return s * s * (3 - 2 * s)


def _edge(x: np.ndarray) -> np.ndarray:
    """Distance to the nearest whole number."""
    return np.abs(x - np.round(x))


def _mix(a: tuple[float, ...], b: tuple[float, ...], s: np.ndarray) -> np.ndarray:
    return _mix_arrays(np.array(a, np.float32)[:, None], np.array(b, np.float32)[:, None], s)


def _plain(colour: tuple[float, float, float], p: np.ndarray) -> np.ndarray:
    return np.broadcast_to(np.array(colour, np.float32)[:, None], p.shape)


def _mix_arrays(a: np.ndarray, b: np.ndarray, s: np.ndarray) -> np.ndarray:
    return a + (b - a) * s


# --- light


GLOSS = {VASE: (0.05, 1.0), BALL: (0.035, 0.0), RING: (0.05, 0.0), BEAD: (0.05, 0.0)}
"""Materials that shine: reflectance head-on, and whether they mirror the room too."""


def march(
    distance: Distance, origins: np.ndarray, directions: np.ndarray, start: np.ndarray, end: np.ndarray
) -> np.ndarray:
    """Walk along rays (3, N) from `start` to the first surface before `end`: (N,), infinite where there is none."""
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


def normals(distance: Distance, p: np.ndarray) -> np.ndarray:
    """Gradient of the distance by four differences over the corners of a tetrahedron."""
    total = np.zeros_like(p)
    for corner in ((1, -1, -1), (-1, -1, 1), (-1, 1, -1), (1, 1, 1)):
        step = np.array(corner, np.float32)[:, None]
        total += step * distance(p + step * np.float32(1e-3))
    return total / np.maximum(np.linalg.norm(total, axis=0), 1e-9)


def shadow(distance: Distance, p: np.ndarray, to_light: np.ndarray, end: np.ndarray, start: np.ndarray) -> np.ndarray:
    """How much of the light is seen, (N,) in [0, 1]: the narrowest gap that the ray to it passes, as an angle."""
    seen = np.ones(p.shape[1], np.float32)
    t = np.maximum(start, 0.02).astype(np.float32)
    active = np.flatnonzero(t < end)
    for _ in range(48):
        if not active.size:
            break
        d = distance(p[:, active] + to_light[:, active] * t[active])
        seen[active] = np.minimum(seen[active], 0.5 + 0.5 * PENUMBRA * d / t[active])
        t[active] += np.clip(np.abs(d), 0.012, 0.25)
        active = active[(seen[active] > 0) & (t[active] < end[active])]
    return _smooth(seen, 0, 1)


def occlusion(distance: Distance, p: np.ndarray, n: np.ndarray) -> np.ndarray:
    """1 in the open, less in corners: how far the distance lags behind as one leaves the surface."""
    lag = np.zeros(p.shape[1], np.float32)
    for k in range(1, 5):
        h = np.float32(REACH * k / 4)
        lag += np.maximum(h - distance(p + n * h), 0) * np.float32(0.6**k)
    return 1 - np.clip(1.7 * lag / REACH, 0, 0.85)


@dataclass
class Buffer:
    """Rays, what they meet of the things that stand still, and how that is lit; `frame` adds the moving things.

    Attributes:
        origins, directions: (3, N) float32.
        mirrors: whether a mirroring surface shows the room (once).
    """

    paint: Paint
    origins: np.ndarray
    directions: np.ndarray
    mirrors: bool = True

    def __post_init__(self) -> None:
        count = self.origins.shape[1]
        far = np.full(count, 20.0, np.float32)
        standing = self.standing
        self.t = march(standing, self.origins, self.directions, np.full(count, 0.02, np.float32), far)
        self.t = np.where(np.isfinite(self.t), self.t, far)
        self.p = self.origins + self.directions * self.t
        self.n = normals(standing, self.p)
        distances = still(self.p, self.paint.content)
        self.material = np.array(list(distances))[np.argmin(np.stack(list(distances.values())), axis=0)]
        self.albedo = np.zeros_like(self.p)
        for material in np.unique(self.material):
            there = self.material == material
            self.albedo[:, there] = self.paint.albedo(material, self.p[:, there], 0.0)
        self.seen = _still_shadow(self.p, self.n, self.paint.content)
        self.open = occlusion(standing, self.p, self.n)
        self.plain = shade(self.material, self.p, self.n, self.albedo, self.directions, self.seen, self.open)

    @property
    def standing(self) -> Distance:
        """Of all that stands still."""
        return partial(still_distance, content=self.paint.content)

    @cached_property
    def mirror(self) -> tuple[np.ndarray, np.ndarray, "Buffer"] | None:
        """Rays that a mirroring surface sends on: which of ours, their share of the colour, and where they go."""
        which = np.flatnonzero(self.material == VASE) if self.mirrors else np.empty(0, int)
        if not which.size:
            return None
        n, d = self.n[:, which], self.directions[:, which]
        on = d - 2 * n * (n * d).sum(0)
        return (
            which,
            _fresnel(GLOSS[VASE][0], n, d),
            Buffer(self.paint, self.p[:, which] + n * np.float32(0.01), on, mirrors=False),
        )

    def frame(self, time: float) -> np.ndarray:
        """Linear colours (3, N) at a time in [0, 1]."""
        things = movers(time, self.paint.content)
        lit = self.plain.copy()
        touched, seen, open_ = _moving_light(things, self.p, self.n)
        if touched.size:
            lit[:, touched] = shade(
                self.material[touched],
                self.p[:, touched],
                self.n[:, touched],
                self.albedo[:, touched],
                self.directions[:, touched],
                self.seen[touched] * seen,
                self.open[touched] * open_,
            )
        if self.mirror is not None:
            which, share, beyond = self.mirror
            lit[:, which] += share * beyond.frame(time)
        nearest = self.t.copy()
        for thing in things:
            start, end = _span(thing, self.origins, self.directions)
            rays = np.flatnonzero(start < np.minimum(end, nearest))
            t = march(
                thing.distance,
                self.origins[:, rays],
                self.directions[:, rays],
                start[rays],
                np.minimum(end, nearest)[rays],
            )
            rays, t = rays[np.isfinite(t)], t[np.isfinite(t)]
            if rays.size:
                nearest[rays] = t
                lit[:, rays] = self._thing(things, thing, time, rays, t)
        return lit

    def _thing(
        self, things: tuple[Mover, ...], thing: Mover, time: float, rays: np.ndarray, t: np.ndarray
    ) -> np.ndarray:
        """Colours of a moving thing where rays meet it."""
        d = self.directions[:, rays]
        p = self.origins[:, rays] + d * t
        n = normals(thing.distance, p)
        ids = np.array([material for material, _ in thing.materials])
        material = ids[np.argmin(np.stack([distance(p) for _, distance in thing.materials]), axis=0)]
        albedo = np.zeros_like(p)
        for number in ids:
            there = material == number
            albedo[:, there] = self.paint.albedo(int(number), p[:, there], time)
        seen, open_ = _still_shadow(p, n, self.paint.content), occlusion(self.standing, p, n)
        touched, moving_seen, moving_open = _moving_light(things, p, n)
        seen[touched] *= moving_seen
        open_[touched] *= moving_open
        return shade(material, p, n, albedo, d, seen, open_)


def shade(
    material: np.ndarray,
    p: np.ndarray,
    n: np.ndarray,
    albedo: np.ndarray,
    directions: np.ndarray,
    seen: np.ndarray,
    open_: np.ndarray,
) -> np.ndarray:
    """Linear colour (3, N): a warm lamp with shadows, a cool sky, light thrown back by the floor, and highlights."""
    to_light, _ = _to_light(p)
    lamp = np.maximum((n * to_light).sum(0), 0) * seen
    up = 0.5 + 0.5 * n[2]
    ambient = _mix((0.20, 0.15, 0.115), (0.34, 0.38, 0.44), up) * open_
    colour = albedo * (np.array([[1.62], [1.42], [1.14]], np.float32) * lamp + ambient)
    for number, (reflectance, mirrors) in GLOSS.items():
        there = np.flatnonzero(material == number)
        if there.size:
            halfway = to_light[:, there] - directions[:, there]
            halfway /= np.linalg.norm(halfway, axis=0)
            lobe = np.maximum((n[:, there] * halfway).sum(0), 0) ** (90 if mirrors else 40)
            colour[:, there] += (1.1 if mirrors else 0.35) * lobe * seen[there]
            if not mirrors:  # a sheen stands in for the room
                colour[:, there] += _fresnel(reflectance, n[:, there], directions[:, there]) * ambient[:, there]
    return colour


def _fresnel(head_on: float, n: np.ndarray, d: np.ndarray) -> np.ndarray:
    """Schlick's approximation."""
    return (
        head_on
        + (0.75 - head_on) * (1 - np.clip(-(n * d).sum(0), 0, 1)) ** 5
        + np.float32(0.12 if head_on == GLOSS[VASE][0] else 0)
    )


def _to_light(p: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Unit directions to the lamp (3, N) and distances (N,)."""
    offset = np.array(LIGHT, np.float32)[:, None] - p
    length = np.linalg.norm(offset, axis=0)
    return offset / length, length


def _still_shadow(p: np.ndarray, n: np.ndarray, content: Content) -> np.ndarray:
    to_light, length = _to_light(p)
    lit = np.flatnonzero((n * to_light).sum(0) > 0)
    seen = np.zeros(p.shape[1], np.float32)
    start = p[:, lit] + n[:, lit] * np.float32(0.01)
    casting = partial(still_furniture, content=content)
    seen[lit] = shadow(casting, start, to_light[:, lit], np.minimum(length[lit], 4.0), np.zeros(lit.size, np.float32))
    return seen


def still_furniture(p: np.ndarray, content: Content = FULL) -> np.ndarray:
    """What casts shadows: all but floor and walls, which lie behind whatever they could shade. Far off where nothing does."""
    distances = still(p, content)
    casting = [distances[m] for m in (PLINTH, VASE, CUBE, STAND) if m in distances]
    return np.minimum.reduce(casting) if casting else np.full(p.shape[1], 1e3, np.float32)


def _moving_light(things: tuple[Mover, ...], p: np.ndarray, n: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Points that moving things darken, and there: the share of the lamp seen past them, and of the sky."""
    to_light, length = _to_light(p)
    seen, open_ = np.ones(p.shape[1], np.float32), np.ones(p.shape[1], np.float32)
    for thing in things:
        offset = thing.centre[:, None] - p
        along = (offset * to_light).sum(0)
        beside = np.sqrt(np.maximum((offset**2).sum(0) - along**2, 0))
        reach = thing.radius + (np.maximum(along, 0) + thing.radius) / PENUMBRA
        dark = np.flatnonzero((beside < reach) & (along > -thing.radius) & ((n * to_light).sum(0) > 0))
        start = np.maximum(along[dark] - reach[dark] - 0.1, 0)
        end = np.minimum(along[dark] + reach[dark] + 0.1, length[dark])
        seen[dark] *= shadow(thing.distance, p[:, dark] + n[:, dark] * np.float32(0.01), to_light[:, dark], end, start)
        close = np.flatnonzero((offset**2).sum(0) < (thing.radius + 2 * REACH) ** 2)
        if close.size:
            open_[close] *= occlusion(thing.distance, p[:, close], n[:, close])
    touched = np.flatnonzero((seen < 1) | (open_ < 1))
    return touched, seen[touched], open_[touched]


def _span(thing: Mover, origins: np.ndarray, directions: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Where rays enter and leave the sphere around a thing; start after end where they miss it."""
    offset = thing.centre[:, None] - origins
    along = (offset * directions).sum(0)
    half = (thing.radius + 0.01) ** 2 - ((offset**2).sum(0) - along**2)
    root = np.sqrt(np.maximum(half, 0))
    return np.where(half > 0, np.maximum(along - root, 0.02), np.inf), np.where(half > 0, along + root, -np.inf)


# --- cameras and pictures


def look_at(eye: np.ndarray, options: Options) -> Camera:
    """A camera at `eye` that looks at the target, z up; about 50 degrees wide."""
    back = eye - np.array(TARGET)
    back /= np.linalg.norm(back)
    right = np.cross([0.0, 0.0, 1.0], back)
    right /= np.linalg.norm(right)
    pose = np.eye(4)
    pose[:3] = np.stack([right, np.cross(back, right), back, eye], axis=1)
    focal = 1.06 * options.width
    return Camera(options.width, options.height, focal, focal, options.width / 2, options.height / 2, pose)


def _at(azimuth: float, elevation: float, distance: float, options: Options) -> Camera:
    """By degrees: azimuth 0 looks along +y, elevation 0 is level."""
    a, e = math.radians(azimuth), math.radians(elevation)
    offset = distance * np.array([math.sin(a) * math.cos(e), -math.cos(a) * math.cos(e), math.sin(e)])
    return look_at(np.array(TARGET) + offset, options)


CENTRAL = (14.0, 12.0, 3.55)
"""Azimuth, elevation (degrees) and distance (metres) of cam00."""


def rig(options: Options) -> list[Camera]:
    """cam00 in the centre, the others in two rows around it, 0.4 of the distance wide, with half a degree of jitter."""
    rng = np.random.default_rng(options.seed)
    cameras = [_at(*CENTRAL, options)]
    others = options.cameras - 1
    for k in range(others):
        across = -11 + 22 * k / max(others - 1, 1)
        up = 5.5 if k % 2 else -5.5
        azimuth, elevation = (across, up) + rng.uniform(-0.5, 0.5, 2)
        cameras.append(
            _at(CENTRAL[0] + azimuth, CENTRAL[1] + elevation, CENTRAL[2] + rng.uniform(-0.05, 0.05), options)
        )
    return cameras


def unseen(options: Options) -> list[Camera]:
    """Four cameras between those of the rig."""
    return [
        _at(CENTRAL[0] + a, CENTRAL[1] + e, CENTRAL[2], options)
        for a, e in ((-6.3, 1.5), (5.1, 2.8), (8.0, -1.2), (-2.2, -3.4))
    ]


class Film:
    """A camera that stands still: its pictures at any time, uint8 (height, width, 3)."""

    def __init__(self, camera: Camera, options: Options) -> None:
        self.camera, self.samples = camera, options.samples
        self.paint = Paint(options.seed, GRADES[options.content])
        fine = camera.resized(camera.width * options.samples, camera.height * options.samples)
        origins, directions = fine.rays()
        self.buffer = Buffer(self.paint, np.ascontiguousarray(origins.T), np.ascontiguousarray(directions.T))

    def picture(self, time: float) -> np.ndarray:
        """samples^2 rays a pixel, averaged as displayed (after the tone curve), so that a bright edge stays smooth."""
        linear = self.buffer.frame(time)
        shown = srgb_from_linear(1.12 * linear / (1 + 0.18 * linear))
        s, w, h = self.samples, self.camera.width, self.camera.height
        return np.rint(255 * shown.reshape(3, h, s, w, s).mean((2, 4))).astype(np.uint8).transpose(1, 2, 0)

    def depths(self) -> tuple[float, float]:
        """Least and greatest depth along the optical axis, over the clip."""
        forward = -self.camera.camera_to_world[:3, 2]
        depth = self.buffer.t * (self.buffer.directions.T @ forward.astype(np.float32))
        centre = self.camera.camera_to_world[:3, 3]
        near = min(
            float((thing.centre - centre) @ forward) - thing.radius
            for t in np.linspace(0, 1, 64)
            for thing in movers(t, self.paint.content)
        )
        return min(near, float(depth.min())), float(depth.max())


def generate(target: str | os.PathLike[str], options: Options) -> None:
    """Write the scene into `target`, which is made if need be. See the module's head for the files.

    Raises:
        MediaError: ffmpeg cannot write. OSError: the folder cannot be written.
    """
    folder = Path(target)
    (folder / "gt").mkdir(parents=True, exist_ok=True)
    times = [k / max(options.frames - 1, 1) for k in range(options.frames)]
    filmed, extra = rig(options), unseen(options)
    stills = sorted({0, options.frames // 4, options.frames // 2, 3 * options.frames // 4, options.frames - 1})
    jobs = [
        (camera, options, folder, f"cam{k:02d}", times, stills if k == 0 else []) for k, camera in enumerate(filmed)
    ]
    jobs += [(camera, options, folder, f"novel{k:02d}", [], stills[1:-1] or stills) for k, camera in enumerate(extra)]
    with ProcessPoolExecutor(
        min(os.cpu_count() or 1, len(jobs)), multiprocessing.get_context("spawn"), end_with_parent
    ) as pool:
        depths = list(progress(pool.map(_film, jobs), "filming", len(jobs), "camera"))
    rows = [_poses_bounds(camera, *bounds) for camera, bounds in zip(filmed, depths)]
    with cli.written_aside(folder / "poses_bounds.npy") as aside:
        np.save(aside, np.array(rows))
    frames = [
        {
            "file": f"{name}_f{k:03d}.png",
            "time": k / max(options.frames - 1, 1),
            "frame": k,
            "camera": name,
            "transform_matrix": camera.camera_to_world.tolist(),
        }
        for camera, _, _, name, _, pictures in jobs
        for k in pictures
    ]
    c = filmed[0]
    document = {"w": c.width, "h": c.height, "fl_x": c.fl_x, "fl_y": c.fl_y, "cx": c.cx, "cy": c.cy, "frames": frames}
    with cli.written_aside(folder / "gt" / "cameras.json") as aside:
        aside.write_text(json.dumps(document, indent=1))


def _film(job: tuple[Camera, Options, Path, str, list[float], list[int]]) -> tuple[float, float]:
    """One camera's video and stills; its least and greatest depth."""
    camera, options, folder, name, times, stills = job
    film = Film(camera, options)
    for k in stills:
        write_image(folder / "gt" / f"{name}_f{k:03d}.png", film.picture(k / max(options.frames - 1, 1)))
    if times:
        frames: Iterator[np.ndarray] = (film.picture(time) for time in times)
        write_video(folder / f"{name}.mp4", frames, options.fps, crf=14, pix_fmt="yuv444p")
    return film.depths()


def _poses_bounds(camera: Camera, least: float, greatest: float) -> np.ndarray:
    """LLFF's 17 numbers: [down right backwards centre | (h w f)], 0.9 of the least depth, 1.1 of the largest."""
    right, up, back, centre = camera.camera_to_world[:3].T
    columns = np.stack([-up, right, back, centre, [camera.height, camera.width, camera.fl_x]], axis=1)
    return np.concatenate([columns.ravel(), [0.9 * least, 1.1 * greatest]])


def main(argv: list[str] | None = None) -> int:
    return cli.run(_command, "scenegen", argv)


def _command(argv: list[str]) -> None:
    default = Options()
    parser = argparse.ArgumentParser(
        "scenegen", description="Write the embedded default scene: posed videos and ground truth."
    )
    parser.add_argument("folder", metavar="DIR", help="where to write; made if need be")
    parser.add_argument(
        "--seed", type=int, default=default.seed, help="of textures and of the rig's jitter (default %(default)s)"
    )
    parser.add_argument("--cameras", type=int, default=default.cameras, help="in the rig (default %(default)s)")
    parser.add_argument("--frames", type=int, default=default.frames, help="of the clip (default %(default)s)")
    parser.add_argument(
        "--size", default=f"{default.width}x{default.height}", help="of a picture, WxH (default %(default)s)"
    )
    parser.add_argument("--fps", type=float, default=default.fps, help="frames a second (default %(default)s)")
    parser.add_argument(
        "--samples", type=int, default=default.samples, help="rays across a pixel (default %(default)s)"
    )
    parser.add_argument(
        "--content",
        choices=tuple(GRADES),
        default=default.content,
        help="how much the room holds: all things and patterns, half or a quarter of them (default %(default)s)",
    )
    given = parser.parse_args(argv)
    try:
        width, height = (int(n) for n in given.size.lower().split("x"))
    except ValueError as error:
        raise UsageError(f"--size {given.size}: write it as 192x144") from error
    if (
        given.cameras < 2
        or given.frames < 1
        or given.samples < 1
        or min(width, height) < 8
        or not given.fps > 0
        or given.seed < 0
    ):
        raise UsageError(
            "at least 2 cameras, 1 frame, 1 sample, 8x8 pixels, a positive fps and a seed from 0 are needed"
        )
    options = Options(given.seed, given.cameras, given.frames, width, height, given.fps, given.samples, given.content)
    generate(given.folder, options)
    print(given.folder)


if __name__ == "__main__":
    sys.exit(main())
