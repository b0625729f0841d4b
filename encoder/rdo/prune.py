"""What a trained scene can do without: colour that depends on the direction, channels, whole scales.

Density and colour are linear in the features before their nonlinearities, so what a channel says is passed on to the others as
far as they can say it (least squares over points that are seen: optimal brain surgeon, Hassibi and Stork, NIPS 1992), and only
the rest is lost. What that costs is measured on pictures before anything goes.
"""

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace

import numpy as np
import torch
from kpc.encoder.evaluation.evaluate import SceneRenderer
from kpc.encoder.field import render
from kpc.encoder.field.field import Field, Layout
from kpc.encoder.rdo.curvature import PerPlane
from kpc.format.scene.scene import Decoder, Scene
from kpc.format.scene.space import Contraction

Rays = tuple[np.ndarray, np.ndarray, np.ndarray]
"""Origins (N, 3), directions (N, 3) and times (N,), float32, as `kpc.encoder.datasets.pixel_rays` makes them."""

POINTS = 1 << 13
"""Seen points, and as many of occupied space, on which channels are compared."""

RIDGE = 1e-6
"""Added to the features' second moments, as a share of their mean: what two equal channels say has no single division."""


@dataclass(frozen=True)
class Pruned:
    """A scene without what it can do without.

    Attributes:
        scene: channels differ in number from scale to scale; scales left without any are gone.
        kept: one array of channel numbers for every scale there was.
        loss_db: what all of it costs on the probe rays.
        view_gain_db: what the direction MLP was worth there; None where colour did not depend on the direction.
        next_loss_db: what one channel less would have cost in all; infinite where one alone is left.
        features: channels that there were, over all scales.
    """

    scene: Scene
    kept: tuple[np.ndarray, ...]
    loss_db: float
    view_gain_db: float | None
    next_loss_db: float
    features: int

    @property
    def removed_any(self) -> bool:
        """Whether anything is gone that was worth anything, or a channel."""
        return self.loss_db != 0 or sum(map(len, self.kept)) < self.features

    def select_channels(self, numbers: PerPlane, in_pairs: bool = False) -> list[dict[str, np.ndarray]]:
        """The part of (..., M) numbers of each plane, or of (..., M, M) `in_pairs`, that belongs to what is left."""
        left = [
            ((..., kept[:, None], kept) if in_pairs else (..., kept), scale)
            for kept, scale in zip(self.kept, numbers, strict=True)
            if len(kept)
        ]
        return [{name: some[part] for name, some in scale.items()} for part, scale in left]


def max_renderings(features: int) -> int:
    """Times that `prune` has a scene of so many features rendered, at most."""
    return 3 + math.ceil(math.log2(features))


def prune(scene: Scene, probes: Rays, fidelity: Callable[[Scene], float], spare_db: float) -> Pruned:
    """Leave out the direction MLP, then as many channels as may be, while `fidelity` (dB) falls by at most `spare_db` in all.

    Channels go in the order in which they can be missed by an estimate in closed form; how many, bisection finds. The scene has
    an explicit decoder: no other is linear.
    """
    before = fidelity(scene)
    worth = None
    if not scene.decoder.w2.any():
        scene = make_view_independent(scene, probes[1])
    elif not scene.appearances:  # whose codes act through the direction MLP
        plain = make_view_independent(scene, probes[1])
        worth = before - fidelity(plain)
        scene = plain if worth <= spare_db else scene
    loss = worth if worth is not None and worth <= spare_db else 0.0

    seen, features = SurfaceFeatures.of(scene, probes), len(scene.decoder.density_weight)
    order = elimination_order(scene.decoder, seen)
    fewest, least, next_loss_db = 0, loss, math.inf
    best, most = scene, features
    while most - fewest > 1:
        count = (fewest + most) // 2 if fewest or most < features else 1  # most often not even one can go
        candidate = replace(scene, decoder=redistribute(scene.decoder, seen, order[:count]))
        cost = before - fidelity(candidate)
        if cost <= spare_db:
            fewest, least, best = count, cost, candidate
        else:
            most, next_loss_db = count, cost
    kept = _kept(scene, order[:fewest])
    return Pruned(keep_channels(best, kept), kept, least, worth, next_loss_db, features)


def make_view_independent(scene: Scene, directions: np.ndarray) -> Scene:
    """The scene with its mean colour basis over (N, 3) directions in place of the direction MLP, which is stored as one
    hidden unit that says nothing."""
    decoder = scene.decoder
    b2 = decoder.b2 if not decoder.w2.any() else _basis(scene, directions).mean(0)
    F = len(decoder.density_weight)
    nothing = [np.zeros(shape, np.float32) for shape in ((1, 9), (1,), (3, F, 1))]
    return replace(
        scene, decoder=Decoder(decoder.density_weight, decoder.density_bias, *nothing, b2.astype(np.float32))
    )


