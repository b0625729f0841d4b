"""What `kpbench steady` measures: whether long playback takes ever more memory or creates graphics objects."""

import contextlib
import os
import time as clock
from collections import Counter
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import moderngl
import numpy as np

from kpc.format.common.memory import peak_memory_bytes
from kpc.format.common.progress import progress
from kpc.format.container.sources import open_source
from kpc.player.app.desktop import glfw
from kpc.player.app.player import Player
from kpc.player.app.preferences import Preferences
from kpc.player.app.resolution_controller import ResolutionController
from kpc.player.app.window import Window
from kpc.player.cpu import loading
from kpc.player.gl import offscreen
from kpc.player.gl.programs import is_software
from kpc.player.streaming.group_playback import GroupPlayback

# The methods of a moderngl context that create an object on the graphics card.
CREATORS = (
    "buffer",
    "compute_shader",
    "depth_texture",
    "framebuffer",
    "program",
    "query",
    "renderbuffer",
    "sampler",
    "simple_framebuffer",
    "simple_vertex_array",
    "texture",
    "texture3d",
    "texture_array",
    "texture_cube",
    "vertex_array",
)

# Share of the frames that are not measured: until then caches fill and allocators grow to what a frame needs.
WARM_UP_SHARE = 0.2

# Number of samples of the memory in use.
MEMORY_SAMPLES = 100

# Angle in radians by which the camera orbits per frame.
TURN = 0.01


@dataclass(frozen=True)
class LongPlay:
    """One run: a scene, the size of the window, and the number of frames to draw."""

    scene: Path
    size: tuple[int, int]
    frames: int


def measure(job: LongPlay) -> dict[str, Any]:
    """Play in a window with all panels open while the camera orbits the scene.

    Raises:
        DisplayError: there is no display.
    """
    with in_window(job.scene, job.size, Preferences(graphs=True, planes=True)) as player:
        window, stream = player.window, player.state.stream
        player.state.visible.path = True
        # With so large a budget, the resolution never changes, however busy the machine is.
        player.state.quality.resolution = ResolutionController(budget_s=3600.0)
        for _ in range(2):
            player.actions.add_keyframe()
        while not stream.is_settled:
            player.frame()
        created = count_created(window.ctx)
        every = max(job.frames // MEMORY_SAMPLES, 1)
        numbers, memory, warm = [], [], int(WARM_UP_SHARE * job.frames)
        started = clock.perf_counter()
        for number in progress(range(job.frames), "playing", unit="frames"):
            if number == warm:
                created.clear()
            glfw.poll_events()
            player.state.view = player.state.view.orbit(TURN, 0.0)
            player.frame()
            if number >= warm and number % every == 0:
                numbers.append(number)
                memory.append(memory_bytes())
        seconds = clock.perf_counter() - started
        slope = float(np.polyfit(numbers, memory, 1)[0]) if len(memory) > 1 else 0.0
        return {
            "renderer": offscreen.describe(window.ctx),
            "fps": job.frames / seconds,
            "first_bytes": memory[0],
            "last_bytes": memory[-1],
            "peak_bytes": max(memory),
            "bytes_per_1000_frames": 1000 * slope,
            "memory_samples_bytes": memory,
            "gpu_objects_created": sum(created.values()),
            "gpu_objects_by_kind": dict(created),
            "gpu_memory_bytes": player.scene_view.renderer.memory_bytes,
        }


@contextlib.contextmanager
def in_window(scene: Path, size: tuple[int, int], preferences: Preferences) -> Iterator[Player]:
    """Open a player whose window does not wait for the refresh of the screen.

    Raises:
        DisplayError: there is no display.
    """
    with (
        contextlib.closing(Window("kpbench", size)) as window,
        contextlib.closing(GroupPlayback(open_source(str(scene)))) as stream,
    ):
        glfw.swap_interval(0)
        if is_software(window.ctx):
            loading.load(stream.scene)
        with contextlib.closing(Player(window, stream, preferences)) as player:
            yield player


def count_created(ctx: moderngl.Context) -> Counter[str]:
    """Return a counter of the objects that `ctx` creates from now on, by the method of CREATORS."""
    created: Counter[str] = Counter()

    def counted(name: str, create: Callable[..., Any]) -> Callable[..., Any]:
        def call(*args: Any, **kwargs: Any) -> Any:
            created[name] += 1
            return create(*args, **kwargs)

        return call

    for name in CREATORS:
        setattr(ctx, name, counted(name, getattr(ctx, name)))
    return created


def memory_bytes() -> int:
    """Return the memory that this process uses now, or its peak where the system reports only that."""
    try:
        return int(Path("/proc/self/statm").read_text().split()[1]) * os.sysconf("SC_PAGE_SIZE")
    except OSError:
        return peak_memory_bytes()
