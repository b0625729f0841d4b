import json

import numpy as np
import pytest
from codec_inputs import followed, random_blocks, textured
from kpc.format.coding import predictive, transform
from kpc.format.coding.predictive import SET_COUNTS, PredictionWeights, encode_symbols
from kpc.format.coding.quantise import quantise_scene
from kpc.format.container.scene_io import write
from kpc.format.container.segments import encode_segment
from kpc.tools.bench import entropy_ablation, kpbench, tables
from scenes import tiny_scene


def in_blocks(side=8, rows=60, columns=92, share=0.7, by_occupancy=False):
    """A segment."""
    told, coded = random_blocks(side, rows, columns, share, seed=3)
    implied = coded if by_occupancy else None
    body = transform.encode_blocks(told, coded, implied)
    values, _ = transform.decode_blocks(body, rows, columns, 3, implied)
    return entropy_ablation.Segment(values, coded, coded if by_occupancy else ~coded, body, body)


def test_with_nothing_changed_the_coder_is_the_coder():
    values, coded = textured(20, 24, 3)
    side_info = PredictionWeights(np.int8([[3, -5, 8, 0, 1, -2, 4, 0, 1]]))
    for values, side_info in ((values, None), (followed(values, coded, side_info), side_info)):
        for implied in (coded, ~coded):
            body = encode_symbols(values, coded, side_info, implied)
            segment = entropy_ablation.Segment(values, coded, implied, side_info, body)
            assert entropy_ablation._bytes(segment, entropy_ablation._compiled(predictive, {}), SET_COUNTS) == len(body)


@pytest.mark.parametrize("by_occupancy", [False, True])
def test_with_nothing_changed_blocks_are_as_they_were(by_occupancy):
    segment, walks = in_blocks(by_occupancy=by_occupancy), entropy_ablation._compiled(transform, {})
    assert entropy_ablation._bytes_in_blocks(segment, walks) == len(segment.body)


@pytest.mark.parametrize(
    "idea",
    [name for name, idea in entropy_ablation.LEFT_OUT.items() if isinstance(idea, entropy_ablation.OfBlocks)],
)
def test_what_is_left_out_of_blocks_changes_something(idea, monkeypatch):
    monkeypatch.setattr(entropy_ablation, "njit", lambda function: function)  # as plain Python: compiling takes longer
    segment = in_blocks(rows=60, columns=64, share=1.0)
    assert entropy_ablation.LEFT_OUT[idea].has(segment)
    assert entropy_ablation.LEFT_OUT[idea].sized()(segment) != len(segment.body)


def test_a_map_is_told_where_occupancy_does_not():
    segment, idea = in_blocks(by_occupancy=True), entropy_ablation.LEFT_OUT["signalled significance maps"]
    assert idea.has(segment) and not idea.has(in_blocks()) and not idea.has(in_blocks(share=1.0))
    assert idea.sized()(segment) > len(segment.body)
    values, coded = textured(20, 24, 3)
    by_symbols = entropy_ablation.Segment(values, coded, coded, None, encode_segment(values, coded, None, coded))
    assert idea.sized()(by_symbols) == len(encode_symbols(values, coded)) > len(by_symbols.body)


def test_what_tables_would_take():
    asked = np.repeat(
        np.int16([-10000, -10001, -10002, -10003, -20000]), [50, 50, 0, 64, 1]
    )  # 0 and 1 as often, 1 always, 0 once
    assert (
        entropy_ablation._tables(np.append(asked, np.int16([2048, -2048]))) * 8
        == 100 + 3 * entropy_ablation.TABLE_BITS + 2
    )


def test_records(tmp_path, monkeypatch):
    scene = tiny_scene(scales=1, channels=4)
    write(quantise_scene(scene, [{name: 0.02 for name in scene.scales[0]}]), tmp_path / "tiny.kpc")
    idea = "one set of prediction weights"
    monkeypatch.setattr(entropy_ablation, "LEFT_OUT", {idea: entropy_ablation.LEFT_OUT[idea]})
    out = tmp_path / "entropy.json"
    assert kpbench.main(["entropy", str(tmp_path / "tiny.kpc"), "--out", str(out)]) == 0
    records = {record["settings"]["variant"]: record["repeats"][0] for record in json.loads(out.read_text())}
    assert list(records) == ["baseline", "zstd", idea]
    assert records["baseline"]["plane_bytes"] < records["zstd"]["plane_bytes"]
    assert records["baseline"]["decode_ms"] > 0
    assert (
        records["baseline"]["file_bytes"] == (tmp_path / "tiny.kpc").stat().st_size
        and records["baseline"]["read_ms"] > 0
    )
    assert "reading ms" in tables.markdown(json.loads(out.read_text()))
