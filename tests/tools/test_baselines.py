"""What a user has at hand codes planes and brings them back."""

from collections.abc import Mapping

import numpy as np
import pytest
from kpc.format.coding.quantise import looked_up_cells, needed_texels
from kpc.format.common.errors import MediaError
from kpc.format.scene.scene import TIME_PLANES
from kpc.tools.bench import baselines
from kpc.tools.bench.baselines import RIVALS, Bytes, Half, Pictures, Rival, Video, tidied
from scenes import tiny_scene

SCENE = tiny_scene(1, channels=5)


def worst(ours: list[dict[str, np.ndarray]], theirs: baselines.Planes, levels: bool) -> float:
    """The largest error, of numbers or in widths of the channels' ranges."""

    def one(a: np.ndarray, b: np.ndarray) -> float:
        width = np.ptp(b, axis=(0, 1)) if levels else 1.0
        return float((np.abs(a - b) / np.maximum(width, 1e-6)).max())

    return max(one(a[name], b[name]) for a, b in zip(ours, theirs, strict=True) for name in b)


@pytest.mark.parametrize("rival", RIVALS, ids=lambda rival: rival.name)
def test_coarser_settings_take_less_and_err_more(rival: Rival) -> None:
    if why := rival.missing():
        pytest.skip(why)
    planes = tidied(SCENE)
    fine, coarse = (rival.code(planes, setting) for setting in (rival.settings[0], rival.settings[-1]))
    assert 0 < coarse.size_bytes < fine.size_bytes and min(fine.encode_s, fine.decode_s) > 0
    errors = [
        np.mean([np.square(a[n] - b[n]).mean() for a, b in zip(c.planes, planes) for n in b]) for c in (fine, coarse)
    ]
    assert errors[0] < errors[1]
    for scale, original in zip(fine.planes, planes, strict=True):
        assert {n: p.shape for n, p in scale.items()} == {n: p.shape for n, p in original.items()}
        assert all(plane.dtype == np.float32 for plane in scale.values())
    assert (
        list(rival.settings) in (sorted(rival.settings), sorted(rival.settings, reverse=True))
        and len(rival.settings) >= 4
    )


@pytest.mark.parametrize("rival", [Bytes(), Pictures("png"), Pictures("webp")], ids=lambda rival: rival.name)
@pytest.mark.parametrize("bits", [8, 4])
def test_levels_err_by_half_of_one(rival: Rival, bits: int) -> None:
    if why := rival.missing():
        pytest.skip(why)
    planes = tidied(SCENE)
    assert worst(rival.code(planes, bits).planes, planes, True) <= 0.5 / (2**bits - 1) * 1.001


@pytest.mark.parametrize("tool", ["zstd -19", "xz -9"])
def test_halves_err_by_half_of_their_last_bit(tool: str) -> None:
    planes = tidied(SCENE)
    back = Half(tool).code(planes, 10).planes
    assert all(np.array_equal(a[n], b[n].astype(np.float16)) for a, b in zip(back, planes) for n in b)
    coarse = Half(tool).code(planes, 4).planes
    assert all((np.abs(a[n] - b[n]) <= np.abs(b[n]) * 2.0**-5 * 1.02).all() for a, b in zip(coarse, planes) for n in b)


def test_all_that_undoes_a_coding_is_counted() -> None:
    """A float32 least and width of each channel, and what the tool makes of the levels."""
    planes = tidied(SCENE)
    for rival in (Bytes(), Pictures("png")):
        blobs = rival.encode(planes, 8)
        assert rival.code(planes, 8).size_bytes == sum(map(len, blobs))
        assert len(blobs[-1]) == 8 * sum(plane.shape[2] for scale in planes for plane in scale.values())


def test_what_nobody_reads_is_evened_out_and_the_rest_is_as_it_was() -> None:
    reached = looked_up_cells(SCENE)
    for tidy, scale in zip(tidied(SCENE), SCENE.scales, strict=True):
        for name, plane in scale.items():
            needed = needed_texels(reached, name, *plane.shape[:2])
            np.testing.assert_array_equal(tidy[name][needed], plane[needed])
            expected = 1.0 if name in TIME_PLANES else plane[needed].mean(0)
            np.testing.assert_allclose(
                tidy[name][~needed], np.broadcast_to(expected, tidy[name][~needed].shape), rtol=1e-5
            )


@pytest.mark.parametrize("shape", [(5, 7, 1), (5, 7, 5), (3, 2, 64)])
def test_canvases_hold_every_channel(shape: tuple[int, int, int]) -> None:
    plane = np.random.default_rng(0).integers(0, 256, shape).astype(np.uint8)
    np.testing.assert_array_equal(baselines._uncanvassed(baselines._canvas(plane), shape), plane)
    scale: Mapping[str, np.ndarray] = {"xy": plane, "xz": np.ascontiguousarray(plane.transpose(1, 0, 2))}
    back = baselines._unpacked(baselines._packed(scale), {name: p.shape for name, p in scale.items()})
    assert all(np.array_equal(back[name], p) for name, p in scale.items())


def test_an_encoder_that_is_not_there_is_said() -> None:
    assert Video("X", "libnothing", (1,), ()).missing() == "this ffmpeg has no libnothing"
    with pytest.raises(MediaError, match="ffmpeg: "):
        Video("X", "libnothing", (1,), ()).code(tidied(SCENE), 1)
