"""Captures and releases told from the signals alone: generalized likelihood ratio on the innovations."""

import math
from collections.abc import Iterable, Iterator
from dataclasses import dataclass, field, replace
from typing import NamedTuple

import numpy as np
import scipy  # its parts are loaded where they are first used

from flexmanip_ros.errors import ParameterError
from flexmanip_ros.parameters import IdentifierParameters, TriggerParameters
from flexmanip_ros.payload import capture_detection_kernel as kernel
from flexmanip_ros.payload import filter_state as mem
from flexmanip_ros.payload import structured, structured_model
from flexmanip_ros.samples import sampling
from flexmanip_ros.samples.sample_log import Rows, SampleLog
from flexmanip_ros.types import DATING_STD_S, Array, CaptureEvent, EventKind, JointBlock, JointRecord

SETTLE = 0.5
"""Time after the start or an event within which no event is reported [s]."""
CONFIRM = 0.01
"""Time from an alarm to its report [s]; the samples in it serve to date the onset."""
PEAK_MEMORY = 20.0
"""Time constant with which a peak of the statistic fades [s]."""
INDEPENDENT = 0.5
"""Samples for each test that counts as independent, for the false alarms; a test is over all onsets of the window."""
SPEED, ACCELERATION, JERK = 0.3, 5.0, 200.0
"""Prior deviations of what a force gives the mass at the empty tip: impulse [m/s], step [m/s^2], ramp [m/s^3]. A moment
has the same, at the prior radius of gyration of a body."""


@dataclass(frozen=True, eq=False)
class DetectionState:
    """Everything remembered; constant in size."""

    identifier: IdentifierParameters
    filter: structured.StructuredState
    kept: tuple[int, ...]
    """Indices of the outputs that are used: displacements, where there are any."""
    glr: kernel.GlrState | None = None
    dt: float = 0.0
    since: int | None = None
    """Row of the sample log at the start or after the last gap; no onset is dated before it."""


def init(config: TriggerParameters) -> DetectionState:
    """Start with an empty arm."""
    # rates show the modes that the model leaves out, at every step of the torque
    kept = tuple(i for i, name in enumerate(config.outputs) if not name.endswith('/velocity'))
    kept = kept or tuple(range(len(config.outputs)))
    settings = IdentifierParameters(
        inputs=config.inputs, outputs=tuple(config.outputs[i] for i in kept), angles=config.angles,
        arm=config.arm, payload=config.payload, order=1)
    return DetectionState(settings, structured.init(settings), kept)


def first_needed(state: DetectionState) -> int:
    """Return the first row of the sample log that will be read again."""
    first = structured.first_needed(state.filter)
    if state.since is None or state.glr is None:
        return first
    window: int = state.glr.trace.shape[0]
    return min(first, max(state.since, state.filter.cursor - window))


def advance(
    config: TriggerParameters, state: DetectionState, rows: Rows,
) -> tuple[DetectionState, tuple[CaptureEvent, ...]]:
    """Take the next rows of the sample log; return the events found, the same as one by one."""
    found: list[CaptureEvent] = []
    rows = replace(rows, chosen=state.kept)
    if state.filter.model is None:
        return replace(state, filter=structured.advance(state.identifier, state.filter, rows)), ()
    while len(rows):
        one = rows.between(rows.first, rows.first + 1)
        if state.glr is None or state.filter.memory is None:
            state = _start(config, state, one)
            rows = rows.since(one.until)
        elif rows.gap[0]:
            filtered = structured.advance(state.identifier, state.filter, one)
            state = replace(state, filter=filtered, glr=_quiet(state.glr), since=one.first)
            rows = rows.since(one.until)
        else:
            state, event = _watch(state, rows.stretches()[0])
            rows = rows.since(state.filter.cursor)
            if event is not None:
                found.append(event)
    return state, tuple(found)


def threshold(config: TriggerParameters, dt: float) -> float:
    """Return the threshold that the statistic exceeds by chance ``false_alarms_per_hour`` times an hour.

    Without an event the statistic is chi-square with one degree of freedom for each cause that is tested. An hour has
    one independent test for each ``INDEPENDENT`` samples.
    """
    looks = 3600.0 / dt / INDEPENDENT
    chance = min(0.5, config.false_alarms_per_hour / looks)
    return float(scipy.special.chdtri(kernel.TESTED, chance))


