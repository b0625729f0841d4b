"""Schedules the tasks of a batch on Dask: a cluster on this machine, or one that runs."""

import contextlib
import logging
import os
import signal
import time
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import CancelledError
from dataclasses import dataclass, replace
from functools import cached_property
from multiprocessing import resource_tracker
from typing import Any

import dask
import psutil
from distributed import Client, Future, LocalCluster, as_completed, get_worker

from kpc.format.common import interrupts
from kpc.format.common.errors import KpcError
from kpc.tools.batch.jobs import Resources
from kpc.tools.batch.tasks import Outcome, Task
from kpc.tools.batch.working import Place, run

# Attempts at a task in all: a task that fails is tried once more, on any worker.
ATTEMPTS = 2
TOPIC = "kpbatch"
# A task whose worker is killed goes to another one; after so many killed workers it counts as failed.
KILLED_WORKERS = 5
# Memory that a task takes if its job does not say: kpenc on a clip of 300 frames.
USUAL_MEMORY = 2 << 30
CONNECT_S = 15
TRY_S = 5  # in a dry run
LISTEN_S = 0.5
# Seconds for which the resources of workers are not asked for again.
HELD_S = 1.0

Runner = Callable[[Task, Place, Callable[[dict[str, float]], None]], Outcome]


class ClusterError(KpcError):
    """The cluster cannot be reached, or was lost."""


@dataclass(frozen=True)
class Event:
    """What happens to a task.

    Attributes:
        task: that it happens to.
        kind: "waits", "runs", "retried", "done" or "failed".
        progress: of a task that runs: percent, seconds left, PSNR.
        outcome: of a task that has ended, or is tried again.
    """

    task: Task
    kind: str
    progress: dict[str, float] | None = None
    outcome: Outcome | None = None


