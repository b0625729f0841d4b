"""Section 4: header, index, chunks and groups."""

import struct
from dataclasses import dataclass

import zstandard

from .common import PLANES, Refused, crc32c, require

RAW, ZSTD, PREDICTIVE, TRANSFORM, MOTION, OCCUPANCY, WEIGHTS, POSES, SHARED = range(9)
CODECS = {  # beside RAW and ZSTD
    b"PLNE": (PREDICTIVE, TRANSFORM, SHARED),
    b"MOVE": (MOTION,),
    b"OCCU": (OCCUPANCY,),
    b"DECO": (WEIGHTS,),
    b"HYBR": (WEIGHTS,),
    b"came": (POSES,),
    b"SCNE": (),
    b"WARP": (),
    b"appe": (),
    b"meta": (),
    b"soun": (),
}
HEADER, ENTRY = struct.Struct("<8sHHIIIQQII"), struct.Struct("<4sHBBIIHIII")
EXPANSION_LIMIT, SCALE_LIMIT = 32768, 16


@dataclass
class Content:
    """What a chunk holds: its raw bytes or, under codecs 2 to 7, the stored bytes and the raw length."""

    codec: int
    raw_length: int
    data: bytes

    @property
    def is_coded(self):
        return self.codec > ZSTD


@dataclass
class Chunk:
    """An index entry with the stored bytes of its chunk; of a prefix, those that are there."""

    kind: bytes
    group: int
    scale: int
    plane: int
    row_start: int
    row_count: int
    codec: int
    stored_length: int
    raw_length: int
    crc: int
    stored: bytes = b""

    @property
    def is_whole(self):
        return len(self.stored) == self.stored_length

    @property
    def is_critical(self):
        return self.kind[:1].isupper()


def read_chunks(data, is_prefix):  # sections 4.1 and 4.2
    """Return (chunks, value_count) of a file."""
    require(len(data) >= HEADER.size and data[:8] == b"\x89KPC\r\n\x1a\n", "not a .kpc file")
    _, version, header_length, chunk_count, index_length, index_crc, *fields = HEADER.unpack(data[: HEADER.size])
    file_length, value_count, largest_raw, header_crc = fields
    require(header_length != 0, "a draft of the format; encode it again")
    require(version == 1, "unknown version of the format")
    require(crc32c(data[:44]) == header_crc, "the header is damaged")
    require(header_length == HEADER.size, "invalid header length")
    require(1 <= chunk_count <= 65536 and 1 <= index_length <= 64 + 40 * chunk_count, "invalid number of chunks")
    require(file_length >= HEADER.size + max(index_length, 8 * chunk_count), "invalid file length")
    require(len(data) <= file_length if is_prefix else len(data) == file_length, "invalid file length")
    require(
        max(value_count, largest_raw) <= file_length * EXPANSION_LIMIT,
        "invalid value_count or largest_raw",
    )
    index = data[HEADER.size : HEADER.size + index_length]
    require(len(index) == index_length and crc32c(index) == index_crc, "the index is damaged")
    table = decompress(index, ENTRY.size * chunk_count)
    chunks, start = [], HEADER.size + index_length
    for number in range(chunk_count):
        chunk = Chunk(*ENTRY.unpack(table[number::chunk_count]))
        require(chunk.kind.isalpha() and chunk.raw_length <= largest_raw, "invalid index entry")
        chunk.stored = data[start : start + chunk.stored_length]
        require(is_prefix or chunk.is_whole, "a chunk is cut off")
        start += chunk.stored_length
        chunks.append(chunk)
    require(start == file_length, "chunks do not fill the file")
    return chunks, value_count


def decompress(frame, length):  # section 4.5
    try:
        parameters = zstandard.get_frame_parameters(frame)
        require(parameters.content_size == length, "invalid content size of a Zstandard frame")
        require(parameters.dict_id == 0, "a Zstandard frame uses a dictionary")
        frames = zstandard.ZstdDecompressor().decompressobj()
        content = frames.decompress(frame)
    except zstandard.ZstdError as error:
        raise Refused("invalid Zstandard frame") from error
    require(frames.eof and not frames.unused_data, "a Zstandard frame is cut off, or bytes follow it")
    return content


