from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from kpc.format.common.errors import BudgetError
from kpc.format.container.container import Reader
from kpc.format.container.partial import PartialScene, SegmentedPlane
from kpc.format.container.runs import adjacent_runs
from kpc.format.container.scene_io import SceneReader, read
from kpc.format.scene.grid import sample_linear
from kpc.format.scene.scene import TIME_PLANES, Scene
from kpc.player.cpu import reference
from kpc.player.sharing.file_server import serving
from partial_scenes import coded, opened
from scenes import VARIANTS, tiny_scene, with_appearances


def picture(scene: Scene, time: float) -> np.ndarray:
    return reference.render(scene, scene.cameras[0].resized(24, 18), time).rgb


@pytest.mark.parametrize("space", VARIANTS)
def test_with_all_its_segments_it_is_the_scene(space: str) -> None:
    partial, whole = opened(with_appearances(VARIANTS[space](tiny_scene(4, time=10))))
    partial.fetch(partial.needed(2, 0.0, 1.0))
    assert len(partial.scene.appearances) == 3
    for time in (0.0, 0.123, 0.5, 1.0):
        assert np.array_equal(picture(partial.scene, time), picture(whole, time))


def test_without_planes_it_is_the_shortest_prefix_that_plays() -> None:
    """What is missing counts as section 10 of the spec says."""
    data = coded(tiny_scene(4, time=10))
    partial, reader = PartialScene(SceneReader(data, in_parts=True)), Reader(data)
    for count in (0, 4, 9, 15):
        chunks = [int(n) for n in partial.numbers[:count]]
        partial.fetch(chunks)
        end = reader.index[int(partial.numbers[count])].offset
        prefix = read(data[:end], allow_partial=True).dequantise()
        for time in (0.1, 0.9):
            assert np.array_equal(picture(partial.scene, time), picture(prefix, time))


@pytest.mark.parametrize("segment_rows", [1, 3, 4, 16])
def test_what_a_time_needs_suffices_and_nothing_of_it_can_be_spared(segment_rows: int) -> None:
    partial, whole = opened(tiny_scene(4, time=10), segment_rows)
    for time in (0.0, 0.11, 1 / 3, 0.5, 0.77, 1.0):
        needed = partial.needed(2, time, time)
        for number in partial.numbers:
            partial.drop(int(number))
        partial.fetch(needed)
        assert np.array_equal(picture(partial.scene, time), picture(whole, time))
        for scale, planes in enumerate(partial.scene.scales):
            for name in TIME_PLANES:
                assert np.array_equal(sample_linear(planes[name], time), sample_linear(whole.scales[scale][name], time))
        rows = 9 * time
        moving = [n for n in needed if partial.entry(n).plane >= 3]
        for entry in map(partial.entry, moving):
            assert entry.row_start - 1.001 <= rows <= entry.row_start + entry.row_count + 0.001
        assert len(moving) <= 6 * (3 if segment_rows == 1 else 2)  # a time on a row may count as a hair beside it


def test_scales_and_spans_are_those_asked_for() -> None:
    partial, _ = opened(tiny_scene(4, time=12), 3)
    entries = [partial.entry(n) for n in partial.needed(1, 0.3, 0.45)]
    assert {e.scale for e in entries} == {0} and [e.plane for e in entries][:3] == [0, 1, 2]
    assert {e.row_start for e in entries if e.plane >= 3} == {3}
    assert partial.needed(2, 0.0, 1.0) == sorted(map(int, partial.numbers))
    still, _ = opened(tiny_scene(4, dynamic=False))
    assert len(still.needed(1, 0.5, 0.5)) == 3 and not still.moves.any()


def test_planes_that_are_not_there_take_no_memory() -> None:
    partial, _ = opened(tiny_scene(4, time=10))
    for scale in partial.scene.scales:
        for name, plane in scale.items():
            assert isinstance(plane, SegmentedPlane) if name in TIME_PLANES else plane.strides[:2] == (0, 0)
            assert len(list(plane)) == len(plane)  # a loop over all rows ends, whatever is missing


def test_planes_can_be_larger_than_the_budget_but_other_chunks_cannot() -> None:
    data = coded(tiny_scene(4, time=10))
    with pytest.raises(BudgetError):
        SceneReader(data, memory_budget=5000)
    reader = SceneReader(data, memory_budget=5000, in_parts=True)
    with pytest.raises(BudgetError, match="occupancy"):
        SceneReader(data, memory_budget=10, in_parts=True).occupancy()
    assert reader.decoder().b1.size == 16


def test_a_scale_and_a_span_over_http_cost_their_bytes_and_two_requests(tmp_path: Path) -> None:
    scene = tiny_scene(4, time=64, resolution=(96, 80, 64), channels=16)
    rng = np.random.default_rng(0)
    scales = [
        {name: plane + rng.normal(0, 0.1, plane.shape).astype(np.float32) for name, plane in scale.items()}
        for scale in scene.scales
    ]
    noisy = replace(scene, scales=tuple(scales))
    (tmp_path / "scene.kpc").write_bytes(coded(noisy, 8))
    with serving(tmp_path) as url:
        reader = SceneReader(f"{url}/scene.kpc", in_parts=True)
        partial = PartialScene(reader)
        partial.fetch(partial.needed(1, 0.0, 0.05))
        index = reader.index
        coarse = index[partial.needed(1, 0.0, 0.05)[-1]]
        assert reader.source.size > 400_000
        # Type: ignore[attr-defined]
        assert reader.source.received_bytes <= max(coarse.offset + coarse.stored_length, 1 << 16)
        reader.source.close()  # type: ignore[attr-defined]


def test_runs_are_chunks_side_by_side() -> None:
    index = Reader(coded(tiny_scene(4, time=10))).index
    assert adjacent_runs(index, [4, 5, 6, 9, 10, 3]) == [[4, 5, 6], [9, 10], [3]]
    assert adjacent_runs(index, [4, 5, 6], most_bytes=1) == [[4], [5], [6]] and adjacent_runs(index, []) == []
