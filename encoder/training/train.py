"""The training loop: draw rays, render them, step the planes, keep the occupancy grid current."""

import hashlib
import math
import sys
import time
from collections.abc import Callable
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
import torch

from kpc.encoder.datasets import Dataset
from kpc.encoder.field.appearances import assign_appearances
from kpc.encoder.field.bounds import visible_cells
from kpc.encoder.field.config import TrainConfig
from kpc.encoder.field.field import Field, HybridField, SummedField
from kpc.encoder.field.fused import log_densities
from kpc.encoder.field.layout import motion_grid_shape, plan_layout
from kpc.encoder.field.occupancy_grid import OccupancyGrid, grid_shape
from kpc.encoder.field.priors import appearance_priors, motion_priors, plane_priors
from kpc.encoder.field.proposals import Proposals
from kpc.encoder.training.checkpoint import save_state
from kpc.encoder.training.continuation import describe_length, name_changes
from kpc.encoder.training.fused_optimiser import FusedOptimiser
from kpc.encoder.training.importance import TileWeights, has_static_cameras
from kpc.encoder.training.moving_area import MovingArea
from kpc.encoder.training.refinement import Refinement
from kpc.encoder.training.sampler import RaySampler
from kpc.encoder.training.torch_optimiser import TorchOptimiser
from kpc.format.common.compiling import MONITOR
from kpc.format.common.errors import TrainingError
from kpc.format.common.fidelity import psnr_from_mse
from kpc.format.common.progress import progress
from kpc.format.scene.scene import Scene
from kpc.format.scene.space import Contraction, DeviceCoordinates, SpaceMapping

# Steps by which held-out cameras are aligned with the finished scene, at most and as a share of those of the run, and
# rays of each step for each of them.
ALIGN_STEPS, ALIGN_SHARE, ALIGN_RAYS = 100, 0.1, 512
# Seconds between reports of progress, at least.
REPORT_S = 0.5


@dataclass(frozen=True)
class Report:
    """The state of training after a step.

    Attributes:
        step: steps done. fraction: of the run, in [0, 1]. elapsed_s: seconds of training.
        psnr: of the rays since the last report, dB.
        rays_per_second, samples_per_ray: recent means.
        occupied: share of the cells that are occupied.
    """

    step: int
    fraction: float
    psnr: float
    rays_per_second: float
    samples_per_ray: float
    occupied: float
    elapsed_s: float


