"""Pruning of a trained scene: view-dependent colour, channels, whole scales.

Density and colour are linear in the features before their nonlinearities. So the contribution of a removed channel is
redistributed to the others by least squares over visible points (optimal brain surgeon, Hassibi and Stork, NIPS
1992), and only the remainder is lost. The loss is measured on pictures before anything is removed.
"""

import math
from collections.abc import Callable, Collection, Sequence
from dataclasses import dataclass, replace

import numpy as np
import torch

from kpc.encoder.evaluation.evaluate import SceneRenderer
from kpc.encoder.field import render
from kpc.encoder.field.field import Field
from kpc.encoder.field.layout import Layout
from kpc.encoder.rdo.curvature import PerPlane
from kpc.format.scene.scene import Decoder, Scene
from kpc.format.scene.space import Contraction

# Origins (N, 3), directions (N, 3) and times (N,), float32, as `kpc.encoder.datasets.pixel_rays` makes them.
Rays = tuple[np.ndarray, np.ndarray, np.ndarray]

POINTS = 1 << 13  # visible points, and as many random points in occupied cells, on which channels are compared
RIDGE = 1e-6  # added to the features' second moments, as a share of their mean, so that equal channels are no problem


@dataclass(frozen=True)
class Pruned:
    """A pruned scene.

    Attributes:
        scene: the number of channels may differ between scales; scales without channels are gone.
        kept: indices of the channels that were kept, one array per original scale.
        loss_db: loss of all of it on the validation rays, dB.
        view_gain_db: what the direction MLP gained there, dB; None where colour was view-independent or the scene has
            appearance embeddings.
        next_loss_db: loss with one more channel removed, dB; infinite where only one is left.
        features: original number of channels, over all scales.
    """

    scene: Scene
    kept: tuple[np.ndarray, ...]
    loss_db: float
    view_gain_db: float | None
    next_loss_db: float
    features: int

    @property
    def removed_any(self) -> bool:
        """Whether a channel was removed, or anything else at a loss."""
        return self.loss_db != 0 or sum(map(len, self.kept)) < self.features

    def select_channels(self, numbers: PerPlane, in_pairs: bool = False) -> list[dict[str, np.ndarray]]:
        """Return the part of (..., M) values of each plane, or of (..., M, M) `in_pairs`, for the kept channels."""
        parts = [
            ((..., kept[:, None], kept) if in_pairs else (..., kept), scale)
            for kept, scale in zip(self.kept, numbers, strict=True)
            if len(kept)
        ]
        return [{name: values[part] for name, values in scale.items()} for part, scale in parts]


def max_renderings(features: int) -> int:
    """Return how often `prune` renders a scene of that many features, at most."""
    return 3 + math.ceil(math.log2(features))


def prune(
    scene: Scene,
    rays: Rays,
    fidelity: Callable[[Scene], float],
    spare_db: float,
    whole: Collection[int] | None = None,
) -> Pruned:
    """Remove the direction MLP, then as many channels as possible, within a loss of `spare_db` in all.

    Channels are removed in the order of an estimate in closed form (`elimination_order`); their number is found by
    bisection.

    Args:
        scene: with an explicit decoder; no other is linear.
        rays: on which visible points are found.
        fidelity: of a scene, dB.
        spare_db: how much the fidelity may fall.
        whole: scales that keep all channels, of a scene whose other scales keep at least one; None where all channels
            of any scale may go.
    """
    assert isinstance(scene.decoder, Decoder)
    before = fidelity(scene)
    gain = None
    if not scene.decoder.w2.any():
        scene = make_view_independent(scene, rays[1])
    elif not scene.appearances:  # appearance embeddings act through the direction MLP
        plain = make_view_independent(scene, rays[1])
        gain = before - fidelity(plain)
        scene = plain if gain <= spare_db else scene
    loss = gain if gain is not None and gain <= spare_db else 0.0

    sampled, features = SurfaceFeatures.sample(scene, rays), len(scene.decoder.density_weight)
    decoder = scene.decoder
    assert isinstance(decoder, Decoder)
    order = elimination_order(decoder, sampled)
    if whole is not None:
        order = order[_may_go(scene, order, whole)]
    removable, next_loss_db = 0, math.inf
    best, most = scene, len(order) + 1
    too_many = most
    while too_many - removable > 1:
        # Most often not even one channel can be removed, so that one is tried first.
        count = (removable + too_many) // 2 if removable or too_many < most else 1
        candidate = replace(scene, decoder=redistribute(decoder, sampled, order[:count]))
        candidate_loss = before - fidelity(candidate)
        if candidate_loss <= spare_db:
            removable, loss, best = count, candidate_loss, candidate
        else:
            too_many, next_loss_db = count, candidate_loss
    kept = _kept(scene, order[:removable])
    return Pruned(keep_channels(best, kept), kept, loss, gain, next_loss_db, features)


