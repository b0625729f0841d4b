"""The conformance vectors, the readable decoder and the package agree."""

import dataclasses
import hashlib
import json
import struct
from pathlib import Path

import decoder.__main__
import decoder.trace
import numpy as np
import pytest
import zstandard
from decoder.common import crc32c
from decoder.container import ENTRY, HEADER
from decoder.entropy import EntropyDecoder

from kpc.encoder.coding import scene_writer
from kpc.format.coding.quantise import quantise_scene
from kpc.format.common import errors
from kpc.format.container import container, groups, metadata_chunk, scene_io
from kpc.player.cpu import reference
from kpc.tools.vectors import specvectors
from kpc.tools.vectors.description import ZSTD_VERSION, described
from scenes import VARIANTS, tiny_scene

SPEC = Path(__file__).parent.parent / "spec"

VECTORS = SPEC / "vectors"
MANIFEST = json.loads((VECTORS / "manifest.json").read_text())
GROUPED = sorted(name for name, expected in MANIFEST["valid"].items() if "groups" in expected)
VALID = sorted(set(MANIFEST["valid"]) - set(GROUPED))
INVALID = sorted(MANIFEST["invalid"])

RAY_TOLERANCE = 1e-4  # section 14 of the page


def valid_vector(name: str) -> tuple[dict, bytes]:
    """Return the manifest's entry and the bytes of a valid vector."""
    return MANIFEST["valid"][name], (VECTORS / "valid" / f"{name}.kpc").read_bytes()


def sha256(data: bytes | np.ndarray) -> str:
    return hashlib.sha256(data if isinstance(data, bytes) else np.ascontiguousarray(data).tobytes()).hexdigest()


def assert_described(found: dict, expected: dict) -> None:
    """Assert that two entries are equal, rays within their tolerance, whichever library packed the file."""
    ignored = dict.fromkeys(("rays", "zstd", "sha256"))
    assert {**found, **ignored} == {**expected, **ignored}
    for one, other in zip(found["rays"], expected["rays"], strict=True):
        for key in ("rgb", "opacity", "depth"):
            assert one[key] == pytest.approx(other[key], abs=RAY_TOLERANCE), key


@pytest.mark.parametrize("name", VALID + GROUPED)
def test_valid_vectors_have_the_bytes_of_the_manifest(name):
    expected, data = valid_vector(name)
    assert sha256(data) == expected["sha256"]


@pytest.mark.parametrize("name", VALID)
def test_package_decodes_valid_vectors_to_the_manifest(name):
    expected, data = valid_vector(name)
    assert_described(described(data, expected["partial"]), expected)


@pytest.mark.parametrize("name", VALID)
def test_readable_decoder_decodes_valid_vectors_to_the_manifest(name):
    expected, data = valid_vector(name)
    scene = decoder.decode(data, expected["partial"])
    for key in ("frame_count", "fps", "background", "ray_step", "uniform_distance", "near", "baseline"):
        assert scene.get(key) == expected.get(key), key
    assert [list(corner) for corner in scene["aabb"]] == expected["aabb"]
    assert len(expected["planes"]) == len(decoder.hashes(scene))
    for plane in expected["planes"]:
        hashes = plane["symbols_sha256"], plane["coded_sha256"], plane["values_sha256"]
        assert decoder.hashes(scene)[plane["scale"], plane["plane"]] == hashes
    assert list(scene["cells"]) == expected["occupancy"]["shape"]
    assert sha256(bytes(scene["occupancy"])) == expected["occupancy"]["sha256"]
    cameras = np.array(scene["cameras"], "<f8")
    assert {"count": len(cameras), "sha256": sha256(cameras)} == expected["cameras"]
    assert_weights(scene, expected["decoder"])
    assert_motion_and_appearances(scene, expected)
    assert scene["metadata"] == expected.get("metadata", {})
    assert_sound(scene["sound"], expected.get("sound"))


def assert_sound(found: dict | None, expected: dict | None) -> None:
    if found is not None:
        packets = found["packets"]
        lengths = np.array([len(packet) for packet in packets], "<u2").tobytes()
        found = {**found, "packets": len(packets), "sha256": sha256(lengths + b"".join(packets))}
    assert found == expected


