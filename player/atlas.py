"""A scene's arrays as the shaders want them: one atlas of planes, rows at a time, distances to occupied cells."""

from dataclasses import dataclass

import numpy as np
from kpc.format.common.jit import compiled
from kpc.format.scene.grid import dilate, sample_linear
from kpc.format.scene.scene import SPACE_PLANES, TIME_PLANES, AnyDecoder, HybridDecoder, Scene
from kpc.player.cpu.threads import share_out

FOLDING_AXIS = {"xy": "x", "xz": "z", "yz": "y"}
"""Along which axis of a plane a row is folded into it: each axis once."""
FARTHEST = 255
"""Distances are stored in a byte."""
WORTH_SHARING = 1 << 19
"""Numbers to multiply: a millisecond's work, or two, of one core."""
LARGEST_FLOAT = np.float32(3.4e38)
"""What float32 can hold."""


@dataclass(frozen=True)
class Block:
    """Where a plane of a scale lies in an atlas: its layers of four channels side by side, each `width` texels wide."""

    scale: int
    plane: str
    x: int
    y: int
    width: int
    height: int

    @property
    def upright(self) -> bool:
        """Whether the row that is folded into the plane runs along its rows, else along its columns."""
        return FOLDING_AXIS[self.plane] == self.plane[1]


