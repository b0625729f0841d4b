import io
import os
import struct
from dataclasses import replace

import google_crc32c
import numpy as np
import pytest
import zstandard

from kpc.format.common.errors import FormatError
from kpc.format.container.container import (
    ENTRY,
    EXPANSION_LIMIT,
    HEADER,
    Chunk,
    Codec,
    Entry,
    Reader,
    header_and_index,
    pack,
    stored_frame,
)

NOISE = np.random.default_rng(0).integers(0, 256, 300).astype(np.uint8).tobytes()
CHUNKS = [
    Chunk("ABCD", b"head"),
    Chunk("PLNE", b"x" * 500 + NOISE, 1, 3, 16, 8),
    Chunk("none", b""),
    Chunk("long", bytes(100_000)),
]


def test_chunks_come_back_with_their_places():
    reader = Reader(pack(CHUNKS, 7))
    assert [reader.chunk(n) for n in range(4)] == [c.raw for c in CHUNKS]
    assert [e.kind for e in reader.index] == ["ABCD", "PLNE", "none", "long"]
    entry = reader.index[1]
    assert (entry.group, entry.scale, entry.plane, entry.row_start, entry.row_count) == (0, 1, 3, 16, 8)
    assert [e.is_critical for e in reader.index] == [True, True, False, False]
    assert [e.codec for e in reader.index] == [Codec.RAW, Codec.ZSTD, Codec.RAW, Codec.ZSTD]
    assert reader.header.value_count == 7 and reader.header.largest_raw == 100_000
    assert all(reader.available(n) for n in range(4))


@pytest.mark.parametrize(
    "kind, body, count, codec",
    [
        *(
            (kind, b"s" * 9, count, codec)
            for kind in ("PLNE", "OCCU")
            for count, codec in (
                (300, Codec.PREDICTIVE),
                (9 * EXPANSION_LIMIT, Codec.PREDICTIVE),
                (9 * EXPANSION_LIMIT + 1, Codec.ZSTD),
            )
        ),
        ("PLNE", b"s" * 500, 300, Codec.RAW),
        ("OCCU", b"s" * 500, 300, Codec.ZSTD),
        ("OCCU", b"s" * 100, 300, Codec.ZSTD),
        ("PLNE", None, 0, Codec.ZSTD),
    ],
)
def test_context_coding_is_chosen_where_it_is_shorter_within_the_expansion_limit(kind, body, count, codec):
    coded = {"codec": Codec.PREDICTIVE, "encode": lambda: body, "raw_length": count} if body else {}
    data = pack([Chunk(kind, b"x" * 500, **coded)], 1)
    entry = Reader(data).index[0]
    assert entry.codec == codec and entry.raw_length == (count if codec == Codec.PREDICTIVE else 500)
    if codec == Codec.PREDICTIVE:
        assert Reader(data).stored(0) == body
        with pytest.raises(FormatError, match="codec 2, unknown"):  # to a reader that knows nothing of planes
            Reader(data).chunk(0)
    else:
        assert Reader(data).chunk(0) == b"x" * 500


def test_without_compression_everything_is_stored_raw():
    data = pack(CHUNKS, 7, compress=False)
    assert all(e.codec == Codec.RAW for e in Reader(data).index)
    index = stored_frame(bytes(4 * ENTRY.size))
    assert len(index) == 12 + 4 * ENTRY.size
    assert len(data) == HEADER.size + len(index) + sum(len(c.raw) for c in CHUNKS)


def test_packing_is_deterministic():
    assert pack(CHUNKS, 7) == pack(CHUNKS, 7)


def test_crc32c_is_the_one_the_spec_names():
    assert google_crc32c.value(b"123456789") == 0xE3069283


class Recorded:
    """A source that notes what is asked of it, as HTTP range requests would be."""

    name = "recorded"

    def __init__(self, data: bytes):
        self.data, self.size, self.asked = data, len(data), []

    def read_at(self, offset: int, length: int) -> bytes:
        self.asked.append((offset, length))
        return self.data[offset : offset + length]

    def will_read(self, offset: int, length: int) -> None:
        pass


def test_the_index_is_compressed_where_that_is_smaller():
    many = [*CHUNKS, *[Chunk("note", NOISE[: 20 + k], row_start=k) for k in range(30)]]
    stored, compressed = pack(many, 7, compress=False), pack(many, 7)
    before, now = Reader(stored), Reader(compressed)
    assert before.header.index_length == 12 + ENTRY.size * len(many)
    assert now.header.index_length < 0.6 * before.header.index_length
    for one, other in zip(before.index[4:], now.index[4:], strict=True):
        assert replace(one, offset=0) == replace(other, offset=0)
    assert [now.stored(k) for k in range(4, len(many))] == [before.stored(k) for k in range(4, len(many))]


@pytest.mark.parametrize("count", [0, 1, 1 << 17, (1 << 17) + 1, 300_000])
def test_stored_frames_are_frames_of_zstandard(count: int):
    content = np.random.default_rng(0).integers(0, 256, count).astype(np.uint8).tobytes()
    frame = stored_frame(content)
    assert zstandard.get_frame_parameters(frame).content_size == count
    assert zstandard.ZstdDecompressor().decompress(frame, allow_extra_data=False) == content


