"""A .kpc decoder in plain Python, written from kpc-format.md alone: slow, short, and independent of the real one.

    python decoder.py scene.kpc        prints what is in the file and the SHA-256 of every plane

It shares no code with the kpc package, so that the two, the page and the vectors check one another. Section numbers are
those of the page. Only Zstandard comes from a library.
"""

import hashlib
import itertools
import math
import struct
import sys

import zstandard

PLANES = ["xy", "xz", "yz", "xt", "yt", "zt"]


class Refused(Exception):
    """The file breaks a rule of the page."""


def require(condition, what):
    if not condition:
        raise Refused(what)


def crc32c(data):  # section 2
    crc = 0xFFFFFFFF
    for byte in data:
        crc ^= byte
        for _ in range(8):
            crc = crc >> 1 ^ (0x82F63B78 if crc & 1 else 0)  # 0x1EDC6F41 with its bits reversed
    return crc ^ 0xFFFFFFFF


def f32(x):
    """Round to the nearest float32."""
    return struct.unpack("<f", struct.pack("<f", x))[0]


def bits(data, count):  # section 2
    require(len(data) == -(-count // 8), "bit string of another length")
    unpacked = [data[i // 8] >> i % 8 & 1 for i in range(8 * len(data))]
    require(not any(unpacked[count:]), "unused bits are not 0")
    return unpacked[:count]


class Bytes:
    """Reads a chunk from front to back."""

    def __init__(self, data):
        self.data, self.at = data, 0

    def take(self, length):
        require(self.at + length <= len(self.data), "chunk too short")
        self.at += length
        return self.data[self.at - length : self.at]

    def unpack(self, layout):
        return struct.unpack("<" + layout, self.take(struct.calcsize("<" + layout)))

    def rest(self):
        return self.take(len(self.data) - self.at)

    def end(self):
        require(self.at == len(self.data), "chunk too long")


def entries(data, partial):  # sections 3, 4 and 10
    """Yield the entries of the index, each with value_count, and the stored bytes, None where a prefix lacks them."""
    require(len(data) >= 64 and data[:8] == b"\x89KPC\r\n\x1a\n", "not a .kpc file")
    (
        version,
        flags,
        header_length,
        index_offset,
        index_length,
        count,
        file_length,
        value_count,
        largest_raw,
        reserved,
        index_crc,
        header_crc,
    ) = struct.unpack("<HHIQIIQQIIII", data[8:64])
    require(version in (0, 1, 2), "unknown version")
    require(crc32c(data[:60]) == header_crc, "header damaged")
    require(flags == reserved == 0 and header_length == index_offset == 64, "reserved field")
    require(
        1 <= count <= 65536 and (index_length < 40 * count if version == 2 else index_length == 40 * count),
        "chunk count",
    )
    require(version != 2 or file_length >= 64 + 8 * count, "chunk count")
    require(len(data) <= file_length if partial else len(data) == file_length, "file length")
    require(max(value_count, largest_raw) <= file_length * 32768, "limits")
    index = data[64 : 64 + index_length]
    require(len(index) == index_length and crc32c(index) == index_crc, "index damaged")
    if version == 2:
        columns = decoded(index, 1, 32 * count)
        listed = [columns[k::count] for k in range(count)]
    else:
        listed = [index[40 * k : 40 * k + 40] for k in range(count)]
    expected = 64 + index_length
    for entry in listed:
        kind, group, scale, plane, start, rows, codec, reserved, stored, raw, crc = struct.unpack(
            "<4sHBBIIHHIII", entry[:32]
        )
        require(kind.isalpha() and reserved == 0 and raw <= largest_raw, "index entry")
        offset = expected
        require(version == 2 or struct.unpack("<Q", entry[32:]) == (offset,), "offset")
        expected += stored
        body = data[offset : offset + stored]
        if len(body) < stored:
            require(partial, "chunk cut off")
            body = None if kind != b"GRUP" else body
        elif kind != b"GRUP":
            require(crc32c(body) == crc, "chunk damaged")
        yield kind, group, scale, plane, start, rows, codec, stored, raw, value_count, body
    require(expected == file_length, "chunks do not fill the file")


def chunks(data, partial):  # section 4
    """Yield (kind, scale, plane, row_start, row_count, raw, value_count) of all chunks of a scene; raw is None where a prefix
    lacks it."""
    for kind, group, scale, plane, start, rows, codec, stored, raw, value_count, body in entries(data, partial):
        known = kind in (b"SCNE", b"DECO", b"HYBR", b"OCCU", b"PLNE", b"WARP", b"MOVE", b"came", b"appe")
        require(known or not kind[:1].isupper(), "unknown critical chunk")
        require(not known or (kind == b"PLNE" and group == 0) or group == scale == plane == start == rows == 0, "place")
        if known:
            if (
                kind in (b"PLNE", b"OCCU", b"MOVE", b"DECO", b"HYBR", b"came")
                and codec == 2
                or kind in (b"MOVE", b"PLNE")
                and codec == 3
            ):
                require(raw <= 32768 * stored, "so much in too few bytes")
                content = None if body is None else (raw, body, codec)
            else:
                content = None if body is None else decoded(body, codec, raw)
            yield kind.decode(), scale, plane, start, rows, content, value_count


def groups(data, partial=False):  # section 4
    """Of a clip in groups, [(row_start, row_count, the group's file)] in their order and [what `decode` makes of them]; None of
    other files."""
    found = {}
    listed = list(entries(data, partial))
    if not any(kind == b"GRUP" for kind, *_ in listed):
        return None
    for kind, group, scale, plane, start, rows, codec, stored, raw, most, body in listed:
        require(kind == b"GRUP" or not kind[:1].isupper(), "a chunk of a scene beside groups")
        if kind == b"GRUP":
            require(codec == scale == plane == 0 and raw == stored and rows > 0 and group not in found, "group")
            found[group] = start, rows, body, stored
    require(sorted(found) == list(range(len(found))), "numbers of groups")
    found = [found[group] for group in range(len(found))]
    for (a, n, *_), (b, m, *_) in zip(found, found[1:]):
        require(a < b <= a + n and a + n < b + m, "frames of groups")
    require(found[-1][0] + found[-1][1] - found[0][0] <= 1 << 24, "frames")
    scenes = [decode(body, len(body) < stored) for _, _, body, stored in found if len(body) == stored or not partial]
    require(all(a + n <= b for (a, n, *_), (b, *_) in zip(found, found[2:])), "a frame in three groups")
    for (_, rows, _, _), scene in zip(found, scenes):
        require(scene["frame_count"] == rows and scene["fps"] == scenes[0]["fps"], "a group's clip")
        require(scene["value_count"] <= most, "value count of a group")
    return [(start, rows, body) for start, rows, body, _ in found], scenes


def shown(spans, time):  # section 4
    """(number, time in it) of the group that shows at a time; `spans`: (row_start, row_count) of each."""
    ends = [start + rows - 1 for start, rows in spans]
    f = spans[0][0] + time * (ends[-1] - spans[0][0])
    g = sum(f >= (ends[k - 1] + spans[k][0]) / 2 for k in range(1, len(spans)))
    start, rows = spans[g]
    return g, min(max((f - start) / (rows - 1), 0.0), 1.0) if rows > 1 else 0.0


def mix(spans, time):  # section 4
    """{number: share of the picture} of the group, or the two, that show at a time."""
    f = spans[0][0] + time * (spans[-1][0] + spans[-1][1] - 1 - spans[0][0])
    for k in range(1, len(spans)):
        a, b = spans[k][0], spans[k - 1][0] + spans[k - 1][1] - 1
        if a < f < b:
            return {k - 1: (b - f) / (b - a), k: (f - a) / (b - a)}
    return {shown(spans, time)[0]: 1.0}


def decoded(body, codec, raw_length):  # section 4
    require(codec in (0, 1), "unknown codec")
    if codec == 1:
        try:
            require(zstandard.get_frame_parameters(body).content_size == raw_length, "zstd content size")
            body = zstandard.ZstdDecompressor().decompress(body, max_output_size=raw_length, allow_extra_data=False)
        except zstandard.ZstdError as error:
            raise Refused("zstd") from error
    require(len(body) == raw_length, "raw length")
    return body


def decode(data, partial=False):
    """The scene as a dict of plain numbers and lists."""
    parts, segments, value_count = {}, [], 0
    for kind, scale, plane, start, rows, raw, value_count in chunks(data, partial):
        if kind == "PLNE":
            segments.append((scale, plane, start, rows, raw))
        else:
            require(kind not in parts, f"two {kind} chunks")
            parts[kind] = raw
    for kind in ("SCNE", "HYBR" if "HYBR" in parts else "DECO", "OCCU"):
        require(parts.get(kind) is not None, f"no {kind} chunk")
    require(not ("DECO" in parts and "HYBR" in parts), "two decoders")
    scene = scene_chunk(Bytes(parts["SCNE"]))
    values = sum(p["rows"] * p["columns"] * s["channels"] for s in scene["scales"] for p in s["planes"].values())
    require(values == value_count, "value count")
    scene["value_count"] = value_count
    require("WARP" not in parts or parts["WARP"] is not None, "no WARP chunk")
    scene |= {"even": None, "frame": None}
    if "WARP" in parts:
        scene |= warp_chunk(Bytes(parts["WARP"]), scene)
    require("MOVE" not in parts or parts["MOVE"] is not None, "no MOVE chunk")
    scene["motion"] = motion_chunk(parts["MOVE"], scene["scales"]) if "MOVE" in parts else None
    expected = sum(s["channels"] for s in scene["scales"])
    scene |= hybrid_chunk(parts["HYBR"], expected) if "HYBR" in parts else decoder_chunk(parts["DECO"], expected)
    scene |= (
        coded_occupancy_chunk(*parts["OCCU"][:2])
        if isinstance(parts["OCCU"], tuple)
        else occupancy_chunk(Bytes(parts["OCCU"]))
    )
    scene["cameras"] = cameras_chunk(parts["came"]) if parts.get("came") is not None else []
    scene["appearances"] = (
        appearances_chunk(Bytes(parts["appe"]), scene["hidden"]) if parts.get("appe") is not None else {}
    )

    for scale in scene["scales"]:
        for plane in scale["planes"].values():  # uncoded until a segment says otherwise
            texels = plane["rows"] * plane["columns"]
            plane["coded"], plane["symbols"], plane["next_row"], plane["segments"], plane["held"] = (
                [0] * texels,
                [0] * (texels * scale["channels"]),
                0,
                0,
                False,
            )
    for scale, number, start, rows, raw in sorted(segments, key=lambda s: s[:3]):
        require(scale < len(scene["scales"]) and number < 6, "place")
        planes, name = scene["scales"][scale]["planes"], PLANES[number]
        require(name in planes and rows > 0 and planes[name]["next_row"] == start, "segments")
        plane, channels = planes[name], scene["scales"][scale]["channels"]
        plane["next_row"] += rows
        plane["segments"] += 1
        if raw is not None:
            plane["held"] = True
            if isinstance(raw, tuple):
                require(raw[0] == rows * plane["columns"] * channels, "number of symbols")
                place = scene, name, plane["rows"], plane["columns"], start
                coded, symbols = context_coded(Bytes(raw[1]), raw[2], rows, plane["columns"], channels, place)
            else:
                coded, symbols = segment(Bytes(raw), rows, plane["columns"], channels)
            first = start * plane["columns"]
            plane["coded"][first : first + len(coded)] = coded
            plane["symbols"][first * channels : first * channels + len(symbols)] = symbols
    for scale in scene["scales"]:
        channels = scale["channels"]
        for name, plane in scale["planes"].items():
            require(plane["next_row"] == plane["rows"], "rows left out")
            require(name in PLANES[3:] or plane["segments"] == 1, "a space plane in pieces")
            if name in PLANES[:3] and not plane["held"]:  # section 10
                plane["offset"] = [0.0] * channels
            plane["values"] = [
                f32(f32(s * plane["step"][i % channels]) + plane["offset"][i % channels])
                for i, s in enumerate(plane["symbols"])
            ]
    return scene


def scene_chunk(chunk):  # section 5
    *aabb, frame_count, fps, step, r, g, b, scale_count, dynamic = chunk.unpack("6fIdd3fBB")
    low, high = aabb[:3], aabb[3:]
    require(all(abs(a) <= 2**30 for a in aabb) and all(b - a >= 2**-30 for a, b in zip(low, high)), "box")
    require(1 <= frame_count <= 1 << 24 and math.isfinite(fps) and fps > 0, "clip")
    require(math.isfinite(step) and step > 0 and math.dist(low, high) / step <= 65536, "step")
    require(all(0 <= c <= 1 for c in (r, g, b)) and 1 <= scale_count <= 16 and dynamic <= 1, "background or scales")
    scales = []
    for _ in range(scale_count):
        channels, *size = chunk.unpack("5H")
        size = dict(zip("xyzt", size))
        require(1 <= channels <= 256 and all(1 <= size[a] <= 16384 for a in "xyz") and size["t"] <= 16384, "size")
        require((size["t"] > 0) == bool(dynamic), "rows in time")
        planes = {}
        for name in PLANES[: 6 if dynamic else 3]:
            step_of = chunk.unpack(f"{channels}f")
            offset_of = chunk.unpack(f"{channels}f") if "t" not in name else (1.0,) * channels
            require(all(s > 0 and 128 * s + abs(o) <= 2048 for s, o in zip(step_of, offset_of)), "step or offset")
            planes[name] = {"columns": size[name[0]], "rows": size[name[1]], "step": step_of, "offset": offset_of}
        scales.append({"channels": channels, "planes": planes})
    chunk.end()
    return {
        "aabb": [low, high],
        "frame_count": frame_count,
        "fps": fps,
        "step": step,
        "background": [r, g, b],
        "scales": scales,
    }


def warp_chunk(chunk, scene):  # section 5
    (mapping,) = chunk.unpack("I")
    require(mapping in (1, 2), "mapping")
    if mapping == 1:
        (even,) = chunk.unpack("d")
        require(2**-30 <= even <= 2**30 and 2 * even / scene["step"] <= 65536, "even")
        chunk.end()
        return {"even": even}
    *frame, near, baseline = chunk.unpack("12ddd")
    chunk.end()
    require(
        all(2**-30 <= x <= 2**30 for x in (near, baseline)) and all(abs(x) <= 2**30 for x in frame),
        "device coordinates",
    )
    axes = [frame[column::4] for column in range(4)]  # right, up, backward, eye
    for i in range(3):
        for j in range(3):
            require(abs(sum(a * b for a, b in zip(axes[i], axes[j])) - (i == j)) < 1e-4, "frame")
    require(scene["aabb"][1][2] < baseline / near, "box")
    return {"frame": axes, "near": near, "baseline": baseline}


def motion_chunk(content, scales):  # section 5
    """`content`: the raw bytes, or with codecs 2 and 3 their length, the stored bytes and the codec."""
    coded = isinstance(content, tuple)
    chunk = Bytes(content[1] if coded else content)
    rows, *nodes, step = chunk.unpack("4Hf")
    require("xt" in scales[0]["planes"] and 2 <= rows <= 16384 and all(2 <= n <= 256 for n in nodes), "motion grid")
    require(step > 0 and 32768 * step <= 1024, "motion step")
    if coded:
        require(content[0] == 12 + 6 * rows * math.prod(nodes), "raw length")
        symbols = {2: coded_motion, 3: halved_motion}[content[2]](chunk, rows, *nodes)
    else:
        symbols = summed_motion(chunk, rows, 3 * math.prod(nodes))
    return {"size": (rows, *nodes), "values": [f32(s * step) for s in symbols]}


def summed_motion(chunk, rows, a_row):
    low, high = chunk.take(rows * a_row), chunk.take(rows * a_row)
    chunk.end()
    symbols = []
    for i in range(rows * a_row):
        symbols.append((low[i] + 256 * high[i] + (symbols[i - a_row] if i >= a_row else 0)) % 65536)
    return [s - 65536 if s > 32767 else s for s in symbols]


def coded_motion(chunk, rows, nz, ny, nx):  # section 5, codec 2
    k = chunk.unpack("15h")
    decisions, v, r = Decisions(chunk), {}, {}
    for t in range(rows):
        for z in range(nz):
            for y in range(ny):
                for x in range(nx):
                    for component in range(3):
                        places = {
                            i: (t - (i >> 3), z - (i >> 2 & 1), y - (i >> 1 & 1), x - (i & 1), component)
                            for i in range(16)
                        }
                        there = [i for i in range(1, 16) if places[i] in v]
                        weights = (
                            k if len(there) == 15 else [1024 if i.bit_count() % 2 else -1024 for i in range(1, 16)]
                        )
                        predicted = sum(weights[i - 1] * v[places[i]] for i in there) + 512 >> 10
                        predicted = min(max(predicted, -32768), 32767)
                        around = [r[places[i]] for i in (8, 4, 2, 1) if i in there]
                        a = sum(around) // len(around) + 2 if around else 66
                        b = a.bit_length()
                        error = decisions.error(min(2 * (b - 2) + (a >> b - 2) % 2, 19), most_bits=15)
                        require(-32768 <= predicted + error <= 32767, "a symbol leaves 16 bits")
                        v[places[0]], r[places[0]] = predicted + error, abs(error)
    decisions.end()
    return list(v.values())


def halved_motion(chunk, *sizes):  # section 5, codec 3
    decisions, v, r = Decisions(chunk), {}, {}
    there = [[0] for _ in sizes]

    def tell(axis, new, sides, weights):
        """Of one new place, that is foreseen by those at the sides."""
        others = [there[a] for a in range(4) if a != axis]
        for place in itertools.product(*others):
            node = (*place[:axis], new, *place[axis:])
            back = [
                (*place[:a], others[a][others[a].index(place[a]) - 1], *place[a + 1 :])
                for a in range(3)
                if place[a] > 0
            ]
            before = [(*one[:axis], new, *one[axis:]) for one in back]
            for c in range(3):
                used = [(k, (*place[:axis], sides[k], *place[axis:], c)) for k in range(4) if weights[k]]
                predicted = min(max(sum(weights[k] * v[at] for k, at in used) + 32 >> 6, -32768), 32767)
                R = sum(r[at] * (2 if k in (1, 2) else 1) for k, at in used) + 3 * sum(r[(*node, i)] for i in range(c))
                R += sum(r[(*one, i)] for one in before for i in range(3))
                b = R.bit_length()
                error = decisions.error(b if b < 2 else min(2 * b - 2 + (R >> b - 2) % 2, 19), most_bits=15)
                require(-32768 <= predicted + error <= 32767, "a symbol leaves 16 bits")
                v[(*node, c)], r[(*node, c)] = predicted + error, abs(error)

    def weight(new, own, others):
        A = 64 * math.prod(new - one for one in others)
        B = math.prod(own - one for one in others)
        return (2 * A + B) // (2 * B)

    tell(0, 0, [0] * 4, [0] * 4)
    for axis, n in enumerate(sizes):
        tell(axis, n - 1, [0] * 4, [0, 64, 0, 0])
        there[axis].append(n - 1)
    for h in range(max((n - 2).bit_length() for n in sizes), 0, -1):
        for axis, n in enumerate(sizes):
            if (n - 2).bit_length() >= h:
                old = there[axis]
                found = [(old[i], i) for i in range(len(old) - 1) if old[i + 1] - old[i] > 1]
                for p, i in found:
                    sides = [old[k] if 0 <= k < len(old) else None for k in range(i - 1, i + 3)]
                    u, real = p + old[i + 1] >> 1, [s for s in sides if s is not None]
                    weights = [0 if s is None else weight(u, s, [one for one in real if one != s]) for s in sides]
                    weights[1] += 64 - sum(weights)
                    tell(axis, u, sides, weights)
                there[axis] = sorted(old + [p + old[i + 1] >> 1 for p, i in found])
    decisions.end()
    return [v[at] for at in itertools.product(*map(range, sizes), range(3))]


def segment(chunk, rows, columns, channels):  # section 6
    """(coded, symbols): a flat list of 0 or 1 for each texel, and of symbols by row, column, channel."""
    (flag,) = chunk.unpack("B")
    require(flag <= 1, "map flag")
    texels = rows * columns
    coded = bits(chunk.take(-(-texels // 8)), texels) if flag else [1] * texels
    filters = chunk.take(channels)
    symbols = [0] * (texels * channels)
    for c in range(channels):
        require(filters[c] <= 3, "filter")
        residuals = iter(chunk.take(sum(coded)))
        v = [[0] * (columns + 1) for _ in range(rows + 1)]  # a row and a column of zeros around it
        for y in range(rows):
            for x in range(columns):
                left, up, corner = v[y + 1][x], v[y][x + 1], v[y][x]
                predicted = (0, left, up, left + up - corner)[filters[c]]
                residual = next(residuals) if coded[y * columns + x] else 0
                v[y + 1][x + 1] = value = (residual + predicted) % 256
                if coded[y * columns + x]:
                    symbols[(y * columns + x) * channels + c] = value - 256 if value > 127 else value
    chunk.end()
    return coded, symbols


class Decisions:  # section 6, codec 2
    def __init__(self, chunk):
        """From state and words, which are the rest of the chunk."""
        (self.state,) = chunk.unpack("I")
        require(self.state >= 1 << 16, "first state")
        words = chunk.rest()
        require(len(words) % 2 == 0, "half a word")
        self.words, self.counters = list(struct.unpack(f"<{len(words) // 2}H", words))[::-1], {}

    def end(self):
        require(not self.words and self.state == 1 << 16, "words and decisions end apart")

    def decide(self, p):
        low, high = self.state % 4096, self.state >> 12
        one = low < p
        self.state = p * high + low if one else (4096 - p) * high + low - p
        if self.state < 1 << 16:
            require(self.words, "too few words")
            self.state = self.state << 16 | self.words.pop()
        return int(one)

    def by_counter(self, name, first=(32768, 0)):
        P, n = self.counters.get(name, first)
        one, R = self.decide(P >> 4), 327680 // (5 * n + 8)
        self.counters[name] = (P + ((65536 - P) * R >> 16) if one else P - (P * R >> 16)), min(n + 1, 120)
        return one

    def error(self, context, unary=4, most_bits=7):
        if not self.by_counter((context, "any")):
            return 0
        sign = 1 if self.by_counter((context, "positive")) else -1
        return sign * self.magnitude(lambda k: self.by_counter((context, sign, k)), unary, most_bits)

    def magnitude(self, decided, unary, most_bits):
        """From 1 on; `decided`: by the counter of this number."""
        for k in range(unary):
            if not decided(k):
                return k + 1
        bits = 0
        while bits < most_bits and decided(unary + bits):
            bits += 1
        spelt = 0
        for _ in range(bits):
            spelt = 2 * spelt + self.decide(2048)
        return unary + 2**bits + spelt

    def map(self, H, W):
        coded = {}
        around = [(2, 1), (2, 0), (2, -1), (1, 2), (1, 1), (1, 0), (1, -1), (1, -2), (0, 2), (0, 1)]
        for y in range(H):
            for x in range(W):
                coded[y, x] = self.by_counter(("map", *(coded.get((y - i, x - j), 0) for i, j in around)))
        return coded


def untold_map(flags, H, W, place):  # section 6, codec 3
    implied = implied_map(*place) if flags & 16 else None
    return {(y, x): 1 if implied is None else implied[y, x] for y in range(H) for x in range(W)}


def implied_map(scene, name, rows, columns, start):
    """{(y, x): 0 or 1}, y from row `start` of the plane on."""
    nx, ny, nz = scene["cells"]
    sizes = {"x": nx, "y": ny, "z": nz, "t": scene["slots"]}
    seen = set()
    for place, occupied in enumerate(scene["occupancy"]):
        if occupied:
            cell = {
                "t": place % scene["slots"],
                "x": place // scene["slots"] % nx,
                "y": place // scene["slots"] // nx % ny,
                "z": place // scene["slots"] // nx // ny,
            }
            seen.add((cell[name[1]], cell[name[0]]))

    def reaches(cell, cells, texel, texels):
        return (texel + 1) * cells >= cell * (texels - 1) and (texel - 1) * cells <= (cell + 1) * (texels - 1)

    found = {(y - start, x): 0 for y in range(start, rows) for x in range(columns)}
    for down, across in seen:
        within = [x for x in range(columns) if reaches(across, sizes[name[0]], x, columns)]
        for y in range(start, rows):
            if reaches(down, sizes[name[1]], y, rows):
                found |= {(y - start, x): 1 for x in within}
    return found


def context_coded(chunk, codec, H, W, channels, place=None):  # section 6, codecs 2 and 3
    """As `segment`. place: of it, the arguments of `implied_map`."""
    set_count, flags = chunk.unpack("BB")
    lattice = flags // 2 % 4
    require(flags < 32 and (flags & 8 > 0) == (codec == 3) and (flags & 16 == 0 or flags & 9 == 8), "flags")
    if lattice == 3:
        return in_blocks(chunk, set_count, flags, H, W, channels, place)
    require(set_count in (1, 2, 4, 8), "sets of weights")
    sets = [chunk.unpack("9b") for _ in range(set_count)]
    decisions = Decisions(chunk)
    coded = decisions.map(H, W) if flags & 1 else untold_map(flags, H, W, place)

    symbols = [0] * (H * W * channels)
    cross = {}
    for c in range(channels):
        known = {}  # (v, r) of the texels so far

        def at(y, x, row):
            """v and r at (y, x), seen from a texel of that row."""
            if y == -1 and row == 1:
                y = 0
            if x < 0:
                return known[y - 1, 0] if y > 0 else (0, 16)
            return known[y, min(x, W - 1)]

        for y in range(H):
            place = 0
            for x in range(W):
                left = at(y, x - 1, y)

                def near(i, j):
                    return left if y == 0 and i < 0 else at(y + i, x + j, y)

                if not coded[y, x]:
                    known[y, x] = left if y == 0 or coded.get((y, x - 1)) else near(-1, 1)
                    continue
                (w, r_w), (n, r_n), (nw, r_nw), (ne, r_ne) = near(0, -1), near(-1, 0), near(-1, -1), near(-1, 1)
                (ww, r_ww), (nn, r_nn) = near(0, -2), near(-2, 0)
                both = w + n
                gradient = abs(w - nw) + abs(n - nw) + abs(n - ne) + abs(w - ww) + abs(n - nn)
                k = sets[min(gradient.bit_length(), 7) * set_count >> 3]
                others = [nw, ne, ww, nn, near(-1, -2)[0], near(-2, -1)[0], near(-2, 1)[0], near(-1, 2)[0]]
                predicted = 64 * both + k[0] * (w - n) + sum(a * (2 * v - both) for a, v in zip(k[1:], others))
                predicted = min(max(predicted, -16384), 16256)
                own = 2 * r_w + 2 * r_n + r_nw + r_ne + r_ww + r_nn
                activity = (11 * own + 5 * cross[y, x] >> 2 if c else 4 * own) + 20 * gradient
                a = activity + 128 >> 6
                b = a.bit_length()
                active = 2 * (b - 2) + (a >> b - 2) % 2
                around, odd = lattice == 2 and active < 4, place % 2
                if lattice > 0 and not around:
                    whole = 2 * (predicted - 128 * odd + 128 >> 8) + odd
                else:
                    whole = predicted + 64 >> 7
                fraction = predicted - 128 * whole
                error = decisions.error(
                    3 * active + (odd if around else min(3 * abs(fraction) >> (7 if lattice else 6), 2))
                )
                if fraction < 0:
                    error = -error
                if around:
                    v = whole + 2 * error - (odd if error > 0 else -odd if error < 0 else 0)
                    onward = error % 2
                else:
                    v = whole + error * (2 if lattice else 1)
                    onward = v % 4 >= 2
                require(-128 <= v <= 127, "a symbol leaves 8 bits")
                place = place // 2 ^ (5 if odd else 0) ^ (2 if onward else 0)
                known[y, x] = v, abs(128 * v - predicted) >> 3
                symbols[(y * W + x) * channels + c] = v
        for y in range(H):
            for x in range(W):
                smooth = (
                    sum(
                        (2 - abs(i)) * (2 - abs(j)) * at(min(max(y + i, 0), H - 1), x + j, 0)[1]
                        for i in (-1, 0, 1)
                        for j in (-1, 0, 1)
                    )
                    >> 1
                )
                cross[y, x] = cross[y, x] + (smooth - cross[y, x] >> 3) if c else smooth
    decisions.end()
    return [coded[y, x] for y in range(H) for x in range(W)], symbols


COSINES = [181, 180, 178, 173, 167, 160, 151, 140, 128, 115, 101, 85, 69, 53, 35, 18, 0]
COARSER = {
    4: [52, 55, 64, 80],
    8: [52, 53, 55, 59, 64, 71, 80, 87],
    16: [52, 52, 53, 54, 55, 57, 59, 61, 64, 67, 71, 75, 80, 84, 87, 90],
}
FINER = [181, 128, 91, 64, 45, 32, 23, 16]
LIKELY = [
    [27, 66, 61, 86, 79, 96, 118, 143, 168, 190, 206, 220, 230, 238, 243, 248],
    [19, 26, 24, 37, 37, 48, 67, 90, 120, 151, 179, 201, 217, 229, 235, 244],
    [110, 100, 90, 86, 82, 80, 87, 98, 117, 135, 160, 184, 204, 220, 230, 243],
]
LIKELY_MEANS = [243, 210, 220]
AGREES = [134, 135, 138, 141, 152, 159, 164, 170, 178, 184, 190, 197, 205, 212, 218, 224, 229, 234, 239, 244]
LOG2 = {4: 2, 8: 3, 16: 4}


def doublings(k):
    """large, of a total."""
    n = k.bit_length()
    return n if n < 2 else 2 * n - 2 + (k >> n - 2) % 2


def in_blocks(chunk, N, flags, H, W, channels, place):  # section 6, blocks
    """As `segment`."""
    (Q,) = chunk.unpack("B")
    require(N in (4, 8, 16) and (N == 4 or N <= 2 * min(H, W)) and Q > 0, "side of blocks or quantiser")
    decisions, borders = Decisions(chunk), flags & 8
    coded = decisions.map(H, W) if flags & 1 else untold_map(flags, H, W, place)
    BY, BX = -(-H // N), -(-W // N)
    told = {
        (b, d): any(coded.get((y, x)) for y in range(b * N, b * N + N) for x in range(d * N, d * N + N))
        for b in range(BY)
        for d in range(BX)
    }
    fine = {}
    for b, d in told:
        left = fine[b, d - 1] if d else fine[b - 1, d] if b else 3
        f = left + (fine[b - 1, d] if b else left) + 1 >> 1
        if told[b, d]:
            node = 1
            for _ in range(3):
                node = 2 * node + decisions.by_counter(("fine", f, node))
            f = node - 8
        fine[b, d] = f

    def cosine(i, y):
        k = 16 // N * i * (2 * y + 1) % 64
        k = min(k, 64 - k)
        return 128 if i == 0 else COSINES[k] if k <= 16 else -COSINES[32 - k]

    def level(c, i, j):
        near = lambda block, di, dj: size.get((c, *block, i + di, j + dj), 0)  # noqa: E731
        here = b, d
        quicker = 2 * (near(here, 0, 1) + near(here, 1, 0)) + near(here, 1, 1) + near(here, 0, 2) + near(here, 2, 0)
        beside = sum(near(block, *by) for block in ((b, d - 1), (b - 1, d)) for by in ((0, 0), (0, 1), (1, 0)))
        total = 3 * quicker + 2 * beside + 3 * size.get((c - 1, b, d, i, j), 0)
        large = min(doublings(total), 15)
        quick = min(5 * (i + j) // N, 7) if i + j else 8

        def decided(k):
            likely = LIKELY_MEANS[min(k, 2)] if quick == 8 else LIKELY[min(k, 2)][large]
            return decisions.by_counter((large, quick, k), (256 * likely, 8) if k <= 5 else (32768, 0))

        if not decided(0):
            return 0
        m = decisions.magnitude(lambda k: decided(k + 1), 5, 12)
        return m if borders and i + j or decisions.decide(2048) else -m

    def tell_signs(levels, q, end, beside, over):
        """Make those levels negative that are. beside, over: what lies across the borders, None where nothing does."""
        left, above = [8 * v for v in beside or [0] * N], [8 * v for v in over or [0] * N]
        shift = 7 + LOG2[N]

        def follow(i, j, c):
            for k in range(N):
                left[k] -= cosine(i, k) * (cosine(j, 0) * c + 64 >> 7) + (1 << shift - 1) >> shift
                above[k] -= cosine(j, k) * (cosine(i, 0) * c + 64 >> 7) + (1 << shift - 1) >> shift

        def pull(border, along, across):
            return cosine(across, 0) * (sum(min(max(border[k], -4095), 4095) * cosine(along, k) for k in range(N)) >> 7)

        follow(0, 0, min(max(levels[0, 0] * q[0, 0], -32768), 32767))
        for i, j in [
            (i, diagonal - i)
            for diagonal in range(1, end)
            for i in range(max(0, diagonal - N + 1), min(diagonal, N - 1) + 1)
        ]:
            if levels[i, j]:
                c = min(levels[i, j] * q[i, j], 32767)
                s = (pull(left, i, j) if beside else 0) + (pull(above, j, i) if over else 0)
                if s:
                    place = min(max(doublings(abs(s)) + doublings(c) - 2 * doublings(q[0, 0]) - 2 * LOG2[N] - 3, 0), 19)
                    positive = decisions.by_counter(("sign", place), (256 * AGREES[place], 8)) == (s > 0)
                else:
                    positive = decisions.decide(2048)
                if not positive:
                    levels[i, j], c = -levels[i, j], -c
                follow(i, j, c)

    symbols, size, end = [0] * (H * W * channels), {}, {}
    for c in range(channels):
        mean, right, bottom = {}, {}, {}
        for b, d in told:
            q = {
                (i, j): max(Q * FINER[fine[b, d]] * COARSER[N][i] * COARSER[N][j] + 131072 >> 18, 1)
                for i in range(N)
                for j in range(N)
            }
            if b == 0 or d == 0:
                mean[b, d] = mean[b, d - 1] if d else mean[b - 1, d] if b else 0
            else:
                left, above = mean[b, d - 1], mean[b - 1, d]
                mean[b, d] = min(max(left, above), max(min(left, above), left + above - mean[b - 1, d - 1]))
            if not told[b, d]:
                continue
            beside, over = right.get((b, d - 1)), bottom.get((b - 1, d))
            ends = end.get((c, b, d - 1), 0), end.get((c, b - 1, d), 0), end.get((c - 1, b, d), 0)
            expected = mean[b, d]
            if borders:
                if beside or over:
                    expected = sum(beside or over) * 4 + sum(over or beside) * 4 + expected >> 1
                context = min(doublings(sum(ends)), 9)
                end[c, b, d] = min(
                    decisions.magnitude(lambda k: decisions.by_counter(("end", context, k)), 2, 4) - 1, 2 * N - 1
                )  # noqa: B023
            else:
                usual = ends[0] + ends[1] + 2 * ends[2] + 2 >> 2
                context = 0 if usual == 0 else 1 + (usual - 1) * 7 // (2 * N - 1)
                end[c, b, d] = min(max(usual + decisions.error(("end", context), 6, 4), 0), 2 * N - 1)
            foreseen = (expected + q[0, 0] // 2) // q[0, 0]
            levels = {}
            for diagonal in range(end[c, b, d] - 1, -1, -1):
                for i in range(max(0, diagonal - N + 1), min(diagonal, N - 1) + 1):
                    levels[i, diagonal - i] = value = level(c, i, diagonal - i)
                    size[c, b, d, i, diagonal - i] = abs(value)
            levels[0, 0] = levels.get((0, 0), 0) + foreseen
            if borders:
                tell_signs(levels, q, end[c, b, d], beside, over)
            factors = {at: min(max(value * q[at], -32768), 32767) for at, value in levels.items()}
            mean[b, d] = factors[0, 0]
            down = [
                [sum(cosine(i, y) * factors.get((i, j), 0) for i in range(N)) + 64 >> 7 for j in range(N)]
                for y in range(N)
            ]
            shift = 10 + LOG2[N]
            v = [
                [
                    min(max(sum(cosine(j, x) * down[y][j] for j in range(N)) + (1 << shift - 1) >> shift, -128), 127)
                    for x in range(N)
                ]
                for y in range(N)
            ]
            right[b, d], bottom[b, d] = [row[-1] for row in v], v[-1]
            for y in range(min(N, H - b * N)):
                for x in range(min(N, W - d * N)):
                    if coded[b * N + y, d * N + x]:
                        symbols[((b * N + y) * W + d * N + x) * channels + c] = v[y][x]
    decisions.end()
    return [coded[y, x] for y in range(H) for x in range(W)], symbols


def decoder_chunk(content, expected):  # section 7
    """`content`: the raw bytes, or with codec 2 their length and the stored bytes, among others."""
    chunk = opened(content)
    features, hidden, bias = chunk.unpack("HHf")
    require(features == expected and 1 <= hidden <= 256 and math.isfinite(bias), "decoder sizes")
    weights = {
        "density_weight": features,
        "w1": hidden * 9,
        "b1": hidden,
        "w2": 3 * features * hidden,
        "b2": 3 * features,
    }
    return weights_of(content, chunk, weights) | {"density_bias": bias, "hidden": hidden, "width": None}


def hybrid_chunk(content, expected):  # section 7
    chunk = opened(content)
    features, width, hidden, bias = chunk.unpack("HHHf")
    require(features == expected and 1 <= width <= 256 and 1 <= hidden <= 256 and math.isfinite(bias), "decoder sizes")
    weights = {
        "v": width * features,
        "v_bias": width,
        "density_weight": width,
        "w1": hidden * 9,
        "b1": hidden,
        "u": hidden * width,
        "w2": 3 * hidden,
        "b2": 3,
    }
    return weights_of(content, chunk, weights) | {"density_bias": bias, "hidden": hidden, "width": width}


def opened(content):
    return Bytes(content[1] if isinstance(content, tuple) else content)


def weights_of(content, chunk, counts):
    if isinstance(content, tuple):
        require(content[0] == chunk.at + 2 * sum(counts.values()), "raw length")
        return multiples(chunk, counts)
    weights = {name: chunk.unpack(f"{count}e") for name, count in counts.items()}
    require(all(math.isfinite(w) for array in weights.values() for w in array), "weights")
    chunk.end()
    return weights


def multiples(chunk, counts):  # codec 2
    powers = chunk.unpack(f"{len(counts)}b")
    require(all(-24 <= power <= 15 for power in powers), "powers of two")
    decisions, weights = Decisions(chunk), {}
    for (name, count), power in zip(counts.items(), powers):
        wholes = [decisions.error((name, "weights"), most_bits=10) for _ in range(count)]
        require(all(abs(k) <= 2048 and abs(k) * 2.0**power <= 65504 for k in wholes), "weights")
        weights[name] = tuple(k * 2.0**power for k in wholes)
    decisions.end()
    return weights


def occupancy_chunk(chunk):  # section 8
    slots, nz, ny, nx = chunk.unpack("4H")
    require(all(1 <= n <= 16384 for n in (slots, nz, ny, nx)), "grid")
    return {"cells": (nx, ny, nz), "slots": slots, "occupancy": bits(chunk.rest(), slots * nz * ny * nx)}


def coded_occupancy_chunk(raw_length, body):  # section 8, codec 2
    chunk = Bytes(body)
    slots, nz, ny, nx = chunk.unpack("4H")
    require(all(1 <= n <= 16384 for n in (slots, nz, ny, nx)), "grid")
    require(raw_length == 8 + -(-slots * nz * ny * nx // 8), "raw length")
    decisions, occupied = Decisions(chunk), {}
    around = [
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
    for s in range(slots):
        for z in range(nz):
            for y in range(ny):
                for x in range(nx):
                    near = [occupied.get((s + h, z + k, y + j, x + i), 0) for h, k, j, i in around]
                    occupied[s, z, y, x] = decisions.by_counter(tuple(near))
    decisions.end()
    return {
        "cells": (nx, ny, nz),
        "slots": slots,
        "occupancy": [
            occupied[s, z, y, x] for z in range(nz) for y in range(ny) for x in range(nx) for s in range(slots)
        ],
    }


def cameras_chunk(content):  # section 9
    """`content`: the raw bytes, or with codec 2 their length, the stored bytes and the codec."""
    if isinstance(content, tuple):
        cameras = posed_cameras(Bytes(content[1]))
        require(content[0] == 2 + 68 * len(cameras), "raw length")
    else:
        chunk = Bytes(content)
        (count,) = chunk.unpack("H")
        cameras = [chunk.unpack("HH16f") for _ in range(count)]
        chunk.end()
    require(1 <= len(cameras) <= 4096, "number of cameras")
    for width, height, *numbers in cameras:
        require(width and height and all(abs(n) <= 2**30 for n in numbers) and min(numbers[:2]) > 0, "camera")
        axes = [[numbers[4 + 4 * row + column] for row in range(3)] for column in range(3)]
        require(all(0.5 <= math.hypot(*axis) <= 2 for axis in axes), "camera axes")
    return cameras


def posed_cameras(chunk):  # section 9, codec 2
    count, lens_count, exponent, *corner = chunk.unpack("HHb3i")
    require(1 <= count <= 4096 and lens_count in (1, count) and -126 <= exponent <= 30, "poses")
    lenses, cameras = [chunk.unpack("HH4f") for _ in range(lens_count)], []
    for number in range(count):
        turn, place = (int.from_bytes(chunk.take(7), "little") for _ in range(2))
        require(place < 1 << 54, "place")
        q = [(turn >> 18 * i & 0x3FFFF) - 131072 for i in range(3)]
        rest = 2 * 131071**2 - sum(a * a for a in q)
        require(rest >= 0, "turn")
        squares = [a * a for a in q]
        q.insert(turn >> 54, math.sqrt(rest))
        squares.insert(turn >> 54, rest)
        (w, x, y, z), (_, xx, yy, zz) = q, squares
        rows = [
            [131071**2 - (yy + zz), x * y - w * z, x * z + w * y],
            [x * y + w * z, 131071**2 - (xx + zz), y * z - w * x],
            [x * z - w * y, y * z + w * x, 131071**2 - (xx + yy)],
        ]
        pose = []
        for row in range(3):
            at = corner[row] + (place >> 18 * row & 0x3FFFF)
            pose += [f32(a / 131071**2) + 0.0 for a in rows[row]] + [f32(math.ldexp(at, exponent))]  # no 0 has a sign
        cameras.append((*lenses[number if lens_count > 1 else 0], *pose))
    chunk.end()
    return cameras


def appearances_chunk(chunk, expected):  # section 9
    """{name: code}"""
    count, hidden = chunk.unpack("HH")
    require(1 <= count <= 16384 and hidden == expected, "number of appearances or of hidden units")
    codes = [chunk.unpack(f"{hidden}e") for _ in range(count)]
    require(all(math.isfinite(a) for code in codes for a in code), "codes")
    appearances = {}
    for code in codes:
        (length,) = chunk.unpack("B")
        try:
            name = chunk.take(length).decode("utf-8")
        except UnicodeDecodeError as error:
            raise Refused("name") from error
        require(name and name not in appearances, "name empty or twice")
        require(not any(ord(c) < 0x20 or 0x7F <= ord(c) <= 0x9F for c in name), "control character")
        appearances[name] = code
    chunk.end()
    return appearances


def render_ray(scene, origin, direction, time, appearance=None):  # section 11
    """(rgb, opacity, depth) that a ray sees, with the appearance of that name."""
    low, high = scene["aabb"]
    world = float  # the distance in the world of one along the ray
    if scene["frame"]:
        path = device_path(scene, origin, direction)
        if path is None:
            return scene["background"], 0.0, math.inf
        origin, direction, world = path
    extent = max(h - w for w, h in zip(low, high))
    t_in, t_out = -math.inf, math.inf
    for o, d, a, b in zip(origin, direction, low, high):
        if d == 0:
            t_in, t_out = (t_in, t_out) if a <= o <= b else (math.inf, -math.inf)
        else:
            t_in, t_out = max(t_in, min((a - o) / d, (b - o) / d)), min(t_out, max((a - o) / d, (b - o) / d))
    t_near, even = max(t_in, 0.0), scene["even"]
    if even:
        t_near, t_out = 0.0, (2 - 1 / 256) * even  # of s

    towards = looking(scene, direction, scene["appearances"][appearance] if appearance else [0.0] * scene["hidden"])
    slot = min(math.floor(time * scene["slots"]), scene["slots"] - 1)
    colour, depth, T, k = [0.0, 0.0, 0.0], 0.0, 1.0, 0
    while T >= 1 / 1024 and t_near + (k + 0.5) * scene["step"] < t_out:
        t_k, length = t_near + (k + 0.5) * scene["step"], scene["step"]
        k += 1
        if even and t_k > even:
            t_k = even / (2 - t_k / even)
        u = [(o + t_k * d - a) / (b - a) for o, d, a, b in zip(origin, direction, low, high)]
        if even:
            q = max(1.0, *(abs(2 * x - 1) for x in u))
            u = [0.5 + (2 * x - 1) * (2 - 1 / q) / (4 * q) for x in u]
            length *= (max(1.0, t_k / even) / q) ** 2
        i, j, m = (min(max(math.floor(x * n), 0), n - 1) for x, n in zip(u, scene["cells"]))
        nx, ny, _ = scene["cells"]
        if not scene["occupancy"][((m * ny + j) * nx + i) * scene["slots"] + slot]:
            continue
        f = features(scene, dict(zip("xyzt", [*moved(scene["motion"], u, time), time])))
        if scene["width"]:
            f = clipped(layer(scene["v"], scene["v_bias"], f))
        log_density = dot(f, scene["density_weight"]) + scene["density_bias"]
        alpha = 1 - math.exp(-math.exp(min(max(log_density, -20.0), 20.0)) * length / extent)
        w = T * alpha
        for c, logit in enumerate(logits(scene, f, towards)):
            colour[c] += w / (1 + math.exp(-logit)) if logit > -700 else 0.0
        depth += w * world(t_k)
        T *= 1 - alpha
    opacity = 1 - T
    return [c + T * b for c, b in zip(colour, scene["background"])], opacity, depth / opacity if opacity else math.inf


def device_path(scene, origin, direction):
    """(origin, direction, distance in the world of one along it) in device coordinates; None for a ray that sees nothing."""
    *axes, eye = scene["frame"]
    x, y, z = (sum(a * (o - e) for a, o, e in zip(axis, origin, eye)) for axis in axes)
    a, b, c = (sum(a * d for a, d in zip(axis, direction)) for axis in axes)
    z, c = -z, -c
    if c <= 0.0001:
        return None
    s_0 = max(0.0, (scene["near"] - z) / c)
    x, y, z = x + s_0 * a, y + s_0 * b, z + s_0 * c
    start = [x / z, y / z, scene["baseline"] * (1 / scene["near"] - 1 / z)]
    v = [a / c - x / z, b / c - y / z, scene["baseline"] / z]
    length = math.hypot(*v)

    def world(r):
        h = min(r / length, 0.999999)
        return s_0 + z / c * h / (1 - h)

    return start, [e / length for e in v], world


def between(position, size):
    """(node, weight) of the two nodes around a position in [0, 1]."""
    position = min(max(position, 0.0), 1.0) * (size - 1)
    low = min(math.floor(position), max(size - 2, 0))
    return (low, 1 - (position - low)), (min(low + 1, size - 1), position - low)


def moved(motion, u, time):
    if motion is None:
        return u
    rows, nz, ny, nx = motion["size"]
    out = list(u)
    for t, wt in between(time, rows):
        for k, wz in between(u[2], nz):
            for j, wy in between(u[1], ny):
                for i, wx in between(u[0], nx):
                    first = 3 * (((t * nz + k) * ny + j) * nx + i)
                    for axis in range(3):
                        out[axis] += wt * wz * wy * wx * motion["values"][first + axis]
    return [min(max(x, 0.0), 1.0) for x in out]


def features(scene, place):
    out = []
    for scale in scene["scales"]:
        product = [1.0] * scale["channels"]
        for name, plane in scale["planes"].items():
            sample = bilinear(plane, scale["channels"], place[name[0]], place[name[1]])
            product = [a * b for a, b in zip(product, sample)]
        out += product
    return out


def bilinear(plane, channels, u, v):
    sample = [0.0] * channels
    for y, wy in between(v, plane["rows"]):
        for x, wx in between(u, plane["columns"]):
            first = (y * plane["columns"] + x) * channels
            for c in range(channels):
                sample[c] += wy * wx * plane["values"][first + c]
    return sample


def dot(a, b):
    return sum(x * y for x, y in zip(a, b))


def layer(weights, biases, values):
    n = len(values)
    return [dot(weights[n * row : n * row + n], values) + bias for row, bias in enumerate(biases)]


def clipped(values):
    return [min(max(x, 0.0), 65504.0) for x in values]


def looking(scene, direction, code):
    """What colours take of a ray: the basis of its direction, or with a hybrid decoder its part of the hidden layer."""
    x, y, z = direction
    hidden = layer(scene["w1"], scene["b1"], [x, y, z, x * x, y * y, z * z, x * y, y * z, z * x])
    hidden = [x + c for x, c in zip(hidden, code)]
    if scene["width"]:
        return hidden
    F = len(scene["density_weight"])
    basis = layer(scene["w2"], scene["b2"], [max(x, 0.0) for x in hidden])
    return [basis[c * F : (c + 1) * F] for c in range(3)]


def logits(scene, f, towards):
    if not scene["width"]:
        return [dot(f, basis) for basis in towards]
    return layer(scene["w2"], scene["b2"], clipped(layer(scene["u"], towards, f)))


def hashes(scene):  # section 16
    """{(scale, plane): (symbols, coded, values)}, each a SHA-256 in hexadecimal."""
    return {
        (number, name): tuple(
            hashlib.sha256(data).hexdigest()
            for data in (
                struct.pack(f"{len(plane['symbols'])}b", *plane["symbols"]),
                bytes(plane["coded"]),
                struct.pack(f"<{len(plane['values'])}f", *plane["values"]),
            )
        )
        for number, scale in enumerate(scene["scales"])
        for name, plane in scale["planes"].items()
    }


if __name__ == "__main__":
    with open(sys.argv[1], "rb") as file:
        content = file.read()
    for found in (groups(content) or ([], [decode(content)]))[1]:
        print({key: found[key] for key in ("aabb", "frame_count", "fps", "step", "background", "cells", "slots")})
        for (number, name), (symbols, _, _) in hashes(found).items():
            print(f"scale {number} {name}: symbols {symbols}")
