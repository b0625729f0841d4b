"""Reading of OpenEXR images, as linear light, by the package OpenEXR, which the extras `encoder` and `film` bring."""

import os
from collections.abc import Iterable, Iterator
from contextlib import contextmanager
from typing import TYPE_CHECKING, Any

import numpy as np

from kpc.format.common.errors import MediaError

if TYPE_CHECKING:
    import OpenEXR

# The first bytes of every OpenEXR file.
_MAGIC = bytes.fromhex("762f3101")

# The most pixels of an image, as Pillow allows for others: a header of a few bytes can ask for any amount of memory.
_MAX_PIXELS = 2 * 89_478_485

# CIE x and y of red, green, blue and white of ITU-R BT.709, which sRGB shares.
_BT709 = (0.64, 0.33, 0.30, 0.60, 0.15, 0.06, 0.3127, 0.3290)


def is_exr(path: str | os.PathLike[str]) -> bool:
    """Return whether a file is an OpenEXR image, by its first bytes."""
    with open(path, "rb") as file:
        return file.read(len(_MAGIC)) == _MAGIC


def exr_info(path: str | os.PathLike[str]) -> tuple[int, int, bool]:
    """Return width and height of the display window, and whether there is an alpha channel.

    Raises:
        MediaError: as `read_exr`; other exceptions of OpenEXR where the file is damaged.
    """
    with _opened(path, header_only=True) as exr:
        part, names = _colour_channels(path, exr)
        width, height = _size(path, exr.header(part))
    return width, height, len(names) == 4


def read_exr(path: str | os.PathLike[str]) -> np.ndarray:
    """Read linear light; colours are divided by alpha, where there is one. Pixels outside the data window are 0.

    The channels are R, G, B and A, or Y alone, of the only layer that has them, or else of the layer `Combined`, which
    holds Blender's picture.

    Returns:
        (height, width, 3 or 4) float32, with straight alpha in [0, 1].

    Raises:
        MediaError: channels are missing, ambiguous, subsampled, deep or integer, or colours are not those of BT.709;
            other exceptions of OpenEXR where the file is damaged.
    """
    with _opened(path, header_only=True) as exr:
        part, names = _colour_channels(path, exr)
        header = exr.header(part)
        width, height = _size(path, header)
        x, y = (int(b) - int(a) for a, b in zip(header["displayWindow"][0], header["dataWindow"][0], strict=True))
    with _opened(path, separate_channels=True) as exr:
        channels = exr.channels(part)
        stored = np.stack([channels[name].pixels for name in names], axis=-1)
    if not np.issubdtype(stored.dtype, np.floating):
        raise MediaError(f"{path}: its channels hold integers of unknown range; export half or float")
    pixels = np.zeros((height, width, len(names)), np.float32)
    inside = stored[max(-y, 0) : max(height - y, 0), max(-x, 0) : max(width - x, 0)]
    pixels[max(y, 0) : max(y, 0) + inside.shape[0], max(x, 0) : max(x, 0) + inside.shape[1]] = inside
    if len(names) == 4:
        alpha = np.clip(np.nan_to_num(pixels[..., 3:]), 0, 1)
        np.divide(pixels[..., :3], alpha, out=pixels[..., :3], where=alpha > 0)
        pixels[..., :3][alpha[..., 0] == 0] = 0
        pixels[..., 3:] = alpha
    return pixels


@contextmanager
def _opened(path: str | os.PathLike[str], **options: bool) -> "Iterator[OpenEXR.File]":
    """Open a file; the name is given as bytes, since OpenEXR takes no str that is not valid Unicode."""
    import OpenEXR

    with OpenEXR.File(os.fsencode(path), **options) as exr:
        yield exr


def _size(path: str | os.PathLike[str], header: dict[str, Any]) -> tuple[int, int]:
    """Return width and height of the display window, after a check of what no conversion is known for."""
    colours = header.get("chromaticities")
    if colours is not None and not np.allclose(np.ravel(colours), _BT709, atol=2e-3):
        raise MediaError(f"{path}: its colours are not those of BT.709 (sRGB); convert it to linear BT.709")
    sizes = []
    for window in ("displayWindow", "dataWindow"):
        low, high = np.asarray(header[window], np.int64)
        sizes.append((int(high[0] - low[0] + 1), int(high[1] - low[1] + 1)))
    if any(min(size) < 1 or size[0] * size[1] > _MAX_PIXELS for size in sizes):
        raise MediaError(f"{path}: is {sizes[0][0]}x{sizes[0][1]}; no image has more than {_MAX_PIXELS} pixels")
    return sizes[0]


def _colour_channels(path: str | os.PathLike[str], exr: "OpenEXR.File") -> tuple[int, tuple[str, ...]]:
    """Return the part and the names of the channels to read: red, green and blue, or luminance thrice; then alpha."""
    import OpenEXR

    found: dict[str, tuple[int, tuple[str, ...]]] = {}
    everything: list[str] = []
    for part in range(len(exr.parts)):
        header = exr.header(part)
        channels = {channel.name: channel for channel in header["channels"]}
        everything += channels
        if header.get("type") in (OpenEXR.deepscanline, OpenEXR.deeptile):
            continue
        for layer in _layers(channels):
            names = tuple(layer + name for name in "RGB")
            if any(name not in channels for name in names):
                if not _is_luminance(layer, channels):
                    continue
                names = (layer + "Y",) * 3
            names += (layer + "A",) if layer + "A" in channels else ()
            if any((channels[n].xSampling, channels[n].ySampling) != (1, 1) for n in names):
                raise MediaError(f"{path}: its channels are subsampled; export R, G and B at full size")
            found[f"{part} {layer}"] = part, names
    if len(found) > 1:
        found = {name: value for name, value in found.items() if name.endswith((" ", "Combined."))}
    if len(found) != 1:
        shown = ", ".join(everything[:12]) + (" ..." if len(everything) > 12 else "")
        raise MediaError(f"{path}: its channels are {shown[:160]}; export one layer with R, G and B")
    return next(iter(found.values()))


def _layers(channels: Iterable[str]) -> list[str]:
    """Return the layers, each with the full stop that ends it; the layer without a name is empty."""
    return sorted({name[: name.rfind(".") + 1] for name in channels})


def _is_luminance(layer: str, channels: Iterable[str]) -> bool:
    """Return whether a layer is a grey image: Y, with or without alpha. (X, Y and Z are coordinates.)"""
    return {name[len(layer) :] for name in channels if name.startswith(layer)} in ({"Y"}, {"Y", "A"})
