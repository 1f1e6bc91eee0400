"""Asking the system for something for every thread of this process."""

from __future__ import annotations

import contextlib
import os
from collections.abc import Callable


def for_each(ask: Callable[[int], object]) -> str:
    """Call ``ask`` with each thread's number; return '' or why the system refuses."""
    try:
        for thread in os.listdir('/proc/self/task'):
            with contextlib.suppress(ProcessLookupError):  # it has ended meanwhile
                ask(int(thread))
    except OSError as error:
        return error.strerror or str(error)
    except AttributeError:
        return 'not on this system'
    return ''
