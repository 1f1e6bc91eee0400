"""From messages to rows of the sample log, on one clock: header stamps decide, not times of arrival.

A message becomes at most one row. Repeated and late stamps are dropped, a jump back in time starts a new log, and
inputs are shifted by ``arm.effort_delay`` samples. Messages that never came become rows that are marked as missing,
with interpolated values. After more than ``max_gap`` without a message the next row is marked with ``gap`` instead. A
row is marked with ``gap`` too where the torque changed too much while messages were missing.
"""

from __future__ import annotations

from collections.abc import Iterable
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from flexmanip_ros.parameters import IdentifierParameters
from flexmanip_ros.samples.sample_log import SampleLog, Signals, Width
from flexmanip_ros.samples.signals import (
    Channels,
    Rejection,
    columns,
    extract,
    joint_rates,
    not_finite,
    resolve,
    without_friction,
    wrong_size,
)
from flexmanip_ros.samples.stamp_jitter import Jitter
from flexmanip_ros.types import Array, CaptureEvent, JointBlock, JointRecord, Sample

LEARNING = 20
"""Number of intervals whose median is the first estimate of the sample time; 20 tolerate a few irregular ones."""
FAR = 100.0
"""Sample times ahead beyond which a stamp is doubted, where ``max_time_jump`` is shorter (a low sample rate)."""
MOST_MISSING = 200
"""Largest number of consecutive missing rows that are interpolated: the fit of the model takes blocks of 256."""
UNKNOWN_TORQUE = 3.0
"""Limit of (change of a torque over missing samples / its peak) x number of missing samples; beyond it the torque
counts as unknown. At 1 kHz, the limit leaves the vibration of a 6 Hz mode uncertain by some 3 % of what a step of the
peak torque excites."""
REGRESSED = 32
"""Rows of which it is asked at once whether their samples jitter as their stamps do."""
NEVER = 6.0
"""Standard deviations of a stamp that chance does not reach in years: 1e-9."""
OF_LAYOUT = ('missing_signal', 'unequal_sizes')
"""Outcomes that all messages of a block share, as they follow from names and array lengths."""
SIMULATED_NS = 10**17
"""Stamp that no simulated clock reaches, three years [ns]. After a larger one a stamp of 0 was not filled in; it is not
the start of another run."""
SHORTEST_NS = 50_000
"""Sample time below which the unit of the stamps is wrong [ns]: nobody publishes 20 000 joint states a second. At 1 kHz
microseconds in the field of nanoseconds are stamps 1000 ns apart, of which modes of some MHz were identified."""
RELEARN = 20
"""Number of consecutive irregular intervals after which the sample time is learned again."""


class Counters(NamedTuple):
    """Numbers of messages by what became of them."""

    received: int = 0
    accepted: int = 0
    gaps: int = 0
    repeated_stamp: int = 0
    late_stamp: int = 0
    missing_signal: int = 0
    unequal_sizes: int = 0
    not_finite: int = 0
    resets: int = 0

    @property
    def dropped(self) -> int:
        """Messages that became no sample."""
        return (self.repeated_stamp + self.late_stamp + self.missing_signal + self.unequal_sizes
                + self.not_finite)

    def plus(self, *names: str, count: int = 1) -> Counters:
        """Return the counters with those of these names raised by ``count``."""
        return self._replace(**{name: getattr(self, name) + count for name in names})


