"""Values at the limits of what a file can store survive writing and reading within half a quantisation step."""

import tracemalloc
from dataclasses import replace

import numpy as np
import pytest

from core_decoders import decode_symbols
from kpc.encoder.coding.predictive import encode_with_weights
from kpc.encoder.coding.scene_writer import encode
from kpc.format.coding.quantise import SYMBOL_MAX, SYMBOL_MIN, QuantisedPlane, QuantisedScene, quantise_scene
from kpc.format.common.errors import BudgetError
from kpc.format.container.scene_io import read
from kpc.format.container.segments import SCALAR, WEIGHT_COUNT
from kpc.format.scene.motion import QuantisedMotion
from kpc.format.scene.scene import SPACE_PLANES, Scene
from scenes import tiny_scene


def quantised(scene: Scene, step: float) -> QuantisedScene:
    return quantise_scene(scene, [dict.fromkeys(scale, step) for scale in scene.scales], skip_unseen=False)


def assert_round_trip(before: QuantisedScene, segment_rows: int = 16) -> QuantisedScene:
    after = read(encode(before, segment_rows=segment_rows))
    for planes, found in zip(before.scales, after.scales, strict=True):
        for name, plane in planes.items():
            assert np.array_equal(found[name].symbols, plane.symbols) and np.array_equal(found[name].coded, plane.coded)
            assert np.array_equal(found[name].dequantise(), plane.dequantise())
    return after


def with_space_planes(scene: Scene, value: np.ndarray | float) -> Scene:
    """Return the scene with all space planes set to one value, or to one value per texel."""

    def plane_of(name: str, plane: np.ndarray) -> np.ndarray:
        return (
            np.full_like(plane, value) if np.isscalar(value) else np.broadcast_to(value, plane.shape).astype(np.float32)
        )

    return replace(
        scene,
        scales=tuple(
            {name: plane_of(name, plane) if name in SPACE_PLANES else plane for name, plane in scale.items()}
            for scale in scene.scales
        ),
    )


@pytest.mark.parametrize("exponent", range(-20, 5, 4))
def test_quantisation_steps_from_a_millionth_to_sixteen(exponent):
    """Values that span 240 steps err by at most half a step, plus the rounding of float32."""
    step = 2.0**exponent
    rng = np.random.default_rng(0)
    scene = with_space_planes(
        tiny_scene(scales=1, channels=2, resolution=(6, 6, 6), dynamic=False),
        step * rng.uniform(-120, 120, (6, 6, 2)) / (4 if exponent == 4 else 1),
    )
    found = assert_round_trip(quantised(scene, step)).dequantise()
    for name, plane in scene.scales[0].items():
        error = np.abs(found.scales[0][name].astype(np.float64) - plane)
        assert error.max() <= step / 2 + 4 * np.spacing(np.float32(128 * step))


@pytest.mark.parametrize("value", [0.0, 1.0, -1.0, 1e-30, 1000.0])
def test_constant_planes(value):
    scene = with_space_planes(tiny_scene(scales=1, channels=2, resolution=(9, 7, 5)), value)
    found = assert_round_trip(quantised(scene, 0.01)).dequantise()
    for name in SPACE_PLANES:
        assert np.abs(found.scales[0][name] - np.float32(value)).max() <= 0.005 + np.spacing(np.float32(abs(value)))


def test_symbols_at_their_limits():
    before = quantised(tiny_scene(scales=1, channels=3, resolution=(8, 8, 8)), 0.01)
    plane = before.scales[0]["xy"]
    limits = np.where(np.random.default_rng(0).random(plane.symbols.shape) < 0.5, SYMBOL_MIN, SYMBOL_MAX).astype(
        np.int8
    )
    assert_round_trip(replace(before, scales=({**before.scales[0], "xy": replace(plane, symbols=limits)},)))


@pytest.mark.parametrize("time", [1, 10_000])
def test_time_planes_of_one_and_of_ten_thousand_rows(time):
    assert_round_trip(
        quantised(tiny_scene(scales=1, channels=1, resolution=(2, 2, 2), time=time), 0.01), segment_rows=500
    )


@pytest.mark.parametrize("shape", [(1, 1, 1), (2, 2, 2), (2, 2048, 1), (2048, 2, 1), (2048, 2048, 1)])
def test_planes_of_extreme_sizes(shape):
    y, x, m = np.ogrid[: shape[0], : shape[1], : shape[2]]
    symbols = ((x * y // 97 + 3 * m + x) % 251 - 125).astype(np.int8)
    coded = np.ones(shape[:2], bool)
    found, where = decode_symbols(
        encode_with_weights(np.zeros((1, WEIGHT_COUNT), np.int8), symbols, coded, SCALAR), *shape
    )
    assert np.array_equal(found, symbols) and np.array_equal(where, coded)


def random_integers(bits: int, shape: tuple[int, ...]) -> np.ndarray:
    """Return signed integers of `bits` bits, including the smallest and the largest."""
    found = np.random.default_rng(bits).integers(-(1 << bits - 1), 1 << bits - 1, shape)
    found.flat[:2] = -(1 << bits - 1), (1 << bits - 1) - 1
    return found


@pytest.mark.parametrize("bits", range(1, 9))
def test_planes_with_symbols_of_every_width(bits):
    before = quantised(tiny_scene(scales=1, channels=2, resolution=(12, 12, 12)), 0.01)
    planes = {
        name: replace(
            plane, symbols=random_integers(bits, plane.symbols.shape).astype(np.int8), coded=plane.coded | True
        )
        for name, plane in before.scales[0].items()
    }
    assert_round_trip(replace(before, scales=(planes,)))


@pytest.mark.parametrize("bits", range(1, 17))
def test_motion_with_symbols_of_every_width(bits):
    before = replace(
        quantised(tiny_scene(scales=1, channels=1, resolution=(2, 2, 2)), 0.01),
        motion=QuantisedMotion(random_integers(bits, (3, 4, 3, 2, 3)).astype(np.int16), 0.5**15),
    )
    found = assert_round_trip(before).motion
    assert np.array_equal(found.symbols, before.motion.symbols) and found.step == before.motion.step


def test_a_file_of_four_million_texels():
    """It is read within the memory budget, and refused with one byte less."""
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
    assert peak < 7 * values  # symbols and coded texels twice, 2 bytes per texel of the previous channel, the file
    with pytest.raises(BudgetError):
        read(data, memory_budget=5 * values - 1)
