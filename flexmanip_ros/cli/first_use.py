"""A word to the user while kernels are compiled, which a wheel does at the first use.

`make setup` and `colcon build` compile all kernels beforehand (`warm_up`); a wheel is only files. numba then compiles
each kernel when it is called first, and keeps it on disk beside the package or in the user's cache folder.
"""

from __future__ import annotations

import sys
import threading
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from multiprocessing.sharedctypes import Synchronized
from typing import Any

from numba.core import event

PATIENCE = 2.0
"""Duration of a compilation [s] from which on the user is told of it; a shorter one is not worth a line."""
WORDS = ('flexmanip_ros: compiling the kernels for this machine. It takes a minute or two, at the first use of each '
         'method after an installation.')


def tell() -> None:
    """Write ``WORDS`` on stderr."""
    print(WORDS, file=sys.stderr, flush=True)


class Listener(event.Listener):
    """Listener to numba's compilations of kernels that are not on disk; calls ``say`` once if one takes long."""

    def __init__(self, say: Callable[[], None] = tell) -> None:
        self._say = say
        self._depth = 0
        self._told = False
        self._timer: threading.Timer | None = None

    def on_start(self, event: Any) -> None:
        """Note the start of a compilation; the compilation of one kernel may contain that of another."""
        self._depth += 1
        if self._depth == 1 and not self._told:
            self._timer = threading.Timer(PATIENCE, self._tell)
            self._timer.daemon = True
            self._timer.start()

    def on_end(self, event: Any) -> None:
        """Note the end of a compilation."""
        self._depth -= 1
        if self._depth == 0 and self._timer is not None:
            self._timer.cancel()

    def _tell(self) -> None:
        self._told = True
        self._say()


@contextmanager
def announced(say: Callable[[], None] = tell) -> Iterator[None]:
    """Tell the user at most once, on stderr unless ``say`` does otherwise, that kernels are being compiled."""
    with event.install_listener('numba:compile', Listener(say)):
        yield


def announce_in_worker(told: Synchronized[bool]) -> None:
    """Do as ``announced`` in a worker process. The workers of a pool share ``told``, so only one tells the user."""
    def once() -> None:
        with told.get_lock():
            if told.value:
                return
            told.value = True
        tell()

    event.register('numba:compile', Listener(once))  # type: ignore[no-untyped-call]
