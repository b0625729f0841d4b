"""kpbench: how good, how small and how fast, as records that can be checked.

kpbench encode room liam --preset balanced --out docs/bench/balanced.json
kpbench curve room liam --minutes 1,2,5,10,20 --out docs/bench/curve.json
kpbench ablate default --preset fast --steps 2000 --out docs/bench/ablate.json
kpbench step room soldier --preset balanced --out docs/bench/step.json
kpbench groups long_clip --preset fast --group 5s --out docs/bench/groups.json
kpbench player room.kpc liam.kpc --out docs/bench/player.json
kpbench stream room.kpc liam.kpc --out docs/bench/stream.json
kpbench codec room.kpck liam.kpc --dataset room --dataset liam --out docs/bench/codec.json
kpbench entropy room.kpc liam.kpc --out docs/bench/entropy.json

Every record says what was run (commit, command, seed, settings), on what (machine, renderer, versions, SHA-256 of the
data) and what came of it, each repeat on its own. Output is one JSON list, a record a line: with --out written after
every run, else to stdout at the end. Every repeat is a process of its own, so that none inherits another's memory.
"""

import argparse
import json
import multiprocessing
import os
import re
import shlex
import sys
import tempfile
import time as clock
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import ProcessPoolExecutor
from concurrent.futures.process import BrokenProcessPool
from dataclasses import asdict, dataclass, replace
from datetime import UTC, datetime
from pathlib import Path
from types import ModuleType
from typing import Any, TypeVar

import numpy as np
from kpc.format.common import cli
from kpc.format.common.errors import KpcError, UsageError
from kpc.format.common.fidelity import psnr
from kpc.format.common.memory import peak_memory_bytes
from kpc.format.container import scene_io
from kpc.format.scene.scene import Scene
from kpc.player.quality import DEFAULT, LEVELS
from kpc.tools.bench import results
from kpc.tools.bench.provenance import commit, data_hash, machine, versions
from kpc.tools.dev.processes import end_with_parent

T = TypeVar("T")

Run = tuple[Path, dict[str, Any]]
"""A dataset, and what `kpenc.Options` differs in from the other runs."""

WARM_UP = 3
"""Frames drawn before those that are timed."""
TURN = 4
"""Frames that each quality draws before the next has its turn. After one that is another's, caches hold nothing of what it needs: in a turn of one,
as no clip is played, the pictures that are drawn soonest lose the most."""
MIDDLE, LEAD_IN = 0.5, 24
"""The time in the clip at which pictures are compared, and how many frames are played up to there: more than the turns of probes."""
COMPARED = 640 * 480
"""Pixels of the pictures that are compared, at most: the reference takes its time."""


@dataclass(frozen=True)
class Play:
    """What one run of the player is told."""

    scene: Path
    size: tuple[int, int]
    frames: int


def main(argv: list[str] | None = None) -> int:
    return cli.run(_command, "kpbench", argv)


def _command(argv: list[str]) -> None:
    options = _parser().parse_args(argv)
    origin = {
        "commit": commit(),
        "command": shlex.join(["kpbench", *argv]),
        "machine": machine(),
        "versions": versions(),
    }
    out: Path | None = options.out
    if out is not None and not out.absolute().parent.is_dir():
        raise UsageError(f"--out {out}: no such folder; make it first")
    records: list[results.Record] = []
    try:
        for record in options.measure(options, origin):
            records.append(record)
            if out is not None:
                with cli.atomic_write(out) as aside:
                    aside.write_text(_as_json(records))
    finally:  # a failure or Ctrl-C later on takes away nothing that was measured
        if records:
            print(results.aligned(results.cells(records[0]["kind"], records)), file=sys.stderr)
            if out is None:
                print(_as_json(records), end="")


def _as_json(records: Sequence[results.Record]) -> str:
    return "[\n" + ",\n".join(json.dumps(record) for record in records) + "\n]\n"


def _record(kind: str, source: Path, origin: results.Record, settings: dict[str, Any]) -> results.Record:
    """What a record says before anything is measured."""
    return {
        "kind": kind,
        "name": source.resolve().stem if source.is_file() else source.resolve().name,
        "date": datetime.now(UTC).isoformat(timespec="seconds"),
        **origin,
        "load_average": os.getloadavg()[0],
        "data_sha256": data_hash(source),
        "settings": settings,
    }


