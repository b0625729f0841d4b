"""What a batch leaves: the results by name, a table, and report.html."""

import json
from collections.abc import Collection, Mapping, Sequence
from urllib.parse import quote

from kpc.format.common.errors import UsageError
from kpc.format.common.text import escaped
from kpc.tools.batch.jobs import Job
from kpc.tools.batch.store import SCENE, Store
from kpc.tools.batch.tasks import Outcome, Task
from kpc.tools.pages import render

# The folder below the output that all workers share.
SHARED = ".kpbatch"
REPORT, MARK = "report.html", "<title>kpbatch</title>"  # by which the page is known
# Columns of the table: heading, figure, and how it is written.
COLUMNS = (
    ("bytes", "size_bytes", "{:,}"),
    ("PSNR", "test_psnr", "{:.2f}"),
    ("moving", "test_psnr_moving", "{:.2f}"),
    ("still", "test_psnr_still", "{:.2f}"),
    ("SSIM", "test_ssim", "{:.4f}"),
    ("encode s", "encode_s", "{:.0f}"),
)


def publish(jobs: Sequence[Job], ended: Mapping[str, Outcome], store: Store, output: Store) -> int:
    """Put each result beside its name, NAME.kpc and NAME.json, unless it is there; return how many jobs failed."""
    failed = 0
    for job in jobs:
        outcome = ended.get(job.name)
        if outcome is None or not outcome.is_done:
            failed += 1
            continue
        name = f"{job.name}.json"
        if output.exists(name) and output.exists(f"{job.name}.kpc") and output.get_json(name).get("key") == outcome.key:
            continue
        output.copy(f"{SHARED}/{outcome.key}/{SCENE}", f"{job.name}.kpc")
        output.put_json({"key": outcome.key, "source": job.source, "options": job.options} | outcome.figures, name)
    return failed


def print_plan(tasks: Sequence[Task], known: Collection[str], as_json: bool) -> None:
    """Print a line for each first task of a job, whether its key is known as done, on stdout; as JSON, also a sum."""
    for task in tasks:
        is_done = task.key in known
        if as_json:
            found = {"task": task.name, "job": task.job, "key": task.key, "state": "done" if is_done else "waits"}
            print(json.dumps(found | {"source": task.source}))
        else:
            print(escaped(f"{task.key} {'done' if is_done else 'to do':<5} {task.name}: {task.source}"))
    if as_json:
        print(json.dumps({"jobs": len(tasks), "done": sum(task.key in known for task in tasks)}))


def print_summary(jobs: Sequence[Job], ended: Mapping[str, Outcome], as_json: bool) -> None:
    """Print a table of all jobs on stdout, and what went wrong with those that failed."""
    if as_json:
        done = sum(outcome.is_done for outcome in ended.values())
        print(json.dumps({"jobs": len(jobs), "done": done, "failed": len(jobs) - done}))
        return
    rows = [["job", *(heading for heading, _, _ in COLUMNS)], *([job.name, *_cells(ended, job)] for job in jobs)]
    widths = [max(map(len, column)) for column in zip(*rows, strict=True)]
    for first, *rest in rows:
        print("  ".join([first.ljust(widths[0]), *(cell.rjust(w) for cell, w in zip(rest, widths[1:], strict=True))]))
    for job in jobs:
        if error := _error(ended, job):
            print(f"\n{job.name} failed:\n  " + error.replace("\n", "\n  "))


def check_report(output: Store) -> None:
    """Refuse a place where another report.html than one of `write_report` would be replaced.

    Raises:
        UsageError: there is one.
    """
    if output.exists(REPORT) and MARK not in output.get_text(REPORT):
        raise UsageError(f"{output.address}/{REPORT}: is no page of kpbatch and stays; move it, or give another place")


def write_report(jobs: Sequence[Job], ended: Mapping[str, Outcome], output: Store) -> None:
    """Write report.html: the table, with what went wrong and links to files and logs; it needs no network."""
    rows = []
    for job in jobs:
        outcome = ended.get(job.name)
        row = {"name": job.name, "cells": _cells(ended, job), "error": _error(ended, job)}
        row["file"] = quote(f"{job.name}.kpc") if outcome and outcome.is_done else ""
        row["log"] = f"{SHARED}/{outcome.key}/log.txt" if outcome else ""
        rows.append(row)
    done = sum(outcome.is_done for outcome in ended.values())
    headings = [heading for heading, _, _ in COLUMNS]
    output.put_text(render("batch.html", done=done, rows=rows, headings=headings), REPORT)


def _cells(ended: Mapping[str, Outcome], job: Job) -> list[str]:
    figures = ended[job.name].figures if job.name in ended else {}
    return ["" if figures.get(name) is None else form.format(figures[name]) for _, name, form in COLUMNS]


def _error(ended: Mapping[str, Outcome], job: Job) -> str:
    outcome = ended.get(job.name)
    return "was not begun" if outcome is None else outcome.error
