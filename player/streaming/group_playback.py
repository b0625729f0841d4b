"""Playback of a clip in groups while it arrives: the group that is shown and the next one, each a `Stream`.

    set_playhead   shows the group at the playhead once it is ready, fetches the next one ahead, releases others
    blended_with   returns the group to blend with the one that is shown, within the frames that both have
    upload         hands what has arrived to the renderers, and makes that of the next group well before it is shown

One thread opens groups, and each `Stream` has a thread that fetches; the window's thread waits for none of them. A file
without groups is played as a single group that is always shown.
"""

import threading
from collections.abc import Callable
from dataclasses import dataclass, replace

from kpc.format.common.errors import KpcError
from kpc.format.common.memory import DEFAULT_BUDGET
from kpc.format.container.groups import Groups
from kpc.format.container.scene_io import SceneReader
from kpc.format.container.sources import RemoteSource, Source
from kpc.format.scene.rig import Rig
from kpc.format.scene.scene import Scene
from kpc.player.gl.renderer import Renderer
from kpc.player.streaming.prefetch import Playhead
from kpc.player.streaming.stream import Stream, loading_message

# The next group is opened so many seconds before it is shown, even if the one that is shown is still arriving.
OPEN_AHEAD_S = 5.0
# (width, height) of the picture that makes a renderer compile its shaders.
WARM_UP_SIZE = (8, 6)


@dataclass
class LoadedGroup:
    """A group that has arrived or is arriving.

    Attributes:
        number: of the group, from 0.
        stream: its scene.
        renderer: made in the window's thread, after the stream.
        is_warm: whether the renderer's shaders are compiled.
    """

    number: int
    stream: Stream
    renderer: Renderer | None = None
    is_warm: bool = False


