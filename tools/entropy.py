"""What each idea of the entropy coder is worth, on the symbols of real files (`kpbench entropy`). It is lossless: bytes say it all.

An idea is left out by compiling `kpc.format.symbols` once more with the one constant or function changed that holds it.
"""

from collections.abc import Callable, Collection
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path
from time import process_time
from types import FunctionType
from typing import Any

import numpy as np
from numba import njit

from kpc.format import rans
from kpc.format import symbols as module
from kpc.format.container import Chunk, pack
from kpc.format.file import SceneReader, read, scene_chunks
from kpc.format.rans import words_of
from kpc.format.scene import ALL_PLANES
from kpc.format.segments import Told
from kpc.format.symbols import ANY, AROUND, MOST_DECISIONS, SET_COUNTS, TRELLIS, WEIGHTS, Guide, fitted

DECODINGS = 5
TABLE_BITS = 12
"""That a stored probability would take."""


@dataclass(frozen=True)
class Segment:
    """A plane segment that is told symbol by symbol: (H, W, M) int8 symbols, (H, W) bool coded texels, what the symbols follow, and the chunk
    that stores it."""

    symbols: np.ndarray
    coded: np.ndarray
    guide: Guide | None
    chunk: Chunk


def measure(scene: Path) -> dict[str, dict[str, float]]:
    """For each idea left out, the bytes of all planes, `plane_bytes`; of what exists as a codec also `decode_ms`, on one core; and of the file
    as it is, `file_bytes`, all that `kpc.format.file.read` does: `read_ms`. Of planes those that are told in blocks are left out."""
    quantised = read(scene)
    segments, chunks = [], scene_chunks(quantised)
    left = {(s, ALL_PLANES.index(name)) for s, planes in enumerate(quantised.scales)
            for name, plane in planes.items() if not isinstance(plane.guide, Told)}
    for chunk in chunks:
        if chunk.kind == "PLNE" and (chunk.scale, chunk.plane) in left:
            plane = quantised.scales[chunk.scale][ALL_PLANES[chunk.plane]]
            rows = slice(chunk.row_start, chunk.row_start + chunk.row_count)
            segments.append(Segment(plane.symbols[rows], plane.coded[rows], plane.guide, chunk))
    values = sum(plane.symbols.size for planes in quantised.scales for plane in planes.values())
    found = {
        "nothing": _decoded(pack(chunks, values), left)
        | {"file_bytes": scene.stat().st_size, "read_ms": _median_ms(partial(read, scene.read_bytes()))},
        "all of them: zstd": _decoded(pack([replace(chunk, coded={}) for chunk in chunks], values), left),
    }
    for name, (changes, counts, size) in LEFT_OUT.items():
        walks = _compiled(changes)
        found[name] = {"plane_bytes": sum(_bytes(segment, walks, counts, size) for segment in segments)}
    return found


def _decoded(data: bytes, left: Collection[tuple[int, int]]) -> dict[str, float]:
    reader = SceneReader(data)
    planes = [number for number, entry in enumerate(reader.index) if entry.kind == "PLNE" and (entry.scale, entry.plane) in left]
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
"""The names of `kpc.format.symbols`, its functions, and what they call of `kpc.format.rans`, compiled anew."""


@njit
def _forget(cross, above, here, below, m):
    """In place of `remember`."""


@njit
def _note(bit, table, which, state, at, words, trace):
    """`adapt` that writes down which counter was asked, and for what, below all that `decide` writes."""
    trace[at] = -10000 - 2 * which - bit
    return bit, state, at + 1


def _compiled(changes: dict[str, Any]) -> Walks:
    names = vars(rans) | vars(module) | changes
    for name in ("begin_row", "remember", "next_state", "next_place", "predict", "nearest", "foreseen", "meant", "told", "activity", "natural",
                 "integer", "walk_map", "walk"):
        if name not in changes:
            names[name] = njit(FunctionType(names[name].py_func.__code__, names, name))
    return names


def _bytes(segment: Segment, walks: Walks, counts: tuple[int, ...], size: Callable[[np.ndarray], float] | None = None) -> int:
    """What the segment takes with the best number of sets of weights, or with none; with those of its guide, if it has one. `size` is of
    a trace, else of its words."""
    symbols, coded = np.ascontiguousarray(segment.symbols), np.ascontiguousarray(segment.coded)
    neighbours, guide = module.neighbourhoods(symbols, coded), segment.guide
    trace = np.empty(coded.size + len(neighbours) * MOST_DECISIONS, np.int16)
    if guide is not None:
        lattice, tried = AROUND, [guide.weights]
    else:
        lattice = TRELLIS if module.follows_trellis(symbols, coded) else ANY
        tried = [fitted(neighbours, count) for count in counts] or [np.zeros((1, WEIGHTS), np.int8)]
    sizes = []
    for weights in tried:
        at = 0
        if not coded.all():
            _, at = walks["walk_map"](coded, 0, at, None, trace)
            trace[:at] -= 8192 * (size is not None)  # counters of the map are others
        _, at, _ = walks["walk"](symbols, coded, lattice, weights, 0, at, None, trace, None)
        sizes.append(2 + (weights.size if counts or guide else 0) + (size(trace[:at]) if size else 2 * len(words_of(trace[:at]))))
    return round(min(sizes))


def _tables(trace: np.ndarray) -> float:
    """Bytes of the decisions if each counter stood still at what it sees in the mean, and was stored."""
    counts = np.bincount(-10000 - trace[trace <= -10000].astype(np.int64), minlength=2)
    pairs = np.append(counts, [0] * (len(counts) % 2)).reshape(-1, 2)
    asked = pairs.sum(1)
    share = pairs / np.maximum(asked, 1)[:, None]
    bits = -(pairs * np.log2(np.where(share > 0, share, 1))).sum() + TABLE_BITS * np.count_nonzero(asked)
    return float(bits + np.count_nonzero(trace > -10000)) / 8


LEFT_OUT: dict[str, tuple[dict[str, Any], tuple[int, ...], Callable[[np.ndarray], float] | None]] = {
    "one set of weights": ({}, (1,), None),
    "no weights: mean of left and above": ({}, (), None),
    "no contexts of activity": ({"_LOGARITHMS": np.zeros_like(module._LOGARITHMS)}, SET_COUNTS, None),
    "no contexts of the fraction": ({"FRACTIONS": 1}, SET_COUNTS, None),
    "no errors of channels before": ({"remember": _forget}, SET_COUNTS, None),
    "stored tables for counters that learn": ({"adapt": _note}, SET_COUNTS, _tables),
}
"""Idea left out: what changes in `kpc.format.symbols`, numbers of sets of weights to try, and how to measure if not by words."""
