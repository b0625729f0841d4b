"""Section 7.2: the texel map, which says what texels of a segment are coded."""

ALL_CODED, STORED, IMPLIED = range(3)
# Neighbours of a texel whose bits choose the model, most significant first: rows above, columns to the left.
MAP_NEIGHBOURS = [(2, 1), (2, 0), (2, -1), (1, 2), (1, 1), (1, 0), (1, -1), (1, -2), (0, 2), (0, 1)]


def all_coded(H, W):
    return {(y, x): 1 for y in range(H) for x in range(W)}


def decode_map(decisions, H, W):
    coded = {}
    for y in range(H):
        for x in range(W):
            context = tuple(coded.get((y - up, x - back), 0) for up, back in MAP_NEIGHBOURS)
            coded[y, x] = decisions.adaptive(("map", context))
    return coded


def implied_map(scene, name, rows, columns, row_start, row_count):
    """Return the map of a segment of the plane of that name, which has so many rows and columns."""
    K, nz, ny, nx = scene["cells"]
    cell_count = {"x": nx, "y": ny, "z": nz, "t": K}
    occupied = set()  # (a, b): projected cells, a along the axis of the plane's rows, b along that of its columns
    for number, bit in enumerate(scene["occupancy"]):
        if bit:
            cell = {
                "x": number % nx,
                "y": number // nx % ny,
                "z": number // (nx * ny) % nz,
                "t": number // (nx * ny * nz),
            }
            occupied.add((cell[name[1]], cell[name[0]]))

    def touches(texel, size, cell, count):
        """Whether the cell lies within a texel's distance of the texel, along an axis."""
        return (texel + 1) * count >= cell * (size - 1) and (texel - 1) * count <= (cell + 1) * (size - 1)

    coded = {(y, x): 0 for y in range(row_count) for x in range(columns)}
    for a, b in occupied:
        across = [x for x in range(columns) if touches(x, columns, b, cell_count[name[0]])]
        for y in range(row_count):
            if touches(row_start + y, rows, a, cell_count[name[1]]):
                coded |= {(y, x): 1 for x in across}
    return coded
