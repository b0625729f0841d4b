"""Simulate kpbatch on more machines than there are, with workers that fail.

    python -m kpc.tools.batch.simulation                                    # 1,000 scenes on 100 workers
    python -m kpc.tools.batch.simulation --workers 1000 --failures-h 24
    python -m kpc.tools.batch.simulation --plot docs/cluster.svg            # the limits, over numbers of workers

A discrete simulation: workers fetch a scene over a link that all share, train it, leave a checkpoint each minute, and
fail at random moments; a scene goes on from its last checkpoint on the next worker that is free. The scheduler takes a
little time for each message, one at a time. The plot needs matplotlib.
"""

import heapq
import sys
from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

from kpc.format.common import cli

# Share of the link of the store that checkpoints may take, at most.
MOST_SHARE = 0.8
SIZES = (1, 3, 10, 30, 100, 300, 1000, 3000)  # workers of the plot
SCENES_PER_WORKER = 10  # of the plot


@dataclass(frozen=True)
class Model:
    """What the simulation assumes; docs/cluster.md says where the figures come from.

    Attributes:
        scenes, workers: how many.
        scene_s: mean time of a scene on a worker, and `spread` its standard deviation over that; log-normal.
        input_bytes: that a worker fetches for a scene; `link` is what the store sends and takes in a second, in all.
        checkpoint_s: between checkpoints of `checkpoint_bytes` each.
        failure_s: mean time between failures of a worker; exponential. `restart_s` until it is back.
        bad: share of scenes that fail by themselves, at the end, and are tried once more.
        message_s: processor time of the scheduler for a message; a scene has `messages`, and one each `report_s`.
    """

    scenes: int = 1000
    workers: int = 100
    scene_s: float = 900.0
    spread: float = 0.5
    input_bytes: float = 50e6
    link: float = 100e6
    checkpoint_s: float = 60.0
    checkpoint_bytes: float = 25e6
    failure_s: float = 24 * 3600.0
    restart_s: float = 60.0
    bad: float = 0.01
    message_s: float = 0.002
    messages: int = 6
    report_s: float = 10.0


@dataclass
class Result:
    """What a simulation finds.

    Attributes:
        seconds: until the last scene has ended.
        efficiency: time of all scenes once, over the time of all workers.
        redone_s: work that was done twice because of failures of workers.
        failures: of workers.
        link: mean share that is used of what checkpoints leave of the store's link.
        scheduler: mean share of the scheduler's time that is used.
    """

    seconds: float
    efficiency: float
    redone_s: float
    failures: int
    link: float
    scheduler: float


def simulate(model: Model, seed: int = 0) -> Result:
    """Simulate a batch; the same seed gives the same result."""
    rng = np.random.default_rng(seed)
    sigma = np.sqrt(np.log1p(model.spread**2))
    lengths = rng.lognormal(np.log(model.scene_s) - sigma**2 / 2, sigma, model.scenes)
    waiting = [(float(length), 0.0, bool(rng.random() < model.bad)) for length in lengths]  # length, done, fails
    waiting.reverse()
    free = [(0.0, worker) for worker in range(model.workers)]  # when each worker is free
    heapq.heapify(free)
    back: list[tuple[float, tuple[float, float, bool]]] = []  # scenes whose worker failed, and when
    # Checkpoints take their share of the link all the time; where it cannot hold them, they become rarer.
    interval = max(model.checkpoint_s, model.workers * model.checkpoint_bytes / (MOST_SHARE * model.link))
    for_scenes = model.link - model.workers * model.checkpoint_bytes / interval
    link_free = scheduler_free = redone = sent = messages_s = ended = 0.0
    failures = 0
    while waiting or back:
        now, worker = heapq.heappop(free)
        if back and (back[0][0] <= now or not waiting):
            when, (length, done, fails) = heapq.heappop(back)
            now = max(now, when)
        else:
            length, done, fails = waiting.pop()
        # The scheduler hands out the scene; the store sends it over its link, one scene after the other.
        scheduler_free = max(scheduler_free, now) + model.messages * model.message_s
        messages_s += model.messages * model.message_s
        moved = model.input_bytes + (model.checkpoint_bytes if done else 0.0)
        link_free = max(link_free, scheduler_free) + moved / for_scenes
        sent += moved
        begun, left = link_free, length - done
        fails_after = rng.exponential(model.failure_s)
        worked = min(left, fails_after)
        kept = worked // interval * interval
        messages_s += worked / model.report_s * model.message_s
        finish = begun + worked
        ended = max(ended, finish)
        if fails_after < left:
            failures += 1
            redone += worked - kept
            heapq.heappush(back, (finish, (length, done + kept, fails)))
            finish += model.restart_s
        elif fails:
            heapq.heappush(back, (finish, (length, 0.0, False)))
        heapq.heappush(free, (finish, worker))
    busy = ended * model.workers
    return Result(ended, float(lengths.sum()) / busy, redone, failures, sent / for_scenes / ended, messages_s / ended)


