"""What each idea of the entropy coder is worth, on the planes of real files (`kpbench entropy`). It is lossless: bytes say it all.

An idea is left out by compiling `kpc.format.coding.predictive` or `kpc.format.coding.transform` once more with the one constant or function changed that holds it, or
by coding as the codec before it does. What does not have it counts as it is.
"""

from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path
from time import process_time
from types import FunctionType, ModuleType
from typing import Any

import numpy as np
from kpc.format.coding import predictive, rans, texel_map, transform
from kpc.format.coding.predictive import (
    DEPENDENT,
    MAX_DECISIONS,
    SCALAR,
    SET_COUNTS,
    TRELLIS,
    WEIGHT_COUNT,
    fit_weights,
)
from kpc.format.coding.quantise import needed_texels
from kpc.format.coding.rans import trace_words
from kpc.format.coding.transform import FREQUENCY_CLASSES, decode_levels
from kpc.format.coding.transform import MODELS_PER_CONTEXT as LEVEL_DECISIONS
from kpc.format.container.container import pack
from kpc.format.container.scene_io import SceneReader, read, scene_chunks
from kpc.format.container.segments import SegmentSideInfo, encode_segment, side_info_at
from kpc.format.scene.scene import ALL_PLANES
from numba import njit

DECODINGS = 5
TABLE_BITS = 12
"""That a stored probability would take."""


@dataclass(frozen=True)
class Segment:
    """(H, W, M) int8 symbols of a plane segment, (H, W) bool coded texels, those that follow from occupancy, how it is told, and so told."""

    symbols: np.ndarray
    coded: np.ndarray
    implied: np.ndarray
    side_info: SegmentSideInfo | None
    body: bytes

    @property
    def is_in_blocks(self) -> bool:
        return isinstance(self.side_info, bytes)

    @property
    def tells_map(self) -> bool:
        return not self.coded.all() and not np.array_equal(self.coded, self.implied)


Sized = Callable[[Segment], int]
"""Bytes of a segment."""


def measure(scene: Path) -> dict[str, dict[str, float]]:
    """For each idea left out that the file has, the bytes of all planes, `plane_bytes`; of what exists as a codec also `decode_ms`, on one core; and
    of the file as it is, `file_bytes`, all that `kpc.format.container.scene_io.read` does: `read_ms`."""
    quantised = read(scene)
    segments, chunks = [], scene_chunks(quantised)
    for chunk in chunks:
        if chunk.kind == "PLNE":
            name = ALL_PLANES[chunk.plane]
            plane = quantised.scales[chunk.scale][name]
            rows, side_info = (
                slice(chunk.row_start, chunk.row_start + chunk.row_count),
                side_info_at(plane.side_info, chunk.row_start),
            )
            told = (
                plane.symbols[rows],
                plane.coded[rows],
                needed_texels(quantised.occupancy, name, *plane.coded.shape)[rows],
            )
            segments.append(Segment(*told, side_info, encode_segment(*told[:2], side_info, told[2])))
    values = sum(plane.symbols.size for planes in quantised.scales for plane in planes.values())
    found = {
        "baseline": _decoded(pack(chunks, values))
        | {"file_bytes": scene.stat().st_size, "read_ms": _median_ms(partial(read, scene.read_bytes()))},
        "zstd": _decoded(
            pack([replace(chunk, coded={}) if chunk.kind == "PLNE" else chunk for chunk in chunks], values)
        ),
    }
    for name, idea in LEFT_OUT.items():
        if any(map(idea.has, segments)):
            size = idea.sized()
            found[name] = {"plane_bytes": sum(size(one) if idea.has(one) else len(one.body) for one in segments)}
    return found


def _decoded(data: bytes) -> dict[str, float]:
    reader = SceneReader(data)
    planes = [number for number, entry in enumerate(reader.index) if entry.kind == "PLNE"]
    decode_ms = _median_ms(lambda: [reader.segment(number) for number in planes])
    return {"plane_bytes": sum(reader.index[n].stored_length for n in planes), "decode_ms": decode_ms}


