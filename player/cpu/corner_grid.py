"""The field by a corner grid, for scenes of many channels with view-independent colour.

The grid holds the logits of the colour and the log density at the corners of the finest scale's texels, and a sample
takes one look-up in it instead of one in each plane for every four channels (36 in `soldier`). It is exact at corners
and linear in between, where the product of three planes is of second degree. Corners are computed when a sample first
needs them. Figures: docs/design/drawing.md.
"""

import numpy as np

from kpc.format.scene.areas import AXES
from kpc.format.scene.grid import sample_linear, texel_and_fraction
from kpc.format.scene.scene import SPACE_PLANES, TIME_PLANES, Scene
from kpc.player.areas import FeatureAreas
from kpc.player.atlas import Layout, pad_to_multiple
from kpc.player.cpu.field_kernels import CornerGridArrays
from kpc.player.cpu.field_sampler import FieldArrays, FieldSampler, quantised_planes
from kpc.player.cpu.lanes import Grid
from kpc.player.cpu.serving import WIDE, grid_bytes, grid_shape, serves_grid
from kpc.player.cpu.simd import LARGEST
from kpc.player.cpu.threads import WORKERS


class CornerGrid(FieldSampler):
    """The corner grid of a scene at a time, as far as samples have looked at it.

    Attributes:
        values: (Nz, Ny, Nx, 4) float32, corner-aligned over [0, 1]^3: logits of red, green and blue, log density. Stale
            where no sample has looked.
    """

    def __init__(self, scene: Scene, layout: Layout) -> None:
        super().__init__(scene, layout)
        self.values = np.zeros((*grid_shape(scene), 4), np.float32)
        # Flags of the corners, as far as each worker knows: workers do not wait for each other.
        self._known = np.zeros((WORKERS, *self.values.shape[:3]), np.uint8)
        self._channels = [scale["xy"].shape[2] for scale in scene.scales]
        self._planes: tuple[np.ndarray, ...] = ()
        # Where each scale counts (`kpc.player.areas.feature_area`), and whether it moved at the last time.
        self._areas = np.zeros((len(self._channels), 2, 3), np.float32)
        self._moved = np.zeros(len(self._channels), bool)
        self._rows: tuple[np.ndarray, ...] = ()
        # Rows of time planes at corners, by plane, scale and number.
        self._corner_rows: dict[tuple[str, int, int], np.ndarray] = {}
        self._corners = {
            axis: np.linspace(0, 1, n, dtype=np.float32) for axis, n in zip("zyx", self.values.shape[:3], strict=True)
        }
        weights = np.concatenate([scene.decoder.b2, scene.decoder.density_weight[None]])
        self._weights = self._scaled_weights = pad_to_multiple(weights.astype(np.float32), 1, WIDE)

    @staticmethod
    def serves(scene: Scene) -> bool:
        return serves_grid(scene)

    @staticmethod
    def bytes_for(scene: Scene) -> int:
        return grid_bytes(scene)

    def set_planes(self, atlas: np.ndarray) -> None:
        planes: dict[str, list[np.ndarray]] = {name: [] for name in SPACE_PLANES}
        for block in self._layout.blocks:
            plane = self._layout.plane(atlas, block)[..., : self._channels[block.scale]]
            across = self._at_corners(plane.swapaxes(0, 1), block.plane[0])
            planes[block.plane].append(self._at_corners(across.swapaxes(0, 1), block.plane[1]))
        weights, quantised = self._weights.astype(np.float64), []
        for parts in planes.values():
            plane = pad_to_multiple(np.concatenate(parts, axis=2), 2, WIDE)
            whole, step = quantised_planes(plane.reshape(-1, plane.shape[2]))
            quantised.append(whole)
            weights = weights * step
        self._planes = tuple(quantised)
        self._scaled_weights = np.clip(weights, -LARGEST, LARGEST).astype(np.float32)
        self._areas = FeatureAreas.of_atlas(self._scene, self._layout, atlas).bounds
        self.time_planes_changed()

    def time_planes_changed(self) -> None:
        super().time_planes_changed()
        self._corner_rows = {}
        self._known[:] = 0

    def _prepare_time(self, time: float | None) -> None:
        assert time is not None, "the static part is drawn by planes"
        self._rows = self._rows_at(time)
        moves = self._moving_scales()
        for area in self._areas[moves | self._moved]:
            self._forget(area)
        self._moved = moves

    def _moving_scales(self) -> np.ndarray:
        """Return whether the rows of each scale are other than 1, (S,) bool."""
        differ = np.any([(rows != 1).any(axis=0) for rows in self._rows], axis=0)[: sum(self._channels)]
        return np.array([part.any() for part in np.split(differ, np.cumsum(self._channels)[:-1])])

    def _forget(self, area: np.ndarray) -> None:
        """Forget the corners in an area (2, 3), and those that know that all corners up to it are computed."""
        inside = []
        for axis, corners in self._corners.items():
            low, high = area[:, AXES.index(axis)]
            inside.append(slice(max(np.searchsorted(corners, low, "right") - 1, 0), np.searchsorted(corners, high)))
        self._known[:, *inside] = 0

    def _arrays(self, worker: int) -> FieldArrays:
        bias, grid = (
            np.float32(self._scene.decoder.density_bias),
            Grid(self.values.reshape(-1, 4), self.values.shape[2::-1]),
        )
        known = self._known[worker].reshape(-1)
        return CornerGridArrays(grid, known, self._planes, self._rows, self._scaled_weights, bias), None

    def _rows_at(self, time: float) -> tuple[np.ndarray, ...]:
        """Return the rows of all scales at a time, at corners, along x, y and z: (N, M) each. Keeps what was made of
        the two rows in time around it for the next picture."""
        scales, kept, rows = self._scene.scales, self._corner_rows, []
        self._corner_rows = {}
        taps = {
            count: texel_and_fraction(np.asarray(time, np.float32), count)
            for count in {len(scale[TIME_PLANES[0]]) for scale in scales}
        }
        for name in TIME_PLANES:
            row = np.zeros((len(self._corners[name[0]]), self._weights.shape[1]), np.float32)
            first = 0
            for number, (scale, channels) in enumerate(zip(scales, self._channels, strict=True)):
                plane = scale[name]  # of a scene that still arrives, only single rows may be there
                before, share = taps[len(plane)]
                for instant, weight in ((int(before), 1 - share), (min(int(before) + 1, len(plane) - 1), share)):
                    key = name, number, instant
                    at_corners = kept.get(key)
                    if at_corners is None:
                        at_corners = self._at_corners(np.asarray(plane[instant], np.float32), name[0])
                    self._corner_rows[key] = at_corners
                    row[:, first : first + channels] += weight * at_corners
                first += channels
            rows.append(row)
        return tuple(rows)

    def _at_corners(self, row: np.ndarray, axis: str) -> np.ndarray:
        """Resample a (size, ...) array that is corner-aligned along x, y or z to the grid's corners."""
        corners = self._corners[axis]
        return row if len(row) == len(corners) else sample_linear(row, corners)
