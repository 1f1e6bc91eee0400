"""Turn joint states and events into estimates.

A joint state becomes a row of the sample log. Two estimators, that of the payload and that of the model (the
identifier), take the rows of this log in groups, each with its own cursor. The live node calls ``step`` with the
messages that came. A replay calls ``run`` with a recording. The same messages give the same estimates bit for bit.
"""

import itertools
import math
from collections.abc import Iterable, Iterator
from dataclasses import replace
from typing import NamedTuple

import numpy as np

from flexmanip_ros import estimator, event_replay
from flexmanip_ros.errors import MissingSignalError, SignalError
from flexmanip_ros.estimator import ModelEstimator, PayloadEstimator
from flexmanip_ros.event_replay import EventReplay
from flexmanip_ros.identification import prediction_check, rpbsid
from flexmanip_ros.numerics.background import INLINE, Background
from flexmanip_ros.parameters import IdentifierParameters
from flexmanip_ros.samples import sampling
from flexmanip_ros.samples.sample_log import Rows, SampleLog
from flexmanip_ros.samples.sampling import Clock, Counters
from flexmanip_ros.types import CaptureEvent, Estimate, EventKind, JointBlock, JointRecord, Payload

GROUP = 8
"""Number of rows that wait until the estimators take them as a group, or until an estimate is due. A group costs less
than its rows one by one. At 30 us a row it takes 0.24 ms, a tenth of the time that an estimate may take."""
RESULT_DELAY_S = 0.005
"""Time from the row where a model is requested to the row where its result is used [s]. Reading it takes 1 to 3 ms."""
ARM_RATE = 1.0
"""Rate at which estimates carry the learned arm parameters [Hz]. It is low because they change slowly."""
REPLAY_GROUP = 2000
"""Number of rows that wait in a replay, where ``GROUP`` rows wait in the live node. Python's overhead is then below a
microsecond a row."""
ABSORB_GROUP = 16_000
"""Number of rows that wait in ``absorb``, which makes no estimate on the way. Both estimators take some tenths of a
second for them. A fit takes up to 0.1 s, so it seldom makes the other estimator wait."""
TRAILING = 8_000
"""Number of rows by which the identifier is behind the payload's estimator in ``absorb``. Its first fits take a second
longer than those of the payload, which need not wait for them."""
EARLY_STAMP = 0.1
"""Fraction of the sample time by which the predicted stamp of a sample may be before the instant of an estimate, while
the node still expects the estimate with this sample. The prediction uses the mean interval and may be too early. The
sample after it would come a whole sample time later."""
ROUNDING = 1e-6
"""Fraction of the grid interval by which a stamp may be before an instant of the grid and still count as reaching it.
Stamps are rounded to nanoseconds."""

Item = JointRecord | JointBlock | CaptureEvent


class PendingModel(NamedTuple):
    """A model that was requested at one row and whose result is used at row ``due``, or with the next estimate."""

    request: estimator.ModelRequest
    payload: Payload | None
    """The payload at the row of the request; None where it is read from the model, and until it is estimated."""
    since_ns: int
    """Stamp of the last event before the request [ns]."""
    instant: int
    """Number of the request's instant on the grid of ``model_rate``."""
    due: int


class ModelEstimate(NamedTuple):
    """The last model: its estimate, the stamp of the event before it [ns], its instant on ``model_rate``'s grid."""

    estimate: Estimate
    since_ns: int
    instant: int