def local_workers(resources: Resources) -> int:
    """Return how many tasks this machine holds at once, by its cores and its memory."""
    cores = len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1
    memory = psutil.virtual_memory().total
    return max(1, min(cores // resources.cores, memory // (resources.memory or USUAL_MEMORY)))


@contextlib.contextmanager
def local_cluster(workers: int, resources: Resources) -> Iterator[Client]:
    """Yield the client of a cluster on this machine, whose workers hold one task each."""
    held = {"cores": resources.cores, "gpus": resources.gpus}
    with dask.config.set({"distributed.scheduler.allowed-failures": KILLED_WORKERS}):
        with _without_ctrl_c():
            made = LocalCluster(
                n_workers=workers,
                threads_per_worker=1,
                memory_limit=None,
                resources=held,
                dashboard_address=":0",  # any port that is free
                silence_logs=logging.CRITICAL,
            )
        with made as cluster, Client(cluster) as client:
            try:
                yield client
            except KeyboardInterrupt:
                interrupts.heard()  # ending workers takes some seconds
                raise


@contextlib.contextmanager
def _without_ctrl_c() -> Iterator[None]:
    """Keep Ctrl-C from the threads that are started meanwhile, and from the processes that these start at any time.

    A terminal sends it to all processes: workers would print tracebacks, though they end with this process.
    """
    if not hasattr(signal, "pthread_sigmask"):  # on Windows
        yield
        return
    resource_tracker.ensure_running()  # which would permit SIGINT again to the thread that starts it
    before = signal.pthread_sigmask(signal.SIG_BLOCK, [signal.SIGINT])
    try:
        yield
    finally:
        signal.pthread_sigmask(signal.SIG_SETMASK, before)


@contextlib.contextmanager
def remote_cluster(address: str, timeout_s: float | None = None) -> Iterator[Client]:
    """Yield the client of a scheduler that runs; it must answer within `timeout_s`, CONNECT_S for None.

    Raises:
        ClusterError: there is none.
    """
    try:
        client = Client(address, timeout=CONNECT_S if timeout_s is None else timeout_s)
    except Exception as error:  # of any kind, if something else than Dask answers
        raise ClusterError(f"{address}: no Dask scheduler answers; start one with dask scheduler") from error
    logging.getLogger("distributed").setLevel(logging.CRITICAL)  # what matters of it is in our own errors
    with client:
        yield client


class Engine:
    """Runs tasks on a cluster, each after those that it needs, and reports what happens to them.

    Args:
        connect: returns the client of a cluster; called when there is something to do.
        place: where tasks are done.
        runner: does a task; `kpc.tools.batch.working.run`.
    """

    def __init__(self, connect: Callable[[], Client], place: Place, runner: Runner = run) -> None:
        self._connect, self._place, self._runner = connect, place, runner
        self._futures: dict[Future, Task] = {}
        self._waiting: list[Task] = []
        self._attempts: dict[str, int] = {}
        self._outcomes: dict[str, Outcome] = {}
        self._reports: list[tuple[float, dict[str, Any]]] = []
        self._held_before: list[dict[str, int]] = []
        self._held_at = float("-inf")

    @cached_property
    def _client(self) -> Client:
        client = self._connect()
        client.subscribe_topic(TOPIC, self._reports.append)
        return client

    @cached_property
    def _completed(self) -> as_completed:
        return as_completed(loop=self._client.loop)

    def add(self, tasks: Sequence[Task]) -> None:
        """Have tasks done; those that others must come before wait for them."""
        self._waiting += tasks

    def know(self, outcomes: dict[str, Outcome]) -> None:
        """Take tasks for done."""
        self._outcomes |= outcomes

    def events(self) -> Iterator[Event]:
        """Yield what happens until all tasks have ended; tasks may be added meanwhile.

        Raises:
            ClusterError: the scheduler is gone.
        """
        yield from self._start()
        while self._futures:
            yield from self._next()
            yield from self._start()

    def _start(self) -> Iterator[Event]:
        """Submit the tasks that can begin; yield those that have ended before they began."""
        waiting, self._waiting = self._waiting, []
        running = {task.key for task in self._futures.values()}
        for task in waiting:
            known = self._outcomes.get(task.key)
            before = [self._outcomes.get(key) for key in task.before]
            failed = next((one for one in before if one is not None and not one.is_done), None)
            if known is not None and known.is_done:
                yield Event(task, "done", outcome=known)
            elif failed is not None:
                yield Event(task, "failed", outcome=self._ended(replace(failed, key=task.key)))
            elif None in before or task.key in running:
                self._waiting.append(task)
            else:
                self._submit(task)
                running.add(task.key)
                yield Event(task, "waits")
        if self._waiting and not self._futures:
            yield from self._start()

    def _submit(self, task: Task) -> None:
        attempt = self._attempts[task.key] = self._attempts.get(task.key, 0) + 1
        future = self._client.submit(
            _work,
            self._runner,
            task,
            self._place,
            key=f"{task.key}-{attempt}",
            pure=False,
            resources=self._resources(task.resources),
        )
        self._futures[future] = task
        self._completed.add(future)

    def _held(self) -> list[dict[str, int]]:
        """Return the resources that each worker says to have, as they were a second ago or later."""
        now = time.monotonic()
        if now - self._held_at > HELD_S:
            workers = self._client.scheduler_info(n_workers=-1)["workers"].values()
            self._held_before = [worker.get("resources", {}) for worker in workers]
            self._held_at = now
        return self._held_before

    def _resources(self, wanted: Resources) -> dict[str, int] | None:
        """Return what to ask of a worker: only of what workers say that they have.

        Raises:
            ClusterError: no worker has as much.
        """
        held = self._held()
        named = {name for resources in held for name in resources}
        asked = {"cores": wanted.cores, "memory": wanted.memory, "gpus": wanted.gpus}
        asked = {name: amount for name, amount in asked.items() if name in named and amount}
        if held and not any(all(one.get(name, 0) >= amount for name, amount in asked.items()) for one in held):
            words = ",".join(f"{name}={amount}" for name, amount in asked.items())
            raise ClusterError(f'no worker has what a job takes; start one with dask worker --resources "{words}"')
        return asked or None

    def _next(self) -> Iterator[Event]:
        """Wait a little, and yield what has happened."""
        done = self._wait()
        reports, self._reports[:] = list(self._reports), []
        latest = {report["key"]: report for _, report in reports}
        for task in self._futures.values():
            if task.key in latest:
                yield Event(task, "runs", latest[task.key])
        for future in done:
            if future.status in ("lost", "pending"):  # its worker was killed, and another does the task again
                self._completed.add(future)
                continue
            task = self._futures.pop(future)
            outcome = self._outcome_of(future, task)
            if not outcome.is_done and self._attempts[task.key] < ATTEMPTS:
                yield Event(task, "retried", outcome=outcome)
                self._submit(task)
            else:
                yield Event(task, "done" if outcome.is_done else "failed", outcome=self._ended(outcome))

    def _wait(self) -> list[Future]:
        deadline = time.monotonic() + LISTEN_S
        while time.monotonic() < deadline:
            if self._completed.has_ready():
                return list(self._completed.next_batch(block=False))
            if self._client.status not in ("running", "connecting"):
                raise ClusterError("the scheduler is gone; start it, and run the same command to go on")
            time.sleep(0.01)
        return []

    def _outcome_of(self, future: Future, task: Task) -> Outcome:
        """Return the outcome of a future that has ended.

        Raises:
            ClusterError: the scheduler, or its client, has given it up.
        """
        with contextlib.suppress(CancelledError):  # the connection may break after the status is known
            if future.status == "finished":
                found: Outcome = future.result()
                return found
            if future.status == "error":
                return Outcome(task.key, False, {}, " ".join(str(future.exception()).split()))
        raise ClusterError("the scheduler has lost its tasks; run the same command to go on")

    def _ended(self, outcome: Outcome) -> Outcome:
        self._outcomes[outcome.key] = outcome
        return outcome


def count_workers(address: str, wanted: Sequence[Resources]) -> int:
    """Return how many workers a scheduler has.

    Raises:
        ClusterError: it does not answer within TRY_S, or no worker has some of the wanted resources.
    """
    with remote_cluster(address, TRY_S) as client:
        engine = Engine(lambda: client, Place(""))
        for resources in wanted:
            engine._resources(resources)
        return len(engine._held())


def _work(runner: Runner, task: Task, place: Place) -> Outcome:
    """Do a task on a worker, and report to the client how far it has come."""
    worker = get_worker()
    last: dict[str, float] = {}

    def report(progress: dict[str, float]) -> None:
        nonlocal last
        if progress != last:
            last = progress
            worker.log_event(TOPIC, {"key": task.key, **progress})

    worker.log_event(TOPIC, {"key": task.key})
    return runner(task, place, report)
