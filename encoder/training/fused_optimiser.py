"""One training step on the CPU: fused kernels for the planes and the explicit decoder's gradient."""

from typing import Any

import numba
import numpy as np
import torch

from kpc.encoder.field import fused, kernels
from kpc.encoder.field.config import TrainConfig
from kpc.encoder.field.field import Field
from kpc.encoder.field.fused import max_samples_per_ray
from kpc.encoder.field.priors import appearance_priors
from kpc.encoder.field.render import Rays
from kpc.encoder.training.line_steps import line_steps
from kpc.encoder.training.optimisers import (
    BETA1,
    BETA2,
    EPSILON,
    Stopwatch,
    add_motion_prior_gradients,
    add_prior_gradients,
    decoder_optimiser,
    feature_mask,
    set_rate,
    total,
)
from kpc.format.scene.space import SpaceMapping


class FusedOptimiser:
    """Kernels for the planes, PyTorch for the small decoder.

    Attributes:
        timers: seconds spent, by part of a step.
        ray_gradients: (N, RAY_GRADIENTS) of the last batch, where cameras are refined.
    """

    def __init__(
        self, field: Field, config: TrainConfig, cells: tuple[int, int, int], mapping: SpaceMapping | None = None
    ) -> None:
        """`field`: with the explicit decoder, on the CPU. `cells`: (Nz, Ny, Nx) of the occupancy grid."""
        self.field, self.config, self.mapping = field, config, mapping
        self.timers = Stopwatch()
        self.workers = numba.get_num_threads()  # starts numba's threads, which would undo the next line
        # The decoder is so small that more threads only slow it down, a hundredfold on a busy machine.
        torch.set_num_threads(1)
        self.theta = field.theta.detach().numpy()
        # PyTorch aligns arrays with lines of the processor's cache, of which unaligned texels would take one more each.
        self.grad = torch.zeros((self.workers, self.theta.size)).numpy()
        self.mean, self.square = np.zeros_like(self.theta), np.zeros_like(self.theta)
        self._peaks = np.zeros((self.workers, *cells), np.float32)
        self.decoder = decoder_optimiser(field, config)
        self.lines = line_steps(field, config)
        self.ray_gradients = np.zeros((1, kernels.RAY_GRADIENTS), np.float32)

    def peaks(self) -> np.ndarray:
        """Return the largest weight in each cell since the last call, (Nz, Ny, Nx) float32."""
        peaks = self._peaks.max(0)
        self._peaks[:] = 0
        return peaks

    def step(
        self,
        number: int,
        fraction: float,
        rate: float,
        batch: Rays,
        targets: torch.Tensor,
        aabb: np.ndarray,
        occupancy: np.ndarray,
        step_length: float,
        extent: float,
    ) -> tuple[float, float]:
        """Do one step.

        Args:
            number: of the step, from 0. fraction: of the run, in [0, 1]. rate: factor on the learning rates.
            batch: N rays. targets: (N, 3) colours in [0, 1].
            aabb: (2, 3) float32. occupancy: `OccupancyGrid.marched`. step_length: in s. extent: longest edge of aabb.

        Returns:
            The mean squared error per colour channel, and the mean number of samples per ray.
        """
        layout, config = self.field.layout, self.config
        with self.timers("decoder"):
            mask = feature_mask(self.field, config, number, fraction)
            scales = int(mask.view(-1, layout.channels).any(1).sum())  # masked finer scales take no time either
            mask = mask[: scales * layout.channels]
            basis = fused.ColourBasis(self.field, batch, mask.numpy(), config.view_dependent)
            planes = fused.planes_of(self.field, scales)
            gradients = self._new_gradients(len(targets), len(mask), planes.motion, number)
        with self.timers("kernel"):
            bias = self.field.density.detach()[-1:]
            errors, counts = kernels.backpropagate(
                planes,
                torch.cat([self.field.density.detach()[: len(mask)] * mask, bias]).numpy(),
                fused.volume_of(aabb, occupancy, step_length, self.mapping)._replace(extent=np.float32(extent)),
                fused.ray_batch(batch),
                basis.values,
                targets.numpy(),
                np.float32(config.distortion),
                gradients,
                self._peaks,
                max_samples_per_ray(aabb, step_length, self.mapping),
            )
        with self.timers("priors"):
            if number % config.regularise_every == 0:
                variation = config.variation(fraction)
                add_prior_gradients(self.field, self.theta, self.grad[0], config, variation, config.regularise_every)
        with self.timers("decoder"):
            self._step_decoder(basis, mask, gradients, rate)
        if self.lines is not None:
            with self.timers("lines"):
                self.lines.step(rate, self.grad)
        with self.timers("adam"):
            learning_rate = config.learning_rate * rate
            kernels.adam(
                self.theta, self.grad, self.mean, self.square, learning_rate, BETA1, BETA2, EPSILON, number + 1
            )
        return float(errors.mean(dtype=np.float64)) / 3, float(counts.mean())

    def _new_gradients(self, rays: int, F: int, motion: np.ndarray, number: int) -> kernels.Gradients:
        """Return `Gradients` for a step: the planes' buffers, and zeros."""
        rows, wants_rays = rays if self.config.view_dependent else self.workers, self.config.refine != "none"
        self.ray_gradients = np.zeros((rays if wants_rays else 1, kernels.RAY_GRADIENTS), np.float32)
        return kernels.Gradients(
            self.grad,
            np.zeros((self.workers, F + 1), np.float32),
            np.zeros((rows, 3, F), np.float32),
            np.zeros((self.workers, *motion.shape), np.float32),
            motion.size > 0 and number % self.config.motion_every == 0,
            self.ray_gradients,
            wants_rays,
            np.float32(0 if wants_rays else self.config.full_weight),
        )

    def _step_decoder(
        self, basis: fused.ColourBasis, mask: torch.Tensor, gradients: kernels.Gradients, rate: float
    ) -> None:
        """Step all parameters but the planes, given the gradients of the masked basis and density."""
        field, config = self.field, self.config
        self.decoder.zero_grad()
        basis.set_gradients(gradients.basis, gradients.rays, gradients.wants_rays)
        g_density = torch.from_numpy(gradients.density.sum(0))
        field.density.grad = torch.zeros_like(field.density)
        field.density.grad[: len(mask)] = g_density[:-1] * mask
        field.density.grad[-1] = g_density[-1]
        if field.codes is not None:
            total(appearance_priors(field, config)).backward()  # type: ignore[no-untyped-call]
        if gradients.wants_motion and field.motion is not None:
            field.motion.grad = torch.from_numpy(gradients.motion.sum(0))
            add_motion_prior_gradients(field.motion, config)
        set_rate(self.decoder, rate)
        self.decoder.step()

    def state(self) -> dict[str, Any]:
        """Return what a checkpoint holds of this optimiser."""
        return {
            "mean": torch.from_numpy(self.mean),
            "square": torch.from_numpy(self.square),
            "peaks": torch.from_numpy(self._peaks.max(0)),
            "decoder": self.decoder.state_dict(),
            "lines": self.lines and self.lines.state(),
        }

    def load(self, state: dict[str, Any]) -> None:
        """Take over what `state` returned."""
        self.mean[:], self.square[:] = state["mean"].numpy(), state["square"].numpy()
        self._peaks[:] = state["peaks"].numpy()
        self.decoder.load_state_dict(state["decoder"])
        if self.lines is not None:
            self.lines.load(state["lines"])
