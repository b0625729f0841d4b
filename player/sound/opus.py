"""Decoding of Opus packets by libsndfile, through the package soundfile (extra `sound`).

libsndfile reads Opus in Ogg files (RFC 7845), so the packets of a sound are wrapped in Ogg pages (RFC 3533) in memory.
"""

import io
import struct
import zlib
from collections.abc import Sequence
from typing import Any

import numpy as np

from kpc.format.common import extras
from kpc.format.common.errors import MediaError
from kpc.format.scene.sound import SAMPLE_RATE, Sound, packet_samples

SERIAL = 1  # of the stream in the Ogg file
FIRST, LAST = 2, 4  # flags of its first and its last page
# Packets on a page; a packet takes a segment for each 255 bytes, and a page has at most 255. Larger packets are larger
# than Opus has a use for, and become silence.
PAGE_PACKETS, MOST_BYTES = 50, 254 * 255
MISSING = f"no decoder of sound is installed; {extras.install('sound')} brings it"


def decode(sound: Sound) -> np.ndarray:
    """Return the samples of a sound.

    Returns:
        (N, channels) float32, full scale 1: `sample_count` samples, fewer where packets are missing.

    Raises:
        MediaError: soundfile is not installed.
    """
    samples = decode_packets(sound.packets, sound.channels)
    return samples[sound.pre_skip : sound.pre_skip + sound.sample_count]


def decode_packets(packets: Sequence[bytes], channels: int) -> np.ndarray:
    """Return all samples that packets decode to, (N, channels) float32; those of packets that the decoder refuses are
    0. Errors as for `decode`.
    """
    soundfile = _soundfile()
    found = np.zeros((sum(map(packet_samples, packets)), channels), np.float32)
    try:
        if packets:
            samples, _ = soundfile.read(io.BytesIO(ogg_file(packets, channels)), dtype="float32", always_2d=True)
            found[: len(samples)] = samples[: len(found)]
    except (soundfile.SoundFileError, RuntimeError):
        if len(packets) > 1:  # it gives up at a bad packet: find that by halving
            half = len(packets) // 2
            parts = packets[:half], packets[half:]
            return np.concatenate([decode_packets(part, channels) for part in parts])
    return found


def _soundfile() -> Any:
    try:
        import soundfile  # late: it loads a library of several megabytes
    except (ImportError, OSError) as error:
        raise MediaError(MISSING) from error
    return soundfile


def ogg_file(packets: Sequence[bytes], channels: int) -> bytes:
    """Return an Ogg file of Opus packets, all of whose samples are heard."""
    head = b"OpusHead" + struct.pack("<BBHIhB", 1, channels, 0, SAMPLE_RATE, 0, 0)
    tags = b"OpusTags" + struct.pack("<I", 3) + b"kpc" + struct.pack("<I", 0)
    pages, samples = [_page(FIRST, 0, 0, [head]), _page(0, 0, 1, [tags])], 0
    held: list[bytes] = []
    packets = [packet if len(packet) <= MOST_BYTES else _silence(packet) for packet in packets]
    for number, packet in enumerate(packets):
        held.append(packet)
        samples += packet_samples(packet)
        is_last, following = number + 1 == len(packets), packets[number + 1 : number + 2]
        if is_last or len(held) == PAGE_PACKETS or sum(_segments(one) for one in (*held, *following)) > 255:
            pages.append(_page(LAST if is_last else 0, samples, len(pages), held))
            held = []
    return b"".join(pages)


def _silence(packet: bytes) -> bytes:
    """Return a packet of as many samples without any content: frames of no bytes."""
    one = bytes([packet[0] & ~3])
    return bytes([packet[0] | 3, packet_samples(packet) // packet_samples(one)])


def _segments(packet: bytes) -> int:
    return len(packet) // 255 + 1


def _page(flags: int, position: int, number: int, packets: Sequence[bytes]) -> bytes:
    """Return a page of whole packets; `position` is the number of samples up to its end."""
    lacing = b"".join(bytes([255] * (len(packet) // 255) + [len(packet) % 255]) for packet in packets)
    head = struct.pack("<4sBBqIIIB", b"OggS", 0, flags, position, SERIAL, number, 0, len(lacing))
    page = head + lacing + b"".join(packets)
    return page[:22] + struct.pack("<I", _crc(page)) + page[26:]


REVERSED = bytes(int(f"{byte:08b}"[::-1], 2) for byte in range(256))


def _crc(page: bytes) -> int:
    """Return the checksum of a page: the CRC of the polynomial 0x04C11DB7, most significant bit first, from 0.

    zlib's has the same polynomial, but takes the least significant bit first, and complements start and result.
    """
    reflected = zlib.crc32(page.translate(REVERSED), 0xFFFFFFFF) ^ 0xFFFFFFFF
    return int.from_bytes(reflected.to_bytes(4, "little").translate(REVERSED), "big")
