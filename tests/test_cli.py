"""Exceptions of commands become an exit code and one line, or are bugs with a traceback."""

import argparse
import errno
import importlib
import importlib.metadata
import os
import re
import sys
from collections.abc import Callable, Iterator
from pathlib import Path

import pytest

from kpc.format.common import cli
from kpc.format.common.errors import FormatError, UsageError
from kpc.format.container import rewriting
from kpc.tools.cli import kpinfo


def raising(error: BaseException, cause: BaseException | None = None) -> Callable[[list[str]], None]:
    def command(argv: list[str]) -> None:
        raise error from cause

    return command


@pytest.mark.parametrize(
    "error, cause, code, line",
    [
        (FormatError("a\n  b.kpc: cut off"), None, 1, "a\\n  b.kpc: cut off"),
        (UsageError("no such option"), None, 2, "no such option"),
        (OSError(errno.ENOENT, "nothing there", "b.kpc"), None, 1, "b.kpc: nothing there"),
        (OSError(errno.EISDIR, "Is a directory", "b"), None, 1, "b: is a folder; give the name of a file"),
        (OSError(errno.ENOSPC, "full"), None, 1, "full"),
        (KeyboardInterrupt(), None, 130, "interrupted"),
        (SystemError("compiled"), KeyboardInterrupt(), 130, "interrupted"),
    ],
)
def test_errors_that_users_can_fix_are_one_line(
    error: BaseException, cause: BaseException | None, code: int, line: str, capsys: pytest.CaptureFixture[str]
) -> None:
    assert cli.run(raising(error, cause), "kpx", []) == code
    assert capsys.readouterr() == ("", f"kpx: {line}\n")


@pytest.mark.parametrize(
    "error, cause",
    [
        (SystemError("compiled"), None),
        (SystemError("compiled"), ValueError()),
        (ValueError("x"), None),
        (OSError(errno.EIO, "x"), None),
    ],
)
def test_bugs_keep_their_traceback(error: Exception, cause: Exception | None) -> None:
    with pytest.raises(type(error)):
        cli.run(raising(error, cause), "kpx", [])


@pytest.mark.parametrize("kind", [UsageError, FormatError, KeyboardInterrupt])
def test_bars_are_closed_before_an_error_is_printed(
    kind: type[BaseException], capsys: pytest.CaptureFixture[str]
) -> None:
    def bar() -> Iterator[int]:
        try:
            yield 0
        finally:
            print("closed", file=sys.stderr)

    def command(_: list[str]) -> None:
        for _ in bar():
            raise kind("bad")

    assert cli.run(command, "kpx", []) > 0
    assert capsys.readouterr().err.startswith("closed\nkpx: ")


@pytest.mark.parametrize("number", [errno.ENOSPC, errno.EDQUOT])
def test_a_full_disk_is_reported_with_the_file_that_was_to_be_written(tmp_path: Path, number: int) -> None:
    with pytest.raises(OSError) as caught, cli.atomic_write(tmp_path / "film.mp4") as aside:
        aside.write_bytes(b"half")
        raise OSError(number, "full")
    assert (caught.value.errno, caught.value.filename) == (number, str(tmp_path / "film.mp4"))
    assert list(tmp_path.iterdir()) == []


def test_errors_name_the_file_that_was_asked_for_not_the_one_written_aside(tmp_path: Path) -> None:
    with pytest.raises(FileNotFoundError) as caught, cli.atomic_write(tmp_path / "none" / "a.png"):
        pass
    assert caught.value.filename == str(tmp_path / "none" / "a.png")
    with pytest.raises(FileNotFoundError) as caught, cli.atomic_write(tmp_path / "a.png") as aside:
        aside.unlink()
    assert caught.value.filename == str(tmp_path / "a.png")