class State(NamedTuple):
    """Everything that the identifier remembers."""

    clock: Clock = Clock()
    log: SampleLog = sampling.EMPTY
    payload: EventReplay[PayloadEstimator] | None = None
    """The payload's estimator, with the events; None before the first usable message."""
    identifier: EventReplay[ModelEstimator] | None = None
    """The model's estimator, with the same events. Its cursor is never ahead of the payload's."""
    config: IdentifierParameters | None = None
    """The configuration with the outputs that the messages really carry."""
    early: tuple[CaptureEvent, ...] = ()
    """Events that came before the first usable message."""
    first_ns: int = 0
    published: int = -1
    """Number of the last instant of ``publish_rate``, counted from the first stamp."""
    told: int = -1
    """Number of the last second, counted from the first stamp, in which an estimate carried the arm parameters."""
    pending: PendingModel | None = None
    model: ModelEstimate | None = None

    @property
    def counters(self) -> Counters:
        """What became of the messages."""
        return self.clock.counters

    @property
    def friction(self) -> tuple[float, ...] | None:
        """Learned Coulomb friction that the inputs of the model are without (L,) [N m]; None: they have the given."""
        return self.log.friction[-1].torques if self.log.friction else None

    @property
    def next_due_ns(self) -> int | None:
        """Stamp of the sample with which the next estimate is due [ns], if no sample is missing; None while unknown."""
        last_ns, dt_ns = self.clock.last_ns, self.clock.dt * 1e9
        if self.config is None or last_ns is None or not dt_ns > 0.0:
            return None
        instant_ns = self.first_ns + (self.published + 1) * 1e9 / self.config.publish_rate
        return last_ns + round(max(math.ceil((instant_ns - last_ns) / dt_ns - EARLY_STAMP), 1) * dt_ns)

    def stamp_of(self, kind: EventKind) -> int | None:
        """Return the stamp of the latest event of a kind [ns], None when there was none."""
        return self.payload.stamp_of(kind) if self.payload is not None else None


def init() -> State:
    """Start with nothing known."""
    return State()


def step(config: IdentifierParameters, state: State, item: Item, background: Background = INLINE,
         group: int = GROUP) -> tuple[State, tuple[Estimate, ...]]:
    """Take a message, a block of messages or an event; return the estimates that are due with it.

    An estimate with a new payload comes at once (``payload_is_new``). Where a model is read at its stamp, the model
    follows in a second estimate of the same stamp (``model_is_new``). Rows wait until an estimate is due or ``group``
    rows wait. Raises ParameterError when the configuration does not fit the signals that the messages carry.
    """
    if isinstance(item, CaptureEvent):
        return _insert(state, item, background), ()
    estimates: list[Estimate] = []
    taken, count = 0, _length(item)
    while taken < count:
        state, some = _push(config, state, item, taken, background)
        state, found = catch_up(state, background, group)
        estimates += found
        taken += some
    return state, tuple(estimates)


def absorb(config: IdentifierParameters, items: Iterable[Item], background: Background = INLINE) -> Iterator[State]:
    """Yield the states of a recording for a caller that needs the last one only: no estimate is made on the way.

    The last state equals that of ``replay`` bit for bit. Raises SignalError when no message can be used.
    """
    state, ahead = init(), None
    for item in items:
        if isinstance(item, CaptureEvent):
            state, ahead = _joined(state, ahead, background), None
            state = _insert(state, item, background)
            continue
        taken, count = 0, _length(item)
        while taken < count:
            state, some = _push(config, state, item, taken, background)
            taken += some
        if ahead is not None and ahead.request.replay is not state.payload:  # the log began anew
            ahead = None
        if state.payload is not None:
            begun = state.payload.cursor if ahead is None else ahead.request.until
            if state.log.end - begun >= ABSORB_GROUP:
                state, until = _to_next_event(_joined(state, ahead, background), state.log.end)
                ahead = _ahead(state, until, background, TRAILING)
        yield state
    state = _joined(state, ahead, background)
    if state.config is not None:
        state = _sampled(config, state, sampling.flush(config, state.clock, state.log), background)
    if state.payload is not None:
        state = _advance(state, state.log.end, background)
    check_used(state)
    yield state


def _length(item: JointRecord | JointBlock) -> int:
    return len(item.stamp_ns) if isinstance(item, JointBlock) else 1


def _push(config: IdentifierParameters, state: State, item: JointRecord | JointBlock, taken: int,
          background: Background) -> tuple[State, int]:
    """Put messages into the log (of a block, those from number ``taken`` on); return the state and their number."""
    if isinstance(item, JointBlock):
        sampled, some = sampling.push_block(config, state.clock, state.log, item, taken)
    else:
        sampled, some = sampling.push(config, state.clock, state.log, item), 1
    return _sampled(config, state, sampled, background), some


