"""Sound in kpinfo, kpjoin, kpedit and kprender."""

import json
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from kpc.encoder.coding.opus import encode_sound
from kpc.encoder.coding.scene_writer import write
from kpc.encoder.datasets.sound_tracks import read_samples
from kpc.format.coding.quantise import quantise_scene
from kpc.format.common.errors import MediaError
from kpc.format.container.clip_sound import parts_of, sample_at, sound_spans
from kpc.format.container.container import Reader
from kpc.format.container.groups import GroupInput, Groups, Span, Timeline
from kpc.format.container.groups import write as write_groups
from kpc.format.container.scene_io import read
from kpc.format.scene.scene import Clip
from kpc.format.scene.sound import SAMPLE_RATE
from kpc.player.sound import opus
from kpc.tools.cli import kpedit, kpinfo, kpjoin
from kpc.tools.rendering import sound as film_sound
from scenes import tiny_scene
from sounds import decoded, offset_of, sweep

FPS = 10.0
SWEEP = sweep(4.0)
Run = Callable[..., tuple[int, str, str]]


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Hold `a.kpc` and `b.kpc`, scenes of 11 frames whose sound is that of frames 0 to 10 and 11 to 21 of one sweep."""
    found = tmp_path_factory.mktemp("sound")
    whole = encode_sound(SWEEP[:, None])
    for number, name in enumerate("ab"):
        scene = tiny_scene(scales=1, channels=2, resolution=(6, 5, 4), time=5)
        part = whole.part(sample_at(11 * number, FPS), sample_at(11, FPS))
        scene = replace(scene, sound=part, clip=Clip(11, FPS))
        write(quantise_scene(scene, [dict.fromkeys(scale, 0.05) for scale in scene.scales]), found / f"{name}.kpc")
    assert kpjoin.main([str(found / "a.kpc"), str(found / "b.kpc"), "-o", str(found / "clip.kpc")]) == 0
    return found


def heard(path: Path) -> np.ndarray:
    """Return the samples of a whole file, with silence where there is none."""
    groups = Groups(path)
    blocks = []
    for count, sound in parts_of(groups, 0, sample_at(groups.clip.frame_count, groups.clip.fps)):
        samples = np.zeros(0, np.float32) if sound is None else decoded(sound)[:, 0]
        blocks.append(np.pad(samples, (0, count - len(samples))))
    return np.concatenate(blocks)


def test_kpinfo_says_what_is_heard(folder, capsys):
    jsonschema = pytest.importorskip("jsonschema")
    assert kpinfo.main([str(folder / "a.kpc"), "--verify"]) == 0
    assert "\n  sound       Opus, mono, 1.10 s, " in capsys.readouterr().out
    assert kpinfo.main([str(folder / "clip.kpc")]) == 0
    assert "\n  sound       Opus, mono, 2.20 s, " in capsys.readouterr().out
    assert kpinfo.main([str(folder / "a.kpc"), "--json"]) == 0
    document = json.loads(capsys.readouterr().out)
    schema = json.loads((Path(__file__).parents[2] / "docs" / "kpinfo.schema.json").read_text())
    jsonschema.validate(document, schema)
    (group,) = document["files"][0]["groups"]
    stored = sum(entry.stored_length for entry in Reader(folder / "a.kpc").index if entry.kind == "soun")
    assert group["sound"] == {"channels": 1, "duration_s": 1.1, "heard_s": 1.1, "stored_bytes": stored}


def test_kpinfo_counts_what_groups_share_once(folder, tmp_path, capsys):
    parts = [GroupInput.of(folder / f"{name}.kpc", start) for name, start in (("a", 0), ("b", 7))]
    write_groups(parts, tmp_path / "clip.kpc")
    assert kpinfo.main([str(tmp_path / "clip.kpc"), "--json"]) == 0
    sounds = [group["sound"] for group in json.loads(capsys.readouterr().out)["files"][0]["groups"]]
    assert [sound["duration_s"] for sound in sounds] == [1.1, 1.1]
    assert [sound["heard_s"] for sound in sounds] == pytest.approx([0.85, 0.95])  # from frame 8.5 on the second
    assert kpinfo.main([str(tmp_path / "clip.kpc")]) == 0
    assert "\n  sound       Opus, mono, 1.80 s, " in capsys.readouterr().out


def test_a_joined_clip_sounds_as_if_it_had_never_been_cut(folder):
    found = heard(folder / "clip.kpc")
    assert len(found) == sample_at(22, FPS)
    whole = decoded(encode_sound(SWEEP[:, None]))[: len(found), 0]
    assert np.abs(found - whole).max() < 0.005  # the pre-roll leaves -46 dB


def test_groups_take_over_in_the_middle_of_frames_that_they_share_or_where_they_begin():
    spans = sound_spans(Timeline((Span(5, 10), Span(11, 10), Span(21, 5)), 8.0))
    assert [(span.group, span.start) for span in spans] == [(0, 0), (1, 36_000), (2, 96_000)]
    assert [span.first for span in spans] == [0, 45_000, 96_000]  # frames 0, 7.5 and 16
    assert [span.stop for span in spans] == [45_000, 96_000, 126_000]


def test_a_part_of_a_clip_keeps_its_sound(folder, capsys):
    out = folder / "part.kpc"
    assert kpedit.main([str(folder / "a.kpc"), "-o", str(out), "--from", "0.3s", "--to", "0.6s"]) == 0
    assert ", 0.250 to 0.750 s" in capsys.readouterr().out
    sound = read(out).sound
    clip = Groups(out).clip
    assert sound.sample_count == round(clip.total_s * SAMPLE_RATE)
    expected = SWEEP[round(0.25 * SAMPLE_RATE) :][: sound.sample_count]
    assert offset_of(decoded(sound)[:, 0], expected) == 0


def test_another_rate_keeps_the_sound_and_another_speed_does_not(folder, capsys):
    out = folder / "other.kpc"
    assert kpedit.main([str(folder / "a.kpc"), "-o", str(out), "--fps", "20"]) == 0
    assert read(out).sound == read(folder / "a.kpc").sound
    assert kpedit.main([str(folder / "a.kpc"), "-o", str(out), "--speed", "1"]) == 0
    assert read(out).sound == read(folder / "a.kpc").sound and "left out" not in capsys.readouterr().err
    for name in ("a.kpc", "clip.kpc"):
        capsys.readouterr()
        assert kpedit.main([str(folder / name), "-o", str(out), "--speed", "2"]) == 0
        assert all(Groups(out).open(number).sound() is None for number in range(len(Groups(out))))
        assert capsys.readouterr().err.count("sound is left out") == 1


@pytest.mark.parametrize("suffix", ["mp4", "webm", "mkv", "mov"])
def test_films_have_the_sound_of_their_span(run: Run, folder, tmp_path, suffix):
    film = tmp_path / f"film.{suffix}"
    times = ["--from", 0.5, "--to", 1.6, "--fps", 20]
    code, out, err = run(folder / "clip.kpc", *times, "--size", "16x16", "--backend", "reference", "-o", film)
    assert code == 0 and "with sound" in out, err
    found = read_samples(film, 0.0, 9.0)[:, 0]
    assert len(found) == pytest.approx(1.1 * SAMPLE_RATE, abs=1100)  # AAC ends with a whole frame
    assert abs(offset_of(found, SWEEP[SAMPLE_RATE // 2 :][: len(found)])) <= 48  # a tick of Matroska, 1 ms


def test_films_at_another_speed_have_none_and_say_so(run: Run, folder, tmp_path, monkeypatch):
    size = ("--size", "16x16", "--backend", "reference", "-o", tmp_path / "film.mp4")
    _, out, err = run(folder / "a.kpc", "--orbit", 4, *size)
    assert "with sound" not in out and err.count("does not play the clip at its own speed") == 1
    _, out, err = run(folder / "a.kpc", "--time", 0.5, *size)
    assert ": 1 frame at " in out and "with sound" not in out and "does not play the clip at its own speed" in err

    def refuse(_: object) -> np.ndarray:
        raise MediaError(opus.MISSING)

    monkeypatch.setattr(film_sound, "decode", refuse)
    code, out, err = run(folder / "a.kpc", "--from", 1, *size)
    assert code == 0 and "with sound" not in out and 'pip install "kpc[sound]"' in err


def test_packets_decode_as_by_libopus_however_long_they_are():
    for channels, bitrate in ((1, 16_000), (2, 256_000)):  # packets of 40 and of 640 bytes
        sound = encode_sound(np.stack([SWEEP, -0.5 * SWEEP], axis=1)[:SAMPLE_RATE, :channels], bitrate)
        assert np.abs(opus.decode(sound) - decoded(sound)).max() < 1e-4  # 16 bits
    large = bytes([3 << 3 | 1]).ljust(65_535, b"\0")  # 120 ms, more bytes than a page takes
    refused = bytes([31 << 3 | 3, 3]) + bytes(256)  # three frames of one size do not take 256 bytes
    for channels in (1, 2):
        samples = opus.decode_packets([large, refused, *sound.packets], channels)
        assert len(samples) == 5760 + 2880 + sound.starts[-1]
        assert not samples[: 5760 + 2880].any() and samples[5760 + 2880 :].any()
    assert opus.decode_packets([], 2).shape == (0, 2)
