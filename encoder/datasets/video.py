"""Reading of videos through PyAV: the frames that a player would show, with the times at which it would show them.

Times. A container's edit list is honoured: what it hides is not read. The times of MP4, QuickTime and Matroska files
are those of the file's own time line, so that a track that starts late stays late. The clocks of other containers,
such as MPEG transport streams, start anywhere; their times count from the start of the file. AVI files and bare
streams hold no presentation times: their frames follow one another in the order of decoding times.

Colour. Frames are R'G'B' in [0, 255]. The tags for matrix, range, chroma layout and bit depth are honoured. Where tags
are missing this does as players do: limited range, BT.601 below 720 lines and BT.709 from there on. HDR transfer curves
(PQ, HLG) are refused, since they would be shown wrong. Primaries are not converted.

Damage is what the decoder or the container reports as such (a packet or frame marked corrupt, a packet or frame that
is missing), never a message for people.
"""

import os
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass, field

import av
import av.filter
import numpy as np
from av.container import InputContainer
from av.stream import Disposition
from av.video.frame import VideoFrame
from av.video.stream import VideoStream

from kpc.encoder.datasets.containers import open_container
from kpc.encoder.datasets.time_stamps import read_time_stamps
from kpc.format.common.errors import MediaError
from kpc.format.common.films import SCALE_FLAGS
from kpc.format.common.media_files import require_file
from kpc.format.common.text import agreeing, counted

# The colour matrices that ffmpeg's scale filter converts, by their numbers in ITU-T H.273, and those of H.273 that it
# does not. 2 and 3 mean that the matrix is unknown.
_MATRICES = {1: "bt709", 4: "fcc", 5: "bt601", 6: "bt601", 7: "smpte240m", 9: "bt2020"}
_OTHER_MATRICES = {8: "YCgCo", 10: "BT.2020 constant luminance", 14: "ICtCp", 15: "IPT"}

# Transfer characteristics of H.273 that are far from BT.709, and colour primaries that are about those of sRGB.
_HDR_CURVES = {16: "PQ", 18: "HLG"}
_OTHER_CURVES = {8: "linear light", 9: "logarithmic", 10: "logarithmic", 17: "SMPTE ST 428-1"}
_COMMON_PRIMARIES = (0, 1, 2, 3, 5, 6, 7)

# libav's numbers of projections, but for the flat ones, and of packings of two views in one picture or in turn.
_PROJECTIONS = {0: "equirectangular", 1: "a cube map", 2: "equirectangular", 3: "half equirectangular", 5: "fisheye"}
_PACKINGS = range(1, 8)

# libav's numbers of field orders: which field is shown first.
_TOP_FIRST, _BOTTOM_FIRST = (2, 5), (3, 4)

_NOT_FILM = Disposition.attached_pic | Disposition.timed_thumbnails  # video streams that are pictures of a cover


@dataclass(frozen=True)
class VideoInfo:
    """Properties of a video.

    Attributes:
        width, height: pixels as stored, after the display rotation that phones record.
        times: (N,) float64, increasing: when each frame is shown, in seconds.
        tick_s: the resolution of the time stamps, seconds.
        fps: frames per second as the container declares or averages them.
        pix_fmt: libav's name of the pixel format, such as "yuv420p10le".
        matrix: colour matrix, "bt601", "bt709", "bt2020", "fcc", "smpte240m" or "rgb".
        full_range: whether values use the full range; False for 16..235.
        has_alpha: whether frames have a fourth channel, straight alpha.
        pixel_aspect: width of a pixel by its height.
        interlaced: whether frames consist of two fields, which `read_video` deinterlaces.
        has_time_stamps: whether frames have presentation times; else `times` follows from the order of decoding.
        notes: what a user should know about how the video is read, each as an end of a sentence about it.
        timecode: of the first frame, which is not used; None without one.
    """

    width: int
    height: int
    times: np.ndarray = field(compare=False, repr=False)
    tick_s: float
    fps: float
    pix_fmt: str
    matrix: str
    full_range: bool
    has_alpha: bool
    pixel_aspect: float
    interlaced: bool
    has_time_stamps: bool
    notes: tuple[str, ...]
    timecode: str | None = None

    @property
    def frame_count(self) -> int:
        """The number of frames that are shown."""
        return len(self.times)


