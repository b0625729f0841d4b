"""What `kpbench player` measures: how long each quality level takes per frame, and how near it is to the reference."""

import time as clock
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import moderngl
import numpy as np

from kpc.format.common.fidelity import psnr
from kpc.format.common.memory import peak_memory_bytes
from kpc.format.common.progress import in_parts, progress
from kpc.format.container import scene_io
from kpc.format.scene.cameras import Camera
from kpc.format.scene.rig import Rig
from kpc.format.scene.scene import Scene
from kpc.player.cpu import reference
from kpc.player.gl import offscreen
from kpc.player.gl.renderer import Renderer, tries_compute
from kpc.player.quality import LEVELS, Quality
from kpc.player.viewpoints import fit_camera, orbit
from kpc.tools.bench.harness import size_text
from kpc.tools.bench.records import Record

# Frames drawn before those that are timed.
WARM_UP = 3

# Consecutive frames of one quality level before the next takes over. With a single frame, caches would hold nothing
# of what the level needs, which no real playback does.
TURN_FRAMES = 4

# The time in [0, 1] at which pictures are compared with the reference, and the frames that are played up to it.
COMPARED_TIME, LEAD_IN_FRAMES = 0.5, 24

# Pictures are compared at most at this many pixels, since the numpy reference is slow.
COMPARED_PIXELS = 640 * 480

# A quality level, and "fragment" or "compute".
Variant = tuple[str, str]


@dataclass(frozen=True)
class Play:
    """One run of the player."""

    scene: Path
    size: tuple[int, int]
    frames: int


@dataclass(frozen=True)
class _Stage:
    """An open scene, and where and whence it is drawn."""

    ctx: moderngl.Context
    screen: moderngl.Framebuffer
    scene: Scene
    camera: Camera
    context_ms: float
    load_ms: float

    def draw(self, renderer: Renderer, time: float) -> tuple[float, float]:
        """Draw a frame; return the milliseconds until it is complete, and those of all CPU threads together."""
        started, spent = clock.perf_counter(), clock.process_time()
        renderer.show(self.screen, self.camera, time)
        self.ctx.finish()
        return round(1e3 * (clock.perf_counter() - started), 3), round(1e3 * (clock.process_time() - spent), 3)


def frame_times(scene: Scene, frames: int, last: float) -> np.ndarray:
    """Return the times (frames,) in [0, 1] of consecutive frames of the clip that end at `last`."""
    spacing = 1 / max(scene.clip.frame_count - 1, 1)
    return np.clip(last - spacing * np.arange(frames)[::-1] % 1.0, 0.0, 1.0)


def play_once(job: Play) -> dict[str, Record]:
    """Open the file, draw the first frame and `job.frames` more at each quality level; return the times by level.

    The levels take turns of TURN_FRAMES frames, so that other load on the machine slows all of them alike. Where both
    fragment and compute shaders can draw, both are timed and the faster one counts.
    """
    stage = _open(job)
    shaders = ("fragment", "compute") if tries_compute(stage.ctx) else ("fragment",)
    variants = [(level, shader) for level in LEVELS for shader in shaders]
    renderers: dict[Variant, Renderer] = {}
    first: dict[Variant, Record] = {}
    for level, shader in progress(variants, "first frames", unit="variants"):
        renderers[level, shader], first[level, shader] = _first_frame(stage, LEVELS[level], shader)
    took: dict[Variant, list[tuple[float, float]]] = {key: [] for key in renderers}
    times = frame_times(stage.scene, WARM_UP + job.frames, 1.0)
    for start in progress(range(0, len(times), TURN_FRAMES), "timing", unit="turns"):
        for key in in_parts(variants):
            took[key] += [stage.draw(renderers[key], float(time)) for time in times[start : start + TURN_FRAMES]]
    median = {key: float(np.median(each[WARM_UP:], axis=0)[0]) for key, each in took.items()}
    reference_ms = min(median["reference", shader] for shader in shaders)
    found = {}
    for level in LEVELS:
        fastest = min(shaders, key=lambda shader: median[level, shader])
        renderer = renderers[level, fastest]
        frame_ms, cpu_ms = zip(*took[level, fastest][WARM_UP:], strict=True)
        renderer.check()
        found[level] = first[level, fastest] | {
            **{f"{shader}_ms_median": median[level, shader] for shader in shaders},
            "frame_ms": frame_ms,
            "frame_ms_median": median[level, fastest],
            "frame_ms_p95": float(np.percentile(frame_ms, 95)),
            "cpu_ms_median": float(np.median(cpu_ms)),
            "fps": 1e3 / median[level, fastest],
            "speedup_over_reference": reference_ms / median[level, fastest],
            "gpu_memory_bytes": renderer.memory_bytes,
            "peak_memory_bytes": peak_memory_bytes(),
            **_texel_rates(stage, renderer, fastest, median[level, fastest]),
        }
    return found


def _open(job: Play) -> _Stage:
    begun = clock.perf_counter()
    ctx = offscreen.open_context()
    screen = ctx.simple_framebuffer(job.size, components=4)
    opened = clock.perf_counter()
    scene = scene_io.read(job.scene).dequantise()
    loaded = clock.perf_counter()
    camera = fit_camera(Rig.of(scene).cameras[0], *job.size)
    return _Stage(ctx, screen, scene, camera, 1e3 * (opened - begun), 1e3 * (loaded - opened))


