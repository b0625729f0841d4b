"""Sums in LLVM's own terms, against numpy."""

import numpy as np
import pytest
from numba import njit

from kpc.player.cpu.serving import NARROW, WIDE
from kpc.player.cpu.simd import LARGEST, accumulate_features, decode_corner, interpolate


@njit
def interpolated(grid, first, steps, shares, into):
    for n in range(len(first)):
        interpolate(
            grid,
            first[n],
            steps[0],
            steps[1],
            steps[2],
            shares[n, 0],
            shares[n, 1],
            shares[n, 2],
            into,
            np.uint64(1),
            np.uint64(n),
        )


@njit
def combined(wholes, factors, weights, bias, into):
    decode_corner(wholes, factors, weights, bias, into, np.uint64(1))


@njit
def weighed(planes, texels, ups, rows, starts, shares, weights, halves, into):
    for n in range(len(texels)):
        at, from_, way = texels[n], starts[n], shares[n]
        accumulate_features(
            planes, (at[0], at[1], at[2]), (ups[0], ups[1], ups[2]),
            rows, (from_[0], from_[1], from_[2]), (way[0], way[1], way[2]),
            weights, np.uint64(3), halves, into, np.uint64(1), np.uint64(n),
        )  # fmt: skip


@pytest.mark.parametrize("shape", [(4, 5, 3), (2, 2, 2), (3, 1, 1)])
def test_grids_are_interpolated_trilinearly(shape: tuple[int, int, int]) -> None:
    """Against the sum over all nodes of products of hat functions; along an axis of one node there is no next."""
    rng, count = np.random.default_rng(0), 500
    values = rng.normal(size=(*shape, 4)).astype(np.float32)
    nz, ny, nx = shape
    steps = np.array([int(nx > 1), nx * (ny > 1), nx * ny * (nz > 1)], np.uint64)
    at = rng.random((count, 3)).astype(np.float32) * (np.array([nx, ny, nz]) - 1)
    first = np.minimum(at.astype(int), np.maximum(np.array([nx, ny, nz]) - 2, 0))
    into = np.full((6, count), np.nan, np.float32)
    interpolated(
        values.reshape(-1, 4),
        (first @ [1, nx, nx * ny]).astype(np.uint64),
        steps,
        (at - first).astype(np.float32),
        into,
    )
    hats = [
        np.maximum(1 - np.abs(at[:, [axis]].astype(np.float64) - np.arange(n)), 0)
        for axis, n in enumerate((nx, ny, nz))
    ]
    wanted = np.einsum("zyxc,nx,ny,nz->cn", values.astype(np.float64), *hats)
    np.testing.assert_allclose(into[1:5], wanted, atol=1e-5)
    assert np.isnan(into[[0, 5]]).all()


@pytest.mark.parametrize("vectors", [1, 2, 3, 5])
def test_corners_are_decoded_from_products(vectors: int) -> None:
    rng, count = np.random.default_rng(vectors), WIDE * vectors
    wholes = tuple(rng.integers(-32767, 32768, count).astype(np.int16) for _ in range(3))
    factors = tuple(rng.normal(size=count).astype(np.float32) for _ in range(2))
    weights, into = (rng.normal(size=(4, count)) * 1e-13).astype(np.float32), np.full((3, 4), np.nan, np.float32)
    for _ in range(2):  # sums begin anew each time
        combined(wholes, factors, weights, np.float32(0.25), into)
    wanted = weights.astype(np.float64) @ np.prod([array.astype(np.float64) for array in (*wholes, *factors)], axis=0)
    np.testing.assert_allclose(into[1], wanted + np.array([0, 0, 0, 0.25]), rtol=1e-4, atol=1e-4)
    assert np.isnan(into[[0, 2]]).all()


@pytest.mark.parametrize("halves", [(0,), (0, NARROW)])
def test_features_are_products_of_interpolated_planes_and_rows(halves: tuple[int, ...]) -> None:
    """Planes of different sizes lie one after the other; rows are read, too."""
    wide = NARROW * len(halves)
    rng, count, (nx, ny, nz) = np.random.default_rng(4), 300, (5, 3, 4)
    planes = [rng.integers(-32767, 32768, (*shape, wide)).astype(np.int16) for shape in ((ny, nx), (nz, nx), (nz, ny))]
    rows = [rng.normal(size=(n, wide)).astype(np.float32) for n in (nx, ny, nz)]
    weights = (1e-13 * rng.normal(size=3 + 4 * wide)).astype(np.float32)
    at = rng.random((count, 3)).astype(np.float32) * (np.array([nx, ny, nz]) - 1)
    first = np.minimum(at.astype(int), np.array([nx, ny, nz]) - 2)
    (x, y, z), shares = first.T, (at - first).astype(np.float32)
    firsts = [np.cumsum([0, *(part.size for part in parts)])[:3] for parts in (planes, rows)]
    texels = firsts[0] + wide * np.stack([y * nx + x, z * nx + x, z * ny + y], 1)
    starts = firsts[1] + wide * first
    into = np.full((6, count), 0.5, np.float32)
    flat, ups = (
        [np.concatenate([part.reshape(-1) for part in parts]) for parts in (planes, rows)],
        np.uint64([wide * nx, wide * nx, wide * ny]),
    )
    weighed(flat[0], texels.astype(np.uint64), ups, flat[1], starts.astype(np.uint64), shares, weights, halves, into)
    hats = [
        np.maximum(1 - np.abs(at[:, [axis]].astype(np.float64) - np.arange(n)), 0)
        for axis, n in enumerate((nx, ny, nz))
    ]
    parts = [
        np.einsum("yxc,ny,nx->nc", plane.astype(np.float64), hats[b], hats[a])
        for plane, (a, b) in zip(planes, ((0, 1), (0, 2), (1, 2)), strict=True)
    ]
    parts += [np.einsum("xc,nx->nc", row.astype(np.float64), hat) for row, hat in zip(rows, hats, strict=True)]
    wanted = 0.5 + weights[3:].reshape(4, wide).astype(np.float64) @ np.prod(parts, axis=0).T
    np.testing.assert_allclose(into[1:5], wanted, rtol=1e-3, atol=1e-3)
    assert (into[[0, 5]] == 0.5).all() and np.abs(wanted - 0.5).max() > 0.5


@pytest.mark.parametrize("value, wanted", [(3e38, LARGEST), (-3e38, -LARGEST), (np.inf, LARGEST), (np.nan, 0.0)])
def test_sums_are_finite(value: float, wanted: float) -> None:
    ones, into = np.ones(WIDE, np.int16), np.zeros((3, 4), np.float32)
    weights = np.zeros((4, WIDE), np.float32)
    weights[:, 0] = 1.0
    combined(
        (ones,),
        (np.full(WIDE, value, np.float32),),
        np.where(weights > 0, weights, 0 if np.isfinite(value) else 1).astype(np.float32),
        np.float32(0),
        into,
    )
    assert (into[1] == np.float32(wanted)).all()
