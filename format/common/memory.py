"""How much memory this process takes."""

import re
import sys
from pathlib import Path


def peak_memory_bytes() -> int:
    """The most memory this process has had resident so far."""
    try:  # unlike ru_maxrss, not inherited from the process that started this one
        status = Path("/proc/self/status").read_text()
        return 1024 * int(re.findall(r"^VmHWM:\s*(\d+) kB", status, re.MULTILINE)[0])
    except (OSError, IndexError):
        import resource  # Unix only

        peak = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
        return peak if sys.platform == "darwin" else 1024 * peak
