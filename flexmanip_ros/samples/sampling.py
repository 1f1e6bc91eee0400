"""From messages to samples on one clock: stamps rule, not arrival.

A message becomes at most one ``Sample``. Repeated and late stamps are dropped, a missing sample marks the
next one with ``gap``, a jump back resets, and inputs are shifted by ``arm.effort_delay`` samples.
"""

from __future__ import annotations

from itertools import pairwise
from typing import NamedTuple

from flexmanip_ros.parameters import IdentifierParameters
from flexmanip_ros.samples.signals import Channels, Refusal, extract, resolve, wrong_size
from flexmanip_ros.types import JointRecord, Sample

LEARNING = 20
"""Intervals looked at before the sample time is known."""
FAR = 100.0
"""Sample times ahead that are taken for far where ``max_time_jump`` is shorter (a slow clock)."""
RELEARN = 20
"""Irregular intervals in a row after which the sample time is taken to have changed."""


class Counters(NamedTuple):
    """What became of the messages."""

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

    def plus(self, name: str) -> Counters:
        """Return the counters with one of them raised."""
        return self._replace(**{name: getattr(self, name) + 1})

    def received_and(self, name: str) -> Counters:
        """Return the counters after one message with this fate."""
        return self._replace(**{'received': self.received + 1, name: getattr(self, name) + 1})

    def one_accepted(self) -> Counters:
        """Return the counters after one message that became a sample."""
        return Counters(self.received + 1, self.accepted + 1, *self[2:])


class SamplingState(NamedTuple):
    """Clock and queues. ``pending`` waits for its inputs, ``learning`` for the sample time."""

    channels: Channels | None = None
    outputs: tuple[str, ...] | None = None
    last_ns: int | None = None
    interval_sum_ns: int = 0
    interval_count: int = 0
    irregular: int = 0
    learning: tuple[Sample, ...] = ()
    pending: tuple[Sample, ...] = ()
    counters: Counters = Counters()
    refusal: Refusal | None = None
    doubtful: Sample | None = None
    """A sample from far ahead, until the next one tells whether the clock was set or one stamp was wrong."""

    @property
    def dt(self) -> float:
        """Sample time, the mean of the regular intervals [s]; 0 before it is known."""
        return self.interval_sum_ns / self.interval_count * 1e-9 if self.interval_count else 0.0


class Sampled(NamedTuple):
    """Samples that are complete now, and whether the clock was set back before them."""

    samples: tuple[Sample, ...] = ()
    reset: bool = False


NOTHING = Sampled()


def init() -> SamplingState:
    """Start with no clock."""
    return SamplingState()


def step(config: IdentifierParameters, state: SamplingState, record: JointRecord
         ) -> tuple[SamplingState, Sampled]:
    """Take one message; return the samples it completes, in the order of their stamps."""
    channels = state.channels
    if channels is None or channels.names != record.names:
        found = resolve(config, record, state.outputs)
        if isinstance(found, Refusal):
            return _refuse(state, found), NOTHING
        channels = found
        state = state._replace(channels=channels, outputs=channels.outputs)
    fault = _fault(channels, record)
    if fault is not None:
        return _refuse(state, fault), NOTHING
    raw = extract(channels, record)
    if raw is None:
        return _refuse(state, _NOT_FINITE), NOTHING
    return _on_clock(config, state, raw)


def flush(config: IdentifierParameters, state: SamplingState) -> tuple[SamplingState, Sampled]:
    """Give out what still waits: for the sample time (a recording too short to learn it), or in doubt."""
    if state.doubtful is not None:
        return _placed(config, state._replace(doubtful=None), state.doubtful)
    return _learned(config, state, reset=False) if state.learning else (state, NOTHING)


_NOT_FINITE = Refusal('not_finite', 'a configured signal is NaN or infinite',
                      'look at the publisher of the joint states')
_REPEATED = Refusal('repeated_stamp', 'header stamps do not advance',
                    'use a publisher that fills header.stamp with the time of each sample')
_LATE = Refusal('late_stamp', 'a header stamp is older than the one before',
                'publish in the order of the stamps')
_AHEAD = Refusal('late_stamp', 'one header stamp was far ahead of those before and after it',
                 'look at the clock of the publisher')


def _refuse(state: SamplingState, refusal: Refusal) -> SamplingState:
    return state._replace(counters=state.counters.received_and(refusal.reason), refusal=refusal)


def _fault(channels: Channels, record: JointRecord) -> Refusal | None:
    """Return what is wrong with a record that has the names of ``channels``."""
    if record.position.size == record.velocity.size == record.effort.size == len(channels.names):
        return None
    fault = wrong_size(record)
    if fault is not None:
        return fault
    for field, _ in channels.places:
        if getattr(record, field).size == 0:
            return Refusal('missing_signal', f'a message carries no {field}',
                           'make the publisher fill it in every message')
    return None


