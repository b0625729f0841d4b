"""The vectors, the decoder written from the page, and the package agree."""

import hashlib
import importlib.util
import json
from pathlib import Path
from types import ModuleType

import numpy as np
import pytest
from kpc.format.common import errors
from kpc.format.container import container, groups, scene_io
from kpc.player.cpu import reference
from kpc.tools.vectors import specvectors
from scenes import VARIANTS, tiny_scene

SPEC = Path(__file__).parent.parent / "spec"
GROUPED = sorted((SPEC / "vectors" / "valid").glob("*groups*.kpc"))
VALID = sorted(set((SPEC / "vectors" / "valid").glob("*.kpc")) - set(GROUPED))
INVALID = sorted((SPEC / "vectors" / "invalid").glob("*.kpc"))

RAY_TOLERANCE = 1e-4  # section 16


@pytest.fixture(scope="module")
def twin() -> ModuleType:
    """spec/decoder.py, which knows the page but not the package."""
    loader = importlib.util.spec_from_file_location("kpc_spec_decoder", SPEC / "decoder.py")
    module = importlib.util.module_from_spec(loader)
    loader.loader.exec_module(module)
    return module


@pytest.mark.parametrize("path", VALID, ids=lambda p: p.stem)
def test_valid_vectors_decode_to_what_is_written(path):
    expected = json.loads(path.with_suffix(".json").read_text())
    found = specvectors.described(path.read_bytes(), expected["partial"])
    assert_described(found, expected)


@pytest.mark.parametrize("path", VALID, ids=lambda p: p.stem)
def test_the_decoder_written_from_the_page_agrees(path, twin):
    expected = json.loads(path.with_suffix(".json").read_text())
    scene = twin.decode(path.read_bytes(), expected["partial"])
    for plane in expected["planes"]:
        assert twin.hashes(scene)[plane["scale"], plane["plane"]] == (
            plane["symbols_sha256"],
            plane["coded_sha256"],
            plane["values_sha256"],
        )
    occupied = np.array(scene["occupancy"], np.uint8).reshape(*scene["cells"][::-1], scene["slots"])
    occupied = np.ascontiguousarray(np.moveaxis(occupied, -1, 0))
    assert list(occupied.shape) == expected["occupancy"]["shape"]
    assert hashlib.sha256(occupied.tobytes()).hexdigest() == expected["occupancy"]["sha256"]
    if "motion" in expected:
        values = np.array(scene["motion"]["values"], "<f4")
        assert [*scene["motion"]["size"], 3] == expected["motion"]["shape"]
        assert hashlib.sha256(values.tobytes()).hexdigest() == expected["motion"]["sha256"]
    else:
        assert scene["motion"] is None
    cameras = np.array(scene["cameras"], "<f8")
    assert {"count": len(cameras), "sha256": hashlib.sha256(cameras.tobytes()).hexdigest()} == expected["cameras"]
    if "appearances" in expected:
        codes = np.array(list(scene["appearances"].values()), "<f4")
        assert (
            hashlib.sha256("".join(scene["appearances"]).encode()).hexdigest()
            == expected["appearances"]["names_sha256"]
        )
        assert hashlib.sha256(codes.tobytes()).hexdigest() == expected["appearances"]["sha256"]
        assert len(codes) == expected["appearances"]["count"]
    else:
        assert scene["appearances"] == {}
    for ray in expected["rays"]:
        rgb, opacity, depth = twin.render_ray(
            scene, ray["origin"], ray["direction"], ray["time"], ray.get("appearance")
        )
        assert rgb == pytest.approx(ray["rgb"], abs=RAY_TOLERANCE)
        assert opacity == pytest.approx(ray["opacity"], abs=RAY_TOLERANCE)
        if ray["depth"] is None:
            assert depth == float("inf")
        else:
            assert depth == pytest.approx(ray["depth"], abs=RAY_TOLERANCE)


@pytest.mark.parametrize("path", INVALID, ids=lambda p: p.stem)
def test_invalid_vectors_are_refused_as_is_written(path, twin):
    expected = json.loads(path.with_suffix(".json").read_text())
    with pytest.raises(getattr(errors, expected["error"])) as caught:
        read_all(path)
    assert type(caught.value).__name__ == expected["error"]
    assert expected["message"] in str(caught.value)
    assert str(path) in str(caught.value) and "\n" not in str(caught.value)
    with pytest.raises(twin.Refused):
        if twin.groups(path.read_bytes()) is None:
            twin.decode(path.read_bytes())


