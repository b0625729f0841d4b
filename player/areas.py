"""Where renderers look scales up: where their features may be other than 0 (`kpc.format.scene.areas`)."""

from collections.abc import Mapping

import numpy as np

from kpc.format.scene.areas import AXES, area_texels
from kpc.format.scene.scene import SPACE_PLANES, TIME_PLANES, Scene
from kpc.player.atlas import Layout

# Beyond all positions in [0, 1], on either side.
BELOW, ABOVE = -1.0, 2.0


class FeatureAreas:
    """The areas of a scene's scales, as far as its space planes have been put; those made for the whole box have that.

    Args:
        layout: of the planes' atlas, without upsampling.

    Attributes:
        bounds: (S, 2, 3) float32, `feature_area` of each scale.
    """

    def __init__(self, scene: Scene, layout: Layout) -> None:
        self.bounds = np.full((layout.scales, 2, len(AXES)), BELOW, np.float32)
        self.bounds[:, 1] = ABOVE
        self._used: dict[int, dict[str, np.ndarray]] = {}
        for scale in np.flatnonzero(may_be_parts(scene)).tolist():
            blocks = [layout.block(scale, name) for name in SPACE_PLANES]
            self._used[scale] = {block.plane: np.zeros((block.height, block.width), bool) for block in blocks}
            self.bounds[scale] = feature_area(self._used[scale])

    @staticmethod
    def of_atlas(scene: Scene, layout: Layout, atlas: np.ndarray) -> "FeatureAreas":
        """Return the areas by all planes of a (height, width, 4) atlas."""
        areas = FeatureAreas(scene, layout)
        for block in layout.blocks:
            areas.put(block.scale, block.plane, layout.cut(atlas, block))
        return areas

    def put(self, scale: int, plane: str, texels: np.ndarray, first: int = 0) -> None:
        """Take note of rows of a space plane from row `first` on, as `Layout.texels` gives them."""
        if scale not in self._used:
            return
        used = self._used[scale][plane]
        rows, columns = len(texels), used.shape[1]
        used[first : first + rows] = texels.reshape(rows, -1, columns, 4).any(axis=(1, 3))
        self.bounds[scale] = feature_area(self._used[scale])


def feature_area(used: Mapping[str, np.ndarray]) -> np.ndarray:
    """Return between which positions a scale's features may be other than 0.

    Args:
        used: of each space plane (rows, columns) bool, whether a texel is other than 0 in a channel.

    Returns:
        (2, 3) float32 along x, y and z: the position of the last texel before that is 0, and of the first behind; BELOW
        and ABOVE where there is none, ABOVE and BELOW where all is 0.
    """
    texels = area_texels(used)
    if texels is None:
        return np.repeat(np.array([[ABOVE], [BELOW]], np.float32), len(AXES), axis=1)
    last = np.array([used["xy"].shape[1], *used["yz"].shape[::-1]]) - 1
    low, high = texels.T
    spaces = np.maximum(last, 1)
    area = np.where(low > 0, (low - 1) / spaces, BELOW), np.where(high < last, (high + 1) / spaces, ABOVE)
    return np.array(area, np.float32)


def may_be_parts(scene: Scene) -> tuple[bool, ...]:
    """Return for each scale whether it may have been made for a part of the box: scales for what moves have more time
    rows than others. Known before any plane has arrived, so shaders are compiled once."""
    rows = [len(scale[TIME_PLANES[0]]) if scene.is_dynamic else 0 for scale in scene.scales]
    return tuple(count > min(rows) for count in rows)
