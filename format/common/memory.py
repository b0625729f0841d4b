"""Memory: use of this process, and the budget of a decoded scene."""

import re
import sys
from pathlib import Path

# Bytes that a decoded scene may take where the caller gives no budget.
DEFAULT_BUDGET = 2 << 30


def peak_memory_bytes() -> int:
    """Return the largest resident set size of this process so far."""
    try:  # Unlike ru_maxrss, VmHWM is not inherited from the parent process.
        status = Path("/proc/self/status").read_text()
        return 1024 * int(re.findall(r"^VmHWM:\s*(\d+) kB", status, re.MULTILINE)[0])
    except (OSError, IndexError):
        import resource  # absent on Windows

        peak = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
        return peak if sys.platform == "darwin" else 1024 * peak
