"""What a batch leaves: the results by name, a table, and report.html."""

import html
import json
from collections.abc import Mapping, Sequence

from kpc.tools.batch.jobs import Job
from kpc.tools.batch.store import SCENE, Store
from kpc.tools.batch.tasks import Outcome

# The folder below the output that all workers share.
SHARED = ".kpbatch"
# Columns of the table: heading, figure, and how it is written.
COLUMNS = (
    ("bytes", "size_bytes", "{:,}"),
    ("PSNR", "test_psnr", "{:.2f}"),
    ("moving", "test_psnr_moving", "{:.2f}"),
    ("still", "test_psnr_still", "{:.2f}"),
    ("SSIM", "test_ssim", "{:.4f}"),
    ("encode s", "encode_s", "{:.0f}"),
)
STYLE = """
:root { color-scheme: light dark; font: 15px/1.5 system-ui, sans-serif }
body { margin: 2rem auto; max-width: 70rem; padding: 0 1rem }
table { border-collapse: collapse; width: 100% }
th, td { padding: .3rem .6rem; text-align: right; border-bottom: 1px solid #8885; white-space: nowrap }
th:first-child, td:first-child { text-align: left }
.failed { color: #c33; white-space: pre-wrap; text-align: left }
.wide { overflow-x: auto }
"""


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


def write_report(jobs: Sequence[Job], ended: Mapping[str, Outcome], output: Store) -> None:
    """Write report.html: the table, with what went wrong and links to files and logs; it needs no network."""
    head = "".join(f"<th>{heading}</th>" for heading in ("job", *(heading for heading, _, _ in COLUMNS), "log"))
    rows = []
    for job in jobs:
        outcome, name = ended.get(job.name), html.escape(job.name)
        link = f'<a href="{name}.kpc">{name}</a>' if outcome and outcome.is_done else name
        cells = "".join(f"<td>{cell}</td>" for cell in _cells(ended, job))
        log = f'<a href="{SHARED}/{outcome.key}/log.txt">log</a>' if outcome else ""
        rows.append(f"<tr><td>{link}</td>{cells}<td>{log}</td></tr>")
        if error := _error(ended, job):
            rows.append(f'<tr><td class="failed" colspan="{len(COLUMNS) + 2}">{html.escape(error)}</td></tr>')
    done = sum(outcome.is_done for outcome in ended.values())
    text = (
        f'<!doctype html><html lang="en"><meta charset="utf-8"><title>kpbatch</title>'
        f'<meta name="viewport" content="width=device-width"><style>{STYLE}</style>'
        f"<h1>{done} of {len(jobs)} jobs done</h1>"
        f'<div class="wide"><table><thead><tr>{head}</tr></thead><tbody>{"".join(rows)}</tbody></table></div></html>\n'
    )
    output.put_text(text, "report.html")


def _cells(ended: Mapping[str, Outcome], job: Job) -> list[str]:
    figures = ended[job.name].figures if job.name in ended else {}
    return ["" if figures.get(name) is None else form.format(figures[name]) for _, name, form in COLUMNS]


def _error(ended: Mapping[str, Outcome], job: Job) -> str:
    outcome = ended.get(job.name)
    return "was not begun" if outcome is None else outcome.error
