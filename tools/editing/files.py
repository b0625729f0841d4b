"""Edited files: a scene is decoded, changed and encoded, and every chunk that stays the same is copied."""

from collections.abc import Callable

import numpy as np

from kpc.format.coding.quantise import QuantisedScene, needed_texels
from kpc.format.common.progress import in_parts
from kpc.format.container.container import Chunk, Codec, Entry, assemble, store
from kpc.format.container.rewriting import copied
from kpc.format.container.scene_io import SceneReader, read
from kpc.format.container.scene_layout import KNOWN_KINDS
from kpc.format.container.segments import needs_occupancy
from kpc.format.scene.scene import ALL_PLANES

Edit = Callable[[QuantisedScene], QuantisedScene]

# Kind, scale, plane, first row and number of rows of a chunk.
Place = tuple[str, int, int, int, int]


def edited(reader: SceneReader, edit: Edit) -> bytes:
    """Return the file of a changed scene.

    Chunks whose content stays the same are copied byte for byte, and so are those of kinds that are not known. Each is
    reported as a part of a unit of progress.

    Raises:
        UsageError, FormatError: as `edit`, or no file can hold the result.
    """
    from kpc.encoder.coding.scene_writer import scene_chunks  # here, since copying alone needs no numba

    before = read(reader)
    after = edit(before)
    numbers = {_place_in(entry): number for number, entry in enumerate(reader.index)}
    old = {_place_in(chunk): chunk.raw for chunk in scene_chunks(before)}
    stored = []
    for chunk in in_parts(scene_chunks(after)):
        place = _place_in(chunk)
        number = numbers.get(place)
        is_same = number is not None and old.get(place) == chunk.raw
        if is_same and number is not None and _reads_the_same_map(reader, number, before, after):
            stored.append(copied(reader, number))
        else:
            stored.append(store(chunk))
    unknown = [number for number, entry in enumerate(reader.index) if entry.kind not in KNOWN_KINDS]
    first_plane = next(k for k, one in enumerate(stored) if one.entry.kind == "PLNE")
    stored[first_plane:first_plane] = [copied(reader, number) for number in unknown]
    return assemble(stored, sum(plane.symbols.size for scale in after.scales for plane in scale.values()))


def _place_in(chunk: Chunk | Entry) -> Place:
    return chunk.kind, chunk.scale, chunk.plane, chunk.row_start, chunk.row_count


def _reads_the_same_map(reader: SceneReader, number: int, before: QuantisedScene, after: QuantisedScene) -> bool:
    """Return whether a chunk decodes in both scenes to the same: whether it is no plane, or one of as many texels whose
    map does not depend on the occupancy, or of which both imply the same map."""
    entry = reader.index[number]
    if entry.kind != "PLNE":
        return True
    name = ALL_PLANES[entry.plane]
    shape, now = (scene.scales[entry.scale][name].coded.shape for scene in (before, after))
    if shape != now:  # though neither stores a symbol, so that their contents are alike
        return False
    if entry.codec not in (Codec.PREDICTIVE, Codec.TRANSFORM) or not needs_occupancy(reader.stored(number)):
        return True
    return np.array_equal(needed_texels(before.occupancy, name, *shape), needed_texels(after.occupancy, name, *shape))
