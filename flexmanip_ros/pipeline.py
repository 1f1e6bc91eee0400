"""The one way through the house: messages in, estimates out.

The live node calls ``take`` and ``read`` for each message, a replay and a study call ``run``. Both take the
same path, so the same messages give the same estimates bit for bit.
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator
from dataclasses import replace

from flexmanip_ros import estimator, event_replay
from flexmanip_ros.errors import SignalError
from flexmanip_ros.identification.recursive_fit import Answer, Job
from flexmanip_ros.parameters import IdentifierParameters
from flexmanip_ros.samples import sampling
from flexmanip_ros.schedule import Due as Due
from flexmanip_ros.schedule import Reading, instant_of, is_due, is_read_anew, is_young
from flexmanip_ros.schedule import State as State
from flexmanip_ros.types import CaptureEvent, Estimate, JointRecord, Payload, Sample

GROUP_S, LEAST, GROUP, BLOCK = 0.003, 2, 20, 256
"""Samples run through the compiled kernels at once: live those of a time [s], between least and most, so that
none of them holds up the next for long; when replaying. The numbers are the same."""
PATIENCE = 2000
"""Messages without a single usable one after which a replay gives up."""


def init() -> State:
    """Start with nothing seen."""
    return State()


def step(config: IdentifierParameters, state: State, item: JointRecord | CaptureEvent
         ) -> tuple[State, tuple[Estimate, ...]]:
    """Take one message; return the estimates that are due with it.

    Raises ParameterError when the configuration does not fit the signals that the messages carry.
    """
    return _all_read(*take(config, state, item))


def take(config: IdentifierParameters, state: State, item: JointRecord | CaptureEvent,
         group: int | None = None) -> tuple[State, tuple[Due, ...]]:
    """Take one message; return what is due with it, each to be given to ``read`` before the next message.

    Samples are run ``group`` at a time, by ``GROUP_S`` where it is None. Those before one that an estimate
    waits for are not kept until then.
    Raises ParameterError when the configuration does not fit the signals that the messages carry.
    """
    if isinstance(item, CaptureEvent):
        return _event(_run_held(state), item), ()
    state, samples = _sample(config, state, item)
    return _hold(state, samples, group)


def read(state: State, due: Due) -> tuple[State, Estimate]:
    """Return the estimate that is due, its model read anew when it is time for that."""
    line, config, last = state.timeline, state.config, state.reading
    assert line is not None
    assert config is not None
    if last is not None and not is_read_anew(state, due):
        return state, estimator.follow(config, due.stamp_ns, last.estimate, due.payload)
    core = estimator.settle(config, due.core)
    if due.core is line.core:
        state = state._replace(timeline=line._replace(core=core))
    # while an event may still come late no verdict is given: it would depend on when that came
    estimate, verdicts = estimator.estimate(config, core, due.stamp_ns, state.sampling.dt, due.payload,
                                            state.verdicts, compare=not is_young(state, due))
    instant = instant_of(state, due.stamp_ns, config.model_rate)
    reading = Reading(estimate, core.since_ns, instant) if estimate.model is not None else None
    return state._replace(reading=reading, verdicts=verdicts), estimate


def payload(state: State) -> tuple[Payload | None, int]:
    """Return the payload as of the last sample run, where it stands by itself, and its stamp [ns]."""
    line, config = state.timeline, state.config
    assert line is not None
    assert config is not None
    return estimator.payload(config, line.core, state.verdicts), line.last_ns


def adopted(state: State, read: State) -> State:
    """Return the state knowing the model with which ``read`` has answered an earlier one.

    So a model may be read elsewhere while samples go on, if this is done before a sample comes for which
    ``schedule.awaits`` an estimate. No change where all was forgotten since.
    """
    if (state.timeline is None or state.config is not read.config
            or state.counters.resets != read.counters.resets):
        return state
    return state._replace(reading=read.reading, verdicts=read.verdicts)


def job(state: State) -> tuple[Job, int] | None:
    """Return long work under way, and the samples until its result is taken.

    Whoever has the time may ``solve`` it on another thread and give ``answered`` the result; otherwise it is
    done when its turn comes. The numbers are the same.
    """
    line, config = state.timeline, state.config
    return estimator.job(config, line.core) if line is not None and config is not None else None


def answered(state: State, job: Job, answer: Answer) -> State:
    """Return the state knowing the result of long work; no change where that work is over."""
    line = state.timeline
    if line is None:
        return state
    return state._replace(timeline=line._replace(core=estimator.answered(line.core, job, answer)))


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
    for item in items:
        state, ready = _all_read(*take(config, state, item, BLOCK))
        yield from ((state, estimate) for estimate in ready)
        if state.counters.accepted == 0 and state.counters.received >= PATIENCE:
            break
    if state.config is not None:
        clock, late = sampling.flush(state.config, state.sampling)
        state, ready = _all_read(*_hold(state._replace(sampling=clock), late.samples, BLOCK))
        yield from ((state, estimate) for estimate in ready)
    state = _run_held(state)
    check_used(state)
    yield state, None


def current(state: State) -> Estimate | None:
    """Return the estimate at the latest sample, whatever the publishing grid; None before the first.

    As none followed: a fit under way is awaited.
    """
    state = _run_held(state)
    line, config = state.timeline, state.config
    if line is None or config is None or line.last_ns == event_replay.BEFORE_ALL:
        return None
    core = estimator.finish(config, line.core)
    estimate, verdicts = estimator.estimate(config, core, line.last_ns, state.sampling.dt, None,
                                            state.verdicts, compare=True)
    payload = estimator.payload(config, core, verdicts)
    if estimate.model is None:
        return estimate._replace(payload=payload)
    return estimator.follow(config, line.last_ns, estimate, payload)._replace(model_is_new=True)


def check_used(state: State) -> None:
    """Raise SignalError when messages came and none, or just one, could be used."""
    refusal = state.sampling.refusal
    if state.counters.accepted <= 1 and refusal is not None:
        raise SignalError(refusal.problem, refusal.remedy)


def reconfigure(config: IdentifierParameters, state: State) -> State:
    """Go on with parameters that were changed while running (those declared ``live``)."""
    state = _run_held(state)
    line, before = state.timeline, state.config
    if before is None:
        return state
    if line is not None:  # what came before the change is of the parameters before it
        state = state._replace(timeline=line._replace(
            core=estimator.settle(before, line.core),
            checkpoints=tuple(one._replace(core=estimator.settle(before, one.core))
                              for one in line.checkpoints)))
    state = state._replace(config=replace(config, outputs=before.outputs))
    if state.published < 0 or state.timeline is None:
        return state
    last = instant_of(state, state.timeline.last_ns, config.publish_rate)
    again = state.reading._replace(instant=-1) if state.reading is not None else None  # to be read anew
    return state._replace(published=last, reading=again)


def _event(state: State, event: CaptureEvent) -> State:
    if state.timeline is None or state.config is None:
        return state._replace(early=(*state.early, event)[-event_replay.MOST_EVENTS:])
    return state._replace(timeline=event_replay.event(
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
    state = state._replace(config=settled, timeline=event_replay.Timeline(estimator.init(settled)),
                           first_ns=first_ns, published=-1)
    early = state.early
    state = state._replace(early=())
    for event in early:
        state = _event(state, event)
    return state


def _hold(state: State, samples: Iterable[Sample], group: int | None) -> tuple[State, tuple[Due, ...]]:
    """Keep samples, and run what is kept: when it is many, at each publishing instant and just before one."""
    config = state.config
    if config is None or state.timeline is None:
        return state, ()
    due: list[Due] = []
    dt, dt_ns = state.sampling.dt, 0
    if group is None:
        group, dt_ns = min(max(LEAST, round(GROUP_S / max(dt, 1e-9))), GROUP), int(dt * 1e9)
    for sample in samples:
        line, held = state.timeline, (*state.held, sample)
        assert line is not None
        if is_due(state, sample.stamp_ns):
            line = event_replay.advance(config, line, held, ahead=True)
            state = state._replace(
                timeline=line, held=(), published=instant_of(state, sample.stamp_ns, config.publish_rate))
            payload = estimator.payload(config, line.core, state.verdicts)
            due.append(Due(sample.stamp_ns, line.core, payload))
            continue
        state = state._replace(held=held)
        following = sample.stamp_ns + dt_ns
        if (len(held) >= group or is_due(state, following)
                or event_replay.is_checkpoint_due(config, line, following)):  # a group is run in one piece
            state = _run_held(state)
        elif len(line.core.owed) >= estimator.BATCH:
            state = state._replace(timeline=line._replace(core=estimator.settle(config, line.core)))
    return state, tuple(due)


def _run_held(state: State) -> State:
    """Run the samples that are kept."""
    if not state.held:
        return state
    assert state.timeline is not None
    assert state.config is not None
    return state._replace(timeline=event_replay.advance(state.config, state.timeline, state.held), held=())


def _all_read(state: State, due: tuple[Due, ...]) -> tuple[State, tuple[Estimate, ...]]:
    estimates = []
    for one in due:
        state, estimate = read(state, one)
        estimates.append(estimate)
    return state, tuple(estimates)
