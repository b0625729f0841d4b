"""kpbench suite: measure all of it from one commit.

    kpbench suite -o records --plan
    kpbench suite -o records
    kpbench suite -o records --scene room --scene liam

Each step is a command of kpbench in a process of its own; its records go to NAME.json in the output folder. A step is
done if its records are there, made by the same command from the same commit, and what later steps need of it is there,
too: run the suite again after an interruption, and it goes on. The checkout must be without changes, and stay so.
"""

import argparse
import json
import os
import shlex
import shutil
import subprocess
import sys
import time
from collections.abc import Iterable, Sequence
from pathlib import Path

from kpc.format.common import cli
from kpc.format.common.errors import KpcError, UsageError
from kpc.tools.bench import provenance
from kpc.tools.bench.suite_steps import HOUR, QUICK, Step, generated, of_scene
from kpc.tools.bench.tables import short_commit

WORK = "work"  # folder below the output with scenes, encodings and logs, by commit
LOG_LINES = 5  # of a step that failed, which are shown


def main(argv: Sequence[str]) -> None:
    """Run the steps.

    Raises:
        UsageError: --only names no step, or the checkout has changes.
        KpcError: a step failed, or the checkout changed meanwhile.
    """
    options = _parser().parse_args(argv)
    steps = _chosen(_steps(options), options.only)
    commit = provenance.commit()
    work = options.output / WORK / short_commit(commit)
    if options.plan:
        print(plan(steps, options.output, work, commit))
        return
    if not is_clean(commit) and not options.allow_dirty:
        remedy = f"the code is of commit {commit}: commit your changes"
        if commit == "unknown":
            remedy = "the code is of no commit: run it from a checkout of KPC in git"
        raise UsageError(
            f"{remedy}, so that records say what they measured; --allow-dirty measures all the same, and marks the "
            "records"
        )
    work.mkdir(parents=True, exist_ok=True)
    for folder in options.scene:  # so that commands, which records hold, name no place on this machine
        if not (work / folder.resolve().name).exists():
            (work / folder.resolve().name).symlink_to(folder.resolve(), target_is_directory=True)
    failed = run(steps, options.output, work, commit)
    records = sorted(options.output.glob("*.json"))
    for note in _foreign(records, commit):
        print(f"kpbench: {note}", file=sys.stderr)
    if records:
        from kpc.tools.bench.report import page  # needs matplotlib

        page.main([*map(str, records), "-o", str(options.output / "report.html")])
        print(f"python -m kpc.tools.bench.results {options.output}/*.json --into README.md docs/benchmarks.md")
    if failed:
        raise KpcError(f"{len(failed)} of {len(steps)} steps failed: {', '.join(failed)}; run again to go on")


def _parser() -> argparse.ArgumentParser:
    parser = cli.Parser(
        "kpbench suite", description="Measure all that kpbench can, from one commit; run again to go on."
    )
    parser.add_argument(
        "-o",
        "--output",
        type=cli.output_path,
        required=True,
        metavar="DIR",
        help="folder of the records; it is made if need be",
    )
    parser.add_argument(
        "--scene",
        type=cli.named_path,
        action="append",
        default=[],
        metavar="DATASET",
        help="measure on this folder instead of generated scenes, in as long as it takes; may be repeated",
    )
    parser.add_argument(
        "--only",
        type=lambda text: text.split(","),
        default=[],
        metavar="STEP,...",
        help="only steps whose names begin so, and what they need",
    )
    parser.add_argument("--quick", action="store_true", help="tiny scenes and few steps, to try whether all runs")
    parser.add_argument("--plan", action="store_true", help="print the steps with their expected minutes, and end")
    parser.add_argument(
        "--allow-dirty", action="store_true", help="measure code that no commit holds; records are marked, none is kept"
    )
    return parser


def _steps(options: argparse.Namespace) -> list[Step]:
    if not options.scene:
        return generated(QUICK if options.quick else HOUR)
    if options.quick:
        raise UsageError("--quick is about generated scenes; leave --scene out")
    names = [folder.resolve().name for folder in options.scene]
    if len({*names}) < len(names):
        raise UsageError("two scenes have one name, which is also that of their records; rename a folder")
    for folder in options.scene:
        if not folder.is_dir():
            raise UsageError(f"{folder}: no such folder")
    return [step for name in names for step in of_scene(name)]


