"""Occupancy under codec 2: every cell told in a context of cells already told, around it and one slot before (spec, section 8).

A cell is most often as its neighbours are, and as it was. Which of these agree says how likely it is occupied.
"""

import numpy as np
from kpc.format.coding.rans import check_end, code_bit_adaptive, encode_trace, new_models, open_stream
from kpc.format.common.jit import compiled

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
"""(slot, z, y, x) from a cell to those that make its context, the most significant bit first. `walk` has them row by row."""
CONTEXTS = 1 << len(NEIGHBOURS)


def encode_occupancy(occupancy: np.ndarray) -> bytes:
    """Code (slots, Nz, Ny, Nx) bool."""
    cells = np.array(occupancy, np.uint8, order="C")
    trace = np.empty(cells.size, np.int16)
    walk(cells, 0, 0, None, trace)
    return encode_trace(trace)


def decode_occupancy(body: bytes, shape: tuple[int, ...]) -> np.ndarray:
    """Undo `encode_occupancy`: bool of that shape.

    Raises:
        FormatError: the body is cut or too long.
    """
    state, words = open_stream(body, "occupancy")
    cells = np.zeros(shape, np.uint8)
    state, at = walk(cells, state, 0, words, None)
    check_end(state, at, words, "occupancy")
    return cells.view(bool)


@compiled()
def walk(cells, state, at, words, trace):
    """Code (slots, Nz, Ny, Nx) uint8 `cells` of 0 and 1, or decode into them: (state, at). The rest as `kpc.format.coding.rans.code_bit`."""
    S, Z, Y, X = cells.shape
    table, nowhere = new_models(CONTEXTS), np.zeros(X, np.uint8)
    for s in range(S):
        for z in range(Z):
            for y in range(Y):
                here = cells[s, z, y]
                north = cells[s, z, y - 1] if y > 0 else nowhere
                back = cells[s, z - 1, y] if z > 0 else nowhere
                below = cells[s, z - 1, y + 1] if z > 0 and y + 1 < Y else nowhere
                before = cells[s - 1, z, y] if s > 0 else nowhere
                front = cells[s - 1, z + 1, y] if s > 0 and z + 1 < Z else nowhere
                above = cells[s - 1, z, y - 1] if s > 0 and y > 0 else nowhere
                behind = cells[s - 1, z - 1, y] if s > 0 and z > 0 else nowhere
                left, past = 0, 0
                for x in range(X):
                    corners = 2 * int(north[x + 1]) + int(back[x + 1]) if x + 1 < X else 0
                    now = int(before[x])
                    context = (
                        left << 10
                        | int(north[x]) << 9
                        | int(back[x]) << 8
                        | int(below[x]) << 7
                        | corners << 5
                        | now << 4
                        | past << 3
                        | int(front[x]) << 2
                        | int(above[x]) << 1
                        | int(behind[x])
                    )
                    left, state, at = code_bit_adaptive(int(here[x]), table, context, state, at, words, trace)
                    here[x] = left
                    past = now
                if words is not None and at > words.size:
                    return state, at
    return state, at
