"""What this machine can do at most, measured: the limits that a training step is held against (a roofline model,
https://doi.org/10.1145/1498765.1498785)."""

import time
from collections.abc import Callable
from dataclasses import dataclass

import moderngl
import numba
import numpy as np
from kpc.player.gl.shader import build, build_compute
from numba import njit, prange

CACHED_BYTES = 1 << 20
"""Of three arrays together for each thread: what fits a second-level cache."""
MEMORY_BYTES = 1 << 29
"""Of three arrays together: what fits no cache."""
REPEATS = 5
"""The best of so many counts: a limit is what can be reached, and other processes only take away from it."""

_DEGREE = 32
_fast = {"nsz", "arcp", "contract", "afn"}


@dataclass(frozen=True)
class Limits:
    """By all threads of numba together, float32.

    Attributes:
        gflops: multiplications and additions, fused and in registers, 1e9/s.
        cache_gb_s: bytes read and written within each core's own cache, 1e9/s.
        memory_gb_s: bytes read and written in memory, 1e9/s.
    """

    gflops: float
    cache_gb_s: float
    memory_gb_s: float


def measure() -> Limits:
    """Measure for a few seconds."""
    threads = numba.get_num_threads()
    x = np.linspace(-1, 1, 1024 * threads, dtype=np.float32).reshape(threads, -1)
    rounds = 2000
    flops = 2 * _DEGREE * rounds * x.size / _best(lambda: _polynomials(x, rounds))

    size = CACHED_BYTES // 12
    a, b, c = (np.ones((threads, size), np.float32) for _ in range(3))
    rounds = 400
    cached = 12 * rounds * a.size / _best(lambda: _triads(a, b, c, rounds))

    size = MEMORY_BYTES // 12 // threads
    a, b, c = (np.ones((threads, size), np.float32) for _ in range(3))
    memory = 12 * a.size / _best(lambda: _triads(a, b, c, 1))
    return Limits(flops / 1e9, cached / 1e9, memory / 1e9)


LOOK_UPS, TEXTURE_SIDE, PICTURE_SIDE = 64, 512, 1024
"""Of `texel_rate`: look-ups a pixel, and sides of what is read and of what is drawn."""
SHORTEST_S = 0.05


def texel_rate(ctx: moderngl.Context, compute: bool, dtype: str) -> float:
    """Look-ups a second, at most: filtered, of four channels of `dtype` ("f4" or "f2"), by neighbours that read side by side, in a compute
    or else a fragment shader. (A card need not let all its units draw: of an H100's, few do.)"""
    texels = (
        np.random.default_rng(0)
        .random(4 * TEXTURE_SIDE**2, np.float32)
        .astype({"f4": np.float32, "f2": np.float16}[dtype])
    )
    texture = ctx.texture((TEXTURE_SIDE, TEXTURE_SIDE), 4, texels.tobytes(), dtype=dtype)
    texture.filter = moderngl.LINEAR, moderngl.LINEAR
    seen = ctx.texture((PICTURE_SIDE, PICTURE_SIDE), 4, dtype="f4")
    target = ctx.framebuffer([seen])
    defines = {"LOOK_UPS": LOOK_UPS, "COMPUTE": int(compute)}
    program = (build_compute if compute else build)(ctx, "texels.glsl", defines)
    program["side"] = float(TEXTURE_SIDE)
    vertices = None if isinstance(program, moderngl.ComputeShader) else ctx.vertex_array(program, [])
    target.use()
    texture.use(0)
    seen.bind_to_image(0, read=False)

    def draw(times: int) -> None:
        for _ in range(times):
            if vertices is None:
                program.run(PICTURE_SIDE // 8, PICTURE_SIDE // 8)
            else:
                vertices.render(moderngl.TRIANGLES, vertices=3)
        ctx.finish()

    times = max(1, round(SHORTEST_S / _best(lambda: draw(1))))
    rate = times * LOOK_UPS * PICTURE_SIDE**2 / _best(lambda: draw(times))
    ctx.detect_framebuffer(0).use()  # moderngl would bind again what it knows as bound, though it is gone
    for thing in (vertices, program, target, seen, texture):
        if thing is not None:
            thing.release()
    return rate


def _best(run: Callable[[], None]) -> float:
    """Seconds of the fastest run, once compiled."""
    run()
    seconds = []
    for _ in range(REPEATS):
        started = time.perf_counter()
        run()
        seconds.append(time.perf_counter() - started)
    return min(seconds)


@njit(parallel=True, fastmath=_fast, cache=True)
def _polynomials(x: np.ndarray, rounds: int) -> None:
    """Each row to its polynomial of degree 32, by Horner's rule, over and over; the fixed point 0.5 keeps it finite."""
    for row in prange(x.shape[0]):
        values = x[row]
        for _ in range(rounds):
            for i in range(values.size):
                v = values[i]
                y = v
                for _ in range(_DEGREE):
                    y = y * np.float32(0.5) + np.float32(0.25)
                values[i] = y


@njit(parallel=True, fastmath=_fast, cache=True)
def _triads(a: np.ndarray, b: np.ndarray, c: np.ndarray, rounds: int) -> None:
    """a = b + factor c, row by row (STREAM's triad)."""
    for row in prange(a.shape[0]):
        out, one, other = a[row], b[row], c[row]
        for k in range(rounds):
            factor = np.float32(k)
            for i in range(out.size):
                out[i] = one[i] + factor * other[i]
