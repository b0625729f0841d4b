import json

import numpy as np
from scenes import tiny_scene
from test_symbols import followed, textured

from kpc.format.container import Chunk
from kpc.format.file import write
from kpc.format.quantise import quantise_scene
from kpc.format.symbols import SET_COUNTS, Guide, encode_symbols
from kpc.tools import entropy, kpbench, results


def test_with_nothing_changed_the_coder_is_the_coder():
    symbols, coded = textured(20, 24, 3)
    guide = Guide(np.int8([[3, -5, 8, 0, 1, -2, 4, 0, 1]]))
    for symbols, guide in ((symbols, None), (followed(symbols, coded, guide), guide)):
        segment = entropy.Segment(symbols, coded, guide, Chunk("PLNE", []))
        assert entropy._bytes(segment, entropy._compiled({}), SET_COUNTS) == len(encode_symbols(symbols, coded, guide))


def test_what_tables_would_take():
    asked = np.repeat(np.int16([-10000, -10001, -10002, -10003, -20000]), [50, 50, 0, 64, 1])  # 0 and 1 as often, 1 always, 0 once
    assert entropy._tables(np.append(asked, np.int16([2048, -2048]))) * 8 == 100 + 3 * entropy.TABLE_BITS + 2


def test_records(tmp_path, monkeypatch):
    scene = tiny_scene(scales=1, channels=4)
    write(quantise_scene(scene, [{name: 0.02 for name in scene.scales[0]}]), tmp_path / "tiny.kpc")
    idea = "one set of weights"
    monkeypatch.setattr(entropy, "LEFT_OUT", {idea: entropy.LEFT_OUT[idea]})
    out = tmp_path / "entropy.json"
    assert kpbench.main(["entropy", str(tmp_path / "tiny.kpc"), "--out", str(out)]) == 0
    records = {record["settings"]["left_out"]: record["repeats"][0] for record in json.loads(out.read_text())}
    assert list(records) == ["nothing", "all of them: zstd", idea]
    assert records["nothing"]["plane_bytes"] < records["all of them: zstd"]["plane_bytes"]
    assert records["nothing"]["decode_ms"] > 0
    assert records["nothing"]["file_bytes"] == (tmp_path / "tiny.kpc").stat().st_size and records["nothing"]["read_ms"] > 0
    assert "whole file KB" in results.markdown(json.loads(out.read_text()))
