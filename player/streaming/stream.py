"""A scene that plays while it arrives: a thread fetches and decodes, the window's thread takes over what is finished.

    fetching thread      what to fetch next (`kpc.player.streaming.prefetch`) -> source -> CRC32C, decoding -> finished pieces
    window's thread      `set_playhead` says where the playhead is; `upload` takes finished pieces, so many bytes a frame

The window's thread waits for nothing but a lock that is never held for long. Segments of time planes lie in memory as symbols
and are dropped when the playhead has passed and the room is needed; space planes go to the graphics card and are gone from here.
A file on a disk takes the same way as one on a server: it is only sooner there.
"""

import threading
import time as clock
from collections import deque
from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from kpc.format.coding.quantise import dequantise_symbols
from kpc.format.common.compiling import MONITOR, NOTICE
from kpc.format.common.errors import BudgetError, FormatError, InterruptedRead, KpcError
from kpc.format.container.container import DEFAULT_BUDGET, Reader, RemoteSource, Source
from kpc.format.container.partial import PartialScene, adjacent_runs, announce
from kpc.format.container.scene_io import SceneReader
from kpc.format.scene.scene import ALL_PLANES, Scene
from kpc.player.atlas import Layout, TimeRows
from kpc.player.cpu.corner_grid import CornerGrid
from kpc.player.cpu.occupancy_culling import OccupancyCulling
from kpc.player.cpu.plane_sampler import PlaneSampler
from kpc.player.gl.renderer import FOLDING_UPSAMPLING, Renderer
from kpc.player.streaming.prefetch import Playhead, fetch_order, min_segment_bytes, segments_to_keep

RUN_BYTES, RUN_CHUNKS = 1 << 18, 256
"""Fetched with one request at most, so that a playhead that jumps does not wait long."""
UPLOAD_BYTES = 1 << 22
"""Handed to the graphics card in a frame at most, about a millisecond's worth."""
RESUME_S = 0.5
"""So much of the clip must be there before it plays on after a pause."""
RATE_OVER_S = 1.0


@dataclass
class Piece:
    """A decoded segment: symbols of a time plane, or texels of a space plane, of which `done` rows are uploaded."""

    position: int
    number: int
    data: np.ndarray
    done: int = 0


