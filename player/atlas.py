"""A scene's planes as one array: the layout that textures on a graphics card and the processor's code share.

An *atlas* is a (height, width, 4) array that holds all space planes; the block of a plane holds its layers of four
channels side by side. Time
planes are not in it: at one time each of them is a row along x, y or z (`TimeRows`).
"""

from dataclasses import dataclass

import numpy as np

from kpc.format.scene.grid import dilate, sample_linear
from kpc.format.scene.scene import SPACE_PLANES, TIME_PLANES, Scene

# The axis of each space plane along which a time row is folded into it: each axis once.
FOLDING_AXIS = {"xy": "x", "xz": "z", "yz": "y"}
# Distances to occupied cells are stored in one byte.
FARTHEST = 255


@dataclass(frozen=True)
class Block:
    """Where a plane of a scale lies in an atlas.

    Attributes:
        scale: number of the scale, from the coarsest on.
        plane: name of the space plane.
        x, y: first column and row, texels.
        width, height: of one layer of four channels, texels; the layers lie side by side.
    """

    scale: int
    plane: str
    x: int
    y: int
    width: int
    height: int

    @property
    def is_folded_along_rows(self) -> bool:
        """Whether the time row that is folded into the plane has one value for each row of it, else one for each
        column."""
        return FOLDING_AXIS[self.plane] == self.plane[1]


