"""The processor's code is loaded, and compiled by another process, while shaders draw."""

import pickle
import subprocess
import sys
import threading
import time
from pathlib import Path
from types import ModuleType

import numba
import numpy as np
import pytest

import gl
from kpc.format.scene.scene import Scene
from kpc.jit import NotCachedError, compiled, only_cached
from kpc.player.cpu import (
    coarse_to_fine,
    field_kernels,
    kernel_warm_up,
    lanes,
    loading,
    raymarch,
    reprojection,
    serving,
)
from kpc.player.gl.renderer import Renderer
from kpc.player.quality import DEFAULT, LEVELS
from processor import psnr
from scenes import VARIANTS, look_at, one_texel_deep, tiny_scene, unequal_scales, view_independent

CAMERA = look_at((2.4, 1.0, 2.2), (0.1, 0.05, 0.05), 64, 48, 70.0)
MODULES = coarse_to_fine, field_kernels, lanes, raymarch, reprojection
# Shaders keep folded planes in float16. Other levels leave out what is hardly seen in a scene, and is in random planes.
LEVEL, AGREEMENT_DB = LEVELS["finer"], 45.0
SCENES = {name: variant(tiny_scene(4)) for name, variant in VARIANTS.items()}
SCENES |= {"unequal scales": unequal_scales(), "one texel along z": one_texel_deep()}
SCENES |= {"one-sided": view_independent(tiny_scene(4)), "static": tiny_scene(4, dynamic=False)}


@pytest.fixture
def unloaded(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(loading, "_begun", {})


def signatures(modules: tuple[ModuleType, ...]) -> int:
    """How many kernels, each for some types, this process has."""
    return sum(len(getattr(found, "signatures", ())) for module in modules for found in vars(module).values())


def in_thread(work) -> list[Exception]:
    """Call something in a thread; return what it raises."""
    raised: list[Exception] = []

    def run() -> None:
        try:
            work()
        except Exception as error:
            raised.append(error)

    thread = threading.Thread(target=run)
    thread.start()
    thread.join()
    return raised


@pytest.mark.usefixtures("unloaded")
def test_shaders_draw_until_the_kernels_are_loaded(monkeypatch: pytest.MonkeyPatch) -> None:
    """The picture hardly changes when the processor takes over."""
    may_end = threading.Event()

    def slow(self: loading.Loading, scene: Scene) -> None:
        may_end.wait(60)
        self.is_done = True

    monkeypatch.setattr(loading.Loading, "run", slow)
    renderer = Renderer(gl.context(), tiny_scene(4), LEVEL, processor=True, in_background=True)
    for _ in range(3):
        assert not renderer.take_over() and renderer.is_loading and renderer.drawn_by == "fragment shaders"
        before = renderer.render(CAMERA, 0.5)
    may_end.set()
    until = time.monotonic() + 60
    while not renderer.take_over():
        assert time.monotonic() < until
    assert renderer.drawn_by == "the processor" and not renderer.is_loading and not renderer.take_over()
    assert psnr(renderer.render(CAMERA, 0.5).rgb, before.rgb) > AGREEMENT_DB
    again = Renderer(gl.context(), tiny_scene(5), LEVEL, processor=True, in_background=True)
    assert again.drawn_by == "the processor", "kernels of the same types are loaded again"


@pytest.mark.usefixtures("unloaded")
@pytest.mark.parametrize("lacks", ["folding", "numba", "a processor"])
def test_nothing_is_loaded_where_the_processor_does_not_draw(monkeypatch: pytest.MonkeyPatch, lacks: str) -> None:
    monkeypatch.setattr(serving, "is_installed", lambda: lacks != "numba")
    quality = LEVELS["reference" if lacks == "folding" else DEFAULT]
    renderer = Renderer(gl.context(), tiny_scene(4), quality, processor=lacks != "a processor", in_background=True)
    assert not renderer.is_loading and not renderer.take_over() and not loading._begun
    assert (serving.bytes_for(tiny_scene(4)) > 0) == (lacks != "numba")


@pytest.mark.parametrize("is_cached", [True, False])
def test_only_what_is_not_cached_is_compiled_elsewhere(monkeypatch: pytest.MonkeyPatch, is_cached: bool) -> None:
    called: list[str] = []

    def warm_up_kernels(scene: Scene) -> None:
        called.append("warm up")
        if not is_cached and called == ["warm up"]:
            raise NotCachedError

    monkeypatch.setattr(kernel_warm_up, "warm_up_kernels", warm_up_kernels)
    monkeypatch.setattr(loading, "compile_elsewhere", lambda scene: called.append("compile"))
    done = loading.Loading()
    done.run(tiny_scene())
    assert done.is_done and called == (["warm up"] if is_cached else ["warm up", "compile", "warm up"])


def test_threads_do_not_compile_where_only_cached_kernels_may_be_used(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(numba.config, "CACHE_DIR", str(tmp_path))  # where an earlier run has kept nothing
    kernel = compiled()(lambda number: number + 1)
    with only_cached():
        (error,) = in_thread(lambda: kernel(1))
        assert isinstance(error, NotCachedError) and not kernel.signatures
        assert kernel(1) == 2 and not in_thread(lambda: kernel(1))
    assert not in_thread(lambda: kernel(1.5))


@pytest.mark.usefixtures("unloaded")
@pytest.mark.parametrize("name", [name for name, scene in SCENES.items() if serving.serves(scene)])
def test_warming_up_leaves_nothing_to_compile(name: str) -> None:
    scene = SCENES[name]
    loading.load(scene)
    renderer, before = Renderer(gl.context(), scene, processor=True), signatures(MODULES)
    for renderer.quality in (quality for quality in LEVELS.values() if quality.folded):
        for number in range(3):
            renderer.render(CAMERA.resized(64 + number, 48), 0.5 + 0.01 * number)
    assert signatures(MODULES) == before > 0


def test_a_sketch_is_of_the_same_kind_and_small() -> None:
    for variant in VARIANTS.values():
        scene = variant(tiny_scene(4, channels=16))
        if serving.serves(scene):
            small = loading.sketch(scene)
            assert loading.kind_of(small) == loading.kind_of(scene)
            assert len(pickle.dumps(small)) < 40_000 and small.occupancy.all()
            assert all(np.all(plane == ("t" in name)) for scale in small.scales for name, plane in scale.items())


ENDING = """
import time
from kpc.player.cpu import loading, threads

def run(self, scene):
    while True:
        threads._POOL.submit(time.sleep, 0.01).result()

loading.Loading.run, loading.sketch = run, lambda scene: scene
loading.Loading().begin(None)
time.sleep(0.1)
"""


def test_a_process_that_ends_while_kernels_are_loaded_says_nothing() -> None:
    done = subprocess.run([sys.executable, "-c", ENDING], capture_output=True, text=True, check=True)
    assert done.stdout == done.stderr == ""


def test_another_process_warms_up() -> None:
    command = [sys.executable, "-m", "kpc.player.cpu.kernel_warm_up"]
    subprocess.run(command, input=pickle.dumps(loading.sketch(tiny_scene(4))), check=True)
