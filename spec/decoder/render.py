"""Section 9: what a ray sees."""

import math

from .common import clamp
from .scene_chunks import CONTRACTION, NDC


def render_ray(scene, origin, direction, time, appearance=None):
    """Return (rgb, opacity, depth) of a ray, with the appearance of that name."""
    low, high = scene["aabb"]
    mapping = scene["mapping"]
    world_distance = float
    if mapping == NDC:
        path = ndc_ray(scene, origin, direction)
        if path is None:
            return scene["background"], 0.0, math.inf
        origin, direction, world_distance = path
    extent = max(b - a for a, b in zip(low, high))
    s_start, s_end = box_interval(origin, direction, low, high)
    if mapping == CONTRACTION:
        s_start, s_end = 0.0, (2 - 1 / 256) * scene["uniform_distance"]

    embedding = scene["appearances"][appearance] if appearance else [0.0] * scene["hidden"]
    view = view_terms(scene, direction, embedding)
    K, nz, ny, nx = scene["cells"]
    slot = min(math.floor(time * K), K - 1)
    colour, depth, T, k = [0.0, 0.0, 0.0], 0.0, 1.0, 0
    while T >= 1 / 1024:
        s = s_start + (k + 0.5) * scene["ray_step"]
        if s >= s_end:
            break
        k += 1
        r, length = s, scene["ray_step"]
        if mapping == CONTRACTION and s > scene["uniform_distance"]:
            r = scene["uniform_distance"] / (2 - s / scene["uniform_distance"])
        p = [o + r * d for o, d in zip(origin, direction)]
        u = [(a - b) / (c - b) for a, b, c in zip(p, low, high)]
        if mapping == CONTRACTION:
            centred = [2 * a - 1 for a in u]
            q = max(1.0, *map(abs, centred))
            u = [0.5 + a * (2 - 1 / q) / (4 * q) for a in centred]
            length *= (max(1.0, r / scene["uniform_distance"]) / q) ** 2
        i, j, m = (clamp(math.floor(a * n), 0, n - 1) for a, n in zip(u, (nx, ny, nz)))
        if not scene["occupancy"][((slot * nz + m) * ny + j) * nx + i]:
            continue
        f = features(scene, dict(zip("xyzt", [*displaced(scene["motion"], u, time), time])))
        sigma, rgb = density_and_colour(scene, f, view)
        alpha = 1 - math.exp(-sigma * length / extent)
        contribution = T * alpha
        colour = [a + contribution * b for a, b in zip(colour, rgb)]
        depth += contribution * world_distance(r)
        T *= 1 - alpha
    opacity = 1 - T
    rgb = [a + T * b for a, b in zip(colour, scene["background"])]
    return rgb, opacity, depth / opacity if opacity else math.inf


def box_interval(origin, direction, low, high):
    """Return the distances from 0 on between which a ray is in the box; an empty interval if there are none."""
    r_in, r_out = 0.0, math.inf
    for o, d, a, b in zip(origin, direction, low, high):
        if d == 0:
            r_out = r_out if a <= o <= b else -math.inf
        else:
            r_in = max(r_in, min((a - o) / d, (b - o) / d))
            r_out = min(r_out, max((a - o) / d, (b - o) / d))
    return r_in, r_out


def ndc_ray(scene, origin, direction):
    """Return (origin, direction, its distances in the world) of a ray in NDC; None if it sees the background."""
    *axes, eye = scene["reference_pose"]
    o_x, o_y, o_z = (sum(a * (o - e) for a, o, e in zip(axis, origin, eye)) for axis in axes)
    d_x, d_y, d_z = (sum(a * d for a, d in zip(axis, direction)) for axis in axes)
    o_z, d_z = -o_z, -d_z
    if d_z <= 0.0001:
        return None
    near, baseline = scene["near"], scene["baseline"]
    r_0 = max(0.0, (near - o_z) / d_z)
    x_0, y_0, z_0 = o_x + r_0 * d_x, o_y + r_0 * d_y, o_z + r_0 * d_z
    start = [x_0 / z_0, y_0 / z_0, baseline * (1 / near - 1 / z_0)]
    slope = [d_x / d_z - x_0 / z_0, d_y / d_z - y_0 / z_0, baseline / z_0]
    reach = math.hypot(*slope)

    def world_distance(r):
        ratio = min(r / reach, 0.999999)
        return r_0 + z_0 / d_z * ratio / (1 - ratio)

    return start, [a / reach for a in slope], world_distance


