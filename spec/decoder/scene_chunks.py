"""Section 6: SCNE and WARP."""

import math

from .common import PLANES, require

BOX_LIMIT, SAMPLE_LIMIT = 2**30, 65536
BOX, CONTRACTION, NDC = range(3)  # mappings; the first is that of a file without WARP


def decode_scne(chunk):  # section 6.1
    *aabb, frame_count, fps, ray_step, red, green, blue, scale_count, is_dynamic = chunk.unpack("6fIdd3fBB")
    low, high = aabb[:3], aabb[3:]
    require(all(abs(a) <= BOX_LIMIT for a in aabb), "invalid box")
    require(all(b - a >= 1 / BOX_LIMIT for a, b in zip(low, high)), "invalid box")
    require(1 <= frame_count <= 1 << 24 and math.isfinite(fps) and fps > 0, "invalid clip")
    require(math.isfinite(ray_step) and ray_step > 0, "invalid ray step")
    require(math.dist(low, high) / ray_step <= SAMPLE_LIMIT, "invalid ray step")
    require(all(0 <= a <= 1 for a in (red, green, blue)), "invalid background")
    require(1 <= scale_count <= 16 and is_dynamic <= 1, "invalid number of scales")
    scales = [decode_scale(chunk, is_dynamic) for _ in range(scale_count)]
    chunk.finish()
    return {
        "aabb": [low, high],
        "frame_count": frame_count,
        "fps": fps,
        "ray_step": ray_step,
        "background": [red, green, blue],
        "scales": scales,
    }


def decode_scale(chunk, is_dynamic):
    """Return {name: plane}."""
    M, *counts = chunk.unpack("5H")
    size = dict(zip("xyzt", counts))
    require(1 <= M <= 256 and all(1 <= size[axis] <= 16384 for axis in "xyz"), "invalid size of a scale")
    require(1 <= size["t"] <= 16384 if is_dynamic else size["t"] == 0, "invalid rows in time")
    planes = {}
    for name in PLANES[: 6 if is_dynamic else 3]:
        step = chunk.unpack(f"{M}f")
        offset = (1.0,) * M if "t" in name else chunk.unpack(f"{M}f")
        require(all(s > 0 and 128 * s + abs(o) <= 2048 for s, o in zip(step, offset)), "invalid step or offset")
        planes[name] = {
            "columns": size[name[0]],
            "rows": size[name[1]],
            "channels": M,
            "step": step,
            "offset": offset,
        }
    return planes


def decode_warp(chunk, scene):  # section 6.2
    (mapping,) = chunk.unpack("I")
    require(mapping in (CONTRACTION, NDC), "invalid mapping")
    if mapping == CONTRACTION:
        (uniform_distance,) = chunk.unpack("d")
        require(1 / BOX_LIMIT <= uniform_distance <= BOX_LIMIT, "invalid uniform distance")
        require(2 * uniform_distance / scene["ray_step"] <= SAMPLE_LIMIT, "invalid uniform distance")
        chunk.finish()
        return {"mapping": mapping, "uniform_distance": uniform_distance}
    *pose, near, baseline = chunk.unpack("12ddd")
    chunk.finish()
    require(all(1 / BOX_LIMIT <= a <= BOX_LIMIT for a in (near, baseline)), "invalid near or baseline")
    require(all(abs(a) <= BOX_LIMIT for a in pose), "invalid reference pose")
    axes = [pose[column::4] for column in range(4)]  # the columns: right, up, backward, eye
    for i in range(3):
        for j in range(3):
            product = sum(a * b for a, b in zip(axes[i], axes[j]))
            require(abs(product - (i == j)) < 0.0001, "invalid axes of the reference pose")
    require(scene["aabb"][1][2] < baseline / near, "invalid box")
    return {"mapping": mapping, "reference_pose": axes, "near": near, "baseline": baseline}
