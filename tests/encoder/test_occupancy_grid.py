"""The occupancy grid: which cells it keeps, which it empties, and what is stored of it."""

import numpy as np

from kpc.encoder.field.occupancy_grid import MERGE_TOLERANCE, STRIDED, OccupancyGrid, grid_shape, merge_slots
from kpc.encoder.field.random_points import random_points
from kpc.format.scene.grid import SPACE_TIME_AXES, dilate

SHAPE = (6, 5, 8)


def ball(points: np.ndarray, times: np.ndarray, centre: float = 0.5) -> np.ndarray:
    return np.where(np.linalg.norm(points - [centre, 0.5, 0.5], axis=1) < 0.3, 5.0, -5.0).astype(np.float32)


def moving(points: np.ndarray, times: np.ndarray) -> np.ndarray:
    """Return density in the lower half of x during the first half of the clip, in the upper half after that."""
    return np.where((points[:, 0] < 0.5) == (times < 0.5), 5.0, -5.0).astype(np.float32)


def grid(visible: np.ndarray | None = None) -> OccupancyGrid:
    return OccupancyGrid(np.ones(SHAPE, bool) if visible is None else visible, threshold=0.0)


def settled(g: OccupancyGrid, density: object, peaks: np.ndarray, updates: int = 200) -> OccupancyGrid:
    rng = np.random.default_rng(0)
    for _ in range(updates):
        g.update(density, peaks, rng)  # type: ignore[arg-type]
    return g


def test_cells_are_nearly_cubes() -> None:
    assert grid_shape(np.array([[0, 0, 0], [4, 2, 1]], np.float32), 96) == (24, 48, 96)
    assert grid_shape(np.array([[0, 0, 0], [1, 1, 1e-9]], np.float32), 10) == (1, 10, 10)


def test_dilation_reaches_all_26_neighbours_and_no_farther() -> None:
    one = np.zeros((5, 5, 5), bool)
    one[2, 2, 2] = True
    wide = dilate(one)
    assert wide.sum() == 27 and wide[1:4, 1:4, 1:4].all()
    assert one.sum() == 1
    corner = np.zeros((2, 3, 4, 5), bool)
    corner[1, 0, 0, 0] = True
    assert dilate(corner).sum() == 8 and not dilate(corner)[0].any()


def test_dilation_along_time_too() -> None:
    one = np.zeros((5, 3, 3, 3), bool)
    one[2, 1, 1, 1] = True
    np.testing.assert_array_equal(dilate(one, SPACE_TIME_AXES).all((1, 2, 3)), [False, True, True, True, False])
    assert dilate(one, SPACE_TIME_AXES).sum() == 81


def test_all_visible_cells_are_occupied_at_first() -> None:
    visible = np.random.default_rng(0).random(SHAPE) < 0.5
    np.testing.assert_array_equal(grid(visible).occupied, visible)


def test_the_grid_converges_to_where_density_is() -> None:
    g = settled(grid(), ball, np.ones(SHAPE, np.float32))
    z, y, x = np.meshgrid(*((np.arange(n) + 0.5) / n for n in SHAPE), indexing="ij")
    centre = ball(np.stack([x, y, z], -1).reshape(-1, 3), np.zeros(z.size)).reshape(SHAPE) > 0
    half = np.linalg.norm([0.5 / n for n in SHAPE])  # from a cell's centre to its corner
    far = np.linalg.norm(np.stack([x, y, z], -1) - 0.5, axis=-1) > 0.3 + half
    assert g.occupied[centre].mean() > 0.95 and not g.occupied[far].any()


def corner(points: np.ndarray, times: np.ndarray) -> np.ndarray:
    return np.where((points < 0.2).all(1), 5.0, -5.0).astype(np.float32)


def test_cells_whose_density_vanishes_are_emptied() -> None:
    g = settled(grid(), lambda p, t: np.maximum(ball(p, t), corner(p, t)), np.ones(SHAPE, np.float32))
    assert g.occupied[3, 2, 4] and g.occupied[0, 0, 0]
    settled(g, corner, np.ones(SHAPE, np.float32), updates=201)  # 10 units of 0.05
    assert g.occupied[0, 0, 0] and not g.occupied[3, 2, 4]


def test_cells_whose_density_appears_are_occupied() -> None:
    g = settled(grid(), corner, np.ones(SHAPE, np.float32), updates=5)
    assert not g.occupied[3, 2, 4]
    settled(g, ball, np.ones(SHAPE, np.float32))
    assert g.occupied[3, 2, 4]