def _median_ms(work: Callable[[], object]) -> float:
    """Milliseconds of processors that it takes, after a first time."""
    times = []
    for _ in range(DECODINGS + 1):
        start = process_time()
        work()
        times.append(1e3 * (process_time() - start))
    return float(np.median(times[1:]))


# --- the coder, with something changed

Walks = dict[str, Any]
"""The names of a module, its functions, and what they call of `kpc.format.coding.rans`, compiled anew."""


@njit
def _by_part(active, part):
    """In place of `context_of`."""
    return part


@njit
def _by_activity(active, part):
    return active * predictive.FRACTIONS


@njit
def _forget(cross, above, here, below, m):
    """In place of `remember`."""


@njit
def _note(bit, table, which, state, at, words, trace):
    """`adapt` that writes down which counter was asked, and for what, below all that `decide` writes."""
    trace[at] = -10000 - 2 * which - bit
    return bit, state, at + 1


@njit
def _no_pull(rest, cosines, i, j, beside, over):
    """In place of `pull_of`."""
    return 0


@njit
def _frequency_alone(here, left, above, before, i, j, side):
    """In place of `level_context`."""
    return min(5 * (i + j) // side, FREQUENCY_CLASSES - 2) if i + j else FREQUENCY_CLASSES - 1


@njit
def _without_frequency(here, left, above, before, i, j, side):
    context = transform.level_context(here, left, above, before, i, j, side)
    return context if i + j == 0 else context // FREQUENCY_CLASSES * FREQUENCY_CLASSES


@njit
def _without_before(here, left, above, before, i, j, side):
    return transform.level_context(here, left, above, np.zeros_like(before), i, j, side)


@njit
def _even_levels():
    """In place of `level_counters`."""
    return rans.new_models(transform.MAGNITUDE_CONTEXTS * FREQUENCY_CLASSES * LEVEL_DECISIONS)


@njit
def _even_signs():
    """In place of `sign_counters`."""
    return rans.new_models(len(transform.SIGN_PROBABILITIES))


CALLERS = {
    predictive: (
        "begin_row",
        "update_cross_channel",
        "trellis_transition",
        "next_trellis_state",
        "predict",
        "nearest",
        "round_prediction",
        "residual_to_offset",
        "offset_to_residual",
        "activity",
        "code_unsigned",
        "code_signed",
        "code_map",
        "code_symbols",
    ),
    transform: ("code_signs", "code_levels"),
}
"""What calls what may be changed, and that itself, each before those that call it."""


def _compiled(module: ModuleType, changes: dict[str, Any]) -> Walks:
    names = vars(rans) | vars(texel_map) | vars(module) | changes
    for name in CALLERS[module]:
        if name not in changes:
            names[name] = njit(FunctionType(names[name].py_func.__code__, names, name))
    if module is transform:
        names["encode_blocks"] = FunctionType(transform.encode_blocks.__code__, names)
    return names


def _bytes(
    segment: Segment, walks: Walks, counts: tuple[int, ...], size: Callable[[np.ndarray], float] | None = None
) -> int:
    """What a segment takes that is told symbol by symbol, with the best number of sets of weights, or with none; with those of its side_info, if it has
    one. `size` is of a trace, else of its words."""
    told, coded = np.array(segment.symbols, order="C"), np.ascontiguousarray(segment.coded)  # `walk` writes
    neighbours, side_info = predictive.collect_neighbours(told, coded), segment.side_info
    trace = np.empty(coded.size + len(neighbours) * MAX_DECISIONS, np.int16)
    if isinstance(side_info, predictive.PredictionWeights):
        lattice, tried = DEPENDENT, [side_info.weights]
    else:
        lattice = TRELLIS if predictive.follows_trellis(told, coded) else SCALAR
        tried = [fit_weights(neighbours, count) for count in counts] or [np.zeros((1, WEIGHT_COUNT), np.int8)]
    sizes = []
    for weights in tried:
        at = 0
        if segment.tells_map:
            _, at = walks["code_map"](coded, 0, at, None, trace)
            trace[:at] -= 8192 * (size is not None)  # counters of the map are others
        _, at, _ = walks["code_symbols"](told, coded, lattice, weights, 0, at, None, trace, None)
        sizes.append(
            2
            + (weights.size if counts or side_info else 0)
            + (size(trace[:at]) if size else 2 * len(trace_words(trace[:at])))
        )
    return round(min(sizes))


def _told(segment: Segment) -> transform.TransformBlocks:
    rows, columns, channels = segment.symbols.shape
    return decode_levels(segment.body, rows, columns, channels, segment.implied)


def _bytes_in_blocks(segment: Segment, walks: Walks) -> int:
    """Return the bytes of a segment under TRANSFORM."""
    return len(walks["encode_blocks"](_told(segment), segment.coded, segment.implied))


def _tables(trace: np.ndarray) -> float:
    """Bytes of the decisions if each counter stood still at what it sees in the mean, and was stored."""
    counts = np.bincount(-10000 - trace[trace <= -10000].astype(np.int64), minlength=2)
    pairs = np.append(counts, [0] * (len(counts) % 2)).reshape(-1, 2)
    asked = pairs.sum(1)
    share = pairs / np.maximum(asked, 1)[:, None]
    bits = -(pairs * np.log2(np.where(share > 0, share, 1))).sum() + TABLE_BITS * np.count_nonzero(asked)
    return float(bits + np.count_nonzero(trace > -10000)) / 8


# --- what is left out


@dataclass(frozen=True)
class OfSymbols:
    """An idea of what is told symbol by symbol: what changes in `kpc.format.coding.predictive`, numbers of sets of weights to try, how to measure if
    not by words, and whether it says, too, which symbols may follow where those are around predictions: left out there, others would have been chosen."""

    changes: dict[str, Any]
    counts: tuple[int, ...] = SET_COUNTS
    size: Callable[[np.ndarray], float] | None = None
    steers: bool = False

    def has(self, segment: Segment) -> bool:
        return not segment.is_in_blocks and not (self.steers and segment.side_info is not None)

    def sized(self) -> Sized:
        return partial(_bytes, walks=_compiled(predictive, self.changes), counts=self.counts, size=self.size)


@dataclass(frozen=True)
class OfBlocks:
    """An idea of what is told in blocks: what changes in `kpc.format.coding.transform`."""

    changes: dict[str, Any]

    def has(self, segment: Segment) -> bool:
        return segment.is_in_blocks

    def sized(self) -> Sized:
        return partial(_bytes_in_blocks, walks=_compiled(transform, self.changes))


class OfMaps:
    """That what occupancy implies is not told."""

    def has(self, segment: Segment) -> bool:
        return not segment.tells_map and not segment.coded.all()

    def sized(self) -> Sized:
        return _with_map


def _with_map(segment: Segment) -> int:
    if segment.is_in_blocks:
        return len(transform.encode_blocks(_told(segment), segment.coded))
    return len(encode_segment(segment.symbols, segment.coded, segment.side_info))


LEFT_OUT: dict[str, OfSymbols | OfBlocks | OfMaps] = {
    "signalled significance maps": OfMaps(),
    "one set of prediction weights": OfSymbols({}, (1,)),
    "prediction by the mean of left and above": OfSymbols({}, ()),
    "no activity contexts": OfSymbols({"residual_context": _by_part}),
    "no fraction contexts": OfSymbols({"residual_context": _by_activity}),
    "no residuals of earlier channels": OfSymbols({"update_cross_channel": _forget}, steers=True),
    "static probability tables": OfSymbols({"code_bit_adaptive": _note}, size=_tables),
    "transform: no sign contexts": OfBlocks({"sign_bias": _no_pull}),
    "transform: no neighbouring levels": OfBlocks({"level_context": _frequency_alone}),
    "transform: no frequency contexts": OfBlocks({"level_context": _without_frequency}),
    "transform: no earlier channel": OfBlocks({"level_context": _without_before}),
    "transform: uniform initial probabilities": OfBlocks(
        {"new_level_models": _even_levels, "new_sign_models": _even_signs}
    ),
}
"""By what the tables call them."""
