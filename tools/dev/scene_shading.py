"""Lighting of the generated scene: a lamp with soft shadows, ambient light, highlights and one mirroring vase.

`StaticView` traces rays against the static objects once; a frame then recomputes only rays, shadows and reflections
that a moving object can reach. Vectors are arrays (3, N), scalars (N,), all float32; colours are linear RGB.
"""

from dataclasses import dataclass
from functools import cached_property, partial

import numpy as np

from kpc.tools.dev.scene_geometry import (
    BALL,
    BEAD,
    RING,
    VASE,
    Content,
    Distance,
    MovingObject,
    caster_distance,
    moving_objects,
    normals,
    smoothstep,
    sphere_intervals,
    sphere_trace,
    static_distance,
    static_distances,
)
from kpc.tools.dev.scene_textures import Textures, lerp

LIGHT = (1.9, -2.4, 3.4)
# Ratio of the lamp's distance to its apparent width; it sets the width of penumbras.
PENUMBRA = 7.0

# Ambient occlusion reaches this far, in metres.
OCCLUSION_REACH = 0.3

# Glossy materials: reflectance at normal incidence, and 1 where a reflection of the room is traced.
GLOSS = {VASE: (0.05, 1.0), BALL: (0.035, 0.0), RING: (0.05, 0.0), BEAD: (0.05, 0.0)}


@dataclass
class StaticView:
    """Rays, the static surfaces they hit and how those are lit; `radiance` adds the moving objects.

    Attributes:
        origins, directions: (3, N) float32, directions of unit length.
        mirrors: whether the mirroring vase reflects the room; reflected rays are not reflected again.
    """

    textures: Textures
    origins: np.ndarray
    directions: np.ndarray
    mirrors: bool = True

    def __post_init__(self) -> None:
        count = self.origins.shape[1]
        far = np.full(count, 20.0, np.float32)
        distance = self.distance
        self.t = sphere_trace(distance, self.origins, self.directions, np.full(count, 0.02, np.float32), far)
        self.t = np.where(np.isfinite(self.t), self.t, far)
        self.points = self.origins + self.directions * self.t
        self.normals = normals(distance, self.points)
        distances = static_distances(self.points, self.textures.content)
        self.material = np.array(list(distances))[np.argmin(np.stack(list(distances.values())), axis=0)]
        self.albedo = np.zeros_like(self.points)
        for material in np.unique(self.material):
            there = self.material == material
            self.albedo[:, there] = self.textures.albedo(material, self.points[:, there], 0.0)
        self.lamp_visibility = _static_visibility(self.points, self.normals, self.textures.content)
        self.openness = ambient_visibility(distance, self.points, self.normals)
        self.static_radiance = shade(
            self.material, self.points, self.normals, self.albedo, self.directions, self.lamp_visibility, self.openness
        )

    @property
    def distance(self) -> Distance:
        """The distance function of all static objects."""
        return partial(static_distance, content=self.textures.content)

    @cached_property
    def mirror(self) -> tuple[np.ndarray, np.ndarray, "StaticView"] | None:
        """The rays reflected by the vase: their indices, their reflectance, and the view along them."""
        which = np.flatnonzero(self.material == VASE) if self.mirrors else np.empty(0, int)
        if not which.size:
            return None
        n, d = self.normals[:, which], self.directions[:, which]
        reflected = d - 2 * n * (n * d).sum(0)
        return (
            which,
            _fresnel(GLOSS[VASE][0], n, d),
            StaticView(self.textures, self.points[:, which] + n * np.float32(0.01), reflected, mirrors=False),
        )

    def radiance(self, time: float) -> np.ndarray:
        """Return the linear colours (3, N) at a time in [0, 1]."""
        moving = moving_objects(time, self.textures.content)
        lit = self.static_radiance.copy()
        touched, lamp, openness = _moving_visibility(moving, self.points, self.normals)
        if touched.size:
            lit[:, touched] = shade(
                self.material[touched],
                self.points[:, touched],
                self.normals[:, touched],
                self.albedo[:, touched],
                self.directions[:, touched],
                self.lamp_visibility[touched] * lamp,
                self.openness[touched] * openness,
            )
        if self.mirror is not None:
            which, reflectance, beyond = self.mirror
            lit[:, which] += reflectance * beyond.radiance(time)
        nearest = self.t.copy()
        for one in moving:
            start, end = sphere_intervals(one, self.origins, self.directions)
            rays = np.flatnonzero(start < np.minimum(end, nearest))
            t = sphere_trace(
                one.distance,
                self.origins[:, rays],
                self.directions[:, rays],
                start[rays],
                np.minimum(end, nearest)[rays],
            )
            rays, t = rays[np.isfinite(t)], t[np.isfinite(t)]
            if rays.size:
                nearest[rays] = t
                lit[:, rays] = self._moving_radiance(moving, one, time, rays, t)
        return lit

    def _moving_radiance(
        self, moving: tuple[MovingObject, ...], hit: MovingObject, time: float, rays: np.ndarray, t: np.ndarray
    ) -> np.ndarray:
        """Return the colours of a moving object where `rays` hit it at `t`."""
        d = self.directions[:, rays]
        p = self.origins[:, rays] + d * t
        n = normals(hit.distance, p)
        ids = np.array([material for material, _ in hit.materials])
        material = ids[np.argmin(np.stack([distance(p) for _, distance in hit.materials]), axis=0)]
        albedo = np.zeros_like(p)
        for number in ids:
            there = material == number
            albedo[:, there] = self.textures.albedo(int(number), p[:, there], time)
        lamp, openness = _static_visibility(p, n, self.textures.content), ambient_visibility(self.distance, p, n)
        touched, moving_lamp, moving_openness = _moving_visibility(moving, p, n)
        lamp[touched] *= moving_lamp
        openness[touched] *= moving_openness
        return shade(material, p, n, albedo, d, lamp, openness)


