import json
from pathlib import Path

import pytest

from kpc.format.common.errors import FormatError
from kpc.tools.bench import columns, results, tables
from kpc.tools.bench.records import Record, median

MACHINE = {"cpu": "Test CPU", "cores": 2, "memory_bytes": 8 << 30, "os": "Linux", "python": "3.11"}


def encode_record(name: str, psnrs: list[float | None], **changes: object) -> Record:
    run: Record = {
        "test_ssim": 0.9,
        "size_bytes": 345678,
        "bits_per_parameter": 1.25,
        "identity_share": None,
        "coding_loss_db": 0.1,
    }
    run |= {"train_s": 100.0, "encode_s": 120.0, "rays_per_s": 23456.0, "peak_memory_bytes": 9e8}
    record: Record = {
        "kind": "encode",
        "name": name,
        "commit": "0123456789abcdef",
        "command": f"kpbench encode {name}",
        "renderer": "cpu",
    }
    record |= {
        "machine": MACHINE,
        "settings": {"preset": "fast"},
        "repeats": [run | {"test_psnr": psnr} for psnr in psnrs],
    }
    return record | changes


def test_printed_tables_fit_a_terminal() -> None:
    """Six columns of each kind of record, within 100 characters for the records that the documents show."""
    assert columns.PRINTED.keys() == columns.COLUMNS.keys()
    for kind, names in columns.PRINTED.items():
        assert len(names) == 6 and {*names} <= {name for name, _ in columns.COLUMNS[kind]}
    for path in sorted((Path(__file__).parents[2] / "docs" / "bench").glob("*.json")):
        records = results.load([path])
        assert max(map(len, tables.printed(records[0]["kind"], records).splitlines())) <= 100
    (long,) = tables.printed("encode", [encode_record(60 * "long", [30.0])]).splitlines()[1:]
    assert long.startswith("longlong") and "…" in long and len(long) <= 100


def test_cells_are_medians_of_the_repeats_that_have_a_value() -> None:
    record = encode_record("room", [30.0, None, 32.0, 33.0])
    assert median(record, "test_psnr") == 32.0
    assert median(record, "identity_share") is None
    head, row = tables.cells("encode", [record])
    assert (
        dict(zip(head, row, strict=True))["PSNR dB"] == "32.00" and dict(zip(head, row, strict=True))["identity"] == "-"
    )
    assert (
        dict(zip(head, row, strict=True))["file KB"] == "346"
        and dict(zip(head, row, strict=True))["rays/s"] == "23,456"
    )


def test_tables_are_split_by_machine_and_state_their_origin() -> None:
    other = encode_record("liam", [28.0], machine=MACHINE | {"cores": 64}, commit="f" * 40 + "+dirty")
    text = tables.markdown([encode_record("room", [30.0, 31.0]), other, encode_record("fox", [20.0, 21.0])])
    first, second = text.split("**Encoding**")[1:]
    assert "Test CPU, 2 cores, 8 GiB" in first and "| room | fast | 30.50 |" in first and "| fox |" in first
    assert "Commit 012345678; median of 2 runs; `kpbench encode room`; `kpbench encode fox`." in first
    assert "64 cores" in second and "Commit fffffffff+dirty; median of 1 run;" in second


def player_records(name: str, size: str = "320x240", renderer: str = "llvmpipe") -> list[Record]:
    accuracy = dict.fromkeys(("samples_per_ray", "psnr_min", "psnr_moving", "within_one_level"), 0.5) | {"psnr": 41.6}
    return [
        encode_record(
            name,
            [30.0],
            kind="player",
            accuracy=accuracy,
            renderer=renderer,
            repeats=[{"fps": 31.4}],
            settings={"quality": quality, "default_quality": "balanced", "size": size},
        )
        for quality in ("fast", "balanced", "fine", "reference")
    ]


def test_documents_show_only_default_and_reference_quality() -> None:
    each = [*player_records("room"), encode_record("liam", [1.0])]
    document = "".join(f"<!-- {kind}: begin -->\n<!-- {kind}: end -->\n" for kind in ("player", "encode"))
    every, few = tables.markdown(each), results.with_tables(document, each)
    assert every.count("| room |") == 4 and few.count("| room |") == 2 and few.count("| liam |") == 1
    assert "| balanced (default) |" in few and "| reference |" in few


