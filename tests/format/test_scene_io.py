import errno
import os
import tracemalloc
from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

import kpc
from codec_inputs import drifting, rolling, swaying
from kpc.encoder.coding.scene_writer import encode, scene_chunks, write
from kpc.format.coding.quantise import QuantisedScene, quantise_scene
from kpc.format.common.errors import BudgetError, FormatError
from kpc.format.container.container import HEADER, Chunk, Codec, Reader, pack
from kpc.format.container.scene_io import SceneReader, read
from kpc.format.container.scene_layout import APPEARANCE_LIMIT, NAME_LIMIT
from kpc.format.scene.cameras import Camera
from kpc.format.scene.motion import FINEST_STEP, QuantisedMotion
from kpc.format.scene.scene import TIME_PLANES, Appearance
from kpc.format.scene.space import Contraction, DeviceCoordinates
from kpc.tools.vectors import files
from kpc.tools.vectors.scenes import with_occupancy
from scenes import in_device_coordinates, tiny_scene, with_appearances, with_motion


def quantised(step: float = 0.02, **options) -> QuantisedScene:
    scene = tiny_scene(**options)
    return quantise_scene(scene, [dict.fromkeys(scale, step) for scale in scene.scales])


def assert_same(a: QuantisedScene, b: QuantisedScene) -> None:
    assert np.array_equal(a.aabb, b.aabb) and a.clip == b.clip and a.step == b.step and a.mapping == b.mapping
    assert np.array_equal(a.background, b.background) and (a.motion is None) == (b.motion is None)
    if a.motion is not None:
        assert a.motion.step == b.motion.step and np.array_equal(a.motion.symbols, b.motion.symbols)
        assert a.motion.symbols.dtype == b.motion.symbols.dtype
    assert a.occupancy.dtype == b.occupancy.dtype and np.array_equal(a.occupancy, b.occupancy)
    for name in ("density_weight", "density_bias", "w1", "b1", "w2", "b2"):
        assert np.array_equal(getattr(a.decoder, name), getattr(b.decoder, name))
    assert len(a.cameras) == len(b.cameras)
    for one, other in zip(a.cameras, b.cameras, strict=True):
        assert np.array_equal(one.camera_to_world, other.camera_to_world)
        assert [getattr(one, k) for k in ("width", "height", "fl_x", "fl_y", "cx", "cy")] == [
            getattr(other, k) for k in ("width", "height", "fl_x", "fl_y", "cx", "cy")
        ]
    assert [one.name for one in a.appearances] == [other.name for other in b.appearances]
    for one, other in zip(a.appearances, b.appearances, strict=True):
        assert one.code.dtype == other.code.dtype and np.array_equal(one.code, other.code)
    assert [list(s) for s in a.scales] == [list(s) for s in b.scales]
    for one, other in zip(a.scales, b.scales, strict=True):
        for name in one:
            for field in ("symbols", "step", "offset", "coded"):
                x, y = getattr(one[name], field), getattr(other[name], field)
                assert x.dtype == y.dtype and np.array_equal(x, y), (name, field)


@given(
    seed=st.integers(0, 1000),
    dynamic=st.booleans(),
    scales=st.integers(1, 3),
    channels=st.integers(1, 9),
    resolution=st.tuples(*[st.integers(1, 12)] * 3),
    time=st.integers(1, 7),
    segment_rows=st.integers(1, 9),
    step=st.sampled_from([0.001, 0.05, 1.0]),
)
@settings(max_examples=25, deadline=None)
def test_a_scene_comes_back(seed, dynamic, scales, channels, resolution, time, segment_rows, step):
    scene = quantised(
        step, seed=seed, dynamic=dynamic, scales=scales, channels=channels, resolution=resolution, time=time
    )
    data = encode(scene, segment_rows=segment_rows)
    assert_same(read(data), scene)
    assert encode(read(data)) == data  # in the segments that it had