def video_info(path: str | os.PathLike[str]) -> VideoInfo:
    """Return a video's size, times and colour. All packets are read, but only the first frame is decoded.

    Raises:
        MediaError: the file is missing, cut off, not a video, its time stamps are unusable, or its colours cannot be
            converted.
    """
    with _opened(path) as (container, stream):
        first = next((frame for frame in _decoded(container, stream) if frame is not None), None)
    if first is None:
        raise MediaError(f"{path}: none of its frames decodes; encode or copy it anew")
    with _opened(path) as (container, stream):
        stamps = read_time_stamps(path, container, stream, first)
        if stamps.missing:
            whole = sum(frame is not None for frame in _decoded_anew(path))
            raise _damaged(path, whole, max(whole, len(stamps.times)) + stamps.missing)
        _require_pinhole(path, first)
        turned = _transposes(_display_matrix(path, first))
        height, width = (first.width, first.height) if turned else (first.height, first.width)
        aspect = float(stream.sample_aspect_ratio or 1)
        interlaced = first.interlaced_frame or stream.codec_context.field_order in (*_TOP_FIRST, *_BOTTOM_FIRST)
        return VideoInfo(
            width=width,
            height=height,
            times=stamps.times,
            tick_s=float(stream.time_base or 0),
            fps=stamps.fps,
            pix_fmt=first.format.name,
            matrix=_matrix(path, first, stream, height),
            full_range=2 in (first.color_range, stream.codec_context.color_range) or first.format.name[:4] == "yuvj",
            has_alpha=_has_alpha(path, first, stream),
            pixel_aspect=1 / aspect if turned else aspect,
            interlaced=interlaced,
            has_time_stamps=stamps.are_given,
            notes=(
                *_stream_notes(container),
                *stamps.notes,
                *(["interlaced; deinterlaced (bwdif)"] * interlaced),
                *_colour_notes(first),
            ),
            timecode=stream.metadata.get("timecode") or container.metadata.get("timecode"),
        )


def read_video(
    path: str | os.PathLike[str], info: VideoInfo | None = None, first: int = 0, stop: int | None = None
) -> Iterator[np.ndarray]:
    """Decode the frames `first` up to `stop` of a video, interlaced ones to whole frames.

    Args:
        path: of the video.
        info: its properties, if `video_info` has already been called.
        first, stop: numbers of frames, by `info.times`; None for its end.

    Yields:
        (height, width, 3) uint8 R'G'B', or 4 channels with straight alpha if `info.has_alpha`.

    Raises:
        MediaError: the file is damaged, or changes in size.
    """
    info = info or video_info(path)
    stop = info.frame_count if stop is None else stop
    with _opened(path) as (container, stream):
        stream.thread_type = "AUTO"
        shown = _shown(path, container, stream, info)
        # PyAV links side data and frame in a circle: a frame whose side data were read keeps its pixels until garbage
        # is collected, hundreds of frames later. They are therefore read only where the rotation changes.
        rotation, matrix = None, np.eye(2)
        for number, frame in enumerate(_converted(path, shown, info, stream)):
            if number >= first:
                if frame.rotation != rotation:
                    rotation, matrix = frame.rotation, _display_matrix(path, frame)
                yield _upright(frame.to_ndarray(), matrix)
            if number + 1 >= stop:
                return


