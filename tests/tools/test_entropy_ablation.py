"""Variants of the entropy coder: without a change they encode as the coder does, and every change has an effect."""

import json
from pathlib import Path

import numpy as np
import pytest

from codec_inputs import followed, random_blocks, textured
from core_decoders import decode_blocks
from kpc.encoder.coding import predictive, transform
from kpc.encoder.coding.predictive import SET_COUNTS, encode_symbols
from kpc.encoder.coding.scene_writer import write
from kpc.encoder.coding.segments import encode_segment
from kpc.format.coding.quantise import quantise_scene
from kpc.format.container.segments import PredictionWeights
from kpc.tools.bench import entropy_ablation, kpbench, tables
from kpc.tools.bench.entropy_ablation import (
    RECORDED,
    TABLE_BITS,
    VARIANTS,
    PredictiveVariant,
    Segment,
    TransformVariant,
    compile_encoder,
    encode_by_tables,
    predictive_size,
)
from scenes import tiny_scene


def transform_segment(rows: int = 60, columns: int = 92, share: float = 0.7, implied: bool = False) -> Segment:
    blocks, coded = random_blocks(8, rows, columns, share, seed=3)
    occupied = coded if implied else None
    body = transform.encode_blocks(blocks, coded, occupied)
    symbols, _ = decode_blocks(body, rows, columns, 3, occupied)
    return Segment(symbols, coded, coded if implied else ~coded, body, body)


def predictive_segment(side_info: PredictionWeights | None = None, implied: bool = False) -> Segment:
    symbols, coded = textured(20, 24, 3)
    if side_info is not None:
        symbols = followed(symbols, coded, side_info)
    derived = coded if implied else ~coded
    return Segment(symbols, coded, derived, side_info, encode_segment(symbols, coded, side_info, derived))


WEIGHTS = PredictionWeights(np.int8([[3, -5, 8, 0, 1, -2, 4, 0, 1]]))


@pytest.fixture
def interpreted(monkeypatch: pytest.MonkeyPatch) -> None:
    """Run variants in Python, which on small segments is faster than compiling each of them."""
    monkeypatch.setattr(entropy_ablation, "njit", lambda function: function)


@pytest.mark.parametrize("side_info", [None, WEIGHTS], ids=["no side information", "weights"])
@pytest.mark.parametrize("implied", [False, True])
def test_without_changes_symbols_take_what_the_coder_takes(
    side_info: PredictionWeights | None, implied: bool, interpreted: None
) -> None:
    segment = predictive_segment(side_info, implied)
    encode = compile_encoder(predictive, "encode_with_weights", {})
    assert predictive_size(segment, encode, SET_COUNTS) == len(segment.body)


@pytest.mark.parametrize("implied", [False, True])
def test_without_changes_blocks_take_what_the_coder_takes(implied: bool, interpreted: None) -> None:
    segment = transform_segment(implied=implied)
    assert TransformVariant({}).compiled()(segment) == len(segment.body)


@pytest.mark.parametrize("name", [name for name, one in VARIANTS.items() if isinstance(one, TransformVariant)])
def test_changes_of_the_transform_codec_have_an_effect(name: str, interpreted: None) -> None:
    segment = transform_segment(rows=60, columns=64, share=1.0)
    assert VARIANTS[name].affects(segment)
    assert VARIANTS[name].compiled()(segment) != len(segment.body)


@pytest.mark.parametrize(
    "name", [name for name, one in VARIANTS.items() if isinstance(one, PredictiveVariant) and one.set_counts != (1,)]
)
def test_changes_of_the_predictive_codec_have_an_effect(name: str, interpreted: None) -> None:
    segment = predictive_segment()
    assert VARIANTS[name].affects(segment) and not VARIANTS[name].affects(transform_segment())
    assert VARIANTS[name].compiled()(segment) != len(segment.body)


def test_maps_that_follow_from_occupancy_are_coded() -> None:
    segment, variant = transform_segment(implied=True), VARIANTS["signalled significance maps"]
    assert variant.affects(segment)
    assert not variant.affects(transform_segment()) and not variant.affects(transform_segment(share=1.0))
    assert variant.compiled()(segment) > len(segment.body)
    by_symbols = predictive_segment(implied=True)
    expected = len(encode_symbols(by_symbols.symbols, by_symbols.coded))
    assert variant.compiled()(by_symbols) == expected > len(by_symbols.body)


def test_the_size_by_static_tables() -> None:
    """One model sees 0 and 1 equally often, one only 1 and one a single 0; three bits have no model."""
    decisions = RECORDED - np.repeat([0, 1, 3, 10000], [44, 44, 64, 1])
    trace = np.append(decisions, [2048, -2048, 2048]).astype(np.int16)
    assert len(encode_by_tables(trace)) == round((88 + 3 * TABLE_BITS + 3) / 8)


def test_records(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    scene = tiny_scene(scales=1, channels=4)
    write(quantise_scene(scene, [dict.fromkeys(scene.scales[0], 0.02)]), tmp_path / "tiny.kpc")
    name = "one set of prediction weights"
    monkeypatch.setattr(entropy_ablation, "VARIANTS", {name: VARIANTS[name]})
    out = tmp_path / "entropy.json"
    assert kpbench.main(["entropy", str(tmp_path / "tiny.kpc"), "--out", str(out)]) == 0
    records = json.loads(out.read_text())
    by_variant = {record["settings"]["variant"]: record["repeats"][0] for record in records}
    assert list(by_variant) == ["baseline", "zstd", name]
    baseline = by_variant["baseline"]
    assert baseline["plane_bytes"] < by_variant["zstd"]["plane_bytes"] and baseline["decode_ms"] > 0
    assert baseline["file_bytes"] == (tmp_path / "tiny.kpc").stat().st_size and baseline["read_ms"] > 0
    assert "reading ms" in tables.markdown(records)