def test_while_density_is_low_everywhere_the_denser_half_stays() -> None:
    """Density is below the threshold of 0 everywhere, but an empty grid could not be trained."""
    g = settled(
        grid(), lambda p, t: np.where(p[:, 0] < 0.5, -1.0, -3.0).astype(np.float32), np.ones(SHAPE, np.float32), 3
    )
    assert g.occupied[:, :, :4].all() and not g.occupied[:, :, 4:].any()


def test_cells_that_contribute_to_no_ray_are_emptied() -> None:
    """Density is everywhere, but only one cell has weights: that cell and its neighbours stay."""
    peaks = np.zeros(SHAPE, np.float32)
    peaks[3, 2, 4] = 0.5
    g = settled(grid(), lambda p, t: np.full(len(p), 5.0, np.float32), peaks)
    assert g.occupied.sum() == 27 and g.occupied[2:5, 1:4, 3:6].all()


def test_cells_that_are_not_visible_stay_empty() -> None:
    visible = np.ones(SHAPE, bool)
    visible[:, :, :4] = False
    g = settled(grid(visible), lambda p, t: np.full(len(p), 5.0, np.float32), np.ones(SHAPE, np.float32), updates=20)
    np.testing.assert_array_equal(g.occupied, visible)
    assert not g.sample_slots(ball, np.random.default_rng(0), 3)[:, ~visible].any()


def test_time_slots_follow_what_moves() -> None:
    g = settled(grid(), moving, np.ones(SHAPE, np.float32))
    assert g.occupied.all()
    slots = g.sample_slots(moving, np.random.default_rng(0), 4)
    assert slots.shape == (4, *SHAPE) and slots.dtype == bool
    for slot, first_half in enumerate((True, True, False, False)):
        assert (slots[slot, :, :, :4] == first_half).all() and (slots[slot, :, :, 4:] != first_half).all()


def test_a_split_grid_is_active_where_density_is_close_in_space_and_time() -> None:
    """Density moves at half time: the slots beside that hold both positions; cells without density are inactive."""
    g = settled(grid(), moving, np.ones(SHAPE, np.float32))
    np.testing.assert_array_equal(g.active, g.occupied[None])
    g.split(moving, 6, np.random.default_rng(0))
    lower, upper = g.active[..., :3].all((1, 2, 3)), g.active[..., 5:].all((1, 2, 3))  # 4 is a neighbour of both
    np.testing.assert_array_equal(lower, [True, True, True, True, False, False])
    np.testing.assert_array_equal(upper, [False, False, True, True, True, True])
    assert not g.active[4:, ..., :3].any() and not g.active[:2, ..., 5:].any()


def test_an_update_empties_cells_in_every_slot() -> None:
    g = settled(grid(), lambda p, t: np.maximum(ball(p, t), corner(p, t)), np.ones(SHAPE, np.float32))
    g.split(ball, 4, np.random.default_rng(0))
    assert g.active[:, 3, 2, 4].all()
    settled(g, corner, np.ones(SHAPE, np.float32), updates=201)
    assert not g.active[:, 3, 2, 4].any()


def test_while_density_is_low_everywhere_a_split_leaves_the_denser_half() -> None:
    def thin(points: np.ndarray, times: np.ndarray) -> np.ndarray:
        return np.where(points[:, 0] < 0.5, -1.0, -3.0).astype(np.float32)

    g = settled(grid(), thin, np.ones(SHAPE, np.float32), 3)
    g.split(thin, 3, np.random.default_rng(0))
    assert g.active[..., :4].all() and not g.active[..., 4:].any()
    assert g.sample_slots(thin, np.random.default_rng(0), 2)[..., :4].all()


def test_sampled_points_lie_in_their_cells_and_times_in_their_slot() -> None:
    visible = np.zeros(SHAPE, bool)
    visible[1, 4, 6] = True
    asked: list[tuple[np.ndarray, np.ndarray]] = []

    def density(points: np.ndarray, times: np.ndarray) -> np.ndarray:
        asked.append((points, times))
        return np.full(len(points), 5.0, np.float32)

    grid(visible).sample_slots(density, np.random.default_rng(0), 2, samples=8)
    points = np.concatenate([p for p, _ in asked])
    np.testing.assert_array_equal(np.floor(points * [8, 5, 6]), np.tile([6, 4, 1], (16, 1)))
    times = np.concatenate([t for _, t in asked])
    assert (times[:8] <= 0.5).all() and (times[8:] >= 0.5).all()