def _chosen(steps: Sequence[Step], only: Sequence[str]) -> list[Step]:
    """Return the steps whose names begin as wanted, and those that they need, in order; all where nothing is wanted.

    Raises:
        UsageError: no step has such a name.
    """
    for prefix in only:
        if not any(step.name.startswith(prefix) for step in steps):
            raise UsageError(f"--only {prefix}: the steps are {', '.join(step.name for step in steps)}")
    names = {step.name for step in steps if not only or step.name.startswith(tuple(only))}
    for step in reversed(steps):
        if step.name in names:
            names |= {*step.needs}
    return [step for step in steps if step.name in names]


def plan(steps: Iterable[Step], output: Path, work: Path, commit: str) -> str:
    """Return the steps with their expected minutes on two cores and their states, a line each."""
    lines, left = [], 0.0
    for step in steps:
        reason = step.missing()
        state = "done" if is_done(step, output, work, commit) else "left out" if reason else "to do"
        left += step.minutes * (state == "to do")
        why = f"  ({reason})" if state == "left out" else ""
        lines.append(f"{step.minutes:5.1f} min  {step.name:<18} {state:<8} {shlex.join(step.command)}{why}")
    return "\n".join([*lines, f"{left:5.1f} min  to do on two cores, from commit {short_commit(commit)}"])


def is_clean(commit: str) -> bool:
    """Return whether a commit, as records state it, says all about the code."""
    return commit != "unknown" and not commit.endswith("+dirty")


def is_done(step: Step, output: Path, work: Path, commit: str) -> bool:
    """Return whether a step's records are there, from this command and commit, and so is what it makes."""
    if not is_clean(commit) or not all((work / made).exists() for made in step.makes):
        return False
    if not step.has_records:
        return True
    try:
        records = json.loads((output / step.file).read_text())
        return bool(records) and all(
            record["commit"] == commit and record["command"] == shlex.join(step.command) for record in records
        )
    except (OSError, ValueError, KeyError, TypeError):
        return False


def run(steps: Sequence[Step], output: Path, work: Path, commit: str) -> list[str]:
    """Run the steps that are not done; return the names of those that failed.

    Raises:
        KpcError: the checkout changed.
    """
    failed: list[str] = []
    left = sum(step.minutes for step in steps if not is_done(step, output, work, commit) and not step.missing())
    for number, step in enumerate(steps, 1):
        title = f"kpbench: {number} of {len(steps)}, {step.name}"
        if is_done(step, output, work, commit):
            print(f"{title}: done before", file=sys.stderr)
            continue
        reason = step.missing() or ", ".join(f"{name} failed" for name in step.needs if name in failed)
        if reason:
            print(f"{title}: left out, {reason}", file=sys.stderr)
            failed += [step.name] if not step.missing() else []
            continue
        print(f"{title}: about {step.minutes:g} min; all: {left:.0f} min", file=sys.stderr)
        started, spent = time.monotonic(), _processor_s()
        if not _run(step, output, work):
            failed.append(step.name)
        left -= step.minutes
        took, of_processors = time.monotonic() - started, _processor_s() - spent
        print(f"{title}: took {took / 60:.1f} min, {of_processors / 60:.1f} min of processors", file=sys.stderr)
        if (now := provenance.commit()) != commit:
            raise KpcError(f"the code changed from {commit} to {now} while {step.name} ran; run the suite again")
    return failed


def _run(step: Step, output: Path, work: Path) -> bool:
    """Run a step, with its log beside its files; return whether it succeeded."""
    log = work / f"{step.name}.log"
    with log.open("w") as file:
        done = subprocess.run([sys.executable, "-m", *step.module], cwd=work, stdout=file, stderr=file, check=False)
    if done.returncode:
        lines = log.read_text(errors="replace").splitlines()[-LOG_LINES:]
        print("\n".join([f"kpbench: {step.name} failed; {log} ends:", *lines]), file=sys.stderr)
        return False
    if step.has_records:
        with cli.atomic_write(output / step.file) as aside:
            shutil.copyfile(work / step.file, aside)
    return True


def _processor_s() -> float:
    """Return the seconds of processors that all steps so far took."""
    times = os.times()
    return times.children_user + times.children_system


def _foreign(records: Iterable[Path], commit: str) -> list[str]:
    """Return a note for each file of records from another commit."""
    notes = []
    for path in records:
        found = {record.get("commit") for record in json.loads(path.read_text())}
        if found != {commit}:
            others = ", ".join(sorted(short_commit(str(one)) for one in found - {commit}))
            notes.append(f"{path} is from commit {others}, not from this run")
    return notes
