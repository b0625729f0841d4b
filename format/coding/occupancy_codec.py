"""OCCUPANCY, the codec of occupancy grids: each cell is coded in a context of coded cells (spec/kpc-format.md,
"OCCUPANCY").

The context is made of cells around it and of the slot before: where these agree, the cell is most often as they are.
"""

import numpy as np

from kpc.format.coding.rans import check_end, code_bit_adaptive, encode_trace, new_models, open_stream
from kpc.format.common.jit import compiled

# (slot, z, y, x) from a cell to those of its context, the most significant bit first. `code_cells` reads them row by
# row.
NEIGHBOURS = np.array(
    [
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
)
CONTEXTS = 1 << len(NEIGHBOURS)


def encode_occupancy(occupancy: np.ndarray) -> bytes:
    """Encode (slots, Nz, Ny, Nx) bool."""
    cells = np.array(occupancy, np.uint8, order="C")
    trace = np.empty(cells.size, np.int16)
    code_cells(cells, 0, 0, None, trace)
    return encode_trace(trace)


def decode_occupancy(body: bytes, shape: tuple[int, ...]) -> np.ndarray:
    """Undo `encode_occupancy`: return bool of that shape.

    Raises:
        FormatError: the body is cut off or too long.
    """
    state, words = open_stream(body, "occupancy")
    cells = np.zeros(shape, np.uint8)
    state, position = code_cells(cells, state, 0, words, None)
    check_end(state, position, words, "occupancy")
    return cells.view(bool)


@compiled()
def code_cells(cells, state, position, words, trace):
    """Code (slots, Nz, Ny, Nx) uint8 `cells` of 0 and 1: (state, position), as of `kpc.format.coding.rans`."""
    S, Z, Y, X = cells.shape
    models, outside = new_models(CONTEXTS), np.zeros(X, np.uint8)
    for s in range(S):
        for z in range(Z):
            for y in range(Y):
                # Rows of the context, named by their offsets in y (n: -1, s: +1), z (b: -1, f: +1) and slot (p: -1).
                here = cells[s, z, y]
                n = cells[s, z, y - 1] if y > 0 else outside
                b = cells[s, z - 1, y] if z > 0 else outside
                bs = cells[s, z - 1, y + 1] if z > 0 and y + 1 < Y else outside
                p = cells[s - 1, z, y] if s > 0 else outside
                pf = cells[s - 1, z + 1, y] if s > 0 and z + 1 < Z else outside
                pn = cells[s - 1, z, y - 1] if s > 0 and y > 0 else outside
                pb = cells[s - 1, z - 1, y] if s > 0 and z > 0 else outside
                left, past = 0, 0
                for x in range(X):
                    corners = 2 * int(n[x + 1]) + int(b[x + 1]) if x + 1 < X else 0
                    now = int(p[x])
                    context = (
                        left << 10
                        | int(n[x]) << 9
                        | int(b[x]) << 8
                        | int(bs[x]) << 7
                        | corners << 5
                        | now << 4
                        | past << 3
                        | int(pf[x]) << 2
                        | int(pn[x]) << 1
                        | int(pb[x])
                    )
                    left, state, position = code_bit_adaptive(
                        int(here[x]), models, context, state, position, words, trace
                    )
                    here[x] = left
                    past = now
                if words is not None and position > words.size:
                    return state, position
    return state, position
