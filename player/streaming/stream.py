"""Playback of a scene while it arrives: one thread fetches and decodes, the window's thread takes over the result.

    fetching thread   chooses a segment (`kpc.player.streaming.prefetch`), reads it, checks its CRC32C, decodes it
    window's thread   `set_playhead` sets the position; `upload` takes over segments, a limited number of bytes a frame

The window's thread waits for nothing but a lock that is held briefly. Segments of time planes stay in memory as symbols
and are dropped when the playhead has passed them and the memory is needed; space planes are kept on the graphics card
only. Local files are read in the same way as those of a server.
"""

import math
import threading
import time as clock
from collections import deque
from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from kpc.format.coding.quantise import dequantise_symbols
from kpc.format.common.compiling import MONITOR, NOTICE
from kpc.format.common.errors import BudgetError, FormatError, InterruptedRead, KpcError
from kpc.format.common.memory import DEFAULT_BUDGET
from kpc.format.common.text import byte_text
from kpc.format.container.container import Reader
from kpc.format.container.partial import PartialScene
from kpc.format.container.runs import adjacent_runs, announce
from kpc.format.container.scene_io import SceneReader
from kpc.format.container.sources import RemoteSource, Source
from kpc.format.scene.scene import ALL_PLANES, Scene
from kpc.player.atlas import Layout
from kpc.player.gl.renderer import Renderer
from kpc.player.streaming.prefetch import Playhead, fetch_order, min_segment_bytes, segments_to_keep

# The most that is fetched with one request, bytes and chunks, so that a jump of the playhead does not wait long.
RUN_BYTES, RUN_CHUNKS = 1 << 18, 256
# The most bytes that are handed to the graphics card in a frame; they take about a millisecond.
UPLOAD_BYTES = 1 << 22
# Seconds of the clip that must have arrived before playback continues after it had to wait.
RESUME_S = 0.5
# Bytes that the sound of a clip takes while it is played (`kpc.player.sound.playback`): what is decoded ahead, and
# packets.
SOUND_BYTES = 1 << 23
# Bytes that a scene without its planes may take before it is refused, however small --memory is.
LEAST_BUDGET = 1 << 25
# Seconds over which the rate of arriving bytes is averaged: on a slow line they come in lumps that are seconds apart.
RATE_OVER_S = 5.0


@dataclass(eq=False)
class Piece:
    """A decoded segment.

    Attributes:
        position: in the arrays of the `PartialScene`.
        number: of its chunk.
        data: symbols of a time plane, or texels of a space plane.
        uploaded_rows: rows of a space plane that are on the graphics card.
    """

    position: int
    number: int
    data: np.ndarray
    uploaded_rows: int = 0


