"""Clean plates, mattes, and what is made of them."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from kpc.encoder.coding.scene_writer import write
from kpc.format.coding.quantise import quantise_scene
from kpc.format.common.images import read_image
from kpc.format.container.scene_io import read
from kpc.format.scene.cameras import Camera
from kpc.format.scene.scene import Scene
from kpc.player.cpu import reference
from kpc.player.cpu.reference import Rendering
from kpc.tools.cli import kprender
from kpc.tools.rendering.clean_plate import INSTANTS, CleanPlates, clean_plate, matte, motion_colours
from scenes import VARIANTS, tiny_scene

HEIGHT, WIDTH = 24, 32
WALL, BALL, SHADOW = (0.2, 0.5, 0.4), (0.9, 0.1, 0.1), (0.1, 0.3, 0.2)


def wall_with(*patches: tuple[slice, slice, tuple[float, float, float], float], noise: float = 0.0) -> Rendering:
    """A wall at distance 4, with patches of another colour and distance."""
    rgb, depth = np.empty((HEIGHT, WIDTH, 3), np.float32), np.full((HEIGHT, WIDTH), 4, np.float32)
    rgb[:] = WALL
    rgb += np.random.default_rng(round(noise * 1e6)).uniform(-0.02, 0.02, rgb.shape) * (noise > 0)
    for rows, columns, colour, distance in patches:
        rgb[rows, columns], depth[rows, columns] = colour, distance
    return Rendering(rgb, depth, np.ones_like(depth), np.ones(depth.shape, np.int32))


def ball(column: int) -> tuple[slice, slice, tuple[float, float, float], float]:
    return slice(8, 14), slice(column, column + 6), BALL, 2.0


def test_what_passes_is_removed_and_masked() -> None:
    """A ball that rests for three quarters of the clip, and then goes, uncovers the wall behind it."""
    for rests in (4, 8, 12):
        pictures = [wall_with(ball(4 if k < rests else 20), noise=0.1 + k) for k in range(16)]
        plate = clean_plate(pictures)
        assert np.abs(plate.rgb - WALL).max() < 0.03 and (plate.depth == 4).all()
        for number, column in ((0, 4), (15, 20)):
            share = matte(pictures[number], plate)
            expected = np.zeros((HEIGHT, WIDTH), bool)
            expected[8:14, column : column + 6] = True
            assert (share[expected] == 1).all() and (share[~expected] == 0).all()


def test_what_is_nearer_is_masked_whatever_its_colour() -> None:
    """A thing of the wall's colour passes before it; what is farther or hardly nearer is no part of it."""
    patches = {1: 2.0, 9: 3.9, 17: 3.7, 25: 5.0}
    camouflaged = wall_with(*((slice(8, 14), slice(k, k + 6), WALL, depth) for k, depth in patches.items()))
    share = matte(camouflaged, wall_with())
    assert (share[8:14, 1:7] == 1).all() and (share[8:14, 9:15] == 0).all()
    np.testing.assert_allclose(share[8:14, 17:23], 0.5, atol=1e-5)
    share[8:14, [*range(1, 7), *range(17, 23)]] = 0
    assert not share.any()
    nothing = replace(wall_with(), depth=np.full((HEIGHT, WIDTH), np.inf, np.float32))
    assert not matte(nothing, wall_with()).any() and not matte(nothing, nothing).any()
    assert (matte(wall_with(), nothing) == 1).all()  # a thing of the background's colour, before nothing
    haze = replace(wall_with(), opacity=np.full((HEIGHT, WIDTH), 0.002, np.float32))
    assert matte(haze, nothing).max() < 0.01


def test_what_never_leaves_stays() -> None:
    pictures = [wall_with(ball(4), noise=0.1 + k) for k in range(16)]
    plate = clean_plate(pictures)
    assert np.allclose(plate.rgb[8:14, 4:10], BALL) and not matte(pictures[3], plate).any()