def test_the_summary_joins_encodings_with_their_software_playback() -> None:
    encoding, with_target = (
        encode_record("room", [30.0]),
        encode_record("room", [20.0], settings={"preset": "fast", "psnr_db": 20.0}),
    )
    played = [
        player_records("room-fast", "640x480"),
        player_records("room-fast"),
        player_records("room-fast", "640x480", "NVIDIA"),
        player_records("fox-fast", "640x480"),
    ]
    head, _, *rows = tables.glance(
        [encoding, with_target, *(record for records in played for record in records)]
    ).splitlines()
    assert rows == ["| room | fast | 30.00 | 0.900 | 346 | 2 | 2 | 31 | 42 |"] and head.count("|") == rows[0].count("|")


def test_only_text_between_markers_is_rewritten(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    readme, tables, records = tmp_path / "README.md", tmp_path / "tables.md", tmp_path / "a.json"
    before, after = "before\n\n<!-- glance: begin; a word -->", "<!-- glance: end -->\n\nafter\n"
    readme.write_text(f"{before}\nold\n{after}")
    tables.write_text("<!-- step: begin -->\nold <!-- step: end -->\n<!-- encode: begin --><!-- encode: end -->")
    records.write_text(json.dumps([encode_record("room", [30.0])]))
    for _ in range(2):
        assert results.main([str(records), "--into", str(readme), str(tables)]) == 0
        assert capsys.readouterr().out == f"{readme}\n{tables}\n"
    text = readme.read_text()
    assert text.startswith(f"{before}\n\n| dataset |") and text.endswith(f"\n\n{after}") and "old" not in text
    text = tables.read_text()
    assert (
        text.startswith("<!-- step: begin -->\n\n\n\n<!-- step: end -->\n<!-- encode: begin -->\n\n**Encoding**")
        and text.count("| room |") == 1
    )


def test_records_without_markers_are_reported_and_nothing_is_written(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    document, records = tmp_path / "a.md", tmp_path / "a.json"
    document.write_text("<!-- step: begin --><!-- step: end -->")
    records.write_text(json.dumps([encode_record("room", [30.0])]))
    assert results.main([str(records), "--into", str(document)]) == 1
    assert "no markers for tables of encode" in capsys.readouterr().err
    assert document.read_text() == "<!-- step: begin --><!-- step: end -->"


@pytest.mark.parametrize("text", ["", "{}", "[1]", '[{"kind": "other"}]', '[{"kind": "encode"}]'])
def test_other_files_are_refused(tmp_path: Path, text: str) -> None:
    path = tmp_path / "a.json"
    path.write_text(text)
    with pytest.raises(FormatError, match=r"a\.json: not (a list of )?records"):
        results.load([path])


@pytest.mark.parametrize(
    "text",
    [
        "nothing",
        "<!-- encode: end --><!-- encode: begin -->",
        "<!-- encode: begin -->",
        "<!-- encode: begin --><!-- encode: end -->" * 2,
        "<!-- other: begin --><!-- other: end -->",
    ],
)
def test_documents_without_paired_markers_are_refused(tmp_path: Path, text: str) -> None:
    document = tmp_path / "a.md"
    document.write_text(text)
    with pytest.raises(FormatError, match="needs lines such as"):
        results.marked_names(document)


@pytest.mark.parametrize(
    ("document", "records"),
    [
        ("README.md", "*.json"),
        ("docs/benchmarks.md", "*.json"),
        ("docs/benchmarks-earlier.md", "earlier/*.json"),
    ],
)
def test_committed_records_give_the_tables_of_the_documents(document: str, records: str) -> None:
    root = Path(__file__).parents[2]
    text, files = (root / document).read_text(), sorted((root / "docs" / "bench").glob(records))
    assert files and results.with_tables(text, results.load(files)) == text


def test_the_records_of_the_readme_come_from_one_commit() -> None:
    files = (Path(__file__).parents[2] / "docs" / "bench").glob("*.json")
    assert len({record["commit"] for record in results.load(files)}) == 1