def onset(glr: kernel.GlrState, variance: Array, longest: int) -> float:
    """Return the posterior mean of the number of samples since the force at the tip began, with a uniform prior.

    variance: (m,) of the white noise [rad^2 or m^2], as the filter's own grows with the event. longest: samples since
    the last gap. The nine causes are integrated out: an onset has the likelihood exp(s' P s / 2) / sqrt(det(I + N))
    with s their score, N their information and P the inverse of I + N. The determinant is the price of an early onset,
    which can fit what a later one explains.
    """
    w, newest = glr.trace.shape[0], int(glr.clock[kernel.NEWEST])
    lags = np.arange(min(int(glr.clock[kernel.FILLED]), longest + 1, w))
    weighted = glr.innovations[(newest - lags) % w] / variance
    trace = glr.trace[:lags.size]
    information = np.eye(trace.shape[2]) + np.cumsum(
        np.einsum('lia,lib->lab', trace / variance[:, np.newaxis], trace), axis=0)
    scores = np.array([np.tensordot(trace[:lag + 1], weighted[lag::-1], ((0, 1), (0, 1))) for lag in lags])
    explained = np.einsum('la,la->l', scores, np.linalg.solve(information, scores[..., np.newaxis])[..., 0])
    likelihood = 0.5 * (explained - np.linalg.slogdet(information)[1])
    told = lags >= kernel.SHORTEST - 1
    chance = np.exp(likelihood[told] - likelihood[told].max())
    return float(np.average(lags[told], weights=chance))


def _start(config: TriggerParameters, state: DetectionState, row: Rows) -> DetectionState:
    """Let the filter take its first rows; once it has started, allocate the test for its sample time."""
    since = row.first if state.since is None else state.since
    state = replace(state, filter=structured.advance(state.identifier, state.filter, row), since=since)
    if state.filter.memory is None or state.filter.model is None or state.glr is not None:
        return state
    assert state.filter.sensors is not None
    dt = state.filter.sensors.period
    w = max(kernel.SHORTEST + 2, round(config.detection_window / dt))
    n2 = 2 * state.filter.model.motion.arm.stiffness.size
    m = len(state.filter.model.roles)
    glr = kernel.GlrState(
        trace=np.zeros((w, m, kernel.CAUSES)), factors=np.zeros((w, kernel.TESTED, kernel.TESTED)),
        scores=np.zeros((w, kernel.TESTED)), past=np.zeros((w, m)), innovations=np.zeros((w, m)),
        clock=np.zeros(6, dtype=np.int64),
        level=np.array([0.0, 0.0, threshold(config, dt), 0.0]), history=np.zeros((2, 2 * w)),
        torques=row.u[-1].copy(), flow=np.zeros((n2, n2)),
        state=np.zeros((2, n2, kernel.DIRECTIONS)))
    return replace(state, glr=glr, dt=dt)


def _watch(state: DetectionState, rows: Rows) -> tuple[DetectionState, CaptureEvent | None]:
    """Take rows without a gap until an alarm; return the event."""
    filtered, glr = state.filter, state.glr
    assert glr is not None
    model, sensors, memory, *_ = filtered.running
    m = mem.copy(memory)
    glr = kernel.GlrState._make(part.copy() for part in glr)
    table, first = structured.input_table(filtered, rows)
    confirm = round(CONFIRM / state.dt)
    mass, moment = structured_model.body_std(state.identifier, model)[:2] / structured_model.PAYLOAD_STD
    prior = np.outer([SPEED, ACCELERATION, JERK], [mass, mass, moment])
    taken = kernel.advance(
        model.motion, sensors, m, glr, prior, state.dt, float(np.exp(-state.dt / PEAK_MEMORY)),
        round(SETTLE / state.dt), confirm, table, first, np.zeros(kernel.TESTED), True)
    until = abs(taken)
    part = rows.between(rows.first, rows.first + until - first)
    after = structured.after_rows(filtered, m, part, table[:until])
    if taken < 0:  # the fit of the empty arm begins again, and may learn more of it
        last = part.since(part.until - 1)
        fresh = structured.restart(state.identifier, filtered, after, last)
        if m.counts[mem.RESTS] != mem.SLIDES:  # else only the horizon of an arm at rest slid
            glr = _quiet(glr)
            glr.level[kernel.PEAK] = 0.0  # what the model missed before
        return replace(state, filter=fresh, glr=glr), None
    state = replace(state, filter=after, glr=glr)
    if glr.clock[kernel.ALARMED] <= confirm:
        return state, None
    assert state.since is not None
    lag = round(onset(glr, np.maximum(m.noise[:, mem.WHITE], m.noise[:, mem.FLOOR]), part.until - 1 - state.since))
    kind = EventKind.RELEASE if m.counts[mem.HELD] else EventKind.CAPTURE
    event = CaptureEvent(int(rows.between(part.until - 1 - lag, part.until).stamp_ns[0]), kind, DATING_STD_S)
    changed = structured.event(state.identifier, after, event._replace(stamp_ns=after.last_ns))
    changed = structured.reopen(state.identifier, changed)  # the samples since the onset made its motion wrong
    return replace(state, filter=changed, glr=_quiet(glr)), event


