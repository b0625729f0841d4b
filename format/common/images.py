"""Reading and writing of images, through Pillow and OpenEXR.

Whatever a file holds, `read_image` returns 8-bit sRGB with straight alpha, or refuses the file by name:

* grey levels and colours of 16 bits become their high byte; those of fewer than 8 bits span 0 to 255;
* colours of an ICC profile or of a PNG's gamma are converted to sRGB, those of CMYK without a profile by
  (1 - C)(1 - K);
* EXR holds linear light, which is clipped to [0, 1] and converted by the sRGB curve;
* integers and floating-point numbers of unknown range, HDR curves (PQ, HLG) and files of several pictures are refused.
"""

import contextlib
import functools
import io
import os
import struct
import warnings
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from PIL import ExifTags, Image, ImageCms, UnidentifiedImageError

from kpc.format.common.cli import atomic_write
from kpc.format.common.errors import MediaError
from kpc.format.common.exr import exr_info, is_exr, read_exr
from kpc.format.common.media_files import require_file

# Pillow's names of the formats that are read. Others are documents, icons or textures, and some start programs.
FORMATS = ("PNG", "JPEG", "TIFF", "WEBP", "AVIF", "BMP", "DIB", "GIF", "JPEG2000", "PPM", "PCX", "QOI", "SGI")

# Formats that change values a little, so that a mask's 0 may be read as 1.
LOSSY_FORMATS = ("JPEG", "MPO", "WEBP", "AVIF", "HEIF", "JPEG2000")

# Modes of Pillow from which colours are known to convert; those of 16-bit grey begin with "I;16".
_MODES = ("1", "L", "LA", "La", "P", "PA", "RGB", "RGBA", "RGBa", "RGBX", "CMYK", "YCbCr", "LAB")

# Tags of TIFF and EXIF.
_SUBFILE_TYPE, _BITS, _PHOTOMETRIC, _ORIENTATION, _PLANAR, _SAMPLE_FORMAT = 254, 258, 262, 274, 284, 339
_MAKER_NOTE, _LENS_MODEL = 0x927C, 0xA434

# Transfer curves of HDR, by their numbers in ITU-T H.273.
_HDR_CURVES = {16: "PQ", 18: "HLG"}

# What Pillow, OpenEXR and their plugins raise about damaged files.
_DAMAGE = (
    *(UnidentifiedImageError, Image.DecompressionBombError, ImageCms.PyCMSError, struct.error, OSError, SyntaxError),
    *(ValueError, KeyError, IndexError, RuntimeError, TypeError, EOFError, OverflowError, AssertionError),
)


@dataclass(frozen=True)
class ImageInfo:
    """Properties of an image, from its header.

    Attributes:
        width, height: pixels, as stored.
        has_alpha: whether there is an alpha channel or a transparent colour.
        orientation: EXIF's number from 1 (as stored) to 8; from 5 on width and height are exchanged for display.
    """

    width: int
    height: int
    has_alpha: bool
    orientation: int = 1

    @property
    def displayed_size(self) -> tuple[int, int]:
        """Width and height after the EXIF orientation is applied."""
        return (self.width, self.height) if self.orientation < 5 else (self.height, self.width)


@dataclass(frozen=True)
class CameraTags:
    """What a camera wrote beside a picture. All but the orientation is data of unknown origin.

    Attributes:
        orientation: as that of `ImageInfo`.
        maker_note: EXIF's MakerNote; empty without one.
        lens: EXIF's LensModel; empty without one.
        xmp: the packet of XMP; empty without one.
    """

    orientation: int = 1
    maker_note: bytes = b""
    lens: str = ""
    xmp: bytes = b""


def image_info(path: str | os.PathLike[str]) -> ImageInfo:
    """Return an image's properties, from its header.

    Raises:
        MediaError: as `read_image`.
    """
    with _image_errors(path):
        if is_exr(path):
            return ImageInfo(*exr_info(path))
        with _opened(path) as image:
            orientation = _orientation(image)
            size = image.size[::-1] if image.format == "TIFF" and orientation >= 5 else image.size
            return ImageInfo(*size, _has_alpha(image), orientation)