class GroupPlayback:
    """See the module.

    Args:
        source: the file.
        memory: bytes that everything may take; of a clip in groups, each of two groups may take half.
        arrived: called by other threads when something has arrived; may wake the window.

    Attributes:
        clip: of all groups together.
        timeline: which group is shown when.
        cameras: those of the first group, used for all.
        metadata: of the clip.

    Raises:
        KpcError: as `Groups` and `Stream`.
    """

    def __init__(
        self, source: Source, *, memory: int = DEFAULT_BUDGET, arrived: Callable[[], None] = lambda: None
    ) -> None:
        self.source, self.memory, self._arrived = source, memory, arrived
        self.groups = Groups(source, memory_budget=memory, allow_partial=True, in_parts=True)
        self.timeline, self.clip = self.groups.timeline, self.groups.clip
        self._share = 1.0 if self.groups.is_single else 0.5
        self._shown = LoadedGroup(0, self._stream(self.groups.open(0), arrived))
        self.cameras, self.metadata = self._shown.stream.scene.cameras, self.groups.metadata()
        self._describe(self._shown.stream)
        self._next: LoadedGroup | None = None
        self._make_renderer: Callable[[Scene], Renderer] | None = None
        self._earlier_versions = 0  # the versions of the groups that were shown before
        self._is_waiting = False  # whether the group at the playhead is not the one that is shown
        self._blended_number: int | None = None  # the group to blend with the one that is shown
        self._closed = False
        self._opening: int | None = None  # the group that a thread is opening
        self._opened: LoadedGroup | None = None  # the result
        self._failure: KpcError | OSError | None = None
        self._bug: BaseException | None = None

    # --- the group that is shown

    @property
    def stream(self) -> Stream:
        """The stream of the group that is shown."""
        return self._shown.stream

    @property
    def notice(self) -> str | None:
        """A line for the user about a file whose end is missing; None if it is whole."""
        cut_off = self.groups.reader.cut_off
        return None if cut_off is None else f"{cut_off}; what is there is played"

    @property
    def scene(self) -> Scene:
        """The scene of the group that is shown."""
        return self.stream.scene

    @property
    def number(self) -> int:
        """The number of the group that is shown, from 0."""
        return self._shown.number

    @property
    def next_group(self) -> LoadedGroup | None:
        """The other group that is held, which is shown next or blended."""
        return self._next

    @property
    def renderer(self) -> Renderer:
        """The renderer of the group that is shown; `draw_with` must have been called."""
        assert self._shown.renderer is not None
        return self._shown.renderer

    @property
    def is_drawn(self) -> bool:
        """Whether there is a renderer."""
        return self._shown.renderer is not None

    def draw_with(self, make_renderer: Callable[[Scene], Renderer]) -> None:
        """Make the renderer of the group that is shown, and those of other groups when they arrive."""
        self._make_renderer = make_renderer
        self._shown.renderer = make_renderer(self.scene)

    def time_in(self, time: float) -> float:
        """Return the time in the group that is shown for a time of the clip, both in [0, 1]."""
        return self.timeline.local_time(self.number, time)

    def time_of(self, time_in_group: float) -> float:
        """Return the time of the clip for a time in the group that is shown, both in [0, 1]."""
        return self.timeline.clip_time(self.number, time_in_group)

    @property
    def has_sound(self) -> bool:
        """Whether the group that is shown has sound."""
        return self.stream.has_sound

    @property
    def complete_scales(self) -> int:
        """See `Stream.complete_scales`."""
        return self.stream.complete_scales

    @property
    def loaded_fraction(self) -> float:
        """See `Stream.loaded_fraction`; of the group that is shown."""
        return self.stream.loaded_fraction

    @property
    def version(self) -> int:
        """A number that grows whenever what is shown has changed."""
        return self._earlier_versions + self.stream.version

    @property
    def is_settled(self) -> bool:
        """Whether everything of the group that is shown, and of one blended with it, has arrived that is going to."""
        if not self.stream.is_settled:
            return False
        if self._failure is not None:
            return True
        if self._is_incomplete:
            return False
        return self._blended_number is None or (self._next is not None and self._next.stream.is_settled)

    @property
    def failure(self) -> str | None:
        """Why nothing more will arrive of the clip, or of the group that is shown; None if it will."""
        return self.stream.failure if self._failure is None else str(self._failure)

    @property
    def message(self) -> str | None:
        """A message for the user; None if everything works."""
        if self._failure is not None:
            return f"loading stopped: {self._failure}"
        if self._is_incomplete:
            return self.stream.message or loading_message(self.bytes_per_s)
        return self.stream.message

    @property
    def bytes_per_s(self) -> float:
        """See `Stream.bytes_per_s`; of all groups that are held."""
        return self.stream.bytes_per_s + (0.0 if self._next is None else self._next.stream.bytes_per_s)

    def blended_with(self, time: float) -> tuple[Renderer, float, float] | None:
        """Return the group to blend with the one that is shown.

        Args:
            time: of the clip, [0, 1].

        Returns:
            Its renderer, the time in it, and its share of the picture; None if there is none, or if it has not arrived.
        """
        parts = {number: (time_in_group, share) for number, time_in_group, share in self.timeline.blend_at(time)}
        other = self._next
        if other is None or other.renderer is None or not other.is_warm:
            return None
        if self.number not in parts or other.number not in parts:
            return None
        time_in_group, share = parts[other.number]
        return (other.renderer, time_in_group, share) if other.stream.can_show(time_in_group) else None

    def version_at(self, time: float) -> tuple[int, int | None]:
        """Return a value that differs whenever the planes that make the picture at a time of the clip have changed."""
        is_alone = self._next is None or self.blended_with(time) is None
        return self.version, None if is_alone or self._next is None else self._next.stream.version

    # --- called by the window's thread

    def set_playhead(self, head: Playhead) -> None:
        """Set the position in the clip: show, open and release groups accordingly.

        Raises:
            BaseException: an unexpected error of the thread that opens groups.
        """
        if self._bug is not None:
            raise self._bug
        self._take_opened()
        number, _ = self.timeline.at(head.time)
        if self._next is not None and number == self._next.number and self._is_ready(self._next, head):
            self._switch()
        self._is_waiting = number != self.number
        self._blended_number = next((other for other, *_ in self.timeline.blend_at(head.time) if other != number), None)
        if self._is_waiting:
            wanted: int | None = number
        elif self._blended_number is not None:
            wanted = self._blended_number
        else:
            wanted = self._number_after(head)
        if self._next is not None and self._next.number != wanted:
            self._release(self._next)
            self._next = None
        is_urgent = self._is_waiting or self._blended_number is not None or self._is_near_end(head)
        if wanted is not None and self._next is None and (is_urgent or self.stream.is_settled):
            self._open(wanted)
        for group in filter(None, (self._shown, self._next)):
            group.stream.set_playhead(self._head_in(group.number, head))

    def upload(self) -> bool:
        """Hand over what has arrived to the renderers; return whether the picture may have changed.

        Raises:
            BaseException: as `Stream.upload`.
            DisplayError: the graphics card has no memory for the next group.
        """
        changed = self.stream.upload(self.renderer)
        group = self._next
        if group is None or self._make_renderer is None:
            return changed
        if group.renderer is None:
            group.renderer = self._make_renderer(group.stream.scene)
        elif not group.is_warm:  # in a call of its own, for compiling takes longer than anything else that happens here
            group.renderer.quality = self.renderer.quality
            group.renderer.render(Rig.of(group.stream.scene).cameras[0].resized(*WARM_UP_SIZE), 0.0)
            group.is_warm = True
        elif self._is_waiting or self._blended_number is not None or not changed:
            changed |= group.stream.upload(group.renderer) and self._blended_number is not None
        return changed

    def can_show(self, time: float, rate: float = 0.0) -> bool:
        """Return whether a picture can be drawn: see `Stream.can_show`; the groups it is made of must have arrived."""
        number, time_in_group = self.timeline.at(time)
        if number != self.number or not self.stream.can_show(time_in_group, self._rate_in(number, rate)):
            return False
        return (
            len(self.timeline.blend_at(time)) == 1 or self._failure is not None or self.blended_with(time) is not None
        )

    def close(self) -> None:
        """End all threads, and close the source."""
        self._closed, self._arrived = True, lambda: None
        for group in filter(None, (self._opened, self._next, self._shown)):
            group.stream.close()
        if isinstance(self.groups.reader.source, RemoteSource):
            self.groups.reader.source.close()

    @property
    def arrived(self) -> Callable[[], None]:
        """What other threads call when something has arrived."""
        return self._arrived

    @arrived.setter
    def arrived(self, call: Callable[[], None]) -> None:
        self._arrived = self._shown.stream.arrived = call

    # --- opening and releasing groups

    def _number_after(self, head: Playhead) -> int | None:
        """The group after the one that is shown; None after the last."""
        if self.number + 1 < len(self.groups):
            return self.number + 1
        return 0 if head.loop and len(self.groups) > 1 else None

    @property
    def _is_incomplete(self) -> bool:
        """Whether a group is missing that the picture is made of."""
        has_blended = self._next is not None and self._next.is_warm and self._next.number == self._blended_number
        return self._is_waiting or (self._blended_number is not None and not has_blended)

    def _is_near_end(self, head: Playhead) -> bool:
        _, until = self.timeline.display_span(self.number)
        return (until - head.time) * self.clip.duration_s < OPEN_AHEAD_S

    def _is_ready(self, group: LoadedGroup, head: Playhead) -> bool:
        head_in_group = self._head_in(group.number, head)
        return group.is_warm and group.stream.can_show(head_in_group.time, head_in_group.rate)

    def _switch(self) -> None:
        """Show the next group; the one before is kept while it is blended."""
        assert self._next is not None and self._next.renderer is not None
        self._next.renderer.quality = self.renderer.quality
        self._earlier_versions += self._shown.stream.version + 1
        self._shown.is_warm = True
        self._shown, self._next = self._next, self._shown

    def _release(self, group: LoadedGroup) -> None:
        group.stream.close()
        if group.renderer is not None:
            group.renderer.release()

    def _head_in(self, number: int, head: Playhead) -> Playhead:
        """The playhead in the time of a group."""
        loops = head.loop and self.groups.is_single
        return Playhead(self.timeline.local_time(number, head.time), self._rate_in(number, head.rate), loops)

    def _rate_in(self, number: int, rate: float) -> float:
        """The fraction of a group that is played per second, if `rate` is that of the clip."""
        return rate * max(self.clip.frame_count - 1, 1) / max(self.timeline.spans[number].count - 1, 1)

    def _open(self, number: int) -> None:
        """Open a group in a thread, unless one is being opened or opening has failed."""
        if self._opening is None and self._failure is None:
            self._opening = number
            threading.Thread(target=self._open_in_thread, args=(number,), name="opening", daemon=True).start()

    def _take_opened(self) -> None:
        """Make the group that a thread has opened the next one."""
        if (opened := self._opened) is not None:
            if self._next is not None:
                self._release(self._next)
            self._next, self._opened, self._opening = opened, None, None

    def _stream(self, group: SceneReader, arrived: Callable[[], None]) -> Stream:
        """Return a group as it arrives, which may take its share of the memory."""
        return Stream(group, memory=int(self.memory * self._share), arrived=arrived, share=self._share)

    def _open_in_thread(self, number: int) -> None:
        try:
            stream = self._stream(self.groups.open(number, apart=True), self._wake)
            self._describe(stream)
            self._opened = LoadedGroup(number, stream)
            if self._closed:
                stream.close()
        except (KpcError, OSError) as error:
            self._failure = error
        except BaseException as error:  # unexpected: raised again in the window's thread
            self._bug = error
        self._wake()

    def _describe(self, stream: Stream) -> None:
        """Give the scene of a group the cameras of the first group if it has none, and the metadata of the clip."""
        if not stream.scene.cameras or stream.scene.metadata != self.metadata:
            stream.scene = replace(stream.scene, cameras=stream.scene.cameras or self.cameras, metadata=self.metadata)

    def _wake(self) -> None:
        self.arrived()
