"""kpbatch: encode many scenes, and code many files, on this machine or on many.

    kpbatch jobs.toml                                    the scenes, options and grids of a file
    kpbatch take01/ take02/ -o out/ -- --preset fast     folders, all with the same options of kpenc
    kpbatch jobs.toml --scheduler tcp://head:8786        on a Dask cluster that runs

What is done is not done again: run the same command after an interruption, or with more scenes.
"""

import argparse
import contextlib
import sys
from collections.abc import Sequence
from importlib.util import find_spec
from pathlib import Path
from urllib.parse import urlsplit

from kpc.format.common import cli
from kpc.format.common.errors import KpcError, UsageError
from kpc.format.common.text import counted, notice
from kpc.tools.batch.jobs import (
    ADDRESS,
    Batch,
    FaultyBatch,
    Job,
    Resources,
    check_results,
    jobs_of_folders,
    memory_size,
    read_jobs,
    resolve,
)
from kpc.tools.batch.store import Store
from kpc.tools.batch.summary import SHARED, check_report, print_plan, print_summary, publish, write_report
from kpc.tools.batch.tasks import PREPARE, Outcome, done_before, first_tasks, is_last, tasks_of_groups


class BatchError(KpcError):
    """Some jobs failed."""


def main(argv: list[str] | None = None) -> int:
    """Run the command and return its exit code."""
    return cli.run(_command, "kpbatch", argv)


def _command(argv: list[str]) -> None:
    options, words = _parse(argv)
    try:
        batch = _batch(options, words)
    except FaultyBatch as error:
        *others, last = error.faults
        for fault in others:
            cli.print_error("kpbatch", fault)
        raise UsageError(last) from error
    for place, option in (batch.output, "-o"), (None if options.scheduler else options.scratch, "--scratch"):
        if place is not None and not ADDRESS.match(place):
            cli.check_writable(Path(place), is_folder=True, option=option)
    shared = f"{batch.output.rstrip('/')}/{SHARED}"
    store, output = (Store(place, make=not options.dry_run) for place in (shared, batch.output))
    check_report(output)
    first, known = first_tasks(batch.jobs), done_before(store)
    if options.dry_run:
        print_plan(first, known, options.json)
        if options.scheduler:
            _try_scheduler(options.scheduler, batch.jobs)
        return
    ended = _run(batch.jobs, shared, known, options)
    failed = publish(batch.jobs, ended, store, output)
    print_summary(batch.jobs, ended, options.json)
    write_report(batch.jobs, ended, output)
    if failed:
        raise BatchError(
            f"{failed} of {counted(len(batch.jobs), 'job')} failed; run the same command to try them again"
        )


def _run(
    jobs: Sequence[Job], shared: str, known: dict[str, Outcome], options: argparse.Namespace
) -> dict[str, Outcome]:
    """Do what is not done, and return the outcomes of jobs by their names."""
    from kpc.tools.batch import engine as scheduling  # Dask takes a second to load, which --help can do without
    from kpc.tools.batch.page import Page
    from kpc.tools.batch.scratch import Scratch
    from kpc.tools.batch.working import Place

    by_name, ended = {job.name: job for job in jobs}, {}
    most = Resources(
        max(job.resources.cores for job in jobs),
        max(job.resources.memory for job in jobs),
        max(job.resources.gpus for job in jobs),
    )
    with contextlib.ExitStack() as stack:

        def connect() -> scheduling.Client:
            if options.scheduler:
                client = stack.enter_context(scheduling.remote_cluster(options.scheduler))
            else:
                workers = options.workers or scheduling.local_workers(most)
                client = stack.enter_context(scheduling.local_cluster(workers, most))
            if find_spec("bokeh") is not None:  # which draws it
                notice(f"Dask's dashboard: {client.dashboard_link}")
            return client

        engine, page = scheduling.Engine(connect, Place(shared, options.scratch or "")), Page(options.json)
        engine.know(known)
        engine.add(first_tasks(jobs))
        for event in engine.events():
            page.show(event)
            if event.kind not in ("done", "failed") or event.outcome is None:
                continue
            if is_last(event.task, jobs) or event.kind == "failed":
                ended[event.task.job] = event.outcome
            elif event.task.kind == PREPARE:
                engine.add(tasks_of_groups(by_name[event.task.job], event.outcome.figures["groups"]))
        page.redraw()
    if not options.scheduler:
        Scratch(options.scratch or "").tidy(kept_s=0)
    return ended


