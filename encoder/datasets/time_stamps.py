"""Presentation times of a video's frames, from its packets alone: decoding takes a hundred times as long."""

import os
from dataclasses import dataclass
from fractions import Fraction

import av
import numpy as np
from av.container import InputContainer
from av.packet import Packet
from av.video.frame import VideoFrame
from av.video.stream import VideoStream

from kpc.encoder.datasets.containers import open_container
from kpc.format.common.errors import MediaError
from kpc.format.common.text import agreeing, counted

# Containers whose time line begins at 0, by libav's names. The clocks of others start anywhere.
MP4, MATROSKA, AVI, MPEG_TS = "mov,mp4,m4a,3gp,3g2,mj2", "matroska,webm", "avi", "mpegts"
NO_TIME_STAMPS = 0x80  # AVFMT_NOTIMESTAMPS: bare streams, whose time stamps libav makes up

HIDES_FRAMES = ("vp8",)  # codecs some of whose packets hold no frame to show, but one that others refer to

MOST_BACK_S = 0.5  # time stamps of decoding, which should increase, may go back by this in the order of the file

# A step between frames is a fault of the time stamps from this many seconds and this many median steps on.
LONGEST_STEP_S, LONGEST_STEP = 10.0, 100.0

# A Matroska file is cut off if it ends this much before the length that it declares: seconds, and a share of it.
MISSING_S, MISSING_SHARE = 0.3, 0.02

ASSUMED_FPS = 25.0  # frame rate of a video that has neither time stamps nor a rate


@dataclass(frozen=True)
class TimeStamps:
    """The frames that a video shows.

    Attributes:
        times: (N,) float64, increasing: when each frame is shown, in seconds.
        fps: frames per second as the container declares or averages them.
        are_given: whether packets have presentation times; else they follow from the order of decoding.
        missing: frames that the file should hold, but does not or only in part.
        notes: what a user should know, each as an end of a sentence about the video.
    """

    times: np.ndarray
    fps: float
    are_given: bool
    missing: int
    notes: tuple[str, ...]


@dataclass(frozen=True)
class _Packets:
    """The packets of a video, in the order of the file. None stands for a time that is not given.

    Attributes:
        pts, dts: presentation and decoding times in ticks, of the packets that are shown.
        first: of all packets.
        key: presentation time of the first key frame that is shown.
        before_start: packets before the time line begins.
        missing: as in `TimeStamps`.
    """

    pts: list[int | None]
    dts: list[int | None]
    first: Packet | None
    key: int | None
    before_start: int
    missing: int


def read_time_stamps(
    path: str | os.PathLike[str], container: InputContainer, stream: VideoStream, first: VideoFrame
) -> TimeStamps:
    """Read all packets of an opened file and return when frames are shown.

    Args:
        path: of the file, for messages.
        container, stream: as opened; nothing has been read yet.
        first: the first frame that the decoder shows.

    Raises:
        MediaError: time stamps go back, or leave out more than LONGEST_STEP_S.
    """
    packets = _read_packets(container, stream)
    fps = float(stream.average_rate or stream.guessed_rate or 0) or ASSUMED_FPS
    if container.format.name == AVI or container.format.flags & NO_TIME_STAMPS or None in packets.pts:
        return _from_decoding_order(packets, float(stream.time_base or 0), fps, container.format.name)
    tick = stream.time_base or Fraction(1)
    pts = np.array(packets.pts, np.int64)
    shown = np.unique(pts)
    _require_no_jump(path, shown * float(tick))
    _require_order(path, pts, packets.dts, float(tick))
    lead = shown < (first.pts or 0)
    if lead.any() and (packets.key is None or shown[lead].max() >= packets.key):
        return TimeStamps(shown[~lead] * float(tick), fps, True, packets.missing + int(lead.sum()), ())
    notes = []
    if lead.any():
        unseen = counted(int(lead.sum()), "frame")
        notes.append(f"the first {unseen} cannot be decoded without what came before; left out")
    if packets.before_start:
        early = f"{counted(packets.before_start, 'frame')} before its time line starts"
        notes.append(f"{early} {agreeing(packets.before_start, 'is', 'are')} not shown; left out")
    if len(shown) < len(pts) and stream.codec_context.name not in HIDES_FRAMES:
        count = len(pts) - len(shown)
        words = agreeing(count, "has the time stamp of the next and is", "have the time stamp of the next and are")
        notes.append(f"{counted(count, 'frame')} {words} never shown; left out")
    times = shown[~lead] * tick.numerator / tick.denominator
    times = times + _origin_s(path, container, stream, packets)
    return TimeStamps(times, fps, True, packets.missing, tuple(notes))


