"""Peak resident memory of this process since the last reset, from /proc on Linux and getrusage elsewhere."""

import resource
import sys
from pathlib import Path


def reset_peak_memory() -> None:
    """Reset the peak; where the system cannot (not Linux), it counts from the start of the process."""
    try:
        Path("/proc/self/clear_refs").write_text("5")  # man proc: 5 resets VmHWM
    except OSError:
        return


def peak_memory_bytes() -> int:
    """Peak resident memory since the last reset."""
    status = Path("/proc/self/status")
    if status.is_file():
        for line in status.read_text().splitlines():
            if line.startswith("VmHWM:"):
                return int(line.split()[1]) * 1024
    peak = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
    return peak if sys.platform == "darwin" else peak * 1024