class Stream:
    """A scene on its way.

    Opening it waits for header, index, and all that there can be no picture without but planes; then the thread begins.

    Args:
        source: of the scene's file, or a reader of it, whose header and index are taken over.
        memory: bytes that the scene may take, on the processor's side and on the graphics card's together. Pictures, shaders and
            the program itself are not counted.
        arrived: called by the fetching thread whenever there is something new; may wake the window.

    Attributes:
        memory: as given.
        scene: what is there of it; `upload` changes it.
        version: grows whenever it has changed.

    Raises:
        KpcError: as `SceneReader` and `HttpSource`; BudgetError if `memory` is too little to play the scene at all.
    """

    def __init__(
        self, source: Source | Reader, *, memory: int = DEFAULT_BUDGET, arrived: Callable[[], None] = lambda: None
    ) -> None:
        self._reader = SceneReader(source, memory_budget=memory, in_parts=True)
        source = self._reader.source
        self.source, self.memory, self.arrived, self.version = source, memory, arrived, 0
        self.parts = PartialScene(self._reader)
        self.scene: Scene = self.parts.scene
        self._layout = Layout.of(self.scene)
        fixed, least = self.fixed_bytes, min_segment_bytes(self.parts)
        if fixed + least > memory:
            raise BudgetError(
                f"{source.name}: takes {fixed + least:,} bytes to play, more than the {memory:,} of --memory"
            )
        self._room = memory - fixed
        self._stored = np.array([self.parts.entry(number).stored_length for number in self.parts.numbers])
        self._taken = np.zeros(len(self._stored), bool)
        """Fetched or being fetched, and not dropped since."""
        self._here = np.zeros(len(self._stored), bool)
        """Uploaded, or put into the scene."""
        self._head, self._keep = Playhead(), segments_to_keep(self.parts, Playhead(), self._room)
        self._is_long = not self._keep.all()
        self._finished: deque[Piece] = deque()
        self._change = threading.Condition()
        self._closed = False
        self._under_way: int | None = None
        self._trouble: str | None = None
        self._failure: KpcError | OSError | None = None
        self._bug: BaseException | None = None
        self._stalled = True
        self._came: deque[tuple[float, int]] = deque()
        """When how many bytes had come, over the last RATE_OVER_S."""
        if isinstance(source, RemoteSource):
            source.attempts, source.report = float("inf"), self._hear
        self._thread = threading.Thread(target=self._run, name="fetching", daemon=True)
        self._thread.start()

    # --- the window's thread

    def set_playhead(self, head: Playhead) -> None:
        """Say where the clip is. What it has left far behind is dropped if the room is needed."""
        with self._change:
            self._head = head
            if self._is_long:
                self._keep = segments_to_keep(self.parts, head, self._room)
                self._drop(self._here & ~self._keep)
            if (self._keep & ~self._taken).any():
                self._change.notify_all()
                self._hurry(head.time)

    def upload(self, renderer: Renderer, most_bytes: float = UPLOAD_BYTES) -> bool:
        """Take over finished pieces; whether the picture may have changed.

        Raises:
            BaseException: what should not have happened in the fetching thread.
        """
        if self._bug is not None:
            raise self._bug
        changed = refresh = False
        while most_bytes > 0 and self._finished:
            piece = self._finished[0]
            if self.parts.moves[piece.position]:
                self.parts.put(piece.number, piece.data)
                refresh, done = True, True
            else:
                entry, row = self.parts.entry(piece.number), piece.data[0].nbytes
                end = min(piece.done + max(int(most_bytes // row), 1), len(piece.data))
                renderer.put(entry.scale, ALL_PLANES[entry.plane], piece.data[piece.done : end], piece.done)
                most_bytes -= (end - piece.done) * row
                piece.done, done = end, end == len(piece.data)
            changed = True
            if done:
                with self._change:
                    self._finished.popleft()
                    self._here[piece.position] = True
                    self._drop(self._here & ~self._keep)
                    self._change.notify_all()
        if refresh:
            renderer.refresh()
        self.version += changed
        return changed

    def can_show(self, time: float, rate: float = 0.0) -> bool:
        """Whether a clip that plays may go on to `time`. After a pause, only once RESUME_S from there on are there, too.

        All that the scales need whose space planes are there must be, and at least scale 0: a picture once fine stays fine.
        """
        end = min(time + rate * RESUME_S, 1.0) if self._stalled else time
        needed = self.parts.is_needed(time, end) & (self.parts.scales < max(self.complete_scales, 1)) & self._keep
        self._stalled = bool((needed & ~self._here).any())
        return not self._stalled

    @property
    def complete_scales(self) -> int:
        """Scales from the coarsest on whose space planes are all there."""
        missing = self.parts.scales[~self.parts.moves & ~self._here]
        return int(missing.min()) if len(missing) else int(self.parts.scales.max()) + 1

    @property
    def is_settled(self) -> bool:
        """Whether all is there that fits the memory, or nothing more will come."""
        if self._failure is not None:
            return True
        with self._change:
            return not (self._keep & ~self._here).any()

    @property
    def loaded_fraction(self) -> float:
        """Of the bytes of all planes."""
        return float(self._stored[self._here].sum() / max(self._stored.sum(), 1))

    @property
    def rate(self) -> float:
        """Bytes a second that came lately."""
        now = clock.monotonic()
        self._came.append((now, self.received))
        while self._came[0][0] < now - RATE_OVER_S:
            self._came.popleft()
        (since, before), (until, after) = self._came[0], self._came[-1]
        return (after - before) / (until - since) if until > since else 0.0

    @property
    def received(self) -> int:
        """Bytes that came so far, through a network or from a disk."""
        return (
            self.source.received_bytes
            if isinstance(self.source, RemoteSource)
            else int(self._stored[self._taken].sum())
        )

    @property
    def memory_bytes(self) -> int:
        """Of the segments of time planes that are there or on their way."""
        with self._change:
            return int(self.parts.sizes[self._taken & self.parts.moves].sum())

    @property
    def fixed_bytes(self) -> int:
        """What the scene takes but for its segments of time: textures, and what folding, thinning and marching by a processor take; occupancy and its distances; motion;
        planes that wait to be uploaded, and one in the making; what the source holds."""
        scene, layout = self.scene, self._layout
        texels = layout.size[0] * layout.size[1]
        if scene.is_dynamic:
            finer = Layout.of(scene, FOLDING_UPSAMPLING)
            texels += (
                2 * finer.size[0] * finer.size[1]
                + (1 + FOLDING_UPSAMPLING) * TimeRows(scene, layout).width * layout.row_count()
            )
            texels += 2 * layout.size[0] * layout.size[1] if OccupancyCulling.serves(scene) else 0
        marching = sum(kind.bytes_for(scene) for kind in (CornerGrid, PlaneSampler) if kind.serves(scene))
        largest = max(layout.layers[block.scale] * block.width * block.height for block in layout.blocks)
        motion = 0 if scene.motion is None else scene.motion.nbytes + 16 * int(np.prod(scene.motion.shape[1:4]))
        decoding = UPLOAD_BYTES + 4 * 16 * largest + 2 * self._reader.header.largest_raw
        whole = isinstance(self.source, RemoteSource) and not self.source.has_ranges
        source = (
            self.source.size if whole else 2 * (RUN_BYTES + max(entry.stored_length for entry in self._reader.index))
        )
        return 16 * texels + marching + 2 * scene.occupancy.nbytes + motion + decoding + source

    @property
    def failure(self) -> str | None:
        """Why no more will come."""
        return None if self._failure is None else str(self._failure)

    @property
    def message(self) -> str | None:
        """What the user should know; None while all goes well."""
        if self._failure is not None:
            return f"no more of the scene will come: {self._failure}"
        if self._trouble is not None:
            return self._trouble
        if self._stalled and MONITOR.is_compiling:
            return NOTICE
        if self._stalled:
            return f"waiting for the scene, {self.rate / 1e3:,.0f} KB/s"
        return None

    def close(self) -> None:
        """End the thread, and let go of the source."""
        self.arrived = lambda: None
        with self._change:
            self._closed = True
            self._change.notify_all()
        if isinstance(self.source, RemoteSource):
            self.source.close()
        self._thread.join(timeout=0.5)  # on a dead line it may take longer, which nobody has to wait for

    def _hurry(self, time: float) -> None:
        """Under the lock: what the picture needs now does not wait for the end of something else, far as that is on a slow line."""
        now = self.parts.is_needed(time, time) & (self.parts.scales < max(self.complete_scales, 1))
        if (
            self._under_way is not None
            and not now[self._under_way]
            and (now & self._keep & ~self._taken).any()
            and isinstance(self.source, RemoteSource)
        ):
            self.source.interrupt()

    def _drop(self, which: np.ndarray) -> None:
        """Under the lock: segments leave the scene."""
        for position in np.flatnonzero(which & self.parts.moves):
            self.parts.drop(int(self.parts.numbers[position]))
            self._here[position] = self._taken[position] = False

    # --- the fetching thread

    def _run(self) -> None:
        try:
            held: list[int] = []
            while (step := self._next(held)) is not None:
                position, held = step
                try:
                    piece = self._fetched(position)
                except InterruptedRead:
                    with self._change:
                        self._taken[position], self._under_way = False, None
                    continue
                with self._change:
                    self._finished.append(piece)
                    self._under_way = None
                self.arrived()
        except (KpcError, OSError) as error:
            if not self._closed:
                self._failure = error
                self.arrived()
        except BaseException as error:  # a bug: told where it is seen, with its traceback
            self._bug = error
            self.arrived()

    def _next(self, held: list[int]) -> tuple[int, list[int]] | None:
        """Wait until something is to be fetched; its position, and the chunks held by the source. None once closed."""
        with self._change:
            while not self._closed:
                order = fetch_order(self.parts, self._head, self.complete_scales)
                wanted = order[(self._keep & ~self._taken)[order]]
                if len(wanted) and not self._is_full(int(wanted[0])):
                    break
                self._change.wait()
            if self._closed:
                return None
            position = int(wanted[0])
            self._taken[position], self._under_way = True, position
        number = int(self.parts.numbers[position])
        if number not in held:
            held = adjacent_runs(self._reader.index, map(int, self.parts.numbers[wanted[:RUN_CHUNKS]]), RUN_BYTES)[0]
            announce(self._reader, held)
        return position, held

    def _is_full(self, position: int) -> bool:
        """Whether the window's thread must take over or drop something first."""
        if not self.parts.moves[position]:
            waiting = sum(piece.data.nbytes for piece in tuple(self._finished) if not self.parts.moves[piece.position])
            return waiting >= UPLOAD_BYTES
        return int(self.parts.sizes[self._taken & self.parts.moves].sum() + self.parts.sizes[position]) > self._room

    def _fetched(self, position: int) -> Piece:
        """A segment, decoded and ready for its place. One that came damaged is fetched a second time."""
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

    def _hear(self, message: str | None) -> None:
        self._trouble = message
        self.arrived()
