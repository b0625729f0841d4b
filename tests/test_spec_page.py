"""The page of the format agrees with itself, with the readable decoder, and with the package."""

import re
import struct
import sys
from pathlib import Path

import numpy as np
import pytest
from decoder import container, trace, transform

from kpc.encoder.coding import rans
from kpc.format.coding import poses
from kpc.format.container import container as package_container
from kpc.format.container import metadata_chunk, scene_layout, sound_chunk
from kpc.format.core import decoding
from kpc.format.scene import scene, sound, space

SPEC = Path(__file__).parent.parent / "spec"

PAGE = (SPEC / "kpc-format.md").read_text()
LINES = PAGE.splitlines()
HEADINGS = [re.fullmatch(r"(#{2,3}) (\d+(?:\.\d+)?)\.? (.*)", line) for line in LINES if re.match(r"#{2,3} \d", line)]
TYPES = {
    "char": "s",
    "i8": "b",
    "u8": "B",
    "i32": "i",
    "u16": "H",
    "u32": "I",
    "u64": "Q",
    "f32": "f",
    "f64": "d",
}


def section(number: str) -> str:
    """Return the text of a section or subsection."""
    starts = {match[2]: PAGE.index(match[0]) for match in HEADINGS if match}
    later = [at for name, at in starts.items() if at > starts[number] and not name.startswith(f"{number}.")]
    return PAGE[starts[number] : min(later, default=len(PAGE))]


def byte_tables(text: str) -> list[struct.Struct]:
    """Return the structure of each byte table of a text; its byte column must add up."""
    found = []
    for block in re.findall(r"(?:^\|.*\n)+", text, re.M):
        rows = [[cell.strip() for cell in line.strip("|").split("|")] for line in block.splitlines()]
        if rows[0][:2] != ["byte", "type"]:
            continue
        layout = "<"
        for position, kind, *_ in rows[2:]:
            assert struct.calcsize(layout) == int(position), (kind, position)
            name, count = re.fullmatch(r"(\w+?)(?:\[(\d+)\])?", kind).groups()
            layout += (count or "") + TYPES[name]
        found.append(struct.Struct(layout))
    return found


def spelled(structure: struct.Struct) -> str:
    """Return a format in which "2f" is written "ff"."""
    return re.sub(r"(\d+)([a-rt-zA-Z])", lambda match: match[2] * int(match[1]), structure.format)


def numbers_after(label: str, count: int) -> list[int]:
    """Return the first numbers that follow a label in section 7.5."""
    text = section("7.5")
    assert text.count(label) == 1, label
    return [int(number) for number in re.findall(r"\d+", text.split(label)[1])[:count]]


def test_no_line_exceeds_120_columns():
    assert [line for line in LINES if len(line) > 120] == []


def test_links_lead_to_headings_and_files():
    slugs = {re.sub(r"[^\w\- ]", "", line.lstrip("# ").lower()).replace(" ", "-") for line in LINES if line[:1] == "#"}
    for target in re.findall(r"\]\(([^)]+)\)", PAGE):
        assert target[1:] in slugs if target.startswith("#") else (SPEC / target).exists(), target


def test_every_section_is_in_the_contents_and_numbered_in_order():
    contents = PAGE.split("## Contents")[1].split("\n## ")[0]
    numbers = [match[2] for match in HEADINGS]
    tops = [number for number in numbers if "." not in number]
    assert tops == [str(number) for number in range(1, len(tops) + 1)]
    for top in tops:
        under = [number for number in numbers if number.startswith(f"{top}.")]
        assert under == [f"{top}.{number}" for number in range(1, len(under) + 1)]
    assert re.findall(r"^(\d+)\. \[", contents, re.M) == tops


def test_references_name_sections_that_exist():
    numbers = {match[2] for match in HEADINGS}
    for listed in re.findall(r"[Ss]ections? ((?:\d+(?:\.\d+)?(?:, | and | to )?)+)", PAGE):
        for number in re.findall(r"\d+(?:\.\d+)?", listed):
            assert number in numbers, number
    count = len(re.findall(r"^\d+\. ", section("15"), re.M))
    assert {int(number) for number in re.findall(r"[ (]\[(\d+)\]", PAGE)} == set(range(1, count + 1))


def test_sources_refer_to_sections_by_their_titles():
    root = SPEC.parent
    titles = {match[3] for match in HEADINGS}
    found = set()
    for folder in ("encoder", "format", "player", "tools", "tests"):
        for path in (root / folder).rglob("*.py"):
            for title in re.findall(r'kpc-format\.md,\s+"([^"]+)"', path.read_text()):
                found.add(" ".join(title.split()))
    assert found and found <= titles