def plot(model: Model, path: Path) -> None:
    """Draw efficiency, and how busy link and scheduler are, over numbers of workers."""
    from matplotlib import rcParams
    from matplotlib.figure import Figure

    rcParams["svg.fonttype"], rcParams["svg.hashsalt"] = "none", "kpc"
    found = [simulate(replace(model, workers=size, scenes=SCENES_PER_WORKER * size)) for size in SIZES]
    figure = Figure((6.4, 3.6), layout="constrained")
    axes = figure.subplots()
    for label, values in (
        ("efficiency", [one.efficiency for one in found]),
        ("link of the store, beside checkpoints", [one.link for one in found]),
        ("scheduler", [one.scheduler for one in found]),
    ):
        axes.plot(SIZES, [100 * value for value in values], marker=".", label=label)
    axes.set(xscale="log", xlabel=f"workers, {SCENES_PER_WORKER} scenes each", ylabel="%", ylim=(0, 105))
    axes.grid(alpha=0.3)
    axes.legend(frameon=False)
    metadata = {"Date": None} if path.suffix == ".svg" else {}
    figure.savefig(path, metadata=metadata)


def main(argv: Sequence[str] | None = None) -> int:
    """Run the command and return its exit code."""
    return cli.run(_command, "simulation", None if argv is None else list(argv))


def _command(argv: list[str]) -> None:
    parser = cli.Parser(prog="simulation", description="Simulate kpbatch on many workers that fail.")
    parser.add_argument("--scenes", type=int, default=Model.scenes, help="default: %(default)s")
    parser.add_argument("--workers", type=int, default=Model.workers, help="default: %(default)s")
    parser.add_argument("--scene-s", type=float, default=Model.scene_s, help="mean time of a scene (%(default)s)")
    parser.add_argument("--link", type=cli.byte_count, default=Model.link, help="of the store, a second (%(default)s)")
    parser.add_argument("--failures-h", type=float, default=24.0, help="hours between failures of a worker")
    parser.add_argument("--plot", type=cli.output_file(".svg", ".png"), metavar="FILE", help="draw it for many sizes")
    given = parser.parse_args(argv)
    if min(given.scenes, given.workers, given.scene_s, given.link, given.failures_h) <= 0:
        parser.error("all numbers must be positive")
    model = Model(
        given.scenes, given.workers, given.scene_s, link=float(given.link), failure_s=3600.0 * given.failures_h
    )
    if given.plot is not None:
        plot(model, given.plot)
    found = simulate(model)
    print(
        f"{model.scenes:,} scenes on {model.workers:,} workers: {found.seconds / 3600:.2f} h, efficiency "
        f"{found.efficiency:.1%}; {found.failures:,} failures of workers, {found.redone_s / 3600:.2f} h done twice; "
        f"link beside checkpoints {found.link:.1%} and scheduler {found.scheduler:.1%} busy"
    )


if __name__ == "__main__":
    sys.exit(main())