class Trainer:
    """A training run: a dataset, a field, and the state of optimiser and occupancy grid.

    Attributes:
        field: being trained.
        grid: the occupancy grid.
        step: steps done.
        elapsed_s: seconds of training, including those spent before on finding the box, but not on compiling kernels.
        timers: seconds by part of a step.
        names: of the appearances.
        cameras: as corrected; None where they are not refined.
        slots: time slots of the occupancy grid.
        extent: longest edge of the box. step_length: of rays, in s.
    """

    def __init__(
        self,
        dataset: Dataset,
        config: TrainConfig,
        aabb: np.ndarray,
        device: str,
        elapsed_s: float = 0.0,
        mapping: SpaceMapping | None = None,
        moving: MovingArea | None = None,
    ) -> None:
        self.dataset, self.config, self.device, self.mapping = dataset, config, torch.device(device), mapping
        self.aabb = np.asarray(aabb, np.float32)
        self.extent = float(np.max(self.aabb[1] - self.aabb[0]))
        # The box is half of contracted space.
        steps_across = config.samples_across / (2 if isinstance(mapping, Contraction) else 1)
        self.step_length = self.extent / steps_across
        self.rng = np.random.default_rng(config.seed)
        layout = plan_layout(config, self.aabb, dataset.clip, dataset.is_dynamic)
        nodes = motion_grid_shape(config, self.aabb, layout)
        appearances, self.names = assign_appearances(dataset, config.appearance)
        kind, hidden = (SummedField if config.summed else Field), config.hidden
        if config.hybrid:
            kind, hidden = HybridField, config.hybrid_width
        generator = torch.Generator().manual_seed(config.seed)
        self.field = kind(layout, hidden, generator, nodes, len(self.names)).to(self.device)
        if not config.view_dependent:
            torch.nn.init.zeros_(self.field.w1)
        shape = grid_shape(self.aabb, config.cells_across)
        threshold = math.log(-math.log(1 - config.occupancy_alpha) * steps_across)
        self.grid = OccupancyGrid(visible_cells(dataset.pictures, self.aabb, shape, mapping), threshold)
        if moving is not None:
            self.grid.kept = moving.cells(shape) & self.grid.visible
        self.slots = min(config.occupancy_slots, dataset.clip.frame_count) if dataset.is_dynamic else 1
        on_cpu = self.device.type == "cpu"
        proposals = (
            Proposals(config, self.aabb, dataset.clip, dataset.is_dynamic).to(self.device) if config.proposals else None
        )
        self.optimiser: FusedOptimiser | TorchOptimiser = (
            FusedOptimiser(self.field, config, shape, mapping)
            if on_cpu and proposals is None and not (config.hybrid or config.summed)
            else TorchOptimiser(self.field, config, shape, mapping, fused=on_cpu, proposals=proposals)
        )
        self.timers = self.optimiser.timers
        self.step = 0
        self.elapsed_s = elapsed_s
        self.samples_per_ray = float(config.samples_across)
        self.cameras: Refinement | None = None
        if config.refine != "none":
            centre = self.aabb.mean(0, dtype=np.float64)
            centre = mapping.to_world(centre) if isinstance(mapping, DeviceCoordinates) else centre
            self.cameras = Refinement(dataset, config, centre, mapping)
        self.sampler = RaySampler(dataset, mapping, appearances if self.names else None, self.cameras)
        # Objects with alpha are shown on white; elsewhere an unknown background is grey, the guess of least error.
        self.background = np.full(3, 1.0 if dataset.has_alpha else 0.5, np.float32)
        self._weights: TileWeights | None = None
        self._has_weights = has_static_cameras(dataset)
        self._steady_rays, self._steady_s = 0, 0.0
        self._time_budget_s: float | None = None

    def run(
        self,
        report: Callable[[Report], None],
        checkpoint: Path | None = None,
        *,
        time_budget_s: float | None = None,
        most_steps: int | None = None,
        checkpoint_every_s: float = 60.0,
        interrupted: Callable[[], bool] = lambda: False,
    ) -> None:
        """Train until `config.steps`, or for `time_budget_s` seconds and at most `most_steps` steps.

        A checkpoint that cannot be written on the way is reported on stderr and does not stop training.

        Args:
            report: called once in REPORT_S seconds at most.
            checkpoint: file to write every `checkpoint_every_s` seconds and at the end.
            interrupted: called between steps.

        Raises:
            TrainingError: the loss is not finite.
            KeyboardInterrupt: `interrupted()` returned True.
        """
        config, self._time_budget_s = self.config, time_budget_s
        saved, error, drawn, since = time.monotonic(), 0.0, 0, time.monotonic()
        while (fraction := self._fraction(time_budget_s, most_steps)) < 1:
            if interrupted():
                raise KeyboardInterrupt
            started, compiling_s = time.monotonic(), MONITOR.spent_s
            squared_error, count = self._step(fraction)
            error, drawn = error + squared_error * count, drawn + count
            now = time.monotonic()
            self.elapsed_s += now - started - (MONITOR.spent_s - compiling_s)
            if self.step > 2 * config.occupancy_start:
                self._steady_rays, self._steady_s = self._steady_rays + count, self._steady_s + now - started
            if now - since > REPORT_S:
                psnr = psnr_from_mse(error / drawn)
                report(
                    Report(
                        self.step,
                        self._fraction(time_budget_s, most_steps),
                        psnr,
                        drawn / (now - since),
                        self.samples_per_ray,
                        float(self.grid.occupied.mean()),
                        self.elapsed_s,
                    )
                )
                error, drawn, since = 0.0, 0, now
            if checkpoint is not None and now - saved > checkpoint_every_s:
                self._try_to_save(checkpoint)
                saved = since = time.monotonic()
        if checkpoint is not None:
            self._try_to_save(checkpoint)

    def _step(self, fraction: float) -> tuple[float, int]:
        """Do one step at a fraction of the run; return its mean squared error and its number of rays."""
        config = self.config
        with self.timers("occupancy"):
            self._update_grid(fraction)
        count = self.rays_per_step
        background = None if self.dataset.has_alpha else self.background
        with self.timers("rays"):
            weights = self._weights_at(fraction)
            pixels = self.sampler.draw_pixels(self.rng, count, config.object_rays, weights)
            batch, targets = self.sampler.rays(self.rng, pixels, background)
        rate = min(1.0, (self.step + 1) / config.warmup) * (0.01 + 0.99 * 0.5 * (1 + math.cos(math.pi * fraction)))
        squared_error, samples = self.optimiser.step(
            self.step,
            fraction,
            rate,
            batch,
            targets,
            self.aabb,
            self.grid.marched,
            self.step_length * (config.warmup_stride if self.step < config.occupancy_start else 1),
            self.extent,
        )
        self.field.restore_fixed()
        if not math.isfinite(squared_error):
            raise TrainingError(f"step {self.step}: {self._not_finite()}; try another --seed or --preset")
        if self.cameras is not None and fraction >= config.refine_from:
            with self.timers("cameras"):
                self.cameras.step(pixels, targets.numpy(), self.optimiser.ray_gradients, _refinement_rate(fraction))
        self.samples_per_ray += 0.1 * (samples - self.samples_per_ray)
        self.step += 1
        return squared_error, count

    def refined_dataset(self) -> Dataset:
        """Return the dataset, its cameras as corrected."""
        return self.dataset if self.cameras is None else self.cameras.refined()

    def align_held_out(self) -> None:
        """Align the refined poses of held-out cameras with the finished scene, which does not change.

        The cameras that are trained on have moved, each for itself, so that a held-out camera no longer stands where
        the scene agrees with it. BARF (arXiv:2104.06405) and others evaluate thus, too.
        """
        cameras = self.cameras
        held_out = np.flatnonzero(cameras.is_held_out[cameras.unit]) if cameras is not None else np.zeros(0, int)
        if cameras is None or not len(held_out):
            return
        sampler = RaySampler(self.dataset, self.mapping, None, cameras, held_out)
        rng, steps = np.random.default_rng(self.config.seed), int(min(ALIGN_STEPS, ALIGN_SHARE * self.step))
        count = min(self.rays_per_step, ALIGN_RAYS * int(cameras.is_held_out.sum()))
        self.optimiser.config = replace(self.config, distortion=0.0)  # the field no longer adapts to it
        for number in progress(range(steps), "aligning held-out cameras", unit="steps"):
            pixels = sampler.draw_pixels(rng, count)
            batch, targets = sampler.rays(rng, pixels, None if self.dataset.has_alpha else self.background)
            # At a learning rate of 0 a step only finds gradients.
            volume = self.aabb, self.grid.active, self.step_length, self.extent
            self.optimiser.step(self.step, 1.0, 0.0, batch, targets, *volume)
            rate = _refinement_rate(number / steps)
            cameras.align(pixels, self.optimiser.ray_gradients, rate)
        self.optimiser.config = self.config

    def _update_grid(self, fraction: float) -> None:
        """Update the occupancy grid where it is due at this step."""
        config = self.config
        if self.step >= config.occupancy_start and self.step % config.occupancy_every == 0:
            if fraction >= config.moving_kept:
                self.grid.kept = None
            self.grid.update(self.density_at, self.optimiser.peaks(), self.rng)
        if self.slots > 1 and self.step >= 4 * config.occupancy_start and self.step % config.occupancy_split_every == 0:
            self.grid.split(self.density_at, self.slots, self.rng)

    def run_until(self, step: int, watch: Callable[[], None] = lambda: None) -> None:
        """Train as `run` does, without reports, until a step of the run is reached; `watch` is called before each step.

        Raises:
            As `run`.
        """

        def is_reached() -> bool:
            watch()
            return self.step >= step

        try:
            self.run(lambda report: None, interrupted=is_reached)
        except KeyboardInterrupt:
            if self.step < step:  # interrupted by the user
                raise

    @property
    def rays_per_step(self) -> int:
        """Rays in the next step: as many as keep the number of samples within `config.samples`."""
        return int(np.clip(self.config.samples / max(self.samples_per_ray, 1e-3), 256, self.config.rays))

    @property
    def rays_per_second(self) -> float:
        """Mean rays per second of training since the occupancy grid has formed."""
        return self._steady_rays / self._steady_s if self._steady_s else 0.0

    def scene(self, occupancy: np.ndarray | None = None) -> Scene:
        """Return the field as a scene; planes are copied. `occupancy`: (slots, Nz, Ny, Nx), or that of training."""
        if occupancy is None:
            occupancy = self.grid.active
        return self.field.to_scene(
            self.aabb, self.dataset.clip, occupancy, self.background, self.step_length, self.mapping, self.names
        )

    def _weights_at(self, fraction: float) -> TileWeights | None:
        """Return the weights by which rays are drawn at a fraction of the run; None for uniform drawing."""
        if fraction < self.config.temporal_start or not self._has_weights:
            return None
        if self._weights is None:
            self._weights = TileWeights(self.dataset, self.config.temporal_floor)
        return self._weights

    def _fraction(self, time_budget_s: float | None, most_steps: int | None) -> float:
        """Return the fraction of the run that is done."""
        if time_budget_s is None:
            return self.step / self.config.steps
        return max(self.elapsed_s / time_budget_s, self.step / most_steps if most_steps else 0.0)

    def _not_finite(self) -> str:
        """Return a message that names the terms of the loss and the parameters that are not finite."""
        field, config = self.field, self.config
        weighted = (
            plane_priors(field, config, config.variation(0.0))
            | motion_priors(field, config)
            | appearance_priors(field, config)
        )
        terms = ["colour"] + [name for name, value in weighted.items() if not torch.isfinite(value)]
        planes = [
            f"{name} at scale {s}"
            for s, name, *_ in self.field.layout.planes()
            if not torch.isfinite(self.field.plane(s, name)).all()
        ]
        decoder = [
            name for name, value in self.field.named_parameters() if name != "theta" and not torch.isfinite(value).all()
        ]
        found = ", ".join((planes + decoder)[:6])
        return f"the loss is not finite ({', '.join(terms)})" + (f", nor are all values of {found}" if found else "")

    def density_at(self, points: np.ndarray, times: np.ndarray) -> np.ndarray:
        """Return log densities (N,) at points (N, 3) in [0, 1]^3 and times (N,)."""
        if isinstance(self.optimiser, FusedOptimiser):
            return log_densities(self.field, points, times)
        out = []
        with torch.no_grad():
            parts = len(points) // 2**18 + 1
            for p, t in zip(np.array_split(points, parts), np.array_split(times, parts), strict=True):
                features = self.optimiser.features(*(torch.from_numpy(np.float32(a)).to(self.device) for a in (p, t)))
                out.append(self.field.decode(features)[0].cpu().numpy())
        return np.concatenate(out)

    def save(self, path: Path) -> None:
        """Write all that `resume` needs, as plain tensors and numbers that are read without unpickling code.

        Raises:
            TrainingError: the file cannot be written; an earlier checkpoint is left unchanged.
        """
        state = self._settings() | {
            "step": self.step,
            "time_budget_s": self._time_budget_s,
            "elapsed_s": self.elapsed_s,
            "samples_per_ray": self.samples_per_ray,
            "field": self.field.state_dict(),
            "optimiser": self.optimiser.state(),
            "grid": self.grid.state(),
            "rng": _rng_to_plain(self.rng),
            "dataset": _fingerprint(self.dataset),
            "cameras": self.cameras and self.cameras.state(),
        }
        save_state(path, state, "give another folder with --work")

    def _settings(self) -> dict[str, Any]:
        return {
            "config": asdict(self.config),
            "aabb": torch.from_numpy(self.aabb),
            "mapping": repr(self.mapping),
        }

    def _try_to_save(self, path: Path) -> None:
        try:
            self.save(path)
        except TrainingError as error:
            print(f"{error}; training goes on", file=sys.stderr, flush=True)

    def resume(self, path: Path, time_budget_s: float | None = None) -> str:
        """Continue from a checkpoint of the same dataset and configuration, to bitwise the same result.

        The length of the run may be another one, whose schedule then holds for the steps that are left.

        Args:
            path: of the checkpoint.
            time_budget_s: for how long this run is to train, seconds; None for `config.steps`.

        Returns:
            How the length differs, in words; empty where it does not.

        Raises:
            TrainingError: the checkpoint cannot be read, belongs to another run, or leaves nothing to train of another
                length.
        """
        try:
            state = _load(path, self.device)
            if changed := name_changes(state, self._settings()):
                raise TrainingError(
                    f"{path}: belongs to a run with other settings ({changed}); give the same ones or drop --resume"
                )
            if state["dataset"] != _fingerprint(self.dataset):
                raise TrainingError(
                    f"{path}: belongs to a run on other pictures; give the same dataset, --holdout and "
                    "--downscale, or drop --resume"
                )
            self.field.load_state_dict(state["field"])
            self.optimiser.load(state["optimiser"])
            self.grid.load(state["grid"])
            if self.cameras is not None:
                self.cameras.load(state["cameras"])
            self.rng.bit_generator.state = _rng_from_plain(state["rng"])
            self.step, self.elapsed_s = state["step"], state["elapsed_s"]
            self.samples_per_ray = state["samples_per_ray"]
            before = describe_length(state["config"]["steps"], state.get("time_budget_s"))
            now = describe_length(self.config.steps, time_budget_s)
            changed = "" if before == now else f"{before} before, {now} now"
            if changed and self._fraction(time_budget_s, None) >= 1:
                raise TrainingError(
                    f"{path}: has {self.step} steps of {self.elapsed_s:.0f} s already ({changed}), so that nothing is "
                    "left to train; give more, or drop --resume"
                )
            return changed
        except TrainingError:
            raise
        except Exception as error:  # a damaged file may raise anything
            raise _unusable(path, error) from error


