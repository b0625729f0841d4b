"""Occupied cells in as few bits as pictures and marching allow (`kpc.encoder.rdo.occupancy_rdo`)."""

import math
from dataclasses import replace

import numpy as np
import pytest

from codec_inputs import rolling
from kpc.encoder.coding.occupancy_codec import CONTEXTS, NEIGHBOURS, encode_occupancy
from kpc.encoder.coding.rans import code_bit_adaptive, encode_trace, new_models
from kpc.encoder.evaluation.validation_rays import Fidelity, ValidationRays
from kpc.encoder.rdo import occupancy_rdo
from kpc.encoder.rdo.occupancy_rdo import CONTRAST, count_contexts, flip_cells, optimise_occupancy, removal_errors
from kpc.format.scene.grid import dilate
from scenes import tiny_scene

pytestmark = pytest.mark.usefixtures("one_thread")

SCENE = tiny_scene()


def test_contexts_match_those_of_the_coder():
    """The grid is coded cell by cell in the contexts of the search."""
    occupancy = rolling(3, 6, 7, 8)
    cells, table, trace, at = occupancy.astype(np.uint8), new_models(CONTEXTS), np.empty(occupancy.size, np.int16), 0
    for place in np.ndindex(cells.shape):
        _, _, at = code_bit_adaptive(
            int(cells[place]), table, occupancy_rdo.context_at(cells, *place, NEIGHBOURS), 0, at, None, trace
        )
    assert encode_trace(trace) == encode_occupancy(occupancy)
    assert count_contexts(cells, NEIGHBOURS).sum() == cells.size


def test_a_ragged_grid_shrinks_where_errors_cost_nothing():
    occupancy = rolling()
    found = flip_cells(occupancy, np.zeros(occupancy.shape))
    assert len(encode_occupancy(found)) < 0.7 * len(encode_occupancy(occupancy))
    assert not (found & ~dilate(occupancy)).any()
    assert np.mean(found != occupancy) < 0.1


def test_important_cells_stay():
    occupancy = rolling(2, 12, 13, 14)
    np.testing.assert_array_equal(flip_cells(occupancy, np.full(occupancy.shape, 1e6)), occupancy)
    needed = occupancy & (np.random.default_rng(0).random(occupancy.shape) < 0.3)
    found = flip_cells(occupancy, np.where(needed, 1e6, 0.0))
    assert found[needed].all() and not np.array_equal(found, occupancy)


def test_removal_errors_distinguish_needed_cells():
    """The scene has cells without density, and cells that no ray passes."""
    validation = ValidationRays.from_cameras(SCENE, 500)
    error = removal_errors(SCENE, validation, 2000)
    assert error.shape == SCENE.occupancy.shape and (error >= 0).all() and (error[~SCENE.occupancy] == 0).all()
    assert 0 < error.max() <= 255**2 * CONTRAST
    thin = replace(SCENE, decoder=replace(SCENE.decoder, density_bias=-30.0))
    assert removal_errors(thin, validation, 2000).max() < 1e-6 * error.max()


def judged(found: list, error: float):
    def measure(candidate):
        found.append(candidate)
        return Fidelity(30.0, 1.0 if candidate is SCENE else 1.0 + error)

    return measure


@pytest.mark.parametrize(
    "error, tries", [(0.0, 1), (0.04, 1), (0.06, occupancy_rdo.TRIES), (math.nan, occupancy_rdo.TRIES)]
)
def test_a_grid_is_accepted_where_its_error_is_small(error, tries):
    seen: list = []
    found = optimise_occupancy(SCENE, np.zeros(SCENE.occupancy.shape), judged(seen, error), 1.0)
    assert len(seen) == 1 + tries and (found is seen[1]) == (tries == 1) and (found is SCENE) == (tries != 1)


def test_no_allowed_error_leaves_the_scene_unchanged():
    assert optimise_occupancy(SCENE, np.zeros(SCENE.occupancy.shape), judged([], 0.0), 0.0) is SCENE


def test_merged_slots_add_up_errors():
    occupancy = rolling(4, 12, 13, 14)
    merged = replace(SCENE, occupancy=occupancy.reshape(2, 2, 12, 13, 14).any(1))
    errors = np.where(occupancy & (np.random.default_rng(0).random(occupancy.shape) < 0.3), 1e6, 0.0)
    found = optimise_occupancy(merged, errors, lambda candidate: Fidelity(30.0, 0.0), 1.0).occupancy
    assert found.shape == merged.occupancy.shape and found[(errors > 0).reshape(2, 2, 12, 13, 14).any(1)].all()


def test_an_empty_occupancy_stays_empty(monkeypatch):
    monkeypatch.setattr(occupancy_rdo, "RAYS", 100)
    monkeypatch.setattr(occupancy_rdo, "FEWER_RAYS", 100)
    empty = replace(SCENE, occupancy=np.zeros_like(SCENE.occupancy))
    errors = occupancy_rdo.flip_errors(empty, ValidationRays.from_cameras(SCENE, 10))
    found = optimise_occupancy(empty, errors, lambda candidate: Fidelity(30.0, 0.0), 1.0)
    assert not found.occupancy.any()