class Clock(NamedTuple):
    """The sample time as learned so far, and the position of the signals in a message."""

    channels: Channels | None = None
    last_ns: int | None = None
    interval_sum_ns: int = 0
    interval_count: int = 0
    irregular: int = 0
    """Number of consecutive irregular intervals up to now."""
    counters: Counters = Counters()
    rejection: Rejection | None = None
    """Why the latest unusable message could not be used."""
    latest: Sample | None = None
    """The sample placed last."""
    peak: Array = np.empty(0)
    """(r,) largest size of each input so far."""
    jump_candidate: Sample | None = None
    """A sample with a stamp far ahead. The next one tells whether the clock was set or one stamp was wrong."""
    jitter: Jitter = Jitter()

    @property
    def dt(self) -> float:
        """Sample time, the mean interval from sample to sample [s]; 0 before it is known."""
        return self.interval_sum_ns / self.interval_count * 1e-9 if self.interval_count else 0.0

    def after(self, interval_ns: int, steps: int = 1) -> Clock:
        """Return the clock after an interval of ``steps`` sample times."""
        jitter = self.jitter.after(interval_ns, steps, self.interval_sum_ns / self.interval_count)
        return self._replace(interval_sum_ns=self.interval_sum_ns + interval_ns, jitter=jitter,
                             interval_count=self.interval_count + steps)

    def after_equal(self, interval_ns: int, count: int) -> Clock:
        """Return the clock after ``count`` intervals that are equal to all before."""
        return self._replace(interval_sum_ns=self.interval_sum_ns + count * interval_ns,
                             interval_count=self.interval_count + count, jitter=self.jitter.after_equal(count))


class Sampled(NamedTuple):
    """Clock and log after a message; reset: whether the message made both start anew."""

    clock: Clock
    log: SampleLog
    reset: bool = False


EMPTY = SampleLog(Width(0, 0, 0))
"""The log before the first usable message."""


def push(config: IdentifierParameters, clock: Clock, log: SampleLog, record: JointRecord) -> Sampled:
    """Take one message; return clock and log with the rows that it completes."""
    channels = clock.channels
    if channels is None or channels.names != record.names:
        found = resolve(config, record, channels.outputs if channels is not None else None)
        if isinstance(found, Rejection):
            return Sampled(_reject(clock, found), log)
        channels = found
        clock = clock._replace(channels=channels)
    fault = _fault(channels, record)
    if fault is not None:
        return Sampled(_reject(clock, fault), log)
    raw = extract(channels, record)
    if raw is None:
        return Sampled(_reject(clock, not_finite(channels, record)), log)
    if log.width == EMPTY.width:  # also in a state that was saved before the first usable message
        log = SampleLog(Width(len(channels.u), len(channels.y), len(channels.angles), len(channels.rates)))
    return _on_clock(config, clock, log, raw)


def push_block(config: IdentifierParameters, clock: Clock, log: SampleLog, block: JointBlock, first: int = 0
               ) -> tuple[Sampled, int]:
    """Take messages of a block from number ``first`` on; return clock and log, and how many were taken.

    Messages that follow one another regularly are taken at once, and so are those whose layout cannot be used; any
    other message alone. The rows equal those of ``push``.
    """
    times, advanced = _regular(config, clock, log, block, first)
    regular = len(times)
    if regular == 0:
        sampled, left = push(config, clock, log, block.record(first)), len(block.stamp_ns) - first - 1
        now, why = sampled.clock, sampled.clock.rejection
        if why is None or why is clock.rejection or why.reason not in OF_LAYOUT:
            return sampled, 1
        counters = now.counters.plus('received', why.reason, count=left)
        return sampled._replace(clock=now._replace(counters=counters)), 1 + left
    channels = clock.channels
    assert channels is not None
    taken = slice(first, first + regular)
    u, y, angles = (columns(block, places, taken) for places in (channels.u, channels.y, channels.angles))
    rates = joint_rates(channels, block, taken)
    last = int(block.stamp_ns[taken][-1])
    latest = Sample(last, u[-1].copy(), y[-1].copy(), angles[-1].copy(), rates[-1].copy())
    clock = advanced._replace(
        last_ns=last, latest=latest, peak=_peak(clock, np.abs(u).max(axis=0)), irregular=0,
        counters=clock.counters.plus('received', 'accepted', count=regular))
    before = log.end
    log = log.append(block.stamp_ns[taken], u, y, angles, np.zeros(regular, dtype=np.bool_), config.arm.effort_delay,
                     rates=rates, time_ns=times)
    return Sampled(_judged(clock, log, before), log), regular