# --- encoding


def _encode(options: argparse.Namespace, origin: results.Record) -> Iterator[results.Record]:
    """One record a dataset."""
    runs: list[Run] = [(source, {"time_budget_s": options.time_budget}) for source in options.datasets]
    yield from _encodes("encode", options, origin, runs)


def _curve(options: argparse.Namespace, origin: results.Record) -> Iterator[results.Record]:
    """One record a dataset and time: an encode of its own, since the learning rate falls as the time runs out."""
    runs: list[Run] = [(source, {"time_budget_s": 60 * m}) for source in options.datasets for m in options.minutes]
    yield from _encodes("curve", options, origin, runs)


def _ablate(options: argparse.Namespace, origin: results.Record) -> Iterator[results.Record]:
    """One record a dataset and ablation that makes a difference to it, the unchanged run first."""
    _encoder()
    runs: list[Run] = []
    with tempfile.TemporaryDirectory(prefix="kpbench-") as scratch:
        for source in options.datasets:
            job = _job(
                options, _folder(source), options.seed, Path(scratch) / "none.kpc", Path(scratch) / f"{len(runs)}.work"
            )
            runs += [(source, {"ablation": name}) for name in _alone(_ablations, job)]
    yield from _encodes("ablate", options, origin, runs)


def _encodes(
    kind: str, options: argparse.Namespace, origin: results.Record, runs: Sequence[Run]
) -> Iterator[results.Record]:
    """A record a run. Repeat k has seed + k, so that repeats show the spread of quality, too."""
    _encoder()  # what is missing is said before anything is read
    with tempfile.TemporaryDirectory(prefix="kpbench-") as scratch:
        kept: Path = options.keep_scenes or Path(scratch)
        kept.mkdir(parents=True, exist_ok=True)
        for source, changes in runs:
            settings = {
                "preset": options.preset,
                "steps": options.steps,
                **changes,
                "downscale": options.downscale,
                "space": options.space,
                "box": options.box,
                "psnr_db": options.psnr,
                "test_views": options.test_views,
            }
            record = _record(kind, _folder(source), origin, settings) | {"seed": options.seed, "repeats": []}
            told = (
                "" if kind == "encode" else "-" + "-".join(str(value) for value in changes.values()).replace(" ", "-")
            )
            label = f"{record['name']}-{options.preset}{told}"
            for seed in range(options.seed, options.seed + options.repeats):
                suffix = f"-{seed}" if options.repeats > 1 else ""
                work = Path(scratch) / f"{label}-{seed}.work"
                job = replace(
                    _job(options, source, seed, kept / f"{label}{suffix}.kpc", work),
                    steps=options.steps,
                    max_test_pictures=options.test_views,
                    keep_checkpoint=kept / f"{label}{suffix}.kpck" if options.keep_scenes else None,
                    **changes,
                )
                said = ", ".join(f"{key} {value}" for key, value in changes.items() if value is not None)
                print(
                    f"kpbench: {record['name']}, {options.preset}, {said + ', ' if said else ''}seed {seed}",
                    file=sys.stderr,
                )
                device, outcome = _alone(_encode_once, job)
                record["repeats"].append(outcome)
            yield record | {"renderer": device}


def _step(options: argparse.Namespace, origin: results.Record) -> Iterator[results.Record]:
    """One record a dataset: where a training step's time goes, beside plain PyTorch and the machine's limits."""
    _encoder()  # what is missing is said before anything is read
    with tempfile.TemporaryDirectory(prefix="kpbench-") as scratch:
        for source in options.datasets:
            settings = {
                "preset": options.preset,
                "downscale": options.downscale,
                "space": options.space,
                "box": options.box,
            }
            record = _record("step", _folder(source), origin, settings) | {"seed": options.seed, "repeats": []}
            work = Path(scratch) / f"{record['name']}.work"
            job = _job(options, source, options.seed, Path(scratch) / "none.kpc", work)
            for _ in range(options.repeats):
                print(f"kpbench: {record['name']}, {options.preset}, a step", file=sys.stderr)
                device, found = _alone(_step_once, job)
                record["repeats"].append(found)
            yield record | {"kind": "step" if device == "cpu" else "gpu", "renderer": device}