def _on_clock(config: IdentifierParameters, state: SamplingState, raw: Sample
              ) -> tuple[SamplingState, Sampled]:
    """Place a sample; one from far ahead waits for the next, as a single wrong stamp must not cost all."""
    held, last = state.doubtful, state.last_ns
    if last is None or state.interval_count == 0:
        return _placed(config, state, raw)
    ahead = (raw.stamp_ns - last) * 1e-9
    far = max(config.max_time_jump, FAR * state.dt)
    if held is None:
        if ahead > far:
            return state._replace(doubtful=raw), NOTHING
        return _placed(config, state, raw)
    state = state._replace(doubtful=None)
    if abs(ahead) <= far:
        return _placed(config, _refuse(state, _AHEAD), raw)
    state, first = _placed(config, state, held)
    state, second = _placed(config, state, raw)
    if second.reset:
        return state, second
    return state, Sampled(first.samples + second.samples, first.reset)


def _placed(config: IdentifierParameters, state: SamplingState, raw: Sample
            ) -> tuple[SamplingState, Sampled]:
    """Place a sample by its stamp: repeated, late, a jump back, still learning, or the next one."""
    interval = None if state.last_ns is None else raw.stamp_ns - state.last_ns
    if interval == 0:
        return _refuse(state, _REPEATED), NOTHING
    if interval is not None and interval < 0:
        if -interval * 1e-9 > config.max_time_jump:
            return _restart(config, state, raw)
        return _refuse(state, _LATE), NOTHING
    if state.interval_count == 0:
        state = state._replace(learning=(*state.learning, raw), last_ns=raw.stamp_ns,
                               counters=state.counters.one_accepted())
        return _learned(config, state, reset=False) if len(state.learning) > LEARNING else (state, NOTHING)
    before = state.counters
    state, ready, gap = _next(config, state, raw, before.one_accepted())
    if gap and state.irregular >= RELEARN:
        return _restart(config, state._replace(counters=before.plus('gaps')), raw)
    return state, Sampled(ready)


def _restart(config: IdentifierParameters, state: SamplingState, raw: Sample
             ) -> tuple[SamplingState, Sampled]:
    """Begin a new clock at ``raw``: the stamps went back, or the rate changed for good."""
    fresh = SamplingState(channels=state.channels, outputs=state.outputs,
                          counters=state.counters.plus('resets'))
    fresh, _ = _on_clock(config, fresh, raw)
    return fresh, Sampled(reset=True)


def _learned(config: IdentifierParameters, state: SamplingState, *, reset: bool
             ) -> tuple[SamplingState, Sampled]:
    """The sample time is the median of the first intervals; place the held samples on that clock."""
    held = state.learning
    steps = sorted(b.stamp_ns - a.stamp_ns for a, b in pairwise(held))
    state = state._replace(learning=(), last_ns=None, interval_count=1,
                    interval_sum_ns=steps[len(steps) // 2] if steps else 0)
    ready: list[Sample] = []
    for raw in held:
        state, complete, _ = _next(config, state, raw, state.counters)
        ready.extend(complete)
    return state._replace(irregular=0), Sampled(tuple(ready), reset)


def _next(config: IdentifierParameters, state: SamplingState, raw: Sample, counters: Counters
          ) -> tuple[SamplingState, tuple[Sample, ...], bool]:
    """Advance the clock by one sample; return the complete samples and whether a gap precedes ``raw``.

    counters: with this sample in them, but for the gap.
    """
    gap = False
    if state.last_ns is None:
        state = state._replace(last_ns=raw.stamp_ns, counters=counters)
    else:
        interval = raw.stamp_ns - state.last_ns
        total, count = state.interval_sum_ns, state.interval_count
        # Compared in whole nanoseconds times count: the same stamps give the same verdict on any machine.
        gap = not (interval * count < config.gap_factor * total
                   and interval * count > (2.0 - config.gap_factor) * total)
        if gap:
            raw = raw._replace(gap=True)
            state = state._replace(irregular=state.irregular + 1, pending=(), last_ns=raw.stamp_ns,
                                   counters=counters.plus('gaps'))
        else:
            state = state._replace(irregular=0, interval_sum_ns=total + interval, interval_count=count + 1,
                                   last_ns=raw.stamp_ns, counters=counters)
    delay = config.arm.effort_delay
    if delay == 0:
        return state, (raw,), gap
    queue = (*state.pending, raw)
    if len(queue) <= delay:
        return state._replace(pending=queue), (), gap
    return state._replace(pending=queue[1:]), (queue[0]._replace(u=raw.u),), gap
