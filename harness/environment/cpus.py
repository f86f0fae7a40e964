"""Order in which the CPUs of a machine are used for measurements."""

from __future__ import annotations

from collections.abc import Iterable
from functools import cache
from pathlib import Path

_CPU = Path("/sys/devices/system/cpu")


def fastest_first(usable: Iterable[int]) -> list[int]:
    """Sort CPUs by decreasing maximal frequency, then by decreasing number.

    On hybrid processors, the CPUs with the largest numbers are often slow.

    usable : numbers of CPUs, such as ``os.sched_getaffinity(0)``
    """
    return sorted(usable, key=lambda cpu: (_max_frequency(cpu), cpu), reverse=True)


@cache
def _max_frequency(cpu: int) -> int:
    """Return the maximal frequency of a CPU in kHz; 0 if it is unknown."""
    try:
        return int((_CPU / f"cpu{cpu}/cpufreq/cpuinfo_max_freq").read_text())
    except (OSError, ValueError):
        return 0
