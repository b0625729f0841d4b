"""EXR images of any layer, type and window become sRGB with straight alpha, or are refused by name."""

import os
from pathlib import Path

import numpy as np
import OpenEXR
import pytest

from kpc.format.common.errors import MediaError
from kpc.format.common.images import image_info, read_image, read_mask, srgb_from_linear

LINEAR = np.random.default_rng(0).uniform(-0.2, 1.4, (5, 6, 4)).astype(np.float32)


def write(path: Path, channels: dict[str, np.ndarray], **header: object) -> None:
    """Write an EXR of scan lines. OpenEXR wants attributes as the types that it reads."""
    full = {"compression": OpenEXR.ZIP_COMPRESSION, "type": OpenEXR.scanlineimage, **header}
    with OpenEXR.File(full, {name: OpenEXR.Channel(values.copy()) for name, values in channels.items()}) as exr:
        exr.write(str(path))


def named(names: str, values: np.ndarray = LINEAR, layer: str = "") -> dict[str, np.ndarray]:
    """Return channels of these one-letter names."""
    return {layer + name: np.ascontiguousarray(values[..., k]) for k, name in enumerate(names)}


def srgb(linear: np.ndarray) -> np.ndarray:
    return np.rint(255 * srgb_from_linear(linear)).astype(np.uint8)


@pytest.mark.parametrize("kind", [np.float16, np.float32])
def test_colours_are_converted_by_the_srgb_curve(tmp_path: Path, kind: type) -> None:
    values = LINEAR.astype(kind)
    write(tmp_path / "x.exr", named("RGB", values))
    np.testing.assert_array_equal(read_image(tmp_path / "x.exr"), srgb(values[..., :3].astype(np.float32)))
    assert not image_info(tmp_path / "x.exr").has_alpha


def test_alpha_is_associated(tmp_path: Path) -> None:
    alpha = np.linspace(0, 1, 30, dtype=np.float32).reshape(5, 6, 1)
    write(tmp_path / "x.exr", named("RGBA", np.concatenate([LINEAR[..., :3] * alpha, alpha], axis=-1)))
    read = read_image(tmp_path / "x.exr").astype(int)
    assert np.abs(read[..., :3] - np.where(alpha > 0, srgb(LINEAR[..., :3]), 0)).max() <= 1  # float32 rounding
    np.testing.assert_array_equal(read[..., 3:], np.rint(255 * alpha))
    assert image_info(tmp_path / "x.exr").has_alpha
    np.testing.assert_array_equal(read_mask(tmp_path / "x.exr"), (alpha > 0)[..., 0])


def test_luminance_alone_is_grey(tmp_path: Path) -> None:
    write(tmp_path / "x.EXR", named("YA"))
    read = read_image(tmp_path / "x.EXR")
    assert read.shape == (5, 6, 4) and (read[..., 0] == read[..., 2]).all()


def test_values_that_are_no_numbers(tmp_path: Path) -> None:
    values = np.stack([np.full((2, 2), v, np.float32) for v in (np.nan, np.inf, -np.inf)], axis=-1)
    write(tmp_path / "x.exr", named("RGB", values))
    np.testing.assert_array_equal(read_image(tmp_path / "x.exr")[0, 0], [0, 255, 0])


def test_the_layer_of_the_picture(tmp_path: Path) -> None:
    """The layer without a name counts first, then Blender's Combined; coordinates X, Y, Z are no luminance."""
    other = named("RGB", 1 - LINEAR, "ViewLayer.DiffCol.") | named("XYZ", LINEAR, "ViewLayer.Normal.")
    expected = srgb(LINEAR[..., :3])
    write(tmp_path / "one.exr", named("RGB", LINEAR, "beauty.") | named("XYZ", LINEAR, "normal."))
    write(tmp_path / "combined.exr", named("RGB", LINEAR, "ViewLayer.Combined.") | other)
    write(tmp_path / "nameless.exr", named("RGB", LINEAR) | other)
    for file in tmp_path.iterdir():
        np.testing.assert_array_equal(read_image(file), expected, err_msg=file.name)


