"""Clocks of cameras from their sound and from what moves."""

import itertools

import numpy as np
import pytest

from kpc.format.common.errors import DatasetError

sound_sync = pytest.importorskip("kpc.encoder.poses.sound_sync", reason="needs scipy")
motion_sync = pytest.importorskip("kpc.encoder.poses.motion_sync", reason="needs scipy")

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


@pytest.mark.parametrize("late, fps", [(0.0, 30.0), (0.717, 30.0), (1.2, 25.0)])
def test_motion_gives_the_offset_within_half_a_frame(late, fps):
    one, two = np.arange(100) / 30, np.arange(90) / fps
    found = motion_sync.align_motion(one, curve(one, 1), two, curve(two + late, 2), 30.0)
    assert found is not None
    assert found.offset_s == pytest.approx(late, abs=0.5 / 30)
    assert found.correlation > 0.8 and found.margin > 0.02


def test_what_does_not_move_is_not_aligned():
    times = np.arange(60) / 30
    assert motion_sync.align_motion(times, np.zeros(60), times, curve(times, 1), 30.0) is None
    assert motion_sync.align_motion(times[:5], np.ones(5), times, curve(times, 1), 30.0) is None


def test_a_wrong_pair_does_not_move_the_others():
    sync = pytest.importorskip("kpc.encoder.poses.sync")
    true = [0.0, 0.4, -0.3, 1.1]
    pairs = {
        (i, j): motion_sync.PairOffset(true[j] - true[i] + 0.002 * i, 0.9, 0.2)
        for i, j in itertools.combinations(range(4), 2)
    }
    pairs[2, 3] = motion_sync.PairOffset(-2.0, 0.9, 0.15)
    start = sync._spanning_offsets(pairs, set())
    found = sync._agreed_offsets(pairs, start, set(), 0.5 / 30)
    assert [found[number] - found[0] for number in range(4)] == pytest.approx(true, abs=0.01)


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
        ('{"cam00": NaN}', "is that of no clock"),
        ('{"cam00": 1' + "0" * 400 + "}", "is that of no clock"),
        ('{"cam00": {"rate": 30}}', "is that of no clock"),
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