def test_a_grids_state_restores_another_grid() -> None:
    one, two = settled(grid(), moving, np.ones(SHAPE, np.float32), updates=7), grid()
    one.split(moving, 4, np.random.default_rng(0))
    two.load(one.state())
    settled(one, moving, np.ones(SHAPE, np.float32), updates=3)
    settled(two, moving, np.ones(SHAPE, np.float32), updates=3)
    for name in ("log_density", "peak", "occupied", "active"):
        np.testing.assert_array_equal(getattr(one, name), getattr(two, name))


def test_slots_are_merged_as_far_as_motion_allows() -> None:
    rng = np.random.default_rng(4)
    still = np.broadcast_to(rng.random((1, 9, 8, 7)) < 0.3, (8, 9, 8, 7)).copy()
    noisy = still & ((rng.random(still.shape) < 0.99) | (np.arange(8) == 3)[:, None, None, None])
    halves = still.copy()
    halves[:4, 5:] = halves[4:, :5] = False
    turning = np.zeros_like(still)
    for slot in range(8):
        turning[slot, slot] = True
    whole = ((still, 1), (noisy, 1), (halves, 2), (turning, 8))
    for before, slots in (*whole, (still[:5], 1), (turning[:5], 5), (still[:1], 1), (np.zeros_like(still), 1)):
        after = merge_slots(before)
        assert len(after) == slots and after.dtype == bool and after.mean() <= (1 + MERGE_TOLERANCE) * before.mean()
        whole = np.repeat(after, len(before) // slots, axis=0)
        assert (whole | before == whole).all() and (after.any(0) == before.any(0)).all()


def test_kept_cells_that_nothing_else_occupies_are_marched_with_a_stride() -> None:
    g = grid()
    g.kept = np.zeros(SHAPE, bool)
    g.kept[:, :, :4] = True
    settled(g, ball, np.ones(SHAPE, np.float32))
    found = g.marched[0] == 1
    assert found[3, 2, 3] and found[3, 2, 4] and not found[0, 0, 0]  # the ball's middle, and a corner
    np.testing.assert_array_equal(g.marched[0] == STRIDED, g.kept & ~found)
    np.testing.assert_array_equal(g.occupied, g.kept | found)
    np.testing.assert_array_equal(g.active[0], g.occupied)
    again = grid()
    again.kept = g.kept
    again.load(g.state())
    np.testing.assert_array_equal(again.marched, g.marched)


def test_what_changes_leaves_the_grid_as_if_all_cells_were_set_anew() -> None:
    """Density moves on while cells are kept and given up, and slots are split."""
    g, rng = grid(), np.random.default_rng(0)
    g.kept = ball(np.argwhere(np.ones(SHAPE)) / SHAPE, np.zeros(0)).reshape(SHAPE) > 0
    for number in range(120):
        if number == 50:
            g.split(moving, 4, rng)
        if number == 80:
            g.kept = None
        g.update(moving if number < 60 else corner, np.ones(SHAPE, np.float32), rng)
        again = grid()
        again.kept = None if g.kept is None else g.kept.copy()
        again.load(g.state())
        for name in ("occupied", "active", "marched"):
            np.testing.assert_array_equal(getattr(g, name), getattr(again, name))
    assert 0 < g.occupied.mean() < 1


def test_random_points_fill_their_cells_and_depend_on_nothing_but_the_seed() -> None:
    cells, seed = np.random.default_rng(0).integers(0, 240, 20_000), np.uint64(2**63 + 5)
    points, times = random_points(cells, SHAPE, 0.25, 0.5, seed)
    z, y, x = np.unravel_index(cells, SHAPE)
    inside = np.c_[points * [8, 5, 6] - np.c_[x, y, z], 4 * times - 1]
    assert inside.min() >= -1e-6 and inside.max() <= 1 + 1e-6
    np.testing.assert_allclose(inside.mean(0), 0.5, atol=0.01)
    np.testing.assert_allclose(np.cov(inside.T), np.eye(4) / 12, atol=0.002)
    part, _ = random_points(cells[:100], SHAPE, 0.25, 0.5, seed)
    np.testing.assert_array_equal(part, points[:100])
    assert (random_points(cells, SHAPE, 0.25, 0.5, np.uint64(6))[1] != times).mean() > 0.99
