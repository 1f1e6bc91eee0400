"""Which cores of the processor this process may use, as ros2_control takes it: nodes out of each other's way.

Two nodes that share a core push each other's code and numbers out of its caches a thousand times a second.
"""

from __future__ import annotations

import os
from collections.abc import Sequence

from flexmanip_ros.ros import threads


def take(cores: Sequence[int]) -> str:
    """Keep every thread of this process, and those made later, on these cores; none: change nothing.

    Returns '' or what the system refuses: all where it has none of them, else those it has not.
    """
    if not cores:
        return ''
    try:
        refused = threads.for_each(lambda thread: os.sched_setaffinity(thread, cores))
    except (ValueError, OverflowError) as error:  # not a number of a core on any machine
        return str(error)
    if refused:
        return refused
    missing = sorted(set(cores) - os.sched_getaffinity(0))
    return f'there is no {", ".join(map(str, missing))}' if missing else ''


def current() -> str:
    """Return the cores that this process may use, such as '0,1,3'; '' where the system does not tell."""
    try:
        return ','.join(str(core) for core in sorted(os.sched_getaffinity(0)))
    except (AttributeError, OSError):
        return ''