def make_view_independent(scene: Scene, directions: np.ndarray) -> Scene:
    """Return the scene with its mean colour basis over (N, 3) directions.

    The direction MLP is replaced by one hidden unit with weights of 0.
    """
    decoder = scene.decoder
    b2 = decoder.b2 if not decoder.w2.any() else _basis(scene, directions).mean(0)
    F = len(decoder.density_weight)
    w1, b1, w2 = (np.zeros(shape, np.float32) for shape in ((1, 9), (1,), (3, F, 1)))
    plain = Decoder(decoder.density_weight, decoder.density_bias, w1, b1, w2, b2.astype(np.float32))
    return replace(scene, decoder=plain)


@dataclass(frozen=True)
class SurfaceFeatures:
    """Features where rays end, and in occupied cells.

    Attributes:
        features: (N, F) float64, where rays end.
        basis: (N, 3, F) float64, the colour basis of their directions.
        all_features: (2 N, F) float64, where rays end and at random in occupied cells: density also counts where
            nothing is visible.
    """

    features: np.ndarray
    basis: np.ndarray
    all_features: np.ndarray

    @staticmethod
    def sample(scene: Scene, rays: Rays) -> "SurfaceFeatures":
        """Sample the features where about POINTS of the rays end, and as many in occupied cells."""
        origins, directions, times = (a[:: max(1, len(a) // POINTS)] for a in rays)
        renderer = SceneRenderer(scene)
        _, opacities, depths = renderer.render(origins, directions, times)
        ends = np.flatnonzero(opacities > 0.5)
        ends = ends if len(ends) else np.arange(len(origins))
        s = np.where(np.isfinite(depths), depths, 0)[ends].astype(np.float32)
        s = scene.mapping.parameter(s) if isinstance(scene.mapping, Contraction) else s
        zeros = np.zeros(len(ends))
        ending = render.Rays.from_arrays(*(a[ends] for a in (origins, directions, times)), zeros, zeros)
        u, _ = render.plane_coordinates(
            ending, torch.from_numpy(s)[:, None], torch.from_numpy(scene.aabb), scene.mapping
        )
        slots, *cells = scene.occupancy.shape
        rng = np.random.default_rng(0)
        occupied = np.argwhere(scene.occupancy)
        chosen = (
            occupied[rng.integers(len(occupied), size=len(ends))]
            if len(occupied)
            else np.zeros((len(ends), 4), np.int64)
        )
        inside = (chosen + rng.random(chosen.shape)) / (slots, *cells)
        # The renderer's field has as many channels at each scale as the widest.
        counts = [scale["xy"].shape[2] for scale in scene.scales]
        own = np.concatenate([max(counts) * s + np.arange(count) for s, count in enumerate(counts)])
        with torch.no_grad():
            features, elsewhere = (
                renderer.field.features(p.float(), t.float()).numpy()[:, own].astype(np.float64)
                for p, t in (
                    (u[:, 0].clamp(0, 1), torch.from_numpy(times[ends])),
                    (torch.from_numpy(inside[:, :0:-1].copy()), torch.from_numpy(inside[:, 0].copy())),
                )
            )
        return SurfaceFeatures(features, _basis(scene, directions[ends]), np.concatenate([features, elsewhere]))


def elimination_order(decoder: Decoder, sampled: SurfaceFeatures) -> np.ndarray:
    """Return the order in which to remove features, (F - 1,) int64: all but one, the least important first.

    Removing feature m and redistributing it to the others changes a linear map of weights w by w_m^2 / (G^-1)_mm, mean
    square, where G holds the second moments of the features. The estimate is the sum of that for log density and for
    the logits of three colours. Each step removes the feature of the least estimate and redistributes it.
    """
    F = sampled.features.shape[1]
    left, order = list(range(F)), []
    weight = decoder.density_weight.astype(np.float64)
    basis = sampled.basis.reshape(-1, F)
    basis_moments = basis.T @ basis / len(sampled.basis)  # second moments of the colour basis, summed over colours
    moments, all_moments = _moments(sampled.features), _moments(sampled.all_features, constant=True)
    while len(left) > 1:
        lost = np.diag(basis_moments)[left] / np.diag(np.linalg.inv(moments[np.ix_(left, left)]))
        with_constant = [*left, -1]
        lost += np.square(weight[left]) / np.diag(np.linalg.inv(all_moments[np.ix_(with_constant, with_constant)]))[:-1]
        m = left.pop(int(np.argmin(lost)))
        share = np.zeros(F)
        share[left] = np.linalg.solve(moments[np.ix_(left, left)], moments[left, m])
        moved = np.outer(basis_moments[:, m], share)
        basis_moments += moved + moved.T + basis_moments[m, m] * np.outer(share, share)
        weight[left] += (
            weight[m] * np.linalg.solve(all_moments[np.ix_([*left, -1], [*left, -1])], all_moments[[*left, -1], m])[:-1]
        )
        order.append(m)
    return np.array(order, np.int64)


def redistribute(decoder: Decoder, sampled: SurfaceFeatures, gone: np.ndarray) -> Decoder:
    """Return the decoder with weights of 0 for the `gone` features, and their contribution added to the others.

    By least squares f_gone = share . f_left; for the density also with a constant, which its bias takes.
    """
    F = len(decoder.density_weight)
    left = np.setdiff1d(np.arange(F), gone)
    moments, all_moments = _moments(sampled.features), _moments(sampled.all_features, constant=True)
    share = np.linalg.solve(moments[np.ix_(left, left)], moments[np.ix_(left, gone)])
    with_constant = np.append(left, F)
    density_share = np.linalg.solve(
        all_moments[np.ix_(with_constant, with_constant)], all_moments[np.ix_(with_constant, gone)]
    )
    weight, w2, b2 = (np.array(a, np.float64) for a in (decoder.density_weight, decoder.w2, decoder.b2))
    taken = density_share @ weight[gone]
    weight[left] += taken[:-1]
    w2[:, left] += np.einsum("lg,cgh->clh", share, w2[:, gone])
    b2[:, left] += b2[:, gone] @ share.T
    for a in (weight, w2.swapaxes(0, 1), b2.T):
        a[gone] = 0
    return replace(
        decoder,
        density_weight=weight.astype(np.float32),
        density_bias=float(decoder.density_bias + taken[-1]),
        w2=w2.astype(np.float32),
        b2=b2.astype(np.float32),
    )


def keep_channels(scene: Scene, kept: Sequence[np.ndarray]) -> Scene:
    """Return the scene with only the given channels, (M',) indices per scale; scales without any are removed."""
    scales = tuple(
        {name: np.ascontiguousarray(plane[..., channels]) for name, plane in scale.items()}
        for channels, scale in zip(kept, scene.scales, strict=True)
        if len(channels)
    )
    starts = np.cumsum([0] + [scale["xy"].shape[2] for scale in scene.scales[:-1]])
    features = np.concatenate([start + channels for start, channels in zip(starts, kept, strict=True)])
    d = scene.decoder
    decoder = replace(d, density_weight=d.density_weight[features], w2=d.w2[:, features], b2=d.b2[:, features])
    return replace(scene, scales=scales, decoder=decoder)


def _may_go(scene: Scene, order: np.ndarray, whole: Collection[int]) -> np.ndarray:
    """Return which features of an order of elimination may go where some scales keep all channels, and others one."""
    counts = [scale["xy"].shape[2] for scale in scene.scales]
    scale_of = np.repeat(np.arange(len(counts)), counts)
    may_go = ~np.isin(scale_of[order], list(whole))
    for s, count in enumerate(counts):
        own = np.flatnonzero(scale_of[order] == s)
        if len(own) == count:
            may_go[own[-1]] = False
    return may_go


def _kept(scene: Scene, gone: np.ndarray) -> tuple[np.ndarray, ...]:
    ends = np.cumsum([scale["xy"].shape[2] for scale in scene.scales])
    left = np.setdiff1d(np.arange(ends[-1]), gone)
    return tuple(left[(left >= start) & (left < end)] - start for start, end in zip([0, *ends[:-1]], ends, strict=True))


def _moments(features: np.ndarray, constant: bool = False) -> np.ndarray:
    """Return the second moments (F, F) of (N, F) features, or (F + 1, F + 1) with a constant 1 last; not singular."""
    if constant:
        features = np.concatenate([features, np.ones((len(features), 1))], axis=1)
    moments = features.T @ features / len(features)
    return moments + RIDGE * max(float(np.trace(moments)) / len(moments), 1e-12) * np.eye(len(moments))


def _basis(scene: Scene, directions: np.ndarray) -> np.ndarray:
    """Return the colour basis of (N, 3) directions: (N, 3, F) float64."""
    with torch.no_grad():
        field = Field(Layout.of(np.array([[2, 2, 2, 0]]), 1), len(scene.decoder.b1))  # its planes are not used
        field.load_decoder(scene.decoder)
        return field.basis(torch.from_numpy(directions)).numpy().astype(np.float64)  # type: ignore[no-any-return]
