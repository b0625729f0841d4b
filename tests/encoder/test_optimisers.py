"""Feature masks, and the steps of both optimisers, which agree."""

import copy
from collections.abc import Callable
from dataclasses import replace
from functools import partial
from typing import Any

import numpy as np
import pytest
import torch

from kpc.encoder.datasets import Dataset
from kpc.encoder.field.adam import Adam
from kpc.encoder.field.field import Field
from kpc.encoder.field.layout import Layout
from kpc.encoder.field.priors import motion_priors
from kpc.encoder.training.optimisers import add_motion_prior_gradients, feature_mask, total
from kpc.format.scene.space import Contraction
from training_runs import CONFIG, torch_twin, trainer

pytestmark = pytest.mark.usefixtures("one_thread")


def test_adam_is_pytorchs_to_the_bit() -> None:
    """A parameter without a gradient waits, and each goes on from the state of the other."""
    start, generator = [torch.randn(50, 3), torch.randn(7), torch.randn(2, 2)], torch.Generator().manual_seed(0)

    def made(kind: Callable[..., Any]) -> tuple[list[torch.nn.Parameter], Any]:
        parameters = [torch.nn.Parameter(values.clone()) for values in start]
        groups = [{"params": parameters[:2], "lr": 0.1}, {"params": parameters[2:], "lr": 0.01}]
        return parameters, kind(groups, betas=(0.9, 0.99), eps=1e-15)

    (ours, one), (theirs, other) = made(Adam), made(partial(torch.optim.Adam, fused=True))
    for number in range(6):
        for optimiser in (one, other):
            optimiser.zero_grad()
            optimiser.param_groups[0]["lr"] = 0.1 / (1 + number)
        for mine, yours in list(zip(ours, theirs, strict=True))[number % 2 :]:
            mine.grad = torch.randn(mine.shape, generator=generator)
            yours.grad = mine.grad.clone()
        one.step()
        other.step()
        assert all(torch.equal(mine, yours) for mine, yours in zip(ours, theirs, strict=True))
        if number == 3:
            a, b = copy.deepcopy(one.state_dict()), copy.deepcopy(other.state_dict())
            one.load_state_dict(b)
            other.load_state_dict(a)
    assert not torch.equal(ours[0], start[0])


def test_scale_dropout_drops_finer_scales(moving: Dataset) -> None:
    """Each step has all scales, or drops those from a random one but the first on, without rescaling the others."""
    run = trainer(moving, resolutions=(8, 12, 16), scale_dropout=0.5)
    M = run.field.layout.channels
    mask = torch.stack([feature_mask(run.field, run.config, step, 0.0) for step in range(400)]).view(400, 3, M)
    assert torch.equal(mask, mask[..., :1].expand_as(mask)) and set(mask.unique().tolist()) == {0.0, 1.0}
    left = mask[:, :, 0].sum(1)
    assert (mask[:, :-1] >= mask[:, 1:]).all() and set(left.tolist()) == {1.0, 2.0, 3.0}
    assert 0.4 < (left < 3).float().mean() < 0.6


