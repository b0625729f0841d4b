"""OCCUPANCY, the codec of occupancy grids: each cell is coded in a context of coded cells (spec/kpc-format.md,
"OCCUPANCY").

The context is made of cells around it and of the slot before: where these agree, the cell is most often as they are.
"""

import numpy as np

from kpc.encoder.coding.rans import code_bit_adaptive, encode_trace, new_models
from kpc.jit import compiled

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
    code_cells(cells, trace)
    return encode_trace(trace)


@compiled()
def code_cells(cells, trace):
    """Code (slots, Nz, Ny, Nx) uint8 `cells` of 0 and 1, a decision of the trace for each."""
    S, Z, Y, X = cells.shape
    models, outside = new_models(CONTEXTS), np.zeros(X, np.uint8)
    state, position = 0, 0
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
                        int(here[x]), models, context, state, position, None, trace
                    )
                    past = now
