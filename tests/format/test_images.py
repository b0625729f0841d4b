"""Images of every mode and depth are read at their true values, or refused by name."""

import contextlib
import io
import struct
import sys
import types
import zlib
from pathlib import Path

import numpy as np
import pytest
from PIL import Image, ImageCms, TiffImagePlugin

from kpc.format.common import images
from kpc.format.common.errors import MediaError
from kpc.format.common.images import image_info, read_image, read_mask, srgb_from_linear, write_image
from kpc.format.common.media_files import IMAGE_SUFFIXES

RNG = np.random.default_rng(0)
HEIGHT, WIDTH = 4, 8


def packed(samples: np.ndarray, bits: int, order: str = ">") -> list[bytes]:
    """Return rows of samples (H, W, C) as bytes, several samples a byte below 8 bits."""
    if bits >= 8:
        return [row.astype(f"{order}u{bits // 8}").tobytes() for row in samples]
    shifts = np.arange(bits - 1, -1, -1)
    return [np.packbits((row.reshape(-1, 1) >> shifts & 1).ravel()).tobytes() for row in samples]


def write_png(path: Path, samples: np.ndarray, bits: int, colour_type: int, **chunks: bytes) -> None:
    """Write a PNG from samples (H, W, C), by the specification (ISO/IEC 15948)."""

    def chunk(kind: bytes, data: bytes) -> bytes:
        return struct.pack(">I", len(data)) + kind + data + struct.pack(">I", zlib.crc32(kind + data))

    head = struct.pack(">IIBBBBB", samples.shape[1], samples.shape[0], bits, colour_type, 0, 0, 0)
    body = zlib.compress(b"".join(b"\0" + row for row in packed(samples, bits)))
    data = b"\x89PNG\r\n\x1a\n" + chunk(b"IHDR", head)
    data += b"".join(chunk(kind.encode(), content) for kind, content in chunks.items())
    path.write_bytes(data + chunk(b"IDAT", body) + chunk(b"IEND", b""))