def camera_tags(path: str | os.PathLike[str]) -> CameraTags:
    """Return what a camera wrote beside a picture; tags that cannot be read are left out.

    Raises:
        MediaError: as `read_image`.
    """
    with _image_errors(path):
        if is_exr(path):
            return CameraTags()
        with _opened(path) as image:
            orientation = _orientation(image)
            try:
                details = Image.Image.getexif(image).get_ifd(ExifTags.IFD.Exif)
                note, lens = details.get(_MAKER_NOTE), details.get(_LENS_MODEL)
            except _DAMAGE:
                note, lens = None, None
            xmp = image.info.get("xmp")
            return CameraTags(
                orientation,
                note if isinstance(note, bytes) else b"",
                lens if isinstance(lens, str) else "",
                xmp if isinstance(xmp, bytes) else b"",
            )


def read_image(path: str | os.PathLike[str], *, upright: bool = False) -> np.ndarray:
    """Read an image as 8-bit sRGB.

    Args:
        path: of the image.
        upright: whether to apply the EXIF orientation; else pixels are returned as stored.

    Returns:
        (height, width, 3) uint8, or 4 channels with straight alpha if the file has alpha.

    Raises:
        MediaError: the file is missing, damaged, or of a format, depth or colour space that is not read.
    """
    with _image_errors(path):
        if is_exr(path):
            linear = read_exr(path)
            return np.rint(np.concatenate([srgb_from_linear(linear[..., :3]), linear[..., 3:]], -1) * 255).astype(
                np.uint8
            )
        with _opened(path) as image:
            orientation = _orientation(image)
            alpha = _alpha(image) if _has_alpha(image) else None
            pixels = _srgb(image)
            if alpha is not None:
                pixels = np.concatenate([pixels, alpha[..., None]], axis=-1)
            return _oriented(image, pixels, orientation, upright)


def read_mask(path: str | os.PathLike[str], *, upright: bool = False) -> np.ndarray:
    """Read which pixels of an image are neither black nor transparent, at its full depth.

    In a lossy format (LOSSY_FORMATS) black is what is darker than half, since compression changes values.

    Returns:
        (height, width) bool.

    Raises:
        MediaError: as `read_image`, or colours have 16 bits, of which Pillow reads but the high byte.
    """
    with _image_errors(path):
        if is_exr(path):
            return (read_exr(path) != 0).all(axis=-1)
        with _opened(path) as image:
            orientation = _orientation(image)
            if _is_16_bit(image):
                usable = np.asarray(image) != 0
            elif ";16" in _raw_mode(image):
                raise MediaError(f"{path}: holds 16-bit colours; save the mask as grey levels")
            else:
                usable = (np.asarray(_plain(image).convert("RGB")) > (127 if image.format in LOSSY_FORMATS else 0)).any(
                    axis=-1
                )
            if _has_alpha(image):
                usable &= _alpha(image) > 0
            return _oriented(image, usable, orientation, upright)


def write_image(path: str | os.PathLike[str], pixels: np.ndarray, jpeg_quality: int = 95) -> None:
    """Write a (height, width, 3 or 4) uint8 image as PNG or JPEG, chosen by the suffix."""
    with atomic_write(path) as temporary:
        Image.fromarray(pixels).save(temporary, quality=jpeg_quality)


def srgb_from_linear(linear: np.ndarray) -> np.ndarray:
    """Apply the sRGB transfer curve (IEC 61966-2-1) to values, which are clipped to [0, 1]; NaN counts as 0.

    12.92 x  where x <= 0.0031308,  1.055 x^(1/2.4) - 0.055  elsewhere
    """
    clipped = np.clip(np.nan_to_num(linear), 0.0, 1.0)
    return np.where(clipped <= 0.0031308, 12.92 * clipped, 1.055 * np.power(clipped, 1 / 2.4) - 0.055)


