"""What the groups of a clip share: the space planes of scales in which nothing moves, which are coded with the first.

Later groups train and code what moves alone. Their files hold the same planes, byte for byte, which the clip then
stores once (`kpc.format.container.groups.write`). Figures: docs/design/rate-distortion.md, "Groups of a long clip".
"""

from collections.abc import Mapping
from dataclasses import dataclass, field, replace

import numpy as np

from kpc.encoder.rdo.distortion import PlaneKey
from kpc.format.coding.quantise import QuantisedPlane, QuantisedScene
from kpc.format.scene.scene import SPACE_PLANES


@dataclass(frozen=True)
class Sharing:
    """Planes that the groups of a clip share.

    Attributes:
        planes: by scale and name.
        cells: (1, Nz, Ny, Nx) bool, cells of the occupancy in which planes are to hold besides those of the first
            group: things move there in others.
        settled: the planes as the first group has coded them; empty while it is coded itself.
        reach: (Nz, Ny, Nx) bool, the cells in which the planes hold; None while the first group is coded.
    """

    planes: frozenset[PlaneKey]
    cells: np.ndarray
    settled: Mapping[PlaneKey, QuantisedPlane] = field(default_factory=dict)
    reach: np.ndarray | None = None

    @staticmethod
    def of_scales(scales: tuple[int, ...], cells: np.ndarray) -> "Sharing":
        """Return the sharing of all space planes of some scales; `cells`: (Nz, Ny, Nx) bool."""
        return Sharing(frozenset((s, name) for s in scales for name in SPACE_PLANES), cells[None])

    @property
    def scales(self) -> frozenset[int]:
        """The scales of which planes are shared."""
        return frozenset(s for s, _ in self.planes)

    def after(self, first: QuantisedScene) -> "Sharing":
        """Return the sharing for the groups after one that is coded: it settles the planes."""
        settled = {(s, name): first.scales[s][name] for s, name in self.planes}
        return replace(self, settled=settled, reach=np.asarray(first.occupancy.any(0) | self.cells[0]))

    def is_kept_by(self, coded: QuantisedScene) -> bool:
        """Return whether a file holds the settled planes."""
        return all(
            np.array_equal(plane.symbols, (own := coded.scales[s][name]).symbols)
            and np.array_equal(plane.step, own.step)
            and np.array_equal(plane.offset, own.offset)
            for (s, name), plane in self.settled.items()
        )