def first_usable_ns(config: IdentifierParameters, block: JointBlock) -> int | None:
    """Return the stamp of the first message of a block that can become a sample [ns]; None where none can."""
    channels = resolve(config, block)
    if isinstance(channels, Rejection):
        return None
    usable = np.isfinite(columns(block, channels.places, slice(0, len(block.stamp_ns)))).all(axis=1)
    stamps = block.stamp_ns[usable][:LEARNING + 1]
    return int(stamps[_first_of_clock(config, stamps)]) if stamps.size else None


def _first_of_clock(config: IdentifierParameters, stamps: NDArray[np.int64]) -> int:
    """Return the number of the stamp (N,) behind the last far jump: those before it are zero, or of another clock."""
    intervals = np.abs(np.diff(stamps)) * 1e-9
    usual = np.sort(intervals)[intervals.size // 2] if intervals.size else 0.0
    jumps = np.flatnonzero(intervals > max(config.max_time_jump, FAR * usual))
    return int(jumps[-1]) + 1 if jumps.size else 0


def _is_on_time(config: IdentifierParameters, interval_ns: int, clock: Clock) -> bool:
    """Whether an interval [ns] agrees with the mean of those before.

    The comparison is one of integers, nanoseconds times count: equal stamps give the same result on any machine.
    """
    interval, mean = interval_ns * clock.interval_count, clock.interval_sum_ns
    return (2.0 - config.gap_factor) * mean < interval < config.gap_factor * mean


def _lost(config: IdentifierParameters, clock: Clock, interval_ns: int) -> int:
    """Return how many messages were lost before the next stamp, by the publisher's clock; -1: it comes too early."""
    if not clock.interval_sum_ns:
        return -1  # after a single sample the sample time is not known
    period, regular = clock.interval_sum_ns / clock.interval_count, config.gap_factor - 1.0
    ahead = clock.jitter.ahead_ns(interval_ns, period)
    if ahead <= -max(regular * period, NEVER * clock.jitter.std_ns):
        return -1
    return max(int(ahead / period + 0.5), 1) if ahead >= clock.jitter.most_ns(period, regular) else 0


def _regular(config: IdentifierParameters, clock: Clock, log: SampleLog, block: JointBlock, first: int
             ) -> tuple[NDArray[np.int64], Clock]:
    """Return the instants [ns] of the messages from ``first`` on that are regular and finite, and the clock after them.

    The clock has their intervals alone.
    """
    channels = clock.channels
    if (channels is None or clock.last_ns is None or clock.interval_count == 0 or clock.jump_candidate is not None
            or channels.names != block.names or _fault(channels, block) is not None):
        return np.zeros(0, dtype=np.int64), clock  # sample time or stamp in doubt, or another layout than before
    # with jitter at most ``REGRESSED`` rows are taken at once, and no more are looked at
    taken = slice(first, len(block.stamp_ns) if clock.jitter.is_sharp else min(first + REGRESSED, len(block.stamp_ns)))
    stamps = block.stamp_ns[taken]
    intervals = np.diff(stamps, prepend=np.int64(clock.last_ns))
    finite = np.logical_and.reduce([
        np.isfinite(columns(block, places, taken)).all(axis=1)
        for places in (channels.u, channels.y, channels.angles)])
    usable = finite & (intervals > 0) & (intervals * 1e-9 <= config.max_time_jump)  # no far jump
    count = len(stamps) if usable.all() else int(np.argmin(usable))
    if clock.jitter.square == 0.0:  # equal intervals leave the clock as it is but for its sums
        equal = intervals[:count] * clock.interval_count == clock.interval_sum_ns
        exact = count if equal.all() else int(np.argmin(equal))
        if exact:
            return stamps[:exact], clock.after_equal(int(intervals[0]), exact)
    times: list[int] = []
    for stamp, interval in zip(stamps[:count].tolist(), intervals[:count].tolist(), strict=True):
        if not _is_on_time(config, interval, clock) or _lost(config, clock, interval):
            break
        clock = clock.after(interval)
        times.append(stamp - round(clock.jitter.correction_ns))
        if not clock.jitter.is_sharp and (log.end + len(times)) % REGRESSED == 0:
            break  # ``_judged``
    return np.array(times, dtype=np.int64), clock


def flush(config: IdentifierParameters, clock: Clock, log: SampleLog) -> Sampled:
    """Place the samples that wait for the sample time, or whose stamp is in doubt: no message follows."""
    if clock.jump_candidate is not None:
        return _placed(config, clock._replace(jump_candidate=None), log, clock.jump_candidate)
    is_learning = clock.interval_count == 0 and log.waiting > 0
    return _learned(config, clock, log) if is_learning else Sampled(clock, log)


def signals(config: IdentifierParameters, clock: Clock, log: SampleLog) -> Signals:
    """Return every row that the log holds, with the names of its columns. The inputs are ``without_friction``."""
    measured = log.rows(log.start, log.end)
    rows = without_friction(config, measured)
    return Signals(rows.stamp_ns, rows.u, rows.y, rows.angles, rows.gap, rows.missing, config.inputs,
                   clock.channels.outputs if clock.channels is not None else config.outputs,
                   measured.u if rows.friction else None)


def push_whole(config: IdentifierParameters, clock: Clock, log: SampleLog, block: JointBlock) -> Sampled:
    """Take every message of a block."""
    taken, reset = 0, False
    while taken < len(block.stamp_ns):
        (clock, log, again), some = push_block(config, clock, log, block, taken)
        taken, reset = taken + some, reset or again
    return Sampled(clock, log, reset)


def collect(config: IdentifierParameters, items: Iterable[JointRecord | JointBlock | CaptureEvent],
            friction: tuple[float, ...] | None = None) -> Signals:
    """Return the signals of a whole recording. friction: that of ``without_friction`` (L,); None: the given one."""
    clock, log = Clock(), EMPTY
    for item in items:
        if not isinstance(item, CaptureEvent):
            block = item if isinstance(item, JointBlock) else JointBlock.of(item)
            clock, log, _ = push_whole(config, clock, log, block)
    clock, log, _ = flush(config, clock, log)
    return signals(config, clock, log.with_friction(0, friction))


_REPEATED = Rejection('repeated_stamp', 'header stamps do not advance',
                      'use a publisher that fills header.stamp with the time of each sample')
_LATE = Rejection('late_stamp', 'a header stamp is older than the one before',
                  'publish in the order of the stamps')
_UNSTAMPED = Rejection('late_stamp', 'a header stamp is 0, as where a publisher does not fill it in',
                       'make each publisher of the joint states fill in header.stamp')
_TOO_FAST = Rejection('repeated_stamp', 'header stamps are less than 50 microseconds apart',
                      'make the publisher fill in header.stamp in seconds and nanoseconds')
_AHEAD = Rejection('late_stamp', 'one header stamp was far ahead of those before and after it',
                   'check the clock of the publisher')


def _reject(clock: Clock, rejection: Rejection) -> Clock:
    return clock._replace(counters=clock.counters.plus('received', rejection.reason), rejection=rejection)


def _fault(channels: Channels, record: JointRecord | JointBlock) -> Rejection | None:
    """Return what is wrong with messages that have the names of ``channels``."""
    count = len(channels.names)
    if record.position.shape[-1] == record.velocity.shape[-1] == record.effort.shape[-1] == count:
        return None
    fault = wrong_size(record)
    if fault is not None:
        return fault
    for field, _ in channels.places:
        if getattr(record, field).shape[-1] == 0:
            return Rejection('missing_signal', f'a message carries no {field}',
                             'make the publisher fill it in every message')
    return None


def _on_clock(config: IdentifierParameters, clock: Clock, log: SampleLog, raw: Sample) -> Sampled:
    """Place a sample. One with a stamp far ahead waits for the next, so that one wrong stamp does not reset the log."""
    candidate, last = clock.jump_candidate, clock.last_ns
    if raw.stamp_ns == 0 and last is not None and last > SIMULATED_NS:
        return Sampled(_reject(clock, _UNSTAMPED), log)
    if last is None or clock.interval_count == 0:
        return _placed(config, clock, log, raw)
    ahead = (raw.stamp_ns - last) * 1e-9
    far = max(config.max_time_jump, FAR * clock.dt)
    if candidate is None:
        if ahead > far:
            return Sampled(clock._replace(jump_candidate=raw), log)
        return _placed(config, clock, log, raw)
    clock = clock._replace(jump_candidate=None)
    if abs(ahead) <= far:
        return _placed(config, _reject(clock, _AHEAD), log, raw)
    first = _placed(config, clock, log, candidate)
    second = _placed(config, first.clock, first.log, raw)
    return second._replace(reset=first.reset or second.reset)


def _placed(config: IdentifierParameters, clock: Clock, log: SampleLog, raw: Sample) -> Sampled:
    """Place a sample by its stamp: repeated, late, a jump back, still learning, or the next one."""
    interval = None if clock.last_ns is None else raw.stamp_ns - clock.last_ns
    if interval == 0:
        return Sampled(_reject(clock, _REPEATED), log)
    if interval is not None and interval < 0:
        if -interval * 1e-9 > config.max_time_jump:
            return _restart(clock, log, raw)
        return Sampled(_reject(clock, _LATE), log)
    if clock.interval_count == 0:
        clock = clock._replace(last_ns=raw.stamp_ns, counters=clock.counters.plus('received', 'accepted'))
        log = log.wait(raw)
        return _learned(config, clock, log) if log.waiting > LEARNING else Sampled(clock, log)
    before = clock.counters
    clock, log = _next(config, clock._replace(counters=before.plus('received', 'accepted')), log, raw)
    if clock.irregular >= RELEARN:
        return _restart(clock._replace(counters=before.plus('gaps')), log, raw)
    return Sampled(clock, log)


def _restart(clock: Clock, log: SampleLog, raw: Sample) -> Sampled:
    """Begin a new clock and a new log at ``raw``: the stamps went back, or the rate changed for good."""
    counters = clock.counters.plus('resets', 'received', 'accepted')
    fresh = Clock(channels=clock.channels, counters=counters, last_ns=raw.stamp_ns)
    return Sampled(fresh, SampleLog(log.width).wait(raw), reset=True)


def _learned(config: IdentifierParameters, clock: Clock, log: SampleLog) -> Sampled:
    """Set the sample time to the median of the first intervals; place the waiting samples on that clock.

    Those before a far jump are left out, and clock and log begin behind it. All are dropped where the unit of their
    stamps is wrong.
    """
    rows = log.waiting_rows()
    if len(rows) > 1 and np.median(np.diff(rows.stamp_ns)) < SHORTEST_NS:
        counters = clock.counters.plus('accepted', count=-len(rows)).plus('repeated_stamp', count=len(rows))
        return Sampled(clock._replace(counters=counters, last_ns=None, rejection=_TOO_FAST), log.without_waiting())
    first = _first_of_clock(config, rows.stamp_ns)
    stamps = rows.stamp_ns.tolist()
    samples = [Sample(stamps[k], *(part[k].copy() for part in (rows.u, rows.y, rows.angles, rows.rates)))
               for k in range(first, len(rows))]
    intervals = np.sort(np.diff(rows.stamp_ns)).tolist()
    clock = clock._replace(last_ns=None, latest=None, interval_count=1,
                           interval_sum_ns=intervals[len(intervals) // 2] if intervals else 0)
    if first:
        clock = clock._replace(counters=clock.counters.plus('resets'))
    log = SampleLog(log.width) if first else log.without_waiting()
    for raw in samples:
        clock, log = _next(config, clock, log, raw)
    return Sampled(clock._replace(irregular=0), log, reset=first > 0)


def _next(config: IdentifierParameters, clock: Clock, log: SampleLog, raw: Sample) -> tuple[Clock, SampleLog]:
    """Advance clock and log by one sample."""
    unknown = False
    if clock.last_ns is not None:
        interval = raw.stamp_ns - clock.last_ns
        irregular = 0 if _is_on_time(config, interval, clock) else clock.irregular + 1
        lost = _lost(config, clock, interval)
        if lost:
            log, clock, unknown = _after_gap(config, log, clock, raw, lost)
        else:
            clock = clock.after(interval)
        clock = clock._replace(irregular=irregular)
    clock = clock._replace(last_ns=raw.stamp_ns, latest=raw, peak=_peak(clock, np.abs(raw.u)))
    before = log.end
    log = log.append(np.array([raw.stamp_ns]), raw.u[None], raw.y[None], raw.angles[None], np.array([unknown]),
                     config.arm.effort_delay, rates=raw.rates[None],
                     time_ns=np.array([raw.stamp_ns - round(clock.jitter.correction_ns)]))
    return _judged(clock, log, before), log


def _judged(clock: Clock, log: SampleLog, before: int) -> Clock:
    """Return the clock after the rows from ``before`` on, if they complete rows that tell more of its jitter."""
    until = log.end - log.end % REGRESSED
    if clock.jitter.is_sharp or until <= before or until - REGRESSED < log.start:
        return clock
    rows = log.rows(until - REGRESSED, until)
    if rows.gap[1:].any() or rows.missing.any():
        return clock
    return clock._replace(jitter=clock.jitter.judged(rows.stamp_ns, np.hstack([rows.y, rows.angles, rows.rates])))


def first_needed(log: SampleLog) -> int:
    """Return the first row that will be read again."""
    return max(log.end - REGRESSED, log.start)


def _after_gap(config: IdentifierParameters, log: SampleLog, clock: Clock, raw: Sample, lost: int
               ) -> tuple[SampleLog, Clock, bool]:
    """Return log and clock where messages before ``raw`` were lost or it came too early.

    The rows of the lost ones are interpolated. Return as well whether motion or torques just before ``raw`` are
    unknown. That is so too where a torque changed so much while messages were missing that the motion depends on when
    it did.
    """
    before, counters = clock.latest, clock.counters.plus('gaps')
    interval = 0 if before is None else raw.stamp_ns - before.stamp_ns
    if before is None or interval * 1e-9 > config.max_gap or not 0 < lost <= MOST_MISSING:
        return log.without_waiting(), clock._replace(counters=counters, jitter=clock.jitter.restarted()), True
    after = clock._replace(counters=counters).after(interval, lost + 1)
    number = np.arange(1, lost + 1)
    share = (number / (lost + 1))[:, None]
    stamps = before.stamp_ns + interval * number // (lost + 1)
    u, y, angles, rates = (np.asarray(a + share * (b - a)) for a, b in zip(before[1:], raw[1:], strict=True))
    correction = clock.jitter.correction_ns
    late = correction + share[:, 0] * (after.jitter.correction_ns - correction)
    log = log.append(stamps, u, y, angles, np.zeros(lost, dtype=np.bool_), config.arm.effort_delay, number, rates,
                     stamps - np.round(late).astype(np.int64))
    change, peak = np.abs(raw.u - before.u), np.maximum(clock.peak, np.abs(raw.u))
    return log, after, bool(np.any(lost * change > UNKNOWN_TORQUE * peak))


def _peak(clock: Clock, size: Array) -> Array:
    return np.maximum(clock.peak, size) if clock.peak.size else np.array(size, dtype=np.float64)
