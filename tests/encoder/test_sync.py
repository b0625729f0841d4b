"""Clocks of cameras from their sound and from what moves."""

import itertools

import numpy as np
import pytest

from kpc.format.common.errors import DatasetError
from textured_room import rig

sound_sync = pytest.importorskip("kpc.encoder.poses.sound_sync", reason="needs scipy")
motion_sync = pytest.importorskip("kpc.encoder.poses.motion_sync", reason="needs scipy")

joint_offsets = pytest.importorskip("kpc.encoder.poses.joint_offsets", reason="needs scipy")
epipolar_motion = pytest.importorskip("kpc.encoder.poses.epipolar_motion", reason="needs scipy")
structure = pytest.importorskip("kpc.encoder.poses.structure")
survey = pytest.importorskip("kpc.encoder.poses.survey")
given_clocks = pytest.importorskip("kpc.encoder.poses.given_clocks", reason="needs scipy")

RATE = 48000


def event(seconds: float) -> np.ndarray:
    """Return a track of claps, (N,) float32."""
    rng = np.random.default_rng(1)
    samples = np.zeros(int(seconds * RATE), np.float32)
    for time in rng.uniform(0, seconds - 0.3, int(2.5 * seconds)):
        start, clap = int(time * RATE), rng.standard_normal(6000) * np.exp(-np.arange(6000) / 1500)
        samples[start : start + 6000] += clap[: len(samples) - start].astype(np.float32)
    return samples


def recorded(samples: np.ndarray, offset_s: float, rate: float, noise: float, seed: int) -> np.ndarray:
    """Return what a recorder that starts at `offset_s`, and whose clock is slow by `rate`, has of an event."""
    rng = np.random.default_rng(seed)
    times = offset_s + rate * np.arange(int(8 * RATE)) / RATE
    echoes = np.convolve(samples, rng.standard_normal(150) * np.exp(-np.arange(150) / 40), "same")
    found = np.interp(times, np.arange(len(samples)) / RATE, echoes)
    return (found + noise * rng.standard_normal(len(found))).astype(np.float32)


@pytest.mark.parametrize(
    "offset_s, rate", [(1.3, 1.0), (-0.5, 1.0), (0.2, 1.005)], ids=["late", "early", "5 s in 17 minutes"]
)
def test_sound_gives_offset_and_drift_within_a_tenth_of_a_frame(offset_s, rate):
    samples = event(14.0)
    reference = recorded(samples, 2.0, 1.0, 0.05, 2)
    found = sound_sync.align_sound(reference, recorded(samples, 2.0 + offset_s, rate, 0.2, 3))
    assert found.confidence > 0.6
    for time in (0.0, 7.0):  # in the other track
        assert found.offset_s + found.rate * time == pytest.approx(offset_s + rate * time, abs=0.1 / 30)


@pytest.mark.parametrize("rate", [1.0, 1000 / 1001])
def test_a_second_of_sound_is_aligned(rate):
    samples = event(6.0)
    reference = recorded(samples, 0.2, 1.0, 0.02, 2)[: 5 * RATE]
    found = sound_sync.align_sound(reference, recorded(samples, 3.9, rate, 0.02, 3)[:RATE])
    assert found.confidence > 0.6
    for time in (0.0, 1.0):
        assert found.offset_s + found.rate * time == pytest.approx(3.7 + rate * time, abs=0.1 / 30)


def test_unlike_sounds_are_not_aligned():
    noise = [np.random.default_rng(seed).standard_normal(6 * RATE).astype(np.float32) for seed in (5, 6)]
    assert sound_sync.align_sound(*noise).confidence < 0.4
    silence = np.zeros(RATE, np.float32)
    assert sound_sync.align_sound(silence, silence) == sound_sync.NOTHING


def curve(times: np.ndarray, seed: int) -> np.ndarray:
    """Return how much moves at some times, by one of several cameras."""
    level = 3 + 2 * np.sin(4 * times + np.sin(2.3 * times)) + np.sin(11 * times)
    return np.maximum(level, 0.1) * (1 + 0.1 * np.random.default_rng(seed).standard_normal(len(times)))


STEP_S = 1 / 60


def evidence_of(one: np.ndarray, late: float, fps: float, count: int = 90) -> motion_sync.Evidence:
    two = np.arange(count) / fps
    signals = [
        motion_sync.sampled(times, motion[:, None], STEP_S, motion_sync.TREND_S)
        for times, motion in ((one, curve(one, 1)), (two, curve(two + late, 2)))
    ]
    return motion_sync.curve_evidence(*signals, STEP_S)


@pytest.mark.parametrize("late, fps", [(0.0, 30.0), (0.717, 30.0), (1.2, 25.0)])
def test_motion_gives_the_offset_within_half_a_frame(late, fps):
    found = joint_offsets.joint_offsets({(0, 1): evidence_of(np.arange(100) / 30, late, fps)}, set())
    assert found[0].steps == 0
    assert found[1].steps * STEP_S == pytest.approx(late, abs=0.5 / 30)
    assert found[1].confidence > 0.5


def test_what_does_not_move_is_not_aligned():
    times = np.arange(60) / 30
    still, moving = (motion_sync.sampled(times, m[:, None], STEP_S) for m in (np.zeros(60), curve(times, 1)))
    assert motion_sync.curve_evidence(still, moving, STEP_S) is None
    assert motion_sync.sampled(times[:3], np.ones((3, 1)), STEP_S) is None