def test_the_coarsest_scale_trains_alone_first_and_dropout_ends(moving: Dataset) -> None:
    run = trainer(moving, resolutions=(8, 12, 16), channel_dropout=0.25, dropout_until=0.5, coarse_until=0.3)
    M = run.field.layout.channels
    for fraction, scales, channels in (
        (0.0, 1, M - M // 4),
        (0.29, 1, M - M // 4),
        (0.3, 3, M - M // 4),
        (0.5, 3, M),
        (1.0, 3, M),
    ):
        mask = feature_mask(run.field, run.config, 7, fraction).view(3, M)
        assert mask.any(1).sum() == scales and mask[:scales].bool().sum() == scales * channels
    before = run.field.theta.detach().clone()
    batch, targets = run.sampler.draw(run.rng, 256)
    run.optimiser.config = replace(run.config, regularise_every=1000)
    run.optimiser.step(1, 0.1, 1.0, batch, targets, run.aabb, run.grid.active, run.step_length, run.extent)
    moved, finer = run.field.theta != before, int(run.field.layout.table[1].min())
    assert moved[:finer].any() and not moved[finer:].any()


def test_dropped_channels_are_not_trained(moving: Dataset) -> None:
    """All scales drop the same channels, each step others, and the mean over steps is 1."""
    run = trainer(moving, channel_dropout=0.25)
    mask = torch.stack([feature_mask(run.field, run.config, step, 0.0) for step in range(400)])
    M = run.field.layout.channels
    assert mask.shape == (400, 2 * M) and torch.equal(mask[:, :M], mask[:, M:])
    assert ((mask == 0).sum(1) == 2 * M // 4).all() and len(torch.unique(mask, dim=0)) > 10
    torch.testing.assert_close(mask.mean(0), torch.ones(2 * M), atol=0.15, rtol=0)
    assert torch.equal(feature_mask(run.field, CONFIG, 3, 0.0), torch.ones(2 * M))
    before = run.field.theta.detach().clone()
    batch, targets = run.sampler.draw(run.rng, 256)
    run.optimiser.field, run.optimiser.config = run.field, replace(run.config, regularise_every=1000)
    run.optimiser.step(1, 0.0, 1.0, batch, targets, run.aabb, run.grid.active, run.step_length, run.extent)
    moved = (run.field.theta != before).view(-1, M).any(0)
    assert torch.equal(moved, mask[1, :M] != 0)


@pytest.mark.parametrize("mapping", [None, Contraction(4.0)])
@pytest.mark.parametrize(
    ("channel_dropout", "view_dependent", "motion_cells", "appearance"),
    [
        (0.0, True, 0, "none"),
        (0.5, True, 0, "none"),
        (0.5, False, 0, "none"),
        (0.0, True, 3, "none"),
        (0.5, True, 0, "image"),
    ],
)
@pytest.mark.parametrize("coarse_until", [0.0, 0.5])
def test_both_optimisers_take_the_same_steps(
    moving: Dataset,
    channel_dropout: float,
    view_dependent: bool,
    motion_cells: int,
    appearance: str,
    mapping: Contraction | None,
    coarse_until: float,
) -> None:
    """Adam's first step is the sign of the gradient: elements whose gradient is rounding may move either way."""
    run = trainer(
        moving,
        mapping,
        channel_dropout=channel_dropout,
        view_dependent=view_dependent,
        motion_cells=motion_cells,
        appearance=appearance,
        coarse_until=coarse_until,
        full_weight=0.0,
    )
    plain = torch_twin(run)
    for number in range(3):
        batch, targets = run.sampler.draw(run.rng, 256)
        args = (number, 0.0, 0.1, batch, targets, run.aabb, run.grid.active, run.step_length, run.extent)
        (ours, samples), (theirs, their_samples) = run.optimiser.step(*args), plain.step(*args)
        # Samples of weight below 1e-4, 83 per ray at most, have no colour in the kernels; differences accumulate.
        assert ours == pytest.approx(theirs, rel=0.02) and samples == pytest.approx(their_samples, rel=0.01)
    moved = run.config.learning_rate * 0.1 * 3
    off = (run.field.theta - plain.field.theta).abs()
    assert float((off > 0.1 * moved).float().mean()) < 0.02
    for ours, theirs in ((run.field.density, plain.field.density), (run.field.b2, plain.field.b2)):
        assert float((ours - theirs).detach().abs().max()) < 1e-3
    if run.names:
        off, far = (run.field.codes - plain.field.codes).abs(), run.config.appearance_learning_rate * 0.1 * 3
        assert float((off > 0.1 * far).float().mean()) < 0.05 and run.field.codes.abs().max().item() > 0.3 * far
    if motion_cells:
        off, far = (run.field.motion - plain.field.motion).abs(), run.config.motion_learning_rate * 0.1 * 3
        assert float((off > 0.1 * far).float().mean()) < 0.05 and run.field.motion.abs().max().item() > 0.5 * far
    ours, theirs = run.optimiser.peaks(), plain.peaks()
    np.testing.assert_allclose(ours, theirs, atol=0.02)
    assert ours.max() > 0.005 and not plain.peaks().any()


def test_the_gradient_of_the_motion_priors_is_that_of_pytorch() -> None:
    """Along z there are too few nodes for a second difference."""
    config = replace(CONFIG, motion_smoothness_time=3.0, motion_smoothness_space=0.5)
    field = Field(Layout.of(np.array([[3, 3, 3, 5]]), 2), 4, motion_shape=(5, 2, 3, 4)).double()
    assert field.motion is not None
    with torch.no_grad():
        field.motion += torch.randn(field.motion.shape, generator=torch.Generator().manual_seed(0))
    (expected,) = torch.autograd.grad(total(motion_priors(field, config)), field.motion)
    field.motion.grad = torch.ones_like(field.motion)
    add_motion_prior_gradients(field.motion, config)
    torch.testing.assert_close(field.motion.grad, 1 + expected)