def catch_up(state: State, background: Background = INLINE, group: int = 1) -> tuple[State, list[Estimate]]:
    """Let the estimators take the rows of the log.

    The payload's estimator takes the rows up to each instant of ``publish_rate``. Where the estimate that is due there
    needs a new model, the identifier takes the same rows. Where several estimates are due, as in a replay, payload and
    models are estimated in parallel, up to the next event. Finally both estimators take the remaining rows, if these
    are ``group`` or more.
    """
    estimates: list[Estimate] = []
    if state.payload is None or state.identifier is None:
        return state, estimates
    while True:
        state, until = _to_next_event(state, state.log.end)
        if due := _due_rows(state, until):
            state, found = _estimates(state, due, background)
            estimates += found
        if until == state.log.end:
            break
        state = _advance(state, until, background)
    if state.log.end - _running(state)[2].cursor >= group:
        state = _advance(state, state.log.end, background)
    if state.pending is not None and state.log.end > state.pending.due:
        state, model = _take_model(state, background)
        estimates += model
    return state, estimates


def _estimates(state: State, due: list[int], background: Background) -> tuple[State, list[Estimate]]:
    """Let the estimators take the rows up to the last of ``due``; return the estimates that are due at these rows."""
    request = _payload_request(state, due)
    if len(due) > 1:
        background.start(request)
        state, steps = _models(state, due, background)
        payload, readings, told = background.result(request)
    else:
        payload, readings, told = request.solve()  # meanwhile a thread may read the model
        state, steps = _models(state, due, background)
    state, estimates = _with_payloads(state._replace(payload=payload, told=told), steps, readings)
    return _without_old_rows(state), estimates


def run(config: IdentifierParameters, items: Iterable[Item]) -> Iterator[Estimate]:
    """Yield the estimates of a recording, one for each stamp. Raises SignalError when no message can be used."""
    for _, estimate in replay(config, items):
        if estimate is not None:
            yield estimate


def replay(config: IdentifierParameters, items: Iterable[Item], background: Background = INLINE
           ) -> Iterator[tuple[State, Estimate | None]]:
    """Yield the state with each estimate of a recording, and at the end the last state with None.

    Payload and model of one stamp come in one estimate. Raises SignalError when no message can be used.
    """
    state, waiting = init(), None
    for item in itertools.chain(items, [None]):
        state, found = (finish(config, state, background) if item is None
                        else step(config, state, item, background, REPLAY_GROUP))
        for estimate in found:
            arm = estimate.arm_parameters
            if waiting is not None and waiting[1].stamp_ns == estimate.stamp_ns:
                arm = arm or waiting[1].arm_parameters
            elif waiting is not None:
                yield waiting
            waiting = state, estimate._replace(payload_is_new=True, arm_parameters=arm)
    if waiting is not None:
        yield waiting
    check_used(state)
    yield state, None


def finish(config: IdentifierParameters, state: State, background: Background = INLINE
           ) -> tuple[State, tuple[Estimate, ...]]:
    """Take every remaining row and the pending model, as no message follows."""
    if state.config is None:
        return state, ()
    sampled = sampling.flush(config, state.clock, state.log)
    state = _sampled(config, state, sampled, background)
    state, estimates = catch_up(state, background)
    state, model = _take_model(state, background)
    return state, (*estimates, *model)


def current(state: State) -> Estimate | None:
    """Return the estimate at the latest sample, on or off the publishing grid; None before the first sample.

    The call waits for a fit that is in progress, as no sample follows.
    """
    if state.payload is None:
        return None
    state, _ = _take_model(_advance(state, state.log.end, INLINE), INLINE)
    config, payload, identifier = _running(state)
    if payload.cursor == 0:
        return None
    model = identifier.estimator._replace(rpbsid=rpbsid.finish(identifier.estimator.rpbsid))
    request = estimator.ModelRequest(config, model, payload.last_ns, state.clock.dt, _latest(state, payload.cursor))
    estimate = request.solve()
    held = estimator.payload(config, payload.estimator)
    return estimator.with_model_of(config, payload.last_ns, estimate, held)._replace(
        model_is_new=estimate.model is not None)