def test_outputs_that_cannot_be_made_are_named_as_such(tmp_path: Path) -> None:
    with pytest.raises(FileNotFoundError, match=r"cannot be written \(.+\); give another name"):
        with cli.atomic_write(tmp_path / "none" / "a.png"):
            pass
    with pytest.raises(OSError, match=r"cannot be made \(.+\); give another name") as caught:
        cli.make_folder(tmp_path / ("a" * 1000))
    assert caught.value.errno == errno.ENAMETOOLONG


def test_the_target_of_a_symbolic_link_is_written_and_keeps_its_permissions(tmp_path: Path) -> None:
    store, link, dangling = tmp_path / "store", tmp_path / "scene.kpc", tmp_path / "next.kpc"
    store.mkdir()
    (store / "blob").write_bytes(b"old")
    (store / "blob").chmod(0o640)
    link.symlink_to("store/blob")
    dangling.symlink_to("store/new")
    for path, target in (link, store / "blob"), (dangling, store / "new"):
        cli.check_writable(path)
        with cli.atomic_write(path) as aside:
            assert aside.parent == store and aside.suffix == ".kpc"
            aside.write_bytes(b"whole")
        assert path.is_symlink() and target.read_bytes() == b"whole"
    assert (store / "blob").stat().st_mode & 0o777 == 0o640
    (tmp_path / "lost.kpc").symlink_to("nowhere/lost")
    with pytest.raises(UsageError, match="nowhere: no such folder"):
        cli.check_writable(tmp_path / "lost.kpc")


def test_a_link_to_a_file_of_another_kind_is_no_output(tmp_path: Path) -> None:
    """It may be the scene that is rendered."""
    (tmp_path / "scene.kpc").write_bytes(b"whole")
    (tmp_path / "picture.png").symlink_to("scene.kpc")
    for write in cli.check_writable, lambda path: rewriting.save(b"other", path):
        with pytest.raises(OSError, match=r"is a link to scene\.kpc, a file of another kind"):
            write(tmp_path / "picture.png")
    assert (tmp_path / "scene.kpc").read_bytes() == b"whole"


def test_a_link_that_leads_nowhere_is_no_folder(tmp_path: Path) -> None:
    (tmp_path / "frames").symlink_to("nowhere")
    with pytest.raises(UsageError, match="frames: is a link that leads nowhere"):
        cli.check_writable(tmp_path / "frames", is_folder=True)


@pytest.mark.skipif(not hasattr(os, "mkfifo"), reason="this system has no named pipes")
def test_pipes_and_devices_are_no_outputs(tmp_path: Path) -> None:
    os.mkfifo(tmp_path / "pipe.kpc")
    (tmp_path / "null.kpc").symlink_to(os.devnull)
    (tmp_path / "loop.kpc").symlink_to("loop.kpc")
    for name, what in ("pipe", "is a named pipe; KPC"), ("null", "is a device; KPC"), ("loop", "symbolic links"):
        path = tmp_path / f"{name}.kpc"
        for write in cli.check_writable, lambda path: rewriting.save(b"whole", path):
            with pytest.raises(OSError, match=what) as caught:
                write(path)
            assert caught.value.filename == str(path)
        assert path.is_fifo() or path.is_symlink()