def _refinement_rate(fraction: float) -> float:
    """Return the share of the peak learning rates of cameras at a fraction of the run."""
    return 0.5 * (1 + math.cos(math.pi * fraction))


def load_checkpoint_box(path: Path) -> np.ndarray:
    """Return the (2, 3) box of the run that wrote a checkpoint.

    Raises:
        TrainingError: the checkpoint cannot be read.
    """
    try:
        aabb = _load(path, torch.device("cpu"))["aabb"].numpy()
        if aabb.shape != (2, 3) or not np.isfinite(aabb).all() or not (aabb[0] < aabb[1]).all():
            raise ValueError("aabb")
    except Exception as error:
        raise _unusable(path, error) from error
    return aabb


def _load(path: Path, device: torch.device) -> dict[str, Any]:
    state: dict[str, Any] = torch.load(path, map_location=device, weights_only=True)
    return state


def _unusable(path: Path, error: Exception) -> TrainingError:
    return TrainingError(f"{path}: not a usable checkpoint ({type(error).__name__}); delete it to start afresh")


def _fingerprint(dataset: Dataset) -> str:
    """Return a hash of all that the rays of a run depend on, including checksums of pixels and masks."""
    digest = hashlib.sha256(repr([(tile.offset, tile.crc32c) for tile in dataset.pixels.tiles]).encode())
    p = dataset.pictures
    for array in (p.time, p.is_test, p.width, p.height, p.intrinsics, p.distortion, p.is_fisheye, p.camera_to_world):
        digest.update(np.ascontiguousarray(array).tobytes())
    if dataset.masks is not None:
        digest.update(repr(dataset.masks.crc32c).encode())
    return digest.hexdigest()


def _rng_to_plain(rng: np.random.Generator) -> dict[str, str]:
    state = rng.bit_generator.state
    return {
        "state": hex(state["state"]["state"]),
        "inc": hex(state["state"]["inc"]),
        "has_uint32": str(state["has_uint32"]),
        "uinteger": str(state["uinteger"]),
    }


def _rng_from_plain(plain: dict[str, str]) -> dict[str, Any]:
    return {
        "bit_generator": "PCG64",
        "state": {"state": int(plain["state"], 16), "inc": int(plain["inc"], 16)},
        "has_uint32": int(plain["has_uint32"]),
        "uinteger": int(plain["uinteger"]),
    }
