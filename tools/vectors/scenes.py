"""Scenes of the conformance vectors, made of integers alone, so that they come out the same everywhere."""

from collections.abc import Callable
from dataclasses import replace

import numpy as np

from kpc.encoder.coding import motion_codec
from kpc.encoder.coding.predictive import MAX_DECISIONS, code_symbols, new_neighbours, trellis_transition
from kpc.encoder.coding.rans import code_signed, encode_trace, new_models
from kpc.format.coding.quantise import QuantisedPlane, QuantisedScene, needed_texels
from kpc.format.container.segments import DEPENDENT, MODE_BITS, PredictionWeights
from kpc.format.scene.cameras import Camera
from kpc.format.scene.motion import QuantisedMotion
from kpc.format.scene.scene import (
    ALL_PLANES,
    SPACE_PLANES,
    TIME_PLANES,
    AnyDecoder,
    Appearance,
    Clip,
    Decoder,
    HybridDecoder,
)

PlaneFunction = Callable[[str, QuantisedPlane], QuantisedPlane]


def map_planes(scene: QuantisedScene, change: PlaneFunction) -> QuantisedScene:
    """Return the scene with every plane changed by a function of its name and itself."""
    scales = tuple({name: change(name, plane) for name, plane in scale.items()} for scale in scene.scales)
    return replace(scene, scales=scales)


def minimal_scene() -> QuantisedScene:
    """Return a minimal scene: one channel, two texels an axis, a fog that is denser towards +x."""
    planes = {
        name: QuantisedPlane(
            np.array([[[0], [4]], [[0], [4]]], np.int8),
            np.array([0.25], np.float32),
            np.array([1.0], np.float32),
            np.ones((2, 2), bool),
        )
        for name in SPACE_PLANES
    }
    decoder = Decoder(
        np.array([1.0], np.float32),
        0.0,
        np.zeros((1, 9), np.float32),
        np.zeros(1, np.float32),
        np.zeros((3, 1, 1), np.float32),
        np.array([[1.0], [0.5], [0.0]], np.float32),
    )
    return QuantisedScene(
        np.array([[0, 0, 0], [1, 1, 1]], np.float32),
        Clip(1, 1.0),
        (planes,),
        decoder,
        np.ones((1, 1, 1, 1), bool),
        np.zeros(3, np.float32),
        0.125,
    )


def make_scene(
    dynamic: bool, sizes: list[tuple[int, int, int, int, int]], amplitude: int = 60, cameras: int = 0
) -> QuantisedScene:
    """A scene made of integers alone. `sizes`: channels, Nx, Ny, Nz, T of each scale."""
    scales = []
    for number, (channels, nx, ny, nz, nt) in enumerate(sizes):
        size = {"x": nx, "y": ny, "z": nz, "t": nt}
        scales.append(
            {
                name: make_plane(
                    size[name[1]],
                    size[name[0]],
                    channels,
                    amplitude,
                    ALL_PLANES.index(name) + 7 * number,
                    name in TIME_PLANES,
                )
                for name in (ALL_PLANES if dynamic else SPACE_PLANES)
            }
        )
    features, hidden = sum(size[0] for size in sizes), 3
    weights = {
        name: noise(shape, 17 + k) / np.float32(64)
        for k, (name, shape) in enumerate(Decoder.shapes(features, hidden).items())
    }
    occupancy = noise((2 if dynamic else 1, 3, 3, 5), 99) > 0
    pose = np.array([[1, 0, 0, 0.5], [0, 1, 0, -0.25], [0, 0, 1, 3], [0, 0, 0, 1]], np.float64)
    return QuantisedScene(
        np.array([[-1, -0.75, -0.5], [1, 0.75, 0.5]], np.float32),
        Clip(12, 24.0) if dynamic else Clip(1, 24.0),
        tuple(scales),
        Decoder(density_bias=0.5, **weights),
        occupancy,
        np.array([0.25, 0.5, 1], np.float32),
        0.0625,
        tuple(Camera(64 + k, 48, 80.0, 80.5, 32.0, 24.0, pose) for k in range(cameras)),
    )


