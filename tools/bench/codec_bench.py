"""What `kpbench codec` measures: rate against distortion of KPC's coder and of general-purpose codecs.

Every coder gets the same planes, those of the checkpoint or the dequantised ones of a .kpc file, and distortion is
measured on the same pixels. The baselines (`kpc.tools.bench.baselines`) code planes only, so their sizes include the
decoder, occupancy, motion and cameras as KPC's file stores them, but no header and index. One baseline is fine-tuned in
the same way as KPC's coder. Sizes of the planes alone are compared, too.
"""

import contextlib
import csv
import io
import json
import math
import multiprocessing
import os
import tempfile
import time
from collections.abc import Iterator, Mapping, Sequence
from concurrent.futures import Future, ProcessPoolExecutor
from concurrent.futures.process import BrokenProcessPool
from dataclasses import dataclass, replace
from functools import lru_cache, partial
from pathlib import Path
from typing import Any

import numpy as np

from kpc.encoder.coding import scene_writer
from kpc.encoder.datasets import Dataset, load_dataset, pixel_rays
from kpc.encoder.evaluation.validation_rays import Fidelity, Measure, ValidationRays
from kpc.encoder.field.config import TrainConfig
from kpc.encoder.rdo import codec_model
from kpc.encoder.rdo.codec_model import Model
from kpc.encoder.rdo.distortion import PlaneKey
from kpc.encoder.rdo.mode_decision import quantise_by_cost
from kpc.encoder.rdo.rate_control import DEFAULT_LOSS_DB, QuantiseFunction, Trade
from kpc.encoder.rdo.sequential_finetune import code_sequentially
from kpc.format.coding.quantise import quantise_scene, round_decoder
from kpc.format.common.errors import KpcError, TrainingError
from kpc.format.common.progress import progress
from kpc.format.container import scene_io
from kpc.format.scene.scene import Scene
from kpc.tools.bench import baselines
from kpc.tools.bench.baselines import Baseline, Coding, Planes
from kpc.tools.bench.provenance import machine
from kpc.tools.bench.rd_curves import Point, bd_rate, size_at
from kpc.tools.dev.processes import end_with_parent

# Target rates of KPC's coder, in bits of the whole file per parameter.
RATES = (0.05, 0.1, 0.2, 0.35, 0.5, 0.75, 1.0, 1.5, 2.0)

# Values of `Trade.quality`, on the validation rays of the scene itself.
QUALITIES = (40, 55, 70, 85, 100)

# Number of random pixels of all held-out views on which distortion is measured.
VIEW_PIXELS = 1 << 15

# Steps of fine-tuning per group of planes.
TUNE_STEPS = TrainConfig().tune_steps

BASELINES = {baseline.name: baseline for baseline in baselines.BASELINES}

# Baselines whose remaining planes are fine-tuned to make up for the loss of those already coded, and which they are.
FINE_TUNED = {"AV1, fine-tuned": "AV1"}

OURS = "kpc"
NO_GRID_RDO = "kpc, no grid RDO"

# Ablations of KPC's coder, at QUALITIES, all without fine-tuning: how planes are quantised; None is the usual way. The
# first two lack nothing else, or the rate-distortion optimisation of occupancy and motion grids. The others ignore the
# correlation of errors between channels, and the last four leave out one more part each.
ABLATIONS: dict[str, QuantiseFunction | None] = {
    "kpc, no fine-tuning": None,
    NO_GRID_RDO: None,
    "kpc, independent channels": quantise_by_cost,
    "kpc, no transform": partial(quantise_by_cost, block_sides=()),
    "kpc, no transform or prediction": partial(quantise_by_cost, low_rate_bits=0.0, block_sides=()),
    "kpc, no trellis": lambda scene, steps, reached, significant: quantise_scene(scene, steps, reached=reached),
    "kpc, uniform weights": lambda scene, steps, reached, significant: quantise_by_cost(scene, steps, reached),
}


@dataclass(frozen=True)
class Job:
    """One coder and setting for one scene.

    Attributes:
        coder: OURS, a key of ABLATIONS, BASELINES or FINE_TUNED.
        setting: the setting of a baseline; for KPC's coder the name of `trade`.
        trade: the target of KPC's coder; None for a baseline.
    """

    scene: Path
    coder: str
    setting: int | str
    trade: Trade | None = None

    @property
    def key(self) -> str:
        """Identify the job among those of its scene."""
        return f"{self.coder}: {self.setting}"


