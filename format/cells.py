"""Occupancy under codec 2: every cell told in a context of cells already told, around it and one slot before (spec, section 8).

A cell is most often as its neighbours are, and as it was. Which of these agree says how likely it is occupied.
"""

import numpy as np

from kpc.format.rans import adapt, compiled, counters, ended, opened, stream

NEIGHBOURS = np.array([
    (0, 0, 0, -1), (0, 0, -1, 0), (0, -1, 0, 0), (0, -1, 1, 0), (0, 0, -1, 1), (0, -1, 0, 1),
    (-1, 0, 0, 0), (-1, 0, 0, -1), (-1, 1, 0, 0), (-1, 0, -1, 0), (-1, -1, 0, 0),
])
"""(slot, z, y, x) from a cell to those that make its context, the most significant bit first."""
CONTEXTS = 1 << len(NEIGHBOURS)


def encode_cells(occupancy: np.ndarray) -> bytes:
    """Code (slots, Nz, Ny, Nx) bool."""
    cells = np.array(occupancy, np.uint8, order="C")
    trace = np.empty(cells.size, np.int16)
    walk(cells, 0, 0, None, trace)
    return stream(trace)


def decode_cells(body: bytes, shape: tuple[int, ...]) -> np.ndarray:
    """Undo `encode_cells`: bool of that shape.

    Raises:
        FormatError: the body is cut or too long.
    """
    state, words = opened(body, "occupancy")
    cells = np.zeros(shape, np.uint8)
    state, at = walk(cells, state, 0, words, None)
    ended(state, at, words, "occupancy")
    return cells.view(bool)


@compiled()
def walk(cells, state, at, words, trace):
    """Code (slots, Nz, Ny, Nx) uint8 `cells` of 0 and 1, or decode into them: (state, at). The rest as `kpc.format.rans.decide`."""
    S, Z, Y, X = cells.shape
    table = counters(CONTEXTS)
    slots = np.zeros((2, Z + 2, Y + 2, X + 1), np.uint8)  # this one and the one before, with nothing around: a cell is at [z + 1, y + 1, x]
    for s in range(S):
        here, before = slots[s & 1], slots[1 - (s & 1)]
        for z in range(Z):
            for y in range(Y):
                left, past = 0, 0
                for x in range(X):
                    now = int(before[z + 1, y + 1, x])
                    context = left << 10 | int(here[z + 1, y, x]) << 9 | int(here[z, y + 1, x]) << 8 | int(here[z, y + 2, x]) << 7 \
                        | int(here[z + 1, y, x + 1]) << 6 | int(here[z, y + 1, x + 1]) << 5 | now << 4 | past << 3 \
                        | int(before[z + 2, y + 1, x]) << 2 | int(before[z + 1, y, x]) << 1 | int(before[z, y + 1, x])
                    left, state, at = adapt(int(cells[s, z, y, x]), table, context, state, at, words, trace)
                    cells[s, z, y, x] = here[z + 1, y + 1, x] = left
                    past = now
                if words is not None and at > words.size:
                    return state, at
    return state, at
