"""How deep the processor's cores may sleep between two samples, asked of Linux (PM QoS).

A core that slept deeply wakes late, and slowly: what takes 0.03 ms in a loop takes 0.1 ms after it. The
request holds for the whole machine, for as long as the file is open.
"""

from __future__ import annotations

import os
import struct

DEVICE = '/dev/cpu_dma_latency'
UNASKED = -1
LONGEST = 100_000


class WakeLatency:
    """A request for cores that wake within ``microseconds``; UNASKED: none is made."""

    def __init__(self, microseconds: int, device: str = DEVICE) -> None:
        self._microseconds = microseconds
        self._device = device
        self._file: int | None = None

    @property
    def current(self) -> int:
        """What is asked for now [us]; UNASKED while nothing is."""
        return UNASKED if self._file is None else self._microseconds

    def hold(self) -> str:
        """Make the request, if it is not made already; return '' or why the system refuses it."""
        if self._microseconds == UNASKED or self._file is not None:
            return ''
        file = None
        try:
            file = os.open(self._device, os.O_WRONLY | getattr(os, 'O_CLOEXEC', 0))
            os.write(file, struct.pack('=i', self._microseconds))
        except OSError as error:
            if file is not None:
                os.close(file)
            return error.strerror or str(error)
        self._file = file
        return ''

    def release(self) -> None:
        """Let the cores sleep as they like again."""
        if self._file is not None:
            os.close(self._file)
            self._file = None
