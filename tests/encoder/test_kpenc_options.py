"""Options of kpenc that contradict each other, or what they name, are refused before anything is done."""

from pathlib import Path

import pytest

from kpc.encoder.cli.options import parse
from kpc.encoder.cli.read_dataset import read_dataset
from kpc.encoder.cli.transcode import check_outputs
from kpc.encoder.cli.work_folder import CHECKPOINT
from kpc.format.common.errors import UsageError


def refusal(capsys: pytest.CaptureFixture[str], *words: str) -> str:
    """Return what the parser says about a command line that it refuses."""
    with pytest.raises(SystemExit, match="2"):
        parse(list(words))
    return capsys.readouterr().err.rsplit("error: ", 1)[-1].strip()


def test_no_output_replaces_what_is_read(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    video, scene = tmp_path / "cam05.mp4", tmp_path / "x.kpc"
    for name in (str(video), "keep.kpc", ".kpck", "keep.kpck/"):
        assert "does not end in .kpck" in refusal(capsys, str(tmp_path), "-o", str(scene), "--keep-checkpoint", name)
    heard, kept = tmp_path / "heard.kpc", tmp_path / "heard.kpck"
    for file in (heard, kept):
        file.write_bytes(b"sound")
    for words in (["-o", str(heard), "--audio", str(heard)], ["-o", str(scene), "--keep-checkpoint", str(kept)]):
        options, *_ = parse([str(tmp_path), "--audio", str(kept), *words])
        with pytest.raises(UsageError, match="is the source, too"):
            check_outputs(options)


def test_no_output_is_removed_with_the_work_folder(tmp_path: Path) -> None:
    def checked(name: str) -> None:
        words = ["--work", str(tmp_path), "--keep-checkpoint", str(tmp_path / name)]
        check_outputs(parse([str(tmp_path / "set"), "-o", str(tmp_path / "x.kpc"), *words])[0])

    checked("model.kpck")
    for name in (CHECKPOINT, "group-3.kpck"):
        with pytest.raises(UsageError, match="in its work folder; choose another with --keep-checkpoint"):
            checked(name)


def test_options_that_contradict_each_other_are_refused(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    words = (str(tmp_path), "-o", str(tmp_path / "x.kpc"))
    assert "drop one" in refusal(capsys, *words, "--steps", "100", "--time-budget", "10s")
    assert "drop --audio-bitrate" in refusal(capsys, *words, "--audio", "none", "--audio-bitrate", "48k")


def test_options_about_missing_poses_are_refused_where_there_are_poses(tmp_path: Path) -> None:
    (tmp_path / "transforms.json").write_text("{}")
    wishes = ["--distance", "a,b=2", "--sync", "audio", "--rig", "still", "--require-all"]
    options, *_ = parse([str(tmp_path), "-o", str(tmp_path / "x.kpc"), *wishes])
    with pytest.raises(UsageError, match=f"^--rig, --sync, --distance, --require-all: {tmp_path} has poses"):
        read_dataset(options)
