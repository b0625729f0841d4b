import json
from pathlib import Path

import pytest

from kpc.format.errors import FormatError
from kpc.tools import results

MACHINE = {"cpu": "Test CPU", "cores": 2, "memory_bytes": 8 << 30, "os": "Linux", "python": "3.11"}


def encode_record(name: str, psnrs: list[float | None], **changes: object) -> results.Record:
    run: results.Record = dict(
        test_ssim=0.9, size_bytes=345678, bits_per_parameter=1.25, identity_share=None, coding_loss_db=0.1
    )
    run |= dict(train_s=100.0, encode_s=120.0, rays_per_s=23456.0, peak_memory_bytes=9e8)
    record: results.Record = dict(
        kind="encode", name=name, commit="0123456789abcdef", command=f"kpbench encode {name}", renderer="cpu"
    )
    record |= dict(machine=MACHINE, settings={"preset": "fast"}, repeats=[run | {"test_psnr": psnr} for psnr in psnrs])
    return record | changes


def test_a_cell_is_the_median_of_the_repeats_that_have_it() -> None:
    record = encode_record("room", [30.0, None, 32.0, 33.0])
    assert results.median(record, "test_psnr") == 32.0
    assert results.median(record, "identity_share") is None
    head, row = results.cells("encode", [record])
    assert dict(zip(head, row))["PSNR dB"] == "32.00" and dict(zip(head, row))["identity"] == "-"
    assert dict(zip(head, row))["file KB"] == "346" and dict(zip(head, row))["rays/s"] == "23,456"


def test_tables_are_split_by_machine_and_say_where_they_come_from() -> None:
    other = encode_record("liam", [28.0], machine=MACHINE | {"cores": 64}, commit="f" * 40 + "+dirty")
    text = results.markdown([encode_record("room", [30.0, 31.0]), other, encode_record("fox", [20.0, 21.0])])
    first, second = text.split("**Encoding**")[1:]
    assert "Test CPU, 2 cores, 8 GiB" in first and "| room | fast | 30.50 |" in first and "| fox |" in first
    assert "Commit 012345678; median of 2 runs; `kpbench encode room`; `kpbench encode fox`." in first
    assert "64 cores" in second and "Commit fffffffff+dirty; median of 1 run;" in second


def test_in_brief_only_the_default_quality_and_the_reference_are_shown() -> None:
    accuracy = dict.fromkeys(("samples_per_ray", "psnr", "psnr_least", "psnr_turning", "within_one_level"), 0.5)
    each = [
        encode_record("room", [30.0], kind="player", accuracy=accuracy,
                      settings={"quality": quality, "default": "balanced", "size": "320x240"})
        for quality in ("fast", "balanced", "fine", "reference")
    ]  # fmt: skip
    every, few = (results.markdown([*each, encode_record("liam", [1.0])], brief) for brief in (False, True))
    assert every.count("| room |") == 4 and few.count("| room |") == 2 and few.count("| liam |") == 1
    assert "| balanced (default) |" in few and "| reference |" in few


def test_the_block_of_a_readme_is_rewritten_and_nothing_else(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    readme, records = tmp_path / "README.md", tmp_path / "a.json"
    readme.write_text(f"before\n\n{results.BEGIN}\nold\n{results.END}\n\nafter\n")
    records.write_text(json.dumps([encode_record("room", [30.0])]))
    for _ in range(2):
        assert results.main([str(records), "--readme", str(readme)]) == 0
    text = readme.read_text()
    assert text.startswith(f"before\n\n{results.BEGIN}\n\n**Encoding**") and text.endswith(
        f"\n\n{results.END}\n\nafter\n"
    )
    assert "old" not in text and text.count("| room |") == 1


@pytest.mark.parametrize("text", ["", "{}", "[1]", '[{"kind": "other"}]', '[{"kind": "encode"}]'])
def test_other_files_are_refused_by_name(tmp_path: Path, text: str) -> None:
    path = tmp_path / "a.json"
    path.write_text(text)
    with pytest.raises(FormatError, match=r"a\.json: not records of kpbench"):
        results.load([path])


def test_a_readme_without_markers_is_left_alone(tmp_path: Path) -> None:
    readme = tmp_path / "README.md"
    for text in ("nothing", f"{results.END}{results.BEGIN}", results.BEGIN, f"{results.BEGIN}{results.END}" * 2):
        readme.write_text(text)
        with pytest.raises(FormatError, match="needs the lines"):
            results.rewrite(readme, "new")
        assert readme.read_text() == text


def test_committed_records_make_the_tables_of_the_readme() -> None:
    root = Path(__file__).parent.parent
    files = sorted((root / "docs" / "bench").glob("*.json"))
    if not files:
        pytest.skip("docs/bench holds no records yet")
    assert results.markdown(results.load(files), brief=True) in (root / "README.md").read_text()
