"""Texts with byte order marks are read; names that are not Unicode are printed with replaced letters."""

import io
import json
import os
import sys
from pathlib import Path

import pytest

from kpc.format.common import cli
from kpc.format.common.errors import MediaError
from kpc.format.common.text import check_unicode, counted, first_names, open_text, valid_unicode


@pytest.mark.parametrize("encoding", ["utf-8", "utf-8-sig", "utf-16", "utf-32"])
def test_byte_order_marks(tmp_path: Path, encoding: str) -> None:
    (tmp_path / "x.txt").write_text("café €\n", encoding=encoding)
    with open_text(tmp_path / "x.txt") as file:
        assert file.read() == "café €\n"


def test_other_encodings_keep_their_bytes(tmp_path: Path) -> None:
    (tmp_path / "x.txt").write_bytes(b"caf\xe9\n")
    with open_text(tmp_path / "x.txt") as file:
        assert os.fsencode(file.read()) == b"caf\xe9\n"


def test_numbers_and_names_in_messages() -> None:
    assert (counted(1, "frame"), counted(0, "frame"), counted(1200, "frame")) == ("1 frame", "0 frames", "1,200 frames")
    names = [str(number) for number in range(10)]
    assert first_names(names[:8]) == "0, 1, 2, 3, 4, 5, 6, 7"
    assert first_names(names, "--json") == "0, 1, 2, 3, 4, 5, 6, 7 (2 more; --json lists all)"


def test_valid_unicode() -> None:
    assert valid_unicode("a\udce9b\ud800 é 😀") == "a\ufffdb\ufffd é 😀"
    assert valid_unicode(Path("caf\udce9")) == "caf\ufffd"


def test_paths_for_libraries_that_take_text() -> None:
    check_unicode(Path("é/ü.exr"), "EXR")
    with pytest.raises(MediaError, match="EXR files need names that are valid Unicode"):
        check_unicode(Path("caf\udce9") / "a.exr", "EXR")


def test_terminals_obey_no_name(capsys: pytest.CaptureFixture[str]) -> None:
    def command(argv: list[str]) -> None:
        raise FileNotFoundError(2, "No such file or directory", "a\x1b[31m\x9bé")

    assert cli.run(command, "kpx", []) == 1
    assert capsys.readouterr().err == "kpx: a\\x1b[31m\\x9bé: No such file or directory\n"


@pytest.mark.parametrize("encoding", ["ascii", "latin-1", "utf-8"])
def test_terminals_of_any_encoding(monkeypatch: pytest.MonkeyPatch, encoding: str) -> None:
    streams = [io.TextIOWrapper(io.BytesIO(), encoding=encoding) for _ in range(2)]
    monkeypatch.setattr(sys, "stdout", streams[0])
    monkeypatch.setattr(sys, "stderr", streams[1])

    def command(argv: list[str]) -> None:
        print("caf\udce9 \u20ac")
        cli.print_json({"caf\udce9": ["é", 1, None, "\\ud800"]})
        raise cli.UsageError("caf\udce9 \u20ac")

    assert cli.run(command, "kpx", []) == 2
    for stream in streams:
        stream.flush()
    out, err = (stream.buffer.getvalue().decode(encoding) for stream in streams)
    euro = "\u20ac" if encoding == "utf-8" else "?"
    first, rest = out.split("\n", 1)
    assert first == f"caf? {euro}" and err == f"kpx: caf? {euro}\n"
    assert json.loads(rest) == {"caf\ufffd": ["é", 1, None, "\\ud800"]}
