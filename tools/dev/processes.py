"""Worker processes."""

import multiprocessing
import os
import threading


def end_with_parent() -> None:
    """Make this worker process exit as soon as its parent does, even if the parent was killed.

    It is the initialiser of a process pool; a thread waits for the parent, so a long computation does not delay it.
    """
    parent = multiprocessing.parent_process()
    assert parent is not None

    def wait() -> None:
        parent.join()
        os._exit(1)

    threading.Thread(target=wait, daemon=True).start()
