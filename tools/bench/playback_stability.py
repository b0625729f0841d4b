"""What kpbench measures of long playback: that it takes no more memory the longer it lasts, and makes nothing anew on the card."""

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
from kpc.format.container.container import open_source
from kpc.player.app.desktop import glfw
from kpc.player.app.player import Player
from kpc.player.app.preferences import Preferences
from kpc.player.app.resolution_controller import ResolutionController
from kpc.player.app.window import Window
from kpc.player.gl import offscreen
from kpc.player.streaming.group_playback import GroupPlayback

MAKERS = ("texture", "texture3d", "texture_array", "texture_cube", "depth_texture", "buffer", "framebuffer", "simple_framebuffer",
          "renderbuffer", "vertex_array", "simple_vertex_array", "program", "sampler", "compute_shader", "query")  # fmt: skip
"""What of a moderngl context makes something on the card."""
WARM_SHARE = 0.2
"""Of the frames, that come before those that are compared: caches fill, arenas grow to what a frame takes."""
LOOKS_AT_MEMORY = 100
TURN = 0.01


@dataclass(frozen=True)
class Steady:
    """What one run is told."""

    scene: Path
    size: tuple[int, int]
    frames: int


def measure(job: Steady) -> dict[str, Any]:
    """Play in a window, all panels shown, the camera turning, for so many frames.

    Raises:
        DisplayError: there is no display.
    """
    with in_window(job.scene, job.size, Preferences(graphs=True, planes=True)) as player:
        window, stream = player.window, player.state.stream
        player.state.visible.path = True
        player.state.quality.resolution = ResolutionController(
            budget_s=3600.0
        )  # the raster stays as it is, however busy the machine
        for _ in range(2):
            player.actions.add_keyframe()
        while not stream.is_settled:
            player.frame()
        made = count_makers(window.ctx)
        every = max(job.frames // LOOKS_AT_MEMORY, 1)
        numbers, held, warm = [], [], int(WARM_SHARE * job.frames)
        started = clock.perf_counter()
        for number in range(job.frames):
            if number == warm:
                made.clear()
            glfw.poll_events()
            player.state.view = player.state.view.orbit(TURN, 0.0)
            player.frame()
            if number >= warm and number % every == 0:
                numbers.append(number)
                held.append(memory_bytes())
        seconds = clock.perf_counter() - started
        slope = float(np.polyfit(numbers, held, 1)[0]) if len(held) > 1 else 0.0
        return {
            "renderer": offscreen.describe(window.ctx),
            "fps": job.frames / seconds,
            "first_bytes": held[0],
            "last_bytes": held[-1],
            "most_bytes": max(held),
            "bytes_per_1000_frames": 1000 * slope,
            "held_bytes": held,
            "made_on_card": sum(made.values()),
            "made": dict(made),
            "gpu_memory_bytes": player.scene_view.renderer.memory_bytes,
        }


@contextlib.contextmanager
def in_window(scene: Path, size: tuple[int, int], preferences: Preferences) -> Iterator[Player]:
    """A player that waits for no screen.

    Raises:
        DisplayError: there is no display.
    """
    with (
        contextlib.closing(Window("kpbench", size)) as window,
        contextlib.closing(GroupPlayback(open_source(str(scene)))) as stream,
    ):
        glfw.swap_interval(0)
        with contextlib.closing(Player(window, stream, preferences)) as player:
            yield player


def count_makers(ctx: moderngl.Context) -> Counter[str]:
    """How often each of MAKERS is called from now on."""
    made: Counter[str] = Counter()

    def counted(name: str, make: Callable[..., Any]) -> Callable[..., Any]:
        def call(*args: Any, **kwargs: Any) -> Any:
            made[name] += 1
            return make(*args, **kwargs)

        return call

    for name in MAKERS:
        setattr(ctx, name, counted(name, getattr(ctx, name)))
    return made


def memory_bytes() -> int:
    """That this process holds now; where the system does not tell, the most it has held."""
    try:
        return int(Path("/proc/self/statm").read_text().split()[1]) * os.sysconf("SC_PAGE_SIZE")
    except OSError:
        return peak_memory_bytes()