def read_all(path: Path) -> None:
    opened = groups.Groups(path)
    for number in range(len(opened)):
        scene_io.read(opened.open(number))


@pytest.mark.parametrize("path", GROUPED, ids=lambda p: p.stem)
def test_vectors_of_groups_hold_the_vectors_that_they_say(path, twin):
    expected, data = json.loads(path.with_suffix(".json").read_text()), path.read_bytes()
    opened = groups.Groups(path, allow_partial=expected["partial"])
    theirs, scenes = twin.groups(data, expected["partial"])
    assert (
        [(span.start, span.count) for span in opened.timeline.spans]
        == [place[:2] for place in theirs]
        == [(group["row_start"], group["row_count"]) for group in expected["groups"]]
    )
    for number, (group, (*_, content)) in enumerate(zip(expected["groups"], theirs, strict=True)):
        if group["scene"] is not None:
            assert content == path.with_name(f"{group['scene']}.kpc").read_bytes()
            assert scene_io.read(opened.open(number)).clip.frame_count == scenes[number]["frame_count"]
    assert len(scenes) == sum(group["scene"] is not None for group in expected["groups"])
    for moment in expected["times"]:
        number, time_in_it = opened.timeline.at(moment["time"])
        assert (number, twin.shown([place[:2] for place in theirs], moment["time"])[0]) == (moment["group"],) * 2
        assert time_in_it == pytest.approx(moment["time_in_it"], abs=1e-6)
        shares = {str(part): share for part, _, share in opened.timeline.blend_at(moment["time"])}
        theirs_mixed = twin.mix([place[:2] for place in theirs], moment["time"])
        assert (
            shares
            == pytest.approx(moment["mix"], abs=1e-6)
            == {str(part): share for part, share in theirs_mixed.items()}
        )
        assert twin.shown([place[:2] for place in theirs], moment["time"])[1] == pytest.approx(time_in_it, abs=1e-9)


def test_vectors_are_what_their_maker_makes():
    made = specvectors.vectors()
    on_disk = {str(p.relative_to(SPEC / "vectors")) for p in (SPEC / "vectors").rglob("*") if p.is_file()}
    assert on_disk == set(made)
    for name, content in made.items():
        committed = (SPEC / "vectors" / name).read_bytes()
        if name.startswith("valid/") and name.endswith(".json") and "groups" not in json.loads(content):
            assert_described(json.loads(content), json.loads(committed))
        elif name.endswith(".json") or name.startswith("invalid/") or packed_here(name):
            assert content == committed, name
    assert sum(len(content) for content in made.values()) < 750_000


@pytest.mark.parametrize(
    "name, digest",
    {
        "version-0": "332b031a5b8c07bb5451f6db534829b7548d34a87e6125edd11a70c80040cb42",
        "version-0-symbols": "2836f74ea5ad19d75e12237690d2e54db6430c45b179f6d22bc2c01d78163ecd",
        "version-0-groups": "fd15878b0953fd13abe5fe47c2137bfb160260d5ee51b422a15d62a407021845",
    }.items(),
)
def test_files_of_the_draft_are_kept_as_they_were_made(name, digest):
    data = (SPEC / "vectors" / "valid" / f"{name}.kpc").read_bytes()
    assert hashlib.sha256(data).hexdigest() == digest
    assert container.Reader(data).header.version == 0


def test_a_file_may_have_so_many_chunks_and_no_more(twin, monkeypatch):
    """No vector, for its index takes 2.6 MB: the least file, and after it chunks of nothing that nobody knows."""
    path = SPEC / "vectors" / "valid" / "minimal.kpc"
    reader = container.Reader(path.read_bytes())
    known = [
        container.Chunk(e.kind, [reader.chunk(k)], e.scale, e.plane, e.row_start, e.row_count)
        for k, e in enumerate(reader.index)
    ]
    empty = [container.Chunk("note", [b""])] * (container.CHUNK_LIMIT - len(known))
    data = container.pack([*known, *empty], reader.header.value_count, compress=False)
    assert len(container.Reader(data).index) == 65536
    plain = twin.hashes(twin.decode(path.read_bytes()))
    assert twin.hashes(twin.decode(data)) == plain
    assert scene_io.encode(scene_io.read(data)) == scene_io.encode(scene_io.read(path))
    with pytest.raises(errors.FormatError, match="65537 chunks are more"):
        container.pack([*known, *empty, *empty[:1]], reader.header.value_count, compress=False)
    full = [container.Chunk("note", [bytes(8)])] * len(empty)  # as many in a file of version 2 are no smaller than this
    data = container.pack([*known, *full], reader.header.value_count)
    assert (
        container.Reader(data).header.version == 2
        and len(data) < 9 * 65536
        and len(container.Reader(data).index) == 65536
    )
    assert twin.hashes(twin.decode(data)) == plain
    assert container.Reader(container.pack([*known, *empty], reader.header.value_count)).header.version == 1
    with monkeypatch.context() as patch:
        patch.setattr(container, "CHUNK_LIMIT", 1 << 20)
        more = container.pack([*known, *empty, *empty[:1]], reader.header.value_count, compress=False)
    with pytest.raises(errors.FormatError, match="claims 65537 chunks"):
        container.Reader(more)
    with pytest.raises(twin.Refused):
        twin.decode(more)


