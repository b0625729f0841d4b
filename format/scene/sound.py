"""The sound of a scene: packets of an Opus stream (RFC 6716), and which of the samples that they decode to are heard.

Sample n of the sound is heard n / SAMPLE_RATE seconds after the first frame of the clip. A decoder yields `pre_skip`
samples before sample 0: its own delay and, where a sound was cut, the pre-roll in which its state settles.
"""

from bisect import bisect_right
from dataclasses import dataclass, replace
from functools import cached_property
from itertools import accumulate

from kpc.format.common.errors import FormatError

SAMPLE_RATE = 48000  # of the decoder's output, samples per second and channel
# Samples, 160 ms, that a decoder decodes before its output is that of a decoder which began earlier, to -46 dB; the
# error halves with each packet of 20 ms.
PRE_ROLL = 7680
PACKET_SAMPLES_LIMIT = 5760  # samples of a packet, 120 ms

# Samples of a frame by the lowest two bits of its configuration.
_SILK, _CELT = (480, 960, 1920, 2880), (120, 240, 480, 960)


@dataclass(frozen=True)
class Sound:
    """A sound.

    Attributes:
        channels: 1 or 2.
        pre_skip: samples that the decoder yields before those of the sound.
        sample_count: samples of the sound, for each channel.
        packets: Opus packets; of a file that is cut off, those that are there.
    """

    channels: int
    pre_skip: int
    sample_count: int
    packets: tuple[bytes, ...]

    @property
    def duration_s(self) -> float:
        """The length of the sound in seconds."""
        return self.sample_count / SAMPLE_RATE

    @cached_property
    def starts(self) -> tuple[int, ...]:
        """The first decoded sample of each packet, and after the last the number of all; the first is 0."""
        return (0, *accumulate(map(packet_samples, self.packets)))

    def part(self, first: int, count: int) -> "Sound | None":
        """Return the samples `first` to `first + count - 1` as a sound of its own, with its pre-roll.

        No packet is coded anew. None if the sound has no such samples.
        """
        count = min(count, self.sample_count - first, self.starts[-1] - self.pre_skip - first)
        if count < 1:
            return None
        begin, end = first + self.pre_skip, first + self.pre_skip + count
        low = max(bisect_right(self.starts, max(begin - PRE_ROLL, 0)) - 1, 0)
        high = next(k for k, start in enumerate(self.starts) if start >= end)
        return replace(self, pre_skip=begin - self.starts[low], sample_count=count, packets=self.packets[low:high])


def packet_samples(packet: bytes) -> int:
    """Return the samples, for each channel, that an Opus packet decodes to (RFC 6716, section 3.1).

    Raises:
        FormatError: it is empty, or claims no frames or more than 120 ms.
    """
    configuration, code = packet[0] >> 3 if packet else 0, packet[0] & 3 if packet else 0
    if not packet or (code == 3 and len(packet) < 2):
        raise FormatError("soun: a packet is too short for an Opus packet")
    if configuration < 12:
        frame = _SILK[configuration & 3]
    elif configuration < 16:
        frame = (480, 960)[configuration & 1]
    else:
        frame = _CELT[configuration & 3]
    frames = packet[1] & 63 if code == 3 else min(code, 1) + 1
    if not 0 < frames * frame <= PACKET_SAMPLES_LIMIT:
        raise FormatError(f"soun: a packet of {frames} frames of {frame} samples is no Opus packet")
    return frames * frame