@dataclass(frozen=True)
class SurfaceFeatures:
    """Features (N, F) float64 where probe rays end, the colour basis (N, 3, F) in whose light they are seen, and features (K, F)
    there and at random in what is occupied, for the density counts where nothing is, too."""

    features: np.ndarray
    basis: np.ndarray
    all_features: np.ndarray

    @staticmethod
    def of(scene: Scene, probes: Rays) -> "SurfaceFeatures":
        origins, directions, times = (a[:: max(1, len(a) // POINTS)] for a in probes)
        renderer = SceneRenderer(scene)
        _, opacities, depths = renderer.render(origins, directions, times)
        ends = np.flatnonzero(opacities > 0.5)
        ends = ends if len(ends) else np.arange(len(origins))
        s = np.where(np.isfinite(depths), depths, 0)[ends].astype(np.float32)
        s = scene.mapping.parameter(s) if isinstance(scene.mapping, Contraction) else s
        nothing = np.zeros(len(ends))
        rays = render.Rays.from_arrays(*(a[ends] for a in (origins, directions, times)), nothing, nothing)
        u, _ = render.plane_coordinates(rays, torch.from_numpy(s)[:, None], torch.from_numpy(scene.aabb), scene.mapping)
        slots, *cells = scene.occupancy.shape
        rng = np.random.default_rng(0)
        occupied = np.argwhere(scene.occupancy)
        chosen = (
            occupied[rng.integers(len(occupied), size=len(ends))]
            if len(occupied)
            else np.zeros((len(ends), 4), np.int64)
        )
        inside = (chosen + rng.random(chosen.shape)) / (slots, *cells)
        counts = [
            scale["xy"].shape[2] for scale in scene.scales
        ]  # the renderer's field has as many as the widest at each
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


def elimination_order(decoder: Decoder, seen: SurfaceFeatures) -> np.ndarray:
    """All features but one, (F - 1,), what can be missed most easily first.

    Taking feature m away and passing it on to the others changes a linear map of weights w by w_m^2 / (G^-1)_mm, mean square, with
    the second moments G of the features. That, of log density and the logits of three colours, is the estimate; each step
    takes the least and passes it on.
    """
    F = seen.features.shape[1]
    left, order = list(range(F)), []
    weight = decoder.density_weight.astype(np.float64)
    basis = seen.basis.reshape(-1, F)
    listened = basis.T @ basis / len(seen.basis)  # second moments of the colour basis, summed over colours
    moments, all_moments = _moments(seen.features), _moments(seen.all_features, constant=True)
    while len(left) > 1:
        lost = np.diag(listened)[left] / np.diag(np.linalg.inv(moments[np.ix_(left, left)]))
        with_constant = [*left, -1]
        lost += np.square(weight[left]) / np.diag(np.linalg.inv(all_moments[np.ix_(with_constant, with_constant)]))[:-1]
        m = left.pop(int(np.argmin(lost)))
        share = np.zeros(F)
        share[left] = np.linalg.solve(moments[np.ix_(left, left)], moments[left, m])
        passed = np.outer(listened[:, m], share)
        listened += passed + passed.T + listened[m, m] * np.outer(share, share)
        weight[left] += (
            weight[m] * np.linalg.solve(all_moments[np.ix_([*left, -1], [*left, -1])], all_moments[[*left, -1], m])[:-1]
        )
        order.append(m)
    return np.array(order, np.int64)


def redistribute(decoder: Decoder, seen: SurfaceFeatures, gone: np.ndarray) -> Decoder:
    """The decoder without some features, weights of 0, whose part the others take over as well as they can: f_gone is
    about share . f_left, for the density with a constant that its bias takes."""
    F = len(decoder.density_weight)
    left = np.setdiff1d(np.arange(F), gone)
    moments, all_moments = _moments(seen.features), _moments(seen.all_features, constant=True)
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
    """The scene with some channels of each scale alone, (M',) numbers; scales without any are left out."""
    scales = tuple(
        {name: np.ascontiguousarray(plane[..., channels]) for name, plane in scale.items()}
        for channels, scale in zip(kept, scene.scales, strict=True)
        if len(channels)
    )
    starts = np.cumsum([0] + [scale["xy"].shape[2] for scale in scene.scales[:-1]])
    features = np.concatenate([start + channels for start, channels in zip(starts, kept)])
    d = scene.decoder
    decoder = replace(d, density_weight=d.density_weight[features], w2=d.w2[:, features], b2=d.b2[:, features])
    return replace(scene, scales=scales, decoder=decoder)


def _kept(scene: Scene, gone: np.ndarray) -> tuple[np.ndarray, ...]:
    ends = np.cumsum([scale["xy"].shape[2] for scale in scene.scales])
    left = np.setdiff1d(np.arange(ends[-1]), gone)
    return tuple(left[(left >= start) & (left < end)] - start for start, end in zip([0, *ends[:-1]], ends))


def _moments(features: np.ndarray, constant: bool = False) -> np.ndarray:
    """Second moments (F, F) of (N, F) features, or (F + 1, F + 1) with a constant 1 at the end; never singular."""
    if constant:
        features = np.concatenate([features, np.ones((len(features), 1))], axis=1)
    moments = features.T @ features / len(features)
    return moments + RIDGE * max(float(np.trace(moments)) / len(moments), 1e-12) * np.eye(len(moments))


def _basis(scene: Scene, directions: np.ndarray) -> np.ndarray:
    """The colour basis of (N, 3) directions: (N, 3, F) float64."""
    with torch.no_grad():
        field = Field(
            Layout.of(np.array([[2, 2, 2, 0]]), 1), len(scene.decoder.b1)
        )  # whose planes, evenly wide, are of no matter
        field.load_decoder(scene.decoder)
        return field.basis(torch.from_numpy(directions)).numpy().astype(np.float64)  # type: ignore[no-any-return]
