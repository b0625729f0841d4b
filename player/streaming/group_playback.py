"""A clip in groups that plays while it arrives: the group that shows and the one that comes next, each a `Stream` with a renderer.

    steer    where the playhead is: the group it is in shows once it can, the next one is fetched ahead, others are let go
    beside   what is mixed with it, amid the frames that two groups share
    upload   what has arrived goes to the renderers; the next group's is made, and its shaders compiled, well before it shows

A thread of its own opens groups, another for each fetches: the window's thread waits for none of them. A file without groups is a
reel of one, which is always there.
"""

import threading
from collections.abc import Callable
from dataclasses import dataclass, replace

from kpc.format.common.errors import KpcError
from kpc.format.container.container import DEFAULT_BUDGET, RemoteSource, Source
from kpc.format.container.groups import Groups
from kpc.format.scene.scene import Scene
from kpc.player.gl.renderer import Renderer
from kpc.player.streaming.prefetch import Playhead
from kpc.player.streaming.stream import Stream
from kpc.player.viewpoints import Rig

AHEAD_S = 5.0
"""The next group is opened so long before it shows, even if the one that shows is still arriving."""
WARM_UP = (8, 6)
"""Pixels of the picture for which a renderer compiles its shaders."""


@dataclass
class LoadedGroup:
    """A group that is there, or on its way."""

    number: int
    stream: Stream
    renderer: Renderer | None = None
    is_warm: bool = False
    """Whether the renderer's shaders are compiled."""