@contextmanager
def _opened(path: str | os.PathLike[str]) -> Iterator[tuple[InputContainer, VideoStream]]:
    """Open a file and choose its first stream of film."""
    require_file(path)
    try:
        container = open_container(path)
    except PermissionError as error:
        raise MediaError(f"{path}: no permission to read it; chmod it or run as its owner") from error
    except (av.FFmpegError, ValueError) as error:
        reason = getattr(error, "strerror", None) or type(error).__name__
        raise MediaError(f"{path}: not a video that can be read ({reason}); encode or copy it anew") from error
    with container:
        films = _films(container)
        if not films:
            kinds = sorted({str(stream.type) for stream in container.streams}) or ["nothing"]
            raise MediaError(f"{path}: holds no video, only {' and '.join(kinds)}; give a video or remove it")
        if films[0].codec_context is None:
            raise MediaError(f"{path}: no decoder for its codec; convert it to H.264")
        yield container, films[0]


def _films(container: InputContainer) -> list[VideoStream]:
    return [stream for stream in container.streams.video if not stream.disposition & _NOT_FILM]


def _stream_notes(container: InputContainer) -> list[str]:
    count = len(_films(container))
    return [f"{count} video streams; the first is used"] if count > 1 else []


def _colour_notes(frame: VideoFrame) -> list[str]:
    number = int(frame.color_primaries)
    return [] if number in _COMMON_PRIMARIES else [f"colour primaries number {number} of H.273 are not converted"]


def _decoded(container: InputContainer, stream: VideoStream) -> Iterator[VideoFrame | None]:
    """Yield decoded frames in the order in which they are shown, and None for each that is damaged.

    Whatever cannot be decoded before the first key frame is skipped: it refers to what came before the recording.
    """
    # Transport streams mark a packet as corrupt where counters jump, as they do where files were joined. The decoder
    # knows whether anything is missing.
    trusts_marks = container.format.name != "mpegts"
    started = False
    packets = container.demux(stream)
    while True:
        try:
            packet = next(packets)
        except StopIteration:
            return
        except av.FFmpegError:
            yield None
            return
        started = started or packet.is_keyframe
        if not trusts_marks:
            packet.is_corrupt = False
        try:
            for frame in packet.decode():
                if started or not frame.is_corrupt:  # type: ignore[union-attr]
                    yield None if frame.is_corrupt else frame  # type: ignore[misc,union-attr]
        except av.FFmpegError:
            if started:
                yield None


def _decoded_anew(path: str | os.PathLike[str]) -> Iterator[VideoFrame | None]:
    with _opened(path) as (container, stream):
        yield from _decoded(container, stream)


def _shown(
    path: str | os.PathLike[str], container: InputContainer, stream: VideoStream, info: VideoInfo
) -> Iterator[VideoFrame]:
    """Yield the frames of `info.times`, after a check of each one's time stamp.

    The last of several frames with one time stamp is shown.

    Raises:
        MediaError: frames are damaged or missing, or come at other times.
    """
    number, origin, held = 0, 0, None
    frames = _decoded(container, stream)
    for frame in frames:
        if frame is None:
            if held is None:
                continue  # `video_info` found the first frame behind it
            raise _damaged(path, number + 1 + sum(frame is not None for frame in frames), info.frame_count)
        if info.has_time_stamps and frame.pts is None:
            continue  # before the time line starts
        if held is None:
            origin = frame.pts or 0
        elif not info.has_time_stamps or frame.pts != held.pts:
            yield held
            number += 1
        held = frame
        if info.has_time_stamps and not _is_at(info, number, frame, origin):
            whole = number + 1 + sum(frame is not None for frame in frames)
            if whole < info.frame_count:
                raise _damaged(path, whole, info.frame_count)
            raise MediaError(
                f"{path}: frame {number} is decoded for another time than its packet says, so its time stamps are "
                "wrong; encode it anew"
            )
    if held is None or number + 1 < info.frame_count:
        raise _damaged(path, number + (held is not None), info.frame_count)
    yield held