@dataclass(frozen=True)
class Layout:
    """How a scene's space planes share one atlas.

    Attributes:
        layers: layers of four channels that the features of each scale fill.
        size: (width, height) of the atlas, texels.
        blocks: scale by scale, "xy", "xz", "yz".
        upsampling: texels to one of the plane's along FOLDING_AXIS; 1 but for planes that time rows are folded into.
    """

    layers: tuple[int, ...]
    size: tuple[int, int]
    blocks: tuple[Block, ...]
    upsampling: int

    @staticmethod
    def of(scene: Scene, upsampling: int = 1) -> "Layout":
        """Pack the blocks on shelves, tallest first, into an atlas about as wide as it is high."""
        layers = tuple(-(-scale["xy"].shape[2] // 4) for scale in scene.scales)
        shapes: list[tuple[int, str, int, int]] = []
        for s, scale in enumerate(scene.scales):
            for name in SPACE_PLANES:
                size = {name[1]: scale[name].shape[0], name[0]: scale[name].shape[1]}
                size[FOLDING_AXIS[name]] = upsampling * (size[FOLDING_AXIS[name]] - 1) + 1
                shapes.append((s, name, size[name[1]], size[name[0]]))
        area = sum(rows * columns * layers[s] for s, _, rows, columns in shapes)
        width = max(int(np.ceil(np.sqrt(area))), max(columns * layers[s] for s, *_, columns in shapes))
        placed: dict[tuple[int, str], Block] = {}
        x, y, shelf = 0, 0, 0
        for s, name, rows, columns in sorted(shapes, key=lambda shape: -shape[2]):
            if x + columns * layers[s] > width:
                x, y, shelf = 0, y + shelf, 0
            placed[s, name] = Block(s, name, x, y, columns, rows)
            x, shelf = x + columns * layers[s], max(shelf, rows)
        blocks = tuple(placed[s, name] for s, name, *_ in shapes)
        return Layout(layers, (width, y + shelf), blocks, upsampling)

    @property
    def scales(self) -> int:
        return len(self.layers)

    @property
    def features(self) -> int:
        """Layers of all scales."""
        return sum(self.layers)

    @property
    def first_layers(self) -> tuple[int, ...]:
        """For each scale, the number of its first layer among those of all scales."""
        return tuple(int(n) for n in np.cumsum((0, *self.layers[:-1])))

    @staticmethod
    def texels(plane: np.ndarray) -> np.ndarray:
        """Return a (rows, columns, M) plane as it lies in its block: (rows, layers * columns, 4) float32."""
        rows, columns, _ = plane.shape
        whole = pad_to_multiple(plane.astype(np.float32), 2)
        return np.ascontiguousarray(whole.reshape(rows, columns, -1, 4).swapaxes(1, 2)).reshape(rows, -1, 4)

    def texture_rectangle(self, block: Block) -> tuple[float, float, float, float]:
        """Return, as shares of the atlas, the centre (x, y) of a block's first texel and the offset (x, y) from there
        to a layer's last one."""
        width, height = self.size
        return (block.x + 0.5) / width, (block.y + 0.5) / height, (block.width - 1) / width, (block.height - 1) / height

    def block(self, scale: int, plane: str) -> Block:
        return self.blocks[3 * scale + SPACE_PLANES.index(plane)]

    def cut(self, atlas: np.ndarray, block: Block) -> np.ndarray:
        """Return a view of a block of a (height, width, 4) atlas: `texels` of its plane."""
        columns = self.layers[block.scale] * block.width
        return atlas[block.y : block.y + block.height, block.x : block.x + columns]

    def plane(self, atlas: np.ndarray, block: Block) -> np.ndarray:
        """Return the plane of a block of a (height, width, 4) atlas: (rows, columns, 4 layers)."""
        plane = self.cut(atlas, block).reshape(block.height, -1, block.width, 4).swapaxes(1, 2)
        return np.ascontiguousarray(plane).reshape(*plane.shape[:2], -1)

    def lines(self, block: Block) -> slice:
        """Return the lines of `TimeRows.at` that are folded into a block, one for each layer."""
        first = self.first_line("xyz".index(FOLDING_AXIS[block.plane]), block.scale)
        return slice(first, first + self.layers[block.scale])

    @property
    def line_count(self) -> int:
        """Lines of `TimeRows.at`."""
        return 3 * self.features

    def first_line(self, axis: int, scale: int) -> int:
        """Return the line of `TimeRows.at` that holds layer 0 of an axis (0, 1, 2 for x, y, z) at a scale."""
        return axis * self.features + self.first_layers[scale]


class TimeRows:
    """The time planes of a scene; at one time, each of them is one row along x, y or z.

    Bilinear interpolation is separable, so interpolating in time first, once a frame, loses nothing.
    """

    def __init__(self, scene: Scene, layout: Layout) -> None:
        self._layout = layout
        self._planes = [
            (axis, s, scale[name]) for s, scale in enumerate(scene.scales) for axis, name in enumerate(TIME_PLANES)
        ]
        self.width = max(plane.shape[1] for *_, plane in self._planes)

    def at(self, time: float, upsampling: int = 1) -> np.ndarray:
        """Return the rows at `time` in [0, 1]: (lines, upsampling (width - 1) + 1, 4) float32; beyond the end of a row
        anything."""
        out = np.ones((self._layout.line_count, self.width, 4), np.float32)
        for axis, scale, plane in self._planes:
            row = sample_linear(plane, time)
            layers = self._layout.layers[scale]
            whole = np.ones((len(row), layers * 4), np.float32)
            whole[:, : row.shape[1]] = row
            first = self._layout.first_line(axis, scale)
            out[first : first + layers, : len(row)] = whole.reshape(len(row), layers, 4).swapaxes(0, 1)
        finer = np.empty((len(out), upsampling * (self.width - 1) + 1, 4), np.float32)
        for between in range(upsampling):
            share = np.float32(between / upsampling)
            finer[:, between::upsampling] = out if between == 0 else (1 - share) * out[:, :-1] + share * out[:, 1:]
        return finer


def empty_distances(occupied: np.ndarray) -> np.ndarray:
    """Return the Chebyshev distance of each cell to the nearest occupied one, so that rays can skip empty space.

    A cell at distance D is the middle of a block of 2 D - 1 cells a side that are all empty.

    Args:
        occupied: (Nz, Ny, Nx) bool.

    Returns:
        (Nz, Ny, Nx) uint8, at most FARTHEST.
    """
    out = np.where(occupied, 0, FARTHEST).astype(np.uint8)
    reached = occupied
    for distance in range(1, FARTHEST):
        wider = dilate(reached)
        fresh = wider & ~reached
        if not fresh.any():
            break
        out[fresh] = distance
        reached = wider
    return out


def pad_to_multiple(array: np.ndarray, axis: int, multiple: int = 4) -> np.ndarray:
    """Return an array with zeros appended along an axis up to a multiple; the array itself where its size is one."""
    if array.shape[axis] % multiple == 0:
        return array
    ends = [(0, 0)] * array.ndim
    ends[axis] = 0, -array.shape[axis] % multiple
    return np.pad(array, ends)