def _read_packets(container: InputContainer, stream: VideoStream) -> _Packets:
    """Demultiplex the whole file."""
    form = container.format.name
    pts: list[int | None] = []
    dts: list[int | None] = []
    first, key, count, before_start, end_s, missing = None, None, 0, 0, 0.0, 0
    try:
        for packet in container.demux():
            at = packet.dts if packet.pts is None else packet.pts
            if not packet.size or packet.time_base is None:
                continue
            if at is not None:
                end_s = max(end_s, float((at + (packet.duration or 0)) * packet.time_base))
            if packet.stream_index != stream.index:
                continue
            first, count = first or packet, count + 1
            if packet.is_corrupt and form != MPEG_TS:
                missing += 1
            elif form == MATROSKA and at is None:  # libav gives no times below zero, where nothing is shown
                before_start += 1
            elif not packet.is_discard:
                pts.append(packet.pts)
                dts.append(packet.dts)
                if key is None and packet.is_keyframe:
                    key = packet.pts
    except av.FFmpegError:
        missing += 1
    if form == MP4:
        missing += max(0, len(stream.index_entries) - count)
    elif form == MATROSKA and container.duration:
        lacks_s = container.duration / av.time_base - end_s
        if lacks_s > max(MISSING_S, MISSING_SHARE * end_s):
            missing += max(1, round(lacks_s * float(stream.average_rate or 0)))
    return _Packets(pts, dts, first, key, before_start, missing)


def _from_decoding_order(packets: _Packets, tick_s: float, fps: float, form: str) -> TimeStamps:
    """Return times of frames that have none: those of decoding, in order, or even ones by the frame rate."""
    times = np.sort(np.array([d for d in packets.dts if d is not None], np.float64)) * tick_s
    if len(times) < len(packets.dts) or (np.diff(times) <= 0).any():
        times = np.arange(len(packets.dts)) / fps
    notes = () if form == AVI else (f"no time stamps; {fps:.5g} frames a second are assumed",)
    return TimeStamps(times - times[:1].sum(), fps, False, packets.missing, notes)


def _require_order(path: str | os.PathLike[str], pts: np.ndarray, dts: list[int | None], tick_s: float) -> None:
    """Refuse recordings that were joined, so that time stamps start again."""
    decoding = np.array([d for d in dts if d is not None], np.int64)
    for stamps, late in ((decoding, MOST_BACK_S / tick_s), (pts, LONGEST_STEP_S / tick_s)):
        back = np.maximum.accumulate(stamps) - stamps if len(stamps) else stamps
        if back.max(initial=0) > late:
            frame = int((back > late).argmax())
            raise MediaError(
                f"{path}: its time stamps go back by {back.max() * tick_s:.4g} s at frame {frame}, as where recordings "
                "are joined; split it there or encode it anew"
            )


def _require_no_jump(path: str | os.PathLike[str], times: np.ndarray) -> None:
    steps = np.diff(times)
    if len(steps) and steps.max() > max(LONGEST_STEP_S, LONGEST_STEP * float(np.median(steps))):
        raise MediaError(
            f"{path}: its time stamps jump by {steps.max():.4g} s after frame {int(np.argmax(steps))}; split it there "
            "or encode it anew"
        )


def _origin_s(path: str | os.PathLike[str], container: InputContainer, stream: VideoStream, packets: _Packets) -> float:
    """Return what to add to libav's times, so that they count from the origin that the file means.

    Where an edit list begins between two frames, libav moves the first whole one to where the list begins.
    """
    if container.format.name == MP4 and packets.first is not None and packets.first.is_discard:
        with open_container(path, advanced_editlist="0") as plain:
            same = next(iter(plain.demux(plain.streams[stream.index])), None)
            if same is not None and same.pos == packets.first.pos:
                return float(((same.pts or 0) - (packets.first.pts or 0)) * (stream.time_base or 0))
    if container.format.name in (MP4, MATROSKA):
        return 0.0
    return -(container.start_time or 0) / av.time_base
