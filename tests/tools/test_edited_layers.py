"""kpedit divides a scene into what moves and what stays, and the two together are the scene."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from scipy import ndimage

from kpc.encoder.coding.scene_writer import write
from kpc.format.coding.quantise import QuantisedScene, needed_texels, quantise_scene
from kpc.format.container import groups
from kpc.format.container.scene_io import read
from kpc.format.scene.scene import Clip, Decoder, Scene
from kpc.player.cpu import reference
from kpc.player.cpu.reference import Rendering
from kpc.tools.cli import kpedit
from kpc.tools.editing.layers import Packed, connected, find_layer, hanging_cells, without_noise
from kpc.tools.rendering.composition import in_depth_order
from scenes import VARIANTS, in_device_coordinates, look_at, tiny_scene, with_contraction, with_motion

FRAMES = 11
# Cells along x of the block at the first and the last frame, and its cells along y and z.
FIRST, LAST, BLOCK_Y, BLOCK_Z = 2.0, 9.0, (4, 6), (3, 5)
HALF = 1.0  # of the block along x, cells


def rolling(path: np.ndarray | None = None, floor: bool = True, bottom: int = BLOCK_Z[0]) -> Scene:
    """Return a red block above a green floor, in 12 x 10 x 8 cells of two texels each.

    Args:
        path: (T,) the middle of the block along x, cells, at equal steps of time; by default from FIRST to LAST.
        floor: whether there is one, of a cell's height.
        bottom: cell along z in which the block begins.
    """
    path = np.linspace(FIRST, LAST, FRAMES) if path is None else path
    x, y, z = ((np.arange(count) + 0.5) / 2 for count in (24, 20, 16))  # about where texels lie, cells
    inside = [(low <= along) & (along < high) for along, low, high in ((y, *BLOCK_Y), (z, bottom, BLOCK_Z[1]))]
    moves = np.abs(x - path[:, None]) < HALF
    planes = {
        "xy": [np.ones((20, 24)), np.broadcast_to(inside[0][:, None], (20, 24))],
        "xz": [np.broadcast_to((z < 1)[:, None] & floor, (16, 24)), np.ones((16, 24))],
        "yz": [np.ones((16, 20)), np.broadcast_to(inside[1][:, None], (16, 20))],
        "xt": [np.ones((len(path), 24)), moves],
        "yt": [np.ones((len(path), 20))] * 2,
        "zt": [np.ones((len(path), 16))] * 2,
    }
    decoder = Decoder(
        density_weight=np.array([14, 14], np.float32),
        density_bias=-6.0,
        w1=np.zeros((4, 9), np.float32),
        b1=np.zeros(4, np.float32),
        w2=np.zeros((3, 2, 4), np.float32),
        b2=np.array([[-4, 4], [4, -4], [-4, -4]], np.float32),
    )
    return Scene(
        aabb=np.array([[-1.2, -1.0, -0.8], [1.2, 1.0, 0.8]], np.float32),
        clip=Clip(FRAMES, 10.0),
        scales=({name: np.stack(channels, axis=-1).astype(np.float32) for name, channels in planes.items()},),
        decoder=decoder,
        occupancy=np.ones((1, 8, 10, 12), bool),
        background=np.zeros(3, np.float32),
        step=0.02,
        cameras=(look_at((2.4, 1.4, 1.8), (0.0, 0.0, 0.0), 40, 30, 50.0),),
    )


def quantised(scene: Scene) -> QuantisedScene:
    return quantise_scene(scene, [dict.fromkeys(scale, 1 / 16) for scale in scene.scales])


def picture(scene: QuantisedScene, time: float) -> Rendering:
    return reference.render(scene.dequantise(), scene.cameras[0], time)


def edit(source: Path, layer: str, *options: str) -> QuantisedScene:
    out = source.with_name(f"{layer}.kpc")
    assert kpedit.main([str(source), "-o", str(out), "--layer", layer, *options]) == 0
    return read(out)


def block_at(since: float, until: float, wider: float, counts: tuple[int, int, int] = (8, 10, 12)) -> np.ndarray:
    """Return the cells, (Nz, Ny, Nx) bool, whose middle lies in the block at some time between two.

    Args:
        since, until: the times.
        wider: by how much the block is wider on all sides, in cells of rolling().
        counts: of cells along z, y and x over the same space.
    """
    middles = [(np.arange(n) + 0.5) / n * own for n, own in zip(counts, (8, 10, 12), strict=True)]
    path = (FIRST + (LAST - FIRST) * since - HALF, FIRST + (LAST - FIRST) * until + HALF)
    z, y, x = (
        (low - wider < at) & (at < high + wider)
        for at, (low, high) in zip(middles, (BLOCK_Z, BLOCK_Y, path), strict=True)
    )
    return z[:, None, None] & y[:, None] & x


def moving_cells(scene: Scene) -> np.ndarray:
    return find_layer("moving", [lambda: scene], [])[0].array()


def in_two_scales(scene: Scene) -> Scene:
    """Return the scene with a scale for the floor, whose time planes are 1, and one for the block."""
    scales = tuple({name: plane[..., k : k + 1] for name, plane in scene.scales[0].items()} for k in range(2))
    return replace(scene, scales=scales)


def in_three_slots(scene: Scene) -> Scene:
    return replace(scene, occupancy=np.repeat(scene.occupancy, 3, axis=0))


KINDS = {
    "box": lambda scene: scene,
    "two scales": in_two_scales,
    "three slots": in_three_slots,
    "contracted": with_contraction,
    "ndc": in_device_coordinates,
    "displaced": lambda scene: with_motion(scene, most=0.01),
}


@pytest.mark.parametrize("kind", KINDS)
def test_what_moves_is_where_it_is_in_each_slot(kind):
    scene = KINDS[kind](rolling())
    cells = moving_cells(scene)
    slots, *counts = cells.shape
    assert slots == (3 if kind == "three slots" else 5)
    occupied = scene.occupancy.any(axis=0)
    for slot, found in enumerate(cells):
        times = slot / slots, (slot + 1) / slots
        assert found[block_at(*times, -0.6, counts) & occupied].all()
        assert not found[~block_at(*times, 1.3, counts)].any()
    assert cells.any(axis=(1, 2, 3)).all() and not cells[:, 0].any()  # the floor


@pytest.mark.parametrize("frames", [2, 3])
def test_clips_of_few_frames_are_divided(frames):
    scene = replace(rolling(np.linspace(FIRST, LAST, frames)), clip=Clip(frames, 10.0))
    cells = moving_cells(scene)
    assert len(cells) == 1 and cells[0][block_at(0, 0, -0.6)].all() and cells[0][block_at(1, 1, -0.6)].all()


def test_what_is_fast_in_a_long_clip_is_never_missed():
    """A block that crosses the scene in ten of 300 frames."""
    path = 5.5 + 4 * np.cos(np.arange(300) * np.pi / 10)
    scene = replace(rolling(path), clip=Clip(300, 30.0))
    cells = moving_cells(scene)
    assert len(cells) == 32
    for frame, middle in enumerate(path):
        column = cells[min(32 * frame // 299, 31), 4, 5]
        assert column[round(middle - 0.5)], frame


@pytest.mark.parametrize(
    ("bottom", "green_share", "ghost", "largest_error"), [(BLOCK_Z[0], 0.1, 0.005, 0.02), (1, 0.7, 0.02, 0.06)]
)
def test_the_layers_of_a_file_together_are_the_scene(bottom, green_share, ghost, largest_error, tmp_path):
    """A block that stands on the floor, too: it takes some of the floor along."""
    write(quantised(rolling(bottom=bottom)), tmp_path / "scene.kpc")
    whole, empty = read(tmp_path / "scene.kpc"), picture(quantised(rolling(np.full(FRAMES, 40.0))), 0.0)
    moving, still = (edit(tmp_path / "scene.kpc", layer) for layer in ("moving", "still"))
    assert not (moving.occupancy & still.occupancy).any() and (moving.occupancy | still.occupancy).all()
    assert moving.metadata.provenance["history"][-1].endswith(": layer moving")
    for time in (0.0, 0.37, 0.5, 1.0):
        expected, alone, rest = (picture(scene, time) for scene in (whole, moving, still))
        error = np.abs(in_depth_order([alone, rest]).rgb - expected.rgb)
        assert error.mean() < 0.001 and error.max() < largest_error
        red, green, _ = alone.rgb.sum(axis=(0, 1))
        assert red > 30 and green < green_share * red
        assert np.abs(rest.rgb - empty.rgb).mean() < ghost
    coded = [sum(int(p.coded.sum()) for s in scene.scales for p in s.values()) for scene in (whole, moving)]
    assert coded[1] < 0.5 * coded[0]


@pytest.mark.parametrize("kind", ["box", "two scales"])
def test_what_rests_in_a_part_but_moves_in_the_clip_moves(kind, tmp_path):
    path = np.concatenate([np.full(8, FIRST), np.linspace(FIRST, LAST, FRAMES)[1:], np.full(8, LAST)])
    scene = replace(KINDS[kind](rolling(path)), clip=Clip(len(path), 10.0))
    write(quantised(scene), tmp_path / "scene.kpc")
    part = edit(tmp_path / "scene.kpc", "moving", "--to", "0.5s")
    assert part.clip.frame_count == 6 and part.occupancy[:, 4, 5, 2].all() and not part.occupancy[:, :2].any()


def test_groups_have_one_mind_about_what_stays(tmp_path, capsys):
    """The block rests for all of the second group, and is gone in the third."""
    paths = None, np.full(FRAMES, LAST), np.full(FRAMES, 40.0)
    parts = []
    for number, path in enumerate(paths):
        write(quantised(rolling(path)), tmp_path / f"{number}.kpc")
        parts.append(groups.GroupInput.of(tmp_path / f"{number}.kpc", FRAMES * number))
    groups.write(parts, tmp_path / "clip.kpc")
    outs = {layer: tmp_path / f"{layer}.kpc" for layer in ("moving", "still")}
    for layer, out in outs.items():
        assert kpedit.main([str(tmp_path / "clip.kpc"), "-o", str(out), "--layer", layer]) == 0
    moving, still = (groups.Groups(out) for out in outs.values())
    second = read(moving.open(1)).occupancy
    assert second[:, 4, 5, 9].all() and not second[:, :2].any()
    assert not read(moving.open(2)).occupancy.any() and read(still.open(2)).occupancy.all()
    shown = picture(read(moving.open(2)), 0.5)
    assert shown.opacity.max() == 0
    words = ["--layer", "moving", "--from", "2.3s"]
    assert kpedit.main([str(tmp_path / "clip.kpc"), "-o", str(tmp_path / "part.kpc"), *words]) == 2
    assert "--layer moving: nothing moves in what is kept" in capsys.readouterr().err


def refused(folder: Path, scene: QuantisedScene, layer: str) -> None:
    write(scene, folder / "scene.kpc")
    assert kpedit.main([str(folder / "scene.kpc"), "-o", str(folder / "out.kpc"), "--layer", layer]) == 2
    assert not (folder / "out.kpc").exists()


@pytest.mark.parametrize("layer", ["moving", "still"])
@pytest.mark.parametrize("scene", [tiny_scene(dynamic=False), rolling(np.full(FRAMES, 5.0))], ids=["static", "resting"])
def test_a_scene_in_which_nothing_moves_is_refused(scene, layer, tmp_path, capsys):
    refused(tmp_path, quantised(scene), layer)
    assert f"--layer {layer}: nothing moves in what is kept" in capsys.readouterr().err


def test_a_scene_in_which_nothing_stays_is_refused(tmp_path, capsys):
    scene = rolling(floor=False)
    refused(tmp_path, quantised(replace(scene, occupancy=moving_cells(scene))), "still")
    assert "--layer still: nothing stays in what is kept" in capsys.readouterr().err


def test_a_grid_of_too_many_cells_is_refused(tmp_path, capsys, monkeypatch):
    monkeypatch.setattr("kpc.tools.editing.layers.MOST_CELLS", 959)
    refused(tmp_path, quantised(rolling()), "moving")
    assert "the occupancy grid has 960 cells in its slots, over 959" in capsys.readouterr().err
    monkeypatch.setattr("kpc.tools.editing.layers.MOST_CELLS", 2000)
    assert len(moving_cells(rolling())) == 2


@pytest.mark.parametrize("variant", VARIANTS)
def test_files_of_all_kinds_are_divided(variant, tmp_path):
    scene = VARIANTS[variant](tiny_scene(scales=2, channels=4, resolution=(12, 10, 8), time=5))
    write(quantised(scene), tmp_path / "scene.kpc")
    moving, still = (edit(tmp_path / "scene.kpc", layer).occupancy for layer in ("moving", "still"))
    assert moving.any() and not (moving & still).any()
    assert np.array_equal(moving | still, np.repeat(scene.occupancy, len(moving) // len(scene.occupancy), axis=0))


def test_a_layer_goes_with_all_other_edits(tmp_path, capsys):
    write(quantised(rolling()), tmp_path / "scene.kpc")
    options = ("--box=-1.2,-1,-0.8,0,1,0.8", "--turn=z:90", "--scale=2", "--move=0,0,5", "--speed=2", "--to=0.5s")
    edited = edit(tmp_path / "scene.kpc", "moving", *options)
    assert edited.clip == Clip(6, 20.0) and edited.aabb == pytest.approx(np.array([[-2, -2.4, 3.4], [2, 2.4, 6.6]]))
    cells = edited.occupancy  # x of the source is y now
    assert cells[0, 4, 2].any() and not cells[:, :2].any() and not cells[:, :, 7:].any()
    edit(tmp_path / "scene.kpc", "moving", "--to", "0.99s")
    assert "it is kept as a whole" in capsys.readouterr().err
    nowhere = [str(tmp_path / "scene.kpc"), "-o", str(tmp_path / "out.kpc"), "--layer", "moving"]
    assert kpedit.main([*nowhere, "--box=-1.2,-1,-0.8,1.2,1,-0.7"]) == 2
    assert "--box: there is nothing of --layer moving from" in capsys.readouterr().err


@pytest.mark.parametrize("codec", ["transform", "predictive"])
def test_groups_share_after_a_layer_is_taken_what_they_shared_before(codec, tmp_path, monkeypatch):
    """Planes whose map the occupancy of both groups implies, which differs afterwards."""
    source = Path(__file__).parents[2] / "spec" / "vectors" / "valid" / f"{codec}-implied.kpc"
    scene = read(source)
    groups.write([groups.GroupInput.of(source, start) for start in (0, scene.clip.frame_count)], tmp_path / "clip.kpc")
    before = groups.Groups(tmp_path / "clip.kpc")
    assert len(before.reader.beside) >= 3 and not scene.scales[0]["xy"].stores_map
    left = np.indices(scene.occupancy.shape)[3] < scene.occupancy.shape[3] // 2
    cells = [scene.occupancy & left, scene.occupancy & ~left]
    monkeypatch.setattr("kpc.tools.editing.clips.find_layer", lambda *_: list(map(Packed.of, cells)))
    out = tmp_path / "out.kpc"
    assert kpedit.main([str(tmp_path / "clip.kpc"), "-o", str(out), "--layer", "moving"]) == 0
    after = groups.Groups(out)
    assert len(after.reader.beside) >= len(before.reader.beside) - 1
    for number in range(2):
        found = read(after.open(number))
        assert np.array_equal(found.occupancy, cells[number])
        for scale, one in zip(found.scales, scene.scales, strict=True):
            for name, plane in scale.items():
                assert np.array_equal(plane.symbols, one[name].symbols * plane.coded[..., None])
                needed = needed_texels(cells[number], name, *plane.coded.shape)
                assert np.array_equal(plane.coded & needed, one[name].coded & needed)


def test_what_touches_nothing_but_what_moves_hangs_on_it():
    risen, solid = (np.zeros((8, 10, 12), bool) for _ in range(2))
    risen[2:4, 2:8, 2:4] = risen[2:4, 2:8, 6:8] = True  # the rim of a wheel on both sides of its axis
    solid[2:4, 4:6, 4:6] = solid[0] = True  # its axis, and the floor
    axis = solid.copy()
    axis[0] = False
    assert np.array_equal(hanging_cells(risen, solid), axis)
    solid[:4, 5, 5] = True  # the axis stands on the floor
    assert not hanging_cells(risen, solid).any()


def test_small_groups_are_noise_beside_the_largest_of_all_grids():
    grids = [((8, 10, 12), bytes([k]), "") for k in range(2)]
    rising = {grid: np.zeros((8, 10, 12), bool) for grid in grids}
    rising[grids[0]][:4, :5, :5] = rising[grids[1]][0, 0, :4] = rising[grids[1]][4, 5, :6] = True
    found = without_noise(rising)
    assert found[grids[0]].sum() == 100 and found[grids[1]].sum() == 6


def test_connected_cells_are_those_of_scipy():
    rng = np.random.default_rng(0)
    for share in (0.0, 0.05, 0.2, 0.6, 1.0):
        cells = rng.random((9, 12, 7)) < share
        expected, count = ndimage.label(cells, np.ones((3, 3, 3)))
        found = connected(cells)
        assert found.max() == count and np.array_equal(found > 0, cells)
        assert len(np.unique(np.stack([found.ravel(), expected.ravel()]), axis=1).T) == len(np.unique(found))


def test_a_path_through_all_of_a_grid_is_one_group():
    cells = np.zeros((41, 41, 41), bool)
    cells[::2] = True  # planes of a snake, joined at one end and then at the other
    cells[:, 1::2] &= np.indices((41, 20, 41))[2] == np.where(np.arange(20) % 2, 0, 40)[:, None]
    cells[1::2] = False
    cells[1::4, 40, 40] = cells[3::4, 0, 0] = True
    assert connected(cells).max() == ndimage.label(cells, np.ones((3, 3, 3)))[1] == 1


def test_packed_arrays_are_the_same():
    for values in (np.arange(24, dtype=np.float16).reshape(2, 3, 4), np.indices((3, 5)).sum(0) % 2 == 0):
        again = Packed.of(values).array()
        assert again.dtype == values.dtype and np.array_equal(again, values)
