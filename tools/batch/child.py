"""A process that runs a command for a worker, and ends as soon as the worker does.

python -m kpc.tools.batch.child PARENT kpenc|kpjoin|prepare ARGUMENT...
"""

import os
import sys
import threading
import time
from collections.abc import Callable

from kpc import commands
from kpc.format.common import cli

POLL_S = 0.5


def main(argv: list[str]) -> int:
    """Run a command and return its exit code."""
    parent, name, *arguments = argv
    threading.Thread(target=_end_with, args=(int(parent),), daemon=True).start()
    runs: dict[str, Callable[[list[str]], int]] = {
        "kpenc": commands.kpenc,
        "kpjoin": commands.kpjoin,
        "prepare": lambda words: cli.run(_prepare, "kpenc", words),
    }
    return runs[name](arguments)


def _prepare(argv: list[str]) -> None:
    """Look at a dataset as kpenc would, cameras of bare videos included, and print how many groups its clip has."""
    from kpc.encoder.cli.encode_groups import plan_groups
    from kpc.encoder.cli.options import parse
    from kpc.encoder.cli.read_dataset import read_dataset
    from kpc.encoder.cli.work_folder import make_work_folder

    options, *_ = parse(argv)
    make_work_folder(options.work_dir, options.cache)
    dataset = read_dataset(options)
    cli.print_json({"groups": len(plan_groups(options, dataset.clip)), "frames": dataset.clip.frame_count})


def _end_with(parent: int) -> None:
    """End this process once its parent is gone, even if it was killed."""
    while os.getppid() == parent:
        time.sleep(POLL_S)
    os._exit(1)


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