def _groups(options: argparse.Namespace, origin: results.Record) -> Iterator[results.Record]:
    """A record a dataset: the peak of memory after the first group and after all, and how steady the clip is where they join.
    Beside --out also .svg, the PSNR of each frame."""
    _encoder()  # what is missing is said before anything is read
    records: list[results.Record] = []
    with tempfile.TemporaryDirectory(prefix="kpbench-") as scratch:
        kept: Path = options.keep_scenes or Path(scratch)
        kept.mkdir(parents=True, exist_ok=True)
        for source in options.datasets:
            settings = {"preset": options.preset, "group_s": options.group, "steps": options.steps, "downscale": options.downscale,
                        "space": options.space, "box": options.box, "test_views": options.test_views}  # fmt: skip
            record = _record("groups", _folder(source), origin, settings) | {"seed": options.seed}
            work = Path(scratch) / f"{record['name']}.work"
            job = replace(
                _job(options, source, options.seed, kept / f"{record['name']}-groups.kpc", work), steps=options.steps,
                max_test_pictures=options.test_views, group_s=options.group, keep=True,
            )  # fmt: skip
            print(f"kpbench: {record['name']}, {options.preset}, groups of {options.group:g} s", file=sys.stderr)
            device, found = _alone(_encode_once, job)
            each = found.pop("groups")
            repeat = found | {"groups": len(each), "peak_of_one_bytes": each[0]["peak_memory_bytes"]}
            records.append(record | {"renderer": device, "repeats": [repeat], "each": each} | _alone(_joins, job))
            yield records[-1]
    if options.out is not None:
        from kpc.tools.bench import plot  # needs matplotlib

        plot.save(plot.per_frame(records), options.out.with_suffix(".svg"))


def _joins(job: Any) -> dict[str, Any]:
    from kpc.encoder.datasets import load_dataset
    from kpc.tools.bench.group_joins import measure

    return measure(job.output, load_dataset(job.source, job.work_dir, holdout=job.holdout, downscale=job.downscale))


def _folder(source: Path) -> Path:
    if not source.is_dir():
        raise UsageError(f"{source}: no such folder")
    return source


def _job(options: argparse.Namespace, source: Path, seed: int, output: Path, work: Path) -> Any:
    """kpenc.Options of what all kinds that train have in common."""
    job = _encoder().Options(
        source=source,
        output=output,
        preset=options.preset,
        seed=seed,
        device=options.device,
        downscale=options.downscale,
        space=options.space,
        box=options.box,
        work=work,
    )
    return replace(job, trade=replace(job.trade, psnr_db=options.psnr))


def _ablations(job: Any) -> list[str]:
    names: list[str] = _encoder().ablations(job)
    return names


def _step_once(job: Any) -> tuple[str, results.Record]:
    """Where it was trained, and what was found."""
    from kpc.tools.bench.machine_limits import measure

    found: results.Record = _encoder().profile_steps(job)
    device = found.pop("device")
    limits = {"limits": asdict(measure())} if device == "cpu" else {}
    return device, found | limits | {"peak_memory_bytes": peak_memory_bytes()}


def _encode_once(job: Any) -> tuple[str, results.Record]:
    """Where it was trained, and what kpenc says of its run."""
    import torch

    outcome = _encoder().encode(job)
    device = outcome.pop("device")
    outcome["file"] = Path(outcome["file"]).name  # where it lay is nobody's business
    outcome["peak_memory_bytes"] = peak_memory_bytes()
    return device if device == "cpu" else torch.cuda.get_device_name(), outcome


def _encoder() -> ModuleType:
    try:
        from kpc.encoder.cli import kpenc
    except ModuleNotFoundError as error:
        raise UsageError(f'encode needs {error.name}, which is not installed; pip install "kpc[encoder]"') from error
    return kpenc


# --- playing


