"""Planes as 8-bit symbols: what the file stores, and the one multiply-add that turns it back into numbers.

    value = float32(float32(symbol * step) + offset)            spec/kpc-format.md, "Dequantisation"

Both roundings are to nearest even and happen in this order: a decoder must not fuse them. An *uncoded* texel has
symbol 0 in every channel, hence the value `offset`: exactly 1 on time planes (the multiplicative identity), a default
of the channel on space planes (read only where nothing is occupied).
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import Any, TypeVar

import numpy as np

from kpc.format.coding.poses import are_rigid, round_poses
from kpc.format.common.errors import FormatError
from kpc.format.container.segments import PlaneSideInfo
from kpc.format.core.decoding import implied_rows
from kpc.format.scene.cameras import Camera
from kpc.format.scene.metadata import Metadata
from kpc.format.scene.motion import QuantisedMotion, quantise_motion, reached_cells
from kpc.format.scene.scene import TIME_PLANES, AnyDecoder, Appearance, Clip, Scene
from kpc.format.scene.sound import Sound
from kpc.format.scene.space import SpaceMapping

SYMBOL_MIN, SYMBOL_MAX = -128, 127

# Magnitude of any plane value: float16 holds it, and with float16 weights no feature, density or colour overflows.
VALUE_LIMIT = 2048.0
HALF_BITS = 11  # significant bits of a float16
FINEST = -24  # exponent of the smallest float16 above 0
COARSEST_STEP = 8.0  # coarser steps count as this one; 128 of it stay within the limit
# Significant bits of focal lengths and principal points: an image of 1000 pixels is shifted by a hundredth of a pixel.
CAMERA_BITS = 16


@dataclass(frozen=True)
class QuantisedPlane:
    """A plane as integers.

    Attributes:
        symbols: (H, W, M) int8; 0 wherever `coded` is False.
        step: (M,) float32 > 0; offset: (M,) float32, exactly 1 on time planes.
        coded: (H, W) bool, the texels whose symbols the file stores.
        side_info: what the symbols were chosen with, if anything; if they do not follow it, that does no harm.
        starts: the first rows of the segments that symbols were chosen for; empty: those of `rows_per_segment`.
        stores_map: whether the file stores `coded` even where the occupancy implies it, so that the plane can be shared
            by groups of other occupancy.
    """

    symbols: np.ndarray
    step: np.ndarray
    offset: np.ndarray
    coded: np.ndarray
    side_info: PlaneSideInfo | None = None
    starts: tuple[int, ...] = ()
    stores_map: bool = False

    def dequantise(self) -> np.ndarray:
        """Return (H, W, M) float32 values."""
        return dequantise_symbols(self.symbols, self.step, self.offset)


def held_texels(values: np.ndarray) -> np.ndarray:
    """Return (H, W) bool: the smallest rectangle with all texels of a plane (H, W, M) that are not 0 in all channels.

    A scale that describes a part of the box is 0 elsewhere.
    """
    some = (values != 0).any(axis=2)
    held = np.zeros(some.shape, bool)
    if some.any():
        (top, bottom), (left, right) = (np.flatnonzero(some.any(axis=axis))[[0, -1]] for axis in (1, 0))
        held[top : bottom + 1, left : right + 1] = True
    return held


def dequantise_symbols(symbols: np.ndarray, step: np.ndarray, offset: np.ndarray) -> np.ndarray:
    """Return (..., M) float32 values of (..., M) int8: symbol * step + offset, rounded after product and after sum."""
    values = symbols.astype(np.float32)
    values *= step
    values += offset
    return values


def quantise_plane(
    values: np.ndarray,
    step: np.ndarray | float,
    *,
    identity: bool,
    needed: np.ndarray | None = None,
    name: str = "plane",
) -> QuantisedPlane:
    """Round a plane to symbols: |dequantised - value| <= step / 2 (the plane's own step) at every needed texel.

    Space planes (identity=False): the offset is the mean over the needed texels, to 8 significant bits, moved
    just so far that 8 bits hold the whole range; a step too small for the range is enlarged to range / 255. All needed
    texels are coded.

    Where texels at its edges are 0 (`held_texels`), these are not coded, and the offset is 0.
    Time planes (identity=True): the offset is 1; a step too small is enlarged until [-128, 127] reaches both ends of
    the range. Texels whose symbols are all 0 are not coded.

    Steps above COARSEST_STEP count as that.

    Args:
        values: (H, W, M) float32.
        step: (M,) or one number for all channels, > 0.
        needed: (H, W) bool; False where no occupied point projects to. Those texels are not coded. None: all needed.
        name: of the plane, for messages.

    Raises:
        FormatError: a needed value is NaN or beyond half of VALUE_LIMIT, or a step is not positive.
    """
    rows, columns, channels = values.shape
    step = np.broadcast_to(np.asarray(step, np.float32), (channels,)).copy()
    needed = np.ones((rows, columns), bool) if needed is None else needed.astype(bool)
    is_part = not identity and 0 < np.count_nonzero(held := held_texels(values)) < held.size
    if is_part:
        needed &= held
    wanted = values[needed].astype(np.float64)  # (needed texels, M)
    if not (np.abs(wanted) <= VALUE_LIMIT / 2).all():
        raise FormatError(
            f"{name}: holds NaN, infinity or a number beyond {VALUE_LIMIT / 2:g}, which no file can "
            "store; train with a lower learning rate"
        )
    if not (step > 0).all():
        raise FormatError(f"{name}: a quantisation step is not a positive number")
    step = np.minimum(step, np.float32(COARSEST_STEP))

    low, high = (wanted.min(0), wanted.max(0)) if len(wanted) else (np.ones(channels), np.ones(channels))
    if is_part:
        offset = np.zeros(channels, np.float32)
        step = _at_least(step, np.maximum(high / SYMBOL_MAX, low / SYMBOL_MIN))
    elif identity:
        offset = np.ones(channels, np.float32)
        step = _at_least(step, np.maximum((high - 1.0) / SYMBOL_MAX, (low - 1.0) / SYMBOL_MIN))
    else:
        step = _at_least(step, (high - low) / (SYMBOL_MAX - SYMBOL_MIN))
        mean = wanted.mean(0).astype(np.float32) if len(wanted) else np.ones(channels, np.float32)
        offset = np.clip(
            bfloat16_floor(mean),
            high - SYMBOL_MAX * step.astype(np.float64),
            low - SYMBOL_MIN * step.astype(np.float64),
        )
        offset = offset.astype(np.float32)

    symbols = np.zeros(values.shape, np.int8)
    rounded = np.rint((wanted - offset) / step.astype(np.float64))
    symbols[needed] = np.clip(rounded, SYMBOL_MIN, SYMBOL_MAX).astype(np.int8)
    coded = np.asarray(symbols.any(axis=2)) if identity else needed
    return QuantisedPlane(symbols, step, offset, coded)


def _at_least(step: np.ndarray, bound: np.ndarray) -> np.ndarray:
    """Return `step`, raised to `bound` where it is less; rounded up, so that the bound still holds."""
    single = bound.astype(np.float32)
    single = np.where(single < bound, np.nextafter(single, np.float32(np.inf)), single)
    return np.where(step < bound, bfloat16_ceil(single), step)


def bfloat16_ceil(values: np.ndarray) -> np.ndarray:
    """Round positive float32 numbers up to 8 significant bits, which makes them at most 1 / 128 larger.

    A file holds such numbers in little more than half the bytes."""
    return bfloat16_floor((values.view(np.uint32) + np.uint32(0xFFFF)).view(np.float32))


def bfloat16_floor(values: np.ndarray) -> np.ndarray:
    """Truncate float32 numbers to their first 8 significant bits."""
    return (values.view(np.uint32) & np.uint32(0xFFFF0000)).view(np.float32)


@dataclass(frozen=True)
class QuantisedScene:
    """A `Scene` as the file stores it: planes as symbols; weights, codes and cameras rounded. Fields as in `Scene`."""

    aabb: np.ndarray
    clip: Clip
    scales: tuple[Mapping[str, QuantisedPlane], ...]
    decoder: AnyDecoder
    occupancy: np.ndarray
    background: np.ndarray
    step: float
    cameras: tuple[Camera, ...] = field(default=())
    mapping: SpaceMapping | None = None
    motion: QuantisedMotion | None = None
    appearances: tuple[Appearance, ...] = field(default=())
    metadata: Metadata = field(default_factory=Metadata)
    sound: Sound | None = None

    def dequantise(self) -> Scene:
        """Return the scene that every decoder sees."""
        scales = tuple({name: plane.dequantise() for name, plane in scale.items()} for scale in self.scales)
        return Scene(
            self.aabb,
            self.clip,
            scales,
            self.decoder,
            self.occupancy,
            self.background,
            self.step,
            self.cameras,
            self.mapping,
            None if self.motion is None else self.motion.dequantise(),
            self.appearances,
            self.metadata,
            self.sound,
        )

    @property
    def is_dynamic(self) -> bool:
        return "xt" in self.scales[0]

    @property
    def parameter_count(self) -> int:
        """Numbers in the model, coded or not; the same as those of the dequantised scene."""
        others = 0 if self.motion is None else self.motion.symbols.size
        others += self.decoder.parameter_count + sum(appearance.code.size for appearance in self.appearances)
        return sum(p.symbols.size for scale in self.scales for p in scale.values()) + others

    @property
    def identity_share(self) -> float:
        """Share of the time planes' texels that are exactly 1 in every channel; 1 for a static scene."""
        changed = [p.symbols.any(axis=2) for scale in self.scales for name, p in scale.items() if name in TIME_PLANES]
        return 1.0 - sum(int(c.sum()) for c in changed) / sum(c.size for c in changed) if changed else 1.0


AnyScene = TypeVar("AnyScene", Scene, QuantisedScene)


def quantise_scene(
    scene: Scene,
    steps: Sequence[Mapping[str, np.ndarray | float]],
    *,
    skip_unseen: bool = True,
    reached: np.ndarray | None = None,
) -> QuantisedScene:
    """Quantise every plane and round the rest to what the file stores.

    Args:
        steps: one mapping a scale, plane name -> step: (M,) or a number.
        skip_unseen: leave texels that no occupied point projects to uncoded.
        reached: `looked_up_cells(scene)`, if the caller has it.

    Raises:
        FormatError: a value is NaN or infinite; the message names the scale and the plane.
    """
    if skip_unseen and reached is None:
        reached = looked_up_cells(scene)
    scales = []
    for number, (planes, plane_steps) in enumerate(zip(scene.scales, steps, strict=True)):
        scales.append(
            {
                name: quantise_plane(
                    values,
                    plane_steps[name],
                    identity=name in TIME_PLANES,
                    name=f"scale {number}, plane {name}",
                    needed=None
                    if reached is None or not skip_unseen
                    else needed_texels(reached, name, *values.shape[:2]),
                )
                for name, values in planes.items()
            }
        )
    return QuantisedScene(
        np.asarray(scene.aabb, np.float32),
        scene.clip,
        tuple(scales),
        round_decoder(scene.decoder),
        np.asarray(scene.occupancy, bool),
        np.asarray(scene.background, np.float32),
        float(scene.step),
        round_cameras(scene.cameras),
        scene.mapping,
        None if scene.motion is None else quantise_motion(scene.motion),
        tuple(Appearance(appearance.name, to_half(appearance.code, "appearances")) for appearance in scene.appearances),
        scene.metadata,
        scene.sound,
    )


def with_planes(scene: AnyScene, planes: Mapping[tuple[int, str], Any]) -> AnyScene:
    """Return a scene with others in place of some of its planes, by scale and name; as numbers or quantised alike."""
    scales = tuple(
        {name: planes.get((s, name), plane) for name, plane in scale.items()} for s, scale in enumerate(scene.scales)
    )
    return replace(scene, scales=scales)


def looked_up_cells(scene: Scene) -> np.ndarray:
    """Return (slots, Nz, Ny, Nx) bool: the cells of the planes' [0, 1]^3 in which occupied points are looked up."""
    occupancy = np.asarray(scene.occupancy, bool)
    return occupancy if scene.motion is None else reached_cells(occupancy, scene.motion)


def needed_texels(occupancy: np.ndarray, plane: str, rows: int, columns: int) -> np.ndarray:
    """Return (rows, columns) bool: the texels of a plane that a bilinear read inside an occupied cell may touch.

    This is the map that the occupancy implies (spec/kpc-format.md, "Texel map").

    Args:
        occupancy: (slots, Nz, Ny, Nx) bool.
        plane: its name, such as "xy" or "zt".
    """
    return implied_rows(project_occupancy(occupancy, plane), rows, columns, range(rows))


def project_occupancy(occupancy: np.ndarray, plane: str) -> np.ndarray:
    """Return (cells down, cells across) bool: the occupancy projected along the axes that a plane does not have."""
    axes = {"t": 0, "z": 1, "y": 2, "x": 3}
    across, down = axes[plane[0]], axes[plane[1]]
    others = tuple(axis for axis in range(4) if axis not in (across, down))
    projected = np.asarray(occupancy.any(axis=others))  # the kept axes stay in the order t, z, y, x
    return projected if down < across else np.ascontiguousarray(projected.T)


def round_decoder(decoder: AnyDecoder, bits: Mapping[str, int] | None = None) -> AnyDecoder:
    """Return the decoder with its weights rounded to float16 (the density bias to float32), as float32 arrays.

    Args:
        bits: for some of its arrays, at most HALF_BITS: the largest weight of the array has so many significant bits,
            and the others are rounded to the same power of two.

    Raises:
        FormatError: a weight is NaN, infinite or beyond float16's 65504.
    """
    if not np.isfinite(decoder.density_bias):
        raise FormatError("decoder: the density bias is NaN or infinite, which no file can store")
    shorter: dict[str, Any] = {
        name: to_half(_to_shared_exponent(value, bits[name]) if bits and name in bits else value)
        for name, value in decoder_arrays(decoder).items()
    }
    density_bias = float(np.float32(decoder.density_bias))
    return replace(decoder, density_bias=density_bias, **shorter)  # type: ignore[arg-type]


def decoder_arrays(decoder: AnyDecoder) -> dict[str, np.ndarray]:
    """Return the arrays of a decoder: all fields but the density bias."""
    return {name: value for name, value in vars(decoder).items() if name != "density_bias"}


def _to_bits(values: np.ndarray, bits: int) -> np.ndarray:
    """Round to so many significant bits."""
    mantissas, exponents = np.frexp(values)
    return np.ldexp(np.rint(np.ldexp(mantissas, bits)), exponents - bits)


def _to_shared_exponent(values: np.ndarray, bits: int) -> np.ndarray:
    """Round to multiples of a power of two, of which the largest takes so many bits."""
    exponent = max(int(np.frexp(np.abs(values).max())[1]) - bits, FINEST)
    return np.ldexp(np.rint(np.ldexp(values, -exponent)), exponent)


def to_half(weights: np.ndarray, what: str = "decoder") -> np.ndarray:
    """Round numbers to float16; return them as float32.

    Raises:
        FormatError: one is NaN, infinite or beyond float16's 65504.
    """
    if not (np.abs(weights) <= 65504.0).all():
        raise FormatError(f"{what}: a weight is NaN or beyond 65504, which no file can store; lower the learning rate")
    return np.asarray(weights).astype(np.float16).astype(np.float32)


def round_cameras(cameras: Sequence[Camera]) -> tuple[Camera, ...]:
    """Round focal lengths and principal points to CAMERA_BITS, and poses to those of `kpc.format.coding.poses`.

    Poses that are not rotations are rounded to float32."""
    lenses = tuple(_with_short_lens(camera) for camera in cameras)
    if lenses and are_rigid(lenses):
        return round_poses(lenses)
    return tuple(
        replace(camera, camera_to_world=camera.camera_to_world.astype(np.float32).astype(np.float64))
        for camera in lenses
    )


def _with_short_lens(camera: Camera) -> Camera:
    fl_x, fl_y, cx, cy = _to_bits(np.array([camera.fl_x, camera.fl_y, camera.cx, camera.cy]), CAMERA_BITS).tolist()
    return replace(camera, fl_x=fl_x, fl_y=fl_y, cx=cx, cy=cy)
