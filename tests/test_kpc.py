"""The public interface: load and render."""

import subprocess
import sys

import numpy as np

import kpc
from kpc.encoder.coding.scene_writer import write
from kpc.format.coding.quantise import quantise_scene
from scenes import tiny_scene


def test_the_example_of_the_docstring(tmp_path):
    scene = tiny_scene()
    path = tmp_path / "scene.kpc"
    write(quantise_scene(scene, [dict.fromkeys(scale, 0.01) for scale in scene.scales]), path)
    loaded = kpc.load(path)
    assert loaded.scales[0]["xy"].dtype == np.float32
    picture = kpc.render(loaded, loaded.cameras[0], time=0.5)
    assert picture.rgb.shape == (36, 48, 3) and picture.rgb.dtype == np.float32
    assert 0.0 <= picture.rgb.min() and picture.rgb.max() <= 1.0 and picture.opacity.max() > 0.5


def test_importing_kpc_loads_neither_torch_nor_opengl():
    program = (
        "import sys, kpc, kpc.format.container.scene_io; "
        "print([m for m in ('torch', 'numba', 'moderngl', 'glfw') if m in sys.modules])"
    )
    done = subprocess.run([sys.executable, "-c", program], capture_output=True, text=True, check=True)
    assert done.stdout.strip() == "[]"