def assert_weights(scene: dict, expected: dict) -> None:
    hybrid = ("v", "v_bias", "density_weight", "density_bias", "w1", "b1", "u", "w2", "b2")
    names = hybrid if "width" in expected else [name for name in hybrid if name not in ("v", "v_bias", "u")]
    weights = np.concatenate([np.ravel(scene[name]) for name in names]).astype("<f4")
    assert sha256(weights) == expected["sha256"]
    assert (scene["width"], scene["hidden"]) == (expected.get("width", 0), expected["hidden"])


def assert_motion_and_appearances(scene: dict, expected: dict) -> None:
    assert (scene["motion"] is None) == ("motion" not in expected)
    if "motion" in expected:
        assert [*scene["motion"]["size"], 3] == expected["motion"]["shape"]
        assert sha256(np.array(scene["motion"]["displacements"], "<f4")) == expected["motion"]["sha256"]
    embeddings = np.array(list(scene["appearances"].values()), "<f4")
    assert len(embeddings) == expected.get("appearances", {"count": 0})["count"]
    if "appearances" in expected:
        assert sha256("".join(scene["appearances"]).encode()) == expected["appearances"]["names_sha256"]
        assert sha256(embeddings) == expected["appearances"]["sha256"]


@pytest.mark.parametrize("name", VALID)
def test_readable_decoder_renders_the_rays_of_the_manifest(name):
    expected, data = valid_vector(name)
    scene = decoder.decode(data, expected["partial"])
    for ray in expected["rays"]:
        view = ray["origin"], ray["direction"], ray["time"], ray.get("appearance")
        rgb, opacity, depth = decoder.render_ray(scene, *view)
        assert rgb == pytest.approx(ray["rgb"], abs=RAY_TOLERANCE)
        assert opacity == pytest.approx(ray["opacity"], abs=RAY_TOLERANCE)
        assert (None if depth == float("inf") else depth) == pytest.approx(ray["depth"], abs=RAY_TOLERANCE)


@pytest.mark.parametrize("name", INVALID)
def test_package_refuses_invalid_vectors_as_the_manifest_says(name):
    expected, path = MANIFEST["invalid"][name], VECTORS / "invalid" / f"{name}.kpc"
    with pytest.raises(getattr(errors, expected["error"])) as caught:
        opened = groups.Groups(path)
        for number in range(len(opened)):
            scene_io.read(opened.open(number))
    assert type(caught.value).__name__ == expected["error"]
    assert expected["message"] in str(caught.value)
    assert str(path) in str(caught.value) and "\n" not in str(caught.value)


@pytest.mark.parametrize("name", INVALID)
def test_readable_decoder_refuses_invalid_vectors(name):
    data = (VECTORS / "invalid" / f"{name}.kpc").read_bytes()
    with pytest.raises(decoder.Refused) as caught:
        if decoder.decode_groups(data) is None:
            decoder.decode(data)
    if name.startswith("draft"):
        assert str(caught.value) == "a draft of the format; encode it again"


@pytest.mark.parametrize("name", GROUPED)
def test_groups_hold_the_vectors_of_the_manifest(name):
    expected, data = valid_vector(name)
    opened = groups.Groups(VECTORS / "valid" / f"{name}.kpc", allow_partial=expected["partial"])
    listed, scenes = decoder.decode_groups(data, expected["partial"])
    spans = [(group["row_start"], group["row_count"]) for group in expected["groups"]]
    assert [(span.start, span.count) for span in opened.timeline.spans] == spans
    assert [group[:2] for group in listed] == spans
    decoded = iter(scenes)
    for number, (group, (*_, content)) in enumerate(zip(expected["groups"], listed, strict=True)):
        assert opened.available(number) == (group["scene"] is not None)
        if group["scene"] is not None:
            alone, data = valid_vector(group["scene"])
            scene, read = next(decoded), scene_io.read(opened.open(number))
            assert read.clip.frame_count == scene["frame_count"]
            if content != data:  # some of its planes lie beside it
                assert name.startswith("groups-shared")
                hashes = [(p["symbols_sha256"], p["coded_sha256"], p["values_sha256"]) for p in alone["planes"]]
                assert list(decoder.hashes(scene).values()) == hashes
                planes = [plane for scale in read.scales for plane in scale.values()]
                assert [(sha256(p.symbols), sha256(p.coded), sha256(p.dequantise())) for p in planes] == hashes
    assert len(scenes) == sum(group["scene"] is not None for group in expected["groups"])
    assert opened.metadata().document == expected.get("metadata", {})


