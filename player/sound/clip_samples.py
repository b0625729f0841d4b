"""The samples of a clip, decoded as they are wanted, from a file that may be on a server."""

from collections import OrderedDict

import numpy as np

from kpc.format.container.clip_sound import SoundSpan, sound_spans
from kpc.format.container.groups import Groups
from kpc.format.container.scene_reader import SceneReader
from kpc.format.container.sound_chunk import SoundSegment
from kpc.format.container.sources import RemoteSource
from kpc.format.scene.sound import PRE_ROLL, Sound
from kpc.player.sound.opus import decode

MISSING = "sound is missing, since the file is cut off"
# Pre-roll of a block that is decoded by itself: so much that nothing is heard of where it begins.
SEAMLESS = 2 * PRE_ROLL
HELD_CHUNKS = 4  # of Opus packets, which the blocks that follow one another share


class ClipSamples:
    """Random access to the samples of a clip in groups or of a scene. For one thread, which may wait for a server.

    Args:
        groups: of the file.

    Attributes:
        notice: MISSING, once samples have been asked for that are not in the file; None before.
    """

    def __init__(self, groups: Groups) -> None:
        self._groups, self._spans = groups, sound_spans(groups.timeline)
        self._reader: tuple[int, SceneReader] | None = None
        self._own_source: RemoteSource | None = None
        self._chunks: OrderedDict[tuple[int, int], SoundSegment] = OrderedDict()
        self.notice: str | None = None

    def read(self, first: int, count: int) -> np.ndarray:
        """Return (count, 2) float32: the samples from `first` on, 0 where there are none.

        Raises:
            KpcError: the file cannot be read, or there is no decoder.
        """
        found = np.zeros((count, 2), np.float32)
        for span in self._spans:
            begin, stop = max(first, span.first), min(first + count, span.stop)
            if begin < stop and not self._groups.available(span.group):
                self.notice = MISSING
            elif begin < stop:
                samples = self._of_group(span, begin - span.start, stop - begin)
                found[begin - first :][: len(samples)] = samples  # one channel is heard on both sides
        return found

    def close(self) -> None:
        """Close what was opened on a server; a read in progress fails."""
        if self._own_source is not None:
            self._own_source.close()

    def _of_group(self, span: SoundSpan, first: int, count: int) -> np.ndarray:
        """Return samples of a group, from its own sample `first` on; fewer at the end of its sound."""
        reader = self._opened(span.group)
        numbers = reader.sound_numbers
        if not numbers:
            return np.zeros((0, 2), np.float32)
        if not reader.available(numbers[0]):
            self.notice = MISSING
            return np.zeros((0, 2), np.float32)
        head = self._chunk(span.group, reader, numbers[0])
        low, high = first + head.pre_skip - SEAMLESS, first + head.pre_skip + count
        entries = [reader.index[number] for number in numbers]
        wanted = [
            (number, entry.row_start)
            for number, entry in zip(numbers, entries, strict=True)
            if entry.row_start < high and entry.row_start + entry.row_count > low
        ]
        needed = [(number, start) for number, start in wanted if reader.available(number)]
        if len(needed) < len(wanted):
            self.notice = MISSING
        if not needed or first >= head.sample_count:
            return np.zeros((0, 2), np.float32)
        packets = [packet for number, _ in needed for packet in self._chunk(span.group, reader, number).packets]
        start = needed[0][1]
        pre_skip = max(head.pre_skip - start, 0)
        whole = Sound(head.channels, pre_skip, max(head.sample_count, 1), tuple(packets))
        part = whole.part(first + head.pre_skip - start - pre_skip, min(count, head.sample_count - first))
        return np.zeros((0, 2), np.float32) if part is None else decode(part)

    def _opened(self, group: int) -> SceneReader:
        if self._reader is None or self._reader[0] != group:
            self.close()
            whole = self._groups.reader.source
            # A server without ranges sends the file once, which all readers share.
            is_shared = isinstance(whole, RemoteSource) and not whole.has_ranges
            self._reader = group, self._groups.open(group, apart=not is_shared)
            source = self._reader[1].source
            self._own_source = source if isinstance(source, RemoteSource) and not is_shared else None
            if self._own_source is not None:
                self._own_source.attempts = float("inf")  # as for planes: wait for a server that does not answer
        return self._reader[1]

    def _chunk(self, group: int, reader: SceneReader, number: int) -> SoundSegment:
        key = group, number
        if key not in self._chunks:
            self._chunks[key] = reader.sound_segment(number)
            while len(self._chunks) > HELD_CHUNKS:
                self._chunks.popitem(last=False)
        self._chunks.move_to_end(key)
        return self._chunks[key]
