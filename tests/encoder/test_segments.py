"""The rows of segments, and that quantisers and the writer cut planes alike."""

from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from test_trellis import waves

from kpc.encoder.coding import scene_writer
from kpc.encoder.rdo import dct_rdo, trellis
from kpc.encoder.rdo.distortion import NO_CORRELATION
from kpc.format.coding.quantise import QuantisedPlane, quantise_plane, quantise_scene
from kpc.format.container import scene_io, segments
from kpc.format.container.container import Codec, Entry, Reader
from kpc.format.container.segments import (
    CODED_NS,
    PREDICTIVE_NS,
    ROW_MULTIPLE,
    SEGMENT_NS,
    PredictionWeights,
    TransformSegments,
    rows_per_segment,
)
from kpc.format.scene.scene import ALL_PLANES
from scenes import tiny_scene


@pytest.mark.parametrize(
    ("shape", "share", "chosen"),
    [
        ((20, 96, 16), 1.0, 32),  # fewer rows than a segment has
        ((43, 160, 8), 1.0, 48),
        ((63, 160, 8), 0.75, 64),
        ((64, 256, 16), 0.5, 32),
        ((75, 160, 16), 0.4, 48),
        ((75, 160, 16), 0.0, 48),
        ((30, 448, 16), 0.2, 32),
    ],
)
def test_segments_have_32_rows_or_more(shape: tuple[int, int, int], share: float, chosen: int) -> None:
    rows, columns, channels = shape
    assert rows_per_segment(first_columns(rows, columns, share), channels, True) == chosen


@pytest.mark.parametrize(
    ("shape", "share", "chosen"),
    [
        ((60, 256, 16), 0.4, 32),  # not 48, with a rest of 12
        ((150, 256, 16), 0.4, 32),
        ((64, 256, 16), 0.75, 16),
        ((30, 448, 16), 0.5, 16),
        ((150, 512, 32), 1.0, 16),  # takes longer than a segment should
    ],
)
def test_segments_of_many_symbols_have_fewer_rows(shape: tuple[int, int, int], share: float, chosen: int) -> None:
    rows, columns, channels = shape
    assert rows_per_segment(first_columns(rows, columns, share), channels, True) == chosen


def test_the_segment_of_most_symbols_decides() -> None:
    coded = np.zeros((96, 256), bool)
    assert rows_per_segment(coded, 16, True) == 32
    coded[64:96] = True
    assert rows_per_segment(coded, 16, True) == 16


@given(rows=st.integers(1, 300), columns=st.integers(1, 600), channels=st.integers(1, 64), share=st.floats(0, 1))
def test_no_segment_has_too_many_symbols(rows: int, columns: int, channels: int, share: float) -> None:
    coded = np.random.default_rng(0).random((rows, columns)) < share
    chosen = rows_per_segment(coded, channels, True)
    assert chosen % ROW_MULTIPLE == 0 and chosen >= ROW_MULTIPLE
    held = [channels * coded[start : start + chosen].sum() for start in range(0, rows, chosen)]
    assert chosen == ROW_MULTIPLE or CODED_NS * max(held) <= SEGMENT_NS
    assert chosen == ROW_MULTIPLE or PREDICTIVE_NS * min(chosen, rows) * columns * channels <= SEGMENT_NS
    assert rows_per_segment(coded, channels, False) == rows


def first_columns(rows: int, columns: int, share: float) -> np.ndarray:
    """Return (rows, columns) bool: a share of the columns."""
    return np.tile(np.arange(columns) < share * columns, (rows, 1))


def segments_of(data: bytes, plane: str) -> list[Entry]:
    """Return the index entries of the segments of a plane of the only scale."""
    number = ALL_PLANES.index(plane)
    return [entry for entry in Reader(data).index if entry.kind == "PLNE" and entry.plane == number]


def test_a_wide_plane_comes_back_from_segments_of_few_rows() -> None:
    scene = tiny_scene(scales=1, channels=16, resolution=(448, 3, 3), time=40)
    quantised = quantise_scene(scene, [dict.fromkeys(scene.scales[0], 0.05)])
    data = scene_writer.encode(quantised)
    assert [entry.row_count for entry in segments_of(data, "xt")] == [16, 16, 8]
    assert [entry.row_count for entry in segments_of(data, "yt")] == [40]
    assert [entry.row_count for entry in segments_of(data, "xy")] == [3]
    back = scene_io.read(data)
    for name, plane in quantised.scales[0].items():
        np.testing.assert_array_equal(back.scales[0][name].symbols, plane.symbols)
    assert scene_writer.encode(back) == data


def test_symbols_on_the_trellis_are_chosen_for_the_segments_that_are_written(monkeypatch: pytest.MonkeyPatch) -> None:
    """Their weights are in the file only if its segments are those that the search had."""
    monkeypatch.setattr(segments, "SEGMENT_NS", (PREDICTIVE_NS + CODED_NS) * 16 * 24 * 3)
    values, step = waves(11, 40, 24) / 100 + 1, np.full(3, 0.02)
    rounded = quantise_plane(values, step, identity=True)
    found = trellis.trellis_quantise(rounded, values, step, np.ones_like(values), True)
    assert isinstance(found.side_info, PredictionWeights)
    assert rows_and_codecs(found) == [(16, Codec.PREDICTIVE), (16, Codec.PREDICTIVE), (8, Codec.PREDICTIVE)]
    assert scene_io.read(with_plane(found)).scales[0]["xt"].side_info == found.side_info


@pytest.mark.parametrize(("share_of_time", "rows"), [(1.0, [40]), (0.9, [32, 8]), (0.0, [16, 16, 8])])
def test_transform_segments_that_take_long_have_fewer_rows(
    share_of_time: float, rows: list[int], monkeypatch: pytest.MonkeyPatch
) -> None:
    values, step = waves(11, 40, 24) / 100 + 1, np.full(3, 0.02)
    rounded = quantise_plane(values, step, identity=True)

    def search() -> QuantisedPlane:
        found = dct_rdo.transform_quantise(rounded, values, step, np.ones_like(values), True, NO_CORRELATION, 8)
        assert found is not None and isinstance(found[0].side_info, TransformSegments)
        assert found[1] == sum(map(len, found[0].side_info.segments.values()))
        return found[0]

    whole = search()
    assert isinstance(whole.side_info, TransformSegments) and whole.starts == (0,)
    limit = share_of_time * segments.transform_ns(whole.side_info.segments[0], values.size)
    monkeypatch.setattr(dct_rdo, "SEGMENT_NS", limit)
    found = search()
    assert rows_and_codecs(found) == [(count, Codec.TRANSFORM) for count in rows]
    np.testing.assert_array_equal(scene_io.read(with_plane(found)).scales[0]["xt"].dequantise(), found.dequantise())


def with_plane(plane: QuantisedPlane) -> bytes:
    """Return a scene of 24 x 3 x 3 texels with this plane as xt."""
    scene = tiny_scene(scales=1, channels=3, resolution=(24, 3, 3), time=40)
    quantised = quantise_scene(scene, [dict.fromkeys(scene.scales[0], 0.05)])
    return scene_writer.encode(replace(quantised, scales=(quantised.scales[0] | {"xt": plane},)))


def rows_and_codecs(plane: QuantisedPlane) -> list[tuple[int, int]]:
    return [(entry.row_count, entry.codec) for entry in segments_of(with_plane(plane), "xt")]