@dataclass(frozen=True)
class PointLog:
    """A file that holds the points measured so far, a line each, from which an interrupted benchmark goes on.

    Attributes:
        stamp: everything the points depend on, the first line. Points under another stamp are ignored.
    """

    path: Path
    stamp: dict[str, Any]

    def read(self) -> dict[str, Point | None]:
        """Return the points by `Job.key`, without an incomplete last line."""
        found: list[Any] = []
        with contextlib.suppress(OSError, ValueError), self.path.open() as lines:
            found.extend(map(json.loads, lines))
        return dict(found[1:]) if found and found[0] == self.stamp else {}

    def begin(self) -> dict[str, Point | None]:
        """Write the file anew with the points that `read` finds, and return them."""
        points = self.read()
        self.path.write_text("".join(json.dumps(line) + "\n" for line in (self.stamp, *points.items())))
        return points

    def add(self, key: str, point: Point | None) -> None:
        """Append a point."""
        with self.path.open("a") as lines:
            lines.write(json.dumps([key, point]) + "\n")


def measure(
    scene: Path, dataset: Path | None, processes: int, ablate: bool, log: PointLog | None = None
) -> list[dict[str, Any]]:
    """Measure all coders on a scene.

    Args:
        scene: a checkpoint or a .kpc file.
        dataset: distortion is measured on its held-out views; None for the validation rays of the scene.
        ablate: whether to measure ABLATIONS, too.
        log: holds points that need not be measured again, and receives new ones.

    Returns:
        For each coder, KPC's first: its name, its points or why it has none, and its delta rates against KPC's coder.

    Raises:
        KpcError: the scene or the dataset cannot be used, or a coder failed.
    """
    source = codec_model.load(scene)
    views = None if dataset is None else held_out_views(source.scene, dataset)
    own = [OURS, *(ABLATIONS if ablate else ())]
    others = BASELINES | {name: BASELINES[base] for name, base in FINE_TUNED.items() if base in BASELINES}
    missing = {name: why for name, baseline in others.items() if (why := baseline.missing())}
    jobs = _own_jobs(scene, own, source.scene.parameter_count)
    for name, baseline in others.items():
        if name not in missing:
            jobs += [Job(scene, name, setting) for setting in reversed(baseline.settings)]
    points = {} if log is None else log.begin()
    remaining = [job for job in jobs if job.key not in points]
    measured = progress(in_parallel(remaining, views, processes), "codec", len(remaining), "points")
    for job, found_point in zip(remaining, measured, strict=True):
        points[job.key] = found_point
        if log is not None:
            log.add(job.key, found_point)
    coders = []
    for name in (*own, *others):
        found = [one for job in jobs if job.coder == name and (one := points[job.key]) is not None]
        coders.append({"coder": name, "missing": missing.get(name), "points": found})
    for coder in coders:
        for key, size in (("bd_rate", "size_bytes"), ("bd_rate_planes", "planes_bytes")):
            coder[key] = None if coder is coders[0] else bd_rate(coders[0]["points"], coder["points"], size)
    return coders


def _own_jobs(scene: Path, coders: Sequence[str], parameter_count: int) -> list[Job]:
    """Return the jobs of KPC's coder, at RATES and QUALITIES, and of its ablations, at QUALITIES."""
    rates = {f"{rate:g} bits": Trade(target_bytes=int(rate * parameter_count / 8)) for rate in RATES}
    qualities = {f"quality {q:g}": Trade(quality=q) for q in QUALITIES}
    return [
        Job(scene, name, setting, trade)
        for name in coders
        for setting, trade in ((rates if name == OURS else {}) | qualities).items()
    ]


