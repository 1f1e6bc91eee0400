"""The one way through the house: messages in, estimates out.

The live node calls ``step`` for each message, a replay and a study call ``run``. Both take the same path, so
the same messages give the same estimates bit for bit.
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator
from dataclasses import replace
from typing import NamedTuple

from flexmanip_ros import estimator, sampling, timeline
from flexmanip_ros.errors import SignalError
from flexmanip_ros.parameters import IdentifierParameters
from flexmanip_ros.sampling import Counters
from flexmanip_ros.types import CaptureEvent, Estimate, EventKind, JointRecord, Sample

BLOCK = 256
"""Samples run through the compiled kernels at once when replaying."""
PATIENCE = 2000
"""Messages without a single usable one after which a replay gives up."""


class Reading(NamedTuple):
    """A model as it was read: its estimate, the samples it rested on, and the index of its instant."""

    estimate: Estimate
    samples: int
    instant: int


class State(NamedTuple):
    """All that the identifier remembers."""

    sampling: sampling.SamplingState = sampling.SamplingState()
    timeline: timeline.Timeline | None = None
    config: IdentifierParameters | None = None
    """The configuration with the outputs that the messages really carry."""
    early: tuple[CaptureEvent, ...] = ()
    """Events that came before the first usable message."""
    first_ns: int = 0
    published: int = -1
    """Index of the last publishing instant, counted from the first stamp."""
    reading: Reading | None = None
    """The last estimate whose model was read anew."""

    @property
    def counters(self) -> Counters:
        """What became of the messages."""
        return self.sampling.counters

    def stamp_of(self, kind: EventKind) -> int | None:
        """Return the stamp of the latest event of a kind [ns], None when there was none."""
        return self.timeline.stamp_of(kind) if self.timeline is not None else None


def init() -> State:
    """Start with nothing seen."""
    return State()


def step(config: IdentifierParameters, state: State, item: JointRecord | CaptureEvent
         ) -> tuple[State, tuple[Estimate, ...]]:
    """Take one message; return the estimates that are due with it.

    Raises ParameterError when the configuration does not fit the signals that the messages carry.
    """
    if isinstance(item, CaptureEvent):
        return _event(state, item), ()
    state, samples = _sample(config, state, item)
    return _consume(state, samples)


def run(config: IdentifierParameters, items: Iterable[JointRecord | CaptureEvent]) -> Iterator[Estimate]:
    """Yield the estimates of a recording. Raises SignalError when none of its messages can be used."""
    for _, estimate in replay(config, items):
        if estimate is not None:
            yield estimate


def replay(config: IdentifierParameters, items: Iterable[JointRecord | CaptureEvent]
           ) -> Iterator[tuple[State, Estimate | None]]:
    """Yield the state with each estimate of a recording, and at the end the last state with None.

    The same numbers as ``step`` on each item, faster. Raises SignalError when no message can be used.
    """
    state = init()
    block: list[Sample] = []
    for item in items:
        if isinstance(item, CaptureEvent):
            state, ready = _consume(state, block)
            block = []
            yield from ((state, estimate) for estimate in ready)
            state = _event(state, item)
            continue
        line = state.timeline
        state, samples = _sample(config, state, item)
        if state.timeline is not line:
            block = []  # the clock was set back: what came before it is over
        block.extend(samples)
        if len(block) >= BLOCK or (samples and _due(state, samples[-1].stamp_ns)):
            state, ready = _consume(state, block)
            block = []
            yield from ((state, estimate) for estimate in ready)
        if state.counters.accepted == 0 and state.counters.received >= PATIENCE:
            break
    if state.config is not None:
        clock, held = sampling.flush(state.config, state.sampling)
        state = state._replace(sampling=clock)
        block.extend(held.samples)
    state, ready = _consume(state, block)
    yield from ((state, estimate) for estimate in ready)
    check_used(state)
    yield state, None


def current(state: State) -> Estimate | None:
    """Return the estimate at the latest sample, whatever the publishing grid; None before the first."""
    line = state.timeline
    if line is None or state.config is None or line.last_ns == timeline.BEFORE_ALL:
        return None
    return estimator.estimate(state.config, line.core, line.last_ns, state.sampling.dt)


def check_used(state: State) -> None:
    """Raise SignalError when messages came and none, or just one, could be used."""
    refusal = state.sampling.refusal
    if state.counters.accepted <= 1 and refusal is not None:
        raise SignalError(refusal.problem, refusal.remedy)


def reconfigure(config: IdentifierParameters, state: State) -> State:
    """Go on with parameters that were changed while running (those declared ``live``)."""
    if state.config is None:
        return state
    state = state._replace(config=replace(config, outputs=state.config.outputs))
    if state.published < 0 or state.timeline is None:
        return state
    last = _instant(state, state.timeline.last_ns, config.publish_rate)
    return state._replace(published=last, reading=None)


def _event(state: State, event: CaptureEvent) -> State:
    if state.timeline is None or state.config is None:
        return state._replace(early=(*state.early, event))
    return state._replace(timeline=timeline.event(
        state.config, state.timeline, event, state.first_ns))


def _sample(config: IdentifierParameters, state: State, record: JointRecord
            ) -> tuple[State, tuple[Sample, ...]]:
    clock, sampled = sampling.step(config, state.sampling, record)
    state = state._replace(sampling=clock)
    if sampled.reset:
        state = State(sampling=clock, config=state.config)
    if state.timeline is None and clock.outputs is not None:
        state = _begin(config, state, record.stamp_ns)
    return state, sampled.samples


def _begin(config: IdentifierParameters, state: State, first_ns: int) -> State:
    """Build the estimators for the outputs that are there, and give them the events that were early."""
    assert state.sampling.outputs is not None
    settled = config if config.outputs == state.sampling.outputs else replace(
        config, outputs=state.sampling.outputs)
    state = state._replace(config=settled, timeline=timeline.Timeline(estimator.init(settled)),
                           first_ns=first_ns, published=-1)
    early = state.early
    state = state._replace(early=())
    for event in early:
        state = _event(state, event)
    return state


def _instant(state: State, stamp_ns: int, rate: float) -> int:
    """Index of the instant at or before a stamp on the grid of a rate [Hz] from the first stamp on."""
    return int((stamp_ns - state.first_ns) * rate * 1e-9 + 1e-6)


def _due(state: State, stamp_ns: int) -> bool:
    assert state.config is not None
    return _instant(state, stamp_ns, state.config.publish_rate) > state.published


def _read(config: IdentifierParameters, state: State, core: estimator.Core, stamp_ns: int
          ) -> tuple[State, Estimate]:
    """Return the estimate at a stamp, its model read anew when that is due.

    That is by ``model_rate``, and with every estimate for as long after an event as it may arrive late: so
    any order of arrival reads models at the same stamps.
    """
    assert state.timeline is not None
    settling = 2.0 * config.rewind_time + 1.0 / config.publish_rate
    changes = (state.first_ns, *(event.stamp_ns for event in state.timeline.latest))
    young = any(0 <= stamp_ns - change <= settling * 1e9 for change in changes)
    instant = _instant(state, stamp_ns, config.model_rate)
    used = estimator.samples_used(core)
    last = state.reading
    if last is not None and not young and instant <= last.instant and last.samples <= used:
        return state, estimator.follow(config, core, stamp_ns, last.estimate)
    estimate = estimator.estimate(config, core, stamp_ns, state.sampling.dt)
    reading = Reading(estimate, used, instant) if estimate.model is not None else None
    return state._replace(reading=reading), estimate


def _consume(state: State, samples: Iterable[Sample]) -> tuple[State, tuple[Estimate, ...]]:
    """Run samples through the estimators, stopping at each publishing instant."""
    config, line = state.config, state.timeline
    if config is None or line is None:
        return state, ()
    ready: list[Estimate] = []
    block: list[Sample] = []
    for sample in samples:
        block.append(sample)
        if not _due(state, sample.stamp_ns):
            continue
        line = timeline.advance(config, line, block)
        block = []
        state = state._replace(
            timeline=line, published=_instant(state, sample.stamp_ns, config.publish_rate))
        state, estimate = _read(config, state, line.core, sample.stamp_ns)
        ready.append(estimate)
    if block:
        state = state._replace(timeline=timeline.advance(config, line, block))
    return state, tuple(ready)
