"""What a node says about itself once a second: rates, losses and callback times."""

from __future__ import annotations

import math
import time
from collections.abc import Mapping
from dataclasses import dataclass, field
from types import TracebackType
from typing import Any

import numpy as np
from builtin_interfaces.msg import Time
from diagnostic_msgs.msg import DiagnosticArray, DiagnosticStatus, KeyValue

OK = 0
WARN = 1
ERROR = 2
STALE = 3
_SEVERITY = (OK, WARN, STALE, ERROR)
"""Silence is told before a warning, a known error before silence."""


@dataclass
class Report:
    """One diagnostic entry. ``worse`` only ever raises the level; its words are joined."""

    values: dict[str, Any] = field(default_factory=dict)
    level: int = OK
    words: list[str] = field(default_factory=list)

    def worse(self, level: int, words: str) -> None:
        """Note a problem."""
        self.level = max(self.level, level, key=_SEVERITY.index)
        self.words.append(words)

    def message(self, node_name: str, stamp: Time) -> DiagnosticArray:
        """Return the entry as it goes out on /diagnostics."""
        status = DiagnosticStatus(
            level=bytes([self.level]), name=f'{node_name}: status', message='; '.join(self.words) or 'ok',
            hardware_id='flexmanip_ros',
            values=[KeyValue(key=key, value=text(value)) for key, value in self.values.items()])
        array = DiagnosticArray(status=[status])
        array.header.stamp = stamp
        return array


def text(value: Any) -> str:
    """Return a value as a diagnostic shows it: short, and 'unknown' where there is no number."""
    if isinstance(value, float):
        return f'{value:.6g}' if math.isfinite(value) else 'unknown'
    return str(value)


class Meter:
    """Counts and times the runs of a callback; ``with meter:`` around its body."""

    def __init__(self) -> None:
        self.total = 0
        self._times_ns: list[int] = []
        self._entered_ns = 0
        self._window_ns = time.monotonic_ns()
        self._worst_p99_us = math.nan

    def __enter__(self) -> Meter:
        self._entered_ns = time.perf_counter_ns()
        return self

    def __exit__(self, kind: type[BaseException] | None, error: BaseException | None,
                 trace: TracebackType | None) -> None:
        self._times_ns.append(time.perf_counter_ns() - self._entered_ns)
        self.total += 1

    def idle_s(self) -> float:
        """Return the seconds since the callback last began."""
        return (time.perf_counter_ns() - self._entered_ns) * 1e-9

    def window(self) -> Mapping[str, float]:
        """Return rate [Hz] and callback time [us] since the last call, and start a new window."""
        now = time.monotonic_ns()
        seconds = max(now - self._window_ns, 1) * 1e-9
        times_us = np.array(self._times_ns, dtype=np.float64) * 1e-3
        self._times_ns, self._window_ns = [], now
        some = times_us.size > 0
        p99_us = float(np.percentile(times_us, 99)) if some else math.nan
        self._worst_p99_us = float(np.fmax(self._worst_p99_us, p99_us))
        return {
            'rate_hz': times_us.size / seconds,
            'callback_p50_us': float(np.percentile(times_us, 50)) if some else math.nan,
            'callback_p99_us': p99_us,
            'callback_max_us': float(times_us.max()) if some else math.nan,
        }

    def worst_p99_us(self) -> float:
        """Return the largest p99 [us] of any window, the present one included."""
        self.window()
        return self._worst_p99_us


class LossCounter:
    """Messages that never arrived, from the publisher's sequence numbers.

    Numbers count per publisher; a step back means that the publisher is a new one. With several
    publishers on the topic the count means nothing, and ``lost`` is then None.
    """

    def __init__(self) -> None:
        self.lost = 0
        self._last: int | None = None

    def note(self, number: int | None) -> None:
        """Take the sequence number of an arrived message (None where the middleware has none)."""
        if number is None:
            return
        if self._last is not None and number > self._last + 1:
            self.lost += number - self._last - 1
        self._last = number

    def restart(self) -> None:
        """Forget the last number: the publisher is another one."""
        self._last = None
