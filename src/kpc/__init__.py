"""KPC: 4D video you can fly through.

    import kpc

    scene = kpc.load("scene.kpc")
    picture = kpc.render(scene, scene.cameras[0], time=0.5).rgb     # (H, W, 3) float32
"""

import os
from typing import TYPE_CHECKING, BinaryIO

from kpc.format.cameras import Camera
from kpc.format.errors import KpcError
from kpc.format.scene import Scene

if TYPE_CHECKING:
    import numpy as np

    from kpc.player.reference import Rendering

__all__ = ["Camera", "KpcError", "Scene", "load", "render"]


def load(path: "str | os.PathLike[str] | bytes | BinaryIO", memory_budget: int = 2 << 30) -> Scene:
    """Read a .kpc file; its planes are numpy arrays by name: `scene.scales[0]["xy"]`.

    Args:
        path: of the file, or its http or https URL; or its bytes, or an open binary file.
        memory_budget: bytes the scene may take.

    Raises:
        FormatError: the file is damaged, hostile or of an unknown version; BudgetError if it is too large.
        NetworkError: the server of a URL does not give it.
    """
    from kpc.format.file import read

    return read(path, memory_budget=memory_budget).dequantise()


def render(scene: Scene, camera: Camera, time: float, appearance: "np.ndarray | None" = None) -> "Rendering":
    """Render one picture with the readable reference renderer; no graphics card is needed.

    Args:
        time: in [0, 1] over the clip.
        appearance: a code, `scene.appearance(name)`, where the scene has any; None for their average.

    Returns:
        `.rgb` (H, W, 3) float32 in [0, 1], `.depth` (H, W), `.opacity` (H, W).
    """
    from kpc.player import reference

    return reference.render(scene, camera, time, appearance=appearance)
