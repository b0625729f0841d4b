"""The radiance field that is trained: K-Planes (arXiv:2301.10241), parameters and plain PyTorch.

The planes live in one flat vector `theta`, channel-last, so that the fused kernels (`kpc.encoder.kernels`), the optimiser and
the priors see one array. `kpc.encoder.render` makes pictures of it.
"""

import math
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, replace

import numpy as np
import torch
from torch import Tensor, nn

from kpc.encoder.config import TrainConfig
from kpc.encoder.occupancy import grid_shape
from kpc.format.scene import (
    ACTIVATION_LIMIT, ALL_PLANES, LOG_DENSITY_LIMIT, SPACE_PLANES, TIME_PLANES, AnyDecoder, Appearance, Clip, Decoder,
    HybridDecoder, Scene,
)
from kpc.format.space import SpaceMapping

AXES = "xyzt"

FEATURE_GAIN = 8.0
"""Of the hybrid decoder's first layer at the start."""

Uniform = Callable[..., Tensor]
"""Random numbers from low to high, of a shape."""


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
        motion: (T, Nz, Ny, Nx, 3) displacements, `kpc.format.motion`, at first 0; or None.
        mixed: whether `features` reads the planes as float16, and the hybrid decoder's layers compute in bfloat16: half the bytes,
            and what GPUs are built for. Sums, products of planes, densities, gradients and the optimiser stay in float32.
        density: (F + 1,) weights of the log density, its bias last.
        w1, b1, w2, b2: the direction MLP, shapes as in `kpc.format.scene.Decoder`. w2 starts at 0: colour depends on the
            direction only as far as the pictures insist.
        codes: (K, H) of appearances, at first 0; or None.
    """

    IDENTITY = 1.0
    """What a time plane holds where nothing changes."""

    def __init__(
        self, layout: Layout, hidden: int, generator: torch.Generator | None = None, motion_nodes: Sequence[int] | None = None,
        appearances: int = 0,
    ) -> None:
        """`motion_nodes`: of the motion grid along t, z, y and x; None for a field without one. `appearances`: their number, K."""
        super().__init__()
        self.layout = layout
        self.mixed = False
        self.codes = nn.Parameter(torch.zeros(appearances, hidden)) if appearances else None
        self.motion = None if motion_nodes is None else nn.Parameter(torch.zeros(*motion_nodes, 3))

        def uniform(low: float, high: float, *shape: int) -> Tensor:
            return torch.rand(shape, generator=generator) * (high - low) + low

        theta = torch.full((layout.size,), self.IDENTITY)
        for _, name, start, rows, columns in layout.planes():
            if name in SPACE_PLANES:
                theta[start : start + rows * columns * layout.channels] = uniform(0.1, 0.5, rows * columns * layout.channels)
        self.theta = nn.Parameter(theta)
        self._make_decoder(layout.features, hidden, uniform)

    def _make_decoder(self, F: int, hidden: int, uniform: Uniform) -> None:
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

    def hidden(self, directions: Tensor, codes: Tensor | None = None) -> Tensor:
        """w1 e(d) + b1 + code of unit directions (N, 3) and codes (N, H) or (H,), None for 0: (N, H), constant along a ray."""
        x, y, z = directions.unbind(-1)
        encoded = torch.stack([x, y, z, x * x, y * y, z * z, x * y, y * z, z * x], dim=-1)
        hidden = encoded @ self.w1.T + self.b1
        return hidden if codes is None else hidden + codes

    def codes_of(self, appearances: Tensor | None) -> Tensor | None:
        """(N, H) the codes of appearances by their numbers (N,); None where there are none."""
        if self.codes is None or appearances is None:
            return None
        # Unlike that of indexing, its gradient is summed in a fixed order.
        return nn.functional.embedding(appearances, self.codes)

    def basis(self, directions: Tensor, codes: Tensor | None = None) -> Tensor:
        """Colour basis of unit directions (N, 3): (N, 3, F). basis(d) = w2 relu(hidden) + b2; `codes` as in `hidden`."""
        F, H = self.w2.shape[1:]
        return (torch.relu(self.hidden(directions, codes)) @ self.w2.reshape(3 * F, H).T).view(-1, 3, F) + self.b2

    def once_a_ray(self, directions: Tensor, codes: Tensor | None = None) -> Tensor:
        """What `colours` takes of (N, 3) directions: their basis; `codes` as in `hidden`."""
        return self.basis(directions, codes)

    def decode(self, features: Tensor) -> tuple[Tensor, Tensor]:
        """Of features (n, F) the clipped log densities, per longest edge of the box, (n,), and what `colours` takes of them."""
        return (features @ self.density[:-1] + self.density[-1]).clamp(-LOG_DENSITY_LIMIT, LOG_DENSITY_LIMIT), features

    def colours(self, latent: Tensor, terms: Tensor, ray: Tensor) -> Tensor:
        """Colours (n, 3) of n samples on the rays `ray` (n,), from what `decode` and `once_a_ray` gave."""
        return torch.sigmoid(torch.einsum("nf,ncf->nc", latent, terms.index_select(0, ray)))

    def decoder_parameters(self, view_dependent: bool) -> list[nn.Parameter]:
        """What there is to train beside planes and motion."""
        return [self.density, self.b2] + ([self.w1, self.b1, self.w2] if view_dependent else [])

    def decoder_as_data(self) -> AnyDecoder:
        """The decoder, its weights copied."""
        density = _array(self.density)
        return Decoder(density[:-1].copy(), float(density[-1]), *(_array(p) for p in (self.w1, self.b1, self.w2, self.b2)))

    def load_decoder(self, decoder: AnyDecoder) -> None:
        """Take the weights of a decoder of the same kind, of any width."""
        bias = np.float32(decoder.density_bias)
        weights = vars(decoder) | {"density": np.append(decoder.density_weight, bias)}
        for name in weights.keys() - {"density_weight", "density_bias"}:
            setattr(self, name, nn.Parameter(torch.from_numpy(np.array(weights[name], np.float32))))

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
                sample = bilinear(self.plane(s, name), coordinate[name[0]], coordinate[name[1]], self.mixed)
                product = sample if product is None else self.combined(product, sample)
            assert product is not None
            scales.append(product)
        return torch.cat(scales, dim=-1)

    def to_scene(
        self, aabb: np.ndarray, clip: Clip, occupancy: np.ndarray, background: np.ndarray, step: float,
        mapping: SpaceMapping | None = None, appearance_names: Sequence[str] = (),
    ) -> Scene:
        """The field as data; the planes are copied. `appearance_names`: as many as it has codes.

        The mean of the codes moves into b1, which changes no picture that has a code, and makes their average the look without.
        """
        names = ALL_PLANES if self.layout.is_dynamic else SPACE_PLANES
        with torch.no_grad():
            scales = tuple(
                {name: self.plane(s, name).cpu().numpy().copy() for name in names}
                for s in range(len(self.layout.resolution))
            )
        decoder, codes = self.decoder_as_data(), np.zeros((0, len(self.b1)), np.float32)
        if self.codes is not None:
            mean = _array(self.codes).mean(0, dtype=np.float64).astype(np.float32)
            decoder, codes = replace(decoder, b1=decoder.b1 + mean), _array(self.codes) - mean
        return Scene(
            aabb=np.asarray(aabb, np.float32), clip=clip, scales=scales,
            decoder=decoder,
            occupancy=np.asarray(occupancy, bool), background=np.asarray(background, np.float32), step=float(step),
            mapping=mapping, motion=None if self.motion is None else _array(self.motion),
            appearances=tuple(Appearance(name, code) for name, code in zip(appearance_names, codes, strict=True)),
        )

    @staticmethod
    def from_scene(scene: Scene) -> "Field":
        """The field whose planes, decoder and codes a scene holds."""
        shape = {name: scene.scales[0][name].shape for name in scene.scales[0]}
        resolution = []
        for scale in scene.scales:
            rows_t = scale["xt"].shape[0] if scene.is_dynamic else 0
            resolution.append([scale["xy"].shape[1], scale["xy"].shape[0], scale["xz"].shape[0], rows_t])
        layout = Layout.of(np.array(resolution), shape["xy"][2])
        kind = HybridField if isinstance(scene.decoder, HybridDecoder) else Field
        field = kind(layout, scene.decoder.b1.size, motion_nodes=None if scene.motion is None else scene.motion.shape[:4],
                     appearances=len(scene.appearances))
        with torch.no_grad():
            for s, scale in enumerate(scene.scales):
                for name, plane in scale.items():
                    _fill(field.plane(s, name), plane)
            if field.motion is not None and scene.motion is not None:
                _fill(field.motion, scene.motion)
            if field.codes is not None:
                _fill(field.codes, np.stack([appearance.code for appearance in scene.appearances]))
            field.load_decoder(scene.decoder)
        return field


    @staticmethod
    def combined(one: Tensor, other: Tensor) -> Tensor:
        """What two planes together say."""
        return one * other


class SummedField(Field):
    """A field whose planes are added up. Only `Field.features` knows it: no kernel, no file and no player does."""

    IDENTITY = 0.0

    @staticmethod
    def combined(one: Tensor, other: Tensor) -> Tensor:
        return one + other


class HybridField(Field):
    """Planes and hybrid decoder.

    Attributes:
        theta, motion: as in `Field`.
        v, v_bias, w1, b1, u, w2, b2: as in `kpc.format.scene.HybridDecoder`, all its layers of the same width.
        density: (G + 1,) weights of the log density, its bias last.
    """

    def _make_decoder(self, F: int, hidden: int, uniform: Uniform) -> None:
        def layer(rows: int, columns: int) -> nn.Parameter:
            reach = math.sqrt(6 / columns)  # He et al., arXiv:1502.01852
            return nn.Parameter(uniform(-reach, reach, rows, columns))

        # Features start at some 0.03, the product of three texels: weights as much larger bring them into a layer's range.
        self.v = nn.Parameter(layer(hidden, F).detach() * FEATURE_GAIN)
        self.v_bias = nn.Parameter(torch.zeros(hidden))
        weights = uniform(-1, 1, hidden) / math.sqrt(hidden)
        self.density = nn.Parameter(torch.cat([weights, torch.tensor([-1.0])]))
        self.w1 = nn.Parameter(uniform(-1, 1, hidden, 9) / 8)
        self.b1 = nn.Parameter(torch.zeros(hidden))
        self.u = layer(hidden, hidden)
        self.w2 = layer(3, hidden)
        self.b2 = nn.Parameter(torch.zeros(3))

    def once_a_ray(self, directions: Tensor, codes: Tensor | None = None) -> Tensor:
        """What `colours` takes of (N, 3) directions: (N, H), their part of the hidden layer."""
        return self.hidden(directions, codes)

    def decode(self, features: Tensor) -> tuple[Tensor, Tensor]:
        h = (self._times(features, self.v) + self.v_bias).clamp(0, ACTIVATION_LIMIT)
        return (h @ self.density[:-1] + self.density[-1]).clamp(-LOG_DENSITY_LIMIT, LOG_DENSITY_LIMIT), h

    def colours(self, latent: Tensor, terms: Tensor, ray: Tensor) -> Tensor:
        hidden = (terms.index_select(0, ray) + self._times(latent, self.u)).clamp(0, ACTIVATION_LIMIT)
        return torch.sigmoid(self._times(hidden, self.w2) + self.b2)

    def _times(self, values: Tensor, weights: Tensor) -> Tensor:
        """values weights^T: (n, columns), (rows, columns) to (n, rows)."""
        if not self.mixed:
            return values @ weights.T
        return (values.bfloat16() @ weights.bfloat16().T).to(values.dtype)

    def decoder_parameters(self, view_dependent: bool) -> list[nn.Parameter]:
        return [self.v, self.v_bias, self.density, self.b1, self.u, self.w2, self.b2] + ([self.w1] if view_dependent else [])

    def decoder_as_data(self) -> AnyDecoder:
        density = _array(self.density)
        weights = {name: _array(getattr(self, name)) for name in ("v", "v_bias", "w1", "b1", "u", "w2", "b2")}
        return HybridDecoder(density_weight=density[:-1].copy(), density_bias=float(density[-1]), **weights)


def _array(parameter: Tensor) -> np.ndarray:
    """A copy."""
    return parameter.detach().cpu().numpy().copy()


def _fill(parameter: Tensor, values: np.ndarray) -> None:
    with torch.no_grad():
        parameter.copy_(torch.from_numpy(np.asarray(values, np.float32)))


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


def bilinear(plane: Tensor, u: Tensor, v: Tensor, in_half: bool = False) -> Tensor:
    """Sample a (rows, columns, M) plane, corner-aligned: u in [0, 1] along columns, v along rows. Returns (N, M).

    `in_half`: texels are read as float16; what is made of them, and the gradient, is in the type of the plane.
    """
    rows, columns, M = plane.shape
    (i, fu), (j, fv) = tap(u, columns), tap(v, rows)
    flat = plane.reshape(-1, M)
    half = flat.detach().half() if in_half else None

    def texels(k: Tensor) -> Tensor:
        return flat.index_select(0, k) if half is None else _HalfTexels.apply(flat, half, k)  # type: ignore[no-untyped-call]

    k = j * columns + i
    low = texels(k) * (1 - fu) + texels(k + 1) * fu
    high = texels(k + columns) * (1 - fu) + texels(k + columns + 1) * fu
    return low * (1 - fv) + high * fv


class _HalfTexels(torch.autograd.Function):
    """Rows `k` of a (texels, M) plane, read from its float16 copy; the gradient is added up in the plane's own type."""

    @staticmethod
    def forward(ctx, flat, half, k):  # type: ignore[no-untyped-def]
        ctx.save_for_backward(k)
        ctx.shape = flat.shape
        return half.index_select(0, k).to(flat.dtype)

    @staticmethod
    def backward(ctx, g):  # type: ignore[no-untyped-def]
        k, = ctx.saved_tensors
        return g.new_zeros(ctx.shape).index_add_(0, k, g), None, None


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


def appearance_priors(field: Field, config: TrainConfig) -> dict[str, Tensor]:
    """The weighted prior of the codes a of appearances, none where there are none: appearance_size * mean of a^2.

    Without it codes and b1 could drift together, and what a few pictures say of a look would be taken for the truth.
    """
    return {} if field.codes is None else {"appearance_size": config.appearance_size * field.codes.square().mean()}