@dataclass(frozen=True)
class Layout:
    """How a scene's planes share one texture, the atlas.

    Attributes:
        layers: of each scale, texels of four channels that its features fill.
        size: (width, height) of the atlas, texels.
        blocks: scale by scale, "xy", "xz", "yz".
        refined: texels to one of the plane's, along FOLDED_AXIS; 1 but for planes that rows are to be multiplied into.
    """

    layers: tuple[int, ...]
    size: tuple[int, int]
    blocks: tuple[Block, ...]
    refined: int

    @staticmethod
    def of(scene: Scene, refined: int = 1) -> "Layout":
        """Shelves, tallest block first, in a texture about as wide as it is high."""
        layers = tuple(-(-scale["xy"].shape[2] // 4) for scale in scene.scales)
        shapes: list[tuple[int, str, int, int]] = []
        for s, scale in enumerate(scene.scales):
            for name in SPACE_PLANES:
                size = {name[1]: scale[name].shape[0], name[0]: scale[name].shape[1]}
                size[FOLDING_AXIS[name]] = refined * (size[FOLDING_AXIS[name]] - 1) + 1
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
        return Layout(layers, (width, y + shelf), blocks, refined)

    @property
    def scales(self) -> int:
        return len(self.layers)

    @property
    def features(self) -> int:
        """Layers of all scales."""
        return sum(self.layers)

    @property
    def first_layers(self) -> tuple[int, ...]:
        """Of each scale, where its layers begin among those of all."""
        return tuple(int(n) for n in np.cumsum((0, *self.layers[:-1])))

    @staticmethod
    def texels(plane: np.ndarray) -> np.ndarray:
        """(rows, layers * columns, 4) float32: a (rows, columns, M) plane as it lies in its block."""
        rows, columns, _ = plane.shape
        padded = pad_to_multiple(plane.astype(np.float32), 2)
        return np.ascontiguousarray(padded.reshape(rows, columns, -1, 4).swapaxes(1, 2)).reshape(rows, -1, 4)

    def place(self, block: Block) -> tuple[float, float, float, float]:
        """As shares of the atlas: where the middle of a block's first texel lies, and how far from it that of a layer's last."""
        width, height = self.size
        return (block.x + 0.5) / width, (block.y + 0.5) / height, (block.width - 1) / width, (block.height - 1) / height

    def block(self, scale: int, plane: str) -> Block:
        return self.blocks[3 * scale + SPACE_PLANES.index(plane)]

    def part(self, block: Block) -> tuple[slice, slice]:
        """Where a block lies in an atlas that is an array of (height, width)."""
        return slice(block.y, block.y + block.height), slice(block.x, block.x + self.layers[block.scale] * block.width)

    def plane(self, atlas: np.ndarray, block: Block) -> np.ndarray:
        """(rows, columns, 4 layers): the plane of a block in an atlas of (height, width, 4)."""
        plane = atlas[self.part(block)].reshape(block.height, -1, block.width, 4).swapaxes(1, 2)
        return np.ascontiguousarray(plane).reshape(*plane.shape[:2], -1)

    def lines(self, block: Block) -> slice:
        """The lines of the rows' texture that are folded into a block, a layer each."""
        first = self.first_row("xyz".index(FOLDING_AXIS[block.plane]), block.scale)
        return slice(first, first + self.layers[block.scale])

    def row_count(self) -> int:
        return 3 * self.features

    def first_row(self, axis: int, scale: int) -> int:
        """The line of the rows' texture that holds layer 0 of an axis (0, 1, 2 for x, y, z) at a scale."""
        return axis * self.features + self.first_layers[scale]


class TimeRows:
    """The time planes of a scene, ready to be cut: at a time, each is one row along x, y or z.

    Bilinear interpolation is separable, so that interpolating in time first, once a frame, loses nothing.
    """

    def __init__(self, scene: Scene, layout: Layout) -> None:
        self._layout = layout
        self._planes = [
            (axis, s, scale[name]) for s, scale in enumerate(scene.scales) for axis, name in enumerate(TIME_PLANES)
        ]
        self.width = max(plane.shape[1] for *_, plane in self._planes)

    def at(self, time: float, refined: int = 1) -> np.ndarray:
        """(lines, refined (width - 1) + 1, 4) float32 at `time` in [0, 1], so many texels to one of the scene's; anything beyond a
        row's end."""
        out = np.ones((self._layout.row_count(), self.width, 4), np.float32)
        for axis, scale, plane in self._planes:
            row = sample_linear(plane, time)
            layers = self._layout.layers[scale]
            padded = np.ones((len(row), layers * 4), np.float32)
            padded[:, : row.shape[1]] = row
            first = self._layout.first_row(axis, scale)
            out[first : first + layers, : len(row)] = padded.reshape(len(row), layers, 4).swapaxes(0, 1)
        finer = np.empty((len(out), refined * (self.width - 1) + 1, 4), np.float32)
        for between in range(refined):
            share = np.float32(between / refined)
            finer[:, between::refined] = out if between == 0 else (1 - share) * out[:, :-1] + share * out[:, 1:]
        return finer


def multiplied(refined: np.ndarray, rows: np.ndarray, layout: Layout, block: Block, room: np.ndarray) -> np.ndarray:
    """fold.glsl by the processor: a block of a refined atlas, (height, width, 4) float32, times the `TimeRows` of a time. In `room`, for as many
    numbers."""
    plane, row = refined[layout.part(block)], rows[layout.lines(block)]
    product = room[: plane.size].reshape(plane.shape)

    def multiply(part: slice) -> None:
        _multiply(plane[part], row[:, part] if block.upright else row, block.width, block.upright, product[part])

    if plane.size < WORTH_SHARING:
        multiply(slice(None))
    else:
        share_out(multiply, block.height)
    return product


@compiled()
def _multiply(plane, rows, width, upright, product):
    """Of one plane; `upright`: the row runs along its rows. Numbers that overflow come out as the largest there is."""
    for y in range(plane.shape[0]):
        for layer in range(len(rows)):
            for x in range(width):
                along, column = y if upright else x, layer * width + x
                for channel in range(4):
                    number = plane[y, column, channel] * rows[layer, along, channel]
                    product[y, column, channel] = min(max(number, -LARGEST_FLOAT), LARGEST_FLOAT)


def empty_distances(occupied: np.ndarray) -> np.ndarray:
    """Chebyshev distance of each cell of a (Nz, Ny, Nx) bool grid to the nearest that is set: uint8, at most 255.

    A cell at distance D is the middle of a block of 2 D - 1 cells a side in which none is set.
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


def decoder_shape(decoder: AnyDecoder) -> dict[str, int]:
    """What march.glsl is told of it."""
    if isinstance(decoder, HybridDecoder):
        hidden_4, width_4 = -(-len(decoder.b1) // 4), -(-len(decoder.v_bias) // 4)
        return {"HYBRID": 1, "HIDDEN": 4 * hidden_4, "HIDDEN_4": hidden_4, "WIDTH": 4 * width_4, "WIDTH_4": width_4}
    return {"HYBRID": 0, "HIDDEN": len(decoder.b1) if decoder.w2.any() else 0, "HIDDEN_4": 0, "WIDTH_4": 0}


def planes_shape(layout: Layout) -> dict[str, int]:
    """What march.glsl is told of the planes."""
    layers = {f"LAYERS_{scale}": count for scale, count in enumerate(layout.layers)}
    first = {f"FIRST_{scale}": number for scale, number in enumerate(layout.first_layers)}
    return {"SCALES": layout.scales, "FEATURES": layout.features, "BASIS": 3 * layout.features} | layers | first


def decoder_arrays(decoder: AnyDecoder, scene: Scene, layout: Layout) -> dict[str, np.ndarray]:
    """The decoder's weights as march.glsl wants them, (N, 4) float32 each, features in the padded layout of the planes.

    Explicit: density_weight (F / 4), w1 (H x 3: nine columns, then b1, then zeros), w2 (3 x F / 4 x H), b2 (3 x F / 4),
    density_bias (1, in x). Without w1 and w2 where colour is the same from all sides, w2 being 0.

    Hybrid, with G and H filled up with zeros to multiples of four: from_features (G x F / 4) is v, from_features_bias (G / 4)
    v_bias, passed_on (H x G / 4) u; density_weight (G / 4), w1 (H x 3), w2 (3 x H / 4), b2 (1, in xyz), density_bias as above.
    """
    features = layout.features * 4
    place = np.concatenate(
        [
            4 * first + np.arange(scale["xy"].shape[2])
            for first, scale in zip(layout.first_layers, scene.scales, strict=True)
        ]
    )

    def spread(weights: np.ndarray) -> np.ndarray:
        out = np.zeros((*weights.shape[:-1], features), np.float32)
        out[..., place] = weights
        return out.reshape(*weights.shape[:-1], features // 4, 4)

    arrays = {"density_bias": np.array([decoder.density_bias, 0, 0, 0])}
    if isinstance(decoder, HybridDecoder):
        arrays |= {
            "from_features": pad_to_multiple(spread(decoder.v), 0),
            "from_features_bias": pad_to_multiple(decoder.v_bias, 0),
            "density_weight": pad_to_multiple(decoder.density_weight, 0),
            "w1": _direction_layer(decoder),
            "passed_on": pad_to_multiple(pad_to_multiple(decoder.u, 0), 1),
            "w2": pad_to_multiple(decoder.w2, 1),
            "b2": np.append(decoder.b2, 0),
        }
    else:
        arrays |= {"density_weight": spread(decoder.density_weight), "b2": spread(decoder.b2)}
        if decoder.w2.any():
            arrays["w1"] = _direction_layer(decoder)[: len(decoder.b1)]
            arrays["w2"] = np.moveaxis(spread(np.moveaxis(decoder.w2, 2, 0)), 0, 2)
    return {name: np.ascontiguousarray(array, np.float32).reshape(-1, 4) for name, array in arrays.items()}


def block_arrays(scene: Scene, layout: Layout) -> dict[str, np.ndarray]:
    """Where planes lie in an atlas, as march.glsl wants it: float32 (N, 4) and (N,), int32 (N,).

    Of each plane, blocks (3 x scales) as `Layout.place`, layer_widths the share of the atlas that a layer is wide; of each scale,
    last_texels that of its unrefined planes along x, y and z, and first_layers.
    """
    sizes = [(s["xy"].shape[1] - 1, s["xy"].shape[0] - 1, s["xz"].shape[0] - 1, 0) for s in scene.scales]
    return {
        "blocks": np.array([layout.place(block) for block in layout.blocks], np.float32),
        "layer_widths": np.array([block.width / layout.size[0] for block in layout.blocks], np.float32),
        "last_texels": np.array(sizes, np.float32),
        "first_layers": np.array(layout.first_layers, np.int32),
    }


def _direction_layer(decoder: AnyDecoder) -> np.ndarray:
    """w1 and b1, (H, 12), H filled up to a multiple of four."""
    return pad_to_multiple(np.concatenate([decoder.w1, decoder.b1[:, None], np.zeros((len(decoder.b1), 2))], axis=1), 0)


def pad_to_multiple(array: np.ndarray, axis: int, multiple: int = 4) -> np.ndarray:
    """With zeros added along an axis up to a multiple of four, or of another number; itself where that is so already."""
    if array.shape[axis] % multiple == 0:
        return array
    ends = [(0, 0)] * array.ndim
    ends[axis] = 0, -array.shape[axis] % multiple
    return np.pad(array, ends)
