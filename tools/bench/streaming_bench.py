"""What kpbench measures of scenes that play while they arrive.

The server is a process of its own, so that the player's does not lend it its time.
"""

import subprocess
import sys
import time as clock
from collections.abc import Callable, Iterator
from contextlib import ExitStack, contextmanager
from dataclasses import dataclass, replace
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

import moderngl
import numpy as np
from kpc.format.common.errors import KpcError
from kpc.format.common.fidelity import psnr_from_mse
from kpc.format.container.container import open_source
from kpc.format.container.partial import PartialScene
from kpc.format.container.scene_io import SceneReader, encode, read
from kpc.format.scene.scene import TIME_PLANES, Clip
from kpc.player.app.resolution_controller import ResolutionController
from kpc.player.gl import offscreen
from kpc.player.gl.renderer import Renderer, is_software
from kpc.player.quality import Quality
from kpc.player.streaming.prefetch import Playhead, min_segment_bytes
from kpc.player.streaming.stream import Stream
from kpc.player.viewpoints import Rig, fit_camera

RATE, DELAY = "10Mbit", "20ms"
SEEKS = 12
LONGER = 16
"""Jumps are measured in a clip that is played so many times in a row: in a short one all that there is has soon come."""
TIMES = (0.1, 0.5, 0.9)


@dataclass(frozen=True)
class Loading:
    """One run: a scene, the size of its pictures, and their quality level."""

    scene: Path
    size: tuple[int, int]
    quality: Quality


def measure(job: Loading) -> dict[str, Any]:
    """The first picture from a disk and over a slow line, a jump of the playhead on a fast one."""
    ctx = offscreen.open_context()
    screen = ctx.simple_framebuffer(job.size, components=4)
    found: dict[str, Any] = {"size_bytes": job.scene.stat().st_size}
    _arrival(ctx, screen, job, str(job.scene))  # drivers keep compiled shaders; all that follows finds them
    found |= {f"disk_{key}": value for key, value in _arrival(ctx, screen, job, str(job.scene)).items()}
    with served(job.scene, "--rate", RATE, "--delay", DELAY) as url:
        found |= {f"network_{key}": value for key, value in _arrival(ctx, screen, job, url).items()}
    if read(job.scene).is_dynamic:
        with TemporaryDirectory() as folder:
            with served(_lengthened(job.scene, Path(folder))) as url:
                found |= _jumps(ctx, screen, job, url)
    return found


def _arrival(ctx: moderngl.Context, screen: moderngl.Framebuffer, job: Loading, source: str) -> dict[str, Any]:
    """From the address to the first coarse picture, to the first with all scales, and to the last byte.

    The first is drawn as finely as the player begins, which on a processor is a quarter of the size."""
    begun = clock.perf_counter()
    with ExitStack() as stack:
        stream = Stream(open_source(source))
        stack.callback(stream.close)
        opened = clock.perf_counter()
        renderer = Renderer(ctx, stream.scene, job.quality)
        draw = _drawing(screen, renderer, job)
        _until(stream, renderer, lambda: stream.complete_scales > 0 and stream.can_show(0.0))
        received = stream.received
        draw(0.0, ResolutionController.of(is_software(ctx)).scale)
        first = clock.perf_counter()
        _until(stream, renderer, lambda: stream.complete_scales == len(stream.scene.scales) and stream.can_show(0.0))
        draw(0.0)
        sharp = clock.perf_counter()
        _until(stream, renderer, lambda: stream.is_settled)
        ended = clock.perf_counter()
    return {
        "open_ms": 1e3 * (opened - begun),
        "first_picture_ms": 1e3 * (first - begun),
        "first_picture_bytes": received,
        "full_detail_ms": 1e3 * (sharp - begun),
        "complete_ms": 1e3 * (ended - begun),
    }


