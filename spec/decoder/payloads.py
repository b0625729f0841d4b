"""Sections 6.3 to 6.7 and 8: motion, occupancy, decoder weights, cameras and appearances."""

import itertools
import math

from .common import ByteReader, Refused, clamp, f32, require, unpack_bits
from .entropy import EntropyDecoder, log_class

# --- 6.3 MOVE, 8.1 MOTION


def decode_motion(content):
    chunk = ByteReader(content.data)
    nt, nz, ny, nx, motion_step = chunk.unpack("4Hf")
    require(2 <= nt <= 16384 and all(2 <= n <= 256 for n in (nz, ny, nx)), "invalid size of the motion grid")
    require(motion_step > 0 and 32768 * motion_step <= 1024, "invalid step of the motion grid")
    count = 3 * nt * nz * ny * nx
    if content.is_coded:
        require(content.raw_length == 12 + 2 * count, "invalid raw length")
        symbols = decode_motion_symbols(chunk, (nt, nz, ny, nx))
    else:
        symbols = chunk.unpack(f"{count}h")
        chunk.finish()
    return {"size": (nt, nz, ny, nx), "displacements": [f32(symbol * motion_step) for symbol in symbols]}


def decode_motion_symbols(chunk, sizes):
    """Return the symbols of the MOTION codec, row-major; sizes: nodes along t, z, y, x."""
    decisions = EntropyDecoder(chunk)
    symbol, residual = {}, {}  # by (t, z, y, x, component)
    decoded = [[0] for _ in sizes]  # positions along each axis that are decoded

    def decode_pass(axis, new, ref, tap):
        """Decode the nodes at position `new` of an axis, predicted from up to four reference positions."""
        others = [decoded[a] for a in range(4) if a != axis]
        for at in itertools.product(*others):

            def node(position):
                return (*at[:axis], position, *at[axis:])  # noqa: B023

            previous = []  # the nodes one decoded position back along each of the other axes
            for a in range(3):
                index = others[a].index(at[a])
                if index > 0:
                    moved = (*at[:a], others[a][index - 1], *at[a + 1 :])
                    previous.append((*moved[:axis], new, *moved[axis:]))
            for component in range(3):
                used = [(k, (*node(ref[k]), component)) for k in range(4) if tap[k]]
                prediction = clamp(sum(tap[k] * symbol[i] for k, i in used) + 32 >> 6, -32768, 32767)
                activity = sum(abs(residual[i]) * (2 if k in (1, 2) else 1) for k, i in used)
                activity += 3 * sum(abs(residual[*node(new), c]) for c in range(component))
                activity += sum(abs(residual[*i, c]) for i in previous for c in range(3))
                decoded_residual = decisions.signed(("motion", min(log_class(activity), 19)), unary=4, escape=15)
                require(-32768 <= prediction + decoded_residual <= 32767, "a symbol exceeds 16 bits")
                here = *node(new), component
                symbol[here], residual[here] = prediction + decoded_residual, decoded_residual

    decode_pass(0, 0, [None] * 4, [0] * 4)
    for axis, n in enumerate(sizes):
        decode_pass(axis, n - 1, [None, 0, None, None], [0, 64, 0, 0])
        decoded[axis].append(n - 1)
    halvings = [(n - 2).bit_length() for n in sizes]
    for halving in range(max(halvings), 0, -1):
        for axis in range(4):
            if halvings[axis] >= halving:
                halve(decoded, axis, decode_pass)
    decisions.finish()
    return [symbol[i] for i in itertools.product(*map(range, sizes), range(3))]


def halve(decoded, axis, decode_pass):
    """Decode the node in the middle of each gap along an axis."""
    old = decoded[axis]
    middles = []
    for index in range(len(old) - 1):
        if old[index + 1] - old[index] > 1:
            new = old[index] + old[index + 1] >> 1
            ref = [old[i] if 0 <= i < len(old) else None for i in range(index - 1, index + 3)]
            decode_pass(axis, new, ref, interpolation_taps(new, ref))
            middles.append(new)
    decoded[axis] = sorted(old + middles)