def _is_at(info: VideoInfo, number: int, frame: VideoFrame, origin: int) -> bool:
    """Return whether a frame comes as long after the first, at `origin`, as its number says."""
    if number >= info.frame_count:
        return False
    time = float(((frame.pts or 0) - origin) * (frame.time_base or 0))
    return bool(abs(time - (info.times[number] - info.times[0])) < 0.6 * info.tick_s + 1e-6)


def _damaged(path: str | os.PathLike[str], whole: int, count: int) -> MediaError:
    share = f"{whole} of its {counted(count, 'frame')} {agreeing(whole, 'decodes', 'decode')}"
    return MediaError(f"{path}: {share}, so it is damaged or cut off; copy it anew")


def _converted(
    path: str | os.PathLike[str], frames: Iterator[VideoFrame], info: VideoInfo, stream: VideoStream
) -> Iterator[VideoFrame]:
    """Convert frames to 8-bit R'G'B', and interlaced ones to whole frames, by libav's filters."""
    graph, kind, size = None, None, None
    for number, frame in enumerate(frames):
        size = size or (frame.width, frame.height)
        if (frame.width, frame.height) != size:
            raise MediaError(
                f"{path}: frame {number} is {frame.width}x{frame.height}, the first {size[0]}x{size[1]}; split it there"
            )
        # A stream may change its format, and become interlaced later on.
        interlaced = info.interlaced or frame.interlaced_frame or (kind is not None and kind[1])
        if graph is None or kind != (frame.format.name, interlaced):
            if graph is not None:
                yield from _pulled(graph, None)
            kind = (frame.format.name, interlaced)
            graph = _graph(frame, info, _deinterlacing(frame, stream) if interlaced else None)
        yield from _pulled(graph, frame)
    if graph is not None:
        yield from _pulled(graph, None)


def _pulled(graph: av.filter.Graph, frame: VideoFrame | None) -> Iterator[VideoFrame]:
    """Push a frame, or None at the end, and yield what comes out."""
    graph.vpush(frame)
    while True:
        try:
            yield graph.vpull()
        except (av.BlockingIOError, av.EOFError):
            return


def _graph(frame: VideoFrame, info: VideoInfo, deinterlacing: dict[str, str] | None) -> av.filter.Graph:
    graph = av.filter.Graph()
    source = graph.add(
        "buffer",
        video_size=f"{frame.width}x{frame.height}",
        pix_fmt=frame.format.name,
        time_base=str(frame.time_base),
        pixel_aspect="1/1",
        colorspace=str(int(frame.colorspace)),
        range=str(int(frame.color_range)),
    )
    fields = [] if deinterlacing is None else [graph.add("bwdif", mode="send_frame", **deinterlacing)]
    of_yuv = {"in_color_matrix": info.matrix, "in_range": "full" if info.full_range else "limited"}
    scale = graph.add("scale", flags=SCALE_FLAGS, out_range="full", **({} if info.matrix == "rgb" else of_yuv))
    wanted = graph.add("format", "rgba" if info.has_alpha else "rgb24")
    graph.link_nodes(source, *fields, scale, wanted, graph.add("buffersink"))
    graph.configure()
    return graph


def _deinterlacing(frame: VideoFrame, stream: VideoStream) -> dict[str, str]:
    """Return options of bwdif: what frames say of themselves or, where they say nothing, what the container does."""
    order = stream.codec_context.field_order
    if frame.interlaced_frame or order not in (*_TOP_FIRST, *_BOTTOM_FIRST):
        return {"deint": "interlaced", "parity": "auto"}
    return {"deint": "all", "parity": "tff" if order in _TOP_FIRST else "bff"}


