"""What `kpbench stream` measures: scenes that play while they load.

The server runs in a process of its own, so that it takes no time from the player's process.
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
from kpc.format.common.progress import Progress, in_parts, progress
from kpc.format.container.partial import PartialScene
from kpc.format.container.scene_io import SceneReader, read
from kpc.format.container.sources import open_source
from kpc.format.scene.rig import Rig
from kpc.format.scene.scene import TIME_PLANES, Clip
from kpc.player.app.resolution_controller import ResolutionController
from kpc.player.gl import offscreen
from kpc.player.gl.programs import is_software
from kpc.player.gl.renderer import Renderer
from kpc.player.quality import Quality
from kpc.player.streaming.prefetch import Playhead, min_segment_bytes
from kpc.player.streaming.stream import Stream
from kpc.player.viewpoints import fit_camera

# Bit rate and latency of the slow link, as options of kpc.tools.cli.serve.
RATE, DELAY = "10Mbit", "20ms"

# Number of seeks of the playhead.
SEEKS = 12

# Seeks are measured in a clip repeated this many times: a short one would soon be loaded completely.
REPETITIONS = 16

# Times in [0, 1] at which prefixes are compared with the whole file.
COMPARED_TIMES = (0.1, 0.5, 0.9)


@dataclass(frozen=True)
class Loading:
    """One run: a scene, the size of its pictures, and their quality level."""

    scene: Path
    size: tuple[int, int]
    quality: Quality


def measure(job: Loading) -> dict[str, Any]:
    """Measure loading from disk (`disk_`) and over a slow link (`network_`), and seeking over a fast link."""
    ctx = offscreen.open_context()
    screen = ctx.simple_framebuffer(job.size, components=4)
    found: dict[str, Any] = {"size_bytes": job.scene.stat().st_size}
    is_dynamic = read(job.scene).is_dynamic
    with Progress("loading", 3 + is_dynamic, "measurements") as bar:
        _load(ctx, screen, job, str(job.scene))  # fills the driver's shader cache for all measurements that follow
        bar.advance()
        found |= {f"disk_{key}": value for key, value in _load(ctx, screen, job, str(job.scene)).items()}
        bar.advance()
        with served(job.scene, "--rate", RATE, "--delay", DELAY) as url:
            found |= {f"network_{key}": value for key, value in _load(ctx, screen, job, url).items()}
        bar.advance()
        if is_dynamic:
            with TemporaryDirectory() as folder, served(_repeated(job.scene, Path(folder))) as url:
                found |= _seeks(ctx, screen, job, url)
            bar.advance()
    return found


def _load(ctx: moderngl.Context, screen: moderngl.Framebuffer, job: Loading, source: str) -> dict[str, Any]:
    """Return the times from opening to the first coarse picture, the first one of all scales, and the last byte.

    The first picture has the resolution that the player starts with.
    """
    begun = clock.perf_counter()
    with ExitStack() as stack:
        stream = Stream(open_source(source))
        stack.callback(stream.close)
        opened = clock.perf_counter()
        renderer = Renderer(ctx, stream.scene, job.quality)
        draw = _drawing(screen, renderer, job)
        _upload_until(stream, renderer, lambda: stream.complete_scales > 0 and stream.can_show(0.0))
        received = stream.received
        draw(0.0, ResolutionController.of(is_software(ctx)).scale)
        first = clock.perf_counter()
        all_scales = len(stream.scene.scales)
        _upload_until(stream, renderer, lambda: stream.complete_scales == all_scales and stream.can_show(0.0))
        draw(0.0)
        full_detail = clock.perf_counter()
        _upload_until(stream, renderer, lambda: stream.is_settled)
        complete = clock.perf_counter()
    return {
        "open_ms": 1e3 * (opened - begun),
        "first_picture_ms": 1e3 * (first - begun),
        "first_picture_bytes": received,
        "full_detail_ms": 1e3 * (full_detail - begun),
        "complete_ms": 1e3 * (complete - begun),
    }


def _seeks(ctx: moderngl.Context, screen: moderngl.Framebuffer, job: Loading, url: str) -> dict[str, Any]:
    """Return the times from a seek to its picture, with so little memory that segments have to be fetched again."""
    with ExitStack() as stack:
        measured = Stream(open_source(url))
        stack.callback(measured.close)
        stream = Stream(open_source(url), memory=measured.fixed_bytes + min_segment_bytes(measured.parts))
        stack.callback(stream.close)
        renderer = Renderer(ctx, stream.scene, job.quality)
        draw = _drawing(screen, renderer, job)
        _upload_until(stream, renderer, lambda: stream.is_settled)
        draw(0.0)
        waits, draws, waited = [], [], 0
        for time in in_parts(np.random.default_rng(0).permutation(np.linspace(0.0, 1.0, SEEKS)).tolist()):
            started = clock.perf_counter()
            stream.set_playhead(Playhead(time))
            waited += not stream.can_show(time)
            _upload_until(stream, renderer, lambda time=time: stream.can_show(time))  # type: ignore[misc]
            loaded = clock.perf_counter()
            draw(time, ResolutionController.of(is_software(ctx)).scale)
            waits.append(1e3 * (loaded - started))
            draws.append(1e3 * (clock.perf_counter() - loaded))
    totals = [wait + drawn for wait, drawn in zip(waits, draws, strict=True)]
    return {
        "seeks": SEEKS,
        "seeks_that_waited": waited,
        "seek_wait_ms": float(np.median(waits)),
        "seek_ms": float(np.median(totals)),
        "seek_ms_p95": float(np.percentile(totals, 95)),
    }


def prefixes(job: Loading) -> list[dict[str, Any]]:
    """Return the PSNR of prefixes of the file to the whole, at each end of a scale or of a segment of all scales."""
    ctx, whole = offscreen.open_context(), read(job.scene).dequantise()
    camera = fit_camera(Rig.of(whole).cameras[0], *job.size)
    scene = PartialScene(SceneReader(str(job.scene), in_parts=True))
    reference = Renderer(ctx, whole)
    wanted = [reference.render(camera, time).rgb.clip(0, 1) for time in COMPARED_TIMES]
    entries = [scene.entry(int(number)) for number in scene.numbers]
    found = []
    numbered = list(zip(entries, scene.numbers, strict=True))
    for at, (entry, number) in enumerate(progress(numbered, "prefixes", unit="segments")):
        scene.fetch([int(number)])
        after = entries[at + 1] if at + 1 < len(entries) else None
        if after is not None and (after.scale, after.row_start) == (entry.scale, entry.row_start):
            continue
        renderer = Renderer(ctx, scene.scene)
        errors = [
            np.mean((renderer.render(camera, time).rgb.clip(0, 1) - rgb) ** 2)
            for time, rgb in zip(COMPARED_TIMES, wanted, strict=True)
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


def _repeated(path: Path, folder: Path) -> Path:
    """Write the clip at `path` repeated REPETITIONS times into `folder`, and return the new file."""
    scene = read(path)
    scales = []
    for scale in scene.scales:
        planes = dict(scale)
        for name in TIME_PLANES:
            plane = scale[name]
            symbols, coded = np.tile(plane.symbols, (REPETITIONS, 1, 1)), np.tile(plane.coded, (REPETITIONS, 1))
            planes[name] = replace(plane, symbols=symbols, coded=coded, side_info=None, starts=())
        scales.append(planes)
    motion = scene.motion
    if motion is not None:
        motion = replace(motion, symbols=np.tile(motion.symbols, (REPETITIONS, 1, 1, 1, 1)))
    repeated = replace(
        scene,
        clip=Clip(scene.clip.frame_count * REPETITIONS, scene.clip.fps),
        scales=tuple(scales),
        motion=motion,
        occupancy=np.tile(scene.occupancy, (REPETITIONS, 1, 1, 1)),
    )
    out = folder / path.name
    from kpc.encoder.coding.scene_writer import encode  # here, since it needs numba

    out.write_bytes(encode(repeated, compress=False))
    return out


def _drawing(screen: moderngl.Framebuffer, renderer: Renderer, job: Loading) -> Callable[..., None]:
    """Return a function that draws the scene's first camera at a time, at a fraction of the size of the screen."""
    camera = Rig.of(renderer.scene).cameras[0]

    def draw(time: float, scale: float = 1.0) -> None:
        width, height = (max(1, round(side * scale)) for side in job.size)
        renderer.show(screen, fit_camera(camera, width, height), time)
        renderer.ctx.finish()

    return draw


def _upload_until(stream: Stream, renderer: Renderer, condition: Callable[[], bool]) -> None:
    """Upload what arrives, as the player does each frame, until the condition holds."""
    while not condition():
        if stream.failure is not None:
            raise KpcError(stream.failure)
        stream.upload(renderer)
        clock.sleep(0.0005)


@contextmanager
def served(scene: Path, *options: str) -> Iterator[str]:
    """Serve a scene from a process of its own while the context lasts, and return its URL."""
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
