"""Zstandard frames (RFC 8878) that no encoder writes."""

import struct

HEAD = b"\x28\xb5\x2f\xfd"
SINGLE_SEGMENT = 0x20  # the size of the content takes 1 byte
FOUR_BYTES = 0x80  # it takes 4
REPEATED, COMPRESSED = 1, 2  # types of blocks
BLOCK = 1 << 17  # the largest content of a block in bytes


def run_of_zeros() -> bytes:
    """Return a small frame of 1 MiB: eight blocks of 128 KiB of zeros each."""
    head = HEAD + bytes([SINGLE_SEGMENT | FOUR_BYTES]) + struct.pack("<I", 8 * BLOCK)
    return head + b"".join(_block_header(block == 7, REPEATED, BLOCK) + b"\0" for block in range(8))


def endless_weights(length: int) -> bytes:
    """Return a frame that claims so many bytes, fewer than 256, and whose Huffman weights never end for decoders that
    wait for their bits to run out: one symbol has all 32 states of the FSE table, so that no state takes a bit
    (sections 4.1.1 and 4.2.1).
    """
    table = struct.pack("<H", 0b111111_0000)  # accuracy 5; value 33, in 6 bits: symbol 0 has probability 32
    tree = bytes([len(table) + 1]) + table + b"\1"
    literals = struct.pack("<I", 2 | 6 << 4 | (len(tree) + 1) << 14)[:3] + tree + b"\1"
    block = literals + b"\0"  # no sequences
    return HEAD + bytes([SINGLE_SEGMENT, length]) + _block_header(True, COMPRESSED, len(block)) + block


def _block_header(is_last: bool, kind: int, size: int) -> bytes:
    return struct.pack("<I", is_last | kind << 1 | size << 3)[:3]
