"""The tasks of a batch: what workers do, and what of it is done already.

A job is a task that encodes; a job in groups is a task that prepares, one that encodes for each group, and one that
joins them. How many groups there are is known once the clip has been looked at, so those tasks come later.
"""

from collections import Counter
from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import Any

from kpc.tools.batch.addresses import address_of, code_address, source_address
from kpc.tools.batch.jobs import Job, Resources
from kpc.tools.batch.store import RESULT, Store

PREPARE, ENCODE, JOIN = "prepare", "encode", "join"


@dataclass(frozen=True)
class Task:
    """What a worker does in one go.

    Attributes:
        key: address of the result.
        name: for people.
        job: name of the job whose result it is, or a part of.
        kind: PREPARE, ENCODE or JOIN.
        source: path or address of what is encoded.
        words: options of kpenc.
        before: keys of the tasks that must be done before; a JOIN joins their results, an ENCODE begins with what a
            PREPARE left in its work folder.
        resources: that it takes.
        shares_source: whether other tasks have the same source, so that its decoded pixels are kept for them.
    """

    key: str
    name: str
    job: str
    kind: str
    source: str = ""
    words: tuple[str, ...] = ()
    before: tuple[str, ...] = ()
    resources: Resources = field(default_factory=Resources)
    shares_source: bool = False


@dataclass(frozen=True)
class Outcome:
    """What became of a task.

    Attributes:
        key: of the task.
        is_done: whether its result is in the store.
        figures: what was measured.
        error: what went wrong: one line for people, and the last lines of the log.
        seconds: that it took.
        worker: that did it; empty if it was done before.
    """

    key: str
    is_done: bool
    figures: dict[str, Any] = field(default_factory=dict)
    error: str = ""
    seconds: float = 0.0
    worker: str = ""


def first_tasks(jobs: Sequence[Job]) -> list[Task]:
    """Return the tasks with which jobs begin: one for each."""
    counts = Counter(job.source for job in jobs)
    return [_prepare(job) if job.group else _encode(job, counts[job.source] > 1) for job in jobs]


def tasks_of_groups(job: Job, count: int) -> list[Task]:
    """Return the tasks that follow once it is known how many groups the clip of a job has; the last one joins them."""
    prepared = _prepare(job).key
    groups = [
        Task(
            key=_address(job, f"group {number}"),
            name=f"{job.name} group {number}",
            job=job.name,
            kind=ENCODE,
            source=job.source,
            words=(*job.options, f"--only={number}"),
            before=(prepared,),
            resources=job.resources,
            shares_source=True,
        )
        for number in range(count)
    ]
    keys = tuple(task.key for task in groups)
    return [*groups, Task(_address(job, "join"), f"{job.name} joined", job.name, JOIN, before=keys)]


def done_before(store: Store) -> dict[str, Outcome]:
    """Return the outcomes of the tasks whose results are in the store."""
    keys = [name.partition("/")[0] for name in store.names(f"*/{RESULT}")]
    return {key: Outcome(key, True, store.get_json(f"{key}/{RESULT}")) for key in keys}


def is_last(task: Task, jobs: Sequence[Job]) -> bool:
    """Return whether the result of a task is that of its job."""
    job = next(job for job in jobs if job.name == task.job)
    return task.kind == (JOIN if job.group else ENCODE)


def _encode(job: Job, shares_source: bool) -> Task:
    key = _address(job, ENCODE)
    return Task(key, job.name, job.name, ENCODE, job.source, job.options, (), job.resources, shares_source)


def _prepare(job: Job) -> Task:
    key = _address(job, PREPARE)
    name = f"{job.name} prepared"
    return Task(key, name, job.name, PREPARE, job.source, job.options, (), job.resources, shares_source=True)


def _address(job: Job, part: str) -> str:
    return address_of(code_address(), source_address(job.source), sorted(job.options), part)
