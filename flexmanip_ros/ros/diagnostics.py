"""Diagnostics of a node, once a second: rates, losses, callback times, and the quality of its latest estimate."""

from __future__ import annotations

import math
import textwrap
import time
from collections.abc import Collection, Iterator, Mapping
from contextlib import contextmanager
from dataclasses import dataclass, field
from typing import Any

import numpy as np

from flexmanip_ros.identification.realization import suggested_order
from flexmanip_ros.messages import DiagnosticStatus
from flexmanip_ros.parameters import IdentifierParameters
from flexmanip_ros.payload.structured_model import unobservable
from flexmanip_ros.samples.sampling import Clock
from flexmanip_ros.samples.signals import Rejection
from flexmanip_ros.types import Estimate, Status

OK = 0
WARN = 1
ERROR = 2
STALE = 3
_SEVERITY = (OK, WARN, STALE, ERROR)
"""Levels from the least to the most severe: STALE (no messages) outranks a warning, an error outranks STALE."""
RECENT_S = 60.0
"""Time for which a loss is a warning [s], so that an occasional reader of /diagnostics sees it."""
LONGEST_LINE = 600
"""Largest number of characters of an error in the log or in /diagnostics, which may quote a message of any length."""
BUSY = 0.9
"""Share of the time that a callback may take; beyond it messages wait, and are lost once the queue is full."""
TOO_SLOW = 'samples wait: they come faster than they can be computed, or the computer is busy with other work'
CLOCK = '/clock'


@dataclass
class Report:
    """One diagnostic entry. ``worse`` can only raise the level; the words of all its calls are joined."""

    values: dict[str, Any] = field(default_factory=dict)
    level: int = OK
    words: list[str] = field(default_factory=list)
    waits_for: str = ''
    """Topic that the node needs and on which no message comes; empty when there is none."""
    silence_s: float | None = None
    """Time since the topics that the node needs ceased [s]; None where they never came since its activation."""

    def worse(self, level: int, words: str) -> None:
        """Note a problem."""
        self.level = max(self.level, level, key=_SEVERITY.index)
        self.words.append(words)

    def silent(self, topic: str) -> None:
        """Note that no message comes on a topic that the node needs."""
        self.waits_for = topic
        self.worse(STALE, self.silence(topic))

    def silence(self, topic: str, none: str = 'no') -> str:
        """Return 'no <topic>', with the time since it ceased, and for /clock why it is needed. none: replaces 'no'."""
        since = '' if self.silence_s is None else f' for {self.silence_s:.0f} s'
        return f'{none} {topic}{since}{" (use_sim_time is true)" if topic == CLOCK else ""}'

    def busy(self, remedy: str) -> None:
        """Warn where the callback takes more than ``BUSY`` of the time."""
        if self.values['callback_share'] > BUSY:
            self.worse(WARN, f'{TOO_SLOW}: {remedy}')

    def entry(self, node: str, namespace: str) -> DiagnosticStatus:
        """Return the entry for /diagnostics; node: the fully qualified name of the node.

        The hardware_id contains the namespace, because the nodes in one namespace belong to one arm.
        """
        return DiagnosticStatus(
            self.level, f'{node}: status', '; '.join(self.words) or 'ok', f'flexmanip_ros {namespace}',
            tuple((key, text(value)) for key, value in self.values.items()))


def shortened(words: str) -> str:
    """Return words with at most ``LONGEST_LINE`` characters."""
    return textwrap.shorten(words, LONGEST_LINE, placeholder=' ...')


def number(count: int, what: str) -> str:
    """Return a count with its noun, such as '1 message' or '2 messages'."""
    return f'{count} {what}' if count == 1 else f'{count} {what}s'


def text(value: Any) -> str:
    """Return a value as text: a float with six digits, or 'unknown' where it is not finite."""
    if isinstance(value, float):
        return f'{value:.6g}' if math.isfinite(value) else 'unknown'
    return str(value)


class Meter:
    """Measures the run times of a callback and counts its messages."""

    def __init__(self) -> None:
        self._times_ns: list[int] = []
        self._messages = 0
        self._window_ns = time.monotonic_ns()

    @contextmanager
    def timed(self, messages: int = 1) -> Iterator[None]:
        """Measure the body, which takes this number of messages."""
        entered_ns = time.perf_counter_ns()
        yield
        self._times_ns.append(time.perf_counter_ns() - entered_ns)
        self._messages += messages

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