# Weights of red, green and blue in luma (ITU-R BT.601).
LUMA = np.array([0.299, 0.587, 0.114], np.float32)


def luma(picture: np.ndarray) -> np.ndarray:
    """Return the luma of a picture, (H, W) float32 in [0, 255]."""
    found: np.ndarray = picture[..., :3].astype(np.float32) @ LUMA
    return found


def linear_from_srgb(display: np.ndarray) -> np.ndarray:
    """Apply the inverse of the curve of `srgb_from_linear` to values in [0, 1]."""
    return np.where(display <= 0.04045, display / 12.92, ((display + 0.055) / 1.055) ** 2.4)


@contextlib.contextmanager
def _opened(path: str | os.PathLike[str]) -> Iterator[Image.Image]:
    """Open an image with the decoders of FORMATS and refuse what would be misread."""
    with Image.open(path, formats=_formats(Path(path).suffix.lower() in (".tga", ".icb", ".vda", ".vst"))) as image:
        refusal = _refusal(path, image)
        if refusal:
            raise MediaError(f"{path}: {refusal}")
        yield image


@functools.cache
def _formats(with_tga: bool) -> tuple[str, ...]:
    """Return the formats that this Pillow reads; TGA, which has no signature, where the suffix says so."""
    Image.init()
    names = (*FORMATS, "TGA") if with_tga else FORMATS
    try:
        import pillow_heif
    except ImportError:
        return tuple(name for name in names if name in Image.OPEN)
    pillow_heif.register_heif_opener()
    return (*(name for name in names if name in Image.OPEN), "HEIF")


def _refusal(path: str | os.PathLike[str], image: Image.Image) -> str | None:
    """Return what about an image would be misread, and what to do; None if all is known."""
    tags = getattr(image, "tag_v2", {})  # of TIFF
    deep_colour = len(tags.get(_BITS, ())) > 1 and max(tags[_BITS]) > 8
    if image.format not in ("MPO", "HEIF") and _picture_count(image) > 1:  # phones put previews behind the first
        return "holds several pictures; save the one that is meant as a PNG"
    if tags.get(_SUBFILE_TYPE, 0) & 1:
        return "its first picture is a preview; develop or export it as a PNG"
    if (image.mode in ("I", "F") and not _is_16_bit(image)) or set(tags.get(_SAMPLE_FORMAT, (1,))) != {1}:
        kind = "floating-point" if image.mode == "F" else "signed or 32-bit"
        return f"holds {kind} values of unknown range; export 8 or 16 bits without sign, or EXR for linear light"
    if image.mode not in _MODES and not image.mode.startswith("I"):
        return f"holds pixels of the mode {image.mode}, whose colours are not known; convert it to RGB"
    if image.format == "JPEG" and image.mode == "CMYK" and "adobe" not in image.info:
        return "is a CMYK JPEG without Adobe's marker, which may or may not be inverted; convert it to RGB"
    if deep_colour and tags.get(_PLANAR) == 2:
        return "holds 16-bit channels in planes of their own; save it with interleaved channels, or as a PNG"
    if "transparency" in image.info and image.mode == "RGB" and ";16" in _raw_mode(image):
        return "marks a 16-bit colour as transparent; save it with an alpha channel"
    if image.format in ("PNG", "AVIF", "HEIF") and not image.info.get("icc_profile"):
        return _foreign_colours(path)
    return None


def _picture_count(image: Image.Image) -> int:
    """Return the number of pictures, without reduced versions and masks of the first; 2 stands for more."""
    count = min(getattr(image, "n_frames", 1), 1000)
    if image.format != "TIFF" or count == 1:
        return count
    full = 0
    for number in range(count):
        image.seek(number)
        full += not image.tag_v2.get(_SUBFILE_TYPE, 0) & 5  # type: ignore[attr-defined]
        if full > 1:
            break
    image.seek(0)
    return full


