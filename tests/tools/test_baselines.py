"""General-purpose codecs code planes and decode them again."""

from collections.abc import Mapping

import numpy as np
import pytest

from kpc.format.coding.quantise import looked_up_cells, needed_texels
from kpc.format.common.errors import MediaError
from kpc.format.scene.scene import TIME_PLANES
from kpc.tools.bench import baselines
from kpc.tools.bench.baselines import BASELINES, Baseline, Float16, LosslessImages, Uint8, Video, fill_unread_texels
from scenes import tiny_scene

SCENE = tiny_scene(1, channels=5)


def largest_error(ours: list[dict[str, np.ndarray]], theirs: baselines.Planes, levels: bool) -> float:
    """Return the largest error, absolute or (`levels`) relative to the range of the channel."""

    def one(a: np.ndarray, b: np.ndarray) -> float:
        width = np.ptp(b, axis=(0, 1)) if levels else 1.0
        return float((np.abs(a - b) / np.maximum(width, 1e-6)).max())

    return max(one(a[name], b[name]) for a, b in zip(ours, theirs, strict=True) for name in b)


@pytest.mark.parametrize("baseline", BASELINES, ids=lambda baseline: baseline.name)
def test_coarser_settings_take_fewer_bytes_and_lose_more(baseline: Baseline) -> None:
    if why := baseline.missing():
        pytest.skip(why)
    planes = fill_unread_texels(SCENE)
    fine, coarse = (baseline.code(planes, setting) for setting in (baseline.settings[0], baseline.settings[-1]))
    assert 0 < coarse.size_bytes < fine.size_bytes and min(fine.encode_s, fine.decode_s) > 0
    errors = [
        np.mean([np.square(a[n] - b[n]).mean() for a, b in zip(c.planes, planes, strict=True) for n in b])
        for c in (fine, coarse)
    ]
    assert errors[0] < errors[1]
    for scale, original in zip(fine.planes, planes, strict=True):
        assert {n: p.shape for n, p in scale.items()} == {n: p.shape for n, p in original.items()}
        assert all(plane.dtype == np.float32 for plane in scale.values())
    assert (
        list(baseline.settings) in (sorted(baseline.settings), sorted(baseline.settings, reverse=True))
        and len(baseline.settings) >= 4
    )


@pytest.mark.parametrize(
    "baseline", [Uint8(), LosslessImages("png"), LosslessImages("webp")], ids=lambda baseline: baseline.name
)
@pytest.mark.parametrize("bits", [8, 4])
def test_levels_are_at_most_half_a_step_off(baseline: Baseline, bits: int) -> None:
    if why := baseline.missing():
        pytest.skip(why)
    planes = fill_unread_texels(SCENE)
    assert largest_error(baseline.code(planes, bits).planes, planes, True) <= 0.5 / (2**bits - 1) * 1.001


@pytest.mark.parametrize("tool", ["zstd -19", "xz -9"])
def test_float16_is_at_most_half_of_the_last_bit_off(tool: str) -> None:
    planes = fill_unread_texels(SCENE)
    back = Float16(tool).code(planes, 10).planes
    assert all(np.array_equal(a[n], b[n].astype(np.float16)) for a, b in zip(back, planes, strict=True) for n in b)
    coarse = Float16(tool).code(planes, 4).planes
    assert all(
        (np.abs(a[n] - b[n]) <= np.abs(b[n]) * 2.0**-5 * 1.02).all()
        for a, b in zip(coarse, planes, strict=True)
        for n in b
    )


def test_side_information_is_counted() -> None:
    """It is float32 minimum and step of each channel, besides the coded levels."""
    planes = fill_unread_texels(SCENE)
    for baseline in (Uint8(), LosslessImages("png")):
        blobs = baseline.encode(planes, 8)
        assert baseline.code(planes, 8).size_bytes == sum(map(len, blobs))
        assert len(blobs[-1]) == 8 * sum(plane.shape[2] for scale in planes for plane in scale.values())


def test_only_unread_texels_are_filled() -> None:
    reached = looked_up_cells(SCENE)
    for filled, scale in zip(fill_unread_texels(SCENE), SCENE.scales, strict=True):
        for name, plane in scale.items():
            needed = needed_texels(reached, name, *plane.shape[:2])
            np.testing.assert_array_equal(filled[name][needed], plane[needed])
            expected = 1.0 if name in TIME_PLANES else plane[needed].mean(0)
            np.testing.assert_allclose(
                filled[name][~needed], np.broadcast_to(expected, filled[name][~needed].shape), rtol=1e-5
            )


@pytest.mark.parametrize("shape", [(5, 7, 1), (5, 7, 5), (3, 2, 64)])
def test_canvases_are_reversible(shape: tuple[int, int, int]) -> None:
    plane = np.random.default_rng(0).integers(0, 256, shape).astype(np.uint8)
    np.testing.assert_array_equal(baselines._from_canvas(baselines._canvas(plane), shape), plane)
    scale: Mapping[str, np.ndarray] = {"xy": plane, "xz": np.ascontiguousarray(plane.transpose(1, 0, 2))}
    back = baselines._unpacked(baselines._packed(scale), {name: p.shape for name, p in scale.items()})
    assert all(np.array_equal(back[name], p) for name, p in scale.items())


def test_a_missing_encoder_is_reported() -> None:
    assert Video("X", "libnothing", (1,), ()).missing() == "this ffmpeg has no libnothing"
    with pytest.raises(MediaError, match="ffmpeg: "):
        Video("X", "libnothing", (1,), ()).code(fill_unread_texels(SCENE), 1)