@pytest.mark.parametrize(
    "channels, words",
    [
        (named("RGB", LINEAR, "left.") | named("RGB", LINEAR, "right."), "left.B, left.G, left.R"),
        (named("Z"), "its channels are Z"),
        (named("RG"), "its channels are G, R"),
        (named("XYZ", LINEAR, "N."), "its channels are N.X"),
        (named("RGB", np.ones((2, 2, 3), np.uint32)), "integers of unknown range"),
    ],
)
def test_channels_that_are_no_picture(tmp_path: Path, channels: dict[str, np.ndarray], words: str) -> None:
    write(tmp_path / "x.exr", channels)
    with pytest.raises(MediaError, match=rf"x\.exr: .*{words}"):
        read_image(tmp_path / "x.exr")


def test_parts(tmp_path: Path) -> None:
    depth = OpenEXR.Part({}, {"Z": np.ones((5, 6), np.float32)}, "depth")
    colour = OpenEXR.Part({}, {"RGB": np.ascontiguousarray(LINEAR[..., :3])}, "colour")
    with OpenEXR.File([depth, colour]) as exr:
        exr.write(str(tmp_path / "x.exr"))
    np.testing.assert_array_equal(read_image(tmp_path / "x.exr"), srgb(LINEAR[..., :3]))


@pytest.mark.parametrize("left, top", [(2, 1), (-2, -3), (4, -1), (20, 20)])
def test_the_data_window_is_placed_in_the_display_window(tmp_path: Path, left: int, top: int) -> None:
    """Compositors crop to what is not empty, or keep a margin outside the picture."""
    windows = {
        "dataWindow": (np.array([left, top], np.int32), np.array([left + 5, top + 4], np.int32)),
        "displayWindow": (np.array([0, 0], np.int32), np.array([7, 8], np.int32)),
    }
    write(tmp_path / "x.exr", named("RGB"), **windows)
    info, read = image_info(tmp_path / "x.exr"), read_image(tmp_path / "x.exr")
    assert (info.width, info.height) == (8, 9) and read.shape == (9, 8, 3)
    for y, x in np.ndindex(9, 8):
        inside = 0 <= y - top < 5 and 0 <= x - left < 6
        np.testing.assert_array_equal(read[y, x], srgb(LINEAR[y - top, x - left, :3]) if inside else 0)


def test_windows_of_any_size_cost_no_memory(tmp_path: Path) -> None:
    far = np.array([30_000, 30_000], np.int32)
    write(tmp_path / "x.exr", named("RGB"), displayWindow=(np.array([0, 0], np.int32), far))
    with pytest.raises(MediaError, match="no image has more than"):
        image_info(tmp_path / "x.exr")


def test_colours_of_other_primaries_are_refused(tmp_path: Path) -> None:
    aces = (0.7347, 0.2653, 0.0, 1.0, 0.0001, -0.077, 0.32168, 0.33767)
    write(tmp_path / "x.exr", named("RGB"), chromaticities=aces)
    with pytest.raises(MediaError, match="not those of BT"):
        image_info(tmp_path / "x.exr")
    write(tmp_path / "y.exr", named("RGB"), chromaticities=(0.64, 0.33, 0.30, 0.60, 0.15, 0.06, 0.3127, 0.3290))
    assert image_info(tmp_path / "y.exr").width == 6


def test_damaged_files_are_media_errors(tmp_path: Path) -> None:
    write(tmp_path / "x.exr", named("RGB", np.ones((40, 40, 3), np.float32)))
    data = (tmp_path / "x.exr").read_bytes()
    for damaged in (b"", b"nonsense", data[:4], data[: len(data) // 2]):
        (tmp_path / "x.exr").write_bytes(damaged)
        with pytest.raises(MediaError, match=r"x\.exr"):
            read_image(tmp_path / "x.exr")


def test_names_that_are_not_utf8(tmp_path: Path) -> None:
    write(tmp_path / "x.exr", named("RGB"))
    name = os.fsdecode(os.fsencode(tmp_path) + b"/caf\xe9.exr")
    os.rename(tmp_path / "x.exr", name)
    assert read_image(name).shape == (5, 6, 3)