def _player(options: argparse.Namespace, origin: results.Record) -> Iterator[results.Record]:
    """A record for each scene and rung of the ladder of qualities. A repeat draws all of them by turns, frame by frame, so that
    whatever else the machine does slows them all alike."""
    for source in options.scenes:
        scene_io.read(source)  # what is wrong with it is told before anything is measured
        common = {
            "size": "{}x{}".format(*options.size),
            "frames": options.frames,
            "warm_up": WARM_UP,
            "default": DEFAULT,
        }
        record = _record("player", source, origin, common)
        job = Play(source, options.size, options.frames)
        print(f"kpbench: {record['name']}", file=sys.stderr)
        repeats = [_alone(_play_once, job) for _ in range(options.repeats)]  # first: drivers keep compiled shaders
        renderer, accuracy = _alone(_compare, job)
        for name, quality in LEVELS.items():
            settings = {"quality": name, **asdict(quality), **common}
            yield record | {"seed": None, "renderer": renderer, "settings": settings, "accuracy": accuracy[name],
                            "repeats": [repeat[name] for repeat in repeats]}  # fmt: skip


def _frame_times(scene: Scene, frames: int, last: float) -> np.ndarray:
    """(frames,) times of one frame of the clip after another, up to `last`."""
    each = 1 / max(scene.clip.frame_count - 1, 1)
    return np.clip(last - each * np.arange(frames)[::-1] % 1.0, 0.0, 1.0)


def _play_once(job: Play) -> dict[str, results.Record]:
    """Of each quality: open the file, draw the first frame, then `job.frames` more, the clip's own one after the other; by fragment and by
    compute shaders where there is a choice, of which the faster counts."""
    from kpc.player.gl import offscreen
    from kpc.player.gl.renderer import Renderer, tries_compute
    from kpc.player.viewpoints import Rig, fit_camera
    from kpc.tools.bench.machine_limits import texel_rate

    begun = clock.perf_counter()
    ctx = offscreen.open_context()
    screen = ctx.simple_framebuffer(job.size, components=4)
    opened = clock.perf_counter()
    scene = scene_io.read(job.scene).dequantise()
    loaded = clock.perf_counter()
    camera = fit_camera(Rig.of(scene).cameras[0], *job.size)

    def draw(renderer: Renderer, time: float) -> tuple[float, float]:
        """Milliseconds until the picture is there, and those that the processors spent on it."""
        started, spent = clock.perf_counter(), clock.process_time()
        renderer.show(screen, camera, time)
        ctx.finish()
        return round(1e3 * (clock.perf_counter() - started), 3), round(1e3 * (clock.process_time() - spent), 3)

    renderers, found = {}, {}
    ways = ("fragment", "compute") if tries_compute(ctx) else ("fragment",)
    for name, quality in LEVELS.items():
        for way in ways:
            started = clock.perf_counter()
            renderers[name, way] = renderer = Renderer(ctx, scene, quality, compute=way == "compute")
            ctx.finish()
            uploaded = clock.perf_counter()
            draw(renderer, 0.0)
            shown = clock.perf_counter()
            parts = {"load_ms": 1e3 * (loaded - opened), "upload_ms": 1e3 * (uploaded - started),
                     "first_render_ms": 1e3 * (shown - uploaded)}  # fmt: skip
            found[name, way] = {
                "way": way,
                "context_ms": 1e3 * (opened - begun),
                **parts,
                "first_frame_ms": sum(parts.values()),
            }
    took: dict[tuple[str, str], list[tuple[float, float]]] = {key: [] for key in renderers}
    times = _frame_times(scene, WARM_UP + job.frames, 1.0)
    for first in range(0, len(times), TURN):
        for key, renderer in renderers.items():
            took[key] += [draw(renderer, float(time)) for time in times[first : first + TURN]]
    median = {key: float(np.median(each[WARM_UP:], axis=0)[0]) for key, each in took.items()}
    best = {name: found[name, min(ways, key=lambda way: median[name, way])] for name in LEVELS}
    for name in LEVELS:
        key = name, best[name]["way"]
        renderer, frame_ms, cpu_ms = renderers[key], *zip(*took[key][WARM_UP:], strict=True)
        renderer.check()
        best[name] |= {
            **{f"{way}_ms_median": median[name, way] for way in ways},
            "frame_ms": frame_ms,
            "frame_ms_median": median[key],
            "frame_ms_p95": float(np.percentile(frame_ms, 95)),
            "cpu_ms_median": float(np.median(cpu_ms)),
            "fps": 1e3 / median[key],
            "times_reference": min(median["reference", way] for way in ways) / median[key],
            "gpu_memory_bytes": renderer.memory_bytes,
            "peak_memory_bytes": peak_memory_bytes(),
        }
        if (
            renderer.quality.reprojection_tolerance == 0
            and renderer.rays_across(camera) == 1
            and renderer.texels_per_sample
        ):  # all it shows has been marched for it
            texels = renderer.texels_per_sample * float(renderer.render(camera, 1.0).samples.sum())
            peak = texel_rate(ctx, key[1] == "compute", renderer.plane_dtype)
            best[name] |= {"texels_a_frame": texels, "share_of_texel_rate": texels / (1e-3 * median[key]) / peak}
    return best


