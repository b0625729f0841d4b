"""That kernels are being compiled is said, once it takes a while."""

import io
import sys

import pytest
from kpc.format.common import compiling
from kpc.format.common.compiling import MONITOR, NOTICE, NOTICE_AFTER_S, CompilationMonitor
from numba import njit
from numba.core import event


class Terminal(io.StringIO):
    def isatty(self) -> bool:
        return True


@pytest.fixture
def clock(monkeypatch: pytest.MonkeyPatch) -> list[float]:
    now = [100.0]
    monkeypatch.setattr(compiling.time, "monotonic", lambda: now[0])
    return now


def started(watch: CompilationMonitor, number: int = 1) -> None:
    for _ in range(number):
        watch.on_start(event.Event("numba:compile", event.EventStatus.START))


def ended(watch: CompilationMonitor, number: int = 1) -> None:
    for _ in range(number):
        watch.on_end(event.Event("numba:compile", event.EventStatus.END))


def test_a_terminal_is_told_once_when_it_takes_a_while(clock: list[float], monkeypatch: pytest.MonkeyPatch) -> None:
    watch, terminal = CompilationMonitor(), Terminal()
    monkeypatch.setattr(sys, "stderr", terminal)
    started(watch, 2)
    assert not watch.is_compiling
    clock[0] += 0.9 * NOTICE_AFTER_S
    ended(watch, 2)
    assert not watch.is_compiling and terminal.getvalue() == ""
    clock[0] += 60.0  # in between nothing is compiled
    started(watch)
    assert not watch.is_compiling
    clock[0] += 0.2 * NOTICE_AFTER_S
    assert watch.is_compiling
    started(watch, 2)  # another function that the first needs
    started(watch)
    assert terminal.getvalue() == f"{NOTICE}\n"
    ended(watch, 4)
    assert not watch.is_compiling


def test_no_file_is_told(clock: list[float], monkeypatch: pytest.MonkeyPatch) -> None:
    for stream in (io.StringIO(), None):
        watch = CompilationMonitor()
        monkeypatch.setattr(sys, "stderr", stream)
        started(watch)
        clock[0] += 2 * NOTICE_AFTER_S
        started(watch)
        assert watch.is_compiling and (stream is None or stream.getvalue() == "")


def test_numba_tells_what_it_compiles(clock: list[float]) -> None:
    import kpc.format.coding.rans  # noqa: F401

    seen, on_start = [], MONITOR.on_start
    MONITOR.on_start = lambda event: (seen.append(event.kind), on_start(event))
    try:
        njit(lambda x: x + 1)(1)
    finally:
        del MONITOR.on_start
    assert "numba:compile" in seen and MONITOR._depth == 0


def test_a_player_that_waits_for_that_says_so(monkeypatch: pytest.MonkeyPatch) -> None:
    from kpc.player.streaming.stream import Stream

    stream = Stream.__new__(Stream)
    stream._failure = stream._trouble = None
    monkeypatch.setattr(Stream, "rate", 2000.0)
    for stalled, compiles, wanted in (
        (True, True, NOTICE),
        (True, False, "waiting for the scene, 2 KB/s"),
        (False, True, None),
    ):
        stream._stalled = stalled
        monkeypatch.setattr(CompilationMonitor, "is_compiling", compiles)
        assert stream.message == wanted