def test_a_contracted_scene_comes_back_and_says_so_in_a_chunk_of_its_own():
    scene = quantised()
    around = replace(scene, mapping=Contraction(1 / 3))
    data = encode(around)
    assert_same(read(data), around)
    assert read(data).dequantise().mapping == around.mapping
    assert [e.kind for e in Reader(data).index][:3] == ["SCNE", "WARP", "DECO"]
    assert [e.kind for e in Reader(encode(scene)).index][:2] == ["SCNE", "DECO"]
    assert read(encode(scene)).mapping is None


def test_device_coordinates_come_back():
    scene = in_device_coordinates(tiny_scene())
    coded = quantise_scene(scene, [dict.fromkeys(scale, 0.02) for scale in scene.scales])
    back = read(encode(coded)).mapping
    assert isinstance(back, DeviceCoordinates) and np.array_equal(back.frame, scene.mapping.frame)
    assert (back.near, back.baseline) == (scene.mapping.near, scene.mapping.baseline)


@pytest.mark.parametrize(
    "change",
    [
        {"near": 0.0},
        {"near": float("nan")},
        {"baseline": -1.0},
        {"baseline": 1e12},
        {"near": 5.0},
        {"frame": np.eye(4)[:3] * 1.01},
        {"frame": np.full((3, 4), np.nan)},
        {"frame": np.eye(3, 4, 3) * 2.0**31 + np.eye(3, 4)},
    ],
)
def test_device_coordinates_that_make_no_sense_are_not_written(change):
    scene = in_device_coordinates(tiny_scene())
    broken = replace(scene, mapping=replace(scene.mapping, **change))
    with pytest.raises(FormatError, match="WARP"):
        encode(quantise_scene(broken, [dict.fromkeys(scale, 0.02) for scale in scene.scales]))


def test_a_prefix_without_the_mapping_shows_nothing():
    data = encode(replace(quantised(), mapping=Contraction(2.0)))
    index = Reader(data).index
    assert read(data[: index[4].offset], allow_partial=True).mapping == Contraction(2.0)
    # A writer may put it last; then what came before it is of no use.
    from kpc.format.container.scene_layout import WARP_STRUCT

    chunks = [*scene_chunks(quantised()), Chunk("WARP", WARP_STRUCT.pack(1, 2.0))]
    late = pack(chunks, Reader(data).header.value_count)
    assert read(late).mapping == Contraction(2.0)
    with pytest.raises(FormatError, match=r"WARP.*is not there"):
        read(late[:-1], allow_partial=True)


def test_a_motion_grid_comes_back_and_says_so_in_a_chunk_of_its_own():
    scene = with_motion(tiny_scene(), most=3.0)
    coded = quantise_scene(scene, [dict.fromkeys(scale, 0.02) for scale in scene.scales])
    data = encode(coded)
    assert_same(read(data), coded)
    assert [e.kind for e in Reader(data).index][:3] == ["SCNE", "MOVE", "DECO"]
    back = read(data).dequantise().motion
    assert back is not None and np.abs(back - scene.motion).max() <= FINEST_STEP / 2 + 1e-7
    index = Reader(data).index
    assert np.array_equal(read(data[: index[4].offset], allow_partial=True).dequantise().motion, back)


def test_a_motion_grid_counts_against_the_budget():
    data = encode(replace(quantised(), motion=QuantisedMotion(np.zeros((40, 9, 9, 9, 3), np.int16), FINEST_STEP)))
    least = 5 * Reader(data).header.value_count
    assert len(data) < least
    with pytest.raises(BudgetError, match="motion grid"):
        read(data, memory_budget=least + 10_000)


def quantised_varied(names: tuple[str, ...] = ("dawn.jpg", "noon.jpg", "dusk.jpg")) -> QuantisedScene:
    scene = with_appearances(tiny_scene(), names)
    return quantise_scene(scene, [dict.fromkeys(scale, 0.02) for scale in scene.scales])


