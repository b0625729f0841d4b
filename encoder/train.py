"""The training loop: draw rays, render them, step the planes, keep the occupancy grid current."""

import contextlib
import hashlib
import math
import sys
import time
from collections import deque
from collections.abc import Callable, Iterator, Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

import numba
import numpy as np
import torch

from kpc.encoder import kernels
from kpc.encoder.appearances import number_pictures
from kpc.encoder.config import TrainConfig
from kpc.encoder.box import seen_cells
from kpc.encoder.datasets import Dataset, rays
from kpc.encoder.field import Field, HybridField, SummedField, appearance_priors, motion_nodes, motion_priors, plan_layout, priors
from kpc.encoder.importance import TileWeights, cameras_stand_still
from kpc.encoder.occupancy import OccupancyGrid, grid_shape
from kpc.encoder.proposals import Level, Proposals, histogram_loss
from kpc.encoder.render import Rays, Samples, collected, fused_features, meet, samples_of, shade
from kpc.format.cli import written_aside
from kpc.format.errors import TrainingError
from kpc.format.scene import SPACE_PLANES, Scene
from kpc.format.space import Contraction, SpaceMapping

ROOM = 3
"""Samples that a step on a GPU has room for, in multiples of `TrainConfig.samples`, which they are on average."""

BETA1, BETA2, EPSILON = 0.9, 0.99, 1e-15
"""Adam's constants as Instant-NGP sets them for grids (arXiv:2201.05989, section 4)."""


@dataclass(frozen=True)
class Report:
    """How training stands after a step."""

    step: int
    fraction: float
    psnr: float
    rays_per_second: float
    samples_per_ray: float
    occupied: float
    elapsed_s: float


class Stopwatch:
    """Seconds of wall clock by what they went to: `with watch("name"): ...`."""

    def __init__(self) -> None:
        self.seconds: dict[str, float] = {}

    @contextlib.contextmanager
    def __call__(self, name: str) -> Iterator[None]:
        started = time.perf_counter()
        yield
        self.seconds[name] = self.seconds.get(name, 0.0) + time.perf_counter() - started