def _batch(options: argparse.Namespace, words: Sequence[str]) -> Batch:
    """Return the jobs that the command line names."""
    first = Path(options.sources[0])
    if first.suffix == ".toml":
        if len(options.sources) > 1 or words:
            raise UsageError(f"{first}: names scenes and options itself; drop what else is given")
        return read_jobs(first, options.output, reads_files=options.dry_run)
    if options.output is None:
        raise UsageError("-o names the folder of the results; give for example -o out/")
    resources = Resources(options.cores, options.memory or 0)
    jobs = jobs_of_folders(options.sources, words, resources, reads_files=options.dry_run)
    batch = Batch(jobs, resolve(options.output, Path()))
    check_results(batch)
    return batch


def _try_scheduler(address: str, jobs: Sequence[Job]) -> None:
    """Say how many workers a scheduler has.

    Raises:
        ClusterError: it does not answer, or no worker has what a job takes.
    """
    from kpc.tools.batch.engine import count_workers

    count = count_workers(address, [job.resources for job in jobs])
    notice(f"kpbatch: {address}: the scheduler answers, and has {counted(count, 'worker')}")


def _parse(argv: list[str]) -> tuple[argparse.Namespace, list[str]]:
    """Return the options, and those of kpenc behind --."""
    parser = cli.Parser(
        prog="kpbatch",
        description="Encode many scenes, and code many files, on this machine or on a Dask cluster. What is done is "
        "not done again.",
        epilog="Options of kpenc for folders follow after --, for example: kpbatch takes/* -o out/ -- --preset fast",
    )
    cli.add_version_option(parser)
    parser.add_argument(
        "sources",
        nargs="+",
        type=cli.file_name,
        metavar="JOBS.toml|SOURCE",
        help="a file of jobs; or folders of videos and .kpc files",
    )
    parser.add_argument("-o", "--output", type=cli.file_name, metavar="OUT", help="folder or address of the results")
    parser.add_argument(
        "--scheduler",
        type=_scheduler,
        metavar="tcp://HOST:PORT",
        help="a Dask scheduler that runs, in place of workers on this machine",
    )
    parser.add_argument("--workers", type=_count, help="jobs at once on this machine (default: by cores and memory)")
    parser.add_argument("--cores", type=_count, default=1, help="of each job, for folders (default: %(default)s)")
    parser.add_argument("--memory", type=memory_size, metavar="3GB", help="of each job, for folders")
    parser.add_argument(
        "--scratch", type=cli.output_name, metavar="DIR", help="folder of workers for what they work on"
    )
    parser.add_argument("--dry-run", action="store_true", help="only check all jobs and files, and list what is done")
    parser.add_argument("--json", action="store_true", help="print a line of JSON for each event, and the results")
    split = argv.index("--") if "--" in argv else len(argv)
    return parser.parse_args(argv[:split]), argv[split + 1 :]


def _scheduler(text: str) -> str:
    """Parse the address of a Dask scheduler, which may lack tcp://."""
    try:
        parts = urlsplit(text if ADDRESS.match(text) else f"tcp://{text}")
        is_address = parts.hostname is not None and parts.port is not None
    except ValueError:
        is_address = False
    if not is_address:
        raise argparse.ArgumentTypeError(f"{text!r} is no address of a scheduler, such as tcp://head:8786")
    return text


def _count(text: str) -> int:
    return cli.whole_number(text, 1, 4096)


if __name__ == "__main__":
    sys.exit(main())