def test_appearances_come_back_and_say_so_in_a_chunk_of_their_own():
    coded = quantised_varied(("cam 1.mp4", "東京/夜:1.jpg", "x" * NAME_LIMIT))
    data = encode(coded)
    assert_same(read(data), coded)
    assert [e.kind for e in Reader(data).index][:6] == ["SCNE", "DECO", "OCCU", "came", "appe", "PLNE"]
    assert "appe" not in [e.kind for e in Reader(encode(quantised())).index]
    scene = read(data).dequantise()
    assert scene.parameter_count == coded.parameter_count == quantised().parameter_count + 3 * 16
    for ours, theirs in zip(scene.appearances, with_appearances(tiny_scene()).appearances, strict=True):
        np.testing.assert_allclose(ours.code, theirs.code, rtol=2.0**-11)  # float16 rounds to the nearest


def test_a_prefix_without_the_appearances_plays_the_average():
    data = encode(quantised_varied())
    index = Reader(data).index
    assert read(data[: index[4].offset], allow_partial=True).appearances == ()
    assert len(read(data[: index[5].offset], allow_partial=True).appearances) == 3


def test_appearances_count_against_the_budget():
    scene = quantised(scales=1, channels=1, resolution=(2, 2, 2), time=1)
    codes = np.zeros((APPEARANCE_LIMIT, 16), np.float32)
    data = encode(replace(scene, appearances=tuple(Appearance(f"{k:060}", code) for k, code in enumerate(codes))))
    assert len(read(data).appearances) == APPEARANCE_LIMIT and len(data) < 300_000
    with pytest.raises(BudgetError, match="appearances"):
        read(data, memory_budget=6_000_000)


def test_rows_in_time_may_differ_from_scale_to_scale():
    coarse, fine = quantised(scales=1, time=3), quantised(scales=1, time=11)
    scene = replace(quantised(scales=2), scales=(coarse.scales[0], fine.scales[0]))
    assert_same(read(encode(scene, segment_rows=4)), scene)


def test_maps_that_the_occupancy_implies_take_no_bytes():
    scene = quantised(resolution=(30, 28, 26), time=6)
    occupancy = np.zeros((1, 9, 10, 11), bool)
    occupancy[0, 2:5, 3, 4:9] = occupancy[0, 4, 2:8, 5] = True
    scene = with_occupancy(scene, occupancy)
    data = encode(scene)
    assert_same(read(data), scene)
    assert encode(read(data)) == data
    codecs = {entry.plane: entry.codec for entry in Reader(data).index if entry.kind == "PLNE"}
    assert [codecs[plane] for plane in range(3)] == 3 * [Codec.PREDICTIVE]

    # Where planes hold more than that, or less, a map is coded.
    other = replace(scene, occupancy=np.roll(occupancy, 1, axis=(1, 2, 3)))
    mapped = encode(other)
    assert_same(read(mapped), other)
    assert {entry.codec for entry in Reader(mapped).index if entry.kind == "PLNE"} == {Codec.PREDICTIVE}
    assert len(mapped) > len(data) + 20

    # A plane cannot be read by another occupancy than its own.
    occu = next(number for number, entry in enumerate(Reader(data).index) if entry.kind == "OCCU")
    chunks = scene_chunks(scene)
    mixed = [chunk if number != occu else scene_chunks(other)[occu] for number, chunk in enumerate(chunks)]
    with pytest.raises(FormatError, match="plane segment"):
        read(pack(mixed, Reader(data).header.value_count))


def test_what_occupancy_implies_counts_against_the_budget():
    corner = np.indices((1, 1, 400, 500)).sum(0) < 500
    data = encode(with_occupancy(quantised(resolution=(30, 28, 26), dynamic=False), corner))
    least = next(budget for budget in range(0, 4 << 20, 10_000) if not refused(data, budget))
    assert least > 2 * corner.size


def refused(data: bytes, budget: int) -> bool:
    try:
        read(data, memory_budget=budget)
    except BudgetError:
        return True
    return False