def _foreign_colours(path: str | os.PathLike[str]) -> str | None:
    """Say which colours AVIF, HEIC or PNG declares by numbers of ITU-T H.273, unless they are those of sRGB."""
    with open(path, "rb") as file:
        head = file.read(1 << 16)
    if b"colrnclx" in head[:-14]:
        primaries, curve = struct.unpack_from(">HH", head, head.index(b"colrnclx") + 8)
    elif head.startswith(b"\x89PNG") and b"cICP" in head[:-8]:
        primaries, curve = struct.unpack_from(">BB", head, head.index(b"cICP") + 4)
    else:
        return None
    if curve in _HDR_CURVES:
        return f"is HDR ({_HDR_CURVES[curve]}); tone-map it to sRGB first"
    # 1 is BT.709, 2 unspecified; 5 to 7 are those of television, which are close.
    return None if primaries in (1, 2, 5, 6, 7) else f"has colour primaries number {primaries}; convert it to sRGB"


def _raw_mode(image: Image.Image) -> str:
    """Return how Pillow unpacks the pixels, for example "RGB;16B"."""
    tiles = getattr(image, "tile", None)
    arguments = tiles[0].args if tiles else ""
    return str(arguments[0] if isinstance(arguments, tuple) else arguments)


def _is_16_bit(image: Image.Image) -> bool:
    """Return whether grey levels span 16 bits; some versions of Pillow give those of PNG and PGM as mode I."""
    return image.mode.startswith("I;16") or (image.mode == "I" and image.format in ("PNG", "PPM"))


def _has_alpha(image: Image.Image) -> bool:
    """Return whether there is an alpha channel or a transparent colour."""
    if image.format == "TGA" and image.mode == "RGBA":
        with open(image.filename, "rb") as file:  # type: ignore[attr-defined]
            return bool(file.read(18)[17] & 15)  # number of alpha bits; without any, the fourth byte means nothing
    return image.has_transparency_data


def _alpha(image: Image.Image) -> np.ndarray:
    """Return straight alpha, (H, W) uint8."""
    if image.mode in ("1", "L", "RGB") or image.mode.startswith("I"):  # one level or colour is transparent
        marked = np.multiply(image.info["transparency"], {"L;2": 85, "L;4": 17}.get(_raw_mode(image), 1))
        same = np.asarray(image) == (marked > 0 if image.mode == "1" else marked)  # of mode 1, white is 1 or 255
        return np.where(same.all(axis=-1) if image.mode == "RGB" else same, 0, 255).astype(np.uint8)
    straight = image.convert("LA") if image.mode == "La" else image
    return np.asarray(straight.convert("RGBA").getchannel("A"))


def _plain(image: Image.Image) -> Image.Image:
    """Return the image without alpha, in RGB, L, CMYK or LAB."""
    if image.mode in ("1", "L", "LA", "La"):
        return (image.convert("LA") if image.mode == "La" else image).convert("L")
    if image.mode in ("CMYK", "LAB"):
        return image
    return (image.convert("RGBA") if image.mode == "RGBa" else image).convert("RGB")


def _srgb(image: Image.Image) -> np.ndarray:
    """Return the colours as sRGB, (H, W, 3) uint8."""
    icc, gamma = image.info.get("icc_profile"), image.info.get("gamma")
    if _is_16_bit(image):
        tags = getattr(image, "tag_v2", {})
        bits = tags.get(_BITS, (16,))[0]
        grey = (np.asarray(image) >> (bits - 8)).astype(np.uint8)
        plain = Image.fromarray(255 - grey if tags.get(_PHOTOMETRIC) == 0 else grey)
    else:
        plain = _plain(image)
    if icc or plain.mode == "LAB":
        transform = _to_srgb(icc if plain.mode != "LAB" else None, plain.mode)
        if transform is not None:
            mode, convert = transform
            return np.asarray(convert.apply(plain.convert(mode)))
    pixels = np.asarray(plain.convert("RGB"))
    if gamma and "srgb" not in image.info and not icc and abs(gamma - 1 / 2.2) > 0.02:
        # A PNG's samples are light to the power of gamma.
        curve = srgb_from_linear((np.arange(256) / 255) ** (1 / gamma))
        pixels = np.rint(255 * curve).astype(np.uint8)[pixels]
    return pixels


