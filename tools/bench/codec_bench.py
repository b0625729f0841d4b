"""Rate against distortion of scenes, beside what a user has at hand (`kpc.tools.bench.baselines`): what `kpbench codec` measures.

Every coder gets the same planes, those of the checkpoint or, of a .kpc file, its own dequantised ones, and is judged by the same
pixels. A rival is given for nothing what our file spends bytes on besides planes: decoder, occupancy and cameras are counted as our
file stores them, header and index not at all. One is tuned as ours is, too. What codes the planes alone is compared as well, of our
files all but those other chunks.
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
from functools import lru_cache
from pathlib import Path
from typing import Any

import numpy as np
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
from kpc.format.container import scene_io
from kpc.format.scene.scene import Scene
from kpc.tools.bench import baselines
from kpc.tools.bench.baselines import Coding, Rival
from kpc.tools.bench.provenance import machine
from kpc.tools.bench.rd_curves import Point, bd_rate, size_at
from kpc.tools.dev.processes import end_with_parent

RATES = (0.05, 0.1, 0.2, 0.35, 0.5, 0.75, 1.0, 1.5, 2.0)
"""Bits per parameter that our coder is asked for, of the file and all that is in it."""
QUALITIES = (40, 55, 70, 85, 100)
"""And qualities, `kpc.encoder.rdo.rate_control.Trade`, on the probe that the scene comes with."""
VIEW_PIXELS = 1 << 15
"""Random pixels of all held-out views that codings are judged by."""
TUNE_STEPS = TrainConfig().tune_steps
RIVALS = {rival.name: rival for rival in baselines.RIVALS}
OURS = "kpc"
GRIDS_AS_THEY_ARE = "kpc, grids as they are"
WITHOUT: dict[str, QuantiseFunction | None] = {
    "kpc without tuning": None,
    GRIDS_AS_THEY_ARE: None,
    "kpc, channels apart": quantise_by_cost,
    "kpc, never in blocks": lambda scene, steps, reached, significant: quantise_by_cost(
        scene, steps, reached, significant, blocks=False
    ),
    "kpc, never around predictions": lambda scene, steps, reached, significant: quantise_by_cost(
        scene, steps, reached, significant, thin=0.0, blocks=False
    ),
    "kpc without the trellis": lambda scene, steps, reached, significant: quantise_scene(scene, steps, reached=reached),
    "kpc, every texel alike": lambda scene, steps, reached, significant: quantise_by_cost(scene, steps, reached),
}
"""Our own coder with something left out: tuning; without it, the search for grids that take few bits, or what channels know of each other's errors;
and without tuning and that, one thing more. At QUALITIES."""
TUNED = {"AV1, tuned": "AV1"}
"""Rivals that get the tuning of our own coder, `kpc.encoder.rdo.sequential_finetune`, through what comes back from their own coding."""


@dataclass(frozen=True)
class Job:
    """A coder and a setting for one scene. `coder`: OURS, one of WITHOUT, for both of which `trade` is, or the name of one of RIVALS
    or of TUNED."""

    scene: Path
    coder: str
    setting: int | str
    trade: Trade = Trade()

    @property
    def key(self) -> str:
        """Which it is of those of its scene."""
        return f"{self.coder}: {self.setting}"


@dataclass(frozen=True)
class PointLog:
    """A file that points are noted in as they are found, a line each, so that a bench that was interrupted goes on.

    Attributes:
        stamp: what all of them depend on, the first line. Points under another are forgotten.
    """

    path: Path
    stamp: dict[str, Any]

    def read(self) -> dict[str, Point | None]:
        """By `Job.key`. A line that was cut off is left out."""
        found: list[Any] = []
        with contextlib.suppress(OSError, ValueError), self.path.open() as scene_io:
            found.extend(map(json.loads, scene_io))
        return dict(found[1:]) if found and found[0] == self.stamp else {}

    def begin(self) -> dict[str, Point | None]:
        """Write the file anew, with what `read` finds, and return that."""
        points = self.read()
        self.path.write_text("".join(json.dumps(line) + "\n" for line in (self.stamp, *points.items())))
        return points

    def add(self, key: str, point: Point | None) -> None:
        with self.path.open("a") as scene_io:
            scene_io.write(json.dumps([key, point]) + "\n")


def measure(
    scene: Path, dataset: Path | None, processes: int, ablate: bool, log: PointLog | None = None
) -> list[dict[str, Any]]:
    """The coders, ours first, then, to `ablate`, WITHOUT: each its name, its points (or why it has none) and by how much ours is smaller.
    What `log` holds is not measured again.

    Raises:
        KpcError: the scene or the dataset cannot be used, or a coder failed.
    """
    source = codec_model.load(scene)
    views = None if dataset is None else held_out_views(source.scene, dataset)
    count = source.scene.parameter_count
    rates = {f"{rate:g} bits": Trade(target_bytes=int(rate * count / 8)) for rate in RATES}
    qualities = {f"quality {q:g}": Trade(quality=q) for q in QUALITIES}
    ours = [OURS, *(WITHOUT if ablate else ())]
    jobs = [
        Job(scene, name, said, trade)
        for name in ours
        for said, trade in ((rates if name == OURS else {}) | qualities).items()
    ]
    others_at_hand = RIVALS | {name: RIVALS[rival] for name, rival in TUNED.items() if rival in RIVALS}
    missing = {name: why for name, rival in others_at_hand.items() if (why := rival.missing())}
    jobs += [Job(scene, name, setting) for name, rival in others_at_hand.items() if name not in missing
             for setting in reversed(rival.settings)]  # fmt: skip
    points = {} if log is None else log.begin()
    left = [job for job in jobs if job.key not in points]
    for job, found_point in zip(left, in_parallel(left, views, processes), strict=True):
        points[job.key] = found_point
        if log is not None:
            log.add(job.key, found_point)
    coders = []
    for name in (*ours, *others_at_hand):
        found = [one for job in jobs if job.coder == name and (one := points[job.key]) is not None]
        coders.append({"coder": name, "missing": missing.get(name), "points": found})
    for coder in coders:
        for key, size in (("bd_rate", "size_bytes"), ("bd_rate_planes", "planes_bytes")):
            coder[key] = None if coder is coders[0] else bd_rate(coders[0]["points"], coder["points"], size)
    return coders


def in_parallel(jobs: Sequence[Job], views: ValidationRays | None, processes: int) -> Iterator[Point | None]:
    """Points of all jobs, in their order, judged by `views`, or by the probe the scene comes with, in processes of their own, none with more
    than its share of the cores."""
    before = os.environ.get("NUMBA_NUM_THREADS")
    os.environ["NUMBA_NUM_THREADS"] = str(max(1, int(machine()["cores"]) // processes))
    try:
        with ProcessPoolExecutor(processes, multiprocessing.get_context("spawn"), _judge_by, (views,)) as pool:
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
    """What a coder makes of a scene at one setting; None where it cannot make so little."""
    source, uncoded, measured = _source(job.scene)
    if job.coder in RIVALS:
        coding = RIVALS[job.coder].code(_tidied(job.scene), int(job.setting))
        judged = measured(replace(source.scene, scales=tuple(coding.planes)))
        return _point(
            job,
            source,
            coding.size_bytes,
            others_bytes(job.scene),
            (coding.encode_s, coding.decode_s),
            uncoded.psnr,
            judged,
        )
    started = time.perf_counter()
    if job.coder in TUNED:
        scene, codings = tuned_through(RIVALS[TUNED[job.coder]], int(job.setting), source.scene)
        searched = time.perf_counter()
        size = sum(coding.size_bytes for coding in codings)
        took = sum(coding.encode_s for coding in codings), sum(coding.decode_s for coding in codings)
        found = _point(job, source, size, others_bytes(job.scene), took, uncoded.psnr, measured(scene))
        return found | {"search_s": searched - started}
    try:
        tune_steps = TUNE_STEPS if job.coder == OURS else 0
        coded = codec_model.code(
            source,
            job.trade,
            TrainConfig().prune_share,
            tune_steps,
            WITHOUT.get(job.coder),
            grids=job.coder != GRIDS_AS_THEY_ARE,
        )
    except TrainingError:
        return None
    searched = time.perf_counter()
    data = scene_io.encode(coded.scene)
    encoded = time.perf_counter()
    scene = scene_io.read(data).dequantise()
    took = encoded - searched, time.perf_counter() - encoded
    stored = stored_bytes(data)
    others = _of_others(stored)
    found = _point(job, source, len(data) - others, others, took, uncoded.psnr, measured(scene))
    return found | {
        "search_s": searched - started,
        "shares": {kind: count / len(data) for kind, count in stored.items()},
    }


def tuned_through(rival: Rival, setting: int, scene: Scene) -> tuple[Scene, list[Coding]]:
    """A scene as it comes back from a rival that codes its planes group by group, while those still to be coded, and the decoder, learn to
    make up for its errors, as with our own coder; and what the groups take."""
    codings: list[Coding] = []

    def coded(candidate: Scene, group: Sequence[PlaneKey]) -> dict[PlaneKey, np.ndarray]:
        planes = baselines.tidied(candidate)
        scales = sorted({s for s, _ in group})
        codings.append(
            rival.code(
                [{name: plane for name, plane in planes[s].items() if (s, name) in group} for s in scales], setting
            )
        )
        return {
            (s, name): plane for s, back in zip(scales, codings[-1].planes, strict=True) for name, plane in back.items()
        }

    back = code_sequentially(scene, scene, coded, TUNE_STEPS)
    return replace(back, decoder=round_decoder(back.decoder)), codings


def _point(
    job: Job,
    source: Model,
    planes_size: int,
    others_size: int,
    took: tuple[float, float],
    uncoded_psnr: float,
    judged: Fidelity,
) -> Point:
    size = planes_size + others_size
    return {
        "setting": job.setting, "size_bytes": size, "planes_bytes": planes_size, "bits_per_parameter": 8 * size / source.scene.parameter_count,
        "psnr": judged.psnr, "loss_db": uncoded_psnr - judged.psnr, "agreement_db": judged.agreement_db,
        "encode_s": took[0], "decode_s": took[1],
    }  # fmt: skip


_views: ValidationRays | None = None
"""What this process judges by; None for the probe a scene comes with."""


def _judge_by(views: ValidationRays | None) -> None:
    global _views
    _views = views
    if multiprocessing.parent_process() is not None:
        end_with_parent()


@lru_cache(1)
def _source(path: Path) -> tuple[Model, Fidelity, Measure]:
    source = codec_model.load(path)
    measured = (_views or source.probe).measure(source.scene)
    return source, measured(source.scene), measured


@lru_cache(1)
def _tidied(path: Path) -> Any:
    return baselines.tidied(_source(path)[0].scene)


@lru_cache(1)
def others_bytes(path: Path) -> int:
    """Stored bytes of all chunks but planes, in our file of the scene."""
    source, _, _ = _source(path)  # whose curvature is known then, or found once
    return _of_others(stored_bytes(scene_io.encode(source.coded or codec_model.code(source, Trade(), 0.0, 0).scene)))


def _of_others(stored: Mapping[str, int]) -> int:
    """Of `stored_bytes`, those of all chunks but planes, for which header and index count."""
    return sum(count for kind, count in stored.items() if kind not in ("PLNE", "index"))


def stored_bytes(data: bytes) -> dict[str, int]:
    """Of a file: the bytes of each kind of chunk, and of header and index."""
    stored: dict[str, int] = {}
    for entry in scene_io.SceneReader(data).index:
        stored[entry.kind] = stored.get(entry.kind, 0) + entry.stored_length
    return stored | {"index": len(data) - sum(stored.values())}


def held_out_views(scene: Scene, folder: Path) -> ValidationRays:
    """Random pixels of all pictures of a dataset that are held out.

    Raises:
        KpcError: the dataset cannot be used, or holds nothing out.
    """
    with tempfile.TemporaryDirectory(prefix="kpbench-") as work:
        dataset = load_dataset(folder, Path(work))
        return _drawn(scene, dataset)


def _drawn(scene: Scene, dataset: Dataset) -> ValidationRays:
    pictures, rng = dataset.pictures, np.random.default_rng(2)
    held_out = np.flatnonzero(pictures.is_test)
    if not len(held_out):
        raise KpcError(f"{dataset.path}: holds no view out to judge by; leave --dataset away")
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
    """What a table shows of a coder: its bytes at DEFAULT_LOSS_DB, else nothing of it, and the point nearest to that loss."""
    if not points:
        return {}
    near = min(points, key=lambda point: abs(math.log(max(point["loss_db"], 1e-4) / DEFAULT_LOSS_DB)))
    return {**near, "size_at_default_loss": size_at(points, DEFAULT_LOSS_DB)}


CSV_COLUMNS = ("name", "coder", "setting", "size_bytes", "bits_per_parameter", "psnr", "loss_db", "agreement_db", "encode_s",
               "decode_s")  # fmt: skip


def as_csv(records: Sequence[dict[str, Any]]) -> str:
    """All points of `kpbench codec` records, a line each."""
    text = io.StringIO()
    writer = csv.DictWriter(text, CSV_COLUMNS, extrasaction="ignore", lineterminator="\n")
    writer.writeheader()
    writer.writerows(
        {"name": record["name"], "coder": record["coder"]} | point for record in records for point in record["points"]
    )
    return text.getvalue()
