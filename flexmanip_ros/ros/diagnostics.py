"""Diagnostics of a node, once a second: rates, losses, callback times, and the quality of its latest estimate."""

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
"""Levels from the least to the most severe: STALE (no messages) outranks a warning, an error outranks STALE."""
RECENT_S = 60.0
"""Time for which a loss is a warning [s], so that an occasional reader of /diagnostics sees it."""


@dataclass
class Report:
    """One diagnostic entry. ``worse`` can only raise the level; the words of all its calls are joined."""

    values: dict[str, Any] = field(default_factory=dict)
    level: int = OK
    words: list[str] = field(default_factory=list)
    waits_for: str = ''
    """Topic that the node needs and on which no message comes; empty when there is none."""

    def worse(self, level: int, words: str) -> None:
        """Note a problem."""
        self.level = max(self.level, level, key=_SEVERITY.index)
        self.words.append(words)

    def silent(self, topic: str) -> None:
        """Note that no message comes on a topic that the node needs."""
        self.waits_for = topic
        self.worse(STALE, f'no {topic}')

    def message(self, node: str, namespace: str, stamp: Time) -> DiagnosticArray:
        """Return the entry as the message for /diagnostics; node: the fully qualified name of the node.

        The hardware_id contains the namespace, because the nodes in one namespace belong to one arm.
        """
        status = DiagnosticStatus(
            level=bytes([self.level]), name=f'{node}: status', message='; '.join(self.words) or 'ok',
            hardware_id=f'flexmanip_ros {namespace}',
            values=[KeyValue(key=key, value=text(value)) for key, value in self.values.items()])
        array = DiagnosticArray(status=[status])
        array.header.stamp = stamp
        return array


def text(value: Any) -> str:
    """Return a value as text: a float with six digits, or 'unknown' where it is not finite."""
    if isinstance(value, float):
        return f'{value:.6g}' if math.isfinite(value) else 'unknown'
    return str(value)


class Meter:
    """Measures the run times of a callback and counts its messages; the callback's body runs in ``with meter:``."""

    def __init__(self) -> None:
        self._times_ns: list[int] = []
        self._messages = 0
        self._taken = 1
        self._entered_ns = 0
        self._window_ns = time.monotonic_ns()

    def of(self, messages: int) -> Meter:
        """Return the meter, set for a run of the callback that takes this number of messages."""
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
        """Return rate of the messages [Hz] and times of the callback since the last call, and start a new window."""
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
            'callback_share': float(times_us.sum()) * 1e-6 / seconds,
        }


class LossCounter:
    """Counts messages that were sent and never arrived, from the publishers' sequence numbers.

    Each publisher numbers its messages. rclpy does not say which publisher sent a message, so a number is assigned to
    the publisher that has it as the next one; after a gap, to the one with the largest next number below it. When
    a publisher goes, the comparison starts again (``matched``), so its numbers are no loss.
    """

    def __init__(self) -> None:
        self.lost = 0
        """Number of messages lost since the node started."""
        self._publishers = 1
        self._expected: list[int] = []
        """Next sequence number of each publisher from which a message arrived."""
        self._losses: deque[tuple[float, int]] = deque()
        """Time [s] and number of messages of each loss within ``RECENT_S``."""

    def matched(self, event: Any) -> None:
        """Process the matched event of the subscription: a publisher came or went."""
        self._publishers = max(int(event.current_count), 1)
        if event.current_count_change < 0:
            self._expected = []

    def note(self, number: int | None) -> None:
        """Process the sequence number of an arrived message (None where the middleware has none)."""
        if number is None:
            return
        if number in self._expected:
            self._expected.remove(number)
        elif len(self._expected) >= self._publishers:
            before = max((expected for expected in self._expected if expected < number), default=None)
            if before is None:  # a publisher started again without a matched event
                self._expected.pop()
            else:
                self._expected.remove(before)
                self._add(number - before)
        self._expected.append(number + 1)

    def _add(self, count: int) -> None:
        self.lost += count
        self._losses.append((time.monotonic(), count))

    def recent(self) -> int:
        """Return how many messages were lost in the last ``RECENT_S`` seconds."""
        while self._losses and time.monotonic() - self._losses[0][0] > RECENT_S:
            self._losses.popleft()
        return sum(count for _, count in self._losses)

    def report(self, report: Report, name: str, what: str) -> None:
        """Add the total under a name, and a warning for losses in ``RECENT_S``. what: 'messages' or 'commands'."""
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
    Status.DIVERGED: 'check units and signs of the signals, and the times of events',
}
"""What a user can do about each status."""
UNANNOUNCED = ('nothing is known of the payload and no capture was announced: publish capture_event, call '
               'capture_trigger/capture, or have captures found in the signals (trigger_mode:=auto)')
"""Log line for a payload interval of [0, inf] when no event was announced: what to do."""


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