class Stamps:
    """Collects the steps between stamps since the last report; steps back, of a clock that was set, are left out.

    Their median is the sample time also where less than a third of the messages is lost, or simulated time runs slowly.
    """

    def __init__(self) -> None:
        self._last_ns: int | None = None
        self._steps_ns: list[int] = []

    def note(self, stamp_ns: int) -> None:
        """Process the stamp of a message [ns]."""
        if self._last_ns is not None and stamp_ns > self._last_ns:
            self._steps_ns.append(stamp_ns - self._last_ns)
        self._last_ns = stamp_ns

    def window(self) -> tuple[float, float]:
        """Return the rate of the samples [Hz] and the share of them that did not come, since the last call.

        Both are NaN where fewer than two messages came.
        """
        steps_ns, self._steps_ns = self._steps_ns, []
        if not steps_ns:
            return math.nan, math.nan
        step_ns = float(np.median(steps_ns))
        return 1e9 / step_ns, max(0.0, 1.0 - len(steps_ns) * step_ns / sum(steps_ns))


class Recent:
    """Counts what happened in the last ``RECENT_S`` seconds, to a second."""

    def __init__(self) -> None:
        self._counts: dict[int, int] = {}
        """Count of each second of the monotonic clock."""

    def add(self, count: int) -> None:
        """Add what happens now."""
        now = int(time.monotonic())
        self._counts[now] = self._counts.get(now, 0) + count

    def count(self) -> int:
        """Return the count of the last ``RECENT_S`` seconds, and forget older ones."""
        oldest = time.monotonic() - RECENT_S
        self._counts = {at: count for at, count in self._counts.items() if at >= oldest}
        return sum(self._counts.values())

    def report(self, report: Report, what: str, became: str) -> None:
        """Add a warning where something happened lately. what: such as 'message'; became: such as 'lost'."""
        count = self.count()
        if count:
            report.worse(WARN, f'{number(count, what)} {became} in the last {RECENT_S:.0f} s')


class LossCounter:
    """Counts messages that were sent and never arrived, from the publishers' sequence numbers.

    Each publisher numbers its messages. rclpy does not say which publisher sent a message, so a number is assigned to
    the publisher that has it as the next one; after a gap, to the one with the largest next number below it. When
    a publisher goes, the comparison starts again (``matched``), so its numbers are no loss.
    """

    def __init__(self) -> None:
        self.lost = 0
        """Number of messages lost since the node started."""
        self.publishers = 1
        """Number of publishers on the topic, at least 1."""
        self._expected: list[int] = []
        """Next sequence number of each publisher from which a message arrived."""
        self._losses = Recent()

    def matched(self, event: Any) -> None:
        """Process the matched event of the subscription: a publisher came or went."""
        self.publishers = max(int(event.current_count), 1)
        if event.current_count_change < 0:
            self._expected = []

    def note(self, number: int | None) -> None:
        """Process the sequence number of an arrived message (None where the middleware has none)."""
        if number is None:
            return
        if number in self._expected:
            self._expected.remove(number)
        elif len(self._expected) >= self.publishers:
            before = max((expected for expected in self._expected if expected < number), default=None)
            if before is None:  # a publisher started again without a matched event
                self._expected.pop()
            else:
                self._expected.remove(before)
                self.lost += number - before
                self._losses.add(number - before)
        self._expected.append(number + 1)

    def recent(self) -> int:
        """Return how many messages were lost in the last ``RECENT_S`` seconds."""
        return self._losses.count()

    def report(self, report: Report, name: str, what: str) -> None:
        """Add the total under a name, and a warning for losses in ``RECENT_S``. what: 'message' or 'command'."""
        report.values[name] = self.lost
        self._losses.report(report, what, 'lost')


