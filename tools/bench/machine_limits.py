"""Measure the limits of the machine to which a training step and a frame are compared.

This is the roofline model (Williams et al., https://doi.org/10.1145/1498765.1498785).
"""

import time
from collections.abc import Callable
from dataclasses import dataclass

import moderngl
import numba
import numpy as np
from numba import njit, prange

from kpc.player.gl.shader import build, build_compute

# Bytes of three arrays per thread that fit into a second-level cache, and of three arrays that fit into no cache.
CACHED_BYTES = 1 << 20
MEMORY_BYTES = 1 << 29

# The best of this many runs counts, since other processes can only lower it.
REPEATS = 5

# Degree of the polynomials that measure arithmetic throughput, and the fast-math flags of the kernels.
_DEGREE = 32
_FAST_MATH = {"nsz", "arcp", "contract", "afn"}


@dataclass(frozen=True)
class Limits:
    """Limits of all threads of numba together, in float32.

    Attributes:
        gflops: fused multiplications and additions in registers, counted separately, 1e9/s.
        cache_gb_s: bytes read and written within each core's own cache, 1e9/s.
        memory_gb_s: bytes read and written in memory, 1e9/s.
    """

    gflops: float
    cache_gb_s: float
    memory_gb_s: float


def measure() -> Limits:
    """Measure the limits; this takes a few seconds."""
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


# `texel_rate`: look-ups per pixel, and the sides of the texture that is read and of the picture that is drawn.
LOOK_UPS, TEXTURE_SIDE, PICTURE_SIDE = 64, 512, 1024

# Pictures are drawn for at least this long per measurement.
SHORTEST_S = 0.05


def texel_rate(ctx: moderngl.Context, compute: bool, dtype: str) -> float:
    """Return the peak rate per second of bilinear look-ups of four channels, neighbours by neighbouring pixels.

    Args:
        compute: whether a compute or a fragment shader reads; a data-centre GPU has few units for the latter.
        dtype: "f4" or "f2".
    """
    texels = (
        np.random.default_rng(0)
        .random(4 * TEXTURE_SIDE**2, np.float32)
        .astype({"f4": np.float32, "f2": np.float16}[dtype])
    )
    texture = ctx.texture((TEXTURE_SIDE, TEXTURE_SIDE), 4, texels.tobytes(), dtype=dtype)
    texture.filter = moderngl.LINEAR, moderngl.LINEAR
    drawn = ctx.texture((PICTURE_SIDE, PICTURE_SIDE), 4, dtype="f4")
    target = ctx.framebuffer([drawn])
    defines = {"LOOK_UPS": LOOK_UPS, "COMPUTE": int(compute)}
    program = (build_compute if compute else build)(ctx, "texels.glsl", defines)
    program["side"] = float(TEXTURE_SIDE)
    vertices = None if isinstance(program, moderngl.ComputeShader) else ctx.vertex_array(program, [])
    target.use()
    texture.use(0)
    drawn.bind_to_image(0, read=False)

    def draw(times: int) -> None:
        for _ in range(times):
            if isinstance(program, moderngl.ComputeShader):
                program.run(PICTURE_SIDE // 8, PICTURE_SIDE // 8)
            elif vertices is not None:
                vertices.render(moderngl.TRIANGLES, vertices=3)
        ctx.finish()

    times = max(1, round(SHORTEST_S / _best(lambda: draw(1))))
    rate = times * LOOK_UPS * PICTURE_SIDE**2 / _best(lambda: draw(times))
    ctx.detect_framebuffer(0).use()  # otherwise moderngl would bind the released framebuffer again
    for resource in (vertices, program, target, drawn, texture):
        if resource is not None:
            resource.release()
    return rate


def _best(run: Callable[[], None]) -> float:
    """Return the seconds of the fastest run, after one that compiles."""
    run()
    seconds = []
    for _ in range(REPEATS):
        started = time.perf_counter()
        run()
        seconds.append(time.perf_counter() - started)
    return min(seconds)


@njit(parallel=True, fastmath=_FAST_MATH, cache=True)
def _polynomials(x: np.ndarray, rounds: int) -> None:
    """Evaluate polynomials of degree 32 by Horner's rule, repeatedly; the fixed point 0.5 keeps values finite."""
    for row in prange(x.shape[0]):
        values = x[row]
        for _ in range(rounds):
            for i in range(values.size):
                v = values[i]
                y = v
                for _ in range(_DEGREE):
                    y = y * np.float32(0.5) + np.float32(0.25)
                values[i] = y


@njit(parallel=True, fastmath=_FAST_MATH, cache=True)
def _triads(a: np.ndarray, b: np.ndarray, c: np.ndarray, rounds: int) -> None:
    """Compute a = b + factor c row by row, the triad of the STREAM benchmark."""
    for row in prange(a.shape[0]):
        out, one, other = a[row], b[row], c[row]
        for k in range(rounds):
            factor = np.float32(k)
            for i in range(out.size):
                out[i] = one[i] + factor * other[i]