def _quiet(glr: kernel.GlrState) -> kernel.GlrState:
    """Begin the test again after a pause. The recent peak, which errors of the model cause, is kept."""
    fresh = kernel.GlrState._make(part.copy() for part in glr)
    fresh.clock[:] = 0
    fresh.level[kernel.STATISTIC] = 0.0
    fresh.history[:] = 0.0
    fresh.scores[:] = 0.0
    return fresh


Item = JointBlock | CaptureEvent
PIECE = 256
"""Messages of a block that are tested together; where an event is found in them, they are tested one by one."""


class Watch(NamedTuple):
    """The detector of a stream of messages: its clock and sample log, and the row that it takes next.

    config: how the signals are sampled; trigger: what is detected in them, with the outputs that came once known.
    """

    config: IdentifierParameters
    clock: sampling.Clock = sampling.Clock()
    log: SampleLog = sampling.EMPTY
    trigger: TriggerParameters = TriggerParameters()
    state: DetectionState | None = None
    cursor: int = 0

    @property
    def is_on(self) -> bool:
        """Whether the next sample can raise an alarm."""
        if self.state is None or self.state.glr is None:
            return False
        return bool(self.state.glr.clock[kernel.QUIET] > round(SETTLE / self.state.dt))

    @property
    def statistic(self) -> tuple[float, float]:
        """The latest statistic and its threshold (0 and infinite before there are any)."""
        if self.state is None or self.state.glr is None:
            return 0.0, math.inf
        return float(self.state.glr.level[kernel.STATISTIC]), float(kernel.limit(self.state.glr))


def watching(trigger: TriggerParameters) -> Watch:
    """Start to look for the events of a trigger."""
    config = IdentifierParameters(inputs=trigger.inputs, outputs=trigger.outputs, angles=trigger.angles,
                                  arm=trigger.arm, payload=trigger.payload)
    return Watch(config, trigger=trigger)


def watch(config: IdentifierParameters) -> Watch:
    """Start to look. Raises ParameterError when the configured signals cannot show a capture."""
    if not config.angles:
        raise ParameterError('captures cannot be found in the signals without angles',
                             'name the joints in parameter angles, or give --capture-time')
    # The angles are needed here whether or not a payload is estimated.
    config = replace(config, payload_method='structured')
    if structured.init(config).model is None:
        raise ParameterError('captures cannot be found in these signals',
                             'add the torques, angles and bends of both links to inputs, angles and outputs')
    return Watch(config, trigger=TriggerParameters(
        mode='auto', inputs=config.inputs, outputs=config.outputs, angles=config.angles, arm=config.arm,
        payload=config.payload))


@dataclass
class Findings:
    """What was found in a recording, and how much of it could show an event."""

    events: list[CaptureEvent] = field(default_factory=list)
    watched: int = 0
    """Messages for which the test was on: not just after the start or an event, and not while the parameters of the
    empty arm are still being fitted."""


def with_detected(start: Watch, items: Iterable[Item], findings: Findings | None = None) -> Iterator[Item]:
    """Yield every message, and after the one that revealed it each event that was found; note those in ``findings``.

    The event carries the stamp of its onset; the pipeline goes back for it, as it does live. Blocks are looked at in
    pieces, with the result of single messages.
    """
    now = start
    findings = findings or Findings()
    for item in items:
        if isinstance(item, CaptureEvent):
            yield item
        else:
            for first in range(0, len(item.stamp_ns), PIECE):
                piece = item.part(slice(first, first + PIECE))
                after, events = look(now, piece)
                if not events and after.clock.counters.resets == now.clock.counters.resets:
                    now = after
                    findings.watched += len(piece.stamp_ns) * now.is_on
                    yield piece
                    continue
                for k in range(len(piece.stamp_ns)):
                    now, events = look(now, piece.record(k))
                    findings.events += events
                    findings.watched += now.is_on
                    yield piece.part(slice(k, k + 1))
                    yield from events


def look(now: Watch, item: JointRecord | JointBlock) -> tuple[Watch, tuple[CaptureEvent, ...]]:
    """Take a message, or a block of them without a reset; return the events that it revealed."""
    config, trigger, state, cursor = now.config, now.trigger, now.state, now.cursor
    if isinstance(item, JointRecord):
        clock, log, reset = sampling.push(config, now.clock, now.log, item)
    else:
        clock, log, reset = sampling.push_whole(config, now.clock, now.log, item)
    if clock.channels is None:
        return now._replace(clock=clock, log=log), ()
    if state is None or reset:
        trigger = replace(trigger, outputs=clock.channels.outputs)
        state, cursor = init(trigger), 0
    state, events = advance(trigger, state, log.rows(cursor, log.end))
    needed = min(first_needed(state), sampling.first_needed(log))
    return Watch(config, clock, log.from_row(needed), trigger, state, log.end), events
