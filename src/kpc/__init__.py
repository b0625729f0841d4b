"""KPC: 4D video you can fly through.

import kpc

scene = kpc.load("scene.kpc")
picture = kpc.render(scene, scene.cameras[0], time=0.5).rgb     # (H, W, 3) float32
"""

import os
from typing import TYPE_CHECKING, BinaryIO

from kpc.format.common.errors import KpcError
from kpc.format.scene.cameras import Camera
from kpc.format.scene.scene import Scene

if TYPE_CHECKING:
    import numpy as np

    from kpc.format.container.groups import GroupedScene
    from kpc.player.cpu.reference import Rendering

__all__ = ["Camera", "KpcError", "Scene", "load", "render"]


def load(path: "str | os.PathLike[str] | bytes | BinaryIO", memory_budget: int = 2 << 30) -> "Scene | GroupedScene":
    """Read a .kpc file; its planes are numpy arrays by name: `scene.scales[0]["xy"]`.

    A long clip may be in groups, of which one is held at a time, or two that are mixed, and read when a time in it is asked for:
    `scene.at(time)` is the scene of the group that shows, and the time in it.

    Args:
        path: of the file, or its http or https URL; or its bytes, or an open binary file.
        memory_budget: bytes the scene, or one group, may take.

    Raises:
        FormatError: the file is damaged, hostile or of an unknown version; BudgetError if it is too large.
        NetworkError: the server of a URL does not give it.
    """
    from kpc.format.container import groups

    return groups.load(path, memory_budget)


def render(
    scene: "Scene | GroupedScene", camera: Camera, time: float, appearance: "np.ndarray | None" = None
) -> "Rendering":
    """Render one picture with the readable reference renderer; no graphics card is needed.

    Args:
        time: in [0, 1] over the clip.
        appearance: a code, `scene.appearance(name)`, where the scene has any; None for their average. Of a clip in groups, that of
            the group: `scene.at(time)[0].appearance(name)`; then no other is mixed with it.

    Returns:
        `.rgb` (H, W, 3) float32 in [0, 1], `.depth` (H, W), `.opacity` (H, W).
    """
    from kpc.player.cpu import reference

    parts = scene.blend_at(time) if appearance is None else [(*scene.at(time), 1.0)]
    return reference.blend(
        [(reference.render(shown, camera, t, appearance=appearance), share) for shown, t, share in parts]
    )