def painted(
    paint: Callable[[tuple[int, int, int], int], np.ndarray], coded: bool = True, size: tuple[int, int, int] = (9, 6, 5)
) -> QuantisedScene:
    """A static scene of `paint(shape, number)` on every plane, all of whose texels are coded, or none."""
    scene = make_scene(dynamic=False, sizes=[(3, *size, 0)])
    planes = {
        name: replace(
            plane, symbols=paint(plane.symbols.shape, number).astype(np.int8), coded=np.full(plane.coded.shape, coded)
        )
        for number, (name, plane) in enumerate(scene.scales[0].items())
    }
    return replace(scene, scales=(planes,))


def hybrid_decoder(features: int, width: int, hidden: int) -> HybridDecoder:
    shapes = HybridDecoder.shapes(features, width, hidden)
    return HybridDecoder(
        density_bias=0.5,
        **{name: noise(shape, 17 + k) / np.float32(64) for k, (name, shape) in enumerate(shapes.items())},
    )


def extreme_decoder(decoder: AnyDecoder) -> Decoder:
    """Return an explicit decoder with the extreme numbers of the WEIGHTS codec, and an array of zeros."""
    assert isinstance(decoder, Decoder)
    return replace(
        decoder,
        density_weight=np.array([-65504, 65504, 32][: len(decoder.density_weight)], np.float32),
        w1=0 * decoder.w1,
        b1=np.array([1, -2, 2048], np.float32) * np.float32(0.5**24),
        w2=noise(decoder.w2.shape, 83) * np.float32(16),
        b2=noise(decoder.b2.shape, 84) * np.float32(0.5**20),
    )


def jumping_motion(rows: int, nz: int, ny: int, nx: int, step: float = 8.0) -> QuantisedMotion:
    """Displacements that jump from row to row, the largest and the smallest symbol among them; `step` in 1 / 8192."""
    symbols = noise((rows, nz, ny, nx, 3), 41).astype(np.int16)
    symbols[0, 0, 0, 0], symbols[1, 0, 0, 0] = (32767, -32768, 0), (-32768, 32767, 1)
    return QuantisedMotion(symbols, step / 8192)


def smooth_motion(rows: int, nz: int, ny: int, nx: int) -> QuantisedMotion:
    """Displacements that grow with place and time, a little rough: what a prediction from neighbours hits nearly."""
    t, z, y, x, c = np.indices((rows, nz, ny, nx, 3))
    symbols = (c + 1) * (3 * x * x - 5 * y * t + 2 * z * t * t) + 40 * t * (c - 1) + noise(t.shape, 47) // 64
    return QuantisedMotion(symbols.astype(np.int16), 0.5**11)


def make_appearances(*names: str) -> tuple[Appearance, ...]:
    """For a scene of `make_scene`'s three hidden units."""
    codes = noise((len(names), 3), 53) / np.float32(32)
    return tuple(Appearance(name, code) for name, code in zip(names, codes, strict=True))