class Trainer:
    """One run: a dataset, a field, the optimiser's state. `run` trains to the end or until told to stop.

    `elapsed_s` counts the seconds of training, those spent before, on a survey, included.
    """

    def __init__(
        self, dataset: Dataset, config: TrainConfig, aabb: np.ndarray, device: str, elapsed_s: float = 0.0,
        mapping: SpaceMapping | None = None,
    ) -> None:
        self.dataset, self.config, self.device, self.mapping = dataset, config, torch.device(device), mapping
        self.aabb = np.asarray(aabb, np.float32)
        self.extent = float(np.max(self.aabb[1] - self.aabb[0]))
        steps_across = config.samples_across / (2 if isinstance(mapping, Contraction) else 1)  # a box is half of contracted space
        self.step_length = self.extent / steps_across
        self.rng = np.random.default_rng(config.seed)
        layout = plan_layout(config, self.aabb, dataset.clip, dataset.is_dynamic)
        nodes = motion_nodes(config, self.aabb, layout)
        appearances, self.names = number_pictures(dataset, config.appearance)
        kind, hidden = (SummedField if config.summed else Field), config.hidden
        if config.hybrid:
            kind, hidden = HybridField, config.hybrid_width
        generator = torch.Generator().manual_seed(config.seed)
        self.field = kind(layout, hidden, generator, nodes, len(self.names)).to(self.device)
        if not config.view_dependent:
            torch.nn.init.zeros_(self.field.w1)
        shape = grid_shape(self.aabb, config.cells_across)
        threshold = math.log(-math.log(1 - config.occupancy_alpha) * steps_across)
        self.grid = OccupancyGrid(seen_cells(dataset.pictures, self.aabb, shape, mapping), threshold)
        self.slots = min(config.occupancy_slots, dataset.clip.frame_count) if dataset.is_dynamic else 1
        on_cpu = self.device.type == "cpu"
        proposals = Proposals(config, self.aabb, dataset.clip, dataset.is_dynamic).to(self.device) if config.proposals else None
        self.optimiser: FusedOptimiser | PlainOptimiser = (
            FusedOptimiser(self.field, config, shape, mapping)
            if on_cpu and proposals is None and not (config.hybrid or config.summed) else
            PlainOptimiser(self.field, config, shape, mapping, fused=on_cpu, proposals=proposals)
        )
        self.watch = self.optimiser.watch
        self.step = 0
        self.elapsed_s = elapsed_s
        self.samples_per_ray = float(config.samples_across)
        self.sampler = RaySampler(dataset, mapping, appearances if self.names else None)
        # Objects with alpha are shown on white. Elsewhere what the box leaves open is grey: the least wrong guess.
        self.background = np.full(3, 1.0 if dataset.has_alpha else 0.5, np.float32)
        self._weights: TileWeights | None = None
        self._can_weigh = cameras_stand_still(dataset)
        self._steady_rays, self._steady_s = 0, 0.0

    def run(
        self, report: Callable[[Report], None], checkpoint: Path | None = None, *,
        time_budget_s: float | None = None, checkpoint_every_s: float = 60.0,
        interrupted: Callable[[], bool] = lambda: False,
    ) -> None:
        """Train until `config.steps`, or for `time_budget_s` seconds of training where given.

        A checkpoint that cannot be written on the way is said on stderr and tried again: it is no reason to stop.

        Raises:
            TrainingError: the loss is not finite.
            KeyboardInterrupt: `interrupted()`, asked between steps, was true.
        """
        config = self.config
        saved, error, drawn, since = time.monotonic(), 0.0, 0, time.monotonic()
        while (fraction := self._fraction(time_budget_s)) < 1:
            if interrupted():
                raise KeyboardInterrupt
            started = time.monotonic()
            with self.watch("occupancy"):
                if self.step >= config.occupancy_start and self.step % config.occupancy_every == 0:
                    self.grid.update(self.density_at, self.optimiser.peaks(), self.rng)
                if self.slots > 1 and self.step >= 4 * config.occupancy_start and self.step % config.occupancy_split_every == 0:
                    self.grid.split(self.density_at, self.slots, self.rng)
            count = self.rays_a_step
            background = None if self.dataset.has_alpha else self.background
            with self.watch("rays"):
                weights = self._weights_at(fraction)
                batch, targets = self.sampler.draw(self.rng, count, background, config.object_rays, weights)
            rate = min(1.0, (self.step + 1) / config.warmup) * (0.01 + 0.99 * 0.5 * (1 + math.cos(math.pi * fraction)))
            squared_error, samples = self.optimiser.step(
                self.step, rate, batch, targets, self.aabb, self.grid.marched,
                self.step_length * (config.warmup_stride if self.step < config.occupancy_start else 1), self.extent,
            )
            if not math.isfinite(squared_error):
                raise TrainingError(f"step {self.step}: {self._not_finite()}; try another --seed or --preset")
            self.samples_per_ray += 0.1 * (samples - self.samples_per_ray)
            self.step += 1
            error, drawn = error + squared_error * count, drawn + count
            now = time.monotonic()
            self.elapsed_s += now - started
            if self.step > 2 * config.occupancy_start:
                self._steady_rays, self._steady_s = self._steady_rays + count, self._steady_s + now - started
            if now - since > 0.5:
                psnr = -10 * math.log10(max(error / drawn, 1e-10))
                report(Report(self.step, self._fraction(time_budget_s), psnr, drawn / (now - since),
                              self.samples_per_ray, float(self.grid.occupied.mean()), self.elapsed_s))
                error, drawn, since = 0.0, 0, now
            if checkpoint is not None and now - saved > checkpoint_every_s:
                self._try_to_save(checkpoint)
                saved = since = time.monotonic()
        if checkpoint is not None:
            self._try_to_save(checkpoint)

    def run_to(self, step: int, watch: Callable[[], None] = lambda: None) -> None:
        """Train as `run` does, without a report, but only to a step on the way; `watch` is called before each.

        Raises:
            As `run`.
        """

        def there() -> bool:
            watch()
            return self.step >= step

        try:
            self.run(lambda report: None, interrupted=there)
        except KeyboardInterrupt:
            if self.step < step:  # the user's
                raise

    @property
    def rays_a_step(self) -> int:
        """As many as keep a step's samples within bounds, now."""
        return int(np.clip(self.config.samples / max(self.samples_per_ray, 1e-3), 256, self.config.rays))

    @property
    def rays_per_second(self) -> float:
        """Rays trained in a second, all that a step takes included, once the occupancy grid has formed."""
        return self._steady_rays / self._steady_s if self._steady_s else 0.0

    def scene(self, occupancy: np.ndarray | None = None) -> Scene:
        """The field as it stands, with an occupancy (slots, Nz, Ny, Nx), or with that of training; the planes are copied."""
        if occupancy is None:
            occupancy = self.grid.marched
        return self.field.to_scene(
            self.aabb, self.dataset.clip, occupancy, self.background, self.step_length, self.mapping, self.names)

    def _weights_at(self, fraction: float) -> TileWeights | None:
        """What decides which rays are drawn at this share of the run; it follows from the dataset, so no checkpoint holds it."""
        if fraction < self.config.temporal_start or not self._can_weigh:
            return None
        if self._weights is None:
            self._weights = TileWeights(self.dataset, self.config.temporal_floor)
        return self._weights

    def _fraction(self, time_budget_s: float | None) -> float:
        if time_budget_s is not None:
            return self.elapsed_s / time_budget_s
        return self.step / self.config.steps

    def _not_finite(self) -> str:
        """Which terms of the loss hold NaN or infinity, the colours being one of them, and which parameters they come from."""
        field, config = self.field, self.config
        weighed = priors(field, config) | motion_priors(field, config) | appearance_priors(field, config)
        terms = ["colour"] + [name for name, value in weighed.items() if not torch.isfinite(value)]
        planes = [f"{name} at scale {s}" for s, name, *_ in self.field.layout.planes()
                  if not torch.isfinite(self.field.plane(s, name)).all()]
        decoder = [name for name, value in self.field.named_parameters() if name != "theta" and not torch.isfinite(value).all()]
        found = ", ".join((planes + decoder)[:6])
        return f"the loss is not finite ({', '.join(terms)})" + (f", nor are all values of {found}" if found else "")

    def density_at(self, points: np.ndarray, times: np.ndarray) -> np.ndarray:
        """Log densities at (N, 3) points in [0, 1]^3 and (N,) times."""
        if isinstance(self.optimiser, FusedOptimiser):
            return log_densities(self.field, points, times)
        out = []
        with torch.no_grad():
            for p, t in zip(np.array_split(points, len(points) // 2**18 + 1), np.array_split(times, len(times) // 2**18 + 1)):
                features = self.optimiser.features(*(torch.from_numpy(np.float32(a)).to(self.device) for a in (p, t)))
                out.append(self.field.decode(features)[0].cpu().numpy())
        return np.concatenate(out)

    def save(self, path: Path) -> None:
        """Write everything a later `resume` needs. The file is plain tensors and numbers; it is read without unpickling code.

        Raises:
            TrainingError: it cannot be written; an earlier checkpoint is left as it was.
        """
        state = {
            "config": asdict(self.config), "aabb": torch.from_numpy(self.aabb), "step": self.step, "elapsed_s": self.elapsed_s,
            "mapping": repr(self.mapping),
            "samples_per_ray": self.samples_per_ray, "field": self.field.state_dict(), "optimiser": self.optimiser.state(),
            "grid": self.grid.state(), "rng": _rng_to_plain(self.rng), "dataset": _fingerprint(self.dataset),
        }
        try:
            with written_aside(path) as aside:
                torch.save(state, aside)
        except (OSError, RuntimeError) as error:  # PyTorch reports a full disk as RuntimeError
            reason = error.strerror if isinstance(error, OSError) else str(error).partition("\n")[0]
            raise TrainingError(f"{path}: the checkpoint cannot be written ({reason}); free space there, or give another "
                                "folder with --work") from error

    def _try_to_save(self, path: Path) -> None:
        try:
            self.save(path)
        except TrainingError as error:
            print(f"{error}; training goes on", file=sys.stderr, flush=True)

    def resume(self, path: Path) -> None:
        """Go on from a checkpoint of the same dataset and config, to bitwise the same end.

        Raises:
            TrainingError: it cannot be read, or belongs to another run.
        """
        try:
            state = _load(path, self.device)
            same = _comparable(state["config"]) == _comparable(asdict(self.config))
            here = np.array_equal(state["aabb"].cpu().numpy(), self.aabb) and state.get("mapping") == repr(self.mapping)
            if not same or not here:
                raise TrainingError(f"{path}: belongs to a run with other settings; give the same ones or drop --resume")
            if state["dataset"] != _fingerprint(self.dataset):
                raise TrainingError(f"{path}: belongs to a run on other pictures; give the same dataset, --holdout and "
                                    "--downscale, or drop --resume")
            self.field.load_state_dict(state["field"])
            self.optimiser.load(state["optimiser"])
            self.grid.load(state["grid"])
            self.rng.bit_generator.state = _rng_from_plain(state["rng"])
            self.step, self.elapsed_s = state["step"], state["elapsed_s"]
            self.samples_per_ray = state["samples_per_ray"]
        except TrainingError:
            raise
        except Exception as error:  # what a damaged file holds may be of any kind
            raise _unusable(path, error) from error


class RaySampler:
    """Draws usable pixels of the training pictures, each as likely as any other unless told otherwise, and makes their rays.

    Attributes:
        frames: (P, 4) int64, columns from and to, rows from and to, of what is not transparent in each training picture;
            None without alpha, and with masks, which need not agree with it.
    """

    MARGIN = 0.03
    """Of a picture's longer side, about what is not transparent: the outline wants to be learnt from both sides."""

    def __init__(
        self, dataset: Dataset, mapping: SpaceMapping | None = None, appearances: np.ndarray | None = None
    ) -> None:
        """`appearances`: (P,) int64, of each picture, as `appearances.number_pictures` has them; None where there are none."""
        self.dataset, self.mapping, self.appearances = dataset, mapping, appearances
        self.train = np.flatnonzero(~dataset.pictures.is_test)
        self.ends = np.cumsum(dataset.usable_counts[self.train])
        self.frames: np.ndarray | None = None
        if dataset.has_alpha and dataset.masks is None:
            self.frames = np.array([self._frame(dataset.pixels.picture(int(p))[..., 3]) for p in self.train], np.int64)
            sizes = (self.frames[:, 1] - self.frames[:, 0]) * (self.frames[:, 3] - self.frames[:, 2])
            self.frame_ends = np.cumsum(sizes)

    def draw(
        self, rng: np.random.Generator, count: int, background: np.ndarray | None = None, object_rays: float = 0.0,
        weights: TileWeights | None = None,
    ) -> tuple[Rays, torch.Tensor]:
        """`count` rays and the (count, 3) colours they should have, over one background or one drawn for each ray.

        `object_rays` is the share of them that is drawn from `frames`, where there are any; the others go by `weights`.
        """
        pictures = self.dataset.pictures
        within = 0 if self.frames is None or not self.frame_ends[-1] else round(object_rays * count)
        if weights is not None:
            picture, row, column = weights.draw(rng, count - within)
        else:
            which, rank = _pick(rng, self.ends, count - within)
            picture = self.train[which]
            row, column = np.divmod(self.dataset.nth_usable(picture, rank), pictures.width[picture])
        if within:
            which, rank = _pick(rng, self.frame_ends, within)
            left, right, top, _ = self.frames[which].T
            below, beside = np.divmod(rank, right - left)
            picture = np.concatenate([self.train[which], picture])
            row, column = np.concatenate([top + below, row]), np.concatenate([left + beside, column])
        # Rays of one instant read the same rows of the space-time planes: side by side, they find them in the cache.
        order = np.argsort(pictures.time[picture], kind="stable")
        picture, row, column = picture[order], row[order], column[order]
        inside = row * pictures.width[picture] + column
        origins, directions = rays(pictures, picture, column, row, self.mapping)
        colours = self.dataset.pixels.read(pictures.offset[picture] + inside).astype(np.float32) / np.float32(255)
        if background is None:
            backgrounds = rng.random((count, 3), dtype=np.float32)
        else:
            backgrounds = np.broadcast_to(background, (count, 3))
        targets = colours[:, :3]
        if self.dataset.has_alpha:
            targets = targets * colours[:, 3:] + backgrounds * (1 - colours[:, 3:])
        jitters = rng.random(count, dtype=np.float32)
        arrays = (origins, directions, pictures.time[picture], jitters, backgrounds)
        numbers = None if self.appearances is None else torch.from_numpy(self.appearances[picture])
        batch = Rays(*(torch.from_numpy(np.ascontiguousarray(a, np.float32)) for a in arrays), numbers)
        return batch, torch.from_numpy(targets)

    def _frame(self, alpha: np.ndarray) -> tuple[int, int, int, int]:
        rows, columns = np.flatnonzero(alpha.any(1)), np.flatnonzero(alpha.any(0))
        if not len(rows):
            return 0, 0, 0, 0
        (height, width), margin = alpha.shape, math.ceil(self.MARGIN * max(alpha.shape))
        return (max(columns[0] - margin, 0), min(columns[-1] + 1 + margin, width),
                max(rows[0] - margin, 0), min(rows[-1] + 1 + margin, height))


def _pick(rng: np.random.Generator, ends: np.ndarray, count: int) -> tuple[np.ndarray, np.ndarray]:
    """`count` of the ends[-1] pixels of several ranges laid end to end: which range each is in, and its number there."""
    pixel = rng.integers(ends[-1], size=count)
    which = np.searchsorted(ends, pixel, side="right")
    return which, pixel - np.where(which > 0, ends[which - 1], 0)


def kept_channels(field: Field, config: TrainConfig, step: int) -> torch.Tensor:
    """Factors on the features for one step, (F,) float32: 0 where `channel_dropout` leaves a channel out, at all scales alike.

    The others carry its weight: the mean over steps is 1.
    """
    M = field.layout.channels
    dropped = min(round(config.channel_dropout * M), M - 1)
    factors = np.full(M, M / (M - dropped), np.float32)
    factors[np.random.default_rng((config.seed, step)).permutation(M)[:dropped]] = 0
    return torch.from_numpy(np.tile(factors, len(field.layout.resolution))).to(field.theta.device)


class FusedOptimiser:
    """A step on the CPU: fused kernels for the planes, PyTorch for the small decoder."""

    def __init__(
        self, field: Field, config: TrainConfig, cells: tuple[int, int, int], mapping: SpaceMapping | None = None
    ) -> None:
        self.field, self.config, self.mapping = field, config, mapping
        self.watch = Stopwatch()
        self.workers = numba.get_num_threads()  # starts numba's threads, which would undo the next line
        torch.set_num_threads(1)  # the decoder is so small that sharing it out costs more, a hundredfold on a busy machine
        self.theta = field.theta.detach().numpy()
        self.grad = np.zeros((self.workers, self.theta.size), np.float32)
        self.mean, self.square = np.zeros_like(self.theta), np.zeros_like(self.theta)
        self._peaks = np.zeros((self.workers, *cells), np.float32)
        self.decoder = _decoder_optimiser(field, config)

    def peaks(self) -> np.ndarray:
        """The largest weight in each cell since the last call: (Nz, Ny, Nx) float32."""
        peaks = self._peaks.max(0)
        self._peaks[:] = 0
        return peaks

    def step(
        self, number: int, rate: float, batch: Rays, targets: torch.Tensor,
        aabb: np.ndarray, occupancy: np.ndarray, step_length: float, extent: float,
    ) -> tuple[float, float]:
        """Mean squared error a colour channel, and samples a ray."""
        layout, config = self.field.layout, self.config
        with self.watch("decoder"):
            kept = kept_channels(self.field, config, number)
            basis = self.field.b2[None]
            if config.view_dependent:
                basis = self.field.basis(batch.directions, self.field.codes_of(batch.appearances))
            basis = basis * kept
            density = torch.cat([self.field.density.detach()[:-1] * kept, self.field.density.detach()[-1:]])
            grad_basis = np.zeros((len(basis) if config.view_dependent else self.workers, *basis.shape[1:]), np.float32)
            grad_density = np.zeros((self.workers, layout.features + 1), np.float32)
            motion = motion_of(self.field)
            grad_motion = None if motion is None else np.zeros((self.workers, *motion.shape), np.float32)
            moving = motion is not None and number % config.motion_every == 0
        with self.watch("kernel"):
            errors, counts = kernels.backpropagate(
                self.theta, self.grad, layout.table, layout.resolution, density.numpy(), grad_density,
                layout.channels, motion, grad_motion, moving, aabb, kernels.even_of(self.mapping), occupancy.view(np.uint8),
                np.float32(step_length), np.float32(extent), batch.origins.numpy(), batch.directions.numpy(), batch.times.numpy(),
                batch.jitters.numpy(), basis.detach().numpy(), grad_basis, targets.numpy(), batch.backgrounds.numpy(),
                self._peaks, np.float32(config.distortion), sample_capacity(aabb, step_length, self.mapping),
            )
        with self.watch("priors"):
            if number % config.regularise_every == 0:
                add_priors(self.field, self.theta, self.grad[0], config, config.regularise_every)
        with self.watch("decoder"):
            self.decoder.zero_grad()
            basis.backward(torch.from_numpy(grad_basis if config.view_dependent else grad_basis.sum(0, keepdims=True)))
            self.field.density.grad = torch.from_numpy(grad_density.sum(0))
            self.field.density.grad[:-1] *= kept
            if self.field.codes is not None:
                _total(appearance_priors(self.field, config)).backward()
            if moving:
                _total(motion_priors(self.field, config)).backward()
                self.field.motion.grad += torch.from_numpy(grad_motion.sum(0))
            _set_rate(self.decoder, rate)
            self.decoder.step()
        with self.watch("adam"):
            kernels.adam(self.theta, self.grad, self.mean, self.square, config.learning_rate * rate, BETA1, BETA2, EPSILON,
                         number + 1)
        return float(errors.mean(dtype=np.float64)) / 3, float(counts.mean())

    def state(self) -> dict[str, Any]:
        return {"mean": torch.from_numpy(self.mean), "square": torch.from_numpy(self.square),
                "peaks": torch.from_numpy(self._peaks.max(0)), "decoder": self.decoder.state_dict()}

    def load(self, state: dict[str, Any]) -> None:
        self.mean[:], self.square[:] = state["mean"].numpy(), state["square"].numpy()
        self._peaks[:] = state["peaks"].numpy()
        self.decoder.load_state_dict(state["decoder"])

    def curvature(self) -> np.ndarray:
        """Running mean of the squared gradient of each element of theta, a diagonal estimate of how much an error there costs."""
        return self.square


class Figures:
    """Small tensors from a device, read LATE steps after they were made, so that nobody waits; on the CPU at once."""

    LATE = 8

    def __init__(self, device: torch.device) -> None:
        self.device = device
        self._waiting: deque[tuple[torch.Tensor, torch.cuda.Event]] = deque()

    def of(self, made: torch.Tensor) -> list[float]:
        """The numbers of `made`, or of what was made LATE calls ago; of the first, as long as there is none."""
        if self.device.type == "cpu":
            return made.tolist()  # type: ignore[no-any-return]
        host = torch.empty_like(made, device="cpu", pin_memory=True).copy_(made, non_blocking=True)
        done = torch.cuda.Event()
        done.record()
        self._waiting.append((host, done))
        host, done = self._waiting.popleft() if len(self._waiting) > self.LATE else self._waiting[0]
        done.synchronize()
        return host.tolist()  # type: ignore[no-any-return]


class PlainOptimiser:
    """A step in plain PyTorch, on any device that PyTorch knows; or `fused`, on the CPU: kernels for the planes.

    On a GPU nothing in a step waits for it: shapes do not depend on what it computes, and `step` returns numbers that it worked
    out a few steps before.
    """

    def __init__(
        self, field: Field, config: TrainConfig, cells: tuple[int, int, int], mapping: SpaceMapping | None = None, *,
        fused: bool = False, proposals: Proposals | None = None,
    ) -> None:
        self.field, self.config, self.mapping, self.proposals = field, config, mapping, proposals
        self.watch = Stopwatch()
        self.device = field.theta.device
        self._peaks = torch.zeros(cells, device=self.device)
        self._figures = Figures(self.device)
        self._occupancy: tuple[np.ndarray, torch.Tensor] | None = None
        self.fused = fused
        self.features = fused_features(field) if fused else field.features
        if fused:
            numba.get_num_threads()  # starts numba's threads, which would undo the next line
            torch.set_num_threads(1)  # several add up gradients in any order: no run would end where another did
        helpers = [] if proposals is None else list(proposals.fields)
        for each in (field, *helpers):
            each.mixed = config.mixed_precision and self.device.type != "cpu"
        self.planes = _adam([([f.theta for f in (field, *helpers)], config.learning_rate)])
        self.decoder = _decoder_optimiser(field, config, [f.density for f in helpers])

    def peaks(self) -> np.ndarray:
        """As `FusedOptimiser.peaks`."""
        peaks = self._peaks.cpu().numpy().copy()
        self._peaks.zero_()
        return peaks

    def step(
        self, number: int, rate: float, batch: Rays, targets: torch.Tensor,
        aabb: np.ndarray, occupancy: np.ndarray, step_length: float, extent: float,
    ) -> tuple[float, float]:
        """Mean squared error a colour channel, and samples a ray."""
        config = self.config
        with self.watch("samples"):
            batch, targets = batch.apply(self._there), self._there(targets)
            levels: list[Level] = []
            if self.proposals is None:
                samples = self._samples(batch, aabb, occupancy, step_length)
            else:
                box, cells = self._there(torch.from_numpy(aabb)), tuple(self._peaks.shape)
                samples, edges, levels = self.proposals.sample(batch, box, self.mapping, cells, number, self.fused)
        with self.watch("forward"):
            kept = self._there(kept_channels(self.field, config, number))
            met = meet(self.field, batch, samples, self.features, extent, kept)
            error = (shade(self.field, batch, met) - targets).square().mean()
            loss = error + config.distortion * met.distortion
            for level in levels:
                loss = loss + config.histogram * histogram_loss(edges, met.weights.view(len(targets), -1), level)
            moving = self.field.motion is not None and number % config.motion_every == 0
            if moving:
                loss = loss + _total(motion_priors(self.field, config))
            if self.field.codes is not None:
                loss = loss + _total(appearance_priors(self.field, config))
            regularised = number % config.regularise_every == 0
            if regularised and not self.fused:
                loss = loss + config.regularise_every * _total(priors(self.field, config))
        with self.watch("backward"):
            for optimiser in (self.planes, self.decoder):
                optimiser.zero_grad()
                _set_rate(optimiser, rate)
            loss.backward()  # type: ignore[no-untyped-call]
            if self.field.motion is not None and not moving:
                self.field.motion.grad = None
        with self.watch("priors"):
            if regularised and self.fused:
                theta, grad = self.field.theta.detach().numpy(), self.field.theta.grad.numpy()
                add_priors(self.field, theta, grad, config, config.regularise_every)
        with self.watch("adam"):
            self.planes.step()
            self.decoder.step()
            _, ny, nx = self._peaks.shape
            flat = (samples.cell[:, 0] * ny + samples.cell[:, 1]) * nx + samples.cell[:, 2]
            self._peaks.view(-1).scatter_reduce_(0, flat, met.weights.detach(), "amax")
        taken = (met.reached & (samples.length > 0)).sum() / len(targets)
        squared_error, samples_a_ray = self._figures.of(torch.stack([error.detach(), taken]))
        return squared_error, samples_a_ray

    def _samples(self, batch: Rays, aabb: np.ndarray, occupancy: np.ndarray, step_length: float) -> Samples:
        if self.fused:
            return collected(batch, aabb, occupancy, step_length, self.mapping)
        if self._occupancy is None or self._occupancy[0] is not occupancy:
            self._occupancy = occupancy, self._there(torch.from_numpy(occupancy))
        fixed = {} if self.device.type == "cpu" else {
            "most": sample_capacity(aabb, step_length, self.mapping), "capacity": ROOM * self.config.samples}
        return samples_of(batch, self._there(torch.from_numpy(aabb)), self._occupancy[1], step_length, self.mapping, **fixed)

    def _there(self, values: torch.Tensor) -> torch.Tensor:
        """On the device, without waiting for it: only pinned memory can be copied behind one's back."""
        return values if self.device.type == "cpu" else values.pin_memory().to(self.device, non_blocking=True)

    def state(self) -> dict[str, Any]:
        return {"planes": self.planes.state_dict(), "decoder": self.decoder.state_dict(), "peaks": self._peaks,
                "proposals": self.proposals and self.proposals.state_dict()}

    def load(self, state: dict[str, Any]) -> None:
        self._peaks.copy_(state["peaks"])
        self.planes.load_state_dict(state["planes"])
        self.decoder.load_state_dict(state["decoder"])
        if self.proposals is not None:
            self.proposals.load_state_dict(state["proposals"])

    def curvature(self) -> np.ndarray:
        """As `FusedOptimiser.curvature`."""
        state = self.planes.state[self.field.theta]
        if "exp_avg_sq" not in state:
            return np.zeros(self.field.theta.numel(), np.float32)
        return state["exp_avg_sq"].cpu().numpy()


def _total(weighed: dict[str, torch.Tensor]) -> torch.Tensor:
    return torch.stack(list(weighed.values())).sum()


def add_priors(field: Field, theta: np.ndarray, grad: np.ndarray, config: TrainConfig, times: float) -> None:
    """Add `times` the gradient of `kpc.encoder.field.priors` to grad."""
    M = field.layout.channels
    space, transient = times * config.space_variation, times * config.transient_variation
    for _, name, start, rows, columns in field.layout.planes():
        if name in SPACE_PLANES:
            kernels.add_variation(theta, grad, start, rows, columns, M, space, space)
            continue
        kernels.add_variation(theta, grad, start, rows, columns, M, transient, 0.0)
        kernels.add_time_smoothness(theta, grad, start, rows, columns, M, times * config.time_smoothness)
        size = rows * columns * field.layout.channels
        kernels.add_sparse_transients(theta, grad, start, size, times * config.sparse_transients)


def log_densities(field: Field, points: np.ndarray, times: np.ndarray) -> np.ndarray:
    """Log densities at (N, 3) points in [0, 1]^3 and (N,) times, on the CPU."""
    layout = field.layout
    return kernels.log_densities(
        field.theta.detach().numpy(), layout.table, layout.resolution, field.density.detach().numpy(),
        layout.channels, motion_of(field), np.asarray(points, np.float32), np.asarray(times, np.float32), 8 * numba.get_num_threads(),
    )


def motion_of(field: Field) -> np.ndarray | None:
    """The motion grid as the kernels take it."""
    return None if field.motion is None else field.motion.detach().numpy()


def sample_capacity(aabb: np.ndarray, step_length: float, mapping: SpaceMapping | None = None) -> int:
    """Samples a ray can take at most: the box's diagonal in steps, or all of a ray through contracted space."""
    longest = np.linalg.norm(np.asarray(aabb[1] - aabb[0], np.float64)) if not isinstance(mapping, Contraction) else mapping.end
    return int(longest / step_length) + 2


def box_of_checkpoint(path: Path) -> np.ndarray:
    """The (2, 3) box of the run that wrote a checkpoint.

    Raises:
        TrainingError: it cannot be read.
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


def _decoder_optimiser(
    field: Field, config: TrainConfig, others: Sequence[torch.nn.Parameter] = ()
) -> torch.optim.Adam:
    """Of all but the planes."""
    decoder = [*field.decoder_parameters(config.view_dependent), *others]
    motion = [] if field.motion is None else [([field.motion], config.motion_learning_rate)]
    codes = [] if field.codes is None else [([field.codes], config.appearance_learning_rate)]
    return _adam([(decoder, config.decoder_learning_rate), *motion, *codes])


def _adam(groups: list[tuple[list[torch.nn.Parameter], float]]) -> torch.optim.Adam:
    """For groups of parameters and the peak of the learning rate of each."""
    return torch.optim.Adam([{"params": parameters, "peak": peak, "lr": peak} for parameters, peak in groups],
                            betas=(BETA1, BETA2), eps=EPSILON)


def _set_rate(optimiser: torch.optim.Adam, rate: float) -> None:
    """`rate`: a share of the peaks."""
    for group in optimiser.param_groups:
        group["lr"] = group["peak"] * rate


def _comparable(config: dict[str, Any]) -> dict[str, Any]:
    """A config without what may differ between a run and its continuation."""
    return {key: tuple(value) if isinstance(value, list) else value for key, value in config.items()
            if key not in ("steps", "max_coding_loss_db", "prune_share")}


def _fingerprint(dataset: Dataset) -> str:
    """Of what the rays of a training run depend on, the checksums of pixels and masks included."""
    digest = hashlib.sha256(repr([(tile.offset, tile.crc32c) for tile in dataset.pixels.tiles]).encode())
    p = dataset.pictures
    for array in (p.time, p.is_test, p.width, p.height, p.intrinsics, p.distortion, p.camera_to_world):
        digest.update(np.ascontiguousarray(array).tobytes())
    if dataset.masks is not None:
        digest.update(repr(dataset.masks.crc32c).encode())
    return digest.hexdigest()


def _rng_to_plain(rng: np.random.Generator) -> dict[str, str]:
    state = rng.bit_generator.state
    return {"state": hex(state["state"]["state"]), "inc": hex(state["state"]["inc"]),
            "has_uint32": str(state["has_uint32"]), "uinteger": str(state["uinteger"])}


def _rng_from_plain(plain: dict[str, str]) -> dict[str, Any]:
    return {"bit_generator": "PCG64", "state": {"state": int(plain["state"], 16), "inc": int(plain["inc"], 16)},
            "has_uint32": int(plain["has_uint32"]), "uinteger": int(plain["uinteger"])}
