"""The sound of an encode: which track is taken, which part of it, and that files and groups have it."""

import shutil
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

import datasets as make
from kpc.encoder.cli import kpenc
from kpc.encoder.cli.options import Options
from kpc.encoder.cli.sound import find_sound, sound_of_span
from kpc.encoder.coding.opus import encode_sound
from kpc.encoder.datasets import Dataset, load_dataset, loading
from kpc.encoder.datasets.sound_tracks import clarity, read_samples
from kpc.encoder.field.config import PRESETS
from kpc.encoder.poses import find
from kpc.encoder.rdo.model_checkpoint import read_checkpoint
from kpc.format.common.errors import MediaError, UsageError
from kpc.format.container.clip_sound import sample_at
from kpc.format.container.groups import Groups, Span
from kpc.format.scene.sound import SAMPLE_RATE
from sounds import add_track, decoded, offset_of, sweep, with_noise, write_track
from training_runs import TINY

FRAMES, SECONDS = 16, 16 / make.FPS
SWEEP = sweep(SECONDS + 1)


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Return videos of four cameras: one silent, one noisy, one clear, and one loud and clipped."""
    found = tmp_path_factory.mktemp("sets") / "n3dv"
    make.write_n3dv(found, cameras=4, frames=FRAMES)
    add_track(found / "cam01.mp4", with_noise(SWEEP, -40))
    add_track(found / "cam02.mp4", with_noise(SWEEP, -55))
    add_track(found / "cam03.mp4", np.clip(30 * with_noise(SWEEP, -90), -1, 1))
    return found


@pytest.fixture(scope="module")
def dataset(folder: Path, tmp_path_factory: pytest.TempPathFactory) -> Dataset:
    return load_dataset(folder, tmp_path_factory.mktemp("cache"), progress=False)


def options(audio: str = "auto", **others: object) -> Options:
    return Options(Path("in"), Path("out.kpc"), audio=audio, **others)


def test_the_clearest_track_is_taken_and_said(dataset, capsys):
    sound, name = find_sound(options(), dataset)
    assert name == "cam02.mp4" and sound.channels == 1
    assert sound.sample_count == round(SECONDS * SAMPLE_RATE)
    assert offset_of(decoded(sound)[:, 0], SWEEP[: sound.sample_count]) == 0
    err = capsys.readouterr().err
    assert err.startswith("sound: cam02.mp4, mono, 2 s, ") and "the clearest of 3 tracks" in err


def test_a_named_track_a_file_or_none_is_taken(dataset, folder, tmp_path):
    assert find_sound(options("none"), dataset) == (None, "none")
    assert find_sound(options("cam01"), dataset)[1] == find_sound(options("cam01.mp4"), dataset)[1] == "cam01.mp4"
    stereo = np.stack([SWEEP, 0.5 * SWEEP], axis=1)[:SAMPLE_RATE]
    track = write_track(tmp_path / "room.wav", stereo, "pcm_s16le")
    sound, name = find_sound(options(str(track), audio_bitrate=96_000), dataset)
    assert (name, sound.channels, sound.sample_count) == ("room.wav", 2, SAMPLE_RATE)  # it ends with the file
    samples = decoded(sound)
    assert np.abs(samples[:, 1] / 0.5 - samples[:, 0])[960:-960].max() < 0.1


@pytest.mark.parametrize(("channels", "bitrate", "bound"), [(1, None, 48_000), (2, None, 64_000), (1, 16_000, 16_000)])
def test_no_sound_takes_more_than_its_bitrate(channels: int, bitrate: int | None, bound: int) -> None:
    t = np.arange(4 * SAMPLE_RATE) / SAMPLE_RATE
    tone = 0.5 * np.sin(2 * np.pi * 440 * t) * (2 * t % 1 < 0.5)  # hard: it begins and ends twice a second
    sound = encode_sound(np.stack([tone] * channels, axis=1), bitrate)
    header, reservoir = 8 * 50, 4000  # bits: a byte of each packet; what the first packets may take in advance
    assert 8 * sum(map(len, sound.packets)) < (bound + header) * sound.duration_s + reservoir


@pytest.mark.parametrize(
    "audio, words",
    [("cam09", "neither a camera nor a file; give one of cam00, cam01"), ("cam00", "cam00.mp4 has no sound track")],
)
def test_a_track_that_is_not_there_is_refused(audio, words, dataset):
    with pytest.raises(UsageError, match=words):
        find_sound(options(audio), dataset)


@pytest.mark.parametrize(
    ("words", "said"),
    [
        (["--audio", "cam09"], "--audio cam09: neither a camera nor a file"),
        (["--audio", "cam00"], "has no sound track"),
        (["--target-size", "200"], "index and sound alone take"),
        (["--group", "1s", "--target-size", "2KB"], "index and sound alone take"),  # half of it for each group
    ],
)
def test_what_no_clip_has_is_refused_before_pictures_are_decoded(folder, tmp_path, monkeypatch, capsys, words, said):
    monkeypatch.setattr(loading, "cached_pixels", lambda *_: pytest.fail("pictures are decoded"))
    monkeypatch.chdir(tmp_path)
    assert kpenc.main([str(folder), "-o", "out.kpc", *words]) != 0
    assert said in capsys.readouterr().err and not list(tmp_path.iterdir())


def test_a_name_of_no_track_is_refused_before_cameras_are_looked_for(folder, tmp_path, monkeypatch, capsys):
    bare = tmp_path / "bare"
    bare.mkdir()
    for video in folder.glob("*.mp4"):
        shutil.copy(video, bare)
    monkeypatch.setattr(find, "find_poses", lambda *_: pytest.fail("cameras are looked for"))
    assert kpenc.main([str(bare), "-o", str(tmp_path / "out.kpc"), "--audio", "cam09"]) == 2
    assert "--audio cam09: neither a camera nor a file; give one of cam00, cam01" in capsys.readouterr().err


def test_silent_videos_make_no_sound(dataset, folder, tmp_path, capsys):
    only = replace(dataset, films={"cam00.mp4": dataset.films["cam00.mp4"]})
    assert find_sound(options(), only) == (None, "auto")
    assert "no video has a sound track" in capsys.readouterr().err
    assert find_sound(options(), replace(dataset, video_start_s=None)) == (None, "auto")  # images
    assert capsys.readouterr().err == ""
    with pytest.raises(UsageError, match="static"):
        find_sound(options("cam01"), replace(dataset, is_dynamic=False))


def test_sound_begins_with_the_clip_as_the_videos_count_time(dataset):
    late = replace(dataset, video_start_s=0.25)
    sound, _ = find_sound(options(), late)
    expected = SWEEP[SAMPLE_RATE // 4 :][: sound.sample_count]
    assert offset_of(decoded(sound)[:, 0], expected) == 0


@pytest.mark.parametrize("codec, name", [("aac", "a.mp4"), ("aac", "a.mkv"), ("pcm_s16le", "a.mov")])
@pytest.mark.parametrize("start_s", [0.0, 0.4])
def test_tracks_are_heard_when_players_play_them(codec, name, start_s, folder, tmp_path):
    video = tmp_path / name
    make.write_n3dv(tmp_path / "one", cameras=1, frames=FRAMES)
    (tmp_path / "one" / "cam00.mp4").rename(tmp_path / "cam00.mp4")
    video.write_bytes((tmp_path / "cam00.mp4").read_bytes())
    add_track(video, SWEEP, codec, start_s)
    whole = np.concatenate([np.zeros(round(start_s * SAMPLE_RATE), np.float32), SWEEP])
    for from_s in (0.0, 0.3):
        found = read_samples(video, from_s, 1.5)[:, 0]
        expected = whole[round(from_s * SAMPLE_RATE) :][: len(found)]
        assert abs(offset_of(found, expected)) <= 48  # a tick of these containers' clocks, 1 ms


def test_samples_of_other_rates_and_damaged_files(tmp_path):
    track = write_track(tmp_path / "a.wav", SWEEP, "pcm_s16le", rate=44_100)
    found = read_samples(track, 0.0, 9.0)
    assert len(found) == pytest.approx(len(SWEEP) * 48_000 / 44_100, abs=48)
    (tmp_path / "b.wav").write_bytes(b"RIFF" + bytes(100))
    with pytest.raises(MediaError, match="cannot be read"):
        read_samples(tmp_path / "b.wav", 0.0, 1.0)


def test_clarity_is_the_signal_above_the_noise_floor():
    clear, noisy = (clarity(with_noise(SWEEP, level)[:, None]) for level in (-60, -40))
    assert clear.range_db - noisy.range_db == pytest.approx(20, abs=1)
    loud = clarity(np.clip(30 * with_noise(SWEEP, -60)[:, None], -1, 1))
    assert loud.is_clipped and loud.rank < noisy.rank < clear.rank
    assert clarity(np.zeros((SAMPLE_RATE, 1), np.float32)).is_silent


def test_groups_hold_their_own_samples_and_go_on_without_a_click():
    sound, fps = encode_sound(SWEEP[:, None]), 30.0
    spans = [Span(0, 47), Span(43, 40)]
    parts = [sound_of_span(sound, span, fps) for span in spans]
    whole = decoded(sound)
    for span, part in zip(spans, parts, strict=True):
        start = sample_at(span.start, fps)
        assert part.sample_count == sample_at(span.count, fps)
        expected = whole[start : start + part.sample_count]
        assert np.abs(decoded(part) - expected).max() < 0.005  # -46 dB, and 16 bits
    assert sound_of_span(None, spans[0], fps) is None


@pytest.mark.usefixtures("one_thread", "quick_coding", "rounded", "heeded_signals")
def test_a_group_and_its_checkpoint_hold_the_sound_of_their_frames(folder, tmp_path, monkeypatch, capsys):
    monkeypatch.setitem(PRESETS, "draft", TINY)
    out, kept = tmp_path / "out.kpc", tmp_path / "kept.kpck"
    only = ["--group", "1s", "--only", "1", "--keep-checkpoint", str(kept)]
    assert kpenc.main([str(folder), "-o", str(out), "--preset", "draft", *only]) == 0
    assert capsys.readouterr().err.count("sound: ") == 1
    groups = Groups(out)
    (span,), sound = groups.timeline.spans, groups.open(0).sound()
    start = sample_at(span.start, groups.clip.fps)
    assert start > 0 and sound.sample_count == sample_at(span.count, groups.clip.fps)
    assert offset_of(decoded(sound)[:, 0], SWEEP[start : start + sound.sample_count]) == 0
    assert groups.open(0).metadata().provenance["options"]["audio"] == "cam02.mp4"
    assert read_checkpoint(kept)[0].sound == sound