@pytest.mark.parametrize("name", GROUPED)
def test_groups_are_shown_and_blended_as_the_manifest_says(name):
    expected, _ = valid_vector(name)
    opened = groups.Groups(VECTORS / "valid" / f"{name}.kpc", allow_partial=expected["partial"])
    spans = [(group["row_start"], group["row_count"]) for group in expected["groups"]]
    for moment in expected["times"]:
        number, local_time = opened.timeline.at(moment["time"])
        shown, shown_time = decoder.shown_group(spans, moment["time"])
        assert number == shown == moment["group"]
        assert local_time == pytest.approx(moment["local_time"], abs=1e-6)
        assert shown_time == pytest.approx(local_time, abs=1e-9)
        weights = {str(part): weight for part, _, weight in opened.timeline.blend_at(moment["time"])}
        assert weights == pytest.approx(moment["blend"], abs=1e-6)
        blended = {str(part): weight for part, weight in decoder.blend(spans, moment["time"]).items()}
        assert blended == pytest.approx(moment["blend"], abs=1e-6)


@pytest.mark.parametrize("held_bytes", [0, 20, 60])  # of group 1: nothing, a part of its header, a part of its index
def test_a_clip_cut_off_at_the_head_of_a_group_keeps_the_groups_before_it(held_bytes):
    expected, data = valid_vector("groups")
    start = container.Reader(data).index[1].offset
    data = data[: start + held_bytes]
    opened = groups.Groups(data, allow_partial=True)
    assert [opened.available(number) for number in range(len(opened))] == [True, False, False, False]
    assert scene_io.read(opened.open(0)).clip.frame_count == expected["groups"][0]["row_count"]
    with pytest.raises(errors.FormatError):
        opened.open(1)
    listed, scenes = decoder.decode_groups(data, True)
    assert len(listed) == 4 and len(scenes) == 1


def test_vectors_on_disk_are_those_of_their_generator():
    made = specvectors.vectors()
    on_disk = {str(path.relative_to(VECTORS)) for path in VECTORS.rglob("*") if path.is_file()}
    assert on_disk == set(made)
    manifest = json.loads(made["manifest.json"])
    assert manifest["invalid"] == MANIFEST["invalid"]
    assert set(manifest["valid"]) == set(MANIFEST["valid"])
    for name, found in manifest["valid"].items():
        expected, data = valid_vector(name)
        if "groups" in found:
            assert {**found, "sha256": 0} == {**expected, "sha256": 0}
        else:
            assert_described(found, expected)
        if expected.get("zstd") in (None, ZSTD_VERSION):
            assert made[f"valid/{name}.kpc"] == data, name
    for name in MANIFEST["invalid"]:
        assert made[f"invalid/{name}.kpc"] == (VECTORS / "invalid" / f"{name}.kpc").read_bytes(), name
    assert sum(map(len, made.values())) < 850_000


def test_schema_of_metadata_is_that_of_the_package():
    assert json.loads((SPEC / "meta.schema.json").read_text()) == metadata_chunk.SCHEMA


def test_drafts_are_among_the_invalid_vectors():
    drafts = [name for name in INVALID if name.startswith("draft")]
    assert len(drafts) >= 3
    assert all("encode it again" in MANIFEST["invalid"][name]["message"] for name in drafts)


def test_valid_vectors_cover_every_kind_under_every_codec():
    files = [decoder.container.read_chunks(valid_vector(name)[1], True)[0] for name in VALID + GROUPED]
    whole = [chunk.stored for chunks in files for chunk in chunks if chunk.kind == b"GRUP" and chunk.is_whole]
    files += [decoder.container.read_chunks(group, False)[0] for group in whole]
    found = {(chunk.kind.decode(), chunk.codec) for chunks in files for chunk in chunks}
    known = decoder.container.CODECS.items()
    expected = {(kind.decode(), codec) for kind, codecs in known for codec in (0, 1, *codecs)}
    assert found >= expected | {("GRUP", 0)}


