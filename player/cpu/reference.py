"""The reference renderer in readable numpy: the oracle of the player's renderers, and their stand-in on servers without
OpenGL.

A ray o + t d with |d| = 1 enters the box at t_near and leaves it at t_far. Its samples lie at

    t_k = t_near + (k + 1/2) step,   k = 0, 1, ... while t_k < t_far,

and count where the occupancy grid is set. (In contracted space `kpc.format.scene.space.Contraction` says where they
lie, and what a step counts in the next line. In device coordinates o, d and t are those of
`kpc.format.scene.space.Path`, all but the depth's t.) With sigma per longest edge of the box ("extent"), from trans = 1
on:

    alpha = 1 - exp(-sigma step / extent)      weight = trans alpha      trans <- trans - weight

A ray ends once trans < TERMINATION. Then rgb = sum weight rgb_k + trans background, opacity = 1 - trans and
depth = sum weight t_k / sum weight. K-Planes, arXiv:2301.10241; the quadrature is NeRF's, arXiv:2003.08934, eq. 3.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from enum import Enum

import numpy as np

from kpc.format.scene.cameras import Camera
from kpc.format.scene.grid import sample_linear, texel_and_fraction
from kpc.format.scene.motion import displace
from kpc.format.scene.scene import (
    ACTIVATION_LIMIT,
    LOG_DENSITY_LIMIT,
    SPACE_PLANES,
    TERMINATION,
    TIME_PLANES,
    AnyDecoder,
    Decoder,
    HybridDecoder,
    Scene,
)
from kpc.format.scene.space import Contraction, DeviceCoordinates, contract

RAYS_AT_ONCE = 8192
STEPS_AT_ONCE = 16
# A direction's component is kept at least this far from 0, so that no slab test divides by 0.
PARALLEL = 1e-12


class Part(Enum):
    """What of a scene to show.

    STATIC: every time plane set to 1, every displacement to 0. DYNAMIC: |full - static|, that is, what moves, and what
        it hides or uncovers; depth,
    opacity and samples are the full scene's.
    """

    FULL = "full"
    STATIC = "static"
    DYNAMIC = "dynamic"


@dataclass(frozen=True)
class Rendering:
    """A picture, float32, and the depth and samples of its rays: (H, W, ...) from `render`, (N, ...) from
    `render_rays`.

    Attributes:
        rgb: (H, W, 3) in [0, 1].
        depth: (H, W) mean distance along the ray, world units; inf where opacity is 0.
        opacity: (H, W) in [0, 1].
        samples: (H, W) int32, samples at which the field was evaluated.
    """

    rgb: np.ndarray
    depth: np.ndarray
    opacity: np.ndarray
    samples: np.ndarray


def blend(parts: Sequence[tuple[Rendering, float]]) -> Rendering:
    """Blend pictures of one camera by their shares: colours and opacity in these shares, depth of the largest share,
    samples of all."""
    rgb, opacity = (
        sum(np.float32(share) * getattr(part, name) for part, share in parts) for name in ("rgb", "opacity")
    )
    largest, _ = max(parts, key=lambda part: part[1])
    return Rendering(rgb, largest.depth, opacity, np.asarray(np.sum([part.samples for part, _ in parts], axis=0)))


def render(
    scene: Scene, camera: Camera, time: float, *, part: Part = Part.FULL, appearance: np.ndarray | None = None
) -> Rendering:
    """Render `scene` as `camera` sees it at `time` in [0, 1] over the clip, and as `appearance_code` says of
    `appearance`."""
    origins, directions = camera.rays()
    flat = render_rays(scene, origins, directions, time, part=part, appearance=appearance)
    shape = (camera.height, camera.width)
    return Rendering(flat.rgb.reshape(*shape, 3), *(a.reshape(shape) for a in (flat.depth, flat.opacity, flat.samples)))


def render_rays(
    scene: Scene,
    origins: np.ndarray,
    directions: np.ndarray,
    time: float,
    *,
    part: Part = Part.FULL,
    appearance: np.ndarray | None = None,
    limits: np.ndarray | None = None,
) -> Rendering:
    """Render rays, (N, 3) float32 origins and unit directions in world coordinates. Only the result grows with N.
    `appearance` as in `appearance_code`. Rays see samples nearer than `limits`, (N,) distances in the world, only."""
    if not 0.0 <= time <= 1.0:
        raise ValueError(f"time {time} lies outside [0, 1]")
    if part is Part.DYNAMIC:
        full = render_rays(scene, origins, directions, time, appearance=appearance, limits=limits)
        static = render_rays(scene, origins, directions, time, part=Part.STATIC, appearance=appearance, limits=limits)
        return Rendering(np.abs(full.rgb - static.rgb), full.depth, full.opacity, full.samples)
    moment, code = SceneAtTime.of(scene, time, with_motion=part is Part.FULL), appearance_code(scene, appearance)
    n = len(origins)
    out = Rendering(np.empty((n, 3), np.float32), *(np.empty(n, t) for t in (np.float32, np.float32, np.int32)))
    for start in range(0, n, RAYS_AT_ONCE):
        block = slice(start, start + RAYS_AT_ONCE)
        seen = None if limits is None else limits[block]
        piece = _march(scene, moment, code, origins[block], directions[block], seen)
        out.rgb[block], out.depth[block] = piece.rgb, piece.depth
        out.opacity[block], out.samples[block] = piece.opacity, piece.samples
    return out


def appearance_code(scene: Scene, appearance: np.ndarray | None) -> np.ndarray:
    """Return the appearance code to show a scene with, (H,) float32: 0, the average appearance, for None.

    Raises:
        ValueError: it is not (H,), or the scene has no appearances, so that its decoder knows no codes.
    """
    hidden = len(scene.decoder.b1)
    if appearance is None:
        return np.zeros(hidden, np.float32)
    if np.shape(appearance) != (hidden,) or not scene.appearances:
        raise ValueError(
            f"a code of shape {np.shape(appearance)} for {len(scene.appearances)} appearances of {hidden} numbers"
        )
    return np.asarray(appearance, np.float32)


@dataclass(frozen=True)
class SceneAtTime:
    """What of a scene depends on the time alone.

    Attributes:
        rows: one mapping a scale, "x" | "y" | "z" -> (size, M) float32: the time planes cut at this time. Bilinear
            interpolation is separable, so this loses nothing. Empty where nothing moves.
        occupied: (Nz, Ny, Nx) bool.
        offsets: (Nz, Ny, Nx, 3) float32, the motion grid cut at this time; None where there is none.
    """

    rows: tuple[Mapping[str, np.ndarray], ...]
    occupied: np.ndarray
    offsets: np.ndarray | None

    @staticmethod
    def of(scene: Scene, time: float, with_motion: bool = True) -> "SceneAtTime":
        """Cut `scene` at `time`; without motion every time plane counts as 1, every displacement as 0."""
        rows: list[dict[str, np.ndarray]] = [
            {name[0]: sample_linear(scale[name], time) for name in TIME_PLANES}
            if with_motion and scene.is_dynamic
            else {}
            for scale in scene.scales
        ]
        offsets = None if scene.motion is None or not with_motion else sample_linear(scene.motion, time)
        return SceneAtTime(tuple(rows), scene.occupancy[occupancy_slot(scene, time)], offsets)


def occupancy_slot(scene: Scene, time: float) -> int:
    """Return the slot of the occupancy grid that holds at `time`: floor(time slots), the last one at time 1."""
    slots = len(scene.occupancy)
    return min(int(time * slots), slots - 1)


def box_range(aabb: np.ndarray, origins: np.ndarray, directions: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return where rays are inside the box: (t_near, t_far), (N,) each, t_near >= 0. t_far <= t_near where they miss
    it."""
    away = np.where(directions < 0, np.float32(-PARALLEL), np.float32(PARALLEL))
    inverse = np.float32(1) / np.where(np.abs(directions) < PARALLEL, away, directions)
    t0, t1 = (aabb[0] - origins) * inverse, (aabb[1] - origins) * inverse
    return np.maximum(np.minimum(t0, t1).max(axis=1), np.float32(0)), np.maximum(t0, t1).min(axis=1)