def test_valid_vectors_cover_every_kind_under_every_codec():
    found = {
        (entry.kind, entry.codec)
        for path in VALID + GROUPED
        for entry in container.Reader(path.read_bytes(), allow_partial=True).index
    }
    codecs = {
        kind: {0, 1, 2} if kind in ("PLNE", "OCCU", "MOVE", "DECO", "HYBR") else {0, 1} for kind in scene_io.KNOWN_KINDS
    }
    assert found >= {(kind, codec) for kind, known in codecs.items() for codec in known} | {(scene_io.GROUP_KIND, 0)}


def test_valid_vectors_cover_every_context_and_size_of_errors(twin, monkeypatch):
    """No error is large enough for the last three of the 66 contexts of planes."""
    contexts, sizes, inner = set(), set(), twin.Decisions.error

    def error(decisions, context, unary=4, most_bits=7):
        found = inner(decisions, context, unary, most_bits)
        contexts.add((most_bits, context))
        sizes.add((most_bits, found if abs(found) <= 4 else (abs(found) - 4).bit_length() + 4, found > 0))
        return found

    monkeypatch.setattr(twin.Decisions, "error", error)
    for path in VALID:
        if path.stem.startswith(("symbols", "nodes", "limits-nodes")):
            twin.decode(path.read_bytes(), partial=path.stem.endswith("prefix"))
    assert contexts == {(7, context) for context in range(63)} | {(15, context) for context in range(20)}
    for most in (7, 15):
        of_each_sign = {(most, size, False) for size in range(-4, 1)} | {(most, size, True) for size in range(1, 5)}
        escapes = {(most, 4 + bits, positive) for bits in range(1, most + 2) for positive in (False, True)}
        assert sizes >= of_each_sign | escapes


def packed_here(name: str) -> bool:
    """Whether a vector's bytes do not depend on the version of zstd, or this is that version."""
    written = json.loads((SPEC / "vectors" / name).with_suffix(".json").read_text())["zstd"]
    return written in (None, specvectors.ZSTD_VERSION)


def assert_described(found: dict, expected: dict) -> None:
    """Equal but for the version of zstd; rays within their tolerance."""
    assert {**found, "rays": 0, "zstd": 0} == {**expected, "rays": 0, "zstd": 0}
    for one, other in zip(found["rays"], expected["rays"], strict=True):
        for key in ("rgb", "opacity", "depth"):
            assert one[key] == pytest.approx(other[key], abs=RAY_TOLERANCE), key


@pytest.mark.parametrize("space", VARIANTS)
def test_the_twin_renders_a_scene_as_the_reference_does(twin, space):
    from kpc.format.coding.quantise import quantise_scene

    scene = VARIANTS[space](tiny_scene(scales=1, channels=4, resolution=(10, 8, 6), time=4))
    data = scene_io.encode(quantise_scene(scene, [dict.fromkeys(scene.scales[0], 0.01)]))
    decoded = scene_io.read(data).dequantise()
    slow = twin.decode(data)
    camera = scene.cameras[0].resized(8, 6)
    origins, directions = camera.rays()
    fast = reference.render_rays(decoded, origins, directions, 0.3)
    for number, (origin, direction) in enumerate(zip(origins.tolist(), directions.tolist(), strict=True)):
        rgb, opacity, _ = twin.render_ray(slow, origin, direction, 0.3)
        assert np.abs(fast.rgb[number] - rgb).max() < 1 / 255
        assert abs(fast.opacity[number] - opacity) < 1 / 255