def taken(state: State) -> State:
    """Return the state as if the messages had ended with the last row that the payload's estimator has taken.

    A replay has rows that wait, up to ``ABSORB_GROUP``; one that is interrupted need not wait for these.
    """
    if state.payload is None:
        return state
    cursor, log = state.payload.cursor, state.log
    left = int(np.count_nonzero(log.rows(cursor, log.end).missing == 0)) + log.waiting
    counters = state.counters._replace(accepted=state.counters.accepted - left)
    return state._replace(log=log.before(cursor), clock=state.clock._replace(counters=counters))


def check_used(state: State) -> None:
    """Raise SignalError when messages came and none, or just one, could be used."""
    rejection = state.clock.rejection
    if state.counters.accepted <= 1 and rejection is not None:
        kind = MissingSignalError if rejection.reason == 'missing_signal' else SignalError
        raise kind(rejection.problem, rejection.remedy)


def reconfigure(config: IdentifierParameters, state: State, background: Background = INLINE) -> State:
    """Go on with parameters that were changed while running (those declared ``live``)."""
    before = state.config
    if before is None:
        return state
    if state.payload is not None:  # the samples before the change are estimated with the parameters before it
        state = _advance(state, state.log.end, background)
    state = state._replace(config=replace(config, outputs=before.outputs))
    if state.published < 0 or state.payload is None:
        return state
    last = _instant(state, state.payload.last_ns, config.publish_rate)
    model = state.model._replace(instant=-1) if state.model is not None else None  # to be read again
    pending = state.pending._replace(instant=-1) if state.pending is not None else None
    return state._replace(published=last, model=model, pending=pending)


def _sampled(config: IdentifierParameters, state: State, sampled: sampling.Sampled, background: Background) -> State:
    """Return the state with new clock and log; at the first usable message build the estimators.

    Where the sample time changed, the events stay: the arm still holds what it caught. They stay too where a stamp was
    wrong before the sample time was known. Any other jump back of the stamps begins a new run.
    """
    channels, first_ns = sampled.clock.channels, sampled.clock.last_ns
    if sampled.reset:
        before, events = state.clock, state.payload
        state = State(config=state.config)
        if events is not None and first_ns is not None and before.last_ns is not None and (
                first_ns > before.last_ns or before.interval_count == 0):
            state = state._replace(early=tuple(dict.fromkeys((*events.latest, *events.pending))))
    state = state._replace(clock=sampled.clock, log=sampled.log)
    if state.payload is not None or channels is None or first_ns is None:
        return state
    settled = replace(config, outputs=channels.outputs)
    early = state.early
    payload, identifier = estimator.init(settled)
    state = state._replace(config=settled, payload=EventReplay(payload), identifier=EventReplay(identifier),
                           first_ns=state.log.first_ns, published=-1, early=())
    for event in early:
        state = _insert(state, event, background)
    return state


def _insert(state: State, event: CaptureEvent, background: Background) -> State:
    if state.payload is None or state.config is None:
        return state._replace(early=(*state.early, event))
    is_late = state.log.row_at(event.stamp_ns, state.log.start) < state.log.end
    if is_late:  # it may rewind what was taken
        state = _advance(state, state.log.end, background)
    config, payload, identifier = _running(state)
    state = state._replace(payload=event_replay.insert(config, payload, event, state.first_ns),
                           identifier=event_replay.insert(config, identifier, event, state.first_ns))
    return _advance(state, state.log.end, background) if is_late else state


def _running(state: State) -> tuple[IdentifierParameters, EventReplay[PayloadEstimator], EventReplay[ModelEstimator]]:
    """Return configuration and estimators of a state that has seen a usable message."""
    assert state.config is not None
    assert state.payload is not None
    assert state.identifier is not None
    return state.config, state.payload, state.identifier