def in_parallel(jobs: Sequence[Job], views: ValidationRays | None, processes: int) -> Iterator[Point | None]:
    """Yield the points of all jobs in order, computed in processes that share the cores evenly.

    Args:
        views: the rays on which distortion is measured; None for those of the scene.
    """
    before = os.environ.get("NUMBA_NUM_THREADS")
    os.environ["NUMBA_NUM_THREADS"] = str(max(1, int(machine()["cores"]) // processes))
    try:
        with ProcessPoolExecutor(processes, multiprocessing.get_context("spawn"), _evaluate_on, (views,)) as pool:
            futures: list[Future[Point | None]] = [pool.submit(point, job) for job in jobs]
            try:
                for future in futures:
                    yield future.result()
            except BrokenProcessPool as error:
                raise KpcError("codec: a process was killed; free some memory, or give fewer --processes") from error
            finally:
                pool.shutdown(cancel_futures=True)
    finally:
        if before is None:
            del os.environ["NUMBA_NUM_THREADS"]
        else:
            os.environ["NUMBA_NUM_THREADS"] = before


def point(job: Job) -> Point | None:
    """Return what a coder achieves at one setting; None where it cannot make so small a file."""
    if job.coder in BASELINES:
        return _baseline_point(job)
    if job.coder in FINE_TUNED:
        return _fine_tuned_point(job)
    return _own_point(job)


def _baseline_point(job: Job) -> Point:
    source, _, measure = _source(job.scene)
    coding = BASELINES[job.coder].code(_filled_planes(job.scene), int(job.setting))
    scene = replace(source.scene, scales=tuple(coding.planes))
    times = coding.encode_s, coding.decode_s
    return _point(job, coding.size_bytes, others_bytes(job.scene), times, measure(scene))


def _fine_tuned_point(job: Job) -> Point:
    source, _, measure = _source(job.scene)
    started = time.perf_counter()
    scene, codings = fine_tune_through(BASELINES[FINE_TUNED[job.coder]], int(job.setting), source.scene)
    search_s = time.perf_counter() - started
    size = sum(coding.size_bytes for coding in codings)
    times = sum(coding.encode_s for coding in codings), sum(coding.decode_s for coding in codings)
    return _point(job, size, others_bytes(job.scene), times, measure(scene)) | {"search_s": search_s}


def _own_point(job: Job) -> Point | None:
    source, _, measure = _source(job.scene)
    started = time.perf_counter()
    try:
        coded = codec_model.code(
            source,
            job.trade or Trade(),
            TrainConfig().prune_share,
            TUNE_STEPS if job.coder == OURS else 0,
            ABLATIONS.get(job.coder),
            grids=job.coder != NO_GRID_RDO,
        )
    except TrainingError:
        return None
    searched = time.perf_counter()
    data = scene_writer.encode(coded.scene)
    encoded = time.perf_counter()
    scene = scene_io.read(data).dequantise()
    times = encoded - searched, time.perf_counter() - encoded
    stored = stored_bytes(data)
    others = _others_of(stored)
    found = _point(job, len(data) - others, others, times, measure(scene))
    return found | {
        "search_s": searched - started,
        "shares": {kind: count / len(data) for kind, count in stored.items()},
    }


def fine_tune_through(baseline: Baseline, setting: int, scene: Scene) -> tuple[Scene, list[Coding]]:
    """Code planes group by group with a baseline, fine-tuning what remains as KPC's coder does.

    Returns:
        The decoded scene, and the coding of each group.
    """
    codings: list[Coding] = []

    def coded(candidate: Scene, group: Sequence[PlaneKey]) -> dict[PlaneKey, np.ndarray]:
        planes = baselines.fill_unread_texels(candidate)
        scales = sorted({s for s, _ in group})
        chosen = [{name: plane for name, plane in planes[s].items() if (s, name) in group} for s in scales]
        codings.append(baseline.code(chosen, setting))
        decoded = zip(scales, codings[-1].planes, strict=True)
        return {(s, name): plane for s, scale in decoded for name, plane in scale.items()}

    decoded = code_sequentially(scene, scene, coded, TUNE_STEPS)
    return replace(decoded, decoder=round_decoder(decoded.decoder)), codings


def _point(job: Job, planes_size: int, others_size: int, times: tuple[float, float], fidelity: Fidelity) -> Point:
    """Return a point from bytes of the planes and of all else, the times of encoding and decoding, and the fidelity."""
    source, uncoded, _ = _source(job.scene)
    size = planes_size + others_size
    return {
        "setting": job.setting,
        "size_bytes": size,
        "planes_bytes": planes_size,
        "bits_per_parameter": 8 * size / source.scene.parameter_count,
        "psnr": fidelity.psnr,
        "loss_db": uncoded.psnr - fidelity.psnr,
        "agreement_db": fidelity.agreement_db,
        "encode_s": times[0],
        "decode_s": times[1],
    }


# The rays on which this process measures distortion; None for the validation rays of the scene.
_views: ValidationRays | None = None


def _evaluate_on(views: ValidationRays | None) -> None:
    """Set the rays of this process, as the initialiser of a worker process."""
    global _views
    _views = views
    if multiprocessing.parent_process() is not None:
        end_with_parent()


@lru_cache(1)
def _source(path: Path) -> tuple[Model, Fidelity, Measure]:
    """Return the uncoded scene, its fidelity, and the function that measures others."""
    source = codec_model.load(path)
    measure = (_views or source.validation).measure(source.scene)
    return source, measure(source.scene), measure


@lru_cache(1)
def _filled_planes(path: Path) -> Planes:
    return baselines.fill_unread_texels(_source(path)[0].scene)


@lru_cache(1)
def others_bytes(path: Path) -> int:
    """Return the stored bytes of all chunks but planes, in KPC's file of the scene."""
    source, _, _ = _source(path)
    return _others_of(
        stored_bytes(scene_writer.encode(source.coded or codec_model.code(source, Trade(), 0.0, 0).scene))
    )


def _others_of(stored: Mapping[str, int]) -> int:
    """Sum `stored_bytes` without planes; header and index count as part of the planes."""
    return sum(count for kind, count in stored.items() if kind not in ("PLNE", "index"))


def stored_bytes(data: bytes) -> dict[str, int]:
    """Return the bytes of each kind of chunk of a file, and of header and index as "index"."""
    stored: dict[str, int] = {}
    for entry in scene_io.SceneReader(data).index:
        stored[entry.kind] = stored.get(entry.kind, 0) + entry.stored_length
    return stored | {"index": len(data) - sum(stored.values())}


def held_out_views(scene: Scene, folder: Path) -> ValidationRays:
    """Return random pixels of all held-out pictures of a dataset.

    Raises:
        KpcError: the dataset cannot be used, or holds out no picture.
    """
    with tempfile.TemporaryDirectory(prefix="kpbench-") as work:
        dataset = load_dataset(folder, Path(work))
        return _held_out_rays(scene, dataset)


def _held_out_rays(scene: Scene, dataset: Dataset) -> ValidationRays:
    pictures, rng = dataset.pictures, np.random.default_rng(2)
    held_out = np.flatnonzero(pictures.is_test)
    if not len(held_out):
        raise KpcError(f"{dataset.path}: holds out no view to measure on; omit --dataset")
    picture = rng.choice(held_out, VIEW_PIXELS)
    pixel = (rng.random(VIEW_PIXELS) * pictures.width[picture] * pictures.height[picture]).astype(np.int64)
    usable = dataset.is_usable(picture, pixel)
    picture, pixel = picture[usable], pixel[usable]
    row, column = np.divmod(pixel, pictures.width[picture])
    origins, directions = pixel_rays(pictures, picture, column, row, scene.mapping)
    colours = dataset.pixels.read(pictures.offset[picture] + pixel).astype(np.float32) / np.float32(255)
    truth = colours[:, :3]
    if dataset.has_alpha:
        truth = truth * colours[:, 3:] + scene.background * (1 - colours[:, 3:])
    return ValidationRays(origins, directions, pictures.time[picture].astype(np.float32), None, truth)


# --- what is shown


def headline(points: Sequence[Point]) -> Point:
    """Return the point nearest to DEFAULT_LOSS_DB, with the interpolated size at that loss; nothing without points."""
    if not points:
        return {}
    nearest = min(points, key=lambda point: abs(math.log(max(point["loss_db"], 1e-4) / DEFAULT_LOSS_DB)))
    return {**nearest, "size_at_default_loss": size_at(points, DEFAULT_LOSS_DB)}


CSV_COLUMNS = (
    "name",
    "coder",
    "setting",
    "size_bytes",
    "bits_per_parameter",
    "psnr",
    "loss_db",
    "agreement_db",
    "encode_s",
    "decode_s",
)


def as_csv(records: Sequence[dict[str, Any]]) -> str:
    """Return all points of `kpbench codec` records as CSV, a line each."""
    text = io.StringIO()
    writer = csv.DictWriter(text, CSV_COLUMNS, extrasaction="ignore", lineterminator="\n")
    writer.writeheader()
    writer.writerows(
        {"name": record["name"], "coder": record["coder"]} | point for record in records for point in record["points"]
    )
    return text.getvalue()
