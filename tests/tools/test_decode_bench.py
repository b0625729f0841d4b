"""Times of decoding: which segments they are of, and tables of records that lack some."""

from pathlib import Path

import pytest

from kpc.encoder.coding import scene_writer
from kpc.format.coding.quantise import quantise_scene
from kpc.tools.bench import decode_bench, tables
from kpc.tools.bench.records import Record
from scenes import tiny_scene


@pytest.mark.parametrize("is_dynamic", [True, False])
def test_time_segments_have_a_figure_of_their_own(is_dynamic: bool, tmp_path: Path) -> None:
    scene = tiny_scene(dynamic=is_dynamic)
    scene_writer.write(
        quantise_scene(scene, [dict.fromkeys(scale, 0.05) for scale in scene.scales]), tmp_path / "a.kpc"
    )
    found = decode_bench.measure(tmp_path / "a.kpc")
    of_time = found["slowest_time_segment_ms"]
    assert 0 < of_time <= found["slowest_segment_ms"] if is_dynamic else of_time is None


def test_records_without_that_figure_stay_readable() -> None:
    old = {"segments": 12, "symbols": 1000, "decode_ms": 2.0, "two_threads_ms": 1.0, "slowest_segment_ms": 0.5}
    made: list[Record] = [
        {"kind": "decode", "name": "room", "settings": {}, "repeats": [repeat]}
        for repeat in (old, old | {"slowest_time_segment_ms": 0.3})
    ]
    head, *rows = tables.cells("decode", made)
    assert [row[head.index("slowest time segment ms")] for row in rows] == ["-", "0.3"]
