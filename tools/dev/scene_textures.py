"""Procedural textures of the generated scene: linear colours of its surfaces, chosen by a seed.

Details are a centimetre or two wide, so that the cameras of the rig resolve them. Points are arrays (3, N), colours
linear RGB (3, N), both float32.
"""

import math
from dataclasses import dataclass

import numpy as np

from kpc.tools.dev.scene_geometry import (
    BACK_WALL,
    BALL,
    BALL_RADIUS,
    BEAD,
    BOARD,
    CUBE,
    FLOOR,
    FULL,
    PLINTH,
    RING,
    SIDE_WALL,
    STAND,
    VASE,
    Content,
    moving_objects,
    smoothstep,
)


@dataclass(frozen=True)
class Textures:
    """Textures of all materials for a seed; surfaces without a pattern in `content` have a uniform colour."""

    seed: int
    content: Content = FULL

    def albedo(self, material: int, points: np.ndarray, time: float) -> np.ndarray:
        """Return the linear albedo (3, N) of points (3, N) on a material at a time in [0, 1]."""
        x, y, z = points
        if material == FLOOR:
            return self._floor(x, y)
        if material == BACK_WALL:
            return self._mural(x, z)
        if material == SIDE_WALL:
            if "stripes" not in self.content.patterns:
                return _uniform((0.58, 0.49, 0.355), points)
            stripe = smoothstep(np.sin(2 * np.pi * y / 0.5), -0.25, 0.25)
            base = lerp((0.64, 0.55, 0.41), (0.52, 0.43, 0.30), stripe)
            return base * (1 + 0.06 * self.noise(x * 5, y * 5 + z, z * 5 - y))
        if material == PLINTH:
            veins = self.noise(x * 4 + 2 * self.noise(x * 3, y * 3, z * 3), y * 4, z * 4)
            return lerp((0.74, 0.72, 0.69), (0.50, 0.49, 0.48), smoothstep(veins, 0.05, 0.7))
        if material == CUBE:
            rings = np.sin(26 * np.hypot(x - 1.0 + 0.08 * self.noise(x * 4, y * 4, z * 4), z + 0.15))
            return lerp((0.50, 0.27, 0.12), (0.36, 0.17, 0.07), smoothstep(rings, -0.8, 0.8))
        if material == BALL:
            return self._ball(points, time)
        if material == RING:
            return _uniform((0.80, 0.47, 0.06), points)
        colour = {
            VASE: (0.012, 0.10, 0.115),
            STAND: (0.09, 0.09, 0.10),
            BEAD: (0.07, 0.30, 0.42),
            BOARD: (0.80, 0.77, 0.70),
        }[material]
        return _uniform(colour, points)

    def _floor(self, x: np.ndarray, y: np.ndarray) -> np.ndarray:
        wood = (
            self._planks(x, y)
            if "planks" in self.content.patterns
            else _uniform((0.43, 0.24, 0.115), np.stack([x, x, x]))
        )
        if "rug" not in self.content.patterns:
            return wood
        r = np.hypot(x - 0.1, (y + 0.25) * 1.15)
        rug = lerp((0.045, 0.085, 0.20), (0.62, 0.56, 0.44), smoothstep(np.sin(r * 2 * np.pi / 0.34 + 0.4), -0.3, 0.3))
        rug = rug * (1 + 0.12 * self.noise(x * 12, y * 12, x * 0))
        return lerp_arrays(rug, wood, smoothstep(r, 0.88, 0.90))

    def _planks(self, x: np.ndarray, y: np.ndarray) -> np.ndarray:
        plank = np.floor(x / 0.26)
        along = y + 0.7 * self._hash(plank, plank * 0 + 5, plank * 0)
        board = np.floor(along / 1.3)
        tone = self._hash(plank, board, plank * 0 + 9)
        grain = self.noise(x * 14, y * 1.6, plank)
        wood = lerp((0.38, 0.20, 0.095), (0.52, 0.30, 0.145), 0.25 + 0.5 * tone + 0.22 * grain)
        seam = np.minimum(_edge(x / 0.26) * 0.26, _edge(along / 1.3) * 1.3)
        return wood * (0.62 + 0.38 * smoothstep(seam, 0.002, 0.020))

    def _mural(self, x: np.ndarray, z: np.ndarray) -> np.ndarray:
        """Return the colours of hills below a sun on the back wall."""
        if "mural" not in self.content.patterns:
            return _uniform((0.265, 0.40, 0.43), np.stack([x, x, x]))
        wall = lerp((0.24, 0.37, 0.40), (0.29, 0.43, 0.46), smoothstep(z, 0.6, 2.0))
        sun = smoothstep(np.hypot(x - 0.72, z - 1.28), 0.33, 0.35)
        wall = lerp_arrays(np.array([[0.80], [0.33], [0.13]], np.float32), wall, sun)
        hills = (
            (0.92, 0.20, 1.9, 0.3, (0.58, 0.40, 0.20)),
            (0.66, 0.16, 2.6, 1.9, (0.25, 0.32, 0.17)),
            (0.38, 0.12, 2.1, 4.0, (0.06, 0.15, 0.15)),
        )
        for height, swing, rate, phase, colour in hills:
            line = height + swing * np.sin(rate * x + phase + 0.7 * self.seed)
            wall = lerp_arrays(np.array(colour, np.float32)[:, None], wall, smoothstep(z - line, -0.012, 0.012))
        return wall * (1 + 0.07 * self.noise(x * 6 + z, z * 6 - x, x * 0 + 3))

    def _ball(self, points: np.ndarray, time: float) -> np.ndarray:
        """Return the colours of the ball: coral with two cream bands; it turns once a clip about a tilted axis."""
        local = (points - moving_objects(time)[0].centre[:, None]) / BALL_RADIUS
        turn = 2 * math.pi * time
        x, y, z = local
        u = x * math.cos(turn) + y * math.sin(turn)
        height = (0.85 * z + 0.52 * u).astype(np.float32)
        bands = smoothstep(np.abs(np.abs(height) - 0.36), 0.10, 0.16)
        return lerp_arrays(
            np.array([[0.82], [0.75], [0.60]], np.float32), np.array([[0.78], [0.13], [0.075]], np.float32), bands
        )

    def noise(self, x: np.ndarray, y: np.ndarray, z: np.ndarray) -> np.ndarray:
        """Return smooth value noise in [-1, 1] with one feature per unit length."""
        corners = [np.floor(a) for a in (x, y, z)]
        fx, fy, fz = (smoothstep(a - c, 0, 1) for a, c in zip((x, y, z), corners, strict=True))
        total = np.zeros_like(fx)
        for corner in range(8):
            i, j, k = corner & 1, corner >> 1 & 1, corner >> 2
            weight = (fx if i else 1 - fx) * (fy if j else 1 - fy) * (fz if k else 1 - fz)
            total = total + weight * self._hash(corners[0] + i, corners[1] + j, corners[2] + k)
        return 2 * total - 1

    def _hash(self, i: np.ndarray, j: np.ndarray, k: np.ndarray) -> np.ndarray:
        """Hash each triple of integers to a number in [0, 1)."""
        h = (
            i.astype(np.int64) * 73856093
            ^ j.astype(np.int64) * 19349663
            ^ k.astype(np.int64) * 83492791
            ^ (self.seed + 1) * 2654435761
        )
        h = (h ^ h >> 13) * 1274126177 & 0xFFFFFFFF
        return ((h ^ h >> 16) & 0xFFFF).astype(np.float32) / np.float32(65536)


def _edge(x: np.ndarray) -> np.ndarray:
    """Return the distance to the nearest integer."""
    return np.abs(x - np.round(x))


def lerp(a: tuple[float, ...], b: tuple[float, ...], s: np.ndarray) -> np.ndarray:
    """Interpolate between two colours by a share (N,)."""
    return lerp_arrays(np.array(a, np.float32)[:, None], np.array(b, np.float32)[:, None], s)


def _uniform(colour: tuple[float, float, float], p: np.ndarray) -> np.ndarray:
    return np.broadcast_to(np.array(colour, np.float32)[:, None], p.shape)


def lerp_arrays(a: np.ndarray, b: np.ndarray, s: np.ndarray) -> np.ndarray:
    """Interpolate between arrays of colours (3, N) by a share (N,)."""
    return a + (b - a) * s