def interpolation(position, count):
    """Return [(index, weight)] of the two of `count` samples of [0, 1] that surround a position."""
    position = clamp(position, 0.0, 1.0) * (count - 1)
    index = min(math.floor(position), max(count - 2, 0))
    return [(index, 1 - (position - index)), (min(index + 1, count - 1), position - index)]


def displaced(motion, u, time):
    """Return the position in the canonical space, where planes are read."""
    if motion is None:
        return u
    rows, nz, ny, nx = motion["size"]
    moved = list(u)
    for t, weight_t in interpolation(time, rows):
        for k, weight_z in interpolation(u[2], nz):
            for j, weight_y in interpolation(u[1], ny):
                for i, weight_x in interpolation(u[0], nx):
                    node = 3 * (((t * nz + k) * ny + j) * nx + i)
                    for axis in range(3):
                        weight = weight_t * weight_z * weight_y * weight_x
                        moved[axis] += weight * motion["displacements"][node + axis]
    return [clamp(a, 0.0, 1.0) for a in moved]


def features(scene, position):
    """Return f: of each scale the products of what its planes hold at a position {axis: coordinate}."""
    f = []
    for scale in scene["scales"]:
        product = [1.0] * scale["xy"]["channels"]
        for name, plane in scale.items():
            sample = bilinear(plane, position[name[0]], position[name[1]])
            product = [a * b for a, b in zip(product, sample)]
        f += product
    return f


def bilinear(plane, u, v):
    M = plane["channels"]
    sample = [0.0] * M
    for y, weight_y in interpolation(v, plane["rows"]):
        for x, weight_x in interpolation(u, plane["columns"]):
            first = (y * plane["columns"] + x) * M
            for c in range(M):
                sample[c] += weight_y * weight_x * plane["values"][first + c]
    return sample


def dot(a, b):
    return sum(x * y for x, y in zip(a, b))


def layer(weights, biases, values):
    n = len(values)
    return [dot(weights[n * row : n * row + n], values) + bias for row, bias in enumerate(biases)]


def clip(values):
    return [clamp(x, 0.0, 65504.0) for x in values]


def sigmoid(x):
    return 1 / (1 + math.exp(-x)) if x > -700 else 0.0


def view_terms(scene, direction, embedding):
    """Return what is constant along a ray: the colour basis or, of a hybrid decoder, the hidden layer's view part."""
    x, y, z = direction
    view = [x, y, z, x * x, y * y, z * z, x * y, y * z, z * x]
    hidden_layer = [a + b for a, b in zip(layer(scene["w1"], scene["b1"], view), embedding)]
    if scene["width"]:
        return hidden_layer
    features = len(scene["density_weight"])
    colour_basis = layer(scene["w2"], scene["b2"], [max(a, 0.0) for a in hidden_layer])
    return [colour_basis[c * features : (c + 1) * features] for c in range(3)]


def density_and_colour(scene, f, view):
    if scene["width"]:
        first_layer = clip(layer(scene["v"], scene["v_bias"], f))
        logits = layer(scene["w2"], scene["b2"], clip(layer(scene["u"], view, first_layer)))
    else:
        first_layer = f
        logits = [dot(f, colour_basis) for colour_basis in view]
    sigma = math.exp(clamp(dot(first_layer, scene["density_weight"]) + scene["density_bias"], -20.0, 20.0))
    return sigma, [sigmoid(logit) for logit in logits]