def shade(
    material: np.ndarray,  # (N,) int
    points: np.ndarray,  # (3, N)
    normals: np.ndarray,  # (3, N)
    albedo: np.ndarray,  # (3, N) linear
    directions: np.ndarray,  # (3, N), of the rays
    lamp_visibility: np.ndarray,  # (N,) in [0, 1]
    openness: np.ndarray,  # (N,) in [0, 1], the share of ambient light
) -> np.ndarray:
    """Return linear colours (3, N) under a warm lamp, a cool sky and light reflected by the floor, with highlights."""
    to_light, _ = _to_light(points)
    lamp = np.maximum((normals * to_light).sum(0), 0) * lamp_visibility
    up = 0.5 + 0.5 * normals[2]
    ambient = lerp((0.20, 0.15, 0.115), (0.34, 0.38, 0.44), up) * openness
    colour = albedo * (np.array([[1.62], [1.42], [1.14]], np.float32) * lamp + ambient)
    for number, (reflectance, mirrors) in GLOSS.items():
        there = np.flatnonzero(material == number)
        if there.size:
            halfway = to_light[:, there] - directions[:, there]
            halfway /= np.linalg.norm(halfway, axis=0)
            lobe = np.maximum((normals[:, there] * halfway).sum(0), 0) ** (90 if mirrors else 40)
            colour[:, there] += (1.1 if mirrors else 0.35) * lobe * lamp_visibility[there]
            if not mirrors:  # ambient light stands in for a traced reflection
                colour[:, there] += _fresnel(reflectance, normals[:, there], directions[:, there]) * ambient[:, there]
    return colour


