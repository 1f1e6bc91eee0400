"""Real-time priority of this process, as ros2_control takes it: a sample is worked on when it comes.

With ordinary scheduling a woken thread may wait for milliseconds behind whatever else computes.
"""

from __future__ import annotations

import contextlib
import os

from flexmanip_ros.ros import threads

LOWEST, HIGHEST = 0, 99


def take(priority: int) -> str:
    """Give every thread of this process SCHED_FIFO at ``priority``; return '' or why the system refuses.

    Threads made later and child processes have ordinary scheduling: long work belongs to them. 0 changes
    nothing.
    """
    if priority == 0:
        return ''
    return threads.for_each(lambda thread: _set(thread, priority))


def join(priority: int) -> None:
    """Give the calling thread SCHED_FIFO just below ``priority``, for a process that has it.

    For a thread that the others will wait for, but not at once.
    """
    if priority > 0:
        with contextlib.suppress(AttributeError, OSError):
            _set(0, max(priority - 1, 1))


def _set(thread: int, priority: int) -> None:
    os.sched_setscheduler(thread, os.SCHED_FIFO | os.SCHED_RESET_ON_FORK, os.sched_param(priority))


def current() -> int:
    """Return the real-time priority of the calling thread, 0 with ordinary scheduling."""
    try:
        return os.sched_getparam(0).sched_priority
    except (AttributeError, OSError):
        return 0