def all_pairs(curves: list[np.ndarray]) -> dict[tuple[int, int], motion_sync.Evidence]:
    signals = [motion_sync.sampled(np.arange(len(c)) / 30, c[:, None], STEP_S) for c in curves]
    return {
        (i, j): motion_sync.curve_evidence(signals[i], signals[j], STEP_S)
        for i, j in itertools.combinations(range(len(curves)), 2)
    }


def test_unlike_motion_gives_no_confident_offset():
    rng = np.random.default_rng(3)
    for count in (3, 6):
        found = joint_offsets.joint_offsets(all_pairs([np.exp(rng.standard_normal(80)) for _ in range(count)]), set())
        assert max(offset.confidence for offset in found.values()) < 0.5


def test_motion_that_repeats_itself_gives_no_sure_offset():
    rng, found = np.random.default_rng(4), []
    for late in ((0, 3, 9), (0, 16, 5), (0, 11, 20)):
        curves = [np.exp(np.sin(2 * np.pi * (np.arange(90) + by) / 14) + 0.2 * rng.standard_normal(90)) for by in late]
        found += joint_offsets.joint_offsets(all_pairs(curves), set()).values()
    assert max(offset.confidence for offset in found) < 0.9


def test_a_wrong_pair_does_not_move_the_others():
    late = [0, 24, -18, 30]  # steps
    times = np.arange(100) / 30
    pairs = {}
    for i, j in itertools.combinations(range(4), 2):
        one, two = (
            motion_sync.sampled(times, curve(times + late[n] * STEP_S, n)[:, None], STEP_S, motion_sync.TREND_S)
            for n in (i, j)
        )
        pairs[i, j] = motion_sync.curve_evidence(one, two, STEP_S)
    pairs[2, 3] = pairs[2, 3].shifted(-40)
    found = joint_offsets.joint_offsets(pairs, set())
    assert [found[number].steps for number in range(4)] == pytest.approx(late, abs=0.5 * motion_sync.STEPS_PER_FRAME)
    known = joint_offsets.joint_offsets(pairs, {1})
    assert known[1].steps == 0
    assert known[0].steps == pytest.approx(-24, abs=0.5 * motion_sync.STEPS_PER_FRAME)


def test_a_point_lies_on_the_same_sheaf_of_epipolar_lines_in_both_cameras():
    side, square, shape = 320, 4, (80, 80)
    poses = [camera.pose for camera in rig(3)][:2]
    views = [structure.PlacedView(pose, (300.0, 300.0, side / 2, side / 2), (0.0,) * 4, 0, 0.0) for pose in poses]
    changes = np.zeros((4, *shape), np.float16)
    seen = survey.Survey(
        np.zeros(4), changes, square, np.zeros((side, side), np.uint8), np.zeros((side, side), bool), 1
    )
    first, second = epipolar_motion.sheaves(*views, tuple(epipolar_motion.directions(view, seen) for view in views))
    compared = apart = 0
    for point in np.random.default_rng(0).uniform((-0.7, -0.7, 0), (0.7, 0.7, 1.3), (200, 3)):
        found = []
        for pose, sheaf in zip(poses, (first, second), strict=True):
            at = np.linalg.inv(pose) @ [*point, 1]
            x, y = side / 2 - 300 * at[0] / at[2], side / 2 + 300 * at[1] / at[2]
            found.append(sheaf.reshape(shape)[int(y) // square, int(x) // square])
        if min(found) >= 0:
            compared, apart = compared + 1, apart + abs(found[0] - found[1])
    assert compared > 100
    assert apart / compared < 0.5  # a sheaf is three squares high: half of a square is lost in each camera


NAMES = ("cam00", "cam01", "cam02")


def test_given_clocks_are_read(tmp_path, capsys):
    file = tmp_path / "offsets.json"
    file.write_text('{"cam01": 0.4, "cam02": {"offset_s": -0.12, "rate": 1.00002}}')
    clocks = given_clocks.read_clocks(file, NAMES)
    assert [(clock.offset_s, clock.rate) for clock in clocks] == [(0.0, 1.0), (0.4, 1.0), (-0.12, 1.00002)]
    assert [clock.method for clock in clocks] == ["none", "given", "given"]
    assert "does not name cam00" in capsys.readouterr().err


@pytest.mark.parametrize(
    "text, said",
    [
        ("{", "not JSON"),
        ("[1, 2, 3]", "no object with an offset for each camera"),
        ("{}", "no object with an offset for each camera"),
        ('{"cam07": 1}', "names cameras that are not there: cam07"),
        ('{"cam00": 1, "cam00": 2}', "is there twice"),
        ('{"cam00": "1"}', "offset_s is no number"),
        ('{"cam00": true}', "offset_s is no number"),
        ('{"cam00": NaN}', r"offset_s nan is not from -100000 to 100000 seconds"),
        ('{"cam00": 1' + "0" * 400 + "}", "offset_s inf is not from"),
        ('{"cam00": {"rate": 30}}', r"rate 30 is not from 0\.5 to 2;"),
        ('{"cam00": {"offset": 1}}', "unknown keys offset"),
        (None, "no such file"),
    ],
)
def test_what_is_no_clock_is_refused(tmp_path, text, said):
    file = tmp_path / "offsets.json"
    if text is not None:
        file.write_text(text)
    with pytest.raises(DatasetError, match=said) as error:
        given_clocks.read_clocks(file, NAMES)
    assert str(error.value).isprintable()
