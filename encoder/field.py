"""The radiance field that is trained: K-Planes with the explicit decoder (arXiv:2301.10241), parameters and plain PyTorch.

The planes live in one flat vector `theta`, channel-last, so that the fused kernels (`kpc.encoder.kernels`), the optimiser and
the priors see one array. `render_reference` is the readable twin of the kernels: it runs on any device, with autograd.
"""

import math
from collections.abc import Iterator, Sequence
from dataclasses import dataclass

import numpy as np
import torch
from torch import Tensor, nn

from kpc.encoder.config import TrainConfig
from kpc.encoder.occupancy import grid_shape
from kpc.format.scene import (
    ALL_PLANES, LOG_DENSITY_LIMIT, SPACE_PLANES, TERMINATION, TIME_PLANES, Clip, Decoder, Scene,
)
from kpc.format.space import Contraction, SpaceMapping

AXES = "xyzt"


@dataclass(frozen=True)
class Layout:
    """Where each plane lies in `theta`.

    Attributes:
        resolution: (S, 4) int64, texels along x, y, z and t; t is 0 in a static scene.
        channels: M, the same for all scales.
        table: (S, 6) int64, first element of each plane in the order of ALL_PLANES, -1 where there is none.
        size: number of elements.
    """

    resolution: np.ndarray
    channels: int
    table: np.ndarray
    size: int

    @staticmethod
    def of(resolution: np.ndarray, channels: int) -> "Layout":
        resolution = np.asarray(resolution, np.int64)
        names = ALL_PLANES if resolution[0, 3] else SPACE_PLANES
        table = np.full((len(resolution), 6), -1, np.int64)
        size = 0
        for s, axes in enumerate(resolution):
            for c, name in enumerate(names):
                table[s, c] = size
                size += int(axes[AXES.index(name[0])] * axes[AXES.index(name[1])]) * channels
        return Layout(resolution, channels, table, size)

    @property
    def is_dynamic(self) -> bool:
        return bool(self.resolution[0, 3])

    @property
    def features(self) -> int:
        return len(self.resolution) * self.channels

    def planes(self) -> Iterator[tuple[int, str, int, int, int]]:
        """(scale, name, start, rows, columns) of every plane."""
        for s, axes in enumerate(self.resolution):
            for c, name in enumerate(ALL_PLANES):
                if self.table[s, c] >= 0:
                    yield s, name, int(self.table[s, c]), int(axes[AXES.index(name[1])]), int(axes[AXES.index(name[0])])


def plan_layout(config: TrainConfig, aabb: np.ndarray, clip: Clip, is_dynamic: bool) -> Layout:
    """Texels in proportion to the box: `resolutions` along its longest edge, as many a unit length along the others.

    The number of rows in time is the same at every scale (K-Planes, section 3.1). No axis has fewer than two texels.
    """
    edges = np.asarray(aabb[1] - aabb[0], np.float64)
    rows = time_rows(clip.frame_count, config.frames_per_row) if is_dynamic else 0
    resolution = [[max(2, round(n * e / edges.max())) for e in edges] + [rows] for n in config.resolutions]
    return Layout.of(np.array(resolution), config.channels)


def time_rows(frame_count: int, frames_per_row: float) -> int:
    """Rows of the time planes over a clip."""
    return max(2, math.ceil(frame_count / frames_per_row))


def motion_nodes(config: TrainConfig, aabb: np.ndarray, layout: Layout) -> tuple[int, int, int, int] | None:
    """Nodes of the motion grid along t, z, y and x: a row for each of the time planes, cells as near to cubes as may be."""
    if not config.motion_cells or not layout.is_dynamic:
        return None
    nz, ny, nx = grid_shape(aabb, config.motion_cells)
    return int(layout.resolution[0, 3]), nz + 1, ny + 1, nx + 1


