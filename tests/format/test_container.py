import io
import struct
from dataclasses import replace

import google_crc32c
import numpy as np
import pytest
from kpc.format.common.errors import FormatError
from kpc.format.container.container import (
    CODEC_RAW,
    CODEC_SYMBOLS,
    CODEC_ZSTD,
    ENTRY,
    EXPANSION_LIMIT,
    HEADER,
    Chunk,
    Reader,
    pack,
)

NOISE = np.random.default_rng(0).integers(0, 256, 300).astype(np.uint8).tobytes()
CHUNKS = [
    Chunk("ABCD", [b"head"]),
    Chunk("PLNE", [b"x" * 500, NOISE], 1, 3, 16, 8),
    Chunk("none", [b""]),
    Chunk("long", [bytes(100_000)]),
]


def test_chunks_come_back_with_their_places():
    reader = Reader(pack(CHUNKS, 7))
    assert [reader.chunk(n) for n in range(4)] == [b"".join(c.parts) for c in CHUNKS]
    assert [e.kind for e in reader.index] == ["ABCD", "PLNE", "none", "long"]
    entry = reader.index[1]
    assert (entry.group, entry.scale, entry.plane, entry.row_start, entry.row_count) == (0, 1, 3, 16, 8)
    assert [e.is_critical for e in reader.index] == [True, True, False, False]
    assert [e.codec for e in reader.index] == [CODEC_RAW, CODEC_ZSTD, CODEC_RAW, CODEC_ZSTD]
    assert reader.header.value_count == 7 and reader.header.largest_raw == 100_000
    assert all(reader.available(n) for n in range(4))


@pytest.mark.parametrize(
    "kind, body, count, codec",
    [
        *(
            (kind, b"s" * 9, count, codec)
            for kind in ("PLNE", "OCCU")
            for count, codec in (
                (300, CODEC_SYMBOLS),
                (9 * EXPANSION_LIMIT, CODEC_SYMBOLS),
                (9 * EXPANSION_LIMIT + 1, CODEC_ZSTD),
            )
        ),
        ("PLNE", b"s" * 500, 300, CODEC_RAW),
        ("OCCU", b"s" * 500, 300, CODEC_ZSTD),
        ("OCCU", b"s" * 100, 300, CODEC_ZSTD),
        ("PLNE", None, 0, CODEC_ZSTD),
    ],
)
def test_symbols_are_taken_where_they_are_shorter_and_may_stand_for_so_many(kind, body, count, codec):
    data = pack([Chunk(kind, [b"x" * 500], coded={CODEC_SYMBOLS: lambda: body} if body else {}, symbol_count=count)], 1)
    entry = Reader(data).index[0]
    assert entry.codec == codec and entry.raw_length == (count if codec == CODEC_SYMBOLS else 500)
    if codec == CODEC_SYMBOLS:
        assert Reader(data).stored(0) == body
        with pytest.raises(FormatError, match="codec 2, unknown"):  # to a reader that knows nothing of planes
            Reader(data).chunk(0)
    else:
        assert Reader(data).chunk(0) == b"x" * 500


def test_without_compression_everything_is_stored_raw():
    data = pack(CHUNKS, 7, compress=False)
    assert all(e.codec == CODEC_RAW for e in Reader(data).index)
    assert len(data) == HEADER.size + 4 * ENTRY.size + sum(len(b"".join(c.parts)) for c in CHUNKS)


def test_packing_is_deterministic():
    assert pack(CHUNKS, 7) == pack(CHUNKS, 7)


def test_the_zstd_frame_of_parts_is_no_larger_than_the_plain_one():
    import zstandard

    rng = np.random.default_rng(1)
    parts = [rng.normal(0, scale, 20_000).astype(np.int8).tobytes() for scale in (1, 20, 2, 40)]
    plain = len(zstandard.ZstdCompressor(level=19).compress(b"".join(parts)))
    assert Reader(pack([Chunk("PLNE", parts)], 1)).index[0].stored_length < plain


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


def test_an_index_is_stored_in_columns_where_that_is_smaller():
    many = [*CHUNKS, *[Chunk("note", [NOISE[: 20 + k]], row_start=k) for k in range(30)]]
    plain, told = pack(many, 7, version=1), pack(many, 7)
    before, now = Reader(plain), Reader(told)
    assert (before.header.version, now.header.version) == (1, 2) and len(plain) - len(told) > 15 * len(many)
    assert [replace(entry, offset=0) for entry in now.index] == [replace(entry, offset=0) for entry in before.index]
    assert [now.stored(k) for k in range(len(many))] == [before.stored(k) for k in range(len(many))]
    assert Reader(pack(many, 7, compress=False)).header.version == 1


@pytest.mark.parametrize("version", [1, 2])
def test_opening_takes_two_requests_and_a_chunk_one(version: int):
    source = Recorded(pack(CHUNKS, 7, version=version))
    reader = Reader(source)
    assert (
        source.asked == [(0, HEADER.size), (HEADER.size, reader.header.index_length)]
        and reader.header.version == version
    )
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


def test_a_partial_file_gives_what_is_there():
    data = pack(CHUNKS, 7)
    cut = Reader(data).index[2].offset
    with pytest.raises(FormatError, match="cut off"):
        Reader(data[:cut])
    reader = Reader(data[:cut], allow_partial=True)
    assert [reader.available(n) for n in range(4)] == [True, True, True, False]  # the third is empty
    assert reader.chunk(0) == b"head"
    with pytest.raises(FormatError, match="chunk 3 .long. is not there"):
        reader.chunk(3)


def test_limits_hold_for_the_writer_too():
    with pytest.raises(FormatError, match="too empty"):
        pack([Chunk("ABCD", [b"x"])], 1 << 40)


def test_a_chunk_larger_than_makes_sense_is_refused_before_it_is_read():
    source = Recorded(pack(CHUNKS, 7))
    reader = Reader(source)
    source.asked.clear()
    with pytest.raises(FormatError, match="at most 99,999"):
        reader.chunk(3, limit=99_999)
    assert not source.asked


def test_a_file_that_claims_huge_sizes_is_refused_after_its_header():
    data = bytearray(pack(CHUNKS, 7))
    for offset, layout, value in [(40, "<Q", 1 << 60), (48, "<I", 0xFFFFFFFF), (28, "<I", 0xFFFFFFFF)]:
        hostile = bytearray(data)
        struct.pack_into(layout, hostile, offset, value)
        struct.pack_into("<I", hostile, 60, google_crc32c.value(bytes(hostile[:60])))
        source = Recorded(bytes(hostile))
        with pytest.raises(FormatError):
            Reader(source)
        assert source.asked == [(0, HEADER.size)]


def test_missing_files_keep_their_names(tmp_path):
    with pytest.raises(FileNotFoundError) as caught:
        Reader(tmp_path / "none.kpc")
    assert caught.value.filename == str(tmp_path / "none.kpc")