def test_without_context_coding_files_are_larger_and_say_the_same():
    scene = quantised(time=6)
    chunks = scene_chunks(scene, segment_rows=4)
    coded = pack(chunks, sum(p.symbols.size for scale in scene.scales for p in scale.values()))
    plain = pack([replace(chunk, encode=None) for chunk in chunks], Reader(coded).header.value_count)
    assert {e.codec for e in Reader(plain).index} == {Codec.RAW, Codec.ZSTD}
    assert {e.codec for e in Reader(coded).index if e.kind == "PLNE"} <= {Codec.RAW, Codec.PREDICTIVE, Codec.TRANSFORM}
    assert len(coded) < len(plain)
    assert_same(read(plain), scene)
    assert_same(read(coded), scene)


def test_grids_are_context_coded_and_count_against_the_budget_all_the_same():
    scene = replace(quantised(time=6), occupancy=rolling(), motion=QuantisedMotion(swaying(), FINEST_STEP))
    chunks = scene_chunks(scene)
    now = pack(chunks, scene_values := sum(p.symbols.size for scale in scene.scales for p in scale.values()))
    before = pack([replace(chunk, encode=None) for chunk in chunks], scene_values)
    for kind, bytes_held in (("OCCU", scene.occupancy.size), ("MOVE", 4 * scene.motion.symbols.nbytes)):
        new, old = (next(e for e in Reader(data).index if e.kind == kind) for data in (now, before))
        assert (
            new.codec in (Codec.OCCUPANCY, Codec.MOTION)
            and old.codec == Codec.ZSTD
            and new.raw_length == old.raw_length
        )
        assert new.stored_length < 0.7 * old.stored_length
        with pytest.raises(BudgetError):
            read(now, memory_budget=5 * scene_values + bytes_held - 1)
    assert_same(read(now), scene)
    assert_same(read(before), scene)


@pytest.mark.parametrize("motion", [swaying(), drifting()])
def test_motion_grids_come_back_under_their_codec(motion):
    scene = replace(quantised(time=6), motion=QuantisedMotion(motion, FINEST_STEP))
    data = encode(scene)
    assert next(entry.codec for entry in Reader(data).index if entry.kind == "MOVE") == Codec.MOTION
    assert_same(read(data), scene)


def test_write_and_load(tmp_path):
    scene = quantised()
    path = tmp_path / "scene.kpc"
    size = write(scene, path)
    assert size == path.stat().st_size == len(encode(scene))
    loaded = kpc.load(path)
    assert isinstance(loaded, kpc.Scene)
    for before, after in zip(scene.dequantise().scales, loaded.scales, strict=True):
        assert all(np.array_equal(before[name], after[name]) for name in before)
    with open(path, "rb") as opened:
        assert_same(read(opened), scene)


