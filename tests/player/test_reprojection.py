"""Pictures that are predicted from the one before."""

from dataclasses import replace

import numpy as np
import pytest

from kpc.format.scene.cameras import Camera
from kpc.player.cpu import cpu_renderer as module
from kpc.player.cpu.cpu_renderer import LATEST, UNPREDICTED_PICTURES, ProcessorRenderer
from kpc.player.cpu.field_sampler import FieldSampler
from kpc.player.cpu.picture import BLOCK, Picture
from kpc.player.cpu.reprojection import EDGE, edge_blocks, mismatched_blocks, predict, sample_pixels
from kpc.player.quality import LEVELS, Quality
from processor import draw, processor_of, psnr
from scenes import VARIANTS, look_at, tiny_scene, with_appearances

CAMERA = look_at((2.4, 1.0, 2.2), (0.1, 0.05, 0.05), 64, 48, 70.0)
TOLERANCE = 5 / 255
PREDICTED, WHOLE = Quality(folded=True, reprojection_tolerance=TOLERANCE), Quality(folded=True)
# Two marches of the same pixel differ by rounding at most.
SAME = 1e-5


def played(renderer: ProcessorRenderer, cameras: list[Camera], times: np.ndarray) -> np.ndarray:
    """The last of several pictures."""
    for camera, time in zip(cameras, times, strict=True):
        picture = draw(renderer, camera, float(time), PREDICTED)
    return picture


def around(angles: np.ndarray) -> list[Camera]:
    return [look_at((2.4 * np.cos(a), 1.0, 2.2 * np.cos(a)), (0.1, 0.05, 0.05), 128, 96, 140.0) for a in angles]


def noted_marches(monkeypatch: pytest.MonkeyPatch) -> list[tuple[int, int]]:
    """Pixels a side of a block, and pixels, of each march from here on; sample pixels are blocks of one."""
    noted, march = [], FieldSampler.march

    def noting(self, camera, free, blocks, side, *rest) -> None:
        noted.append((side, len(blocks) * side**2))
        march(self, camera, free, blocks, side, *rest)

    monkeypatch.setattr(FieldSampler, "march", noting)
    return noted


@pytest.mark.parametrize(
    ("variant", "size"),
    [*((variant, (64, 48)) for variant in ("box", "contracted", "displaced")),
     *(("box", size) for size in ((33, 17), (1, 1), (4096, 1), (3, 64)))],
)  # fmt: skip
def test_mismatched_blocks_are_marched_again(
    variant: str, size: tuple[int, int], monkeypatch: pytest.MonkeyPatch
) -> None:
    scene, camera, times = VARIANTS[variant](tiny_scene(4)), CAMERA.resized(*size), np.linspace(0.4, 0.5, 9)
    renderer, whole = processor_of(scene), processor_of(scene)
    assert psnr(played(renderer, [camera] * 9, times), draw(whole, camera, 0.5, WHOLE)) > 40
    # Where the last picture is wrong everywhere, every block is marched, up to each edge.
    monkeypatch.setattr(module, "MOST_MISMATCHED", 9.0)
    picture = renderer.draw(camera, 0.505, PREDICTED, np.zeros(16, np.float32), is_moving=True)
    picture.rgba[:], picture.sums[:] = 9.0, 9.0
    assert np.abs(draw(renderer, camera, 0.51, PREDICTED) - draw(whole, camera, 0.51, WHOLE)).max() < SAME
    monkeypatch.undo()
    # After a jump a picture is predicted, too; at the same time, or of another size, none is.
    assert psnr(draw(renderer, camera, 0.95, PREDICTED), draw(whole, camera, 0.95, WHOLE)) > 40
    for time, other in ((0.95, camera), (0.96, camera.resized(20, 30))):
        assert np.abs(draw(renderer, other, time, PREDICTED) - draw(whole, other, time, WHOLE)).max() < SAME


