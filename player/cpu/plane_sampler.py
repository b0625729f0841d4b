"""The field by its planes: samples of the processor's ray marcher look up space planes, and time rows beside them."""

import math

import numpy as np

from kpc.format.scene.grid import sample_linear
from kpc.format.scene.scene import SPACE_PLANES, TIME_PLANES, Scene
from kpc.player.areas import FeatureAreas
from kpc.player.atlas import Layout, pad_to_multiple
from kpc.player.cpu.field_kernels import PlaneArrays, log_densities_at
from kpc.player.cpu.field_sampler import FieldArrays, FieldSampler, quantised_planes
from kpc.player.cpu.serving import CHANNELS, LANES, NARROW, group_width, plane_bytes, serves, texels_along
from kpc.player.cpu.simd import LARGEST
from kpc.player.cpu.threads import WORKERS


class PlaneSampler(FieldSampler):
    """The planes of a scene in int16, and the time rows of a time.

    Channels are in groups, of NARROW where no scale has more, else of WIDE: all texels of a plane hold those of the
    first group, then all those of the next.
    """

    def __init__(self, scene: Scene, layout: Layout) -> None:
        super().__init__(scene, layout)
        decoder = scene.decoder
        self._channels = [scale["xy"].shape[2] for scale in scene.scales]
        self._wide = group_width(scene)
        groups = [-(-channels // self._wide) for channels in self._channels]
        self._first_group = np.cumsum([0, *groups])
        self._sizes = np.repeat([texels_along(scale) for scale in scene.scales], groups, axis=0)
        nx, ny, nz = self._sizes.T
        planes, rows = self._wide * np.stack([nx * ny, nx * nz, ny * nz], axis=1), self._wide * self._sizes
        self._sizes = np.pad(self._sizes, ((0, 0), (0, 1)))  # beside them, whether rows are other than 1
        self._firsts = np.concatenate([_offsets(planes), _offsets(rows)], axis=1)
        self._planes, self._rows = np.zeros(int(planes.sum()), np.int16), np.ones(int(rows.sum()), np.float32)
        self._areas = np.zeros((len(self._sizes), 2, 3), np.float32)
        hidden = len(decoder.b1) if decoder.w2.any() else 0
        self._w1 = np.ascontiguousarray(decoder.w1[:hidden], np.float32)
        self._b1 = np.asarray(decoder.b1[:hidden], np.float32)
        w2 = np.moveaxis(decoder.w2, 2, 0)[:hidden]
        self._w2 = self._scaled_w2 = self._grouped(np.concatenate([w2, np.zeros_like(w2[:, :1])], axis=1))
        density = np.concatenate([decoder.b2, decoder.density_weight[None]])
        self._weights = self._scaled_weights = self._grouped(density)
        # Room for the direction-dependent weights of each worker's rays.
        self._ray_weights = np.zeros((WORKERS, LANES if hidden else 0, len(self._weights)), np.float32)

    @staticmethod
    def serves(scene: Scene) -> bool:
        return serves(scene)

    @staticmethod
    def bytes_for(scene: Scene) -> int:
        return plane_bytes(scene)

    def set_planes(self, atlas: np.ndarray) -> None:
        steps = []
        for block in self._layout.blocks:
            whole, step = quantised_planes(self._layout.plane(atlas, block)[..., : self._channels[block.scale]])
            for axis in (0, 1):
                whole = _at_least_two(whole, axis)
            self._put(self._planes, block.scale, SPACE_PLANES.index(block.plane), whole)
            steps.append(step)
        for scale, area in enumerate(FeatureAreas.of_atlas(self._scene, self._layout, atlas).bounds):
            self._areas[self._groups(scale)] = area
        # The product of three planes is in products of their steps, by which the decoder's weights are the larger.
        count = len(SPACE_PLANES)
        products = [np.prod(steps[first : first + count], axis=0) for first in range(0, len(steps), count)]
        scaling = self._grouped(np.tile(np.concatenate(products), (CHANNELS, 1)))
        self._scaled_w2, self._scaled_weights = (
            np.clip(weights * scaling, -LARGEST, LARGEST).astype(np.float32) for weights in (self._w2, self._weights)
        )
        self.time_planes_changed()

    def _prepare_time(self, time: float | None) -> None:
        self._sizes[:, 3], self._rows[:] = 0, 1
        if time is None:
            return
        for number, scale in enumerate(self._scene.scales):
            rows = [_at_least_two(sample_linear(scale[name], time), 0) for name in TIME_PLANES]
            self._sizes[self._groups(number), 3] = any((row != 1).any() for row in rows)
            for axis, row in enumerate(rows):
                self._put(self._rows, number, len(SPACE_PLANES) + axis, row)

    def _arrays(self, worker: int) -> FieldArrays:
        b1 = self._b1 + self._code if len(self._b1) else self._b1
        weights = self._ray_weights[worker] if len(b1) else self._scaled_weights[None]
        bias = np.float32(self._scene.decoder.density_bias)
        return None, PlaneArrays(
            tuple(range(0, self._wide, NARROW)), self._planes, self._rows, self._firsts, self._sizes,
            self._areas, self._w1, b1, self._scaled_w2, self._scaled_weights, bias, weights,
        )  # fmt: skip

    def log_densities(self, positions: np.ndarray, out: np.ndarray) -> None:
        """Compute the log density at positions, (N, 3) float32 in [0, 1]^3, at the prepared time, to (N,) float32
        `out`."""
        _, planes = self._arrays(0)
        assert planes is not None
        density_only = planes._replace(
            w1=planes.w1[:0], b1=planes.b1[:0], w2=planes.w2[:0], ray_weights=planes.weights[None]
        )
        log_densities_at(positions, self._motion, density_only, out)

    def _groups(self, scale: int) -> slice:
        """Return the groups of channels of a scale."""
        return slice(self._first_group[scale], self._first_group[scale + 1])

    def _put(self, into: np.ndarray, scale: int, which: int, texels: np.ndarray) -> None:
        """Write (..., channels) texels of a plane or row to their place, group by group."""
        groups = self._groups(scale)
        for number, group in enumerate(range(groups.start, groups.stop)):
            part = texels[..., self._wide * number : self._wide * (number + 1)]
            part = pad_to_multiple(part, texels.ndim - 1, self._wide)
            first = self._firsts[group, which]
            into[first : first + part.size] = part.reshape(-1)

    def _grouped(self, weights: np.ndarray) -> np.ndarray:
        """Return (..., CHANNELS, F) weights as (..., CHANNELS F) float64: for each group of features, those of each of
        the channels."""
        parts = np.split(weights, np.cumsum(self._channels)[:-1], axis=-1)
        parts = [pad_to_multiple(part, part.ndim - 1, self._wide) for part in parts]
        whole = np.concatenate(parts, axis=-1).astype(np.float64)
        grouped = whole.reshape(*whole.shape[:-1], whole.shape[-1] // self._wide, self._wide).swapaxes(-3, -2)
        return np.ascontiguousarray(grouped).reshape(*whole.shape[:-2], math.prod(whole.shape[-2:]))


def _at_least_two(texels: np.ndarray, axis: int) -> np.ndarray:
    return np.repeat(texels, 2, axis=axis) if texels.shape[axis] == 1 else texels


def _offsets(counts: np.ndarray) -> np.ndarray:
    """Return where each of several arrays begins that lie one after the other, given their sizes."""
    return np.asarray(np.cumsum(counts).reshape(counts.shape) - counts)