def test_header_and_index_tables_are_those_of_the_readable_decoder():
    assert [spelled(table) for table in byte_tables(section("4.1"))] == [spelled(container.HEADER)]
    assert [spelled(table) for table in byte_tables(section("4.2"))] == [spelled(container.ENTRY)]


@pytest.mark.parametrize(
    "number, sizes",
    {
        "6.1": [58, 10],
        "6.2": [12, 116],
        "6.3": [12],
        "6.4": [8],
        "6.5": [8, 10],
        "6.6": [68],
        "6.9": [9],
        "8.4": [17],
    }.items(),
)
def test_sizes_in_the_text_are_those_of_the_tables(number, sizes):
    assert [table.size for table in byte_tables(section(number))] == sizes
    if number != "8.4":
        assert [int(size) for size in re.findall(r"\b(\d+) bytes\b", section(number))] == sizes


def test_structures_are_those_of_the_package():
    expected = {
        "6.1": [scene_layout.SCENE_STRUCT, scene_layout.SCALE_STRUCT],
        "6.2": [scene_layout.WARP_STRUCT, scene_layout.NDC_STRUCT],
        "6.3": [scene_layout.MOTION_STRUCT],
        "6.4": [scene_layout.OCCUPANCY_STRUCT],
        "6.5": [scene_layout.DECODER_STRUCT, scene_layout.HYBRID_STRUCT],
        "6.6": [scene_layout.CAMERA_STRUCT],
        "6.7": [scene_layout.APPEARANCE_STRUCT],
        "6.9": [sound_chunk.SOUND_STRUCT],
        "8.4": [poses.HEAD],
    }
    for number, structures in expected.items():
        assert [spelled(table) for table in byte_tables(section(number))] == [spelled(one) for one in structures]


def test_container_is_that_of_the_package():
    assert spelled(package_container.HEADER) == spelled(container.HEADER)
    assert spelled(package_container.ENTRY) == spelled(container.ENTRY)
    assert [(codec.name, codec.value) for codec in package_container.Codec] == [
        (name, int(number)) for number, name in re.findall(r"^\| (\d) \| ([A-Z]+) \|", section("4.4"), re.M)
    ]
    assert {kind.decode() for kind in container.CODECS} == scene_layout.KNOWN_KINDS
    assert f"1 to {package_container.INDEX_BYTES} + {package_container.INDEX_BYTES_PER_CHUNK} x" in section("4.1")
    assert f"48 + {package_container.MIN_CHUNK_BYTES} x chunk_count" in section("4.1")
    assert PAGE.startswith(f"# The .kpc format, version {package_container.VERSION}\n")


def test_limits_are_those_of_the_package():
    rows = re.findall(r"^\| ([A-Z_]+) \| (\d+) \|", section("11.1"), re.M)
    code = {
        name: int(value)
        for module in (package_container, scene_layout, metadata_chunk, sound_chunk)
        for name, value in vars(module).items()
        if name.endswith("_LIMIT") and name != "HEAD_LIMIT"
    }
    assert {name: int(value) for name, value in rows} == code
    assert set(re.findall(r"\b[A-Z]+_LIMIT\b", PAGE)) == set(code)


def test_numbers_in_the_text_are_those_of_the_package():
    assert package_container.MAGIC.hex(" ").upper() in section("4.1")
    numbered = ", ".join(f"{number} `{name}`" for number, name in enumerate(scene.ALL_PLANES))
    assert numbered in section("4.2")
    assert f"differ by less than {scene_layout.FRAME_TOLERANCE:.4f}" in section("6.2")
    assert f"component[i] - {poses.NOTHING}" in section("8.4") and f"D = {poses.ROOT}^2" in section("8.4")
    assert f"-{scene.LOG_DENSITY_LIMIT:.0f}, {scene.LOG_DENSITY_LIMIT:.0f}" in section("9.5")
    assert f"clamp(a, 0, {scene.ACTIVATION_LIMIT:.0f})" in section("9.5")
    assert f"T < 1/{1 / scene.TERMINATION:.0f}" in section("9.6")
    assert f"(2 - 1/{space.FAR:.0f}) uniform_distance" in section("9.6")
    assert f"farther than {space.FAR:.0f} uniform_distance" in section("9.7")
    assert f"d_z <= {space.MIN_FORWARD:.4f}" in section("9.8")
    assert f"min(s / reach, {1 - space.MIN_DISPARITY})" in section("9.8")
    assert f"{sound.SAMPLE_RATE} samples per second" in section("6.9")
    assert f"pre_skip + n -\n{sound.PRE_ROLL}" in section("6.9")
    assert f"1 .. {sound.PACKET_SAMPLES_LIMIT}" in section("6.9")
    models = "(32768, 0)", "/ (5 * model.count + 8)", "count + 1, 120"
    assert all(text in section("5.3") for text in models) and rans.ADAPTATION_LIMIT == 120


