"""A notice is printed once compilation takes a while."""

import io
import sys

import pytest
from numba import njit
from numba.core import event

from kpc.format.common import compiling
from kpc.format.common.compiling import MONITOR, NOTICE, NOTICE_AFTER_S, CompilationMonitor


class Terminal(io.StringIO):
    def isatty(self) -> bool:
        return True


@pytest.fixture
def clock(monkeypatch: pytest.MonkeyPatch) -> list[float]:
    now = [100.0]
    monkeypatch.setattr(compiling.time, "monotonic", lambda: now[0])
    return now


def started(monitor: CompilationMonitor, number: int = 1) -> None:
    for _ in range(number):
        monitor.on_start(event.Event("numba:compile", event.EventStatus.START))


def ended(monitor: CompilationMonitor, number: int = 1) -> None:
    for _ in range(number):
        monitor.on_end(event.Event("numba:compile", event.EventStatus.END))


def test_a_terminal_gets_one_notice_once_compilation_takes_a_while(
    clock: list[float], monkeypatch: pytest.MonkeyPatch
) -> None:
    monitor, terminal = CompilationMonitor(), Terminal()
    monkeypatch.setattr(sys, "stderr", terminal)
    started(monitor, 2)
    assert not monitor.is_compiling
    clock[0] += 0.9 * NOTICE_AFTER_S
    ended(monitor, 2)
    assert not monitor.is_compiling and terminal.getvalue() == ""
    clock[0] += 60.0  # idle time does not count
    started(monitor)
    assert not monitor.is_compiling
    clock[0] += 0.2 * NOTICE_AFTER_S
    assert monitor.is_compiling
    started(monitor, 2)  # functions needed by the first
    started(monitor)
    assert terminal.getvalue() == f"{NOTICE}\n"
    ended(monitor, 4)
    assert not monitor.is_compiling


def test_nothing_is_printed_into_files(clock: list[float], monkeypatch: pytest.MonkeyPatch) -> None:
    for stream in (io.StringIO(), None):
        monitor = CompilationMonitor()
        monkeypatch.setattr(sys, "stderr", stream)
        started(monitor)
        clock[0] += 2 * NOTICE_AFTER_S
        started(monitor)
        assert monitor.is_compiling and (stream is None or stream.getvalue() == "")


def test_numba_reports_its_compilations(clock: list[float]) -> None:
    import kpc.jit  # noqa: F401

    kinds, on_start = [], MONITOR.on_start
    MONITOR.on_start = lambda event: (kinds.append(event.kind), on_start(event))
    try:
        njit(lambda x: x + 1)(1)
    finally:
        del MONITOR.on_start
    assert "numba:compile" in kinds and MONITOR._depth == 0


def test_a_player_waiting_for_compilation_shows_the_notice(monkeypatch: pytest.MonkeyPatch) -> None:
    from kpc.player.streaming.stream import Stream

    stream = Stream.__new__(Stream)
    stream._failure = stream._trouble = None
    for stalled, compiles, rate, wanted in (
        (True, True, 2000.0, NOTICE),
        (True, False, 2000.0, "loading, 2 KB/s"),
        (True, False, 0.0, "loading"),  # all has arrived, and is being decoded
        (False, True, 2000.0, None),
    ):
        stream._stalled = stalled
        monkeypatch.setattr(Stream, "bytes_per_s", rate)
        monkeypatch.setattr(CompilationMonitor, "is_compiling", compiles)
        assert stream.message == wanted