def _first_frame(stage: _Stage, quality: Quality, shader: str) -> tuple[Renderer, Record]:
    """Upload the scene and draw its first frame; return the renderer and what that took."""
    started = clock.perf_counter()
    renderer = Renderer(stage.ctx, stage.scene, quality, compute=shader == "compute")
    stage.ctx.finish()
    uploaded = clock.perf_counter()
    stage.draw(renderer, 0.0)
    shown = clock.perf_counter()
    parts = {
        "load_ms": stage.load_ms,
        "upload_ms": 1e3 * (uploaded - started),
        "first_render_ms": 1e3 * (shown - uploaded),
    }
    total = {"shader": shader, "context_ms": stage.context_ms, **parts, "first_frame_ms": sum(parts.values())}
    return renderer, total


def _texel_rates(stage: _Stage, renderer: Renderer, shader: str, frame_ms: float) -> Record:
    """Return the texels read per frame, and their rate relative to the peak of the graphics card.

    It is empty unless every pixel shown was marched for this very frame by shaders.
    """
    if (
        renderer.quality.reprojection_tolerance
        or renderer.rays_across(stage.camera) != 1
        or not renderer.texels_per_sample
    ):
        return {}
    texels = renderer.texels_per_sample * float(renderer.render(stage.camera, 1.0).samples.sum())
    from kpc.tools.bench.machine_limits import texel_rate  # here, since it needs numba

    peak = texel_rate(stage.ctx, shader == "compute", renderer.plane_dtype)
    return {"texels_per_frame": texels, "share_of_texel_rate": texels / (1e-3 * frame_ms) / peak}


def compare(job: Play) -> tuple[str, dict[str, Record]]:
    """Return the name of the OpenGL renderer, and how near each quality level is to the reference.

    The clip is played up to its middle, once from a fixed camera and once (keys that end in `_moving`) from one that
    orbits the scene by a degree per frame. The last picture is compared with the numpy reference; the minimum over all
    pictures is taken against the quality level "reference". With that level come the worst PSNR and the largest error
    of folding alone, over the pictures of both cameras.
    """
    ctx = offscreen.open_context()
    scene = scene_io.read(job.scene).dequantise()
    scale = min(1.0, (COMPARED_PIXELS / (job.size[0] * job.size[1])) ** 0.5)
    size = round(scale * job.size[0]), round(scale * job.size[1])
    common = {"time": COMPARED_TIME, "frames": LEAD_IN_FRAMES, "size": size_text(size)}
    found: dict[str, Record] = {level: dict(common) for level in LEVELS}
    fixed = [fit_camera(Rig.of(scene).cameras[0], *size)] * LEAD_IN_FRAMES
    moving = [fit_camera(camera, *size) for camera in orbit(scene, 360)[:LEAD_IN_FRAMES]]
    folding = [
        _compare_along(ctx, scene, cameras, suffix, found)
        for cameras, suffix in progress(((fixed, ""), (moving, "_moving")), "comparing", unit="paths")
    ]
    found["reference"] |= {
        "folding_psnr": min(psnr for psnr, _ in folding),
        "folding_max_error": max(error for _, error in folding),
    }
    return offscreen.describe(ctx), found


def _compare_along(
    ctx: moderngl.Context, scene: Scene, cameras: Sequence[Camera], suffix: str, found: dict[str, Record]
) -> tuple[float, float]:
    """Compare along a path of cameras, and add the results to `found`; return the PSNR and error of folding alone."""
    folding, folding_psnr, folding_error = Renderer(ctx, scene, Quality(folded=True), processor=False), 100.0, 0.0
    renderers = {level: Renderer(ctx, scene, quality) for level, quality in LEVELS.items()}
    psnrs: dict[str, list[float]] = {level: [] for level in LEVELS}
    drawn: dict[str, Any] = {}
    times = frame_times(scene, len(cameras), COMPARED_TIME)
    for camera, time in in_parts(list(zip(cameras, times, strict=True))):
        exact = np.clip(renderers["reference"].render(camera, float(time)).rgb, 0, 1)
        drawn = {level: renderer.render(camera, float(time)) for level, renderer in renderers.items()}
        for level, picture in drawn.items():
            psnrs[level].append(psnr(np.clip(picture.rgb, 0, 1), exact))
        error = np.clip(folding.render(camera, float(time)).rgb, 0, 1) - exact
        folding_psnr, folding_error = min(folding_psnr, psnr(error, 0)), max(folding_error, float(np.abs(error).max()))
    wanted = np.clip(reference.render(scene, cameras[-1], COMPARED_TIME).rgb, 0, 1)
    for level, picture in drawn.items():
        difference = np.clip(picture.rgb, 0, 1) - wanted
        found[level] |= {f"psnr{suffix}": psnr(difference, 0), f"psnr_min{suffix}": min(psnrs[level])}
        if not suffix:
            found[level]["within_one_level"] = float(np.mean(np.abs(difference).max(axis=2) <= 1 / 255))
            found[level]["samples_per_ray"] = float(picture.samples.mean())
    for renderer in (folding, *renderers.values()):
        renderer.release()
    return folding_psnr, folding_error


def renderer_name(_: None) -> str:
    """Return the name of the OpenGL renderer."""
    return offscreen.describe(offscreen.open_context())