class GroupPlayback:
    """See the module.

    Args:
        source: of the file.
        memory: bytes that all of it may take; of a clip in groups, half of that for each of two.
        arrived: called by other threads whenever there is something new; may wake the window.

    Attributes:
        clip: of all groups together.
        timeline: when which group shows.

    Raises:
        KpcError: as `Groups` and `Stream`.
    """

    def __init__(
        self, source: Source, *, memory: int = DEFAULT_BUDGET, arrived: Callable[[], None] = lambda: None
    ) -> None:
        self.source, self.memory, self._arrived = source, memory, arrived
        self.groups = Groups(source, memory_budget=memory, in_parts=True)
        self.timeline, self.clip = self.groups.timeline, self.groups.clip
        self._a_group = memory if self.groups.is_single else memory // 2
        self._shown = LoadedGroup(0, Stream(self.groups.open(0), memory=self._a_group, arrived=arrived))
        self.cameras = self._shown.stream.scene.cameras
        self._next: LoadedGroup | None = None
        self._make: Callable[[Scene], Renderer] | None = None
        self._before = 0
        """Versions of what has shown before."""
        self._waiting = False
        self._beside: int | None = None
        """The group that is to be mixed with the one that shows."""
        self._closed = False
        self._opening: int | None = None
        """What a thread opens; what came of it lies in one of the next."""
        self._opened: LoadedGroup | None = None
        self._failure: KpcError | OSError | None = None
        self._bug: BaseException | None = None

    # --- what shows

    @property
    def stream(self) -> Stream:
        """Of the group that shows."""
        return self._shown.stream

    @property
    def scene(self) -> Scene:
        return self.stream.scene

    @property
    def number(self) -> int:
        """Of the group that shows."""
        return self._shown.number

    @property
    def renderer(self) -> Renderer:
        """Of the group that shows; there once `draw_with` has been called."""
        assert self._shown.renderer is not None
        return self._shown.renderer

    @property
    def is_drawn(self) -> bool:
        return self._shown.renderer is not None

    def draw_with(self, make: Callable[[Scene], Renderer]) -> None:
        """Make renderers so: one now, others as groups come."""
        self._make = make
        self._shown.renderer = make(self.scene)

    def time_in(self, time: float) -> float:
        """The time in the group that shows, at a time of the clip."""
        return self.timeline.local_time(self.number, time)

    def time_of(self, time_in_it: float) -> float:
        """The time of the clip, at a time in the group that shows."""
        return self.timeline.clip_time(self.number, time_in_it)

    @property
    def complete_scales(self) -> int:
        """As of `Stream`."""
        return self.stream.complete_scales

    @property
    def loaded_fraction(self) -> float:
        """As of `Stream`, of the group that shows."""
        return self.stream.loaded_fraction

    @property
    def version(self) -> int:
        """Grows whenever what shows has changed."""
        return self._before + self.stream.version

    @property
    def is_settled(self) -> bool:
        """Whether all of the group that shows is there that fits the memory, or nothing more will come."""
        return self.stream.is_settled and (
            self._failure is not None
            or not self._is_short
            and (self._beside is None or self._next is not None and self._next.stream.is_settled)
        )

    @property
    def message(self) -> str | None:
        """What the user should know; None while all goes well."""
        if self._failure is not None:
            return f"no more of the scene will come: {self._failure}"
        if self._is_short:
            return self.stream.message or f"waiting for the scene, {self.rate / 1e3:,.0f} KB/s"
        return self.stream.message

    @property
    def rate(self) -> float:
        """Bytes a second that came lately."""
        return self.stream.rate + (0.0 if self._next is None else self._next.stream.rate)

    def beside(self, time: float) -> tuple[Renderer, float, float] | None:
        """At a time of the clip, what is to be mixed with the group that shows: the renderer of another, the time in it, and its share of
        the picture. None where nothing is, or where it is not there."""
        parts = {number: (time_in_it, share) for number, time_in_it, share in self.timeline.blend_at(time)}
        other = self._next
        if (
            self.number not in parts
            or other is None
            or other.number not in parts
            or other.renderer is None
            or not other.is_warm
        ):
            return None
        time_in_it, share = parts[other.number]
        return (other.renderer, time_in_it, share) if other.stream.can_show(time_in_it) else None

    def version_at(self, time: float) -> tuple[int, int | None]:
        """Another whenever what makes the picture at a time of the clip has changed."""
        return self.version, None if self._next is None or self.beside(time) is None else self._next.stream.version

    # --- the window's thread

    def set_playhead(self, head: Playhead) -> None:
        """Say where the clip is.

        Raises:
            BaseException: what should not have happened in the thread that opens groups.
        """
        if self._bug is not None:
            raise self._bug
        self._take_in()
        number, _ = self.timeline.at(head.time)
        if self._next is not None and number == self._next.number and self._is_ready(self._next, head):
            self._turn()
        self._waiting = number != self.number
        self._beside = next((other for other, *_ in self.timeline.blend_at(head.time) if other != number), None)
        ahead = number if self._waiting else self._comes_after(head) if self._beside is None else self._beside
        if self._next is not None and self._next.number != ahead:
            self._let_go(self._next)
            self._next = None
        wanted_now = self._waiting or self._beside is not None or self._is_near(head)
        if ahead is not None and self._next is None and (wanted_now or self.stream.is_settled):
            self._open(ahead)
        for held in filter(None, (self._shown, self._next)):
            held.stream.set_playhead(self._head_in(held.number, head))

    def upload(self) -> bool:
        """Take over what has arrived; whether the picture may have changed.

        Raises:
            BaseException: as `Stream.upload`. DisplayError: the card has no room for the next group.
        """
        changed = self.stream.upload(self.renderer)
        coming = self._next
        if coming is not None and self._make is not None:
            if coming.renderer is None:
                coming.renderer = self._make(coming.stream.scene)
            elif (
                not coming.is_warm
            ):  # a turn later: compiling takes the longest of all that the window's thread does here
                coming.renderer.quality = self.renderer.quality
                coming.renderer.render(Rig.of(coming.stream.scene).cameras[0].resized(*WARM_UP), 0.0)
                coming.is_warm = True
            elif self._waiting or self._beside is not None or not changed:
                changed |= coming.stream.upload(coming.renderer) and self._beside is not None
        return changed

    def can_show(self, time: float, rate: float = 0.0) -> bool:
        """As `Stream.can_show`; not while the group is missing, or one that is mixed with it is on its way."""
        number, time_in_it = self.timeline.at(time)
        if number != self.number or not self.stream.can_show(time_in_it, self._rate_in(number, rate)):
            return False
        return len(self.timeline.blend_at(time)) == 1 or self._failure is not None or self.beside(time) is not None

    def close(self) -> None:
        """End all threads, and let go of the source."""
        self._closed, self._arrived = True, lambda: None
        for held in filter(None, (self._opened, self._next, self._shown)):
            held.stream.close()
        if isinstance(self.groups.reader.source, RemoteSource):
            self.groups.reader.source.close()

    # --- groups that come and go

    def _comes_after(self, head: Playhead) -> int | None:
        """The group after the one that shows."""
        if self.number + 1 < len(self.groups):
            return self.number + 1
        return 0 if head.loop and len(self.groups) > 1 else None

    @property
    def _is_short(self) -> bool:
        """Whether a group is missing that the picture is made of."""
        there = self._next is not None and self._next.is_warm and self._next.number == self._beside
        return self._waiting or self._beside is not None and not there

    def _is_near(self, head: Playhead) -> bool:
        _, until = self.timeline.display_span(self.number)
        return (until - head.time) * self.clip.duration_s < AHEAD_S

    def _is_ready(self, held: LoadedGroup, head: Playhead) -> bool:
        there = self._head_in(held.number, head)
        return held.is_warm and held.stream.can_show(there.time, there.rate)

    def _turn(self) -> None:
        """The next group shows; the one that did is held as long as it is mixed with it."""
        assert self._next is not None and self._next.renderer is not None
        self._next.renderer.quality = self.renderer.quality
        self._before += self._shown.stream.version + 1
        self._shown.is_warm = True
        self._shown, self._next = self._next, self._shown

    def _let_go(self, held: LoadedGroup) -> None:
        held.stream.close()
        if held.renderer is not None:
            held.renderer.release()

    def _head_in(self, number: int, head: Playhead) -> Playhead:
        loops = head.loop and self.groups.is_single
        return Playhead(self.timeline.local_time(number, head.time), self._rate_in(number, head.rate), loops)

    def _rate_in(self, number: int, rate: float) -> float:
        """Of a group in a second, where it is `rate` of the clip."""
        return rate * max(self.clip.frame_count - 1, 1) / max(self.timeline.spans[number].count - 1, 1)

    def _open(self, number: int) -> None:
        """Have a group opened by a thread, unless that has something to do, or has failed."""
        if self._opening is None and self._failure is None:
            self._opening = number
            threading.Thread(target=self._open_now, args=(number,), name="opening", daemon=True).start()

    def _take_in(self) -> None:
        """What a thread has opened is the next group, whether it is still wanted or not."""
        if (opened := self._opened) is not None:
            if self._next is not None:
                self._let_go(self._next)
            self._next, self._opened, self._opening = opened, None, None

    def _open_now(self, number: int) -> None:
        try:
            stream = Stream(self.groups.open(number, apart=True), memory=self._a_group, arrived=self._wake)
            if not stream.scene.cameras:
                stream.scene = replace(stream.scene, cameras=self.cameras)
            self._opened = LoadedGroup(number, stream)
            if self._closed:
                stream.close()
        except (KpcError, OSError) as error:
            self._failure = error
        except BaseException as error:  # a bug: told where it is seen, with its traceback
            self._bug = error
        self._wake()

    def _wake(self) -> None:
        self.arrived()

    @property
    def arrived(self) -> Callable[[], None]:
        return self._arrived

    @arrived.setter
    def arrived(self, call: Callable[[], None]) -> None:
        self._arrived = self._shown.stream.arrived = call
