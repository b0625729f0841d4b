"""Ctrl-C, and SIGTERM alike: the first ends a command in an orderly way, the second at once.

Python handles a signal between two bytecodes of the main thread, which may be long within compiled code, and what is
raised there is lost if it happens in a destructor or a callback of C. So a thread, which the C runtime wakes, ends the
process on the second Ctrl-C, or when the first has not done so in time. While numba compiles, an exception between any
two bytecodes can crash LLVM; `defer_while` lets the first wait for a safe place there.
"""

import contextlib
import math
import os
import select
import signal
import socket
import sys
import threading
import time
from collections.abc import Callable, Iterator
from typing import Any

SIGNALS = signal.SIGINT, signal.SIGTERM

# Seconds that the second Ctrl-C leaves to the exception of the first, to remove temporary files.
GRACE_S = 0.3

# Seconds that a command has to end after the first.
LONGEST_S = 4.0

POLL_S = 0.1

# The exit code of a command that was interrupted, as shells have it.
INTERRUPTED = 130

_busy: list[Callable[[], bool]] = []
_asked = _is_pending = False  # whether KeyboardInterrupt is to be raised, and whether at a safe place
_is_heard = False  # whether the command has taken note of the first Ctrl-C by a handler of its own
_loading: Callable[..., None] | None = None  # the handler of `ending_at_once`


def defer_while(is_busy: Callable[[], bool]) -> None:
    """Let a Ctrl-C that comes while `is_busy()` wait until `raise_pending` is called."""
    _busy.append(is_busy)


def handle(*_: Any) -> None:
    """Raise KeyboardInterrupt, or have `raise_pending` do so: a handler for `signal.signal`."""
    global _asked, _is_pending
    _asked, _is_pending = True, any(is_busy() for is_busy in _busy)
    if not _is_pending:
        raise KeyboardInterrupt


def heard() -> None:
    """Say that a handler of the command's own has taken note of Ctrl-C; it may then take as long as it needs."""
    global _is_heard
    _is_heard = True


def raise_pending() -> None:
    """Raise KeyboardInterrupt if one has been deferred; do so again until the command ends, should it be lost."""
    if _is_pending:
        raise KeyboardInterrupt


@contextlib.contextmanager
def ending_at_once(name: str) -> Iterator[None]:
    """Let Ctrl-C end the process while modules are loaded, up to `heeded`.

    Nothing has to be put in order then, and an exception could be lost or turn into another one in what is loaded.
    """
    global _loading
    own = signal.getsignal(signal.SIGINT)
    if threading.current_thread() is not threading.main_thread() or own is not signal.default_int_handler:
        yield
        return
    _loading = lambda *_: end(name)  # noqa: E731
    signal.signal(signal.SIGINT, _loading)
    try:
        yield
    finally:
        signal.signal(signal.SIGINT, own)


@contextlib.contextmanager
def heeded(name: str) -> Iterator[None]:
    """Handle Ctrl-C and SIGTERM as described above while the command `name` runs; in other threads than the main one do
    nothing.

    A process for which one of them is ignored, as Ctrl-C is in the background of a shell without job control, goes on
    ignoring it, and a handler of the caller's own stays.
    """
    global _asked, _is_pending, _is_heard
    is_main = threading.current_thread() is threading.main_thread()
    own = {number: signal.getsignal(number) for number in SIGNALS}
    plain = (signal.default_int_handler, signal.SIG_DFL, handle, _loading)
    own = {number: handler for number, handler in own.items() if is_main and handler is not None and handler in plain}
    if not own:
        yield
        return
    reader, writer = socket.socketpair()  # sockets, since Windows takes no other
    writer.setblocking(False)
    before = signal.set_wakeup_fd(writer.fileno(), warn_on_full_buffer=False)
    for number in own:
        signal.signal(number, handle)
    watcher = threading.Thread(target=_end_in_time, args=(reader, name), name="Ctrl-C", daemon=True)
    watcher.start()
    try:
        yield
    finally:
        for number, handler in own.items():
            signal.signal(number, handler)
        signal.set_wakeup_fd(before)
        _asked = _is_pending = _is_heard = False
        writer.close()
        watcher.join()


def _end_in_time(reader: socket.socket, name: str) -> None:
    """Read the numbers of signals until the other end is closed, and end the process when the command is overdue.

    A command that calls `heard`, such as training, takes as long as it needs for the first Ctrl-C.
    """
    count, overdue_at = 0, math.inf
    with reader:
        while time.monotonic() < overdue_at:
            is_asked = _asked
            if select.select([reader], [], [], POLL_S if count else None)[0]:
                numbers = reader.recv(64)
                if not numbers:
                    return
                count += sum(numbers.count(number) for number in SIGNALS)
                is_asked |= any(
                    signal.getsignal(number) is handle for number in SIGNALS
                )  # which may have to wait for compiled code
                if count > 1:
                    overdue_at = min(overdue_at, time.monotonic() + GRACE_S)
            if count == 1 and _is_heard:
                overdue_at = math.inf
            elif count and is_asked:
                overdue_at = min(overdue_at, time.monotonic() + LONGEST_S)
        end(name)  # with the reader open, since Python reports a signal whose number it cannot write


def end(name: str) -> None:
    """End the process at once, after one line on stderr."""
    with contextlib.suppress(OSError, ValueError):
        sys.stdout.flush()
        bar = "\n" if os.isatty(2) else ""  # a bar may be in the line
        os.write(2, f"{bar}{name}: interrupted\n".encode())
    os._exit(INTERRUPTED)