def _stream(options: argparse.Namespace, origin: results.Record) -> Iterator[results.Record]:
    """A record a scene: how soon it is seen from a disk and over a slow line, and what its prefixes look like."""
    from kpc.tools.bench import streaming_bench

    for source in options.scenes:
        settings = {"size": "{}x{}".format(*options.size), "rate": streaming_bench.RATE, "delay": streaming_bench.DELAY}
        job = streaming_bench.Arrival(source, options.size, LEVELS[DEFAULT])
        record = _record("stream", source, origin, settings)
        print(f"kpbench: {record['name']}", file=sys.stderr)
        repeats = [_alone(streaming_bench.measure, job) for _ in range(options.repeats)]
        yield record | {"seed": None, "renderer": _alone(_renderer, None), "repeats": repeats,
                        "prefixes": _alone(streaming_bench.prefixes, job)}  # fmt: skip


def _steady(options: argparse.Namespace, origin: results.Record) -> Iterator[results.Record]:
    """A record a scene: whether long playback in a window takes ever more memory."""
    from kpc.tools.bench import playback_stability

    for source in options.scenes:
        record = _record("steady", source, origin, {"size": "{}x{}".format(*options.size), "frames": options.frames})
        yield _in_window(
            record,
            options.repeats,
            playback_stability.measure,
            playback_stability.Steady(source, options.size, options.frames),
        )


def _window(options: argparse.Namespace, origin: results.Record) -> Iterator[results.Record]:
    """A record a scene: what a window that is left to itself plays at."""
    from kpc.tools.bench import pacing

    for source in options.scenes:
        settings = {"size": "{}x{}".format(*options.size), "seconds": options.seconds, "turn": options.turn}
        job = pacing.Pacing(source, options.size, options.seconds, options.turn)
        yield _in_window(_record("window", source, origin, settings), options.repeats, pacing.measure, job)


def _in_window(
    record: results.Record, repeats: int, measure: Callable[[Any], results.Record], job: object
) -> results.Record:
    """A record with what was measured, each time in a process of its own."""
    print(f"kpbench: {record['name']}", file=sys.stderr)
    found = [_alone(measure, job) for _ in range(repeats)]
    return record | {"seed": None, "renderer": found[0].pop("renderer"), "repeats": found}


def _renderer(_: None) -> str:
    from kpc.player.gl import offscreen

    return offscreen.describe(offscreen.open_context())