def test_the_file_is_ordered_for_streaming():
    index = Reader(encode(quantised(time=6), segment_rows=4)).index
    assert [e.kind for e in index[:4]] == ["SCNE", "DECO", "OCCU", "came"]
    places = [(e.row_start // 4, e.scale, e.plane) for e in index[4:]]
    first = [(0, scale, plane) for scale in (0, 1) for plane in range(6)]
    assert places == first + [(1, scale, plane) for scale in (0, 1) for plane in (3, 4, 5)]


def test_a_static_scene_stores_no_time_plane():
    index = Reader(encode(quantised(dynamic=False))).index
    assert {e.plane for e in index if e.kind == "PLNE"} == {0, 1, 2}


def test_a_plane_segment_decodes_alone(tmp_path):
    scene = quantised(time=6)
    path = tmp_path / "scene.kpc"
    write(scene, path, segment_rows=4)
    reader = SceneReader(path)
    for number, entry in enumerate(reader.index):
        if entry.kind == "PLNE" and entry.row_start == 4:
            symbols, coded = reader.segment(number)
            plane = scene.scales[entry.scale][kpc.format.scene.scene.ALL_PLANES[entry.plane]]
            assert np.array_equal(symbols, plane.symbols[4:6]) and np.array_equal(coded, plane.coded[4:6])


def test_every_prefix_that_ends_at_a_chunk_plays():
    scene = quantised(time=6)
    data = encode(scene, segment_rows=4)
    index = Reader(data).index
    ends = [e.offset + e.stored_length for e in index]
    for number in (0, 1):
        with pytest.raises(FormatError, match="is not there"):
            read(data[: ends[number]], allow_partial=True)
    for number in range(2, len(index)):
        partial = read(data[: ends[number]], allow_partial=True)
        there = {(e.scale, e.plane, e.row_start) for e in index[: number + 1] if e.kind == "PLNE"}
        for scale, (planes, whole) in enumerate(zip(partial.scales, scene.scales, strict=True)):
            for p, (name, plane) in enumerate(planes.items()):
                for start in (0, 4) if name in TIME_PLANES else (0,):
                    rows = slice(start, start + 4) if name in TIME_PLANES else slice(None)
                    if (scale, p, start) in there:
                        assert np.array_equal(plane.symbols[rows], whole[name].symbols[rows])
                    else:
                        assert not plane.coded[rows].any()
                        assert (plane.dequantise()[rows] == (1 if name in TIME_PLANES else 0)).all()
    assert_same(read(data, allow_partial=True), scene)


def test_identity_and_unseen_regions_cost_no_bits():
    still = tiny_scene(time=64)
    for scale in still.scales:
        for name in TIME_PLANES:
            scale[name][:] = 1
    scene = quantise_scene(still, [dict.fromkeys(scale, 0.02) for scale in still.scales])
    assert scene.identity_share == 1.0
    reader = SceneReader(encode(scene, segment_rows=64))
    time = [e for e in reader.index if e.kind == "PLNE" and e.plane >= 3]
    assert sum(e.raw_length for e in time) > 600 and sum(e.stored_length for e in time) <= 6 * 24

    empty = replace(tiny_scene(), occupancy=np.zeros((1, 8, 8, 8), bool))
    scene = quantise_scene(empty, [dict.fromkeys(scale, 0.02) for scale in empty.scales])
    reader = SceneReader(encode(scene))
    assert sum(e.stored_length for e in reader.index if e.kind == "PLNE") <= 12 * 24
    assert_same(read(encode(scene)), scene)


# --- damage and hostility


@pytest.fixture(scope="module")
def small() -> bytes:
    return files.encode_kinds(quantised(scales=1, channels=2, resolution=(5, 4, 3), time=3), "PLNE", "OCCU")


def test_every_truncation_is_refused_or_plays_when_partial_files_are_welcome(small):
    for length in range(len(small)):
        try:
            scene = read(small[:length], allow_partial=True)
        except FormatError:
            continue
        assert scene.dequantise().parameter_count == scene.parameter_count


@given(seed=st.integers(0, 2**32 - 1))
@settings(max_examples=300, deadline=None)
def test_damage_behind_right_checksums_decodes_or_is_refused(small, seed):
    """What the checksums cannot catch: a file that was made to harm."""
    rng = np.random.default_rng(seed)
    damaged = bytearray(small)
    ends = [HEADER.size, HEADER.size + Reader(small).header.index_length, len(small)]
    region = rng.integers(3)
    start = 12 if region == 0 else ends[region - 1]
    for _ in range(rng.integers(1, 4)):
        damaged[rng.integers(start, ends[region])] = rng.integers(256)
    hostile = files.sealed(bytes(damaged))
    if region == 2:
        hostile = files.resealed(hostile)
    try:
        scene = read(hostile, memory_budget=1 << 24)
    except FormatError:
        return
    assert np.isfinite(scene.dequantise().scales[0]["xy"]).all()


def test_the_memory_budget_is_checked_before_memory_is_taken():
    wide = tiny_scene(scales=1, channels=2, resolution=(1200, 1200, 2), dynamic=False)
    flat = {name: np.ones_like(plane) for name, plane in wide.scales[0].items()}
    scene = quantise_scene(replace(wide, scales=(flat,)), [dict.fromkeys(flat, 0.5)])
    data = encode(scene)
    values = sum(plane.symbols.size for plane in scene.scales[0].values())
    assert len(data) < 20_000 and 5 * values > 14_000_000
    tracemalloc.start()
    try:
        with pytest.raises(BudgetError, match="budget of 14,000,000"):
            read(data, memory_budget=14_000_000)
        assert tracemalloc.get_traced_memory()[1] < 1_000_000
    finally:
        tracemalloc.stop()
    assert read(data, memory_budget=5 * values + 100_000).parameter_count == scene.parameter_count


def test_the_budget_counts_the_occupancy_grid():
    scene = replace(quantised(), occupancy=np.zeros((4, 128, 128, 128), bool))
    values = 5 * sum(p.symbols.size for s in scene.scales for p in s.values())
    with pytest.raises(BudgetError, match="occupancy"):
        read(encode(scene), memory_budget=values + (1 << 20))


def test_a_full_disk_leaves_no_half_written_file(tmp_path, monkeypatch):
    path = tmp_path / "scene.kpc"
    path.write_bytes(b"the old one")

    def full(self, data):
        with open(self, "wb") as opened:
            opened.write(data[:100])
        raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))

    monkeypatch.setattr("pathlib.Path.write_bytes", full)
    with pytest.raises(OSError) as caught:
        write(quantised(), path)
    assert caught.value.errno == errno.ENOSPC and caught.value.filename == str(path)
    assert os.listdir(tmp_path) == ["scene.kpc"] and path.read_bytes() == b"the old one"