class Field(nn.Module):
    """Planes and explicit decoder.

    Attributes:
        theta: (layout.size,) the planes. Space planes start uniform in [0.1, 0.5], time planes at 1 (K-Planes).
        density: (F + 1,) weights of the log density, its bias last.
        motion: (T, Nz, Ny, Nx, 3) displacements, `kpc.format.motion`, at first 0; or None.
        w1, b1, w2, b2: the direction MLP, shapes as in `kpc.format.scene.Decoder`. w2 starts at 0: colour depends on the
            direction only as far as the pictures insist.
    """

    def __init__(
        self, layout: Layout, hidden: int, generator: torch.Generator | None = None, motion_nodes: Sequence[int] | None = None
    ) -> None:
        """`motion_nodes`: of the motion grid along t, z, y and x; None for a field without one."""
        super().__init__()
        self.layout = layout
        self.motion = None if motion_nodes is None else nn.Parameter(torch.zeros(*motion_nodes, 3))
        F = layout.features

        def uniform(low: float, high: float, *shape: int) -> Tensor:
            return torch.rand(shape, generator=generator) * (high - low) + low

        theta = torch.ones(layout.size)
        for _, name, start, rows, columns in layout.planes():
            if name in SPACE_PLANES:
                theta[start : start + rows * columns * layout.channels] = uniform(0.1, 0.5, rows * columns * layout.channels)
        self.theta = nn.Parameter(theta)
        # Weights of zero mean: the box starts evenly thin, whatever the seed, with log density -1 on average.
        weights = uniform(-3, 3, F)
        self.density = nn.Parameter(torch.cat([weights - weights.mean(), torch.tensor([-1.0])]))
        self.w1 = nn.Parameter(uniform(-1, 1, hidden, 9))
        self.b1 = nn.Parameter(torch.zeros(hidden))
        self.w2 = nn.Parameter(torch.zeros(3, F, hidden))
        self.b2 = nn.Parameter(uniform(-1, 1, 3, F))

    def plane(self, scale: int, name: str) -> Tensor:
        """A view of one plane: (rows, columns, M)."""
        axes = self.layout.resolution[scale]
        rows, columns = int(axes[AXES.index(name[1])]), int(axes[AXES.index(name[0])])
        start = int(self.layout.table[scale, ALL_PLANES.index(name)])
        M = self.layout.channels
        return self.theta[start : start + rows * columns * M].view(rows, columns, M)

    def basis(self, directions: Tensor) -> Tensor:
        """Colour basis of unit directions (N, 3): (N, 3, F). basis(d) = w2 relu(w1 e(d) + b1) + b2."""
        x, y, z = directions.unbind(-1)
        encoded = torch.stack([x, y, z, x * x, y * y, z * z, x * y, y * z, z * x], dim=-1)
        h = torch.relu(encoded @ self.w1.T + self.b1)
        F, H = self.w2.shape[1:]
        return (h @ self.w2.reshape(3 * F, H).T).view(-1, 3, F) + self.b2

    def features(self, points: Tensor, times: Tensor) -> Tensor:
        """Features at (N, 3) points in [0, 1]^3 and (N,) times in [0, 1]: (N, F).

        The product over planes, concatenated over scales, of what they hold where the motion grid leads.
        """
        if self.motion is not None:
            points = moved(points, times, self.motion)
        coordinate = {"x": points[:, 0], "y": points[:, 1], "z": points[:, 2], "t": times}
        scales = []
        for s in range(len(self.layout.resolution)):
            product: Tensor | None = None
            for name in ALL_PLANES if self.layout.is_dynamic else SPACE_PLANES:
                sample = bilinear(self.plane(s, name), coordinate[name[0]], coordinate[name[1]])
                product = sample if product is None else product * sample
            assert product is not None
            scales.append(product)
        return torch.cat(scales, dim=-1)

    def log_density(self, features: Tensor) -> Tensor:
        """Clipped log density, per longest edge of the box: (N,)."""
        return (features @ self.density[:-1] + self.density[-1]).clamp(-LOG_DENSITY_LIMIT, LOG_DENSITY_LIMIT)

    def to_scene(
        self, aabb: np.ndarray, clip: Clip, occupancy: np.ndarray, background: np.ndarray, step: float,
        mapping: SpaceMapping | None = None,
    ) -> Scene:
        """The field as data; the planes are copied."""
        names = ALL_PLANES if self.layout.is_dynamic else SPACE_PLANES
        with torch.no_grad():
            scales = tuple(
                {name: self.plane(s, name).cpu().numpy().copy() for name in names}
                for s in range(len(self.layout.resolution))
            )
            arrays = [p.detach().cpu().numpy().copy() for p in (self.w1, self.b1, self.w2, self.b2)]
            density = self.density.detach().cpu().numpy()
        return Scene(
            aabb=np.asarray(aabb, np.float32), clip=clip, scales=scales,
            decoder=Decoder(density[:-1].copy(), float(density[-1]), *arrays),
            occupancy=np.asarray(occupancy, bool), background=np.asarray(background, np.float32), step=float(step),
            mapping=mapping, motion=None if self.motion is None else self.motion.detach().cpu().numpy().copy(),
        )

    @staticmethod
    def from_scene(scene: Scene) -> "Field":
        """The field whose planes and decoder a scene holds."""
        shape = {name: scene.scales[0][name].shape for name in scene.scales[0]}
        resolution = []
        for scale in scene.scales:
            rows_t = scale["xt"].shape[0] if scene.is_dynamic else 0
            resolution.append([scale["xy"].shape[1], scale["xy"].shape[0], scale["xz"].shape[0], rows_t])
        layout = Layout.of(np.array(resolution), shape["xy"][2])
        field = Field(layout, scene.decoder.b1.size, motion_nodes=None if scene.motion is None else scene.motion.shape[:4])
        with torch.no_grad():
            for s, scale in enumerate(scene.scales):
                for name, plane in scale.items():
                    field.plane(s, name).copy_(torch.from_numpy(np.asarray(plane, np.float32)))
            if field.motion is not None:
                field.motion.copy_(torch.from_numpy(np.asarray(scene.motion, np.float32)))
            d = scene.decoder
            field.density.copy_(torch.from_numpy(np.append(d.density_weight, np.float32(d.density_bias)).astype(np.float32)))
            for parameter, value in ((field.w1, d.w1), (field.b1, d.b1), (field.w2, d.w2), (field.b2, d.b2)):
                parameter.copy_(torch.from_numpy(np.asarray(value, np.float32)))
        return field


