"""KPC: a codec and player for 4D radiance fields.

import kpc

scene = kpc.load("scene.kpc")
picture = kpc.render(scene, scene.cameras[0], time=0.5).rgb     # (H, W, 3) float32
"""

import os
from importlib import import_module

# Threads of OpenMP, which numba and PyTorch read this for as they are loaded, sleep while they wait. GNU's spin by
# default: two encodes at once, on two cores, then train for three times as long.
os.environ.setdefault("OMP_WAIT_POLICY", "passive")

TYPE_CHECKING = False  # as in typing, whose import would take longer than all else here, while Ctrl-C ends nothing yet
if TYPE_CHECKING:
    from typing import Any, BinaryIO

    import numpy as np

    from kpc.format.common.errors import KpcError
    from kpc.format.common.version import VERSION as __version__
    from kpc.format.container.groups import GroupedScene
    from kpc.format.scene.cameras import Camera
    from kpc.format.scene.scene import Scene
    from kpc.player.cpu.reference import Rendering

__all__ = ["Camera", "KpcError", "Scene", "__version__", "load", "render"]

# Where names are that are loaded when they are used, so that commands start before numpy is loaded.
_HOMES = {
    "Camera": "kpc.format.scene.cameras.Camera",
    "KpcError": "kpc.format.common.errors.KpcError",
    "Scene": "kpc.format.scene.scene.Scene",
    "__version__": "kpc.format.common.version.VERSION",
}


def __getattr__(name: str) -> "Any":
    """Load a name of `_HOMES`."""
    if name not in _HOMES:
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    module, _, attribute = _HOMES[name].rpartition(".")
    return getattr(import_module(module), attribute)


def load(path: "str | os.PathLike[str] | bytes | BinaryIO", memory_budget: int = 2 << 30) -> "Scene | GroupedScene":
    """Read a .kpc file into numpy arrays, such as `scene.scales[0]["xy"]`.

    A long clip may consist of groups. They are read when a time within them is needed, and one is held at a time, or
    two while they are blended: `scene.at(time)` returns the `Scene` of the group shown at a time, and the time within
    it.

    Args:
        path: of the file, or its http or https URL, or its bytes, or an open binary file.
        memory_budget: the most bytes that the scene, or one group, may take in memory.

    Raises:
        FormatError: the file is damaged, hostile or of an unsupported version.
        BudgetError: the scene is larger than `memory_budget`.
        NetworkError: the server of a URL does not deliver the file.
    """
    from kpc.format.container import groups

    return groups.load(path, memory_budget)


def render(
    scene: "Scene | GroupedScene", camera: "Camera", time: float, appearance: "np.ndarray | None" = None
) -> "Rendering":
    """Render one picture with the reference renderer in numpy; no graphics card is needed.

    Args:
        scene: from `load`.
        camera: its size is that of the picture.
        time: in [0, 1] over the clip.
        appearance: a code, `scene.appearance(name)`; None for the average look. For a clip in groups it is a code of
            the group shown, `scene.at(time)[0].appearance(name)`, and that group is not blended with its neighbour.

    Returns:
        A `Rendering` with `rgb` (H, W, 3) float32 in [0, 1], `depth` (H, W) and `opacity` (H, W).
    """
    from kpc.player.cpu import reference

    parts = scene.blend_at(time) if appearance is None else [(*scene.at(time), 1.0)]
    return reference.blend(
        [(reference.render(shown, camera, t, appearance=appearance), weight) for shown, t, weight in parts]
    )