class Ahead(NamedTuple):
    """The progress of both estimators on rows that they take while further rows come into the log."""

    request: estimator.PayloadRequest
    """The request of the payload's estimator; a replay solves it in the background."""
    identifier: EventReplay[ModelEstimator]
    """The identifier after these rows."""


def _ahead(state: State, until: int, background: Background, behind: int = 0) -> Ahead:
    """Let both estimators begin with the rows up to ``until``; in a replay they work in parallel.

    behind: number of these rows that the identifier leaves for later.
    """
    config, payload, identifier = _running(state)
    request = estimator.PayloadRequest(config, payload, state.log, until)
    if until - payload.cursor >= REPLAY_GROUP:
        background.start(request)
    return Ahead(request, event_replay.advance(config, identifier, state.log, until - behind, background))


def _joined(state: State, ahead: Ahead | None, background: Background) -> State:
    """Return the state after both estimators have taken the rows that they began with."""
    if ahead is None:
        return state
    payload, _, _ = background.result(ahead.request)
    return _without_old_rows(state._replace(payload=payload, identifier=ahead.identifier))


def _advance(state: State, until: int, background: Background) -> State:
    """Let both estimators take the rows up to ``until``."""
    while True:
        state, stop = _to_next_event(state, until)
        state = _joined(state, _ahead(state, stop, background), background)
        if stop == until:
            return state


def _to_next_event(state: State, until: int) -> tuple[State, int]:
    """Return the row up to which both estimators may go: that of the next event, ``until`` at most.

    At an event the identifier begins again, and from there on its inputs are without the Coulomb friction that the
    payload's estimator learned before. So it waits there for that estimator. Where events come before the next row, the
    log of the state returned has the friction learned until now.
    """
    config, payload, _ = _running(state)
    log, cursor = state.log, payload.cursor
    for event in payload.pending if cursor < log.end else ():
        row = log.row_at(event.stamp_ns, cursor)
        if row > cursor:
            return state._replace(log=log), min(row, until)
        log = log.with_friction(event.stamp_ns, estimator.friction(config, payload.estimator))
    return state._replace(log=log), until


def _without_old_rows(state: State) -> State:
    """Drop the rows that neither estimator reads again."""
    config, payload, identifier = _running(state)
    needed = min(sampling.first_needed(state.log),
                 event_replay.first_needed(payload), event_replay.first_needed(identifier),
                 identifier.cursor - prediction_check.length(state.clock.dt, config.order))
    return state._replace(log=state.log.from_row(needed))


def _latest(state: State, until: int) -> Rows:
    """Return the rows before ``until`` on which a model is judged, none of them before the last event."""
    config, _, identifier = _running(state)
    first = max(state.log.start, until - prediction_check.length(state.clock.dt, config.order))
    first = min(state.log.row_at(identifier.estimator.since_ns, first), until)
    return state.log.rows(first, until)


def _instant(state: State, stamp_ns: int, rate: float) -> int:
    """Return the number of the instant at or before a stamp on the grid of a rate [Hz] from the first stamp on."""
    return int((stamp_ns - state.first_ns) * rate * 1e-9 + ROUNDING)


def _due_rows(state: State, until: int) -> list[int]:
    """Return the rows before ``until`` not taken yet that are the first at or after an instant of ``publish_rate``."""
    config, payload, _ = _running(state)
    cursor = payload.cursor
    rows = state.log.rows(cursor, until)
    if not len(rows) or _instant(state, int(rows.stamp_ns[-1]), config.publish_rate) <= state.published:
        return []  # no instant was passed, as after most messages that come one by one
    measured = np.flatnonzero(rows.missing == 0)
    stamps = rows.stamp_ns[measured]
    instants = ((stamps - state.first_ns) * config.publish_rate * 1e-9 + ROUNDING).astype(np.int64)
    new = np.diff(instants, prepend=state.published) > 0
    return [int(row) for row in measured[new] + cursor]