def lamp_visibility(
    distance: Distance, points: np.ndarray, to_light: np.ndarray, end: np.ndarray, start: np.ndarray
) -> np.ndarray:
    """Return the visible share of the lamp, (N,) in [0, 1], from the narrowest angle that the ray to it clears."""
    visible = np.ones(points.shape[1], np.float32)
    t = np.maximum(start, 0.02).astype(np.float32)
    active = np.flatnonzero(t < end)
    for _ in range(48):
        if not active.size:
            break
        d = distance(points[:, active] + to_light[:, active] * t[active])
        visible[active] = np.minimum(visible[active], 0.5 + 0.5 * PENUMBRA * d / t[active])
        t[active] += np.clip(np.abs(d), 0.012, 0.25)
        active = active[(visible[active] > 0) & (t[active] < end[active])]
    return smoothstep(visible, 0, 1)


def ambient_visibility(distance: Distance, points: np.ndarray, normals: np.ndarray) -> np.ndarray:
    """Return 1 in the open and less in corners: how much the distance falls short of the height over the surface."""
    shortfall = np.zeros(points.shape[1], np.float32)
    for k in range(1, 5):
        h = np.float32(OCCLUSION_REACH * k / 4)
        shortfall += np.maximum(h - distance(points + normals * h), 0) * np.float32(0.6**k)
    return 1 - np.clip(1.7 * shortfall / OCCLUSION_REACH, 0, 0.85)


def _fresnel(head_on: float, n: np.ndarray, d: np.ndarray) -> np.ndarray:
    """Return the reflectance by Schlick's approximation."""
    return (
        head_on
        + (0.75 - head_on) * (1 - np.clip(-(n * d).sum(0), 0, 1)) ** 5
        + np.float32(0.12 if head_on == GLOSS[VASE][0] else 0)
    )


def _to_light(points: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return unit directions to the lamp (3, N) and distances (N,)."""
    offset = np.array(LIGHT, np.float32)[:, None] - points
    length = np.linalg.norm(offset, axis=0)
    return offset / length, length


def _static_visibility(points: np.ndarray, normals: np.ndarray, content: Content) -> np.ndarray:
    """Return the visible share of the lamp past static objects, 0 on surfaces that face away from it."""
    to_light, length = _to_light(points)
    lit = np.flatnonzero((normals * to_light).sum(0) > 0)
    visible = np.zeros(points.shape[1], np.float32)
    start = points[:, lit] + normals[:, lit] * np.float32(0.01)
    casting = partial(caster_distance, content=content)
    visible[lit] = lamp_visibility(
        casting, start, to_light[:, lit], np.minimum(length[lit], 4.0), np.zeros(lit.size, np.float32)
    )
    return visible


def _moving_visibility(
    moving: tuple[MovingObject, ...], points: np.ndarray, normals: np.ndarray
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return the points that moving objects darken, and there the visible shares of the lamp and of the sky."""
    to_light, length = _to_light(points)
    lamp, openness = np.ones(points.shape[1], np.float32), np.ones(points.shape[1], np.float32)
    for one in moving:
        offset = one.centre[:, None] - points
        along = (offset * to_light).sum(0)
        beside = np.sqrt(np.maximum((offset**2).sum(0) - along**2, 0))
        reach = one.radius + (np.maximum(along, 0) + one.radius) / PENUMBRA
        dark = np.flatnonzero((beside < reach) & (along > -one.radius) & ((normals * to_light).sum(0) > 0))
        start = np.maximum(along[dark] - reach[dark] - 0.1, 0)
        end = np.minimum(along[dark] + reach[dark] + 0.1, length[dark])
        raised = points[:, dark] + normals[:, dark] * np.float32(0.01)
        lamp[dark] *= lamp_visibility(one.distance, raised, to_light[:, dark], end, start)
        close = np.flatnonzero((offset**2).sum(0) < (one.radius + 2 * OCCLUSION_REACH) ** 2)
        if close.size:
            openness[close] *= ambient_visibility(one.distance, points[:, close], normals[:, close])
    touched = np.flatnonzero((lamp < 1) | (openness < 1))
    return touched, lamp[touched], openness[touched]