def test_codecs_and_kinds_are_those_of_the_readable_decoder():
    rows = re.findall(r"^\| (\d) \| ([A-Z]+) \| ([\w, ]+) \|", section("4.4"), re.M)
    assert [int(number) for number, *_ in rows] == list(range(9))
    for number, name, kinds in rows:
        assert getattr(container, name) == int(number)
        if int(number) > container.ZSTD:
            known = {kind.decode() for kind, codecs in container.CODECS.items() if int(number) in codecs}
            assert known == set(kinds.split(", "))
    kinds = re.findall(r"^\| ([A-Za-z]{4}) \|", section("4.3"), re.M)
    assert {kind for kind in kinds if kind != "kind"} == {kind.decode() for kind in container.CODECS} | {"GRUP"}


def test_transform_tables_are_those_of_their_formulas_and_of_the_readable_decoder():
    k = np.arange(17)
    assert numbers_after("64 sqrt(2)^(3 - k):", 8) == transform.OFFSET_SCALE
    assert np.rint(64 * np.sqrt(2) ** (3.0 - k[:8])).tolist() == transform.OFFSET_SCALE
    for N, scale in transform.FREQUENCY_SCALE.items():
        assert numbers_after(f"N = {N}:", N) == scale
        assert np.rint(64 / np.sqrt(1 + np.cos(np.pi * k[:N] / N) / 2)).tolist() == scale
    assert numbers_after("128 sqrt(2) cos(pi k / 32):", 17) == transform.COSINE
    assert np.rint(128 * np.sqrt(2) * np.cos(np.pi * k / 32)).tolist() == transform.COSINE
    usual, dc = section("7.5").split("level_model for frequency_class 8")
    titles = "number 0", "number 1", "numbers 2 to 5"
    for title, prior, of_dc in zip(titles, transform.LEVEL_PRIOR, transform.DC_PRIOR, strict=True):
        assert [int(number) for number in usual.split(f" {title} ")[1].split()[:16]] == prior
        assert int(dc.split(f" {title} ")[1].split()[0]) == of_dc
    assert numbers_after("sign_model for sign_class 0 .. 19:", 20) == transform.SIGN_PRIOR


def test_worked_examples_are_what_the_readable_decoder_does():
    assert trace.PREDICTIVE_EXAMPLE.hex(" ") in section("13.2")
    assert trace.TRANSFORM_EXAMPLE.hex(" ") in section("13.3")
    for number, tables in (("13.2", trace.predictive_example()), ("13.3", trace.transform_example())):
        for table in tables:
            assert table in section(number)


def test_the_package_decodes_the_worked_examples():
    for codec, body, rows, columns in (
        (container.PREDICTIVE, trace.PREDICTIVE_EXAMPLE, 2, 3),
        (container.TRANSFORM, trace.TRANSFORM_EXAMPLE, 4, 8),
    ):
        _, expected = trace.traced_segment(codec, body, rows, columns)
        symbols, coded = decoding.decode_segment(codec, body, rows, columns, 1)
        assert {(y, x, 0): int(symbols[y, x, 0]) for y, x in np.argwhere(coded).tolist()} == expected


def test_the_hex_dump_is_the_minimal_vector():
    rows = re.findall(r"^    ([0-9a-f]{4})  ((?:[0-9a-f]{2} ?)+)$", section("13.1"), re.M)
    data = b"".join(bytes.fromhex(row) for _, row in rows)
    assert [int(at, 16) for at, _ in rows] == list(range(0, len(data), 16))
    assert data == (SPEC / "vectors" / "valid" / "minimal.kpc").read_bytes()
    assert f"{len(data)} bytes" in section("13.1")
    for entry in package_container.Reader(data).index:
        assert f"0x{entry.offset:x}" in section("13.1")


def test_the_trace_of_a_file_leaves_the_decoder_as_it_was():
    assert container is sys.modules["decoder.container"]
    plain = sys.modules["decoder.entropy"].EntropyDecoder
    trace.predictive_example()
    assert sys.modules["decoder.planes"].EntropyDecoder is plain
    assert sys.modules["decoder.payloads"].EntropyDecoder is plain