def test_valid_vectors_cover_every_context_and_size_of_residuals(monkeypatch):
    """No residual is large enough for the last three of the 66 contexts of planes."""
    contexts, sizes, inner = set(), set(), EntropyDecoder.signed

    def signed(decisions, context, unary, escape):
        residual = inner(decisions, context, unary, escape)
        contexts.add(context)
        size = residual if abs(residual) <= 4 else (abs(residual) - 4).bit_length() + 4
        sizes.add((context[0], size, residual > 0))
        return residual

    monkeypatch.setattr(EntropyDecoder, "signed", signed)
    for name in VALID:
        if name.startswith(("predictive", "motion", "limits-nodes")):
            expected, data = valid_vector(name)
            decoder.decode(data, expected["partial"])
    planes = {("residual", context) for context in range(63)}
    motion = {("motion", context) for context in range(20)}
    assert {context for context in contexts if context[0] in ("residual", "motion")} == planes | motion
    for name, escape in (("residual", 7), ("motion", 15)):
        of_each_sign = {(name, size, False) for size in range(-4, 1)} | {(name, size, True) for size in range(1, 5)}
        escapes = {(name, 4 + bits, positive) for bits in range(1, escape + 2) for positive in (False, True)}
        assert sizes >= of_each_sign | escapes


def test_commands_of_the_readable_decoder_print_hashes_and_decisions(capsys):
    path = str(VECTORS / "valid" / "predictive.kpc")
    decoder.__main__.main(path)
    expected, data = valid_vector("predictive")
    printed = capsys.readouterr().out
    assert all(plane["symbols_sha256"] in printed for plane in expected["planes"])
    chunks, _ = decoder.container.read_chunks(data, False)
    number = next(number for number, chunk in enumerate(chunks) if chunk.codec == decoder.container.PREDICTIVE)
    decoder.trace.main([path, str(number)])
    rows = capsys.readouterr().out.splitlines()
    assert rows[0].startswith("| number | model |") and rows[-1].endswith("| 10000 |")


def file_of(chunks: list[decoder.container.Chunk], value_count: int) -> bytes:
    """Return the file of these chunks."""
    entries = b"".join(ENTRY.pack(*dataclasses.astuple(chunk)[:-1]) for chunk in chunks)
    index = zstandard.ZstdCompressor().compress(b"".join(entries[byte :: ENTRY.size] for byte in range(ENTRY.size)))
    stored = b"".join(chunk.stored for chunk in chunks)
    sizes = len(chunks), len(index), crc32c(index), HEADER.size + len(index) + len(stored), value_count
    largest_raw = max(chunk.raw_length for chunk in chunks)
    header = HEADER.pack(b"\x89KPC\r\n\x1a\n", 1, HEADER.size, *sizes, largest_raw, 0)[:-4]
    return header + struct.pack("<I", crc32c(header)) + index + stored


def test_a_file_has_65536_chunks_at_most():
    _, minimal = valid_vector("minimal")
    chunks, value_count = decoder.container.read_chunks(minimal, False)
    note = decoder.container.Chunk(b"note", 0, 0, 0, 0, 0, 0, 8, 8, crc32c(bytes(8)), bytes(8))
    most = file_of(chunks + [note] * (65536 - len(chunks)), value_count)
    assert len(container.Reader(most).index) == 65536
    assert scene_writer.encode(scene_io.read(most)) == scene_writer.encode(scene_io.read(minimal))
    assert decoder.hashes(decoder.decode(most)) == decoder.hashes(decoder.decode(minimal))
    more = file_of(chunks + [note] * (65537 - len(chunks)), value_count)
    with pytest.raises(errors.FormatError, match="65537 chunks"):
        container.Reader(more)
    with pytest.raises(decoder.Refused, match="number of chunks"):
        decoder.decode(more)


@pytest.mark.parametrize("variant", VARIANTS)
def test_readable_decoder_renders_a_scene_as_the_reference_does(variant):
    scene = VARIANTS[variant](tiny_scene(scales=1, channels=4, resolution=(10, 8, 6), time=4))
    data = scene_writer.encode(quantise_scene(scene, [dict.fromkeys(scene.scales[0], 0.01)]))
    decoded = decoder.decode(data)
    origins, directions = scene.cameras[0].resized(8, 6).rays()
    expected = reference.render_rays(scene_io.read(data).dequantise(), origins, directions, 0.3)
    for number, (origin, direction) in enumerate(zip(origins.tolist(), directions.tolist(), strict=True)):
        rgb, opacity, _ = decoder.render_ray(decoded, origin, direction, 0.3)
        assert np.abs(expected.rgb[number] - rgb).max() < 1 / 255
        assert abs(expected.opacity[number] - opacity) < 1 / 255