@pytest.mark.parametrize("content", [b"", b"a" * 100], ids=["empty", "full"])
@pytest.mark.parametrize("more", [b"\0", zstandard.compress(b""), b"\x50\x2a\x4d\x18\0\0\0\0"])
def test_a_zstd_frame_followed_by_more_is_refused(content: bytes, more: bytes):
    frame = zstandard.compress(content)
    for body in (frame, frame + more):
        entry = Entry("note", 0, 0, 0, 0, 0, Codec.ZSTD, len(body), len(content), google_crc32c.value(body))
        reader = Reader(header_and_index([entry], 0) + body)
        if body == frame:
            assert reader.chunk(0) == content
        else:
            with pytest.raises(FormatError, match="no valid zstd frame"):
                reader.chunk(0)


def test_an_index_of_many_empty_chunks_is_not_compressed_too_far():
    """Else the file would be smaller than MIN_CHUNK_BYTES for each chunk allows."""
    data = pack([Chunk("note", b"")] * 5000, 0)
    assert len(Reader(data).index) == 5000


@pytest.mark.parametrize("version", [0, 1, 2])
def test_drafts_are_refused_by_name(version: int):
    draft = b"\x89KPC\r\n\x1a\n" + struct.pack("<HHI", version, 0, 64) + bytes(100)
    with pytest.raises(FormatError, match="a draft of the format; encode it again"):
        Reader(draft)


def test_other_versions_are_refused_by_number():
    data = bytearray(pack(CHUNKS, 7))
    struct.pack_into("<H", data, 8, 2)
    with pytest.raises(FormatError, match="format version 2, this reader knows 1; update kpc"):
        Reader(bytes(data))


@pytest.mark.parametrize("compress", [False, True])
def test_opening_takes_two_requests_and_a_chunk_one(compress: bool):
    source = Recorded(pack(CHUNKS, 7, compress=compress))
    reader = Reader(source)
    assert source.asked == [(0, HEADER.size), (HEADER.size, reader.header.index_length)]
    source.asked.clear()
    assert reader.chunk(1) == b"x" * 500 + NOISE
    assert source.asked == [(reader.index[1].offset, reader.index[1].stored_length)]


def test_sources_of_every_kind(tmp_path):
    data = pack(CHUNKS, 7)
    path = tmp_path / "a.kpc"
    path.write_bytes(data)
    with open(path, "rb") as opened:
        for source in (path, str(path), data, bytearray(data), io.BytesIO(data), opened):
            assert Reader(source).chunk(1) == b"x" * 500 + NOISE
    assert str(path) in Reader(path).name


@pytest.mark.parametrize("change", ["replaced", "shortened", "written anew", "appended to", "touched"])
def test_a_file_that_changes_while_it_is_read_is_no_damaged_one(tmp_path, change):
    data, path, other = pack(CHUNKS, 7), tmp_path / "a.kpc", tmp_path / "b.kpc"
    path.write_bytes(data)
    reader = Reader(path)
    other.write_bytes(data)
    if change == "replaced":
        other.replace(path)
    elif change == "written anew":  # in place, by cp or rsync, and longer
        path.write_bytes(pack([*CHUNKS[:-1], Chunk("test", NOISE[::-1] * 2)], 7))
    elif change == "touched":
        os.utime(path, (0, 0))
    else:
        path.write_bytes(data[:-1] if change == "shortened" else data + b"more")
    if change in ("appended to", "touched"):  # as by a download that goes on
        assert reader.stored(0)
        return
    with pytest.raises(FormatError, match=r"a\.kpc: changed while it was read; open it again"):
        reader.stored(0)


def test_a_partial_file_gives_what_is_there():
    data = pack(CHUNKS, 7)
    cut = Reader(data).index[2].offset
    with pytest.raises(FormatError, match="cut off"):
        Reader(data[:cut])
    reader = Reader(data[:cut], allow_partial=True)
    assert [reader.available(n) for n in range(4)] == [True, True, True, False]  # the third is empty
    assert reader.chunk(0) == b"head"
    with pytest.raises(FormatError, match=r"chunk 3 .long. is not there"):
        reader.chunk(3)


def test_limits_hold_for_the_writer_too():
    with pytest.raises(FormatError, match="too empty"):
        pack([Chunk("ABCD", b"x")], 1 << 40)


def test_a_chunk_larger_than_makes_sense_is_refused_before_it_is_read():
    source = Recorded(pack(CHUNKS, 7))
    reader = Reader(source)
    source.asked.clear()
    with pytest.raises(FormatError, match="at most 99,999"):
        reader.chunk(3, limit=99_999)
    assert not source.asked


def test_a_file_that_claims_huge_sizes_is_refused_after_its_header():
    data = bytearray(pack(CHUNKS, 7))
    for offset, layout, value in [(32, "<Q", 1 << 60), (40, "<I", 0xFFFFFFFF), (12, "<I", 0xFFFFFFFF)]:
        hostile = bytearray(data)
        struct.pack_into(layout, hostile, offset, value)
        struct.pack_into("<I", hostile, 44, google_crc32c.value(bytes(hostile[:44])))
        source = Recorded(bytes(hostile))
        with pytest.raises(FormatError):
            Reader(source)
        assert source.asked == [(0, HEADER.size)]


def test_missing_files_keep_their_names(tmp_path):
    with pytest.raises(FileNotFoundError) as caught:
        Reader(tmp_path / "none.kpc")
    assert caught.value.filename == str(tmp_path / "none.kpc")
