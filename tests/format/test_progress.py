"""A bar on a terminal, lines elsewhere, nothing if hidden."""

import io
import os
import re
import struct
import sys

import pytest

from kpc.format.common import compiling
from kpc.format.common import progress as module
from kpc.format.common.compiling import CompilationMonitor
from kpc.format.common.progress import Progress, in_parts, part, progress


class Clock:
    now = 0.0

    def monotonic(self) -> float:
        return self.now


@pytest.fixture
def clock(monkeypatch: pytest.MonkeyPatch) -> Clock:
    clock = Clock()
    monkeypatch.setattr(module, "time", clock)
    monkeypatch.setattr(compiling, "time", clock)
    return clock


def test_a_line_after_a_second_and_every_ten(clock: Clock, capsys: pytest.CaptureFixture[str]) -> None:
    with Progress("decode", 100, "frame") as bar:
        for _ in range(50):
            clock.now += 0.5
            bar.note("fine")
            bar.advance()
    out, err = capsys.readouterr()
    assert out == ""
    assert err.splitlines() == [
        f"decode: {done}/100 frame, {left} s left, fine" for done, left in ((2, 49), (22, 39), (42, 29))
    ]


def test_time_before_the_first_unit_is_not_extrapolated(clock: Clock, capsys: pytest.CaptureFixture[str]) -> None:
    with Progress("train", 1000) as bar:
        clock.now = 30.0
        bar.advance()
        for _ in range(112):
            clock.now += 0.1
            bar.advance()
    lines = capsys.readouterr().err.splitlines()
    assert lines[0] == "train: 1/1000" and len(lines) == 3
    assert all(re.fullmatch(r"train: (11|12|111|112)/1000, (99|89) s left", line) for line in lines[1:])


def test_compiling_is_not_extrapolated(
    clock: Clock, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(CompilationMonitor, "spent_s", 0.0)
    with Progress("train", 100) as bar:
        bar.advance()
        clock.now = 42.0
        monkeypatch.setattr(CompilationMonitor, "spent_s", 40.0)
        bar.advance()
    assert capsys.readouterr().err == "train: 2/100, 196 s left\n"


def test_without_a_total(clock: Clock, capsys: pytest.CaptureFixture[str]) -> None:
    with Progress("count") as bar:
        clock.now = 11
        bar.advance(7)
    assert capsys.readouterr().err == "count: 7\n"


def test_percent_and_a_total_that_was_a_guess(clock: Clock, capsys: pytest.CaptureFixture[str]) -> None:
    with Progress("train", 100, "%") as bar:
        bar.advance(10)
        clock.now = 10
        bar.advance(10)
    with Progress("search", 4) as bar:
        bar.extend(3)
        bar.advance(3)
        bar.extend(3)
        clock.now = 20
        bar.advance(1)
    assert capsys.readouterr().err.splitlines() == ["train: 20 %, 80 s left", "search: 4/6, 20 s left"]


def test_parts_of_a_unit_and_parts_of_these(clock: Clock, capsys: pytest.CaptureFixture[str]) -> None:
    reported = []
    with Progress("render", 2, "pictures") as bar:
        for _ in in_parts("ab"):
            for _ in in_parts("cd"):
                reported.append(bar.done)
        for _ in progress(range(3), "plate", shown=False):
            for _ in in_parts("cd"):
                pass  # parts of the plate's bar
        bar.advance()
        reported.append(bar.done)
        with part(0.25):
            clock.now = 2.0
        reported.append(bar.done)
        bar.advance()
    assert reported == [0.0, 0.25, 0.5, 0.75, 1.0, 1.25] and bar.done == 2
    assert capsys.readouterr().err == "render: 1/2 pictures, 62 %, 2 s left\n"
    assert list(in_parts("without a bar")) == list("without a bar")


def test_hidden(clock: Clock, capsys: pytest.CaptureFixture[str]) -> None:
    with Progress("decode", 10, shown=False) as bar:
        clock.now = 60
        bar.advance()
    assert capsys.readouterr().err == ""


def test_items_of_an_iterable_are_yielded() -> None:
    assert list(progress([1, 2, 3], "count")) == [1, 2, 3]
    assert list(progress((k for k in "ab"), "letters", total=2)) == ["a", "b"]


@pytest.mark.parametrize("total", [3, None])
def test_bar_on_a_terminal(monkeypatch: pytest.MonkeyPatch, total: int | None) -> None:
    class Terminal(io.StringIO):
        def isatty(self) -> bool:
            return True

    terminal = Terminal()
    monkeypatch.setattr(sys, "stderr", terminal)
    with Progress("decode", total, "frame") as bar:
        bar.note("psnr 30")
        bar.advance(2)
        bar.advance(2)  # one more than the total
        bar.bar.refresh()
    assert "decode" in terminal.getvalue() and "psnr 30" in terminal.getvalue() and "4" in terminal.getvalue()


@pytest.mark.skipif(os.name == "nt", reason="there are no pseudoterminals")
@pytest.mark.parametrize("columns", [0, 80])
def test_a_terminal_without_a_size_gets_lines(clock: Clock, monkeypatch: pytest.MonkeyPatch, columns: int) -> None:
    import fcntl
    import termios

    reader, writer = os.openpty()
    fcntl.ioctl(writer, termios.TIOCSWINSZ, struct.pack("HHHH", columns // 4, columns, 0, 0))
    with open(writer, "w") as terminal:
        monkeypatch.setattr(sys, "stderr", terminal)
        with Progress("decode", 100, "frame") as bar:
            clock.now = 2.0
            bar.advance(7)
        terminal.flush()
        shown = os.read(reader, 10_000).decode()
    os.close(reader)
    assert ("\r" in shown.replace("\r\n", "")) == (columns > 0)
    assert columns > 0 or shown == "decode: 7/100 frame\r\n"
