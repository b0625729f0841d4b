"""Numbers at the edges of what a file can hold: they come back as near as their steps promise, through the whole file."""

import tracemalloc
from dataclasses import replace

import numpy as np
import pytest
from kpc.format.coding.predictive import SCALAR, WEIGHT_COUNT, decode_symbols, encode_with_weights
from kpc.format.coding.quantise import SYMBOL_MAX, SYMBOL_MIN, QuantisedPlane, QuantisedScene, quantise_scene
from kpc.format.common.errors import BudgetError
from kpc.format.container.scene_io import encode, read
from kpc.format.scene.motion import QuantisedMotion
from kpc.format.scene.scene import SPACE_PLANES, Scene
from scenes import tiny_scene


def quantised(scene: Scene, step: float) -> QuantisedScene:
    return quantise_scene(scene, [{name: step for name in scale} for scale in scene.scales], skip_unseen=False)


def assert_comes_back(before: QuantisedScene, segment_rows: int = 16) -> QuantisedScene:
    after = read(encode(before, segment_rows=segment_rows))
    for planes, found in zip(before.scales, after.scales, strict=True):
        for name, plane in planes.items():
            assert np.array_equal(found[name].symbols, plane.symbols) and np.array_equal(found[name].coded, plane.coded)
            assert np.array_equal(found[name].dequantise(), plane.dequantise())
    return after


def painted(scene: Scene, value: np.ndarray | float) -> Scene:
    """All of its space planes of one value, or of one for each texel."""

    def paint(name: str, plane: np.ndarray) -> np.ndarray:
        return (
            np.full_like(plane, value) if np.isscalar(value) else np.broadcast_to(value, plane.shape).astype(np.float32)
        )

    return replace(
        scene,
        scales=tuple(
            {name: paint(name, plane) if name in SPACE_PLANES else plane for name, plane in scale.items()}
            for scale in scene.scales
        ),
    )


@pytest.mark.parametrize("exponent", range(-20, 5, 4))
def test_steps_from_a_millionth_to_sixteen(exponent):
    """Of values that span all 255 steps, every one is at most half a step off, and what float32 adds to it."""
    step = 2.0**exponent
    rng = np.random.default_rng(0)
    scene = painted(
        tiny_scene(scales=1, channels=2, resolution=(6, 6, 6), dynamic=False),
        step * rng.uniform(-120, 120, (6, 6, 2)) / (4 if exponent == 4 else 1),
    )
    found = assert_comes_back(quantised(scene, step)).dequantise()
    for name, plane in scene.scales[0].items():
        error = np.abs(found.scales[0][name].astype(np.float64) - plane)
        assert error.max() <= step / 2 + 4 * np.spacing(np.float32(128 * step))


@pytest.mark.parametrize("value", [0.0, 1.0, -1.0, 1e-30, 1000.0])
def test_constant_planes(value):
    scene = painted(tiny_scene(scales=1, channels=2, resolution=(9, 7, 5)), value)
    found = assert_comes_back(quantised(scene, 0.01)).dequantise()
    for name in SPACE_PLANES:
        assert np.abs(found.scales[0][name] - np.float32(value)).max() <= 0.005 + np.spacing(np.float32(abs(value)))


def test_symbols_at_their_limits():
    before = quantised(tiny_scene(scales=1, channels=3, resolution=(8, 8, 8)), 0.01)
    plane = before.scales[0]["xy"]
    limits = np.where(np.random.default_rng(0).random(plane.symbols.shape) < 0.5, SYMBOL_MIN, SYMBOL_MAX).astype(
        np.int8
    )
    assert_comes_back(replace(before, scales=({**before.scales[0], "xy": replace(plane, symbols=limits)},)))


@pytest.mark.parametrize("time", [1, 10_000])
def test_one_row_in_time_and_ten_thousand(time):
    assert_comes_back(
        quantised(tiny_scene(scales=1, channels=1, resolution=(2, 2, 2), time=time), 0.01), segment_rows=500
    )


@pytest.mark.parametrize("shape", [(1, 1, 1), (2, 2, 2), (2, 2048, 1), (2048, 2, 1), (2048, 2048, 1)])
def test_sizes_of_planes(shape):
    y, x, m = np.ogrid[: shape[0], : shape[1], : shape[2]]
    symbols = ((x * y // 97 + 3 * m + x) % 251 - 125).astype(np.int8)
    coded = np.ones(shape[:2], bool)
    found, where = decode_symbols(
        encode_with_weights(np.zeros((1, WEIGHT_COUNT), np.int8), symbols, coded, SCALAR), *shape
    )
    assert np.array_equal(found, symbols) and np.array_equal(where, coded)


def of_bits(bits: int, shape: tuple[int, ...]) -> np.ndarray:
    """Signed numbers of so many bits, the least and the largest among them."""
    found = np.random.default_rng(bits).integers(-(1 << bits - 1), 1 << bits - 1, shape)
    found.flat[:2] = -(1 << bits - 1), (1 << bits - 1) - 1
    return found


@pytest.mark.parametrize("bits", range(1, 9))
def test_planes_of_so_many_bits(bits):
    before = quantised(tiny_scene(scales=1, channels=2, resolution=(12, 12, 12)), 0.01)
    planes = {
        name: replace(plane, symbols=of_bits(bits, plane.symbols.shape).astype(np.int8), coded=plane.coded | True)
        for name, plane in before.scales[0].items()
    }
    assert_comes_back(replace(before, scales=(planes,)))


@pytest.mark.parametrize("bits", range(1, 17))
def test_motion_of_so_many_bits(bits):
    before = replace(
        quantised(tiny_scene(scales=1, channels=1, resolution=(2, 2, 2)), 0.01),
        motion=QuantisedMotion(of_bits(bits, (3, 4, 3, 2, 3)).astype(np.int16), 0.5**15),
    )
    found = assert_comes_back(before).motion
    assert np.array_equal(found.symbols, before.motion.symbols) and found.step == before.motion.step


def test_a_file_of_four_million_texels():
    """Read within the memory that the reader is allowed, one byte less of which it refuses."""
    side = 2048
    y, x = np.ogrid[:side, :side]
    planes = {
        name: QuantisedPlane(
            ((x[..., None] * y[:rows, :, None] // 97 + x[..., None]) % 251 - 125).astype(np.int8),
            np.float32([0.01]),
            np.float32([0]),
            np.ones((rows, side), bool),
        )
        for name, rows in (("xy", side), ("xz", 1), ("yz", 1))
    }
    before = replace(
        quantised(tiny_scene(scales=1, channels=1, resolution=(2, 2, 2), dynamic=False), 0.01), scales=(planes,)
    )
    data = encode(before)
    values = side * side + 2 * side
    assert len(data) < values
    tracemalloc.start()
    try:
        found = read(data, memory_budget=5 * values + (1 << 16))
        _, peak = tracemalloc.get_traced_memory()
    finally:
        tracemalloc.stop()
    assert all(np.array_equal(found.scales[0][name].symbols, plane.symbols) for name, plane in planes.items())
    assert peak < 7 * values  # symbols and coded texels twice, two bytes a texel of the channel before, the file
    with pytest.raises(BudgetError):
        read(data, memory_budget=5 * values - 1)