class JointStateFaults:
    """Counts the joint states that became no sample, and the jumps and gaps of their stamps.

    Messages with none of the configured joints, such as those of a gripper on the same topic, are an error only while
    no other message can be used.
    """

    def __init__(self, joints: Collection[str], topic: str) -> None:
        """topic: the full name of the topic of the joint states."""
        self.losses = LossCounter()
        self.foreign = 0
        """Number of messages with none of the configured joints."""
        self._joints, self._topic = frozenset(joints), topic
        self._dropped, self._resets, self._gaps, self._unordered = Recent(), Recent(), Recent(), Recent()
        self._why = ''
        """Why the latest message of the configured joints was dropped."""
        self._jitter_ns = 0.0
        self._is_used = False
        """Whether a message became a sample since the last report."""
        self._unused: Rejection | None = None
        """Why the latest message that was dropped since the last report could not be used."""

    def note(self, before: Clock, clock: Clock, names: Collection[str]) -> Rejection | None:
        """Process the clock before and after messages with these names; return why some were dropped.

        None is returned where none was dropped, and for messages with none of the configured joints.
        """
        then, now = before.counters, clock.counters
        self._jitter_ns = clock.jitter.std_ns
        self._is_used |= now.accepted > then.accepted
        self._resets.add(now.resets - then.resets)
        self._gaps.add(now.gaps - then.gaps)
        self._unordered.add(now.late_stamp + now.repeated_stamp - then.late_stamp - then.repeated_stamp)
        dropped, rejection = now.dropped - then.dropped, clock.rejection
        if not dropped or rejection is None:
            return None
        if self._joints.isdisjoint(names):
            self.foreign += dropped
            self._unused = self._unused or rejection
            return None
        self._dropped.add(dropped)
        self._unused, self._why = rejection, shortened(f'{rejection.problem}; {rejection.remedy}')
        return rejection

    def likely_cause(self) -> str:
        """Return that the topic has several publishers where that explains the faults, otherwise ''.

        Publishers of different joints on one topic are no fault. So the stamps must have jumped or come out of order,
        or more than one gap a second was not caused by a loss; and where messages of other joints came, one publisher
        is theirs.
        """
        gaps = self._gaps.count() - self.losses.recent()
        is_likely = self._resets.count() or self._unordered.count() or gaps > RECENT_S
        if self.losses.publishers - bool(self.foreign) < 2 or not is_likely:
            return ''
        return (f'{self.losses.publishers} publishers are on {self._topic}: only one may publish these joints, '
                'with the stamps of one clock')

    def jumped(self) -> str:
        """Return the words for stamps that jumped: how often they did lately, and the likely cause."""
        count, cause = self._resets.count(), self.likely_cause()
        often = f' ({count} times in the last {RECENT_S:.0f} s)' if count > 1 else ''
        return f'the stamps jumped or their rate changed{often}{": " if cause else ""}{cause}'

    def report(self, report: Report) -> Rejection | None:
        """Report losses and faults; return why no message since the last report could be used, None where one was."""
        self.losses.report(report, 'lost', 'message')
        report.values.update(foreign=self.foreign, stamp_jitter_ms=self._jitter_ns * 1e-6)
        unused, self._unused = None if self._is_used else self._unused, None
        self._is_used = False
        dropped, cause = self._dropped.count(), self.likely_cause()
        if unused is not None:
            report.worse(ERROR, shortened(f'no message can be used: {unused.problem}; {unused.remedy}'))
        elif dropped:
            report.worse(WARN, f'{number(dropped, "message")} dropped in the last {RECENT_S:.0f} s: {self._why}')
        if self._resets.count() > 1:
            report.worse(WARN, self.jumped())
        elif cause:
            report.worse(WARN, cause)
        return unused


ADVICE = {
    Status.WARMING_UP: 'move the arm; the first estimates take some tenths of a second',
    Status.TRACKING: 'the estimates can be used',
    Status.POORLY_EXCITED: 'move the arm, or raise the torque (node excitation)',
    Status.ILL_CONDITIONED: 'lower order or past_window',
    Status.ORDER_TOO_LOW: 'raise order (suggested_order in /diagnostics)',
    Status.INCONSISTENT: 'check the parameters of the arm and the units of the signals (rad, m, N m); say how well '
                         'lengths and masses are known (payload.length_std, payload.mass_std); announce each capture '
                         'and release, or set trigger_mode:=auto at launch',
    Status.UNOBSERVABLE: 'correct inputs, outputs and angles, or set payload_method to none',
    Status.DIVERGED: 'check units and signs of the signals, and the times of events',
}
"""What a user can do about each status."""
UNANNOUNCED = ('nothing is known of the payload and no capture was announced: publish capture_event, call '
               'capture_trigger/capture, or have captures found in the signals (trigger_mode:=auto)')
"""Log line for a payload interval of [0, inf] when no event was announced: what to do."""


def status_line(config: IdentifierParameters, status: Status, reason: str) -> str:
    """Return a status with its meaning, its reason where that is known, and what to do about it."""
    advice = ADVICE[status]
    if status is Status.UNOBSERVABLE:
        reason, remedy = unobservable(config)
        advice = f'{remedy}, or set payload_method to none'
    return f'status {status.name}: {status.value}{": " if reason else ""}{reason}; {advice}'


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
