"""The radiance field that is trained: K-Planes (arXiv:2301.10241), its parameters and its evaluation in PyTorch.

The planes live in one flat vector `theta`, channel last, so that the fused kernels (`kpc.encoder.field.kernels`), the
optimiser and the priors (`kpc.encoder.field.priors`) see one array. `kpc.encoder.field.render` renders the field.
"""

import functools
import math
from collections.abc import Callable, Iterable, Sequence
from dataclasses import replace

import numpy as np
import torch
from torch import Tensor, nn

from kpc.encoder.field.layout import AXES, Layout, border_elements, resolution_of
from kpc.encoder.field.sampling import WeightedRowSum, bilinear_corners, displace
from kpc.format.scene.scene import (
    ACTIVATION_LIMIT,
    ALL_PLANES,
    LOG_DENSITY_LIMIT,
    SPACE_PLANES,
    TIME_PLANES,
    AnyDecoder,
    Appearance,
    Clip,
    Decoder,
    HybridDecoder,
    Scene,
)
from kpc.format.scene.space import SpaceMapping

# Factor on the first layer of the hybrid decoder at the start: features start at about 0.03, the product of three
# texels, and are to span that layer's range.
FEATURE_GAIN = 8.0

# Rows of space-time planes in a file, of scales that have none.
FEWEST_ROWS = 2

# A function of low, high and a shape that returns uniform random numbers.
Uniform = Callable[..., Tensor]


