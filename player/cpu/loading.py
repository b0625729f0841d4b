"""Loading of the processor's renderer while shaders draw.

Numba takes a second to import and its kernels up to a minute to compile, and it holds the interpreter lock all the
while. So a thread loads what is in numba's cache, and another process compiles what is not.
"""

import atexit
import pickle
import subprocess
import sys
import threading
from dataclasses import replace
from typing import Any

import numpy as np

from kpc.format.scene.metadata import Metadata
from kpc.format.scene.scene import Scene
from kpc.player.cpu.serving import is_installed, serves, serves_grid

# Texels a side of the planes, and cells a side of the grids, of what `sketch` returns.
SIDE = 4
# Seconds to wait for the end of the process before an error of the thread is reported.
ENDING_S = 2.0


class Loading:
    """The loading of the kernels for scenes of one kind.

    Attributes:
        is_done: whether they are loaded.
    """

    def __init__(self) -> None:
        self.is_done = False

    def begin(self, scene: Scene) -> None:
        """Load them in a thread."""
        threading.Thread(target=self._run_in_thread, args=(sketch(scene),), name="loading kernels", daemon=True).start()

    def _run_in_thread(self, scene: Scene) -> None:
        """Load them, and end without a word where that fails because the process ends: then pools take no more work."""
        main = threading.main_thread()
        try:
            self.run(scene)
        except BaseException:
            main.join(ENDING_S)
            if main.is_alive():
                raise

    def run(self, scene: Scene) -> None:
        """Load them; those that are not in numba's cache are compiled by another process first."""
        from kpc.jit import NotCachedError, only_cached
        from kpc.player.cpu.kernel_warm_up import warm_up_kernels

        try:
            with only_cached():
                warm_up_kernels(scene)
        except NotCachedError:
            compile_elsewhere(scene)
            warm_up_kernels(scene)  # where numba's cache cannot be written, this compiles
        self.is_done = True


_begun: dict[Any, Loading] = {}


def loading_for(scene: Scene) -> Loading:
    """Return the loading of a scene's kernels, which begins now if it has not begun."""
    kind = kind_of(scene)
    if kind not in _begun:
        _begun[kind] = Loading()
        _begun[kind].begin(scene)
    return _begun[kind]


def is_loaded(scene: Scene) -> bool:
    """Return whether a scene's kernels are loaded."""
    loading = _begun.get(kind_of(scene))
    return loading is not None and loading.is_done


def load(scene: Scene) -> None:
    """Load a scene's kernels before this returns, if the processor can draw it."""
    if not is_installed() or not serves(scene):
        return
    loading = _begun.setdefault(kind_of(scene), Loading())
    if not loading.is_done:
        loading.run(sketch(scene))


def kind_of(scene: Scene) -> tuple[Any, ...]:
    """Return what the types of a scene's kernels depend on."""
    channels = tuple(scale["xy"].shape[2] for scale in scene.scales)
    has_direction = bool(scene.decoder.w2.any())
    return (
        *(scene.is_dynamic, scene.motion is not None, type(scene.mapping), channels),
        *(has_direction, serves_grid(scene), len(scene.occupancy) > 1),
    )


def sketch(scene: Scene) -> Scene:
    """Return a scene of the same kind and hardly any size, in which nothing moves and no cell is empty."""
    scales = tuple(
        {
            name: np.full((*(min(side, SIDE) for side in plane.shape[:2]), plane.shape[2]), "t" in name, np.float32)
            for name, plane in scale.items()
        }
        for scale in scene.scales
    )
    occupancy = np.ones([min(side, SIDE) for side in scene.occupancy.shape], bool)
    motion = None
    if scene.motion is not None:
        motion = np.zeros((*(min(side, SIDE) for side in scene.motion.shape[:4]), 3), np.float32)
    return replace(
        scene,
        scales=scales,
        occupancy=occupancy,
        motion=motion,
        cameras=scene.cameras[:1],
        appearances=(),
        metadata=Metadata(),
        sound=None,
    )


def compile_elsewhere(scene: Scene) -> None:
    """Have another process compile a scene's kernels into numba's cache, and wait for it."""
    command = [sys.executable, "-m", "kpc.player.cpu.kernel_warm_up"]
    process = subprocess.Popen(command, stdin=subprocess.PIPE, stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL)
    atexit.register(process.kill)
    process.communicate(pickle.dumps(scene))
    atexit.unregister(process.kill)