def test_a_shadow_shorter_than_the_light_is_removed() -> None:
    """A shadow lies at the distance of what it falls on, so the time that it stays decides."""
    shadow = (slice(16, 22), slice(4, 12), SHADOW, 4.0)
    dark = [wall_with(*[shadow] * (k < 6)) for k in range(16)]
    assert np.allclose(clean_plate(dark).rgb, WALL, atol=1e-3)
    assert matte(dark[0], clean_plate(dark))[18, 8] == 1


def test_a_map_is_grey_where_the_matte_is_black() -> None:
    picture = wall_with(ball(4))
    map_ = motion_colours(picture, matte(picture, wall_with())).rgb
    assert np.ptp(map_[:, 12:], axis=2).max() < 1e-6 and np.ptp(map_[8:14, 4:10], axis=2).min() > 0.3


@pytest.mark.parametrize("space", VARIANTS)
def test_a_still_scene_has_no_matte(space: str) -> None:
    """The plate of a scene that does not move is its picture; a fixed camera's plate is rendered once."""
    scene = VARIANTS[space](tiny_scene())
    camera = scene.cameras[0].resized(24, 18)
    calls: list[float] = []

    def draw(shown: Scene, seen_by: Camera, time: float) -> Rendering:
        calls.append(time)
        return reference.render(shown, seen_by, 0.4)  # at whatever time

    plates = CleanPlates(draw)
    for _ in range(3):
        assert not matte(reference.render(scene, camera, 0.4), plates.of(scene, camera)).any()
    assert calls == list(INSTANTS)


@pytest.fixture(scope="module")
def scene_file(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A scene whose right half disappears in the second half of the clip, and which does not change otherwise."""
    path = tmp_path_factory.mktemp("scene") / "half.kpc"
    scene = tiny_scene(4, time=9)
    still = tuple({name: plane if "t" not in name else np.ones_like(plane) for name, plane in scale.items()}
                  for scale in scene.scales)  # fmt: skip
    occupancy = scene.occupancy[:1].repeat(2, axis=0)
    occupancy[1, :, :, occupancy.shape[3] // 2 :] = False
    scene = replace(scene, scales=still, occupancy=occupancy, motion=None)
    write(quantise_scene(scene, [dict.fromkeys(scale, 0.01) for scale in scene.scales]), path)
    return path


def test_kprender_writes_plates_and_what_moves(scene_file: Path, tmp_path: Path) -> None:
    words = [str(scene_file), "--backend", "reference", "--size", "24x18", "-o"]

    def rendered(name: str, *options: str) -> np.ndarray:
        assert kprender.main([*words, str(tmp_path / name), *options]) == 0
        return read_image(tmp_path / name).astype(int)

    early, late = rendered("early.png", "--time", "0.2"), rendered("late.png", "--time", "0.8")
    gone = np.abs(early - late).max(axis=2) > 60
    assert 0.05 < gone.mean() < 0.7
    for time in ("0.2", "0.8"):
        assert np.abs(rendered("plate.png", "--time", time, "--static-only") - late)[gone].max() <= 1
    share = rendered("matte.png", "--time", "0.2", "--matte")
    assert (share[gone] == 255).all() and not rendered("none.png", "--time", "0.8", "--matte")[gone].any()
    cut = rendered("cut.png", "--time", "0.2", "--dynamic-only", "--background", "transparent")
    scene = read(scene_file).dequantise()
    opacity = 255 * reference.render(scene, scene.cameras[0].resized(24, 18), 0.2).opacity
    assert np.abs(cut[..., 3] - opacity * share[..., 0] / 255).max() < 2
    over = cut[..., :3] * (cut[..., 3:] / 255) + 255 * scene.background * (1 - cut[..., 3:] / 255)
    assert np.abs(over - early)[gone].max() < 3
    on_black = rendered("black.png", "--time", "0.2", "--dynamic-only")
    assert not on_black[share[..., 0] == 0].any()
    map_ = rendered("map.png", "--time", "0.2", "--dynamic-map")
    assert np.ptp(map_, axis=2)[gone].min() > 60 and np.ptp(map_[share[..., 0] == 0], axis=1).max() <= 1
