"""The profile of a training step: its parts add up, and the count of work follows the formulas."""

import time
from dataclasses import replace

import numpy as np
import pytest
import torch
from test_train import BOX, CONFIG

from kpc.encoder.datasets import Dataset
from kpc.encoder.evaluation import profile
from kpc.encoder.field.layout import Layout
from kpc.encoder.training.train import Trainer
from kpc.tools.bench import machine_limits

pytestmark = pytest.mark.usefixtures("one_thread")


def test_the_parts_add_up_to_the_step(moving: Dataset, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(profile, "STEPS", 2)
    monkeypatch.setattr(profile, "FUSED_STEPS", 10)
    for clock in ("monotonic", "perf_counter"):
        monkeypatch.setattr(time, clock, time.process_time)  # other programs do not count
    trainer = Trainer(moving, replace(CONFIG, steps=1000), BOX, "cpu")
    found = profile.profile(trainer)
    assert trainer.step == 2 * CONFIG.occupancy_start + 10 * profile.ROUNDS
    assert set(found["parts_s"]) == {"kernel", "adam", "priors", "decoder", "rays", "occupancy"}
    assert all(seconds > 0 for seconds in found["parts_s"].values())
    # Medians of parts against the median of the whole; what no part names is the loop around them.
    assert 0.5 * found["step_s"] < sum(found["parts_s"].values()) < 1.3 * found["step_s"]
    assert found["rays_per_s"] == pytest.approx(found["rays"] / found["step_s"])
    assert found["plain_rays_per_s"] == pytest.approx(found["rays"] / found["plain_step_s"])
    assert found["kernel_gflops"] > 0 and found["kernel_gb_s"] > 0


def test_too_short_a_run_is_refused(moving: Dataset) -> None:
    with pytest.raises(ValueError, match="60 steps"):
        profile.profile(Trainer(moving, CONFIG, BOX, "cpu"))


def test_work_of_a_sample() -> None:
    """Two scales of four channels: 6 planes of 4 taps in either direction, a multiply-add per tap and channel."""
    layout = Layout.of(np.array([[4, 4, 4, 2], [8, 8, 8, 2]]), 4)
    flops, bytes_ = profile.least_work(layout, 10)
    assert bytes_ == 10 * 2 * 6 * 4 * (4 * 4) * 3  # read, then read and written back
    interpolation = 10 * 2 * 6 * 4 * 4 * 2
    assert 2 * interpolation < flops < 3 * interpolation
    static, _ = profile.least_work(Layout.of(np.array([[4, 4, 4, 0]]), 4), 1)
    assert static < flops / 10 / 2


def test_limits_are_positive_and_caches_beat_memory(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(machine_limits, "MEMORY_BYTES", 1 << 24)
    monkeypatch.setattr(machine_limits, "REPEATS", 1)
    found = machine_limits.measure()
    assert found.gflops > 0.1 and found.memory_gb_s > 0.05 and found.cache_gb_s > 0.1


def test_the_rows_of_the_arithmetic_limit_stay_finite() -> None:
    x = np.linspace(-1, 1, 64, dtype=np.float32).reshape(2, -1)
    machine_limits._polynomials(x, 100)
    np.testing.assert_allclose(x, 0.5, atol=1e-5)


def test_traffic_is_what_operations_read_and_write() -> None:
    x, table, rows = torch.rand(100, 50), torch.rand(1000, 8), torch.randint(0, 1000, (60,))
    with profile.Traffic() as traffic:
        x + x[:1]  # the row once
        assert traffic.bytes == 4 * (5000 + 50 + 5000)
        _ = x.T
        assert traffic.bytes == 4 * (5000 + 50 + 5000)
        traffic.bytes = 0
        table.index_select(0, rows)  # of the table 60 rows
        assert traffic.bytes == 8 * 60 + 2 * 4 * 60 * 8
        traffic.bytes = 0
        torch.nn.functional.embedding_bag(rows.view(15, 4), table, per_sample_weights=torch.rand(15, 4), mode="sum")
    assert traffic.bytes == pytest.approx(8 * 60 + 4 * 60 + 4 * 60 * 8 + 4 * 15 * 8, rel=0.2)  # and where bags begin
    x = torch.rand(100, 50, requires_grad=True)
    with profile.Traffic() as traffic:
        x.exp().sum().backward()
    assert traffic.bytes == pytest.approx(
        4 * (2 * 5000 + 5000 + 2 * 5000), rel=0.01
    )  # the gradient of the sum is one number