def scene_contents(data, is_prefix, shared=None):  # sections 4.3 and 4.4
    """Return (list of (chunk, content), value_count) of a scene; the content is None where a prefix lacks it.

    shared: of a group, the shared planes that it may use, by scale and plane."""
    chunks, value_count = read_chunks(data, is_prefix)
    contents = []
    for chunk in chunks:
        require(chunk.kind in CODECS or not chunk.is_critical, "unknown critical chunk")
        if chunk.kind not in CODECS:
            continue
        position = chunk.scale, chunk.plane, chunk.row_start, chunk.row_count
        has_position = chunk.kind in (b"PLNE", b"soun")
        require(chunk.group == 0 and (has_position or not any(position)), "invalid fields of an index entry")
        require(chunk.codec in (RAW, ZSTD, *CODECS[chunk.kind]), "unknown codec")
        if chunk.codec == SHARED:
            require(shared is not None, "a shared plane is not in a group")
            chunk = shared_plane(chunk, shared)
        require(chunk.codec != RAW or chunk.raw_length == chunk.stored_length, "invalid raw length")
        require(chunk.codec <= ZSTD or chunk.raw_length <= EXPANSION_LIMIT * chunk.stored_length, "invalid raw length")
        contents.append((chunk, plain_content(chunk) if chunk.is_whole else None))
    return contents, value_count


def plain_content(chunk):
    require(crc32c(chunk.stored) == chunk.crc, "a chunk is damaged")
    stored = decompress(chunk.stored, chunk.raw_length) if chunk.codec == ZSTD else chunk.stored
    return Content(chunk.codec, chunk.raw_length, stored)


def shared_plane(chunk, shared):  # section 4.7
    """Return the shared plane that a SHARED chunk of a group stands for."""
    require(chunk.row_start == chunk.stored_length == chunk.crc == 0, "a SHARED chunk has bytes or a first row")
    require((chunk.scale, chunk.plane) in shared, "there is no such shared plane")
    found = shared[chunk.scale, chunk.plane]
    sizes = found.row_count, found.raw_length
    require((chunk.row_count, chunk.raw_length) == sizes, "a shared plane has another size")
    return found


def group_chunks(data, is_prefix=False):  # section 4.7
    """Return (the GRUP chunks by rising number, the meta chunks beside them, the shared planes, value_count); no chunks
    of a scene."""
    chunks, value_count = read_chunks(data, is_prefix)
    groups, beside, shared = {}, [], []
    if any(chunk.kind == b"GRUP" for chunk in chunks):
        for chunk in chunks:
            is_known = chunk.kind in (b"GRUP", b"PLNE")
            require(is_known or not chunk.is_critical, "a critical chunk lies beside groups")
            if chunk.kind == b"GRUP":
                require(chunk.codec == RAW and chunk.raw_length == chunk.stored_length, "invalid codec of a group")
                require(chunk.scale == chunk.plane == 0 and chunk.row_count > 0, "invalid fields of a group")
                require(chunk.group not in groups, "invalid number of a group")
                groups[chunk.group] = chunk
            elif chunk.kind == b"PLNE":
                require(chunk.codec in (RAW, ZSTD, PREDICTIVE, TRANSFORM), "invalid codec of a shared plane")
                is_plane = chunk.scale < SCALE_LIMIT and chunk.plane < len(PLANES)
                require(is_plane and chunk.row_start == 0 and chunk.row_count > 0, "invalid fields of a shared plane")
                shared.append(chunk)
            elif chunk.kind == b"meta":
                require(chunk.codec in (RAW, ZSTD), "unknown codec")
                beside.append(chunk)
    require(sorted(groups) == list(range(len(groups))), "invalid numbers of groups")
    require(all(chunk.group < len(groups) for chunk in shared), "a shared plane is for no group")
    places = {(chunk.group, chunk.scale, chunk.plane) for chunk in shared}
    require(len(places) == len(shared), "a shared plane is there twice")
    return [groups[number] for number in range(len(groups))], beside, shared, value_count


def shared_planes_of(group, shared):
    """Return {(scale, plane): the shared plane that SHARED chunks of a group stand for}."""
    usable = sorted((chunk for chunk in shared if chunk.group <= group), key=lambda chunk: chunk.group)
    return {(chunk.scale, chunk.plane): chunk for chunk in usable}  # of those of one place, the last stays
