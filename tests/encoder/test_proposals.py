"""Proposal sampling: equal shares after resampling, the histogram loss, and samples at surfaces after training."""

import numpy as np
import pytest
import torch

import datasets as make
from kpc.encoder.cli import encode_scene
from kpc.encoder.datasets import Dataset, load_dataset
from kpc.encoder.evaluation.evaluate import evaluate
from kpc.encoder.field.config import TrainConfig
from kpc.encoder.field.proposals import WEIGHT_PADDING, histogram_loss, resample_edges
from kpc.encoder.training.train import Trainer
from kpc.format.scene.space import Contraction

pytestmark = pytest.mark.usefixtures("one_thread")
BOX = np.array([[-1, -1, -1], [1, 1, 1]], np.float32)
CONFIG = TrainConfig(
    resolutions=(12, 24),
    samples_across=48,
    cells_across=16,
    steps=200,
    rays=256,
    samples=12288,
    warmup=5,
    occupancy_start=16,
    occupancy_every=8,
    proposals=True,
    proposal_resolutions=(8, 16),
    proposal_samples=(48, 24, 16),
)


def intervals(rays: int, count: int, seed: int) -> tuple[torch.Tensor, torch.Tensor]:
    generator = torch.Generator().manual_seed(seed)
    edges = torch.rand(rays, count + 1, generator=generator).sort(1).values
    edges[:, 0], edges[:, -1] = 0, 1  # all levels begin and end where the ray does
    weights = torch.rand(rays, count, generator=generator) ** 4
    return edges, weights / weights.sum(1, keepdim=True)


def test_resampled_intervals_hold_equal_shares_of_the_weights() -> None:
    edges, weights = intervals(20, 30, 0)
    new = resample_edges(edges, weights, 12, torch.full((20,), 0.5))
    for e, w, n in zip(edges.numpy(), weights.numpy(), new.numpy(), strict=True):
        padded = w + WEIGHT_PADDING / 30
        cumulative = np.append(0, np.cumsum(padded / padded.sum()))
        np.testing.assert_allclose(np.interp(n, e, cumulative), np.linspace(0, 1, 13), atol=1e-4)
    assert torch.equal(new[:, 0], edges[:, 0]) and torch.allclose(new[:, -1], edges[:, -1], atol=1e-5)


@pytest.mark.parametrize("jitter", [0.0, 0.3, 0.999])
def test_jitter_keeps_edges_in_order_and_within(jitter: float) -> None:
    edges, weights = intervals(20, 30, 1)
    new = resample_edges(edges, weights, 12, torch.full((20,), jitter))
    assert (new.diff(dim=1) >= 0).all() and (new >= edges[:, :1]).all() and (new <= edges[:, -1:]).all()


def test_rays_without_weight_get_uniform_and_rays_without_length_empty_intervals() -> None:
    edges = torch.stack([torch.linspace(1, 2, 9), torch.full((9,), 3.0)])
    new = resample_edges(edges, torch.zeros(2, 8), 4, torch.full((2,), 0.5))
    assert torch.allclose(new[0], torch.linspace(1, 2, 5)) and torch.equal(new[1], torch.full((5,), 3.0))


def test_the_histogram_loss_follows_its_equation() -> None:
    (edges, weights), (proposed, estimate) = intervals(8, 10, 2), intervals(8, 14, 3)
    expected = 0.0
    for e, w, p, v in zip(*(a.double().numpy() for a in (edges, weights, proposed, estimate)), strict=True):
        for i in range(10):
            bound = sum(v[j] for j in range(14) if p[j] < e[i + 1] and p[j + 1] > e[i])
            expected += max(0.0, w[i] - bound) ** 2 / (w[i] + 1e-7)
    assert float(histogram_loss(edges, weights, (proposed, estimate))) == pytest.approx(expected / 8, rel=1e-4)
    assert expected > 0


def test_the_histogram_loss_trains_only_proposals_that_underestimate() -> None:
    (edges, weights), (proposed, estimate) = intervals(8, 10, 2), intervals(8, 14, 3)
    weights.requires_grad_()
    estimate.requires_grad_()
    histogram_loss(edges, weights, (proposed, estimate)).backward()
    assert weights.grad is None and estimate.grad is not None and (estimate.grad <= 0).all() and estimate.grad.any()
    bounding = torch.ones(8, 14, requires_grad=True)
    # Intervals of the proposal begin and end beyond those of the field, so that some weight is over all of it.
    wide = torch.cat([torch.zeros(8, 1), proposed[:, 1:-1], torch.ones(8, 1)], dim=1)
    loss = histogram_loss(edges, weights, (wide, bounding))
    loss.backward()
    assert float(loss.detach()) == 0 and not bounding.grad.any()


@pytest.fixture(scope="module")
def surrounded(tmp_path_factory: pytest.TempPathFactory) -> Dataset:
    folder = tmp_path_factory.mktemp("surrounded")
    make.write_unbounded(folder / "set")
    return load_dataset(folder / "set", folder / "cache", progress=False)


def test_training_learns_a_scene_and_where_to_sample(surrounded: Dataset) -> None:
    mapping = Contraction(4.0)
    run = Trainer(surrounded, CONFIG, BOX, "cpu", mapping=mapping)
    before, reports = evaluate(encode_scene.to_scene(run), surrounded), []
    batch, _ = run.sampler.draw(np.random.default_rng(5), 512, run.background)

    def found() -> float:
        """Return the share of the rays' light that is absorbed at the field's samples."""
        optimiser = run.optimiser
        with torch.no_grad():
            samples, *_ = optimiser.proposals.sample(
                batch, torch.from_numpy(BOX), mapping, (16, 16, 16), run.step, True
            )
            s = samples.s.view(512, -1)
            return float((s[:, 1:] - s[:, :-1]).median(1).values.mean())

    spread = found()
    run.run(reports.append)
    after = evaluate(encode_scene.to_scene(run), surrounded)
    assert before is not None and after is not None and after.psnr > before.psnr + 4, (before, after)
    assert found() < 0.5 * spread
    assert run.grid.occupied.mean() < 0.9  # the grid that the file gets has formed meanwhile