def test_where_nothing_changes_only_sample_pixels_are_marched(monkeypatch: pytest.MonkeyPatch) -> None:
    renderer, marches = processor_of(tiny_scene(4)), noted_marches(monkeypatch)
    first, *_, last = (draw(renderer, CAMERA, time, PREDICTED, is_moving=False) for time in (0.4, 0.41, 0.42, 0.43))
    assert np.abs(last - first).max() < SAME
    (_, whole), *others = marches
    assert others == [(1, whole // BLOCK**2), (BLOCK, 0)] * 3


@pytest.mark.parametrize("size", [(63, 62), (64, 64), (5, 3)])
def test_every_pixel_is_a_sample_pixel_within_sixteen_turns(size: tuple[int, int]) -> None:
    counts = np.zeros(size[::-1], int)
    for turn in range(16):
        rows, columns = sample_pixels(turn, size)
        assert rows.shape == (-(-size[1] // BLOCK), -(-size[0] // BLOCK))
        assert (rows // BLOCK == np.arange(rows.shape[0])[:, None]).all() and (
            columns // BLOCK == np.arange(rows.shape[1])
        ).all()
        np.add.at(counts, (rows, columns), 1)
    whole = counts[: size[1] // BLOCK * BLOCK, : size[0] // BLOCK * BLOCK]
    assert (whole == 1).all() and (counts > 0).all()


@pytest.mark.parametrize("shape", [(12, 16), (11, 13), (1, 9)])
def test_blocks_are_mismatched_by_their_own_sample_or_a_neighbours_by_twice_as_much(shape: tuple[int, int]) -> None:
    rng = np.random.default_rng(0)
    sampled, predicted = rng.random((2, *shape, 4), np.float32)
    predicted = sampled + 0.1 * rng.exponential(1.0, sampled.shape).astype(np.float32) * (predicted - 0.5)
    got, off = mismatched_blocks(sampled, predicted, 0.1), np.abs(sampled - predicted).max(2)
    for row, column in np.ndindex(shape):
        near = off[max(row - 1, 0) : row + 2, max(column - 1, 0) : column + 2].max()
        assert got[row, column] == (off[row, column] > 0.1 or near > 0.2)
    assert 0.1 < got.mean() < 0.9 or shape == (1, 9)


@pytest.mark.parametrize("shape", [(48, 64), (47, 61), (5, 3)])
def test_blocks_over_which_opacity_varies_are_at_an_edge(shape: tuple[int, int]) -> None:
    y, x = np.mgrid[: shape[0], : shape[1]]
    opacity = np.clip(0.5 + 0.3 * (x - 0.7 * y - 5), 0, 1).astype(np.float32)
    got = edge_blocks(opacity)
    for row, column in np.ndindex(got.shape):
        means = []
        for i, j in np.ndindex(3, 3):
            ys, xs = (np.clip([BLOCK * n + 2 * k - 1, BLOCK * n + 2 * k], 0, side - 1)
                      for n, k, side in ((row, i, shape[0]), (column, j, shape[1])))  # fmt: skip
            means.append(opacity[np.ix_(ys, xs)].mean())
        assert got[row, column] == (np.ptp(means) > EDGE)
    assert got.any() != got.all() or shape == (5, 3)


@pytest.mark.parametrize("size", [(64, 48), (170, 90), (321, 1)])
def test_the_screen_mask_changes_no_prediction(monkeypatch: pytest.MonkeyPatch, size: tuple[int, int]) -> None:
    scene, camera, pictures = tiny_scene(4), CAMERA.resized(*size), []
    for most in (-1.0, 1.0):
        monkeypatch.setattr(module, "MOST_MASKED", most)
        pictures.append(played(processor_of(scene), [camera] * 5, np.linspace(0.4, 0.46, 5)))
    assert np.abs(pictures[0] - pictures[1]).max() < SAME and np.ptp(pictures[0]) > 0.1


def test_nothing_is_left_behind_by_what_moves() -> None:
    """A block of colour crosses the picture: at no time is much of it where it was before, nor does it stay after the
    loop."""
    scene = tiny_scene(4, resolution=(48, 40, 32))
    renderer, whole = processor_of(scene), processor_of(scene)
    camera, changed = CAMERA.resized(128, 96), 0.0
    first = draw(whole, camera, 0.0, WHOLE)
    for time in map(float, (*np.linspace(0, 1, 60), *np.linspace(0, 0.2, 12))):
        wanted = draw(whole, camera, time, WHOLE)
        error = np.abs(draw(renderer, camera, time, PREDICTED) - wanted).max(axis=2)
        changed = max(changed, float(np.mean(np.abs(wanted - first).max(axis=2) > 8 * TOLERANCE)))
        assert np.mean(error > 2 * TOLERANCE) < 0.02 and np.mean(error > 8 * TOLERANCE) < 0.001, time
    assert changed > 0.05


def test_a_camera_that_moves_takes_the_picture_along(monkeypatch: pytest.MonkeyPatch) -> None:
    scene, times = tiny_scene(4, resolution=(48, 40, 32)), np.linspace(0.4, 0.5, 12)
    cameras, marches = around(np.arange(12) * 0.02), noted_marches(monkeypatch)
    renderer, whole = processor_of(scene), processor_of(scene)
    got = played(renderer, cameras, times)
    assert sum(pixels for _, pixels in marches[1:]) < 0.8 * 11 * marches[0][1]  # most of each picture is predicted
    assert psnr(got, draw(whole, cameras[-1], 0.5, WHOLE)) > 40


def test_a_picture_is_predicted_from_where_its_points_were_seen() -> None:
    whole = processor_of(tiny_scene(4, resolution=(48, 40, 32)))
    cameras = [look_at((2.4 + x, 1.0, 2.2 - x), (0.1 + x, 0.05, 0.05 - x), 128, 96, 1000.0) for x in (0.0, 0.02)]
    code = np.zeros(16, np.float32)
    old = Picture(*(array.copy() for array in whole.draw(cameras[0], 0.5, WHOLE, code, is_moving=True)))
    wanted, predicted = whole.draw(cameras[1], 0.5, WHOLE, code, is_moving=True), Picture.empty((128, 96))
    predict(old, cameras[0], predicted, cameras[1])
    assert psnr(predicted.rgba, wanted.rgba) > psnr(old.rgba, wanted.rgba) + 10
    both = (predicted.rgba[..., 3] > 0.9) & (wanted.rgba[..., 3] > 0.9)
    depths = [(picture.sums[..., 0] / np.maximum(picture.rgba[..., 3], 1e-9))[both] for picture in (predicted, wanted)]
    assert np.median(np.abs(depths[0] - depths[1])) < 0.01 and both.any()


def test_a_prediction_for_the_same_camera_is_the_picture() -> None:
    whole, new = processor_of(tiny_scene(4)), Picture.empty((64, 48))
    old = whole.draw(CAMERA, 0.5, WHOLE, np.zeros(16, np.float32), is_moving=True)
    predict(old, CAMERA, new, CAMERA)
    # A point in float32 is seen within 1e-4 pixels of where it was.
    assert np.abs(new.rgba - old.rgba).max() < 1e-3 and np.ptp(old.rgba) > 0.5


def test_a_camera_that_looks_elsewhere_sees_what_is_there() -> None:
    scene = tiny_scene(4, resolution=(48, 40, 32))
    behind = look_at((-1.8, 1.4, 2.6), (0.1, 0.05, 0.05), 128, 96, 140.0)
    got = played(processor_of(scene), [*around(np.zeros(2)), behind], np.array([0.4, 0.41, 0.42]))
    assert psnr(got, draw(processor_of(scene), behind, 0.42, WHOLE)) > 35


def test_nothing_is_predicted_across_a_change_of_quality_appearance_or_planes() -> None:
    scene = with_appearances(tiny_scene(4, scales=3))
    dawn, dusk = (scene.appearance(name) for name in ("dawn.jpg", "dusk.jpg"))
    renderer, whole = processor_of(scene), processor_of(scene)

    def differs(time: float, code: np.ndarray) -> float:
        one = draw(renderer, CAMERA, time, PREDICTED, appearance=code)
        return float(np.abs(one - draw(whole, CAMERA, time, WHOLE, appearance=code)).max())

    assert differs(0.40, dawn) < SAME < differs(0.41, dawn) and differs(0.42, dusk) < SAME
    draw(renderer, CAMERA, 0.43, replace(PREDICTED, step=2.0), appearance=dusk)
    assert differs(0.44, dusk) < SAME < differs(0.45, dusk)
    scene.scales[1]["xy"][...] *= 0.9
    for each in (renderer, whole):
        each.planes_changed()
    assert differs(0.46, dusk) < SAME < differs(0.47, dusk)
    scene.scales[0]["xt"][...] *= 0.9
    for each in (renderer, whole):
        each.time_planes_changed()
    assert differs(0.48, dusk) < SAME < differs(0.49, dusk)


@pytest.mark.parametrize("others", [LATEST - 1, LATEST])
def test_only_the_latest_picture_is_predicted_from(others: int) -> None:
    renderer, whole = processor_of(tiny_scene(4)), processor_of(tiny_scene(4))
    draw(renderer, CAMERA, 0.4, PREDICTED)
    for k in range(others):
        draw(renderer, CAMERA.resized(20, 30), 0.41 + 0.01 * k, PREDICTED)
    is_whole = np.abs(draw(renderer, CAMERA, 0.5, PREDICTED) - draw(whole, CAMERA, 0.5, WHOLE)).max() < SAME
    assert is_whole == (others >= LATEST)


def test_where_most_is_mismatched_pictures_are_whole_for_a_while(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(module, "MOST_MISMATCHED", 0.0)
    marches, level = noted_marches(monkeypatch), LEVELS["balanced"]
    renderer, whole, tried = processor_of(tiny_scene(4)), processor_of(tiny_scene(4)), []
    for k in range(2 + 2 * (UNPREDICTED_PICTURES + 1)):
        time = 0.2 + 0.01 * k
        wanted = draw(whole, CAMERA, time, replace(level, reprojection_tolerance=0.0))
        marches.clear()
        np.testing.assert_array_equal(draw(renderer, CAMERA, time, level), wanted)
        tried.append(any(side == 1 for side, _ in marches))
    assert tried == [False, *([True] + UNPREDICTED_PICTURES * [False]) * 2, True]


def test_after_a_jump_that_is_mismatched_the_next_is_predicted_again(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(module, "MOST_MISMATCHED", 0.0)
    renderer, marches, tried = processor_of(tiny_scene(4)), noted_marches(monkeypatch), []
    for time in (0.1, 0.9, 0.91, 0.92):
        marches.clear()
        draw(renderer, CAMERA, time, LEVELS["balanced"])
        tried.append(any(side == 1 for side, _ in marches))
    assert tried == [False, True, True, False]


def test_the_static_part_and_the_whole_scene_are_predicted_each_from_their_own() -> None:
    scene = tiny_scene(4)
    renderer, whole = processor_of(scene), processor_of(scene)
    for time in map(float, np.linspace(0.4, 0.5, 5)):
        both = [draw(renderer, CAMERA, time, PREDICTED, is_moving=is_moving) for is_moving in (True, False)]
    for got, is_moving in zip(both, (True, False), strict=True):
        assert psnr(got, draw(whole, CAMERA, 0.5, WHOLE, is_moving=is_moving)) > 40


def test_steady_playback_allocates_nothing() -> None:
    renderer = processor_of(tiny_scene(4))
    sizes = []
    for n in range(12):
        draw(renderer, CAMERA, 0.4 + n / 100, LEVELS["balanced"])
        sizes.append((renderer.memory_bytes, renderer.picture_bytes))
    assert len(set(sizes[3:])) == 1 and sizes[3][1] > 0