def test_a_folder_that_is_not_there_is_named(tmp_path):
    with pytest.raises(FileNotFoundError) as caught:
        write(quantised(), tmp_path / "none" / "scene.kpc")
    assert caught.value.filename == str(tmp_path / "none" / "scene.kpc")


@pytest.mark.parametrize(
    "change, complaint",
    [
        (lambda s: {"aabb": s.aabb[::-1]}, "box"),
        (lambda s: {"mapping": Contraction(0.0)}, "WARP"),
        (lambda s: {"mapping": Contraction(-1.0)}, "WARP"),
        (lambda s: {"mapping": Contraction(float("nan"))}, "WARP"),
        (lambda s: {"mapping": Contraction(float("inf"))}, "WARP"),
        (lambda s: {"mapping": Contraction(40000 * s.step)}, "WARP"),
        (lambda s: {"motion": QuantisedMotion(np.zeros((1, 2, 2, 2, 3), np.int16), FINEST_STEP)}, "MOVE"),
        (lambda s: {"motion": QuantisedMotion(np.zeros((2, 2, 2, 1, 3), np.int16), FINEST_STEP)}, "MOVE"),
        (lambda s: {"motion": QuantisedMotion(np.zeros((2, 2, 2, 2, 3), np.int16), 0.0)}, "MOVE"),
        (lambda s: {"motion": QuantisedMotion(np.zeros((2, 2, 2, 2, 3), np.int16), 1.0)}, "MOVE"),
        (lambda s: {"motion": QuantisedMotion(np.zeros((2, 2, 2, 2, 3), np.int32), FINEST_STEP)}, "motion"),
        (lambda s: {"aabb": np.full((2, 3), np.nan, np.float32)}, "box"),
        (lambda s: {"step": 0.0}, "ray step"),
        (lambda s: {"step": 1e-9}, "ray step"),
        (lambda s: {"background": np.float32([0, 0, 2])}, "background"),
        (lambda s: {"clip": replace(s.clip, frame_count=0)}, "0 frames"),
        (lambda s: {"clip": replace(s.clip, frame_count=-1)}, "does not fit"),
        (lambda s: {"occupancy": np.zeros((3, 3, 3), bool)}, "occupancy"),
        (lambda s: {"occupancy": s.occupancy.astype(np.uint8)}, "occupancy"),
        (lambda s: {"scales": s.scales[:1]}, "decoder"),
        (lambda s: {"scales": ({k: v for k, v in s.scales[0].items() if k != "yt"},)}, "scale 0 holds planes"),
        (lambda s: {"decoder": replace(s.decoder, w1=s.decoder.w1 + np.float32(1e-5))}, "float16"),
        (lambda s: {"appearances": (Appearance("a", np.zeros(15, np.float32)),)}, "shapes"),
        (lambda s: {"appearances": (Appearance("a", np.full(16, 0.1, np.float32)),)}, "float16"),
        (lambda s: {"appearances": (Appearance("a", np.full(16, np.inf, np.float32)),)}, "infinite"),
        (lambda s: {"appearances": 2 * (Appearance("a", np.zeros(16, np.float32)),)}, "there twice"),
        (lambda s: {"appearances": (Appearance("", np.zeros(16, np.float32)),)}, "empty"),
        (lambda s: {"appearances": (Appearance("a\nb", np.zeros(16, np.float32)),)}, "control character"),
        (lambda s: {"appearances": (Appearance("\ud800", np.zeros(16, np.float32)),)}, "UTF-8"),
        (lambda s: {"appearances": (Appearance("x" * 256, np.zeros(16, np.float32)),)}, "does not fit"),
        (lambda s: {"cameras": (Camera(70000, 4, 5.0, 5.0, 1.0, 1.0, np.eye(4)),)}, "does not fit"),
        (
            lambda s: {
                "scales": (
                    s.scales[0],
                    {**s.scales[1], "xt": replace(s.scales[1]["xt"], offset=np.zeros(8, np.float32))},
                )
            },
            "offset of a time plane",
        ),
        (
            lambda s: {
                "scales": (
                    s.scales[0],
                    {**s.scales[1], "xt": replace(s.scales[1]["xt"], coded=np.zeros_like(s.scales[1]["xt"].coded))},
                )
            },
            "uncoded texel",
        ),
        (lambda s: {"scales": (s.scales[0], {**s.scales[1], "yz": s.scales[1]["xy"]})}, "plane yz"),
        (
            lambda s: {
                "scales": (
                    s.scales[0],
                    {**s.scales[1], "xy": replace(s.scales[1]["xy"], step=np.full(8, 1e3, np.float32))},
                )
            },
            "plane xy: a step",
        ),
    ],
)
def test_the_writer_refuses_what_readers_would(change, complaint):
    scene = quantised()
    with pytest.raises(FormatError, match=complaint):
        encode(replace(scene, **change(scene)))


def test_decoding_is_fast():
    """About 2.4 million symbols; the bar is a first frame within a second."""
    import time

    rng = np.random.default_rng(0)
    base = tiny_scene(scales=1, channels=16, resolution=(256, 192, 128))
    noisy = {n: (p + rng.normal(0, 0.02, p.shape)).astype(np.float32) for n, p in base.scales[0].items()}
    data = encode(quantise_scene(replace(base, scales=(noisy,)), [dict.fromkeys(noisy, 0.02)]))
    start = time.perf_counter()
    kpc.load(data)
    assert time.perf_counter() - start < 1.0


def test_grids_and_planes_count_against_the_budget_together():
    scene = replace(quantised(time=6), occupancy=rolling(), motion=QuantisedMotion(swaying(), FINEST_STEP))
    data = encode(scene)
    reader = SceneReader(data)
    raw = {entry.kind: entry.raw_length for entry in reader.index}
    needed = reader.planes_bytes + 8 * (raw["OCCU"] + raw["MOVE"])
    assert_same(read(data, memory_budget=needed), scene)
    with pytest.raises(BudgetError):
        read(data, memory_budget=needed - 1)
