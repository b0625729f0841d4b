"""What a batch shows while it runs: a page in the terminal, or lines where there is none, or JSON lines."""

import json
import shutil
import sys
import time
from collections.abc import Sequence
from typing import Any

from kpc.format.common.text import escaped, notice
from kpc.tools.batch.engine import Event

# Seconds between two pictures of the page.
REFRESH_S = 0.5
# States in the order in which the page lists them.
STATES = ("runs", "retried", "failed", "waits", "done")
CLEAR = "\x1b[{}F\x1b[J"


class Page:
    """Shows tasks and their states.

    Args:
        as_json: print each event as a line of JSON on stdout.
    """

    def __init__(self, as_json: bool) -> None:
        self._as_json, self._is_terminal = as_json, sys.stderr.isatty()
        self._events: dict[str, Event] = {}
        self._started, self._shown_at, self._lines = time.monotonic(), 0.0, 0

    def show(self, event: Event) -> None:
        """Take note of an event, and show it."""
        before = self._events.get(event.task.key)
        self._events[event.task.key] = event
        if self._as_json:
            self._print_json(event)
        elif self._is_terminal:
            if time.monotonic() - self._shown_at > REFRESH_S:
                self.redraw()
        elif event.kind != "waits" and (before is None or before.kind != event.kind):
            notice(_line_of(event))

    def redraw(self) -> None:
        """Show the present state of the page."""
        if not self._is_terminal or self._as_json:
            return
        width, height = shutil.get_terminal_size()
        events = sorted(self._events.values(), key=lambda event: STATES.index(event.kind))
        lines = [_line_of(event)[: width - 1] for event in events[: max(1, height - 3)]]
        lines.append(self._summary(events)[: width - 1])
        clear = CLEAR.format(self._lines) if self._lines else ""
        print(clear + "\n".join(lines), file=sys.stderr, flush=True)
        self._lines, self._shown_at = len(lines), time.monotonic()

    def _summary(self, events: Sequence[Event]) -> str:
        counts = {state: sum(event.kind == state for event in events) for state in STATES}
        text = ", ".join(f"{count} {state}" for state, count in counts.items() if count)
        spent = time.monotonic() - self._started
        timed = [event.outcome.seconds for event in events if event.outcome and event.outcome.worker]
        left = counts["waits"] + counts["runs"]
        if timed and left:
            at_once = max(1, counts["runs"])
            text += f"; about {left * sum(timed) / len(timed) / at_once:.0f} s left"
        return f"{text}; {spent:.0f} s"

    def _print_json(self, event: Event) -> None:
        found: dict[str, Any] = {
            "task": event.task.name,
            "job": event.task.job,
            "key": event.task.key,
            "state": event.kind,
        }
        if event.progress:
            found |= {name: value for name, value in event.progress.items() if name != "key"}
        if event.outcome is not None:
            found |= {"seconds": event.outcome.seconds, "worker": event.outcome.worker}
            found |= {"error": event.outcome.error} if event.outcome.error else {"figures": event.outcome.figures}
        print(json.dumps(found), flush=True)


def _line_of(event: Event) -> str:
    """Return a line about a task: its state, and how far it is or what was measured."""
    parts = [f"{event.kind:<8} {event.task.name}"]
    if event.kind == "runs" and event.progress:
        units = {"percent": "{:.0f} %", "psnr": "{:.1f} dB", "left_s": "{:.0f} s left"}
        parts += [unit.format(event.progress[name]) for name, unit in units.items() if name in event.progress]
    if event.outcome is not None and event.outcome.is_done:
        parts += describe(event.outcome.figures)
        parts.append(f"{event.outcome.seconds:.0f} s" if event.outcome.worker else "done before")
    elif event.outcome is not None:
        parts.append(event.outcome.error.splitlines()[-1] if event.outcome.error else "")
    return escaped(", ".join(part for part in parts if part))


def describe(figures: dict[str, object]) -> list[str]:
    """Return size and quality in words, as far as they were measured."""
    size, psnr = figures.get("size_bytes"), figures.get("test_psnr")
    found = [f"{size:,} bytes"] if isinstance(size, int) else []
    return found + ([f"{psnr:.2f} dB"] if isinstance(psnr, int | float) else [])
