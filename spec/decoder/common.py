"""Section 3: notation. What all parts of the decoder use."""

import struct

PLANES = ["xy", "xz", "yz", "xt", "yt", "zt"]


class Refused(Exception):
    """The file breaks a rule of the specification."""


def require(condition, message):
    if not condition:
        raise Refused(message)


def clamp(x, low, high):
    return min(max(x, low), high)


def crc32c(data):
    crc = 0xFFFFFFFF
    for byte in data:
        crc ^= byte
        for _ in range(8):
            crc = crc >> 1 ^ (0x82F63B78 if crc & 1 else 0)  # 0x1EDC6F41 with its bits reversed
    return crc ^ 0xFFFFFFFF


def f32(x):
    """Round to the nearest float32."""
    return struct.unpack("<f", struct.pack("<f", x))[0]


def unpack_bits(data, count):
    require(len(data) == -(-count // 8), "a bit string has another length")
    unpacked = [data[i // 8] >> i % 8 & 1 for i in range(8 * len(data))]
    require(not any(unpacked[count:]), "unused bits are not 0")
    return unpacked[:count]


class ByteReader:
    """Reads a chunk from front to back."""

    def __init__(self, data):
        self.data, self.position = data, 0

    def take(self, length):
        require(self.position + length <= len(self.data), "a chunk is too short")
        self.position += length
        return self.data[self.position - length : self.position]

    def unpack(self, layout):
        return struct.unpack("<" + layout, self.take(struct.calcsize("<" + layout)))

    def remaining(self):
        return self.take(len(self.data) - self.position)

    def finish(self):
        require(self.position == len(self.data), "a chunk is too long")
