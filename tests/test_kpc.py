"""The public interface: load and render."""

import os
import subprocess
import sys

import numpy as np
import pytest

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


@pytest.mark.parametrize(("given", "kept"), [(None, "PASSIVE"), ("active", "ACTIVE")])
def test_waiting_threads_sleep_unless_the_user_says_otherwise(given, kept):
    pytest.importorskip("numba")
    program = (
        "import kpc.jit, numba, numpy\n"
        "numba.njit(parallel=True)(lambda x: x + 1)(numpy.ones(9))\n"
        "print(numba.threading_layer())"
    )
    environment = {name: value for name, value in os.environ.items() if name != "OMP_WAIT_POLICY"}
    environment |= {"OMP_DISPLAY_ENV": "true"} | ({} if given is None else {"OMP_WAIT_POLICY": given})
    done = subprocess.run([sys.executable, "-c", program], capture_output=True, text=True, check=True, env=environment)
    if done.stdout.strip() != "omp":
        pytest.skip("numba's threads are not OpenMP's here")
    assert f"OMP_WAIT_POLICY = '{kept}'" in done.stderr


def test_importing_kpc_loads_neither_torch_nor_opengl():
    program = (
        "import sys, kpc, kpc.format.container.scene_io; "
        "print([m for m in ('torch', 'numba', 'moderngl', 'glfw') if m in sys.modules])"
    )
    done = subprocess.run([sys.executable, "-c", program], capture_output=True, text=True, check=True)
    assert done.stdout.strip() == "[]"