@functools.lru_cache(maxsize=16)
def _to_srgb(icc: bytes | None, mode: str) -> tuple[str, ImageCms.ImageCmsTransform] | None:
    """Return the transform from a profile (None: CIE L*a*b* under D50) to sRGB, and the mode that it takes.

    Return None if the profile is sRGB within two levels, or is one for pixels of another kind.
    """
    profile = ImageCms.ImageCmsProfile(ImageCms.createProfile("LAB") if icc is None else io.BytesIO(icc))
    space = profile.profile.xcolor_space.strip()
    takes = {"RGB": "RGB", "GRAY": "L", "CMYK": "CMYK", "Lab": "LAB"}.get(space)
    if takes != mode and not (takes == "RGB" and mode == "L"):
        return None
    transform = ImageCms.buildTransform(
        profile, ImageCms.createProfile("sRGB"), takes, "RGB", ImageCms.Intent.RELATIVE_COLORIMETRIC
    )
    if takes in ("RGB", "L"):
        steps = np.arange(0, 256, 17, dtype=np.uint8)
        cube = np.stack(np.meshgrid(steps, steps, steps), axis=-1).reshape(1, -1, 3)
        probe = Image.fromarray(cube).convert(takes)
        change = np.asarray(transform.apply(probe)).astype(int) - np.asarray(probe.convert("RGB"))
        if np.abs(change).max() <= 2:
            return None
    return takes, transform


def _orientation(image: Image.Image) -> int:
    """Return EXIF's orientation, 1 to 8; to be called before pixels are read."""
    if image.format == "TIFF":
        number = image.tag_v2.get(_ORIENTATION, 1)  # type: ignore[attr-defined]
    else:
        try:
            number = Image.Image.getexif(image).get(_ORIENTATION, 1)  # that of PNG would decode the whole image
        except _DAMAGE:
            number = 1
    return number if number in range(1, 9) else 1


def _oriented(image: Image.Image, pixels: np.ndarray, orientation: int, upright: bool) -> np.ndarray:
    """Return pixels upright or as stored. Pillow has turned those of TIFF upright already."""
    if (image.format == "TIFF") == upright:
        return pixels
    if not upright:
        orientation = {6: 8, 8: 6}.get(orientation, orientation)  # the others undo themselves
    if orientation >= 5:
        pixels = pixels.swapaxes(0, 1)
    if orientation in (2, 3, 6, 7):
        pixels = pixels[:, ::-1]
    if orientation in (3, 4, 7, 8):
        pixels = pixels[::-1]
    return np.ascontiguousarray(pixels)


@contextlib.contextmanager
def _image_errors(path: str | os.PathLike[str]) -> Iterator[None]:
    """Turn what Pillow and OpenEXR raise about `path` into a MediaError."""
    require_file(path)
    try:
        with warnings.catch_warnings(action="ignore"):  # Pillow warns of large images
            yield
    except PermissionError as error:
        raise MediaError(f"{path}: no permission to read it; chmod it or run as its owner") from error
    except _DAMAGE as error:
        raise MediaError(f"{path}: {_unreadable(path, error)}") from error


def _unreadable(path: str | os.PathLike[str], error: Exception) -> str:
    """Return why an image cannot be read, and what to do."""
    with open(path, "rb") as file:
        head = file.read(12)
    if head[4:8] == b"ftyp" and "HEIF" not in _formats(False) and head[8:12] != b"avif":
        return "is HEIC; install its decoder (pip install pillow-heif), or convert it to PNG or JPEG"
    if isinstance(error, UnidentifiedImageError):
        return "not an image of a known format, or damaged; convert it to PNG or JPEG, or copy it anew"
    return f"not an image that can be read ({error}); export or copy it anew"
