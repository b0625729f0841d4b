"""Processes that work for another one."""

import multiprocessing
import os
import threading


def end_with_parent() -> None:
    """The initialiser of a pool's processes: end when the one that started them is gone, killed, say, however deep in work."""
    parent = multiprocessing.parent_process()
    assert parent is not None

    def wait() -> None:
        parent.join()
        os._exit(1)

    threading.Thread(target=wait, daemon=True).start()
