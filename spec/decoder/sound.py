"""Section 6.9: sound."""

from .common import ByteReader, require

SILK, CELT = [480, 960, 1920, 2880], [120, 240, 480, 960]


def decode_sound(segments):
    """Return channels, pre_skip, sample_count and the packets; None without any.

    segments: (chunk, content) of all soun chunks; the content is None where a prefix lacks it.
    """
    segments = sorted(segments, key=lambda segment: segment[0].row_start)
    total = 0
    for chunk, _ in segments:
        require(chunk.scale == chunk.plane == 0, "invalid fields of an index entry")
        require(chunk.row_start == total and 1 <= chunk.row_count <= 480000, "sound overlaps or leaves samples out")
        total += chunk.row_count
    require(total < 2**32, "there are too many samples")
    sound = None
    for chunk, content in segments:
        if content is None:
            break
        head, packets = decode_segment(content.data)
        require(sum(samples_of(packet) for packet in packets) == chunk.row_count, "invalid number of samples")
        channels, pre_skip, sample_count = head
        require(channels in (1, 2) and sample_count >= 1 and pre_skip + sample_count <= total, "invalid sound")
        sound = sound or (head, [])
        require(sound[0] == head, "chunks of sound disagree")
        sound[1].extend(packets)
    return sound and dict(zip(("channels", "pre_skip", "sample_count"), sound[0]), packets=sound[1])


def decode_segment(content):
    require(len(content) <= 2**20, "a chunk of sound is too long")
    reader = ByteReader(content)
    *head, packet_count = reader.unpack("BHIH")
    lengths = reader.unpack(f"{packet_count}H")
    packets = [reader.take(length) for length in lengths]
    reader.finish()
    return head, packets


def samples_of(packet):
    require(len(packet) >= 1, "a packet is empty")
    configuration, code = packet[0] >> 3, packet[0] % 4
    if configuration < 12:
        frame = SILK[configuration % 4]
    elif configuration < 16:
        frame = 480 if configuration % 2 == 0 else 960
    else:
        frame = CELT[configuration % 4]
    if code == 3:
        require(len(packet) >= 2, "a packet is too short")
        frames = packet[1] % 64
    else:
        frames = 1 if code == 0 else 2
    require(1 <= frames and frames * frame <= 5760, "invalid packet")
    return frames * frame