class Stream:
    """A scene that is arriving.

    The constructor waits for the header, the index and every chunk but planes; then the fetching thread starts.

    Args:
        source: the scene's file, or a reader of it, whose header and index are used.
        memory: bytes that the scene may take in main memory and on the graphics card together. Pictures, shaders and
            the program itself do not count.
        arrived: called by the fetching thread when a segment has arrived; may wake the window.
        share: what part of --memory this scene may take, for messages.

    Attributes:
        memory: as given.
        scene: what has arrived; `upload` changes it.
        version: a number that grows whenever the scene has changed.

    Raises:
        KpcError: as `SceneReader` and `HttpSource`.
        BudgetError: `memory` is too little to play the scene.
    """

    def __init__(
        self,
        source: Source | Reader,
        *,
        memory: int = DEFAULT_BUDGET,
        arrived: Callable[[], None] = lambda: None,
        share: float = 1.0,
    ) -> None:
        budget = max(memory, LEAST_BUDGET)  # so that a smaller --memory is refused below, with the one that would do
        try:
            self._reader = SceneReader(source, memory_budget=budget, in_parts=True)
            self.parts = PartialScene(self._reader)
        except BudgetError as error:
            raise BudgetError(f"{error}; give more than {memory_option(budget / share)}") from error
        self.source: Source = self._reader.source
        self.memory, self.arrived, self.version = memory, arrived, 0
        self.scene: Scene = self.parts.scene
        self._layout = Layout.of(self.scene)
        fixed, least = self.fixed_bytes, min_segment_bytes(self.parts)
        if fixed + least > memory:
            needed = math.ceil((fixed + least) / share / 1e6)
            raise BudgetError(
                f"{self.source.name}: playing takes more than {memory_option(memory / share)}; give --memory {needed}MB"
            )
        self._segment_memory = memory - fixed
        self._stored = np.array([self.parts.entry(number).stored_length for number in self.parts.numbers])
        self._requested = np.zeros(len(self._stored), bool)  # fetched or being fetched, and not dropped since
        self._loaded = np.zeros(len(self._stored), bool)  # uploaded, or put into the scene
        # Segments beyond the end of a file that is cut off are never fetched, nor waited for.
        self._missing = np.array([not self._reader.available(int(number)) for number in self.parts.numbers])
        self._head, fitting = Playhead(), segments_to_keep(self.parts, Playhead(), self._segment_memory)
        self._keep, self._exceeds_memory = fitting & ~self._missing, not fitting.all()
        self._finished: deque[Piece] = deque()
        self._change = threading.Condition()
        self._closed = False
        self._fetching: int | None = None
        self._trouble: str | None = None
        self._failure: KpcError | OSError | None = None
        self._bug: BaseException | None = None
        self._stalled = True
        self._history: deque[tuple[float, int]] = deque()  # (time, bytes received until then) over the last RATE_OVER_S
        if isinstance(self.source, RemoteSource):
            self.source.attempts, self.source.report = float("inf"), self._set_trouble
        self._thread = threading.Thread(target=self._run, name="fetching", daemon=True)
        self._thread.start()

    # --- called by the window's thread

    def set_playhead(self, head: Playhead) -> None:
        """Set the position in the clip. Segments far behind it are dropped if the memory is needed."""
        with self._change:
            self._head = head
            if self._exceeds_memory:
                self._keep = segments_to_keep(self.parts, head, self._segment_memory) & ~self._missing
                self._drop(self._loaded & ~self._keep)
            if (self._keep & ~self._requested).any():
                self._change.notify_all()
                self._interrupt_for(head.time)

    def upload(self, renderer: Renderer, max_bytes: float = UPLOAD_BYTES) -> bool:
        """Take over finished segments. The last space plane of a finer scale waits for the scale's time planes.

        Args:
            renderer: the renderer of the scene.
            max_bytes: of space planes to upload at most, to within a row.

        Returns:
            Whether the picture may have changed.

        Raises:
            BaseException: an unexpected error of the fetching thread.
        """
        if self._bug is not None:
            raise self._bug
        changed = refresh = False
        while max_bytes > 0 and (piece := self._next_finished()) is not None:
            if self.parts.moves[piece.position]:
                self.parts.put(piece.number, piece.data)
                refresh = is_done = True
            else:
                entry, row = self.parts.entry(piece.number), piece.data[0].nbytes
                end = min(piece.uploaded_rows + max(int(max_bytes // row), 1), len(piece.data))
                renderer.put(
                    entry.scale, ALL_PLANES[entry.plane], piece.data[piece.uploaded_rows : end], piece.uploaded_rows
                )
                max_bytes -= (end - piece.uploaded_rows) * row
                piece.uploaded_rows, is_done = end, end == len(piece.data)
            changed = True
            if is_done:
                with self._change:
                    self._finished.remove(piece)
                    self._loaded[piece.position] = True
                    self._drop(self._loaded & ~self._keep)
                    self._change.notify_all()
        if refresh:
            renderer.refresh()
        self.version += changed
        return changed

    def can_show(self, time: float, rate: float = 0.0) -> bool:
        """Return whether the picture at `time` can be drawn; after a wait, only once the next RESUME_S are there.

        It needs the segments at `time` of all scales whose space planes have arrived, and of scale 0 at least: a
        picture does not become coarser again.

        Args:
            time: of the clip, [0, 1].
            rate: fraction of the clip that is played per second.
        """
        end = min(time + rate * RESUME_S, 1.0) if self._stalled else time
        self._stalled = self._is_lacking(self.parts.scales < max(self.complete_scales, 1), time, end)
        return not self._stalled

    @property
    def complete_scales(self) -> int:
        """The number of scales, from the coarsest on, whose space planes have arrived."""
        missing = self.parts.scales[~self.parts.moves & ~self._loaded]
        return int(missing.min()) if len(missing) else int(self.parts.scales.max()) + 1

    @property
    def is_settled(self) -> bool:
        """Whether everything that fits the memory has arrived, or nothing more will."""
        if self._failure is not None:
            return True
        with self._change:
            return not (self._keep & ~self._loaded).any()

    @property
    def loaded_fraction(self) -> float:
        """The fraction of the bytes of all planes that has arrived."""
        return float(self._stored[self._loaded].sum() / max(self._stored.sum(), 1))

    @property
    def bytes_per_s(self) -> float:
        """Bytes per second, over the last RATE_OVER_S or since it was last asked for, if that is longer."""
        now = clock.monotonic()
        self._history.append((now, self.received))
        while len(self._history) > 2 and self._history[1][0] <= now - RATE_OVER_S:
            self._history.popleft()
        (since, before), (until, after) = self._history[0], self._history[-1]
        return (after - before) / (until - since) if until > since else 0.0

    @property
    def received(self) -> int:
        """Bytes that have arrived so far, from a server or a disk."""
        return (
            self.source.received_bytes
            if isinstance(self.source, RemoteSource)
            else int(self._stored[self._requested].sum())
        )

    @property
    def memory_bytes(self) -> int:
        """Bytes of the segments of time planes that have arrived or are being fetched."""
        with self._change:
            return int(self.parts.sizes[self._requested & self.parts.moves].sum())

    @property
    def fixed_bytes(self) -> int:
        """Bytes that the scene takes besides segments of time planes.

        They are those of the renderer without pictures, of occupancy and motion, of planes that wait to be uploaded and
        one that is being decoded, of the source, of planes that groups share, and of sound.
        """
        scene, layout = self.scene, self._layout
        largest = max(layout.layers[block.scale] * block.width * block.height for block in layout.blocks)
        motion = 0 if scene.motion is None else scene.motion.nbytes
        decoding = UPLOAD_BYTES + 4 * 16 * largest + 2 * self._reader.header.largest_raw
        whole = isinstance(self.source, RemoteSource) and not self.source.has_ranges
        source = (
            self.source.size if whole else 2 * (RUN_BYTES + max(entry.stored_length for entry in self._reader.index))
        )
        sound = SOUND_BYTES if self.has_sound else 0
        kept = self._reader.kept_bytes
        return Renderer.bytes_for(scene) + scene.occupancy.nbytes + motion + decoding + source + kept + sound

    @property
    def has_sound(self) -> bool:
        """Whether the file has sound, which `kpc.player.sound` fetches beside the planes."""
        return bool(self._reader.sound_numbers)

    @property
    def failure(self) -> str | None:
        """Why nothing more will arrive; None if it will."""
        return None if self._failure is None else str(self._failure)

    @property
    def message(self) -> str | None:
        """A message for the user; None if everything works."""
        if self._failure is not None:
            return f"loading stopped: {self._failure}"
        if self._trouble is not None:
            return self._trouble
        if self._stalled and MONITOR.is_compiling:
            return NOTICE
        if self._stalled:
            return loading_message(self.bytes_per_s)
        return None

    def close(self) -> None:
        """End the thread, and close the source."""
        self.arrived = lambda: None
        with self._change:
            self._closed = True
            self._change.notify_all()
        if isinstance(self.source, RemoteSource):
            self.source.close()
        self._thread.join(timeout=0.5)  # if the server does not answer, the thread ends later

    def _next_finished(self) -> Piece | None:
        """Return the segment to take over next: the first one that is not to wait."""
        return next((piece for piece in tuple(self._finished) if not self._is_early(piece)), None)

    def _is_early(self, piece: Piece) -> bool:
        """Whether a segment would complete the space planes of a finer scale, whose time planes are not there yet.

        Playback would stop for them, while coarser scales can be shown.
        """
        scale = self.parts.scales[piece.position]
        if scale == 0 or self.parts.moves[piece.position]:
            return False
        is_of_scale = self.parts.scales == scale
        others = is_of_scale & ~self.parts.moves & ~self._loaded
        others[piece.position] = False
        head = self._head
        end = min(head.time + head.rate * RESUME_S, 1.0)
        return not others.any() and self._is_lacking(is_of_scale & self.parts.moves, head.time, end)

    def _is_lacking(self, which: np.ndarray, time: float, end: float) -> bool:
        """Whether segments among some, (N,) bool, that are needed from a time to another one have not arrived."""
        return bool((which & self.parts.is_needed(time, end) & self._keep & ~self._loaded).any())

    def _interrupt_for(self, time: float) -> None:
        """With the lock held: interrupt a request if segments that the picture needs now would have to wait for it."""
        now = self.parts.is_needed(time, time) & (self.parts.scales < max(self.complete_scales, 1))
        if (
            self._fetching is not None
            and not now[self._fetching]
            and (now & self._keep & ~self._requested).any()
            and isinstance(self.source, RemoteSource)
        ):
            self.source.interrupt()

    def _drop(self, which: np.ndarray) -> None:
        """With the lock held: drop segments of time planes."""
        for position in np.flatnonzero(which & self.parts.moves):
            self.parts.drop(int(self.parts.numbers[position]))
            self._loaded[position] = self._requested[position] = False

    # --- the fetching thread

    def _run(self) -> None:
        try:
            announced: list[int] = []  # chunks that the source fetches together
            while (step := self._next(announced)) is not None:
                position, announced = step
                try:
                    piece = self._fetched(position)
                except InterruptedRead:
                    with self._change:
                        self._requested[position], self._fetching = False, None
                    continue
                with self._change:
                    self._finished.append(piece)
                    self._fetching = None
                self.arrived()
        except (KpcError, OSError) as error:
            if not self._closed:
                self._failure = error
                self.arrived()
        except BaseException as error:  # unexpected: raised again in the window's thread
            self._bug = error
            self.arrived()

    def _next(self, announced: list[int]) -> tuple[int, list[int]] | None:
        """Wait for a segment to fetch; return its position and the chunks that the source holds, None once closed."""
        with self._change:
            while not self._closed:
                order = fetch_order(self.parts, self._head, self.complete_scales)
                wanted = order[(self._keep & ~self._requested)[order]]
                if len(wanted) and not self._is_full(int(wanted[0])):
                    break
                self._change.wait()
            if self._closed:
                return None
            position = int(wanted[0])
            self._requested[position], self._fetching = True, position
        number = int(self.parts.numbers[position])
        if number not in announced:
            numbers = map(int, self.parts.numbers[wanted[:RUN_CHUNKS]])
            announced = adjacent_runs(self._reader.index, numbers, RUN_BYTES)[0]
            announce(self._reader, announced)
        return position, announced

    def _is_full(self, position: int) -> bool:
        """Whether the window's thread must take over or drop segments first."""
        if not self.parts.moves[position]:
            waiting = sum(piece.data.nbytes for piece in tuple(self._finished) if not self.parts.moves[piece.position])
            return waiting >= UPLOAD_BYTES
        requested_bytes = int(self.parts.sizes[self._requested & self.parts.moves].sum())
        return requested_bytes + int(self.parts.sizes[position]) > self._segment_memory

    def _fetched(self, position: int) -> Piece:
        """Fetch and decode a segment. One that arrives damaged is fetched a second time."""
        number = int(self.parts.numbers[position])
        try:
            symbols, _ = self._reader.segment(number)
        except FormatError:
            if not isinstance(self.source, RemoteSource):
                raise
            self.source.discard()
            symbols, _ = self._reader.segment(number)
        if self.parts.moves[position]:
            return Piece(position, number, symbols)
        plane = self.parts.head_of(number)
        return Piece(position, number, self._layout.texels(dequantise_symbols(symbols, plane.step, plane.offset)))

    def _set_trouble(self, message: str | None) -> None:
        self._trouble = message
        self.arrived()


def loading_message(bytes_per_s: float) -> str:
    """Return the message for a user who has to wait; no rate where all has arrived and is being decoded."""
    return f"loading, {bytes_per_s / 1e3:,.0f} KB/s" if bytes_per_s >= 500 else "loading"


def memory_option(count: float) -> str:
    """Return the option of kpplay that grants a number of bytes: "--memory 30KB"."""
    return "--memory " + byte_text(int(count)).removesuffix(" bytes").replace(" ", "")
