"""What a node reports once a second: rates, losses, callback times, and what its latest estimate is worth."""

from __future__ import annotations

import math
import time
from collections import deque
from collections.abc import Mapping
from dataclasses import dataclass, field
from types import TracebackType
from typing import Any

import numpy as np
from builtin_interfaces.msg import Time
from diagnostic_msgs.msg import DiagnosticArray, DiagnosticStatus, KeyValue

from flexmanip_ros.identification.realization import suggested_order
from flexmanip_ros.parameters import IdentifierParameters
from flexmanip_ros.payload.structured_model import unobservable_reason
from flexmanip_ros.types import Estimate, Status

OK = 0
WARN = 1
ERROR = 2
STALE = 3
_SEVERITY = (OK, WARN, STALE, ERROR)
"""From the least to the most severe: silence hides a warning, and a known error hides silence."""
RECENT_S = 60.0
"""A loss is a warning for so long: somebody who looks at /diagnostics now and then sees it."""


@dataclass
class Report:
    """One diagnostic entry. ``worse`` only ever raises the level; its words are joined."""

    values: dict[str, Any] = field(default_factory=dict)
    level: int = OK
    words: list[str] = field(default_factory=list)
    waits_for: str = ''
    """The topic that the node needs and that is silent."""

    def worse(self, level: int, words: str) -> None:
        """Note a problem."""
        self.level = max(self.level, level, key=_SEVERITY.index)
        self.words.append(words)

    def silent(self, topic: str) -> None:
        """Note that no message comes on a topic that the node needs."""
        self.waits_for = topic
        self.worse(STALE, f'no {topic}')

    def message(self, node: str, namespace: str, stamp: Time) -> DiagnosticArray:
        """Return the entry as it goes out on /diagnostics; node: its name with the namespace.

        Nodes in one namespace belong to one arm, which the hardware_id names.
        """
        status = DiagnosticStatus(
            level=bytes([self.level]), name=f'{node}: status', message='; '.join(self.words) or 'ok',
            hardware_id=f'flexmanip_ros {namespace}',
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
    """Times the runs of a callback and counts its messages: ``with meter:`` around its body."""

    def __init__(self) -> None:
        self._times_ns: list[int] = []
        self._messages = 0
        self._taken = 1
        self._entered_ns = 0
        self._window_ns = time.monotonic_ns()

    def of(self, messages: int) -> Meter:
        """Return the meter for a run that takes so many messages."""
        self._taken = messages
        return self

    def __enter__(self) -> Meter:
        self._entered_ns = time.perf_counter_ns()
        return self

    def __exit__(self, kind: type[BaseException] | None, error: BaseException | None,
                 trace: TracebackType | None) -> None:
        self._times_ns.append(time.perf_counter_ns() - self._entered_ns)
        self._messages += self._taken
        self._taken = 1

    def window(self) -> Mapping[str, float]:
        """Return rate of the messages [Hz] and callback time [us] since the last call, and start a new window."""
        now = time.monotonic_ns()
        seconds = max(now - self._window_ns, 1) * 1e-9
        times_us = np.array(self._times_ns, dtype=np.float64) * 1e-3
        messages = self._messages
        self._times_ns, self._messages, self._window_ns = [], 0, now
        some = times_us.size > 0
        return {
            'rate_hz': messages / seconds,
            'callback_p50_us': float(np.percentile(times_us, 50)) if some else math.nan,
            'callback_p99_us': float(np.percentile(times_us, 99)) if some else math.nan,
            'callback_max_us': float(times_us.max()) if some else math.nan,
        }


class LossCounter:
    """Messages that were sent and never arrived, from the publishers' sequence numbers.

    Each publisher counts its messages. rclpy does not say which publisher a message is from, so a number belongs to the
    publisher whose next one it is; after a gap, to the one with the largest number before it. A publisher that comes or
    goes starts the comparison again (``matched``), so its numbers are no loss.
    """

    def __init__(self) -> None:
        self.lost = 0
        """Since the node started."""
        self._publishers = 1
        self._expected: list[int] = []
        """The next number of each publisher heard."""
        self._losses: deque[tuple[float, int]] = deque()
        """When [s] how many were lost, within ``RECENT_S``."""

    def matched(self, event: Any) -> None:
        """Take the event that a publisher came or went."""
        self._publishers = max(int(event.current_count), 1)
        if event.current_count_change < 0:
            self._expected = []

    def note(self, number: int | None) -> None:
        """Take the sequence number of an arrived message (None where the middleware has none)."""
        if number is None:
            return
        if number in self._expected:
            self._expected.remove(number)
        elif len(self._expected) >= self._publishers:
            before = max((expected for expected in self._expected if expected < number), default=None)
            if before is None:  # a publisher began again without an event of the middleware
                self._expected.pop()
            else:
                self._expected.remove(before)
                self._add(number - before)
        self._expected.append(number + 1)

    def _add(self, count: int) -> None:
        self.lost += count
        self._losses.append((time.monotonic(), count))

    def recent(self) -> int:
        """Return how many were lost in the last ``RECENT_S`` seconds."""
        while self._losses and time.monotonic() - self._losses[0][0] > RECENT_S:
            self._losses.popleft()
        return sum(count for _, count in self._losses)

    def report(self, report: Report, name: str, what: str) -> None:
        """Add the total under a name; losses of the last ``RECENT_S`` are a warning. what: of messages, commands."""
        report.values[name] = self.lost
        recent = self.recent()
        if recent:
            report.worse(WARN, f'{recent} {what} lost in the last {RECENT_S:.0f} s')


ADVICE = {
    Status.WARMING_UP: 'move the arm; the first estimates take some tenths of a second',
    Status.TRACKING: 'the estimates can be used',
    Status.POORLY_EXCITED: 'move the arm, or raise the torque (node excitation)',
    Status.ILL_CONDITIONED: 'lower order or past_window',
    Status.ORDER_TOO_LOW: 'raise order (suggested_order in /diagnostics)',
    Status.INCONSISTENT: 'check the parameters of the arm; announce each capture and release, or set '
                         'trigger_mode:=auto at launch',
    Status.UNOBSERVABLE: 'correct inputs, outputs and angles, or set payload_method to none',
    Status.DIVERGED: 'check units and signs of the signals',
}
"""What a user can do about each status."""
UNANNOUNCED = ('nothing is known of the payload and no capture was announced: publish capture_event, call '
               'capture_trigger/capture, or have captures found in the signals (trigger_mode:=auto)')
"""What to do about an interval of [0, inf] without any event."""


def status_line(config: IdentifierParameters, status: Status) -> str:
    """Return a status with its meaning, its reason where that is known, and what to do about it."""
    reason = f': {unobservable_reason(config)}' if status is Status.UNOBSERVABLE else ''
    return f'status {status.name}: {status.value}{reason}; {ADVICE[status]}'


def report_estimate(report: Report, estimate: Estimate | None, order: int) -> None:
    """Add status, excitation, conditioning, order and payload to a report; order: the one configured."""
    status = Status.WARMING_UP if estimate is None else estimate.status
    payload = None if estimate is None else estimate.payload
    report.values.update(
        status=status.name, model_status=(Status.WARMING_UP if estimate is None else estimate.model_status).name,
        converged=status is Status.TRACKING,
        consistent=payload is None or payload.status is not Status.INCONSISTENT)
    if status not in (Status.TRACKING, Status.WARMING_UP):
        report.worse(WARN, status.value)
    if estimate is None:
        return
    report.values.update(
        excitation=estimate.excitation, condition=estimate.condition,
        innovation_power=estimate.innovation_power)
    if estimate.singular_values is not None:
        report.values.update(
            order=order, suggested_order=suggested_order(estimate.singular_values),
            singular_values=' '.join(f'{value:.4g}' for value in estimate.singular_values))
    if payload is not None:
        report.values.update(payload_mass_kg=payload.mass, payload_std_kg=payload.std, consistency=payload.consistency)