@pytest.mark.parametrize("letter", ["x", "é", "😀"])
def test_names_may_be_as_long_as_the_system_permits(tmp_path: Path, letter: str) -> None:
    path = tmp_path / (letter * (251 // len(letter.encode())) + ".kpc")
    path.touch()
    with cli.atomic_write(path) as aside:
        aside.write_bytes(b"whole")
    assert path.read_bytes() == b"whole"


def test_errors_of_other_files_stay_as_they_are_while_one_is_written(tmp_path: Path) -> None:
    with pytest.raises(PermissionError) as caught, cli.atomic_write(tmp_path / "a.png"):
        raise PermissionError(errno.EACCES, "no", "b.png")
    assert caught.value.filename == "b.png"


@pytest.mark.parametrize("module", ["encoder.cli.kpenc", "tools.cli.kpedit", "tools.cli.kpjoin"])
def test_commands_that_read_files_alone_refuse_addresses(module: str, capsys: pytest.CaptureFixture[str]) -> None:
    with pytest.raises(SystemExit) as ended:
        importlib.import_module(f"kpc.{module}").main(["https://user:secret@host/a.kpc", "-o", "b.kpc"])
    err = capsys.readouterr().err
    assert ended.value.code == 2 and "download the file and give its path (see" in err and "secret" not in err


@pytest.mark.parametrize(
    ("module", "words"),
    [
        ("encoder.cli.kpenc", "set -o s3://bucket/x.kpc"),
        ("encoder.cli.kpenc", "set -o x.kpc --work s3://bucket/work"),
        ("encoder.cli.kpposes", "set -o s3://bucket/x.json"),
        ("player.app.kpplay", "x.kpc --folder s3://bucket/films"),
        ("tools.cli.kpshare", "x.kpc -o https://mysite.org/scene/"),
        ("tools.cli.kprender", "x.kpc -o s3://bucket/frames/"),
        ("tools.cli.kprender", "x.kpc -o https://host/film.mp4"),
        ("tools.cli.kpexport", "x.kpc -o https://host/points"),
        ("tools.cli.kpedit", "x.kpc --title x -o s3://bucket/x.kpc"),
        ("tools.cli.kpjoin", "x.kpc -o s3://bucket/x.kpc"),
        ("tools.cli.kpbatch", "set -o out --scratch s3://bucket/scratch"),
        ("tools.cli.contactsheet", "a b -o s3://bucket/x.png"),
        ("tools.bench.kpbench", "decode x.kpc --out s3://bucket/x.json"),
        ("tools.bench.kpbench", "report x.json -o s3://bucket/x.html"),
        ("tools.bench.kpbench", "suite -o s3://bucket/records"),
        ("tools.bench.plot", "x.json -o s3://bucket/x.svg"),
    ],
)
def test_nothing_is_written_to_an_address(
    module: str, words: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.chdir(tmp_path)
    with pytest.raises(SystemExit, match="2"):
        importlib.import_module(f"kpc.{module}").main(words.split())
    err = capsys.readouterr().err
    assert "nothing is written to an address; give a file or folder of this machine" in err and err.count("\n") == 1
    assert not list(tmp_path.iterdir())


@pytest.mark.parametrize("module", ["encoder.cli.kpenc", "tools.cli.kpedit", "tools.cli.kpjoin"])
def test_errors_of_options_are_one_line(module: str, capsys: pytest.CaptureFixture[str]) -> None:
    with pytest.raises(SystemExit):
        importlib.import_module(f"kpc.{module}").main(["none.kpc", "-o", "b.kpc", "--c\nd"])
    name = module.rpartition(".")[2]
    assert capsys.readouterr().err == f"{name}: error: unrecognized arguments: --c\\nd (see {name} --help)\n"


def test_files_may_stand_on_both_sides_of_an_option(capsys: pytest.CaptureFixture[str]) -> None:
    parser = cli.Parser("kpx")
    parser.add_argument("files", nargs="+")
    parser.add_argument("-o", required=True)
    given = parser.parse_args(["a", "-o", "b", "c"])
    assert (given.files, given.o) == (["a", "c"], "b")
    assert parser.parse_args(["-o", "b", "--", "-c.kpc", "d"]).files == ["-c.kpc", "d"]
    for words in (["-o", "b"], ["a"]):
        with pytest.raises(SystemExit, match="2"):
            parser.parse_args(words)
        assert "kpx: error: the following arguments are required: " in capsys.readouterr().err


@pytest.mark.parametrize(
    "module",
    [
        "encoder.cli.kpenc",
        "player.app.kpplay",
        "tools.cli.kprender",
        "tools.cli.kpinfo",
        "tools.cli.kpjoin",
        "tools.cli.kpexport",
        "tools.bench.kpbench",
    ],
)
def test_every_command_prints_its_version(module: str, capsys: pytest.CaptureFixture[str]) -> None:
    with pytest.raises(SystemExit) as exit_:
        importlib.import_module(f"kpc.{module}").main(["--version"])
    assert exit_.value.code == 0
    assert capsys.readouterr().out == f"{module.rpartition('.')[2]} {importlib.metadata.version('kpc')}\n"


@pytest.mark.parametrize(
    "text, count", [("300000", 300_000), ("300KB", 300_000), ("2mb", 2_000_000), ("1.5M", 1_500_000)]
)
def test_sizes(text: str, count: int) -> None:
    assert cli.byte_count(text) == count


@pytest.mark.parametrize(
    ("name", "is_folder", "complaint"),
    [
        ("there/new.kpc", False, None),
        ("there", True, None),
        ("new/and/below", True, None),
        ("there", False, "there: is a folder; give the name of a file"),
        ("new/new.kpc", False, "new: no such folder; make it first"),
        ("file/new.kpc", False, "file: is a file, not a folder"),
        ("file", True, "file: is a file, not a folder"),
        ("file/new", True, "file: is a file, not a folder"),
    ],
)
def test_output_is_checked_before_the_work(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, name: str, is_folder: bool, complaint: str | None
) -> None:
    (tmp_path / "there").mkdir()
    (tmp_path / "file").touch()
    if complaint is not None:
        with pytest.raises(UsageError, match=re.escape(complaint)):
            cli.check_writable(tmp_path / name, is_folder=is_folder)
        return
    cli.check_writable(tmp_path / name, is_folder=is_folder)
    monkeypatch.setattr(os, "access", lambda path, mode: False)
    with pytest.raises(OSError, match="no permission to write there") as caught:
        cli.check_writable(tmp_path / name, is_folder=is_folder)
    assert caught.value.filename == str(tmp_path / name)


def test_a_folder_that_takes_no_files_is_no_place_for_output(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """As /proc does, whose permissions promise them to root."""

    def refuse(*, dir: Path) -> None:
        raise FileNotFoundError(errno.ENOENT, "not here", dir / "tmp")

    monkeypatch.setattr("tempfile.TemporaryFile", refuse)
    for is_folder in False, True:
        with pytest.raises(OSError, match=r"nothing can be written there \(not here\); .* --out") as caught:
            cli.check_writable(tmp_path / "x.kpc", is_folder=is_folder, option="--out")
        assert caught.value.filename == str(tmp_path / "x.kpc")


def test_a_write_protected_file_is_kept(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    (tmp_path / "master.kpc").touch(0o444)
    monkeypatch.setattr(os, "access", lambda path, mode: Path(path).is_dir())  # as for all users but root
    cli.check_writable(tmp_path / "new.kpc")
    with pytest.raises(OSError, match="is write-protected; choose another name with --out"):
        cli.check_writable(tmp_path / "master.kpc", option="--out")


@pytest.mark.skipif(not hasattr(os, "mkfifo"), reason="this system has no named pipes")
def test_a_pipe_is_refused_rather_than_waited_for(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    os.mkfifo(tmp_path / "scene.kpc")
    assert kpinfo.main([str(tmp_path / "scene.kpc")]) == 1
    assert "scene.kpc: is a pipe" in capsys.readouterr().err


def test_frame_rates_may_be_fractions() -> None:
    rate = cli.frame_rate(0.1, 240)
    assert rate("24000/1001") == 24000 / 1001 and rate("29.97") == 29.97
    for text in ("24000/0", "9" * 400 + "/1", "1/1001", "-24/1", "24/", "1e3/7", "nan"):
        with pytest.raises(argparse.ArgumentTypeError, match=r"is not a frame rate from 0\.1 to 240"):
            rate(text)


def test_a_dash_is_no_file() -> None:
    with pytest.raises(argparse.ArgumentTypeError, match="is no file"):
        cli.file_name("-")