def interpolation_taps(new, ref):
    """Return the factors of cubic interpolation, in 1/64."""
    tap = [0] * 4
    for k in range(4):
        if ref[k] is not None:
            others = [position for j, position in enumerate(ref) if position is not None and j != k]
            A = 64 * math.prod(new - position for position in others)
            B = math.prod(ref[k] - position for position in others)
            tap[k] = (2 * A + B) // (2 * B)
    tap[1] += 64 - sum(tap)
    return tap


# --- 6.4 OCCU, 8.2 OCCUPANCY

# Neighbours of a cell whose bits choose the model, most significant first: steps along slot, z, y, x.
OCCUPANCY_NEIGHBOURS = [
    (0, 0, 0, -1),
    (0, 0, -1, 0),
    (0, -1, 0, 0),
    (0, -1, 1, 0),
    (0, 0, -1, 1),
    (0, -1, 0, 1),
    (-1, 0, 0, 0),
    (-1, 0, 0, -1),
    (-1, 1, 0, 0),
    (-1, 0, -1, 0),
    (-1, -1, 0, 0),
]


def decode_occupancy(content):
    chunk = ByteReader(content.data)
    sizes = K, nz, ny, nx = chunk.unpack("4H")
    require(all(1 <= n <= 16384 for n in sizes), "invalid size of the occupancy grid")
    count = K * nz * ny * nx
    if not content.is_coded:
        return {"cells": sizes, "occupancy": unpack_bits(chunk.remaining(), count)}
    require(content.raw_length == 8 + -(-count // 8), "invalid raw length")
    decisions, occupied = EntropyDecoder(chunk), {}
    for cell in itertools.product(*map(range, sizes)):
        context = tuple(
            occupied.get(tuple(a + b for a, b in zip(cell, neighbour)), 0) for neighbour in OCCUPANCY_NEIGHBOURS
        )
        occupied[cell] = decisions.adaptive(("occupancy", context))
    decisions.finish()
    return {"cells": sizes, "occupancy": list(occupied.values())}


# --- 6.5 DECO and HYBR, 8.3 WEIGHTS


def decode_explicit_decoder(content, feature_count):
    chunk = ByteReader(content.data)
    features, hidden, density_bias = chunk.unpack("HHf")
    require(features == feature_count and 1 <= hidden <= 256, "invalid size of the decoder")
    require(math.isfinite(density_bias), "invalid density bias")
    counts = {
        "density_weight": features,
        "w1": hidden * 9,
        "b1": hidden,
        "w2": 3 * features * hidden,
        "b2": 3 * features,
    }
    weights = decode_weights(content, chunk, counts)
    return weights | {"density_bias": density_bias, "hidden": hidden, "width": 0}


def decode_hybrid_decoder(content, feature_count):
    chunk = ByteReader(content.data)
    features, width, hidden, density_bias = chunk.unpack("HHHf")
    require(features == feature_count and 1 <= width <= 256 and 1 <= hidden <= 256, "invalid size of the decoder")
    require(math.isfinite(density_bias), "invalid density bias")
    counts = {
        "v": width * features,
        "v_bias": width,
        "density_weight": width,
        "w1": hidden * 9,
        "b1": hidden,
        "u": hidden * width,
        "w2": 3 * hidden,
        "b2": 3,
    }
    weights = decode_weights(content, chunk, counts)
    return weights | {"density_bias": density_bias, "hidden": hidden, "width": width}


def decode_weights(content, chunk, counts):
    """Return {array: its weights, row-major}."""
    if not content.is_coded:
        weights = {name: chunk.unpack(f"{count}e") for name, count in counts.items()}
        require(all(math.isfinite(w) for array in weights.values() for w in array), "a weight exceeds its range")
        chunk.finish()
        return weights
    require(content.raw_length == chunk.position + 2 * sum(counts.values()), "invalid raw length")
    exponents = chunk.unpack(f"{len(counts)}b")
    require(all(-24 <= e <= 15 for e in exponents), "invalid exponents of weights")
    decisions, weights = EntropyDecoder(chunk), {}
    for (name, count), e in zip(counts.items(), exponents):
        integers = [decisions.signed(("weights", name), unary=4, escape=10) for _ in range(count)]
        require(all(abs(k) <= 2048 and abs(k) * 2.0**e <= 65504 for k in integers), "a weight exceeds its range")
        weights[name] = tuple(k * 2.0**e for k in integers)
    decisions.finish()
    return weights


# --- 6.6 came, 8.4 POSES

D = 131071**2  # one half, in squares of quaternion components


def decode_cameras(content):
    """Return (width, height, focal x and y, centre x and y, 12 numbers of the pose) of each camera."""
    chunk = ByteReader(content.data)
    if content.is_coded:
        cameras = decode_poses(chunk)
        require(content.raw_length == 2 + 68 * len(cameras), "invalid raw length")
    else:
        (count,) = chunk.unpack("H")
        cameras = [chunk.unpack("HH16f") for _ in range(count)]
    chunk.finish()
    require(1 <= len(cameras) <= 4096, "invalid number of cameras")
    for width, height, *numbers in cameras:
        pose = numbers[4:]
        require(width > 0 and height > 0 and min(numbers[:2]) > 0, "invalid lens of a camera")
        require(all(abs(a) <= 2**30 for a in numbers), "invalid numbers of a camera")
        require(all(0.5 <= math.hypot(*pose[column::4]) <= 2 for column in range(3)), "invalid axes of a camera")
    return cameras


def decode_poses(chunk):
    camera_count, lens_count, e, *corner = chunk.unpack("HHb3i")
    require(
        1 <= camera_count <= 4096 and lens_count in (1, camera_count) and -126 <= e <= 30,
        "invalid number of cameras or lenses",
    )
    lenses = [chunk.unpack("HH4f") for _ in range(lens_count)]
    cameras = []
    for number in range(camera_count):
        rotation, position = (int.from_bytes(chunk.take(7), "little") for _ in range(2))
        require(position >> 54 == 0, "invalid position of a camera")
        left_out = rotation >> 54
        q = [(rotation >> 18 * i & 0x3FFFF) - 131072 for i in range(3)]
        square = 2 * D - sum(a * a for a in q)
        require(square >= 0, "invalid rotation of a camera")
        q.insert(left_out, math.sqrt(square))
        squares = [square if i == left_out else q[i] * q[i] for i in range(4)]
        (w, x, y, z), (_, xx, yy, zz) = q, squares
        rows = [
            [D - (yy + zz), x * y - w * z, x * z + w * y],
            [x * y + w * z, D - (xx + zz), y * z - w * x],
            [x * z - w * y, y * z + w * x, D - (xx + yy)],
        ]
        pose = []
        for i in range(3):
            pose += [f32(a / D) + 0.0 for a in rows[i]]  # + 0.0 makes -0 a 0
            pose.append(f32(math.ldexp(corner[i] + (position >> 18 * i & 0x3FFFF), e)))
        cameras.append((*lenses[number if lens_count > 1 else 0], *pose))
    return cameras


# --- 6.7 appe


def decode_appearances(chunk, expected_hidden):
    """Return {name: embedding}."""
    appearance_count, hidden = chunk.unpack("HH")
    require(
        1 <= appearance_count <= 16384 and hidden == expected_hidden, "invalid number of appearances or of hidden units"
    )
    embeddings = [chunk.unpack(f"{hidden}e") for _ in range(appearance_count)]
    require(all(math.isfinite(a) for embedding in embeddings for a in embedding), "an embedding is not finite")
    appearances = {}
    for embedding in embeddings:
        (length,) = chunk.unpack("B")
        try:
            name = chunk.take(length).decode("utf-8")
        except UnicodeDecodeError as error:
            raise Refused("a name is not UTF-8") from error
        require(name and name not in appearances, "a name is empty or is there twice")
        require(not any(ord(a) < 0x20 or 0x7F <= ord(a) <= 0x9F for a in name), "a name holds a control character")
        appearances[name] = embedding
    chunk.finish()
    return appearances
