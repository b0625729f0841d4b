import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from kpc.format.coding.quantise import (
    VALUE_LIMIT,
    QuantisedPlane,
    needed_texels,
    quantise_plane,
    quantise_scene,
    round_cameras,
    round_decoder,
)
from kpc.format.common.errors import FormatError
from kpc.format.scene.cameras import Camera
from kpc.format.scene.scene import TIME_PLANES, Decoder
from scenes import tiny_scene


def tolerance(values: np.ndarray, plane: QuantisedPlane) -> np.ndarray:
    """Half a step, and what float32 rounds: offset and step when chosen, product and sum when applied."""
    largest = np.abs(values).max(initial=0) + 2 * np.abs(plane.offset).max() + 128 * plane.step
    return plane.step * 0.5 + 4 * largest * 2.0**-24


@given(
    seed=st.integers(0, 2**32 - 1),
    step=st.floats(1e-4, 2.0),
    spread=st.floats(1e-3, 50.0),
    centre=st.floats(-20.0, 20.0),
    identity=st.booleans(),
)
def test_every_needed_value_is_within_half_a_step(seed, step, spread, centre, identity):
    rng = np.random.default_rng(seed)
    values = (centre + spread * rng.uniform(-1, 1, (5, 7, 3))).astype(np.float32)
    needed = rng.random((5, 7)) < 0.7
    plane = quantise_plane(values, step, identity=identity, needed=needed)
    error = np.abs(plane.dequantise().astype(np.float64) - values)
    assert (error[needed] <= tolerance(values, plane)).all()
    assert (plane.step >= np.float32(step)).all()
    assert not plane.symbols[~plane.coded].any()
    assert not (plane.coded & ~needed).any()


def test_a_step_that_fits_is_kept_and_one_that_does_not_is_just_large_enough():
    """To 8 significant bits."""
    values = np.linspace(0.0, 1.0, 512, dtype=np.float32).reshape(32, 16, 1)
    kept = quantise_plane(values, 1 / 128, identity=False)
    assert kept.step == np.float32(1 / 128)
    raised = quantise_plane(values, 1e-4, identity=False)
    assert 1 / 255 <= raised.step <= (1 + 2**-7) / 255
    assert raised.symbols.max() == 127 and raised.symbols.min() <= -127
    time = quantise_plane(values, 1e-4, identity=True)  # 0 to 1 lies below the identity: 128 steps down
    assert time.step == pytest.approx(1 / 128, rel=1e-6)
    assert (time.symbols.min(), time.symbols.max()) == (-128, 0)


def test_a_space_plane_rests_on_its_mean_and_moves_off_it_only_to_fit():
    values = np.zeros((10, 10, 1), np.float32)
    values[0, 0], values[-1, -1] = 2.0, 1e-6  # its edges are not empty
    assert quantise_plane(values, 0.1, identity=False).offset == pytest.approx(0.02, rel=2**-7)
    moved = quantise_plane(values, 0.01, identity=False)  # 200 steps of range: the top must be 127 steps up
    assert moved.offset == pytest.approx(2.0 - 1.27)
    assert moved.symbols[0, 0, 0] == 127


def test_identity_is_exact_and_uncoded():
    values = np.ones((6, 9, 4), np.float32)
    values[2, 3] = 1.5
    values[4, 4, 1] = 1.0 + 0.04  # less than half a step from the identity
    plane = quantise_plane(values, 0.1, identity=True)
    assert plane.coded.sum() == 1 and plane.coded[2, 3]
    assert (plane.dequantise()[~plane.coded] == 1.0).all()


def test_two_roundings_in_the_stated_order():
    rng = np.random.default_rng(5)
    symbols = rng.integers(-128, 128, (8, 8, 2)).astype(np.int8)
    step, offset = np.float32([0.0123, 0.77]), np.float32([1.0, -3.3])
    plane = QuantisedPlane(symbols, step, offset, np.ones((8, 8), bool))
    expected = (symbols.astype(np.float64) * step).astype(np.float32).astype(np.float64) + offset
    assert np.array_equal(plane.dequantise(), expected.astype(np.float32))
    assert plane.dequantise().dtype == np.float32


@pytest.mark.parametrize("bad", [np.nan, np.inf, -np.inf, 1025.0])
def test_a_value_that_is_no_number_is_refused_by_name(bad):
    scene = tiny_scene()
    scene.scales[1]["xt"][2, 3, 4] = bad
    steps = [dict.fromkeys(scale, 0.02) for scale in scene.scales]
    with pytest.raises(FormatError, match="scale 1, plane xt: holds NaN, infinity"):
        quantise_scene(scene, steps, skip_unseen=False)


def test_a_value_that_is_no_number_does_not_matter_where_nothing_is_seen():
    values = np.ones((4, 4, 2), np.float32)
    values[0, 0] = np.nan
    needed = np.ones((4, 4), bool)
    needed[0, 0] = False
    plane = quantise_plane(values, 0.1, identity=False, needed=needed)
    assert not plane.coded[0, 0] and np.isfinite(plane.dequantise()).all()


@pytest.mark.parametrize("step", [0.0, -1.0, np.nan])
def test_a_step_that_is_not_positive_is_refused(step):
    with pytest.raises(FormatError, match="step"):
        quantise_plane(np.ones((2, 2, 1), np.float32), step, identity=False)


