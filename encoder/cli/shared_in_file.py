"""Planes that the groups of a file share, while the file is coded anew group by group."""

from collections.abc import Sequence
from dataclasses import dataclass, field

import numpy as np

from kpc.encoder.cli.grouped import options_of_group, plane_bytes
from kpc.encoder.cli.options import Options
from kpc.encoder.rdo.codec_model import CodedModel
from kpc.encoder.rdo.distortion import PlaneKey
from kpc.encoder.rdo.rate_control import Trade
from kpc.encoder.rdo.sharing import Sharing
from kpc.format.coding.quantise import QuantisedPlane, looked_up_cells
from kpc.format.container import scene_io
from kpc.format.container.groups import Groups, Span
from kpc.format.scene.scene import ALL_PLANES


@dataclass
class SharedInFile:
    """What groups share, and how it has been coded so far.

    Attributes:
        places: of each group, where the planes that it shares lie in the file, by scale and name.
        cells: of each group, (Nz, Ny, Nx) bool, the cells in which it looks planes up; None where it shares none.
        still_share: share of the first group's bytes that others share.
        sizes: bytes of each plane by where it lies, as far as they are known those of the new coding.
        settled: planes that are coded already, by where they lay.
    """

    places: list[dict[PlaneKey, int]]
    cells: list[np.ndarray | None]
    still_share: float
    sizes: dict[int, int]
    settled: dict[int, QuantisedPlane] = field(default_factory=dict)

    @staticmethod
    def find(source: Groups) -> "SharedInFile":
        """Find what the groups of a file share."""
        places: list[dict[PlaneKey, int]] = []
        cells: list[np.ndarray | None] = []
        sizes: dict[int, int] = {}
        for number in range(len(source)):
            reader = source.open(number)
            own = [reader.index[chunk] for chunk in reader.beside]
            places.append({(entry.scale, ALL_PLANES[entry.plane]): entry.offset for entry in own})
            sizes |= {entry.offset: entry.stored_length for entry in own}
            cells.append(np.asarray(looked_up_cells(scene_io.read(reader).dequantise()).any(0)) if own else None)
        elsewhere = {place for own in places[1:] for place in own.values()}
        still = sum(sizes[place] for place in places[0].values() if place in elsewhere)
        return SharedInFile(places, cells, still / source.whole(0).size, sizes)

    def of_group(self, number: int) -> Sharing | None:
        """Return what a group shares with those before and after it; None for nothing."""
        own = self.places[number]
        users = [
            cells
            for places, cells in zip(self.places, self.cells, strict=True)
            if cells is not None and not set(places.values()).isdisjoint(own.values())
        ]
        if not users or any(cells.shape != users[0].shape for cells in users):
            return None
        settled = {key: self.settled[place] for key, place in own.items() if place in self.settled}
        return Sharing(frozenset(own), np.any(users, axis=0)[None], settled)

    def trade_of(self, options: Options, number: int, spans: Sequence[Span], alone: bool = False) -> Trade:
        """Return the target of a group, of all of which `options.trade` is the target.

        Args:
            options: of the file.
            number: of the group.
            spans: the frames of each.
            alone: whether to leave out the bytes of planes that groups before it share with it.
        """
        before = set() if alone else {place for places in self.places[:number] for place in places.values()}
        shared = sum(self.sizes[place] for place in self.places[number].values() if place in before)
        return options_of_group(options, number, spans, self.still_share, shared).trade

    def settle(self, number: int, coded: CodedModel) -> None:
        """Take over the planes that a group shares from its coding."""
        sizes = plane_bytes(coded.data)
        for (s, name), place in self.places[number].items():
            self.sizes[place] = sizes[s, name]
            self.settled[place] = coded.scene.scales[s][name]
