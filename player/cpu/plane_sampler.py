"""Scenes of planes, drawn by a processor itself: samples look up the planes, and the rows of the time planes beside them."""

import math
from typing import Any

import numpy as np
from kpc.format.scene.grid import sample_linear
from kpc.format.scene.scene import SPACE_PLANES, TIME_PLANES, Decoder, Scene
from kpc.format.scene.space import DeviceCoordinates
from kpc.player.atlas import Layout, pad_to_multiple
from kpc.player.cpu.cpu_renderer import Marching, in_steps
from kpc.player.cpu.raymarch import LANES
from kpc.player.cpu.simd import CHANNELS, LARGEST, NARROW, WIDE
from kpc.player.cpu.threads import WORKERS


class PlaneSampler(Marching):
    """The planes of a scene in whole numbers, and the rows of a time.

    Channels go in groups, of NARROW where no scale has more, else of WIDE: all texels of a plane have those of the first, then all have those of the next.
    """

    def __init__(self, scene: Scene, layout: Layout) -> None:
        super().__init__(scene)
        self._layout, decoder = layout, scene.decoder
        self._channels = [scale["xy"].shape[2] for scale in scene.scales]
        self._wide = _wide(scene)
        groups = [-(-channels // self._wide) for channels in self._channels]
        self._first_group = np.cumsum([0, *groups])
        self._sizes = np.repeat([_texels(scale) for scale in scene.scales], groups, axis=0)
        nx, ny, nz = self._sizes.T
        planes, rows = self._wide * np.stack([nx * ny, nx * nz, ny * nz], axis=1), self._wide * self._sizes
        self._firsts = np.concatenate([_starts(planes), _starts(rows)], axis=1)
        self._planes, self._rows = np.zeros(int(planes.sum()), np.int16), np.ones(int(rows.sum()), np.float32)
        hidden = len(decoder.b1) if decoder.w2.any() else 0
        self._w1, self._b1 = (
            np.ascontiguousarray(decoder.w1[:hidden], np.float32),
            np.asarray(decoder.b1[:hidden], np.float32),
        )
        w2 = np.moveaxis(decoder.w2, 2, 0)[:hidden]
        self._w2 = self._w2_in_steps = self._as_it_lies(np.concatenate([w2, np.zeros_like(w2[:, :1])], axis=1))
        self._weights = self._weights_in_steps = self._as_it_lies(
            np.concatenate([decoder.b2, decoder.density_weight[None]])
        )
        self._seen_from = np.zeros((WORKERS, LANES if hidden else 0, len(self._weights)), np.float32)
        """Each worker's room for weights as its rays see them."""

    @staticmethod
    def serves(scene: Scene) -> bool:
        """Of the explicit decoder, but for device coordinates."""
        return isinstance(scene.decoder, Decoder) and not isinstance(scene.mapping, DeviceCoordinates)

    @staticmethod
    def bytes_for(scene: Scene) -> int:
        taken = 0
        for scale in scene.scales:
            nx, ny, nz = _texels(scale)
            channels = scale["xy"].shape[2]
            taken += (channels + -channels % _wide(scene)) * (
                2 * (nx * ny + nx * nz + ny * nz) + 4 * (nx + ny + nz) + 4 * CHANNELS * WORKERS * LANES
            )
        return taken

    def keep(self, atlas: np.ndarray) -> None:
        steps = []
        for block in self._layout.blocks:
            whole, step = in_steps(self._layout.plane(atlas, block)[..., : self._channels[block.scale]])
            for axis in (0, 1):
                whole = _twice(whole, axis)
            self._put(self._planes, block.scale, SPACE_PLANES.index(block.plane), whole)
            steps.append(step)
        product = [
            np.prod(steps[first : first + len(SPACE_PLANES)], axis=0)
            for first in range(0, len(steps), len(SPACE_PLANES))
        ]
        in_all = self._as_it_lies(np.tile(np.concatenate(product), (CHANNELS, 1)))
        self._w2_in_steps, self._weights_in_steps = (
            np.clip(weights * in_all, -LARGEST, LARGEST).astype(np.float32) for weights in (self._w2, self._weights)
        )
        self.forget()

    def _prepare(self, time: float | None) -> None:
        if time is None:
            self._rows[:] = 1.0
            return
        for number, scale in enumerate(self._scene.scales):
            for axis, name in enumerate(TIME_PLANES):
                self._put(self._rows, number, len(SPACE_PLANES) + axis, _twice(sample_linear(scale[name], time), 0))

    def _looked_at(self, worker: int) -> tuple[Any, Any]:
        b1 = self._b1 + self._code if len(self._b1) else self._b1
        bias = np.float32(self._scene.decoder.density_bias)
        halves = tuple(range(0, self._wide, NARROW))
        weights = self._seen_from[worker] if len(b1) else self._weights_in_steps[None]
        return None, (
            halves, self._planes, self._rows, self._firsts, self._sizes, self._w1, b1, self._w2_in_steps, self._weights_in_steps, bias, weights,
        )  # fmt: skip

    @staticmethod
    def rehearsed(scene: Scene) -> tuple[Any, Any]:
        halves, flat, of_two = (
            tuple(range(0, _wide(scene), NARROW)),
            np.zeros(1, np.float32),
            np.zeros((1, 1), np.float32),
        )
        places = np.zeros((1, 1), np.int64)
        return None, (
            halves,
            np.zeros(1, np.int16),
            flat,
            places,
            places,
            of_two,
            flat,
            of_two,
            flat,
            np.float32(0),
            of_two,
        )

    def _put(self, into: np.ndarray, scale: int, which: int, texels: np.ndarray) -> None:
        """(..., channels) where it lies."""
        for number, group in enumerate(range(self._first_group[scale], self._first_group[scale + 1])):
            part = pad_to_multiple(
                texels[..., self._wide * number : self._wide * (number + 1)], texels.ndim - 1, self._wide
            )
            first = self._firsts[group, which]
            into[first : first + part.size] = part.reshape(-1)

    def _as_it_lies(self, weights: np.ndarray) -> np.ndarray:
        """(..., CHANNELS, F) float64 as (..., CHANNELS F): each group's features of each of the channels."""
        parts = [
            pad_to_multiple(part, part.ndim - 1, self._wide)
            for part in np.split(weights, np.cumsum(self._channels)[:-1], axis=-1)
        ]
        whole = np.concatenate(parts, axis=-1).astype(np.float64)
        grouped = whole.reshape(*whole.shape[:-1], whole.shape[-1] // self._wide, self._wide).swapaxes(-3, -2)
        return np.ascontiguousarray(grouped).reshape(*whole.shape[:-2], math.prod(whole.shape[-2:]))


def _wide(scene: Scene) -> int:
    return NARROW if all(scale["xy"].shape[2] <= NARROW for scale in scene.scales) else WIDE


def _texels(scale: Any) -> tuple[int, int, int]:
    """Along x, y, z; at least two, of which the second is as the first where there is one."""
    return tuple(max(2, scale[plane].shape[axis]) for plane, axis in (("xy", 1), ("xy", 0), ("xz", 0)))  # type: ignore[return-value]


def _twice(texels: np.ndarray, axis: int) -> np.ndarray:
    return np.repeat(texels, 2, axis=axis) if texels.shape[axis] == 1 else texels


def _starts(counts: np.ndarray) -> np.ndarray:
    """Where each begins of what lies one after the other."""
    return np.asarray(np.cumsum(counts).reshape(counts.shape) - counts)