def tap(x: Tensor, size: int) -> tuple[Tensor, Tensor]:
    """Corner-aligned position x (size - 1), x in [0, 1], as a lower node and the fraction (N, 1) towards the next."""
    position = x * (size - 1)
    lower = position.detach().floor().clamp(0, max(size - 2, 0))
    return lower.long(), (position - lower).clamp(0, 1)[:, None]


def moved(points: Tensor, times: Tensor, motion: Tensor) -> Tensor:
    """Places in the planes of (N, 3) points in [0, 1]^3 at (N,) times: `kpc.format.motion.moved`, differentiable."""
    rows, nz, ny, nx, _ = motion.shape
    (h, fh), (i, fi), (j, fj), (k, fk) = (
        tap(x, size) for x, size in zip((times, points[:, 2], points[:, 1], points[:, 0]), (rows, nz, ny, nx), strict=True))
    out = points
    for dh, di, dj, dk in np.ndindex(2, 2, 2, 2):
        weight = (fh if dh else 1 - fh) * (fi if di else 1 - fi) * (fj if dj else 1 - fj) * (fk if dk else 1 - fk)
        out = out + weight * motion[h + dh, i + di, j + dj, k + dk]
    return out.clamp(0, 1)


def bilinear(plane: Tensor, u: Tensor, v: Tensor) -> Tensor:
    """Sample a (rows, columns, M) plane, corner-aligned: u in [0, 1] along columns, v along rows. Returns (N, M)."""
    rows, columns, M = plane.shape
    (i, fu), (j, fv) = tap(u, columns), tap(v, rows)
    flat = plane.reshape(-1, M)
    k = j * columns + i
    low = flat[k] * (1 - fu) + flat[k + 1] * fu
    high = flat[k + columns] * (1 - fu) + flat[k + columns + 1] * fu
    return low * (1 - fv) + high * fv


@dataclass(frozen=True)
class Rays:
    """A batch of rays; every member has N rows. Directions are unit vectors, times and jitters lie in [0, 1)."""

    origins: Tensor
    directions: Tensor
    times: Tensor
    jitters: Tensor
    backgrounds: Tensor


def place(points: Tensor, t: Tensor, aabb: Tensor, mapping: SpaceMapping | None) -> tuple[Tensor, Tensor]:
    """Places (..., 3) of world points in [0, 1]^3, and what a step there counts, `kpc.format.space.Contraction.stretch`.

    `t` (...): how far along their rays they lie.
    """
    u = (points - aabb[0]) / (aabb[1] - aabb[0])
    if not isinstance(mapping, Contraction):
        return u, torch.ones_like(t)
    y = 2 * u - 1
    radius = y.abs().amax(-1).clamp(min=1)
    stretch = ((t / mapping.even).clamp(min=1) / radius).square()
    return y * ((2 - 1 / radius) / radius / 4)[..., None] + 0.5, stretch