def write_tiff(path: Path, samples: np.ndarray, bits: int, photometric: int, order: str = "<", **tags: int) -> None:
    """Write a TIFF of one uncompressed strip from samples (H, W, C), by the specification (TIFF 6.0).

    Args:
        tags: `t` and the number of a tag, with its value.
    """
    if tags.get("t284") == 2:
        body = b"".join(b"".join(packed(plane[..., None], bits, order)) for plane in np.moveaxis(samples, -1, 0))
    else:
        body = b"".join(packed(samples, bits, order))
    height, width, count = samples.shape
    strips = count if tags.get("t284") == 2 else 1
    entries: dict[int, list[int]] = {256: [width], 257: [height], 258: [bits] * count, 259: [1], 262: [photometric]}
    entries |= {277: [count], 278: [height]}
    entries |= {273: [8 + k * len(body) // strips for k in range(strips)], 279: [len(body) // strips] * strips}
    entries |= {int(name[1:]): [value] * (count if name == "t339" else 1) for name, value in tags.items()}
    place = 8 + len(body) + len(body) % 2
    after = place + 2 + 12 * len(entries) + 4
    directory, extra = struct.pack(order + "H", len(entries)), b""
    for tag, values in sorted(entries.items()):
        data = struct.pack(f"{order}{len(values)}I", *values)
        if len(values) > 1:
            data, extra = struct.pack(order + "I", after + len(extra)), extra + data
        directory += struct.pack(order + "HHI", tag, 4, len(values)) + data
    head = (b"II" if order == "<" else b"MM") + struct.pack(order + "HI", 42, place)
    path.write_bytes(head + body + bytes(len(body) % 2) + directory + bytes(4) + extra)


def samples(bits: int, channels: int) -> np.ndarray:
    """Return random samples (H, W, C) of so many bits, with the lowest and the highest among them."""
    values = RNG.integers(0, 2**bits, (HEIGHT, WIDTH, channels))
    values[0, :2] = [[0] * channels, [2**bits - 1] * channels]
    return values


def as_8_bits(values: np.ndarray, bits: int) -> np.ndarray:
    """Return what samples are at 8 bits: the high byte of deeper ones, and shallower ones spread to 0 to 255."""
    return (values >> (bits - 8) if bits > 8 else values * 255 // (2**bits - 1)).astype(np.uint8)


def rgb(grey: np.ndarray) -> np.ndarray:
    return np.repeat(grey, 3, axis=-1)


@pytest.mark.parametrize("bits", [1, 2, 4, 8, 16])
@pytest.mark.parametrize("transparent", [False, True])
@pytest.mark.parametrize("place", [0, 1])
def test_grey_png(tmp_path: Path, bits: int, transparent: bool, place: int) -> None:
    values = samples(bits, 1)
    key = int(values[0, place, 0])  # the lowest, or the highest
    write_png(tmp_path / "x.png", values, bits, 0, **({"tRNS": struct.pack(">H", key)} if transparent else {}))
    read = read_image(tmp_path / "x.png")
    np.testing.assert_array_equal(read[..., :3], rgb(as_8_bits(values, bits)))
    assert image_info(tmp_path / "x.png").has_alpha == transparent == (read.shape[2] == 4)
    if transparent:
        np.testing.assert_array_equal(read[..., 3], np.where(values[..., 0] == key, 0, 255))


@pytest.mark.parametrize("bits", [8, 16])
@pytest.mark.parametrize("colour_type, channels", [(2, 3), (4, 2), (6, 4)])
def test_colour_png(tmp_path: Path, bits: int, colour_type: int, channels: int) -> None:
    values = samples(bits, channels)
    write_png(tmp_path / "x.png", values, bits, colour_type)
    expected = as_8_bits(values, bits)
    if channels == 2:
        expected = np.concatenate([rgb(expected[..., :1]), expected[..., 1:]], axis=-1)
    np.testing.assert_array_equal(read_image(tmp_path / "x.png"), expected)


def test_a_transparent_colour(tmp_path: Path) -> None:
    values = samples(8, 3)
    write_png(tmp_path / "x.png", values, 8, 2, tRNS=struct.pack(">3H", *values[2, 3]))
    alpha = np.where((values == values[2, 3]).all(-1, keepdims=True), 0, 255)
    np.testing.assert_array_equal(read_image(tmp_path / "x.png"), np.concatenate([values, alpha], -1))
    write_png(tmp_path / "y.png", samples(16, 3), 16, 2, tRNS=struct.pack(">3H", 1, 2, 3))
    with pytest.raises(MediaError, match=r"y\.png: marks a 16-bit colour as transparent"):
        image_info(tmp_path / "y.png")


@pytest.mark.parametrize("bits", [1, 2, 4, 8])
@pytest.mark.parametrize("alphas", [None, [0], [0, 128], [255, 0]])
def test_palette_png(tmp_path: Path, bits: int, alphas: list[int] | None) -> None:
    """One entry of alpha 0 among opaque ones becomes an index in Pillow, others become bytes."""
    values = samples(bits, 1)
    colours = RNG.integers(0, 256, (2**bits, 3), dtype=np.uint8)
    extra = {"tRNS": bytes(alphas)} if alphas else {}
    write_png(tmp_path / "x.png", values, bits, 3, PLTE=colours.tobytes(), **extra)
    expected = colours[values[..., 0]]
    if alphas:
        table = np.full(2**bits, 255, np.uint8)
        table[: len(alphas)] = alphas
        expected = np.concatenate([expected, table[values]], axis=-1)
    np.testing.assert_array_equal(read_image(tmp_path / "x.png"), expected)


@pytest.mark.parametrize("order", ["<", ">"])
@pytest.mark.parametrize("photometric", [0, 1])
@pytest.mark.parametrize("bits", [1, 2, 4, 8, 16])
def test_grey_tiff(tmp_path: Path, bits: int, photometric: int, order: str) -> None:
    """Photometric interpretation 0 means that 0 is white."""
    values = samples(bits, 1)
    write_tiff(tmp_path / "x.tif", values, bits, photometric, order)
    if (bits, photometric, order) == (16, 0, ">"):  # Pillow does not know it
        with pytest.raises(MediaError, match="not an image"):
            read_image(tmp_path / "x.tif")
        return
    expected = as_8_bits(values, bits)
    np.testing.assert_array_equal(read_image(tmp_path / "x.tif"), rgb(expected if photometric else 255 - expected))


def test_grey_tiff_of_12_bits(tmp_path: Path) -> None:
    values = samples(12, 1)
    nibbles = np.stack([values >> 8, values >> 4 & 15, values & 15], axis=-1)
    write_tiff(tmp_path / "x.tif", nibbles.reshape(HEIGHT, -1, 1), 4, 1)
    data = bytearray((tmp_path / "x.tif").read_bytes())
    place = struct.unpack_from("<I", data, 4)[0]
    for entry in range(place + 2, len(data) - 4, 12):
        tag = struct.unpack_from("<H", data, entry)[0]
        if tag in (256, 258):
            struct.pack_into("<I", data, entry + 8, WIDTH if tag == 256 else 12)
    (tmp_path / "x.tif").write_bytes(data)
    np.testing.assert_array_equal(read_image(tmp_path / "x.tif"), rgb(as_8_bits(values, 12)))


@pytest.mark.parametrize("order", ["<", ">"])
@pytest.mark.parametrize("bits", [8, 16])
@pytest.mark.parametrize("extra", [None, 0, 1, 2])
def test_colour_tiff(tmp_path: Path, bits: int, extra: int | None, order: str) -> None:
    """The fourth sample means nothing (0), associated alpha (1) or straight alpha (2)."""
    values = samples(bits, 3 if extra is None else 4)
    if extra == 1:
        values[..., 3] = np.where(values[..., 3] < 2 ** (bits - 1), 0, 2**bits - 1)
        values[..., :3] *= values[..., 3:] > 0
    write_tiff(tmp_path / "x.tif", values, bits, 2, order, **({} if extra is None else {"t338": extra}))
    expected = as_8_bits(values, bits)
    np.testing.assert_array_equal(read_image(tmp_path / "x.tif"), expected[..., :3] if extra == 0 else expected)


def test_tiff_in_planes(tmp_path: Path) -> None:
    values = samples(8, 3)
    write_tiff(tmp_path / "x.tif", values, 8, 2, t284=2)
    np.testing.assert_array_equal(read_image(tmp_path / "x.tif"), values)
    write_tiff(tmp_path / "y.tif", samples(16, 3), 16, 2, t284=2)
    with pytest.raises(MediaError, match="16-bit channels in planes"):
        read_image(tmp_path / "y.tif")


@pytest.mark.parametrize("bits, sample_format", [(8, 2), (16, 2), (32, 1), (32, 2), (32, 3)])
def test_numbers_of_unknown_range_are_refused(tmp_path: Path, bits: int, sample_format: int) -> None:
    write_tiff(tmp_path / "x.tif", samples(bits, 1), bits, 1, t339=sample_format)
    with pytest.raises(MediaError, match=r"x\.tif: holds .* of unknown range"):
        image_info(tmp_path / "x.tif")


def test_a_floating_point_map_is_refused(tmp_path: Path) -> None:
    (tmp_path / "x.pfm").write_bytes(b"Pf\n2 1\n-1.0\n" + struct.pack("<2f", 0.5, 3.0))
    with pytest.raises(MediaError, match="floating-point"):
        read_image(tmp_path / "x.pfm")


@pytest.mark.parametrize("most", [1, 15, 255, 1023, 65535])
@pytest.mark.parametrize("channels", [1, 3])
def test_portable_anymaps(tmp_path: Path, most: int, channels: int) -> None:
    """Any highest value is white. Pillow rounds colours to 8 bits; of grey the high byte of 16 is taken."""
    values = RNG.integers(0, most + 1, (HEIGHT, WIDTH, channels))
    values[0, :2] = [[0] * channels, [most] * channels]
    body = values.astype(">u2" if most > 255 else "u1").tobytes()
    (tmp_path / "x.pnm").write_bytes(b"P%d\n%d %d\n%d\n" % (5 if channels == 1 else 6, WIDTH, HEIGHT, most) + body)
    read = read_image(tmp_path / "x.pnm")
    assert np.abs(read - values / most * 255).max() <= 1
    assert read[0, 0].max() == 0 and read[0, 1].min() == 255


def test_cmyk_jpeg(tmp_path: Path) -> None:
    """Adobe's marker, which Pillow writes, says that values are stored inverted; without it this is unknown."""
    colour = (40, 100, 0, 60)
    Image.new("CMYK", (16, 16), colour).save(tmp_path / "x.jpg", quality=100, subsampling=0)
    expected = (255 - np.array(colour[:3])) * (255 - colour[3]) / 255
    assert np.abs(read_image(tmp_path / "x.jpg") - expected).max() <= 2  # half a step of each ink, and rounding
    data = (tmp_path / "x.jpg").read_bytes()
    place = data.index(b"\xff\xee")
    (tmp_path / "y.jpg").write_bytes(data[:place] + data[place + 2 + struct.unpack_from(">H", data, place + 2)[0] :])
    with pytest.raises(MediaError, match=r"y\.jpg: is a CMYK JPEG without Adobe"):
        image_info(tmp_path / "y.jpg")


def lab_of_srgb(colour: np.ndarray) -> np.ndarray:
    """Return CIE L*a*b* under D50 of sRGB colours in [0, 1], with the matrix of the ICC's sRGB profile."""
    linear = np.where(colour <= 0.04045, colour / 12.92, ((colour + 0.055) / 1.055) ** 2.4)
    matrix = [[0.4361, 0.3851, 0.1431], [0.2225, 0.7169, 0.0606], [0.0139, 0.0971, 0.7141]]
    t = linear @ np.array(matrix).T / [0.9642, 1, 0.8251]
    f = np.where(t > (6 / 29) ** 3, np.cbrt(t), t * (29 / 6) ** 2 / 3 + 4 / 29)
    return np.stack([116 * f[..., 1] - 16, 500 * (f[..., 0] - f[..., 1]), 200 * (f[..., 1] - f[..., 2])], axis=-1)


def test_lab_tiff(tmp_path: Path) -> None:
    wanted = RNG.integers(90, 200, (HEIGHT, WIDTH, 3))
    lab = lab_of_srgb(wanted / 255)
    stored = np.rint(lab * [2.55, 1, 1]).astype(int) & 255  # a* and b* are signed
    write_tiff(tmp_path / "x.tif", stored, 8, 8)
    error = lab_of_srgb(read_image(tmp_path / "x.tif") / 255) - lab
    assert np.abs(error).max() <= 1.2  # half a step of a* or b*, and half a level of sRGB, which may be 0.6 of b*


def test_ycbcr_tiff(tmp_path: Path) -> None:
    image = Image.new("RGB", (16, 16), (200, 100, 50)).convert("YCbCr")
    image.save(tmp_path / "x.tif")
    assert np.abs(read_image(tmp_path / "x.tif") - np.array([200, 100, 50])).max() <= 2


# What each mode of Pillow holds at one pixel, and the colour that this is; None: no file has this mode.
MODES: dict[str, tuple[object, tuple[int, ...] | None]] = {
    "1": (255, (255, 255, 255)),
    "L": (77, (77, 77, 77)),
    "LA": ((77, 50), (77, 77, 77, 50)),
    "La": ((30, 51), (150, 150, 150, 51)),
    "P": (3, (9, 10, 11)),
    "PA": ((3, 99), (9, 10, 11, 99)),
    "RGB": ((1, 2, 3), (1, 2, 3)),
    "RGBA": ((1, 2, 3, 4), (1, 2, 3, 4)),
    "RGBa": ((10, 20, 30, 51), (50, 100, 150, 51)),
    "RGBX": ((1, 2, 3, 4), (1, 2, 3)),
    "CMYK": ((0, 51, 255, 0), (255, 204, 0)),
    "YCbCr": ((128, 128, 128), (128, 128, 128)),
    "LAB": ((0, 128, 128), (0, 0, 0)),
    "HSV": ((1, 2, 3), None),
    "I": (300, None),
    "F": (0.5, None),
    "I;16": (77 << 8 | 99, (77, 77, 77)),
    "I;16L": (77 << 8 | 99, (77, 77, 77)),
    "I;16B": (77 << 8 | 99, (77, 77, 77)),
    "I;16N": (77 << 8 | 99, (77, 77, 77)),
}


@pytest.mark.parametrize("mode", MODES)
def test_every_mode(tmp_path: Path, mode: str, monkeypatch: pytest.MonkeyPatch) -> None:
    """Whatever mode a decoder of Pillow returns is converted, or refused by name."""
    value, expected = MODES[mode]
    image = Image.new("P" if mode == "PA" else mode, (2, 1), None if mode == "PA" else value)
    if mode in ("P", "PA"):
        image.putpalette(range(256))
    if mode == "PA":
        image = Image.new("P", (2, 1), 3)
        image.putpalette(range(256))
        image = image.convert("PA")
        image.putalpha(99)
    (tmp_path / "x.any").write_bytes(b"nothing")
    monkeypatch.setattr(images.Image, "open", lambda *a, **k: image)
    if expected is None:
        with pytest.raises(MediaError, match=r"x\.any: holds"):
            read_image(tmp_path / "x.any")
    else:
        off = 1 if mode == "LAB" else 0  # converted by 16-bit arithmetic
        np.testing.assert_allclose(read_image(tmp_path / "x.any"), [[expected, expected]], atol=off)


def test_all_modes_of_pillow_are_known() -> None:
    assert {*Image.MODES} <= {*MODES}


def profile(red: tuple[float, float], gamma: float) -> bytes:
    """Return an ICC profile of BT.709's green and blue, the given red, white D65 and a power curve.

    The matrix is that of the primaries, adapted to D50 by Bradford's method, in s15Fixed16 numbers (ICC.1:2010).
    """
    colorants = adapted(red)
    tags = {
        name: b"XYZ " + bytes(4) + struct.pack(">3i", *np.rint(xyz * 65536).astype(int))
        for name, xyz in zip((b"rXYZ", b"gXYZ", b"bXYZ", b"wtpt"), [*colorants.T, D50], strict=True)
    }
    curve = b"curv" + bytes(4) + struct.pack(">IH", 1, round(gamma * 256)) + bytes(2)
    tags |= dict.fromkeys((b"rTRC", b"gTRC", b"bTRC"), curve)
    table, body = struct.pack(">I", len(tags)), b""
    for name, data in tags.items():
        table += name + struct.pack(">II", 132 + 12 * len(tags) + len(body), len(data))
        body += data
    head = struct.pack(
        ">I4xI4s4s4s12x4s", 132 + 12 * len(tags) + len(body), 0x02100000, b"mntr", b"RGB ", b"XYZ ", b"acsp"
    )
    head += bytes(28) + struct.pack(">3i", *np.rint(D50 * 65536).astype(int))
    return head.ljust(128, b"\0") + table + body


D50 = np.array([0.9642, 1.0, 0.8249])


def adapted(red: tuple[float, float]) -> np.ndarray:
    """Return the matrix from linear RGB to XYZ under D50."""
    xy = np.array([red, (0.30, 0.60), (0.15, 0.06), (0.3127, 0.3290)])
    xyz = np.stack([xy[:, 0] / xy[:, 1], np.ones(4), (1 - xy.sum(1)) / xy[:, 1]])
    matrix = xyz[:, :3] * np.linalg.solve(xyz[:, :3], xyz[:, 3])
    bradford = np.array([[0.8951, 0.2664, -0.1614], [-0.7502, 1.7135, 0.0367], [0.0389, -0.0685, 1.0296]])
    scale = (bradford @ D50) / (bradford @ xyz[:, 3])
    return np.linalg.inv(bradford) @ np.diag(scale) @ bradford @ matrix


@pytest.mark.parametrize("mode", ["RGB", "RGBA", "L"])
@pytest.mark.parametrize("red, gamma", [((0.64, 0.33), 1.8), ((0.68, 0.32), 2.2), ((0.70, 0.29), 1.0)])
def test_profiles_are_converted_to_srgb(tmp_path: Path, mode: str, red: tuple[float, float], gamma: float) -> None:
    """Grey images may carry the profile of the colours that they were made from."""
    values = RNG.integers(60, 200, (HEIGHT, WIDTH, 3 if mode == "RGB" else 4)).astype(np.uint8)
    if mode == "L":
        values = rgb(values[..., :1])
    Image.fromarray(values[..., 0] if mode == "L" else values).save(tmp_path / "x.png", icc_profile=profile(red, gamma))
    read = read_image(tmp_path / "x.png")
    linear = (values[..., :3] / 255) ** gamma @ np.linalg.solve(adapted((0.64, 0.33)), adapted(red)).T
    assert np.abs(read[..., :3] - 255 * srgb_from_linear(linear)).max() <= 1.5  # rounding, and 16-bit arithmetic
    if mode == "RGBA":
        np.testing.assert_array_equal(read[..., 3], values[..., 3])


def test_sixteen_bit_grey_with_a_profile(tmp_path: Path) -> None:
    values = samples(16, 1)
    icc = zlib.compress(profile((0.64, 0.33), 1.8))
    write_png(tmp_path / "x.png", values, 16, 0, iCCP=b"x\0\0" + icc)
    expected = 255 * srgb_from_linear((as_8_bits(values, 16) / 255) ** 1.8)
    assert np.abs(read_image(tmp_path / "x.png") - expected).max() <= 1.5


def test_profiles_that_change_nothing_are_not_applied(tmp_path: Path) -> None:
    """Colours of sRGB stay exact, and a profile for other pixels than these says nothing."""
    pixels = RNG.integers(0, 256, (16, 16, 3), dtype=np.uint8)
    srgb = ImageCms.ImageCmsProfile(ImageCms.createProfile("sRGB")).tobytes()
    lab = ImageCms.ImageCmsProfile(ImageCms.createProfile("LAB")).tobytes()
    for icc in (srgb, lab):
        Image.fromarray(pixels).save(tmp_path / "x.png", icc_profile=icc)
        np.testing.assert_array_equal(read_image(tmp_path / "x.png"), pixels)
    Image.fromarray(pixels).save(tmp_path / "x.png", icc_profile=srgb[:200])
    with pytest.raises(MediaError, match=r"x\.png"):
        read_image(tmp_path / "x.png")


@pytest.mark.parametrize("gamma", [1.0, 1 / 1.8, 0.45455])
def test_gamma_of_png(tmp_path: Path, gamma: float) -> None:
    """Samples are light to the power of gamma; 0.45455 stands for sRGB's own curve, also where sRGB is declared."""
    values = samples(8, 3)
    chunk = struct.pack(">I", round(gamma * 100000))
    write_png(tmp_path / "x.png", values, 8, 2, gAMA=chunk)
    expected = np.rint(255 * srgb_from_linear((values / 255) ** (1 / gamma))) if gamma != 0.45455 else values
    assert np.abs(read_image(tmp_path / "x.png") - expected).max() <= (gamma != 0.45455)
    write_png(tmp_path / "y.png", values, 8, 2, sRGB=b"\0", gAMA=chunk)
    np.testing.assert_array_equal(read_image(tmp_path / "y.png"), values)


@pytest.mark.parametrize(
    "numbers, words", [((9, 16), "HDR .PQ"), ((9, 18), "HDR .HLG"), ((9, 1), "primaries number 9")]
)
def test_colours_declared_by_number(tmp_path: Path, numbers: tuple[int, int], words: str) -> None:
    write_png(tmp_path / "x.png", samples(8, 3), 8, 2, cICP=bytes([*numbers, 0, 1]))
    (tmp_path / "x.avif").write_bytes(avif())
    data = (tmp_path / "x.avif").read_bytes()
    place = data.index(b"colrnclx") + 8
    (tmp_path / "x.avif").write_bytes(data[:place] + struct.pack(">HH", *numbers) + data[place + 4 :])
    for name in ("x.png", "x.avif"):
        with pytest.raises(MediaError, match=words):
            image_info(tmp_path / name)


def avif() -> bytes:
    buffer = io.BytesIO()
    Image.new("RGB", (16, 16), (200, 100, 50)).save(buffer, "AVIF", quality=100)
    return buffer.getvalue()


@pytest.mark.parametrize("suffix", [".gif", ".png", ".webp", ".tif", ".avif"])
def test_several_pictures_are_refused(tmp_path: Path, suffix: str) -> None:
    pages = [Image.new("RGB", (16, 16), (k * 90, 0, 0)) for k in range(3)]
    pages[0].save(tmp_path / f"one{suffix}")
    pages[0].save(tmp_path / f"x{suffix}", save_all=True, append_images=pages[1:])
    assert image_info(tmp_path / f"one{suffix}").width == 16
    with pytest.raises(MediaError, match="several pictures"):
        image_info(tmp_path / f"x{suffix}")


def test_previews_beside_a_picture_do_not_count(tmp_path: Path) -> None:
    """Phones put a second picture into JPEGs; scanners put a thumbnail into TIFFs, raw files one in front."""
    large, small = Image.new("RGB", (16, 16), (90, 90, 90)), Image.new("RGB", (4, 4))
    large.save(tmp_path / "x.jpg", format="MPO", save_all=True, append_images=[small])
    assert read_image(tmp_path / "x.jpg").shape == (16, 16, 3)
    with TiffImagePlugin.AppendingTiffWriter(str(tmp_path / "x.tif")) as pages:
        large.save(pages, "TIFF")
        pages.newFrame()
        small.save(pages, "TIFF", tiffinfo={254: 1})
    assert read_image(tmp_path / "x.tif").shape == (16, 16, 3)
    large.save(tmp_path / "y.tif", tiffinfo={254: 1})
    with pytest.raises(MediaError, match="preview"):
        image_info(tmp_path / "y.tif")


@pytest.mark.parametrize("suffix", [".jpg", ".png", ".webp", ".tif", ".avif"])
@pytest.mark.parametrize("orientation", range(1, 9))
def test_exif_orientation(tmp_path: Path, orientation: int, suffix: str) -> None:
    """EXIF names the sides of the scene at row 0 and column 0, here of an image with the colours of its corners."""
    stored = np.zeros((32, 48), np.uint8)
    stored[:16, :24], stored[:16, 24:], stored[16:, :24] = 250, 160, 80  # the fourth corner is 0
    exif = Image.Exif()
    exif[0x0112] = orientation
    Image.fromarray(rgb(stored[..., None])).save(tmp_path / f"x{suffix}", exif=exif, quality=100)
    info = image_info(tmp_path / f"x{suffix}")
    assert (info.width, info.height, info.orientation) == (48, 32, orientation)
    pixels = read_image(tmp_path / f"x{suffix}")[..., 0].astype(int)
    assert pixels.shape == (32, 48) and np.abs(pixels - stored).max() <= 3
    turned = read_image(tmp_path / f"x{suffix}", upright=True)[..., 0].astype(int)
    assert turned.shape == info.displayed_size[::-1]
    row0 = ["", "top", "top", "bottom", "bottom", "left", "right", "right", "left"][orientation]
    column0 = ["", "left", "right", "right", "left", "top", "top", "bottom", "bottom"][orientation]
    corner = {row0, column0}  # where the first stored pixel is displayed
    place = (0 if "top" in corner else -1, 0 if "left" in corner else -1)
    assert abs(turned[place] - 250) <= 3
    # The stored neighbour along the first row moves away from the side of column 0.
    along = (place[0], -1 - place[1]) if column0 in ("left", "right") else (-1 - place[0], place[1])
    assert abs(turned[along] - 160) <= 3


def test_an_orientation_that_is_none(tmp_path: Path) -> None:
    exif = Image.Exif()
    exif[0x0112] = 77
    Image.new("RGB", (4, 4)).save(tmp_path / "x.jpg", exif=exif)
    assert image_info(tmp_path / "x.jpg").orientation == 1
    Image.new("RGB", (4, 4)).save(tmp_path / "y.jpg", exif=b"Exif\0\0nonsense")
    assert image_info(tmp_path / "y.jpg").orientation == 1


SAVED = [
    suffix for suffix in IMAGE_SUFFIXES if suffix not in (".exr", ".heic", ".heif", ".hif", ".pbm", ".pfm", ".pgm")
]


@pytest.mark.parametrize("suffix", SAVED)
def test_all_suffixes_are_read(tmp_path: Path, suffix: str) -> None:
    grey = np.linspace(20, 220, 256).astype(np.uint8).reshape(16, 16)
    image = Image.fromarray(grey if suffix == ".bw" else rgb(grey[..., None]))
    image.save(tmp_path / f"x{suffix.upper()}", **({"quality": 100} if suffix != ".gif" else {}))
    assert np.abs(read_image(tmp_path / f"x{suffix.upper()}").astype(int) - rgb(grey[..., None])).max() <= 4


def test_suffixes_are_those_of_the_formats() -> None:
    Image.init()
    known = {
        suffix for suffix, name in Image.registered_extensions().items() if name in {*images.FORMATS, "TGA", "MPO"}
    }
    assert known - {".avifs"} == {*IMAGE_SUFFIXES} - {".exr", ".heic", ".heif", ".hif"}


def test_the_content_decides_and_not_the_suffix(tmp_path: Path) -> None:
    pixels = RNG.integers(0, 256, (8, 8, 3), dtype=np.uint8)
    write_image(tmp_path / "x.png", pixels)
    for name in ("x.exr", "x.jpg", "x"):
        (tmp_path / name).write_bytes((tmp_path / "x.png").read_bytes())
        np.testing.assert_array_equal(read_image(tmp_path / name), pixels)
    (tmp_path / "x.png").write_bytes(b"%!PS-Adobe-3.0 EPSF-3.0\n%%BoundingBox: 0 0 9 9\nshowpage\n")
    with pytest.raises(MediaError, match="not an image of a known format"):
        read_image(tmp_path / "x.png")


def test_heic_needs_a_decoder(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    (tmp_path / "x.heic").write_bytes(b"\0\0\0\x18ftypheic" + bytes(200))
    monkeypatch.setitem(sys.modules, "pillow_heif", None)  # as if it were not installed
    images._formats.cache_clear()
    with pytest.raises(MediaError, match=r"x\.heic: is HEIC; .*pip install pillow-heif"):
        image_info(tmp_path / "x.heic")
    registered = []
    decoder = types.SimpleNamespace(register_heif_opener=lambda: registered.append("HEIF"))
    monkeypatch.setitem(sys.modules, "pillow_heif", decoder)
    images._formats.cache_clear()
    assert "HEIF" in images._formats(False) and registered
    images._formats.cache_clear()


def test_heic(tmp_path: Path) -> None:
    pillow_heif = pytest.importorskip("pillow_heif")
    pillow_heif.register_heif_opener()
    Image.new("RGB", (32, 16), (200, 100, 50)).save(tmp_path / "x.HEIC", quality=100)
    assert np.abs(read_image(tmp_path / "x.HEIC") - np.array([200, 100, 50])).max() <= 3
    assert image_info(tmp_path / "x.HEIC").displayed_size == (32, 16)


@pytest.mark.parametrize("attribute_bits, channels", [(0, 3), (8, 4)])
def test_tga_declares_its_alpha(tmp_path: Path, attribute_bits: int, channels: int) -> None:
    """Without attribute bits the fourth byte means nothing, and is often 0."""
    Image.new("RGBA", (4, 3), (10, 20, 30, 0)).save(tmp_path / "x.tga")
    data = bytearray((tmp_path / "x.tga").read_bytes())
    data[17] = data[17] & 0xF0 | attribute_bits
    (tmp_path / "x.tga").write_bytes(data)
    assert read_image(tmp_path / "x.tga").shape == (3, 4, channels)


def test_masks(tmp_path: Path) -> None:
    """What is not black is usable, at any depth; labels are small numbers of 16 bits, or indices of a palette."""
    labels = RNG.integers(0, 3, (HEIGHT, WIDTH, 1))
    usable = labels[..., 0] > 0
    write_png(tmp_path / "grey8.png", labels, 8, 0)
    write_png(tmp_path / "grey16.png", labels, 16, 0)
    write_png(tmp_path / "grey1.png", labels > 0, 1, 0)
    write_png(tmp_path / "palette.png", labels, 2, 3, PLTE=bytes([0, 0, 0, 0, 0, 128, 0, 128, 0]))
    write_tiff(tmp_path / "grey16.tif", labels, 16, 1)
    colour = np.where(labels > 0, [0, 1, 0], 0)
    write_png(tmp_path / "colour.png", colour, 8, 2)
    write_png(tmp_path / "alpha.png", np.concatenate([np.full((HEIGHT, WIDTH, 3), 255), labels], -1), 8, 6)
    for file in tmp_path.iterdir():
        np.testing.assert_array_equal(read_mask(file), usable, err_msg=file.name)
    write_png(tmp_path / "colour16.png", colour, 16, 2)
    with pytest.raises(MediaError, match="16-bit colours; save the mask as grey"):
        read_mask(tmp_path / "colour16.png")


@pytest.mark.parametrize("suffix", [".jpg", ".webp", ".avif"])
def test_masks_in_lossy_formats(tmp_path: Path, suffix: str) -> None:
    usable = np.zeros((32, 32), bool)
    usable[4:21, 9:30] = True
    Image.fromarray(np.where(usable, 255, 0).astype(np.uint8)).save(tmp_path / f"x{suffix}", quality=60)
    assert (read_mask(tmp_path / f"x{suffix}") != usable).mean() < 0.02


@pytest.mark.parametrize("mode, channels", [("RGB", 3), ("RGBA", 4), ("L", 3), ("LA", 4), ("P", 3)])
def test_png_modes(tmp_path: Path, mode: str, channels: int) -> None:
    Image.new(mode, (5, 4), 7).save(tmp_path / "x.png")
    assert read_image(tmp_path / "x.png").shape == (4, 5, channels)
    info = image_info(tmp_path / "x.png")
    assert (info.width, info.height, info.has_alpha) == (5, 4, channels == 4)


def test_images_round_trip(tmp_path: Path) -> None:
    pixels = np.random.default_rng(0).integers(0, 256, (6, 7, 4), dtype=np.uint8)
    write_image(tmp_path / "x.png", pixels)
    np.testing.assert_array_equal(read_image(tmp_path / "x.png"), pixels)
    flat = np.full((8, 8, 3), (200, 100, 50), np.uint8)
    write_image(tmp_path / "x.jpg", flat)
    assert np.abs(read_image(tmp_path / "x.jpg").astype(int) - flat).max() <= 2  # half a step of each of Y, Cb, Cr


def test_srgb_curve_at_known_points() -> None:
    np.testing.assert_allclose(
        srgb_from_linear(np.array([-1, 0, 0.0031308, 0.2140411, 1, 5, np.nan])),
        [0, 0, 0.0404499, 0.5, 1, 1, 0],
        atol=1e-6,
    )


@pytest.mark.parametrize("suffix", [".png", ".jpg", ".tif", ".webp", ".avif", ".bmp", ".gif", ".jp2", ".qoi", ".tga"])
def test_damaged_images_are_media_errors(tmp_path: Path, suffix: str) -> None:
    file = tmp_path / f"x{suffix}"
    with pytest.raises(MediaError, match="no such file"):
        read_image(file)
    write_image(file, RNG.integers(0, 256, (40, 40, 3), dtype=np.uint8))
    data = file.read_bytes()
    for damaged in (b"", b"nonsense", data[: len(data) // 2]):
        file.write_bytes(damaged)
        with pytest.raises(MediaError, match=file.name) as caught:
            read_image(file)
        assert "\n" not in str(caught.value)
    for _ in range(60):  # whatever the decoders raise about flipped bytes is one line
        flipped = np.frombuffer(data, np.uint8).copy()
        flipped[RNG.integers(0, min(len(data), 400), 4)] = RNG.integers(0, 256, 4)
        file.write_bytes(flipped.tobytes())
        with contextlib.suppress(MediaError):
            read_image(file)


def test_image_without_permission(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    write_image(tmp_path / "x.png", np.zeros((4, 4, 3), np.uint8))

    def refuse(*_: object, **__: object) -> None:
        raise PermissionError(13, "Permission denied", "x.png")

    monkeypatch.setattr(images.Image, "open", refuse)  # root may read everything, so the refusal is simulated
    with pytest.raises(MediaError, match="no permission"):
        read_image(tmp_path / "x.png")