def _payload_request(state: State, due: list[int]) -> estimator.PayloadRequest:
    config, payload, _ = _running(state)
    first = payload.cursor
    stamps = state.log.rows(first, due[-1] + 1).stamp_ns
    seconds = [_instant(state, int(stamps[row - first]), ARM_RATE) for row in due]
    return estimator.PayloadRequest(config, payload, state.log, due[-1] + 1, due, seconds, state.told)


class ModelStep(NamedTuple):
    """What happens to the models at a row where an estimate is due."""

    stamp_ns: int
    taken: list[Estimate]
    """The model that was pending, if any. A model requested at an earlier row of the same call has no payload yet."""
    last: ModelEstimate | None
    """The last model."""
    asked: bool
    """Whether another model was requested at this row."""


def _models(state: State, due: list[int], background: Background) -> tuple[State, list[ModelStep]]:
    """Use the pending model at each row in turn, and request another one when it is due.

    A model is due at the rate ``model_rate``. After an event it is due with every estimate, for as long as another
    event may arrive late. So the stamps at which models are read do not depend on the order of arrival.
    """
    steps = []
    for row in due:
        config, _, identifier = _running(state)
        state, taken = _take_model(state, background)
        last = state.model
        stamp_ns = int(state.log.rows(row, row + 1).stamp_ns[0])
        since_ns = max((event.stamp_ns for event in identifier.pending if event.stamp_ns <= stamp_ns),
                       default=identifier.estimator.since_ns)
        state = state._replace(published=_instant(state, stamp_ns, config.publish_rate))
        settling_ns = (2.0 * config.rewind_time + 1.0 / config.publish_rate) * 1e9
        young = stamp_ns - max(state.first_ns, since_ns) <= settling_ns
        instant = _instant(state, stamp_ns, config.model_rate)
        asked = last is None or last.since_ns != since_ns or young or instant > last.instant
        if asked:
            identifier = event_replay.advance(config, identifier, state.log, row + 1, background)
            state = state._replace(identifier=identifier)
            request = estimator.ModelRequest(config, identifier.estimator, stamp_ns, state.clock.dt,
                                             _latest(state, row + 1))
            background.start(request)
            result = row + int(np.ceil(RESULT_DELAY_S / max(state.clock.dt, 1e-9)))
            state = state._replace(pending=PendingModel(request, None, since_ns, instant, result))
        steps.append(ModelStep(stamp_ns, taken, last, asked))
    return state, steps


def _with_payloads(state: State, steps: list[ModelStep], readings: list[estimator.PayloadReading]
                   ) -> tuple[State, list[Estimate]]:
    """Return the estimates of payload and models at the rows where they are due."""
    config = _running(state)[0]
    estimates = steps[0].taken
    held: Payload | None = None
    for k, (step, (payload, arm)) in enumerate(zip(steps, readings, strict=True)):
        if k > 0:
            estimates += [estimator.with_payload(config, model, held) for model in step.taken]
        last, held = step.last, payload if step.asked else held
        if payload is not None and last is None:
            estimate = estimator.without_model(config, step.stamp_ns, payload)
        elif last is None or (payload is None and step.asked):  # it is read from the model
            continue
        else:
            estimate = estimator.with_model_of(config, step.stamp_ns, last.estimate, payload)
        estimates.append(estimate._replace(arm_parameters=arm))
    if steps[-1].asked and state.pending is not None:
        state = state._replace(pending=state.pending._replace(payload=held))
    return state, estimates


def _take_model(state: State, background: Background) -> tuple[State, list[Estimate]]:
    """Use the pending model, if there is one."""
    pending = state.pending
    if pending is None:
        return state, []
    estimate = background.result(pending.request)
    model = None if estimate.model is None else ModelEstimate(estimate, pending.since_ns, pending.instant)
    state = state._replace(pending=None, model=model)
    return state, [estimator.with_payload(_running(state)[0], estimate, pending.payload)]