def render_reference(
    field: Field, rays: Rays, aabb: Tensor, occupancy: Tensor, step: float, kept: Tensor | None = None,
    mapping: SpaceMapping | None = None,
) -> tuple[Tensor, Tensor, Tensor, Tensor]:
    """Colours of a batch of rays, in plain PyTorch: the reference of `kernels.backpropagate`.

    Sample k of a ray lies at s = near + (k + jitter) * step, which is its distance unless there is a mapping, and counts where
    the occupancy grid (slots, Nz, Ny, Nx) is set; alpha = 1 - exp(-sigma stretch step / extent), stretch = 1 in a box; a ray
    ends once its transmittance falls below TERMINATION. `kept` (F,), where given, multiplies the features.

    Returns:
        Colours (N, 3); the mean over rays of the distortion D that `kernels.backpropagate` states; of the n samples taken
        their weights (n,), and their cells (n, 3) int64 in the order z, y, x.
    """
    extent = (aabb[1] - aabb[0]).max()
    inverse = 1 / rays.directions
    t0, t1 = (aabb[0] - rays.origins) * inverse, (aabb[1] - rays.origins) * inverse
    near = torch.minimum(t0, t1).nan_to_num(-torch.inf).amax(1).clamp(min=0)
    far = torch.maximum(t0, t1).nan_to_num(torch.inf).amin(1)
    if isinstance(mapping, Contraction):
        near, far = torch.zeros_like(near), torch.full_like(far, mapping.end)
    longest = float((far - near).clamp(min=0).max())
    k = torch.arange(max(1, math.ceil(longest / step)), device=near.device)
    s = near[:, None] + (k + rays.jitters[:, None]) * step
    t = s
    if isinstance(mapping, Contraction):
        t = torch.where(s <= mapping.even, s, mapping.even / (2 - s.clamp(max=mapping.end) / mapping.even))
    u, stretch = place(rays.origins[:, None] + t[..., None] * rays.directions[:, None], t, aabb, mapping)
    size = torch.tensor(occupancy.shape[:0:-1], device=u.device)
    cell = (u.detach() * size).long().clamp(min=0).minimum(size - 1)
    slot = (rays.times * occupancy.shape[0]).long().clamp(max=occupancy.shape[0] - 1)[:, None]
    cell = cell.flip(-1)
    taken = occupancy[slot, cell[..., 0], cell[..., 1], cell[..., 2]].bool() & (s < far[:, None])
    ray, _ = index = taken.nonzero(as_tuple=True)

    features = field.features(u[index], rays.times[ray])
    if kept is not None:
        features = features * kept
    tau = torch.zeros_like(s).index_put(index, field.log_density(features).exp() * (step / extent) * stretch[index])
    trans = torch.exp(-torch.cumsum(torch.nn.functional.pad(tau, (1, 0)), dim=1))
    weights = torch.where(trans[:, :-1] >= TERMINATION, trans[:, :-1] * (1 - torch.exp(-tau)), 0)
    basis = field.basis(rays.directions)
    colours = torch.sigmoid(torch.einsum("nf,ncf->nc", features, basis[ray]))
    rgb = torch.zeros_like(rays.backgrounds).index_add(0, ray, weights[index][:, None] * colours)
    reached = trans[:, :-1][index] >= TERMINATION
    rgb = rgb + (1 - weights.sum(1, keepdim=True)) * rays.backgrounds
    along = (k + rays.jitters[:, None]) * (step / extent)
    before, before_s = (torch.cumsum(x, 1) - x for x in (weights, weights * along))
    distortion = (2 * weights * (along * before - before_s) + weights.square() * (step / extent / 3)).sum(1).mean()
    return rgb, distortion, weights[index][reached], cell[index][reached]


def priors(field: Field, config: TrainConfig) -> dict[str, Tensor]:
    """The weighted priors of the planes by the name of their weight, in plain PyTorch: the reference of the `add_*` kernels.

    space_variation * mean of squared neighbour differences, on space planes; on space-time planes
    transient_variation * the same along space alone, time_smoothness * mean (P[t-1] - 2 P[t] + P[t+1])^2, and
    sparse_transients * mean |1 - P|; each summed over the planes it concerns.
    """
    names = ("space_variation", "transient_variation", "time_smoothness", "sparse_transients")
    total = {name: field.theta.new_zeros(()) for name in names}
    for s, name, _, rows, columns in field.layout.planes():
        p = field.plane(s, name)
        along_rows = (p[:, 1:] - p[:, :-1]).square().sum() / p.numel()
        if name in SPACE_PLANES:
            across_rows = (p[1:] - p[:-1]).square().sum() / p.numel()
            total["space_variation"] = total["space_variation"] + along_rows + across_rows
        if name in TIME_PLANES:
            second_difference = (p[:-2] - 2 * p[1:-1] + p[2:]).square().sum() / p.numel()
            total["transient_variation"] = total["transient_variation"] + along_rows
            total["time_smoothness"] = total["time_smoothness"] + second_difference
            total["sparse_transients"] = total["sparse_transients"] + (1 - p).abs().mean()
    return {name: getattr(config, name) * value for name, value in total.items()}


def motion_priors(field: Field, config: TrainConfig) -> dict[str, Tensor]:
    """The weighted priors of the motion grid D, none where there is none.

    motion_smoothness * sum (D[t-1] - 2 D[t] + D[t+1])^2 / n, motion_bending * the same along x, y and z; n numbers in D. Neither
    minds what moves, turns or stretches evenly.
    """
    if field.motion is None:
        return {}
    n = field.motion.numel()
    in_time, *in_space = (field.motion.diff(n=2, dim=dim).square().sum() / n for dim in range(4))
    return {"motion_smoothness": config.motion_smoothness * in_time, "motion_bending": config.motion_bending * sum(in_space)}