def _compare(job: Play) -> tuple[str, dict[str, results.Record]]:
    """The renderer's name, and how near the pictures of each quality come to the reference's while the clip plays up to its middle:
    from one camera, and PSNR from one that turns around the scene by a degree a frame, too.

    The last picture is compared with the reference itself, the worst of all ("least") is found by the rung of that name. So is what
    folding alone costs in the worst of all pictures of both, which is told with the reference.
    """
    from kpc.player.cpu import reference
    from kpc.player.gl import offscreen
    from kpc.player.gl.renderer import Renderer
    from kpc.player.quality import Quality
    from kpc.player.viewpoints import Rig, fit_camera, orbit

    ctx = offscreen.open_context()
    scene = scene_io.read(job.scene).dequantise()
    folding, folding_psnr, folding_most = Renderer(ctx, scene, Quality(folded=True), processor=False), [], 0.0
    times = _frame_times(scene, LEAD_IN, MIDDLE)
    smaller = min(1.0, (COMPARED / (job.size[0] * job.size[1])) ** 0.5)
    size = round(smaller * job.size[0]), round(smaller * job.size[1])
    common = {"time": MIDDLE, "frames": LEAD_IN, "size": "{}x{}".format(*size)}
    found: dict[str, results.Record] = {name: dict(common) for name in LEVELS}
    for suffix, cameras in (("", [Rig.of(scene).cameras[0]] * LEAD_IN), ("_turning", orbit(scene, 360)[:LEAD_IN])):
        renderers = {name: Renderer(ctx, scene, quality) for name, quality in LEVELS.items()}
        each: dict[str, list[float]] = {name: [] for name in LEVELS}
        for view, time in zip(cameras, times, strict=True):
            camera = fit_camera(view, *size)
            exact = np.clip(renderers["reference"].render(camera, float(time)).rgb, 0, 1)
            drawn = {name: renderer.render(camera, float(time)) for name, renderer in renderers.items()}
            for name, picture in drawn.items():
                each[name].append(psnr(np.clip(picture.rgb, 0, 1), exact))
            off = np.clip(folding.render(camera, float(time)).rgb, 0, 1) - exact
            folding_psnr.append(psnr(off, 0))
            folding_most = max(folding_most, float(np.abs(off).max()))
        wanted = np.clip(reference.render(scene, camera, MIDDLE).rgb, 0, 1)
        for name, picture in drawn.items():
            difference = np.clip(picture.rgb, 0, 1) - wanted
            found[name] |= {f"psnr{suffix}": psnr(difference, 0), f"psnr_least{suffix}": min(each[name])}
            if not suffix:
                found[name]["within_one_level"] = float(np.mean(np.abs(difference).max(axis=2) <= 1 / 255))
                found[name]["samples_per_ray"] = float(picture.samples.mean())
        for renderer in renderers.values():
            renderer.release()
    found["reference"] |= {"folding_psnr": min(folding_psnr), "folding_most": folding_most}
    return offscreen.describe(ctx), found


# --- coding


def _codec(options: argparse.Namespace, origin: results.Record) -> Iterator[results.Record]:
    """A record for each scene and coder; beside --out also .csv of all points and .svg of the curves, and until the end, for another try to go
    on with, .NAME.points of each scene."""
    _encoder()  # what is missing is said before anything is read
    from kpc.tools.bench import codec_bench  # needs scipy

    folders: list[Path | None] = options.dataset or [None] * len(options.scenes)
    if len(folders) != len(options.scenes):
        raise UsageError(
            f"--dataset is given {len(folders)} times for {len(options.scenes)} scenes; name one for each, or none"
        )
    if options.out is not None:
        from kpc.tools.bench import plot  # needs matplotlib
    records: list[results.Record] = []
    noted: list[Path] = []
    for source, folder in zip(options.scenes, folders, strict=True):
        judged_by = "its own probe" if folder is None else f"held-out views of {_folder(folder).resolve().name}"
        record = _record("codec", source, origin, {"judged_by": judged_by, "processes": options.processes})
        print(f"kpbench: {record['name']}, judged by {judged_by}", file=sys.stderr)
        notes = options.out and codec_bench.Notes(
            options.out.with_suffix(f".{record['name']}.points"),
            {key: record[key] for key in ("commit", "data_sha256", "machine", "versions", "settings")},
        )
        coders = codec_bench.measure(source, folder, options.processes, options.ablate, notes)
        for coder in coders:
            repeats = [codec_bench.headline(coder["points"])]
            records.append(record | {"seed": None, "renderer": "cpu"} | coder | {"repeats": repeats})
            yield records[-1]
        noted += [notes.path] if notes else []
    if options.out is not None:
        with cli.atomic_write(options.out.with_suffix(".csv")) as aside:
            aside.write_text(codec_bench.as_csv(records))
        plot.save(plot.rate_distortion(records), options.out.with_suffix(".svg"))
    for path in noted:
        path.unlink()


def _entropy(options: argparse.Namespace, origin: results.Record) -> Iterator[results.Record]:
    """A record for each scene and idea of the entropy coder that is left out."""
    from kpc.tools.bench.entropy_ablation import measure

    for source in options.scenes:
        for name, found in measure(source).items():
            settings = {"left_out": name}
            yield _record("entropy", source, origin, settings) | {"seed": None, "renderer": "cpu", "repeats": [found]}


def _alone(function: Callable[[Any], T], job: Any) -> T:
    """`function(job)` in a fresh process."""
    with ProcessPoolExecutor(1, multiprocessing.get_context("spawn"), initializer=end_with_parent) as pool:
        try:
            return pool.submit(function, job).result()
        except BrokenProcessPool as error:
            raise KpcError(f"{function.__name__.strip('_')}: the process was killed; free some memory") from error