def make_plane(rows: int, columns: int, channels: int, amplitude: int, seed: int, is_time: bool) -> QuantisedPlane:
    """Ramps of several slopes, some flat, plus noise; a quarter of the texels uncoded. Wraps where it leaves 8 bits."""
    y, x, m = np.meshgrid(np.arange(rows), np.arange(columns), np.arange(channels), indexing="ij")
    ramp = amplitude * ((m % 3) * x // columns + (m % 2) * y * y // (rows * rows))
    texture = noise((rows, columns, channels), seed) % np.array([1, 2, 5, 256])[m % 4]
    symbols = (ramp + texture).astype(np.int64).astype(np.int8)  # the low 8 bits
    coded = (x[..., 0] * 3 + y[..., 0] * 5 + seed) % 16 >= 4
    symbols[~coded] = 0
    steps = ((1 + np.arange(channels)) / 128).astype(np.float32)
    offsets = np.ones(channels) if is_time else (seed + np.arange(channels)) / 8 - 1
    return QuantisedPlane(symbols, steps, offsets.astype(np.float32), symbols.any(2) if is_time else coded)


def noise(shape: tuple[int, ...], seed: int) -> np.ndarray:
    """Integers in [-128, 127] from a multiplicative hash of their position, as float32."""
    index = np.arange(int(np.prod(shape)), dtype=np.uint32) + np.uint32(seed * 7919)
    mixed = (index * np.uint32(2654435761)) ^ (index * np.uint32(2654435761) >> np.uint32(15))
    mixed = mixed * np.uint32(2246822519)
    return ((mixed >> np.uint32(13)) & np.uint32(255)).astype(np.float32).reshape(shape) - np.float32(128)


def walked(symbols: np.ndarray, coded: np.ndarray, weights: np.ndarray, quantiser: int) -> bytes:
    """Move (H, W, M) symbols in place onto a quantiser, and return the segment up to the first that leaves its 8
    bits.
    """
    trace = np.empty(symbols.size * MAX_DECISIONS, np.int16)
    coded, nothing = np.ascontiguousarray(coded), new_neighbours(0)
    _, position, _ = code_symbols(symbols, coded, quantiser, weights, 0, 0, None, trace, nothing)
    return bytes([len(weights), quantiser << MODE_BITS]) + weights.tobytes() + encode_trace(trace[:position])


def on_trellis(scene: QuantisedScene) -> QuantisedScene:
    """Return the scene with the last bit of its symbols such that they follow the trellis."""

    def moved(name: str, plane: QuantisedPlane) -> QuantisedPlane:
        symbols = plane.symbols.copy()
        for y, c in np.ndindex(len(symbols), symbols.shape[2]):
            state = 0
            for x in np.flatnonzero(plane.coded[y]):
                symbols[y, x, c] = symbols[y, x, c] & ~1 | state & 1
                state = trellis_transition(state, int(symbols[y, x, c]))
        return replace(plane, symbols=symbols)

    return map_planes(scene, moved)


def dependent(scene: QuantisedScene, weights: np.ndarray, segment_rows: int) -> QuantisedScene:
    """Return the scene with symbols nearby, none at the ends of 8 bits, that are DEPENDENT under these weights in
    each segment.
    """

    def moved(name: str, plane: QuantisedPlane) -> QuantisedPlane:
        rows = segment_rows if name in TIME_PLANES else len(plane.symbols)
        starts = range(0, len(plane.symbols), rows)
        segments = [np.clip(plane.symbols[start : start + rows], -126, 126) for start in starts]
        for start, symbols in zip(starts, segments, strict=True):
            walked(symbols, plane.coded[start : start + rows], weights, DEPENDENT)
        return replace(plane, symbols=np.concatenate(segments), side_info=PredictionWeights(weights))

    return map_planes(scene, moved)


def with_occupancy(scene: QuantisedScene, occupancy: np.ndarray) -> QuantisedScene:
    """Return the scene with another occupancy; those texels are coded that it implies."""

    def cut(name: str, plane: QuantisedPlane) -> QuantisedPlane:
        coded = needed_texels(occupancy, name, *plane.coded.shape)
        return replace(plane, symbols=plane.symbols * coded[..., None], coded=coded)

    return replace(map_planes(scene, cut), occupancy=occupancy)


def with_few_cells(scene: QuantisedScene) -> QuantisedScene:
    """Return the scene with few occupied cells."""
    return with_occupancy(scene, noise((2 if scene.is_dynamic else 1, 5, 7, 6), 96) > 110)


def at_rest(scene: QuantisedScene) -> QuantisedScene:
    """Return the scene with time planes none of whose texels is coded."""

    def still(name: str, plane: QuantisedPlane) -> QuantisedPlane:
        if name not in TIME_PLANES:
            return plane
        return replace(plane, symbols=0 * plane.symbols, coded=plane.coded & False)

    return map_planes(scene, still)


def flat_zeros(scene: QuantisedScene) -> QuantisedScene:
    """Return the scene with the symbol 0 in all texels."""
    return map_planes(scene, lambda _, plane: replace(plane, symbols=0 * plane.symbols))


def smooth(scene: QuantisedScene) -> QuantisedScene:
    """Return the scene with planes that compress well however large they are: they rise and fall slowly over all 8
    bits.
    """

    def slow(name: str, plane: QuantisedPlane) -> QuantisedPlane:
        index = np.arange(plane.symbols.size).reshape(plane.symbols.shape) // 32 % 512
        return replace(plane, symbols=(np.minimum(index, 511 - index) - 128).astype(np.int8), coded=plane.coded | True)

    return map_planes(scene, slow)


def first_symbol(symbol: int) -> bytes:
    """Return the coded data of a motion grid up to its first symbol."""
    trace = np.empty(motion_codec.MAX_DECISIONS, np.int16)
    *_, position = code_signed(
        symbol,
        new_models(motion_codec.MODELS_PER_CONTEXT),
        0,
        motion_codec.UNARY,
        motion_codec.ESCAPES,
        0,
        0,
        None,
        trace,
    )
    return encode_trace(trace[:position])