def _require_pinhole(path: str | os.PathLike[str], frame: VideoFrame) -> None:
    """Refuse pictures that are no perspective projection, or two in one.

    Raises:
        MediaError: the video says that it is spherical, fisheye or stereoscopic.
    """
    spherical, stereo = (frame.side_data.get(kind) for kind in ("SPHERICAL", "STEREO3D"))
    projection = _PROJECTIONS.get(_first_int(spherical)) if spherical is not None else None
    if projection is not None:
        raise MediaError(f"{path}: its projection is {projection}; undistort it to a pinhole")
    if stereo is not None and _first_int(stereo) in _PACKINGS:
        raise MediaError(f"{path}: is stereoscopic, two views in one video; split them into two videos")


def _first_int(side_data: object) -> int:
    """Return the number with which libav's structures of side data begin."""
    return int(np.frombuffer(bytes(side_data), np.int32, 1)[0])  # type: ignore[call-overload]


def _display_matrix(path: str | os.PathLike[str], frame: VideoFrame) -> np.ndarray:
    """Return the matrix [[a, b], [c, d]] that takes a stored pixel (x, y) to (a x + c y, b x + d y) on the screen.

    Raises:
        MediaError: it turns the picture by other than quarter turns.
    """
    found = frame.side_data.get("DISPLAYMATRIX")
    numbers = b"" if found is None else bytes(found)  # type: ignore[call-overload]
    matrix = np.frombuffer(numbers, np.int32).reshape(3, 3)[:2, :2] / 65536 if numbers else np.eye(2)
    one = np.abs(matrix) > 0.5 * np.abs(matrix).max()
    if np.abs(matrix[~one]).max(initial=0) > 0.01 * np.abs(matrix).max() or one.sum() != 2 or one[0, 0] != one[1, 1]:
        raise MediaError(f"{path}: its rotation is no quarter turn ({frame.rotation} degrees); turn and encode it anew")
    return np.where(one, np.sign(matrix), 0)


def _transposes(matrix: np.ndarray) -> bool:
    return bool(matrix[0, 0] == 0)


def _upright(pixels: np.ndarray, matrix: np.ndarray) -> np.ndarray:
    """Turn and mirror (H, W, C) pixels by `_display_matrix`."""
    across, down = matrix.sum(0)  # the signs of the horizontal and the vertical axis of the screen
    turned = pixels.swapaxes(0, 1) if _transposes(matrix) else pixels
    return np.ascontiguousarray(turned[:: int(down), :: int(across)])


def _matrix(path: str | os.PathLike[str], frame: VideoFrame, stream: VideoStream, height: int) -> str:
    """Return the colour matrix of a video.

    Raises:
        MediaError: its transfer curve or matrix is one that would be shown wrong.
    """
    for curve in (int(frame.color_trc), int(stream.codec_context.color_trc)):
        if curve in _HDR_CURVES:
            raise MediaError(f"{path}: HDR video ({_HDR_CURVES[curve]}); tone-map it to BT.709 first")
        if curve in _OTHER_CURVES:
            raise MediaError(f"{path}: its transfer curve is {_OTHER_CURVES[curve]}; convert it to BT.709 first")
    if frame.format.is_rgb or frame.format.has_palette:
        return "rgb"
    for number in (int(frame.colorspace), int(stream.codec_context.colorspace)):
        if number in _MATRICES:
            return _MATRICES[number]
        if number not in (0, 2, 3):
            name = _OTHER_MATRICES.get(number, f"number {number} of H.273")
            raise MediaError(f"{path}: colour matrix {name}; convert it to BT.709 first")
    return "bt601" if height < 720 else "bt709"


def _has_alpha(path: str | os.PathLike[str], frame: VideoFrame, stream: VideoStream) -> bool:
    if any(component.is_alpha for component in frame.format.components):
        return True
    if stream.metadata.get("alpha_mode", stream.metadata.get("ALPHA_MODE")) == "1":
        raise MediaError(
            f"{path}: its alpha channel is a stream inside the other, which is not decoded; convert it to ProRes 4444 "
            "or FFV1"
        )
    return False
