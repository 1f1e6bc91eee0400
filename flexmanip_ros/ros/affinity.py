"""Which cores of the processor this process may use, as ros2_control takes it: nodes out of each other's way.

Two nodes that share a core push each other's code and numbers out of its caches a thousand times a second.
"""

from __future__ import annotations

import contextlib
import os
from collections.abc import Sequence


def take(cores: Sequence[int]) -> str:
    """Keep every thread of this process, and those made later, on these cores; none: change nothing.

    Returns '' or what the system refuses: all where it has none of them, else those it has not.
    """
    if not cores:
        return ''
    try:
        for thread in os.listdir('/proc/self/task'):
            with contextlib.suppress(ProcessLookupError):  # it has ended meanwhile
                os.sched_setaffinity(int(thread), cores)
        missing = sorted(set(cores) - os.sched_getaffinity(0))
    except OSError as error:
        return error.strerror or str(error)
    except (ValueError, OverflowError) as error:  # not a number of a core on any machine
        return str(error)
    except AttributeError:
        return 'not on this system'
    return f'there is no {", ".join(map(str, missing))}' if missing else ''


def current() -> str:
    """Return the cores that this process may use, such as '0,1,3'; '' where the system does not tell."""
    try:
        return ','.join(str(core) for core in sorted(os.sched_getaffinity(0)))
    except (AttributeError, OSError):
        return ''