# --- the command line


def _parser() -> argparse.ArgumentParser:
    parser = argparse.ArgumentParser(
        "kpbench", description="Measure encoding or playing; JSON on stdout or in --out, a table on stderr."
    )
    cli.add_version_option(parser)
    kinds = parser.add_subparsers(
        dest="kind", required=True, metavar="encode|curve|ablate|step|groups|player|stream|window|steady|codec|entropy"
    )

    encode = kinds.add_parser("encode", help="kpenc on each dataset", description="Run kpenc on each dataset.")
    encode.add_argument("--steps", type=_positive, help="optimiser steps instead of the preset's")
    encode.add_argument("--time-budget", type=cli.duration_s, metavar="10m", help="of training, instead of steps")
    encode.set_defaults(measure=_encode)

    curve = kinds.add_parser(
        "curve", help="quality against time", description="Run kpenc on each dataset for each time."
    )
    curve.add_argument("--minutes", type=_minutes, default=(1.0, 2.0, 5.0, 10.0, 20.0), metavar="1,2,5,10,20",
                       help="of training, a run of its own for each (default: 1,2,5,10,20)")  # fmt: skip
    curve.set_defaults(measure=_curve, steps=None)

    ablate = kinds.add_parser("ablate", help="what each part is worth", description="Run kpenc on each dataset, with one thing "
                              "changed at a time: kpc.encoder.evaluation.ablations.")  # fmt: skip
    ablate.add_argument("--steps", type=_positive, help="optimiser steps instead of the preset's")
    ablate.set_defaults(measure=_ablate)

    step = kinds.add_parser(
        "step", help="where the time of training goes", description="Profile a training step, on the CPU."
    )
    step.set_defaults(measure=_step, device="cpu")

    groups = kinds.add_parser("groups", help="a long clip in groups", description="Run kpenc --group on each dataset: memory of "
                              "one group and of all, and how steady held-out views are where groups join.")  # fmt: skip
    groups.add_argument(
        "--group", type=cli.duration_s, default=10.0, metavar="10s", help="that each shows (default: 10s)"
    )
    groups.add_argument("--steps", type=_positive, help="optimiser steps of the first group instead of the preset's")
    groups.set_defaults(measure=_groups)

    for kind in (encode, curve, ablate, step, groups):
        kind.add_argument("datasets", type=Path, nargs="+", metavar="DATASET", help="folders, as for kpenc")
        kind.add_argument("--preset", choices=("draft", "fast", "balanced", "best", "paper"), default="balanced")
        kind.add_argument(
            "--seed", type=int, default=0, help="of the first repeat; each next one takes the next number"
        )
        kind.add_argument("--downscale", type=_positive, default=1, help="average blocks of N x N pixels first")
        kind.add_argument(
            "--space", choices=("auto", "box", "contracted", "ndc"), default="auto", help="of every dataset"
        )
        kind.add_argument("--box", type=cli.box_corners, metavar="x0,y0,z0,x1,y1,z1", help="of every dataset")
        kind.set_defaults(psnr=None)
    encode.add_argument(
        "--psnr", type=cli.decibels, metavar="30dB", help="the smallest files of at least this PSNR on training views"
    )
    for kind in (encode, curve, ablate, groups):
        kind.add_argument("--device", choices=("auto", "cpu", "cuda"), default="auto")
        kind.add_argument("--test-views", type=_positive, metavar="N", help="test on at most N held-out pictures")
        kind.add_argument(
            "--keep-scenes", type=Path, metavar="DIR", help="keep the .kpc files there, and what `codec` takes, .kpck"
        )

    player = kinds.add_parser("player", help="draw each scene, headless", description="Draw each scene, headless.")
    player.add_argument("scenes", type=Path, nargs="+", metavar="SCENE", help=".kpc files")
    player.add_argument("--size", type=_size, default=(320, 240), metavar="WxH", help="of a frame (default: 320x240)")
    player.add_argument("--frames", type=_positive, default=60, help="timed frames, spread over the clip (default: 60)")
    player.set_defaults(measure=_player)

    stream = kinds.add_parser("stream", help="scenes that play while they arrive", description="How soon scenes are seen from a "
                              "disk and over a slow line, how soon after a jump, and what their prefixes look like.")  # fmt: skip
    stream.add_argument("scenes", type=Path, nargs="+", metavar="SCENE", help=".kpc files")
    stream.add_argument("--size", type=_size, default=(320, 240), metavar="WxH", help="of a picture (default: 320x240)")
    stream.set_defaults(measure=_stream)

    playback_stability = kinds.add_parser("steady", help="long playback in a window", description="Whether memory stays as it is, and nothing "
                              "is made anew on the graphics card, while scenes play in a window. Wants a display.")  # fmt: skip
    playback_stability.add_argument("scenes", type=Path, nargs="+", metavar="SCENE", help=".kpc files")
    playback_stability.add_argument(
        "--size", type=_size, default=(320, 240), metavar="WxH", help="of the window (default: 320x240)"
    )
    playback_stability.add_argument("--frames", type=_positive, default=10_000, help="to draw (default: 10000)")
    playback_stability.set_defaults(measure=_steady)

    window = kinds.add_parser("window", help="playback in a window that is left to itself", description="On how fine a raster, and how "
                              "often, a window draws scenes as they play, and how near that is to exact pictures. Wants a display.")  # fmt: skip
    window.add_argument("scenes", type=Path, nargs="+", metavar="SCENE", help=".kpc files")
    window.add_argument(
        "--size", type=_size, default=(800, 600), metavar="WxH", help="of the window (default: 800x600)"
    )
    window.add_argument("--seconds", type=_positive, default=20, metavar="S", help="to look at (default: 20)")
    window.add_argument(
        "--turn", type=float, default=0.0, metavar="DEGREES", help="a second, around the scene meanwhile (default: 0)"
    )
    window.set_defaults(measure=_window)

    codec = kinds.add_parser("codec", help="rate against distortion, beside general tools",
                             description="Code each scene at several rates, and its planes with what a user has at hand: "
                                         "kpc.tools.bench.baselines. With --out FILE.json also FILE.csv and FILE.svg.")  # fmt: skip
    codec.add_argument("scenes", type=Path, nargs="+", metavar="SCENE", help="finished checkpoints (kpenc --keep-checkpoint) or "
                       ".kpc files")  # fmt: skip
    codec.add_argument("--dataset", type=Path, action="append", metavar="DIR",
                       help="judge by its held-out views; once for each scene, in their order (default: training pixels of a "
                            "checkpoint, a file's own pictures)")  # fmt: skip
    codec.add_argument(
        "--ablate",
        action="store_true",
        help="measure our own coder with one of its ideas left out, too: for each of them",
    )
    codec.add_argument("--processes", type=_positive, default=int(machine()["cores"]), metavar="N",
                       help="at a time (default: one a core)")  # fmt: skip
    codec.set_defaults(measure=_codec)

    entropy = kinds.add_parser("entropy", help="what the entropy coder's ideas are worth",
                               description="Code the symbols of each scene again, with one idea left out at a time.")  # fmt: skip
    entropy.add_argument("scenes", type=Path, nargs="+", metavar="SCENE", help=".kpc files")
    entropy.set_defaults(measure=_entropy)

    for kind in (encode, curve, ablate, step, player, stream, window, playback_stability):
        kind.add_argument("--repeats", type=_positive, default=1, help="of each run (default: 1)")
    for kind in (encode, curve, ablate, step, groups, player, stream, window, playback_stability, codec, entropy):
        kind.add_argument("--out", type=Path, metavar="FILE", help="write the records there instead of to stdout")
    return parser


def _positive(text: str) -> int:
    if not text.isdecimal() or int(text) < 1:
        raise argparse.ArgumentTypeError(f"{text!r} is not a whole number from 1 on")
    return int(text)


def _minutes(text: str) -> tuple[float, ...]:
    try:
        values = tuple(float(word) for word in text.split(","))
    except ValueError:
        values = ()
    if not values or not all(0 < value < 1e6 for value in values):
        raise argparse.ArgumentTypeError(f"{text!r} is no list of minutes; write 1,2,5")
    return values


def _size(text: str) -> tuple[int, int]:
    match = re.fullmatch(r"([1-9]\d{0,3})x([1-9]\d{0,3})", text)
    if match is None:
        raise argparse.ArgumentTypeError(f"{text!r} is not a size like 320x240")
    return int(match[1]), int(match[2])


if __name__ == "__main__":
    sys.exit(main())