def _jumps(ctx: moderngl.Context, screen: moderngl.Framebuffer, job: Loading, url: str) -> dict[str, Any]:
    """From a jump of the playhead to the picture there, in so little memory that its segments have to be fetched."""
    with ExitStack() as stack:
        probe = Stream(open_source(url))
        stack.callback(probe.close)
        stream = Stream(open_source(url), memory=probe.fixed_bytes + min_segment_bytes(probe.parts))
        stack.callback(stream.close)
        renderer = Renderer(ctx, stream.scene, job.quality)
        draw = _drawing(screen, renderer, job)
        _until(stream, renderer, lambda: stream.is_settled)
        draw(0.0)
        waits, draws, missed = [], [], 0
        for time in np.random.default_rng(0).permutation(np.linspace(0.0, 1.0, SEEKS)):
            started = clock.perf_counter()
            stream.set_playhead(Playhead(float(time)))
            missed += not stream.can_show(float(time))
            _until(stream, renderer, lambda time=float(time): stream.can_show(time))  # type: ignore[misc]
            there = clock.perf_counter()
            draw(float(time), ResolutionController.of(is_software(ctx)).scale)
            waits.append(1e3 * (there - started))
            draws.append(1e3 * (clock.perf_counter() - there))
    together = [wait + drawn for wait, drawn in zip(waits, draws)]
    return {
        "seeks": SEEKS,
        "seeks_that_waited": missed,
        "seek_wait_ms": float(np.median(waits)),
        "seek_ms": float(np.median(together)),
        "seek_ms_p95": float(np.percentile(together, 95)),
    }


def prefixes(job: Loading) -> list[dict[str, Any]]:
    """How near the picture of each prefix is to that of the whole file, where a scale, or a segment over all scales, ends."""
    ctx, whole = offscreen.open_context(), read(job.scene).dequantise()
    camera = fit_camera(Rig.of(whole).cameras[0], *job.size)
    scene = PartialScene(SceneReader(str(job.scene), in_parts=True))
    reference = Renderer(ctx, whole)
    wanted = [reference.render(camera, time).rgb.clip(0, 1) for time in TIMES]
    entries = [scene.entry(int(number)) for number in scene.numbers]
    found = []
    for at, (entry, number) in enumerate(zip(entries, scene.numbers)):
        scene.fetch([int(number)])
        after = entries[at + 1] if at + 1 < len(entries) else None
        if after is not None and (after.scale, after.row_start) == (entry.scale, entry.row_start):
            continue
        renderer = Renderer(ctx, scene.scene)
        errors = [
            np.mean((renderer.render(camera, time).rgb.clip(0, 1) - rgb) ** 2) for time, rgb in zip(TIMES, wanted)
        ]
        found.append(
            {
                "bytes": entry.offset + entry.stored_length,
                "scale": entry.scale,
                "row_start": entry.row_start,
                "psnr": psnr_from_mse(float(np.mean(errors))),
            }
        )
    return found


def _lengthened(scene: Path, folder: Path) -> Path:
    """A clip LONGER times as long: its time planes over and over."""
    short = read(scene)
    scales = tuple({name: replace(plane, symbols=np.tile(plane.symbols, (LONGER, 1, 1)), coded=np.tile(plane.coded, (LONGER, 1)),
                                  side_info=None, starts=())
                    if name in TIME_PLANES else plane for name, plane in scale.items()} for scale in short.scales)  # fmt: skip
    motion = (
        None
        if short.motion is None
        else replace(short.motion, symbols=np.tile(short.motion.symbols, (LONGER, 1, 1, 1, 1)))
    )
    long = replace(short, clip=Clip(short.clip.frame_count * LONGER, short.clip.fps), scales=scales, motion=motion,
                   occupancy=np.tile(short.occupancy, (LONGER, 1, 1, 1)))  # fmt: skip
    path = folder / scene.name
    path.write_bytes(encode(long, compress=False))
    return path


def _drawing(screen: moderngl.Framebuffer, renderer: Renderer, job: Loading) -> Callable[..., None]:
    camera = Rig.of(renderer.scene).cameras[0]

    def draw(time: float, scale: float = 1.0) -> None:
        width, height = (max(1, round(side * scale)) for side in job.size)
        renderer.show(screen, fit_camera(camera, width, height), time)
        renderer.ctx.finish()

    return draw


def _until(stream: Stream, renderer: Renderer, condition: Callable[[], bool]) -> None:
    """Take over what arrives, as frames do, until the condition holds."""
    while not condition():
        if stream.failure is not None:
            raise KpcError(stream.failure)
        stream.upload(renderer)
        clock.sleep(0.0005)


@contextmanager
def served(scene: Path, *options: str) -> Iterator[str]:
    """The URL of a scene on a server of its own, on this machine."""
    command = [sys.executable, "-m", "kpc.tools.cli.serve", str(scene.absolute().parent), "--port", "0", *options]
    with subprocess.Popen(command, stdout=subprocess.PIPE, stderr=subprocess.DEVNULL, text=True) as server:
        try:
            assert server.stdout is not None
            for line in server.stdout:
                if line.rstrip().endswith(f"/{scene.name}"):
                    yield line.strip()
                    return
            raise KpcError(f"{scene}: cannot be served")
        finally:
            server.terminate()