def test_any_step_however_coarse_makes_a_plane_that_a_file_can_hold():
    values = np.linspace(-1024.0, 1024.0, 64, dtype=np.float32).reshape(8, 8, 1)
    for step in (8.0, 1e4, np.inf):
        for identity in (True, False):
            plane = quantise_plane(values, step, identity=identity)
            assert (plane.step * 128 + np.abs(plane.offset) <= VALUE_LIMIT).all()
            assert (np.abs(plane.dequantise() - values) <= tolerance(values, plane)).all()


def test_a_plane_nobody_sees_costs_nothing():
    for identity in (False, True):
        plane = quantise_plane(np.zeros((3, 3, 2), np.float32), 0.1, identity=identity, needed=np.zeros((3, 3), bool))
        assert not plane.coded.any() and (plane.dequantise() == 1.0).all()


@pytest.mark.parametrize("dynamic", [True, False])
def test_scene_keeps_what_is_not_a_plane_and_counts_the_same_parameters(dynamic):
    scene = tiny_scene(dynamic=dynamic)
    quantised = quantise_scene(scene, [dict.fromkeys(scale, 0.02) for scale in scene.scales])
    decoded = quantised.dequantise()
    assert decoded.parameter_count == quantised.parameter_count == scene.parameter_count
    assert decoded.is_dynamic == quantised.is_dynamic == dynamic
    assert np.array_equal(decoded.occupancy, scene.occupancy) and decoded.clip == scene.clip
    if dynamic:
        ones = [
            (plane == 1).all(axis=2) for scale in decoded.scales for name, plane in scale.items() if name in TIME_PLANES
        ]
        assert quantised.identity_share == pytest.approx(sum(o.sum() for o in ones) / sum(o.size for o in ones))
        assert quantised.identity_share >= 0.5  # the bump covers a third of the columns
    else:
        assert quantised.identity_share == 1.0


@given(
    seed=st.integers(0, 2**32 - 1),
    plane=st.sampled_from(["xy", "xz", "yz", "xt", "yt", "zt"]),
    rows=st.integers(1, 12),
    columns=st.integers(1, 12),
)
def test_needed_texels_cover_every_read_from_an_occupied_cell(seed, plane, rows, columns):
    rng = np.random.default_rng(seed)
    shape = tuple(rng.integers(1, 6, 4))
    occupancy = rng.random(shape) < 0.15
    needed = needed_texels(occupancy, plane, rows, columns)
    axis = {"t": 0, "z": 1, "y": 2, "x": 3}
    for cell in np.argwhere(occupancy):
        for _ in range(4):
            u = (cell + rng.random(4)) / shape
            x, y = u[axis[plane[0]]] * (columns - 1), u[axis[plane[1]]] * (rows - 1)
            assert needed[int(y) : int(np.ceil(y)) + 1, int(x) : int(np.ceil(x)) + 1].all()
    if not occupancy.any():
        assert not needed.any()
    # As the spec has it.
    n, m = (shape[axis[plane[k]]] for k in (1, 0))
    cells = {(cell[axis[plane[1]]], cell[axis[plane[0]]]) for cell in np.argwhere(occupancy)}
    for i, j in np.ndindex(rows, columns):
        assert needed[i, j] == any(
            (i + 1) * n >= c * (rows - 1)
            and (i - 1) * n <= (c + 1) * (rows - 1)
            and (j + 1) * m >= d * (columns - 1)
            and (j - 1) * m <= (d + 1) * (columns - 1)
            for c, d in cells
        )


def test_decoder_weights_become_float16_and_refuse_what_it_cannot_hold():
    scene = tiny_scene()
    rounded = round_decoder(scene.decoder)
    for name in ("density_weight", "w1", "b1", "w2", "b2"):
        before, after = getattr(scene.decoder, name), getattr(rounded, name)
        assert after.dtype == np.float32 and np.array_equal(after, after.astype(np.float16))
        assert np.abs(after - before).max() <= np.abs(before).max() * 2.0**-11  # half a unit in the last of 11 bits
    d = scene.decoder
    with pytest.raises(FormatError, match="decoder"):
        round_decoder(Decoder(d.density_weight * 1e6, d.density_bias, d.w1, d.b1, d.w2, d.b2))
    with pytest.raises(FormatError, match="density bias"):
        round_decoder(Decoder(d.density_weight, float("nan"), d.w1, d.b1, d.w2, d.b2))


def test_cameras_are_rounded_by_no_more_than_pictures_show():
    pose = tiny_scene().cameras[0].camera_to_world.copy()
    pose[:3, 3] += 5e5  # a survey's origin may be far away
    camera = Camera(4000, 48, 3001.07, 50.2, 1999.9, -24.3, pose)
    (rounded,) = round_cameras([camera])
    assert rounded.width == 4000 and rounded.fl_x == np.float32(rounded.fl_x)
    for name in ("fl_x", "fl_y", "cx", "cy"):
        assert abs(getattr(rounded, name) / getattr(camera, name) - 1) <= 2.0**-16
    assert np.abs(rounded.camera_to_world - pose)[:3, :3].max() <= 1e-5
    assert np.abs(rounded.camera_to_world - pose)[:3, 3].max() <= 2.0**-5  # as float32
    (again,) = round_cameras([rounded])
    assert np.array_equal(again.camera_to_world, rounded.camera_to_world) and again.fl_x == rounded.fl_x


def test_poses_that_are_more_than_turns_and_places_are_rounded_to_float32():
    pose = np.diag([1.1, 0.9, -1.0, 1.0])
    pose[:3, 3] = 0.1
    (rounded,) = round_cameras([Camera(4, 3, 5.0, 5.0, 2.0, 1.5, pose)])
    assert np.array_equal(rounded.camera_to_world, pose.astype(np.float32))
    assert round_cameras(()) == ()