def sample_range(scene: Scene, origins: np.ndarray, directions: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return where the samples of rays begin and end, (N,) each: as `box_range`; in contracted space in its s."""
    if not isinstance(scene.mapping, Contraction):
        return box_range(scene.aabb, origins, directions)
    return np.zeros(len(origins), np.float32), np.full(len(origins), scene.mapping.s_end, np.float32)


def sample_positions(
    scene: Scene, origins: np.ndarray, directions: np.ndarray, s: np.ndarray
) -> tuple[np.ndarray, ...]:
    """Return, for samples at s (N, K) on N rays, distance t (N, K), position u (N, K, 3) in the planes, and density
    scale (N, K)."""
    if not isinstance(scene.mapping, Contraction):
        size = (scene.aabb[1] - scene.aabb[0]).astype(np.float32)
        return s, (origins[:, None] + s[..., None] * directions[:, None] - scene.aabb[0]) / size, np.ones_like(s)
    t = scene.mapping.distance(s)
    u, radius = contract(origins[:, None] + t[..., None] * directions[:, None], scene.aabb)
    return t, u, scene.mapping.density_scale(t, radius)


def bilinear(plane: np.ndarray, u: np.ndarray, v: np.ndarray) -> np.ndarray:
    """Sample a (rows, columns, M) plane at (N,) positions, u along columns and v along rows, both in [0, 1]: (N, M)."""
    rows, columns, channels = plane.shape
    (i, f), (j, g) = texel_and_fraction(u, columns), texel_and_fraction(v, rows)
    flat = plane.reshape(-1, channels)
    corner = j * columns + i
    right, up = np.int32(columns > 1), np.int32(columns if rows > 1 else 0)
    out = flat[corner] * ((1 - f) * (1 - g))[:, None]
    out += flat[corner + right] * (f * (1 - g))[:, None]
    out += flat[corner + up] * ((1 - f) * g)[:, None]
    out += flat[corner + up + right] * (f * g)[:, None]
    return out


def features(scene: Scene, moment: SceneAtTime, u: np.ndarray) -> np.ndarray:
    """Return f at (N, 3) points in [0, 1]^3: (N, F), the product over planes, concatenated over scales (eq. 1 of
    K-Planes)."""
    if moment.offsets is not None:
        u = displace(u, moment.offsets)
    axis = {"x": u[:, 0], "y": u[:, 1], "z": u[:, 2]}
    out = []
    for scale, rows in zip(scene.scales, moment.rows, strict=True):
        product = np.ones(1, np.float32)
        for name in SPACE_PLANES:
            product = product * bilinear(scale[name], axis[name[0]], axis[name[1]])
        for letter, row in rows.items():
            product *= sample_linear(row, axis[letter])
        out.append(product)
    return np.concatenate(out, axis=1)


def density(decoder: AnyDecoder, f: np.ndarray) -> np.ndarray:
    """Return sigma per longest edge of the box of features (N, F): (N,). `kpc.format.scene.scene`."""
    values = activations(decoder, f) if isinstance(decoder, HybridDecoder) else f
    return np.exp(
        np.clip(values @ decoder.density_weight + decoder.density_bias, -LOG_DENSITY_LIMIT, LOG_DENSITY_LIMIT)
    )


def activations(decoder: HybridDecoder, f: np.ndarray) -> np.ndarray:
    """Return h of `HybridDecoder`: (N, F) -> (N, G)."""
    return np.clip(f @ decoder.v.T + decoder.v_bias, 0, ACTIVATION_LIMIT)


def hidden_layer(decoder: AnyDecoder, directions: np.ndarray, code: np.ndarray) -> np.ndarray:
    """Return w1 e(d) + b1 + code of unit directions (N, 3) and an appearance's code (H,): (N, H), constant along a
    ray."""
    x, y, z = directions.T
    encoded = np.stack([x, y, z, x * x, y * y, z * z, x * y, y * z, z * x], axis=1)
    return encoded @ decoder.w1.T + (decoder.b1 + code)


def direction_basis(decoder: Decoder, directions: np.ndarray, code: np.ndarray) -> np.ndarray:
    """Return basis(d) = w2 relu(hidden layer) + b2 of unit directions (N, 3): (N, 3, F)."""
    hidden = np.maximum(hidden_layer(decoder, directions, code), 0)
    return np.einsum("cfh,nh->ncf", decoder.w2, hidden, optimize=True) + decoder.b2


def ray_terms(decoder: AnyDecoder, directions: np.ndarray, code: np.ndarray) -> np.ndarray:
    """Return what `colour` needs of unit directions (N, 3): their basis, or with a hybrid decoder their part of its
    hidden layer."""
    terms = hidden_layer if isinstance(decoder, HybridDecoder) else direction_basis
    return terms(decoder, directions, code).astype(np.float32)  # type: ignore[arg-type]


def colour(decoder: AnyDecoder, f: np.ndarray, terms: np.ndarray) -> np.ndarray:
    """Return rgb of features (N, F), given `ray_terms` of their rays: (N, 3). `kpc.format.scene.scene`."""
    if isinstance(decoder, HybridDecoder):
        hidden = np.clip(terms + activations(decoder, f) @ decoder.u.T, 0, ACTIVATION_LIMIT)
        return sigmoid(hidden @ decoder.w2.T + decoder.b2)
    return sigmoid(np.einsum("nf,ncf->nc", f, terms))


def sigmoid(x: np.ndarray) -> np.ndarray:
    with np.errstate(over="ignore"):  # exp of much more than 88 is infinite, and the result 0
        return 1 / (1 + np.exp(-x))


def composite(alphas: np.ndarray, trans: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Composite the next samples of rays, (N, K) alphas, front to back, from their transmittance `trans` (N,) on.

    Returns:
        (N, K) weights, (N,) remaining transmittance, and (N, K) bool: samples that were reached before the ray ended.
    """
    through = np.cumprod(np.concatenate([trans[:, None], 1 - alphas], axis=1), axis=1)
    reached = through[:, :-1] >= TERMINATION
    weights = np.where(reached, through[:, :-1] * alphas, np.float32(0))
    return weights, through[np.arange(len(trans)), reached.sum(axis=1)], reached


def _march(
    scene: Scene,
    moment: SceneAtTime,
    code: np.ndarray,
    origins: np.ndarray,
    directions: np.ndarray,
    limits: np.ndarray | None,
) -> Rendering:
    n, path = len(origins), None
    if isinstance(scene.mapping, DeviceCoordinates):
        path = scene.mapping.rays(origins, directions)
        origins, directions = path.origins, path.directions
    near, far = sample_range(scene, origins, directions)
    terms = ray_terms(scene.decoder, directions, code)
    rgb, depth = np.zeros((n, 3), np.float32), np.zeros(n, np.float32)
    trans, samples = np.ones(n, np.float32), np.zeros(n, np.int32)
    step = np.float32(scene.step)
    cells = np.array(moment.occupied.shape[::-1])

    rays, first = np.flatnonzero(near < far), 0
    while len(rays):
        s = near[rays, None] + (np.arange(first, first + STEPS_AT_ONCE, dtype=np.float32) + np.float32(0.5)) * step
        t, u, stretch = sample_positions(scene, origins[rays], directions[rays], s)
        distance = t if path is None else path.distance(s, rays)
        inside = s < far[rays, None] if limits is None else (s < far[rays, None]) & (distance < limits[rays, None])
        x, y, z = np.clip((u * cells).astype(np.int32), 0, cells - 1).transpose(2, 0, 1)
        row, column = np.nonzero(moment.occupied[z, y, x] & inside)

        f = features(scene, moment, u[row, column])
        alphas = np.zeros_like(s)
        thickness = np.float32(scene.step / scene.extent) * stretch[row, column]
        alphas[row, column] = 1 - np.exp(-density(scene.decoder, f) * thickness)
        weights, trans[rays], reached = composite(alphas, trans[rays])
        shown = reached[row, column]
        row, column, f = row[shown], column[shown], f[shown]

        weight, ray = weights[row, column], rays[row]
        seen = weight[:, None] * colour(scene.decoder, f, terms[ray])
        for channel in range(3):
            rgb[:, channel] += np.bincount(ray, seen[:, channel], n).astype(np.float32)
        depth += np.bincount(ray, weight * distance[row, column], n).astype(np.float32)
        samples += np.bincount(ray, minlength=n).astype(np.int32)

        first += STEPS_AT_ONCE
        on = (trans[rays] >= TERMINATION) & (near[rays] + (np.float32(first) + np.float32(0.5)) * step < far[rays])
        rays = rays[on]

    rgb += trans[:, None] * scene.background
    opacity = 1 - trans
    depth = np.divide(depth, opacity, out=np.full(n, np.inf, np.float32), where=opacity > 0)
    return Rendering(rgb, depth, opacity, samples)