class Field(nn.Module):
    """Planes and explicit decoder.

    Attributes:
        layout: where each plane lies in theta.
        theta: (n,) the planes. Space planes start uniform in [0.1, 0.5], space-time planes at 1 (K-Planes).
        motion: (T, Nz, Ny, Nx, 3) displacements, `kpc.format.scene.motion`, at first 0; or None.
        codes: (K, H) appearance codes, at first 0; or None.
        mixed: whether the layers of a decoder compute in bfloat16 with float32 sums.
        density: (F + 1,) weights of the log density, its bias last.
        w1, b1, w2, b2: the direction MLP, shapes as in `kpc.format.scene.scene.Decoder`. w2 starts at 0: colour depends
            on the direction only as far as the pictures ask for it.
        axes, sizes, first, areas: constants of `features`: the axes, sizes and first texels of the planes, and
            `Layout.areas`.
        border: elements of theta that stay 0, `restore_fixed`.
    """

    axes: Tensor
    sizes: Tensor
    first: Tensor
    areas: Tensor
    border: Tensor

    # What a space-time plane holds where nothing changes: the identity of `combine`.
    IDENTITY = 1.0

    def __init__(
        self,
        layout: Layout,
        hidden: int,
        generator: torch.Generator | None = None,
        motion_shape: Sequence[int] | None = None,
        appearances: int = 0,
    ) -> None:
        """Create a field at its initial values.

        Args:
            layout: of the planes. hidden: H, width of the decoder. generator: of random numbers.
            motion_shape: nodes of the motion grid along t, z, y and x; None for a field without one.
            appearances: K, the number of appearance codes.
        """
        super().__init__()
        self.layout = layout
        self.mixed = False
        self.codes = nn.Parameter(torch.zeros(appearances, hidden)) if appearances else None
        self.motion = None if motion_shape is None else nn.Parameter(torch.zeros(*motion_shape, 3))

        def uniform(low: float, high: float, *shape: int) -> Tensor:
            return torch.rand(shape, generator=generator) * (high - low) + low

        theta = torch.full((layout.size,), self.IDENTITY)
        for _, name, start, rows, columns in layout.planes():
            if name in SPACE_PLANES:
                theta[start : start + rows * columns * layout.channels] = uniform(
                    0.1, 0.5, rows * columns * layout.channels
                )
        self.theta = nn.Parameter(theta)
        names = ALL_PLANES if layout.is_dynamic else SPACE_PLANES
        axes = torch.tensor([[AXES.index(axis) for axis in of_all] for of_all in zip(*names, strict=True)])
        self._constant("axes", axes)
        table = layout.table.T[: len(names), None, :, None]
        sizes = torch.from_numpy(layout.held.T)[axes][:, :, None]
        # Planes that do not exist are read from four texels of 1 behind all others.
        self._constant("sizes", torch.where(torch.from_numpy(table[None, ..., 0]) < 0, 2, sizes))
        self._constant("first", torch.from_numpy(np.where(table < 0, layout.size, table) // layout.channels))
        self._constant("areas", torch.from_numpy(layout.areas))
        self._constant("border", torch.from_numpy(border_elements(layout)))
        self._frozen: list[tuple[int, str, Tensor]] = []
        self.restore_fixed()
        self._make_decoder(layout.features, hidden, uniform)

    def _constant(self, name: str, values: Tensor) -> None:
        """Register a buffer, which moves to a device with the parameters and is not saved with them."""
        self.register_buffer(name, values.contiguous(), persistent=False)

    def _make_decoder(self, F: int, hidden: int, uniform: Uniform) -> None:
        """Create the decoder's parameters; `uniform` is a function of low, high and a shape."""
        # Weights of zero mean: the box starts with a log density of -1 on average, whatever the seed.
        weights = uniform(-3, 3, F)
        self.density = nn.Parameter(torch.cat([weights - weights.mean(), torch.tensor([-1.0])]))
        self.w1 = nn.Parameter(uniform(-1, 1, hidden, 9))
        self.b1 = nn.Parameter(torch.zeros(hidden))
        self.w2 = nn.Parameter(torch.zeros(3, F, hidden))
        self.b2 = nn.Parameter(uniform(-1, 1, 3, F))

    @functools.cached_property
    def texels(self) -> tuple[Tensor, Tensor]:
        """`_prior_tables` of all planes, (3, rows of theta) each, on the device of theta at the first use."""
        M = self.layout.channels
        each = [
            _prior_tables(name, start // M, rows, columns, M) for _, name, start, rows, columns in self.layout.planes()
        ]
        neighbours, shares = (torch.cat(parts, dim=1).to(self.theta.device) for parts in zip(*each, strict=True))
        return neighbours, shares.to(self.theta.dtype)

    def plane(self, scale: int, name: str) -> Tensor:
        """Return a view of one plane, as far as it is held, (rows, columns, M)."""
        axes = self.layout.held[scale]
        rows, columns = int(axes[AXES.index(name[1])]), int(axes[AXES.index(name[0])])
        start = int(self.layout.table[scale, ALL_PLANES.index(name)])
        M = self.layout.channels
        return self.theta[start : start + rows * columns * M].view(rows, columns, M)

    def hidden(self, directions: Tensor, codes: Tensor | None = None) -> Tensor:
        """Return w1 e(d) + b1 + code, (N, H), of unit directions d (N, 3) and codes (N, H) or (H,); None for 0."""
        x, y, z = directions.unbind(-1)
        encoded = torch.stack([x, y, z, x * x, y * y, z * z, x * y, y * z, z * x], dim=-1)
        hidden = encoded @ self.w1.T + self.b1
        return hidden if codes is None else hidden + codes

    def appearance_codes(self, appearances: Tensor | None) -> Tensor | None:
        """Return the codes (N, H) of appearances by their numbers (N,); None where there are none."""
        if self.codes is None or appearances is None:
            return None
        # Its gradient is summed in a fixed order, unlike that of indexing.
        return nn.functional.embedding(appearances, self.codes)

    def basis(self, directions: Tensor, codes: Tensor | None = None) -> Tensor:
        """Return the colour basis w2 relu(hidden) + b2 of unit directions (N, 3): (N, 3, F); codes as in `hidden`."""
        F, H = self.w2.shape[1:]
        return (torch.relu(self.hidden(directions, codes)) @ self.w2.reshape(3 * F, H).T).view(-1, 3, F) + self.b2

    def ray_terms(self, directions: Tensor, codes: Tensor | None = None) -> Tensor:
        """Return what `colours` takes of directions (N, 3): relu(hidden) and a column of 1, (N, H + 1)."""
        return nn.functional.pad(torch.relu(self.hidden(directions, codes)), (0, 1), value=1.0)

    def decode(self, features: Tensor) -> tuple[Tensor, Tensor]:
        """Return the clipped log densities (n,) of features (n, F), per longest box edge, and what `colours` takes."""
        return (features @ self.density[:-1] + self.density[-1]).clamp(-LOG_DENSITY_LIMIT, LOG_DENSITY_LIMIT), features

    def colours(self, latent: Tensor, terms: Tensor, ray: Tensor) -> Tensor:
        """Return the colours (n, 3) of n samples.

        sigmoid(basis(d) . f), but summed over features before it is summed over the hidden layer: a sample then needs
        H + 1 numbers of its ray rather than 3 F.

        Args:
            latent: (n, F), from `decode`. terms: (N, H + 1), from `ray_terms`. ray: (n,) int64, the samples' rays.
        """
        F, H = self.w2.shape[1:]
        weights = torch.cat([self.w2, self.b2[..., None]], dim=2).transpose(0, 1).reshape(F, 3 * (H + 1))
        by_hidden = (latent @ weights).view(-1, 3, H + 1)
        return torch.sigmoid((by_hidden * terms.index_select(0, ray)[:, None]).sum(2))

    def decoder_parameters(self, view_dependent: bool) -> list[nn.Parameter]:
        """Return the parameters that are trained besides planes, motion grid and codes."""
        return [self.density, self.b2] + ([self.w1, self.b1, self.w2] if view_dependent else [])

    def export_decoder(self) -> AnyDecoder:
        """Return the decoder as data, its weights copied."""
        density = _array(self.density)
        return Decoder(
            density[:-1].copy(), float(density[-1]), *(_array(p) for p in (self.w1, self.b1, self.w2, self.b2))
        )

    def load_decoder(self, decoder: AnyDecoder) -> None:
        """Take over the weights of a decoder of the same kind and any width."""
        bias = np.float32(decoder.density_bias)
        weights = vars(decoder) | {"density": np.append(decoder.density_weight, bias)}
        for name in weights.keys() - {"density_weight", "density_bias"}:
            setattr(self, name, nn.Parameter(torch.from_numpy(np.array(weights[name], np.float32))))

    def features(self, points: Tensor, times: Tensor) -> Tensor:
        """Return the features (N, F) at points (N, 3) in [0, 1]^3 and times (N,) in [0, 1].

        The product over planes of their bilinear samples at the displaced points, concatenated over scales.
        """
        if self.motion is not None:
            points = displace(points, times, self.motion)
        table, inside = self.theta.view(-1, self.layout.channels), None
        if self.layout.is_uniform:
            u, v = torch.cat([points, times[:, None]], dim=1).T[self.axes, :, None]  # (C, N, 1) each
        else:
            at = (points[:, None] - self.areas[:, 0, :3]) * self.areas[:, 1, :3]  # (N, S, 3)
            inside = ((at >= 0) & (at <= 1)).all(2, keepdim=True) | (self.areas[:, 0, 3:] == 0)
            u, v = torch.cat([at, times[:, None, None].expand(-1, at.shape[1], 1)], dim=2).permute(2, 0, 1)[self.axes]
            table = torch.cat([table, table.new_ones(4, self.layout.channels)])
        corners, weights = bilinear_corners(u, v, *self.sizes)  # (C, N, S, 4)
        planes = WeightedRowSum.apply(table, self.first + corners, weights)  # type: ignore[no-untyped-call]
        features = self.combine(planes)  # each plane: (N, S, M)
        return (features if inside is None else features * inside).flatten(1)

    def freeze(self, planes: Iterable[tuple[int, str]]) -> None:
        """Keep planes, by scale and name, as they are now: `restore_fixed` sets them back."""
        self._frozen = [(s, name, self.plane(s, name).detach().clone()) for s, name in planes]

    def restore_fixed(self) -> None:
        """Set back what training must not change: frozen planes, and the outermost texels of areas to 0, so that
        nothing jumps where they end.
        """
        with torch.no_grad():
            self.theta.index_fill_(0, self.border, 0)
            for s, name, values in self._frozen:
                self.plane(s, name).copy_(values)

    def to_scene(
        self,
        aabb: np.ndarray,
        clip: Clip,
        occupancy: np.ndarray,
        background: np.ndarray,
        step: float,
        mapping: SpaceMapping | None = None,
        appearance_names: Sequence[str] = (),
    ) -> Scene:
        """Return the field as data; the planes are copied.

        The mean of the codes moves into b1: pictures with a code stay the same, and no code is the average one.

        Args:
            aabb, clip, occupancy, background, step, mapping: as in `Scene`.
            appearance_names: of the codes, as many.
        """
        names = ALL_PLANES if self.layout.is_dynamic else SPACE_PLANES
        scales = tuple({name: self.whole_plane(s, name) for name in names} for s in range(len(self.layout.resolution)))
        decoder, codes = self.export_decoder(), np.zeros((0, len(self.b1)), np.float32)
        if self.codes is not None:
            mean = _array(self.codes).mean(0, dtype=np.float64).astype(np.float32)
            decoder, codes = replace(decoder, b1=decoder.b1 + mean), _array(self.codes) - mean
        return Scene(
            aabb=np.asarray(aabb, np.float32),
            clip=clip,
            scales=scales,
            decoder=decoder,
            occupancy=np.asarray(occupancy, bool),
            background=np.asarray(background, np.float32),
            step=float(step),
            mapping=mapping,
            motion=None if self.motion is None else _array(self.motion),
            appearances=tuple(Appearance(name, code) for name, code in zip(appearance_names, codes, strict=True)),
        )

    def whole_plane(self, scale: int, name: str) -> np.ndarray:
        """Return a copy of one plane of the whole box, (rows, columns, M): 0 or 1 where it is not held."""
        layout, axes = self.layout, [AXES.index(axis) for axis in name]
        columns, rows = (max(int(layout.resolution[scale, axis]), FEWEST_ROWS) for axis in axes)
        whole = np.full((rows, columns, layout.channels), float(name in TIME_PLANES), np.float32)
        if layout.has(scale, name):
            whole[layout.rectangle(scale, name)] = _array(self.plane(scale, name))
        return whole

    @staticmethod
    def from_scene(scene: Scene, layout: Layout | None = None) -> "Field":
        """Return a field with a scene's planes, decoder, motion grid and codes.

        Args:
            layout: of the field; None for all texels of the scene. What it leaves out is taken for 0, and 1 in time.

        Raises:
            ValueError: a plane has a single texel along an axis (see `rdo.codec_model.widen_single_texels`).
        """
        if any(min(plane.shape[:2]) < 2 for scale in scene.scales for plane in scale.values()):
            raise ValueError("a plane has a single texel along an axis")
        if layout is None:
            layout = Layout.of(
                np.array([resolution_of(scale) for scale in scene.scales]), scene.scales[0]["xy"].shape[2]
            )
        kind = HybridField if isinstance(scene.decoder, HybridDecoder) else Field
        field = kind(
            layout,
            scene.decoder.b1.size,
            motion_shape=None if scene.motion is None else scene.motion.shape[:4],
            appearances=len(scene.appearances),
        )
        with torch.no_grad():
            for s, name, *_ in layout.planes():
                _fill(field.plane(s, name), scene.scales[s][name][layout.rectangle(s, name)])
            if field.motion is not None and scene.motion is not None:
                _fill(field.motion, scene.motion)
            if field.codes is not None:
                _fill(field.codes, np.stack([appearance.code for appearance in scene.appearances]))
            field.load_decoder(scene.decoder)
        return field

    @staticmethod
    def combine(planes: Sequence[Tensor]) -> Tensor:
        """Return the product over planes, (N, S, M) each."""
        return functools.reduce(torch.mul, planes)


class SummedField(Field):
    """A field whose planes are summed rather than multiplied, for ablations: no kernel, file or player supports it."""

    IDENTITY = 0.0

    @staticmethod
    def combine(planes: Sequence[Tensor]) -> Tensor:
        """Return the sum over planes, (N, S, M) each."""
        return functools.reduce(torch.add, planes)


class HybridField(Field):
    """Planes and hybrid decoder.

    Attributes:
        theta, motion: as in `Field`.
        v, v_bias, w1, b1, u, w2, b2: as in `kpc.format.scene.scene.HybridDecoder`, all its layers of the same width.
        density: (G + 1,) weights of the log density, its bias last.
    """

    def _make_decoder(self, F: int, hidden: int, uniform: Uniform) -> None:
        def layer(rows: int, columns: int) -> nn.Parameter:
            bound = math.sqrt(6 / columns)  # He et al., arXiv:1502.01852
            return nn.Parameter(uniform(-bound, bound, rows, columns))

        self.v = nn.Parameter(layer(hidden, F).detach() * FEATURE_GAIN)
        self.v_bias = nn.Parameter(torch.zeros(hidden))
        weights = uniform(-1, 1, hidden) / math.sqrt(hidden)
        self.density = nn.Parameter(torch.cat([weights, torch.tensor([-1.0])]))
        self.w1 = nn.Parameter(uniform(-1, 1, hidden, 9) / 8)
        self.b1 = nn.Parameter(torch.zeros(hidden))
        self.u = layer(hidden, hidden)
        self.w2 = layer(3, hidden)
        self.b2 = nn.Parameter(torch.zeros(3))

    def ray_terms(self, directions: Tensor, codes: Tensor | None = None) -> Tensor:
        """Return what `colours` takes of directions (N, 3): their part of the hidden layer, (N, H)."""
        return self.hidden(directions, codes)

    def decode(self, features: Tensor) -> tuple[Tensor, Tensor]:
        """Return the clipped log densities (n,) of features (n, F), and the hidden layer (n, G)."""
        h = (self._times(features, self.v) + self.v_bias).clamp(0, ACTIVATION_LIMIT)
        return (h @ self.density[:-1] + self.density[-1]).clamp(-LOG_DENSITY_LIMIT, LOG_DENSITY_LIMIT), h

    def colours(self, latent: Tensor, terms: Tensor, ray: Tensor) -> Tensor:
        """Return the colours (n, 3) of samples: latent (n, G), from `decode`; terms (N, H), from `ray_terms`."""
        hidden = (terms.index_select(0, ray) + self._times(latent, self.u)).clamp(0, ACTIVATION_LIMIT)
        return torch.sigmoid(self._times(hidden, self.w2) + self.b2)

    def _times(self, values: Tensor, weights: Tensor) -> Tensor:
        """Return values weights^T, (n, rows), of values (n, columns) and weights (rows, columns)."""
        if not self.mixed:
            return values @ weights.T
        return (values.bfloat16() @ weights.bfloat16().T).to(values.dtype)

    def decoder_parameters(self, view_dependent: bool) -> list[nn.Parameter]:
        return [self.v, self.v_bias, self.density, self.b1, self.u, self.w2, self.b2] + (
            [self.w1] if view_dependent else []
        )

    def export_decoder(self) -> AnyDecoder:
        density = _array(self.density)
        weights = {name: _array(getattr(self, name)) for name in ("v", "v_bias", "w1", "b1", "u", "w2", "b2")}
        return HybridDecoder(density_weight=density[:-1].copy(), density_bias=float(density[-1]), **weights)


def _array(parameter: Tensor) -> np.ndarray:
    """Return a copy of a parameter as an array."""
    return parameter.detach().cpu().numpy().copy()


def _fill(parameter: Tensor, values: np.ndarray) -> None:
    with torch.no_grad():
        parameter.copy_(torch.from_numpy(np.asarray(values, np.float32)))


def _prior_tables(name: str, first: int, rows: int, columns: int, M: int) -> tuple[Tensor, Tensor]:
    """Return what `kpc.encoder.field.priors.plane_priors` needs of the n texels of a plane, whose first is `first`.

    Returns:
        (3, n) int64, the texels to the right, below and above, clamped at the edges.
        (3, n) float32, factors that turn sums into means: 1 / (rows * columns * M) in a space plane; in a space-time
        plane; in a space-time plane's inner rows; 0 otherwise.
    """
    row, column = torch.meshgrid(torch.arange(rows), torch.arange(columns), indexing="ij")
    near = [
        (row, (column + 1).clamp(max=columns - 1)),
        ((row + 1).clamp(max=rows - 1), column),
        ((row - 1).clamp(min=0), column),
    ]
    is_time, inner = torch.full_like(row, name in TIME_PLANES), (row > 0) & (row < rows - 1)
    shares = torch.stack([1 - is_time, is_time, is_time * inner]).flatten(1) / (rows * columns * M)
    return first + torch.stack([j * columns + i for j, i in near]).flatten(1), shares
