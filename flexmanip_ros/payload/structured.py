"""Payload from the arm's own equations of motion, in any configuration, moving or not.

A Kalman filter with moving-horizon estimation (``moving_horizon``). States are never written to. See docs/payload.md.
"""

from __future__ import annotations

import math
from itertools import pairwise
from typing import NamedTuple

import numpy as np
import scipy

from flexmanip_ros.parameters import IdentifierParameters
from flexmanip_ros.payload import filter_state as mem
from flexmanip_ros.payload import structured_model
from flexmanip_ros.payload.capture_detection_kernel import filtered
from flexmanip_ros.payload.gauss_newton import BY_CHANCE, MOST_BIAS
from flexmanip_ros.payload.interval import POWER_LIMIT, innovation_power, judge
from flexmanip_ros.payload.measurement_update import MeasurementModel
from flexmanip_ros.payload.moving_horizon import MOST_REFITS, STARTS, excess_bias, keep_possible
from flexmanip_ros.payload.process_model import Kind, predict
from flexmanip_ros.payload.structured_model import Model, build, sensors
from flexmanip_ros.samples.sample_log import Rows
from flexmanip_ros.types import Array, CaptureEvent, EventKind, Payload

FIRST_LOOK = 24
"""Samples before the filter starts; the first guess of the noise is made from them."""
UNTAUGHT = 100
"""Samples within which a capture comes too early to learn the empty arm, which then keeps its given parameters."""
FAILED = 2
"""Fits of an empty arm that may fail before it counts as another arm. The first learns less than the others. Of 127
random arms five had two and two had three, and all of these were fitted in the end."""
LONGEST_S = 10.0
"""Longest time from the last sample to an event over which the motion is predicted [s]; beyond it is unknown anyway."""
TAKEN_FOR_NOISE = [mem.EFFECTIVE, mem.POWER, mem.SLOW]
"""Columns of the noise in which residuals of a wrong fit are."""


class StructuredState(NamedTuple):
    """Everything remembered; constant in size."""

    model: Model | None
    """None when the configured signals, or samples as rare as these, cannot give a payload."""
    sensors: MeasurementModel | None = None
    memory: mem.FilterState | None = None
    begin: int | None = None
    """Row of the sample log with which it starts, while there are not enough rows to start."""
    early: tuple[tuple[int, CaptureEvent], ...] = ()
    """Events before it started, each with the row that follows it."""
    cursor: int = 0
    """Row of the sample log that it takes next."""
    horizon: Horizon | None = None
    """Where the moving horizon begins."""
    next: Arrival | None = None
    """Where it will begin when it slides, while the arm is at rest."""
    last_ns: int = 0
    time_ns: int = 0
    """Instant of the state [ns]: when the last row was sampled, or the event after it."""
    efforts: Array | None = None
    """(P, L) effort held since then, and those of the samples before, newest last [N m]."""
    rates: Array = np.empty(0)
    """(L,) measured rates of the joints in that sample [rad/s]; NaN: unknown."""
    missing: int = 0
    """How many rows in a row were missing up to now."""
    peak: Array = np.empty(0)
    """(L,) largest size of each torque so far [N m]."""
    slope: Array = np.zeros(1)
    """(L,) change of each torque over the last sample that was measured [N m]."""
    restarts: int = 0
    """How often all was forgotten because numbers left the finite range."""
    refits: int = 0
    """How often the empty arm's fit was begun again."""
    skipped: int = 0
    """Samples of an empty arm whose fits all failed, see ``strays``."""
    white: Array = np.empty(0)
    """(m, 2) variance of each measurement's white noise at the last restart, and its bound by the spectrum."""
    known: Array = np.empty(0)
    """What was known of the empty arm at the last restart, see ``FilterState.known``; (0,): nothing."""

    @property
    def running(self) -> Running:
        """What there is once it has started."""
        assert self.model is not None
        assert self.sensors is not None
        assert self.memory is not None
        assert self.efforts is not None
        assert self.horizon is not None
        return Running(self.model, self.sensors, self.memory, self.efforts, self.horizon)

    @property
    def here(self) -> Horizon:
        """A horizon that begins with the next row."""
        assert self.efforts is not None
        return Horizon(self.cursor, self.time_ns, self.efforts, self.rates)


class Running(NamedTuple):
    """The parts of ``StructuredState`` that there are once it has started."""

    model: Model
    sensors: MeasurementModel
    memory: mem.FilterState
    efforts: Array
    horizon: Horizon


class Arrival(NamedTuple):
    """Where the horizon of an arm at rest will begin next, and its arrival cost."""

    horizon: Horizon
    x: Array
    """(nx,) mean."""
    S: Array
    """(nx, nx) square root of the covariance."""
    noise: Array
    """(m, 11) what was known of each sensor's noise."""
    ringing: Array
    """(3, L) vibration of omitted modes, and the last efforts; see ``note_change``."""


class Horizon(NamedTuple):
    """The rows of the sample log since the last event or gap."""

    row: int
    """Its first row."""
    before_ns: int
    """Instant of the state from which it starts [ns]."""
    efforts: Array
    """(P, L) effort held from there on, and those of the samples before [N m]."""
    rates: Array
    """(L,) measured rates of the joints there [rad/s]; NaN: unknown."""


def init(config: IdentifierParameters) -> StructuredState:
    """Start with an empty arm of which nothing is measured."""
    return StructuredState(build(config))


def first_needed(state: StructuredState) -> int:
    """Return the first row of the sample log that will be read again."""
    if state.begin is not None:
        return state.begin
    if state.memory is None or state.horizon is None or not _has_horizon(state.memory):
        return state.cursor
    return state.horizon.row


def _has_horizon(m: mem.FilterState) -> bool:
    """Whether the rows of the horizon will be read again: it is open, or slides along with an arm at rest."""
    return bool(m.counts[mem.STORED] < mem.HORIZON or m.counts[mem.RESTS] == mem.RESTING)


def advance(config: IdentifierParameters, state: StructuredState, rows: Rows) -> StructuredState:
    """Take the next rows of the sample log; the same bits as one by one."""
    if state.model is None or not len(rows):
        return state._replace(cursor=rows.until)
    if state.memory is None:
        begin = rows.first if state.begin is None else state.begin
        if rows.until - begin < FIRST_LOOK:
            return state._replace(begin=begin, cursor=rows.until)
        state = _begin(config, state, rows.since(begin).between(begin, begin + FIRST_LOOK))
        rows = rows.since(begin + FIRST_LOOK)
    for broken, part in _parts(state, rows):
        if state.memory is None:  # it restarted meanwhile
            state = advance(config, state, part)
            continue
        if broken:  # ``unknown_torque`` is linearized at one instant; over more than a block that is some percent off
            is_short = 0 < state.missing <= state.running.sensors.block
            state = _bridge(state, part) if is_short else _resume(config, state, part)
        state = _run(config, state, part)
    return state


def event(config: IdentifierParameters, state: StructuredState, event: CaptureEvent) -> StructuredState:
    """The arm took or let go of something before the next sample."""
    if state.model is None:
        return state
    if state.memory is None:
        refits = 0 if event.kind is EventKind.CAPTURE else min(state.refits, MOST_REFITS)
        return state._replace(early=(*state.early, (state.cursor, event)), refits=refits, skipped=0)
    model, sensors, memory, efforts, _ = state.running
    m = mem.copy(memory)
    ahead = max(event.stamp_ns - state.time_ns, 0)
    before = event.kind is EventKind.CAPTURE and is_held_before(sensors, m, event)
    if before and not m.known[1].any() and not is_another_arm(m):
        return StructuredState(model, restarts=state.restarts, cursor=state.cursor, efforts=efforts,
                               early=((state.cursor, event._replace(std_s=0.0)),),
                               white=m.noise[:, [mem.WHITE, mem.LEVEL]])
    rows, rates = np.pad(efforts, ((0, 0), (1, 0))), np.full(state.rates.size, np.nan)
    predict(model.motion, m.x, m.S, m.x.size, rows, sensors.period, min(ahead * 1e-9, LONGEST_S))
    if before and m.known[1].any():
        m.x[:], m.S[:] = m.known[1, :, -1], m.known[1, :, :-1]
        structured_model.guess_noise(m, int(m.counts[mem.SEEN]))
        m.noise[:, mem.AT_EVENT] = m.noise[:, mem.EFFECTIVE]
        m.counts[mem.MOVED], m.score[mem.MOVES], m.score[mem.EXCESS_BIAS] = 0, 0.0, 0.0
        _forget_payload(model, m)
        m.counts[[mem.HELD, mem.LEARNED]] = 1
        _hold_from_here(config, model, m, m.recent[:, 0], 0)
    else:
        _change(config, model, m, event)
    state = state._replace(memory=m, last_ns=max(event.stamp_ns, state.last_ns), time_ns=state.time_ns + ahead,
                           rates=rates)
    return state._replace(horizon=state.here)


def estimate(config: IdentifierParameters, state: StructuredState) -> Payload:
    """Return the payload with its interval; never a NaN."""
    return judge(config, state.model, state.sensors, state.memory, state.restarts, state.peak)


def _change(config: IdentifierParameters, model: Model, m: mem.FilterState, event: CaptureEvent) -> None:
    """Make uncertain what an event changes: the rates, and what is held."""
    payload, kind = model.payload, event.kind
    held = bool(m.counts[mem.HELD])
    before = max(float(m.x[payload]), 0.0) if held else 0.0
    if kind is EventKind.CAPTURE and m.counts[mem.SEEN] < UNTAUGHT:
        structured_model.take_as_known(model, m)
    columns = structured_model.jump(config, model, m, math.hypot(event.std_s, config.payload.event_time_std))
    opened = np.zeros((m.x.size, model.body))
    if kind is EventKind.CAPTURE:
        if not held:
            _forget_payload(model, m)  # the arm was empty: its payload was the bias of the model
            if not m.counts[mem.LEARNED] and is_another_arm(m):
                m.score[mem.EXCESS_BIAS] = math.inf
            m.counts[mem.LEARNED] = m.counts[mem.SEEN] >= UNTAUGHT
        # a point first, but one that joins a body makes a body
        added = model.body if m.S[payload + 1:payload + model.body].any() else 1
        opened[payload:payload + added, :added] = np.diag(structured_model.body_std(config, model)[:added])
        m.x[payload:payload + added] += structured_model.body_mean(config, model)[:added]
        m.counts[mem.REFITS] = 0
        m.counts[mem.HELD] = 1
    else:
        _forget_payload(model, m)
        opened[payload, 0] = structured_model.EMPTY_STD * model.motion.scale + 0.3 * before
        m.counts[mem.HELD] = 0
        m.counts[mem.REFITS] = min(m.counts[mem.REFITS], MOST_REFITS)  # what is left is fitted once more
    m.counts[mem.SKIPPED] = 0
    m.S[:] = structured_model.widen(m.S, np.hstack([columns, opened]))
    if m.counts[mem.STORED] < mem.HORIZON and m.counts[mem.SEEN] >= UNTAUGHT:  # guessed from the first samples
        structured_model.guess_noise(m, int(m.counts[mem.SEEN]))
    m.noise[:, mem.AT_EVENT] = m.noise[:, mem.EFFECTIVE]
    _set_arrival_cost(model, m)


def is_held_before(sensors: MeasurementModel, m: mem.FilterState, event: CaptureEvent) -> bool:
    """Whether an object was held for longer than a tenth of the slowest period when its capture was announced.

    So it is where the event says so, or where the filter explained the empty arm once and does not now. The samples
    since then are those of another arm. The effect of an unknown instant is linearized, see ``jump``: over more than
    that time it is some percent off.
    """
    if m.counts[mem.HELD]:
        return False
    if event.std_s > sensors.block * sensors.period:
        return True
    refitted = m.counts[mem.SEEN] < UNTAUGHT or (m.counts[mem.REFITS] > 0 and m.counts[mem.STORED] < mem.HORIZON)
    strayed = refitted or m.score[mem.EXCESS_BIAS] != 0.0 or innovation_power(sensors, m)[0] > POWER_LIMIT
    return bool(m.known[1].any() and strayed)


def is_another_arm(m: mem.FilterState) -> bool:
    """Whether an empty arm is another one than was told: over ``FAILED`` of its fits failed, and none fits since."""
    fits = m.counts[mem.STORED] == mem.HORIZON and m.score[mem.EXCESS] < BY_CHANCE
    return bool(m.counts[mem.REFITS] > FAILED and not fits)


def _forget_payload(model: Model, m: mem.FilterState) -> None:
    """Condition an empty arm on a payload of zero; forget a payload that is let go."""
    payload = model.payload
    if not m.counts[mem.HELD]:
        f = m.S[payload].copy()
        square = float(f @ f)
        if square > 0.0:
            if m.counts[mem.SINCE_EVENT] > mem.ENOUGH:
                m.score[mem.EMPTY_ARM_BIAS] = m.x[payload] / math.sqrt(square)
            if m.counts[mem.SINCE_EVENT] > mem.ENOUGH or m.counts[mem.REFITS]:  # a fit begun again is doubted sooner
                # the bias for which a fit was begun again counts until a horizon closes with a fit, see close_horizon
                m.score[mem.EXCESS_BIAS] = max(m.score[mem.EXCESS_BIAS], excess_bias(model.motion, m), key=abs)
            gain = m.S @ f / square
            m.x[:] -= gain * m.x[payload]
            m.S[:] -= np.outer(gain, f)
    m.x[payload:payload + model.body] = 0.0
    m.S[payload:payload + model.body] = 0.0


def _set_arrival_cost(model: Model, m: mem.FilterState) -> None:
    """Begin a horizon at an event: the present state is its arrival cost; figures of payload and noise start again."""
    _begin_horizon(model, m)
    m.counts[[mem.SINCE_EVENT, mem.EXPLAINS]] = 0
    m.swing[:] = 0.0
    m.counts[mem.BLOCKS] = min(m.counts[mem.BLOCKS], 40)
    m.score[:mem.EMPTY_ARM_BIAS] = 0.0
    m.score[mem.DOUBT] = np.linalg.norm(m.S[model.payload]) / max(m.x[model.payload], 1e-300)
    m.noise[:, mem.WEIGHT] = 0.0
    m.power[:] = 1.0


def _open_body(config: IdentifierParameters, model: Model, m: mem.FilterState) -> None:
    """Fit a rigid body to the samples since the event, from the state just before it, as no point mass fits.

    If a body was fitted before, that fit ended in a wrong minimum: begin again with the centre of mass on the other
    side. The filter goes on as it is until the fit replaces its state.
    """
    body = slice(model.payload, model.payload + model.body)
    if m.S0[body][1:].any():
        there = m.x0 + m.S0 @ m.accepted
        _refit(m)
        aim = m.x0.copy()
        aim[body] = structured_model.body_mean(config, model)
        aim[model.payload + 1:model.payload + 3] = -there[model.payload + 1:model.payload + 3]
        _fit_from(m, aim)
        return
    m.S0[:] = structured_model.widen(m.S0, _unknown_body(config, model, m.x0, m.S0, model.body))
    _refit(m)


def _unknown_body(config: IdentifierParameters, model: Model, x: Array, S: Array, size: int) -> Array:
    """Set the body in the state x (nx,) to its prior mean, known exactly; return the columns (nx, size) of its prior.

    size: number of its inertial parameters that are unknown, 1: of a point, whose others are zero.
    """
    body, opened = slice(model.payload, model.payload + model.body), slice(model.payload, model.payload + size)
    x[body], S[body] = 0.0, 0.0
    x[opened] = structured_model.body_mean(config, model)[:size]
    columns = np.zeros((x.size, size))
    columns[opened] = np.diag(structured_model.body_std(config, model)[:size])
    return columns


def _fit_from(m: mem.FilterState, start: Array) -> None:
    """Let the first iteration of the fit be linearized at a state (nx,) at the event that is not its prior mean x0."""
    unknown = m.S0.any(axis=1)
    rank = int(unknown.sum())
    departure = (start - m.x0)[unknown]
    m.xi[:rank] = scipy.linalg.solve_triangular(m.S0[unknown, :rank], departure, lower=True)
    m.accepted[:] = m.xi


def _fit_with_tip(config: IdentifierParameters, state: StructuredState, y: Array) -> StructuredState:
    """Fit the simplest arm with an unknown rotary inertia of the tip mass, after measurements y (m,).

    To the same samples, or to further ones where the horizon has closed and the filter seems to hold something.
    """
    model, m = state.running.model, mem.copy(state.running.memory)
    tip = model.motion.kind == Kind.TIP_INERTIA
    column = np.zeros((m.x.size, 1))
    column[model.payload:][tip, 0] = model.motion.prior[tip]
    if m.counts[mem.STORED] == mem.HORIZON:
        _fit_empty_arm_again(config, model, m, y, column)
        return state._replace(memory=m, horizon=state.here)
    m.S0[:] = structured_model.widen(m.S0, column)
    _refit(m)
    return state._replace(memory=m)


def _fit_empty_arm_again(config: IdentifierParameters, model: Model, m: mem.FilterState, y: Array,
                         opened: Array) -> None:
    """Fit an empty arm that seems to hold something to further samples, after measurements y (m,).

    The fit begins where the last one ended, which may not have converged when its horizon closed. The priors are those
    of the start, as the samples of that fit are not used again. opened: columns (nx, c) of what was known until now.
    """
    p = slice(model.payload, m.x.size)
    learned, known = m.x[p].copy(), ~m.S[p].any(axis=1)
    bias = excess_bias(model.motion, m)
    structured_model.first(config, model, m, y)
    given = np.where(known, learned, m.x[p])
    m.x[p] = learned
    m.S[p][known] = 0.0
    m.S[:] = structured_model.widen(m.S, opened)
    structured_model.guess_noise(m, int(m.counts[mem.SEEN]))
    _set_arrival_cost(model, m)
    start = m.x0.copy()
    m.x0[p] = given
    m.counts[mem.MOVED], m.score[mem.MOVES] = 0, 0.0  # moves of a fit that is given up tell nothing of the next
    m.score[mem.EXCESS_BIAS] = bias  # makes the arm INCONSISTENT until the new horizon closes
    _fit_from(m, start)


def _begin_horizon(model: Model, m: mem.FilterState) -> None:
    """Begin a new moving horizon here: the present state is its arrival cost.

    After too many fits that failed it stays closed: reading its rows again takes seconds, and the next fails as well.
    """
    keep_possible(model.motion, m, 0.0)  # over a whole horizon a damping ratio below zero explodes
    m.x0[:], m.S0[:] = m.x, m.S
    m.ringing[1] = m.ringing[0]
    m.counts[mem.STORED] = mem.HORIZON if m.counts[mem.REFITS] > MOST_REFITS else 0
    m.counts[mem.RESTS] = mem.MOVES_ABOUT
    _refit(m)


def _refit(m: mem.FilterState) -> None:
    """Begin the iterations of the fit again, at the first samples of the horizon."""
    m.counts[mem.USED] = int(m.S0.any(axis=1).sum())
    m.xi[:] = 0.0
    m.counts[[mem.ITERATED, mem.ITERATING, mem.SINCE_NOISE, mem.IN_BATCH, mem.BEFORE, mem.REJECTED, mem.AGAIN,
              mem.TRIED, mem.WITH_TIP]] = 0
    if m.counts[mem.EFFORTS] == mem.COMPARED:
        m.counts[mem.EFFORTS] = mem.NOISY
    m.score[[mem.LAMBDA, mem.DISAGREES]] = 0.0
    m.early_normal[:], m.early_gradient[:] = 0.0, 0.0


def _begin(config: IdentifierParameters, state: StructuredState, rows: Rows) -> StructuredState:
    """Start the filter with its first rows, and take them and the events among them; not where they are too rare."""
    dt = float(np.median(np.diff(rows.stamp_ns) * 1e-9))
    if dt > structured_model.longest_sample_time(config.arm):
        return state._replace(model=None, begin=None, cursor=rows.until)
    fewer = structured_model.sampled(config, dt)
    again = state.efforts is not None  # then the model is that of the first start, with its working point
    model = state.model if again or fewer is config else build(fewer)
    assert model is not None
    Y = measurements(model, rows)
    m = mem.memory(2 * model.motion.arm.stiffness.size + model.motion.kind.size, len(model.roles),
                   model.motion.effort.size)
    if state.known.size:
        m.known[:] = state.known
    m.noise[:] = structured_model.noise(model, Y)
    structured_model.first(config, model, m, Y[0])
    if not again:
        structured_model.freeze(fewer, model, np.mean(rows.angles, axis=0))
    if state.white.size:
        m.noise[:, [mem.WHITE, mem.LEVEL]] = state.white
    structured_model.guess_noise(m, FIRST_LOOK)
    # the simplest arm first; then all that may be learned, with late signals and without in turn
    if state.refits:
        structured_model.expect_rotors_and_friction(model, m)
    if state.refits % 2 == 0:
        structured_model.take_as_known(model, m, Kind.MODE if state.refits else Kind.DAMPING)
    m.S[:] = structured_model.triangular(m.S)
    _set_arrival_cost(model, m)
    seen = sensors(fewer, model, dt, np.mean(rows.angles, axis=0))
    events = state.early
    time_ns, efforts = int(rows.time_ns[0]), latest(seen, rows.u[:1], state.efforts)
    m.ringing[:, 2] = efforts[-1]
    rates = np.full(efforts.shape[1], np.nan)
    if rows.rates.shape[1]:
        m.rate_noise[:] = structured_model.rate_noise(rows.rates, dt)
    state = state._replace(
        model=model, memory=m, sensors=seen, begin=None, early=(), cursor=rows.first, last_ns=int(rows.stamp_ns[0]),
        time_ns=time_ns, efforts=efforts, rates=rates)
    state = state._replace(horizon=state.here)
    for row, item in events:
        state = event(config, _part(config, state, rows, row), item)
    if state.memory is not None:  # the capture with which ``restart`` begins again is no new one
        state.memory.counts[[mem.REFITS, mem.SKIPPED]] = state.refits, state.skipped
        if state.refits > MOST_REFITS:
            state.memory.counts[mem.STORED] = mem.HORIZON
    return _part(config, state, rows, rows.until)


def _part(config: IdentifierParameters, state: StructuredState, rows: Rows, until: int) -> StructuredState:
    """Take the rows from the cursor to ``until``."""
    return advance(config, state, rows.between(state.cursor, until)) if until > state.cursor else state


def _resume(config: IdentifierParameters, state: StructuredState, rows: Rows) -> StructuredState:
    """After a gap: start at the measurements of the first row."""
    model, sensors, *_ = state.running
    state = state._replace(missing=0, last_ns=int(rows.stamp_ns[0]), time_ns=int(rows.time_ns[0]),
                           efforts=latest(sensors, rows.u[:1]))
    state = reopen(config, state, measurements(model, rows.between(rows.first, rows.first + 1))[0])
    state.running.memory.counts[mem.IN_A_ROW] = 0  # differences over a gap tell no noise
    return state


def latest(sensors: MeasurementModel, efforts: Array, before: Array | None = None) -> Array:
    """Return the efforts (P, L) that the next torques depend on; before these (N, L) the effort was constant."""
    if before is not None:
        efforts = np.vstack([before[-sensors.reach:], efforts])
    missing = sensors.reach - len(efforts)
    if missing > 0:
        return np.vstack([np.tile(efforts[0], (missing, 1)), efforts])
    return efforts[-missing:].copy()


def _bridge(state: StructuredState, rows: Rows) -> StructuredState:
    """Widen the covariance by what torques may have done that changed at an unknown time while samples were missing."""
    model, sensors, memory, efforts, _ = state.running
    m = mem.copy(memory)
    change = _unforeseen(rows.u[0] - efforts[-1], state.slope, state.missing)
    columns = structured_model.unknown_torque(model, m, change, state.missing, sensors.period)
    m.S[:] = structured_model.widen(m.S, columns)
    if _has_horizon(m):  # it has no process noise
        _begin_horizon(model, m)
    return state._replace(memory=m, missing=0, horizon=state.here)


UNKNOWN_TORQUE = 0.1
"""Change of a torque over missing samples, over its peak, times their number, below which it is neglected: its effect
is some 1e-4 of that of a step of the whole torque."""


def _parts(state: StructuredState, rows: Rows) -> list[tuple[bool, Rows]]:
    """Return the rows in pieces, each with whether a gap or an unknown change of torque precedes its first row."""
    if not len(rows):
        return []
    if not state.missing and not rows.gap.any() and not rows.missing.any():  # as nearly always
        return [(False, rows)]
    before = state.efforts[-1] if state.efforts is not None else rows.u[0]
    absent = np.concatenate([[state.missing], rows.missing[:-1]]) * (rows.missing == 0)
    broken = rows.gap
    if absent.any():
        slope = np.diff(np.vstack([before, rows.u]), axis=0)
        at = np.arange(len(rows)) - absent - 1  # the last row before the missing ones
        change = _unforeseen(slope, np.where(at[:, None] < 0, state.slope, slope[np.maximum(at, 0)]), absent[:, None])
        broken = broken | (absent[:, None] * np.abs(change) > UNKNOWN_TORQUE * _peaks(state, rows)).any(axis=1)
    borders = [rows.first, *(np.flatnonzero(broken[1:]) + rows.first + 1).tolist(), rows.until]
    return [(bool(broken[a - rows.first]), rows.between(a, b)) for a, b in pairwise(borders)]


def _unforeseen(step: Array, slope: Array, missing: int | Array) -> Array:
    """Return the change of the torques over missing samples that nothing foretold [N m].

    step: their change from one missing sample to the next, interpolated; slope: their change over the last sample
    before. A torque that keeps its value is foretold, and so is one that keeps its slope; the smaller difference
    counts.
    """
    change = (missing + 1) * step
    beyond = change - (missing + 1) * slope
    return np.where(np.abs(beyond) < np.abs(change), beyond, change)


def _peaks(state: StructuredState, rows: Rows) -> Array:
    """Return the largest size (N, L) of each torque up to each row [N m]."""
    sizes = np.abs(rows.u)
    return np.maximum.accumulate(np.vstack([state.peak, sizes]) if state.peak.size else sizes)[-len(rows):]


def reopen(
    config: IdentifierParameters, state: StructuredState, y: Array | None = None,
) -> StructuredState:
    """Start the motion again from measurements y (m,), and keep what is known of arm, payload and noise."""
    model, m = state.running.model, mem.copy(state.running.memory)
    _start_motion(config, model, m, m.recent[:, 0] if y is None else y, m.S)
    _set_arrival_cost(model, m)
    return state._replace(memory=m, horizon=state.here)


def _start_motion(config: IdentifierParameters, model: Model, m: mem.FilterState, y: Array, spread: Array) -> None:
    """Start the motion from measurements y (m,); keep the mean of payload and arm, take their rows of ``spread``."""
    payload = model.payload
    parameters, spread = m.x[payload:].copy(), spread.copy()
    structured_model.first(config, model, m, y)
    m.x[payload:], m.S[payload:], spread[:payload] = parameters, 0.0, 0.0
    m.S[:] = structured_model.widen(m.S, spread)


def _run(config: IdentifierParameters, state: StructuredState, rows: Rows) -> StructuredState:
    """Take rows without a gap among them."""
    while len(rows):
        model, sensors, memory, *_ = state.running
        m = mem.copy(memory, horizon=False)
        # an arm at rest returns after every slide, and the table of what is left is made again
        part = rows.between(rows.first, min(rows.first + mem.HORIZON, rows.until))
        table, first = input_table(state, part)
        failed = filtered(model.motion, sensors, m, table, first) - first
        taken = part.between(part.first, min(part.first + failed + 1, part.until))
        after = after_rows(state, m, taken, table[:first + len(taken)])
        rows = rows.since(taken.until)
        if failed < len(part):
            after = restart(config, state, after, taken.since(taken.until - 1))
            if after.memory is None:
                return advance(config, after, rows)
        state = after
    return state


def after_rows(state: StructuredState, m: mem.FilterState, taken: Rows, table: Array) -> StructuredState:
    """Return the state once the filter, now with memory m, took these rows, the last of the table."""
    links = taken.u.shape[1]
    efforts = latest(state.running.sensors, taken.u[-1:], table[:, 1:1 + links])
    slope = state.slope
    measured = np.flatnonzero(taken.missing == 0)
    if len(measured):
        last = int(measured[-1])
        slope = taken.u[last] - (taken.u[last - 1] if last else state.running.efforts[-1])
    return state._replace(memory=m, cursor=taken.until, last_ns=int(taken.stamp_ns[-1]),
                          time_ns=int(taken.time_ns[-1]), efforts=efforts,
                          rates=table[-1, 1 + 2 * links:1 + 3 * links].copy(), slope=slope,
                          missing=int(taken.missing[-1]), peak=_peaks(state, taken)[-1].copy())


def input_table(state: StructuredState, rows: Rows) -> tuple[Array, int]:
    """Return what the kernel reads, (N, 1 + 3 L + m), and the row of it that belongs to the first of ``rows``.

    Columns: duration since the sample before [s]; efforts held meanwhile [N m]; rates of the joints before and after
    [rad/s] (NaN: unknown); measurements (NaN: missing). While the horizon is open the table reaches back to its first
    row; before that come the efforts that a late torque needs.
    """
    model, *_, horizon = state.running
    begin = first_needed(state)
    _, before_ns, efforts, rates = horizon if begin < rows.first else state.here
    reach = rows.since(begin)
    times, y = reach.time_ns, measurements(model, reach)
    before, links = len(efforts) - 1, efforts.shape[1]
    first = 1 + 3 * links
    whole = np.zeros((before + len(y), first + y.shape[1]))
    whole[:before + 1, 1:1 + links] = efforts
    table = whole[before:]
    table[0, 0] = times[0] - before_ns
    table[1:, 0], table[1:, 1:1 + links] = times[1:] - times[:-1], reach.u[:-1]
    np.maximum(table[:, 0], 0.0, out=table[:, 0])
    table[:, 0] *= 1e-9
    begins, ends = table[:, 1 + links:1 + 2 * links], table[:, 1 + 2 * links:first]
    ends[:] = reach.rates if reach.rates.shape[1] else np.nan
    table[:, first:] = y
    table[reach.missing > 0, 1 + 2 * links:] = np.nan
    begins[0], begins[1:] = rates, ends[:-1]
    return whole, before + rows.first - begin


def restart(config: IdentifierParameters, before: StructuredState, state: StructuredState, last: Rows,
            ) -> StructuredState:
    """Begin again after the last row, at which numbers left the finite range or a fit failed.

    Or let the horizon begin there, as the samples before disagree with the later ones, or that of an arm at rest slide
    or open there.

    before: the state before these rows.

    The first fit of an empty arm estimates few of its parameters, and is made again with the rotary inertia of the tip
    mass before it is given up. Later ones estimate all of ``payload.learn``, every second one without late signals. One
    that only seems to hold something begins with what was learned. After more than ``MOST_REFITS`` the filter goes on
    without a fit, as none ever fits with signals in other units; two more follow at times that double (``strays``). The
    first fit of an object is one of a point, the next two are of a body (``_open_body``). Then the horizon begins later
    (``_begin_later``), with what was learned of the arm before the event; an arm that was not learned, or that fails
    within ``FIRST_LOOK`` samples, begins with its given parameters. Numbers that leave the finite range while the
    horizon is open count as a fit that failed.
    """
    model, _, m, *_ = state.running
    if m.counts[mem.RESTS] == mem.BEGINS_TO_MOVE:
        return _begin_to_move(state)
    if m.counts[mem.RESTS] == mem.SLIDES:
        return _slide(state)
    y = measurements(model, last)[0]
    if m.counts[mem.WITH_TIP]:
        return _fit_with_tip(config, state, y)
    refits = int(m.counts[mem.REFITS])
    unfit = refits > before.running.memory.counts[mem.REFITS]
    refits += not unfit and m.counts[mem.STORED] < mem.HORIZON
    if unfit and refits <= STARTS and m.counts[mem.HELD] and model.body > 1 and m.counts[mem.STORED] < mem.HORIZON:
        m = mem.copy(m)
        _open_body(config, model, m)
        return state._replace(memory=m)
    if unfit and refits > 1 and not m.counts[mem.HELD] and is_off(state):  # the simplest arm is given up
        m = mem.copy(m)
        _fit_empty_arm_again(config, model, m, y, np.empty((m.x.size, 0)))
        return state._replace(memory=m, horizon=state.here)
    later = m.counts[mem.SKIPPED] > before.running.memory.counts[mem.SKIPPED]
    at_once = m.counts[mem.SINCE_EVENT] < FIRST_LOOK  # what was learned moves as no arm does
    if m.counts[mem.HELD] and (later or (m.counts[mem.LEARNED] and np.isfinite(m.S0).all() and not at_once)):
        return _begin_later(config, state, y, m.counts[mem.SKIPPED] + (0 if later else m.counts[mem.SINCE_EVENT]))
    fresh = StructuredState(model, restarts=state.restarts + (not (unfit or later)), cursor=state.cursor,
                            refits=MOST_REFITS - 1 if later else refits, skipped=int(m.counts[mem.SKIPPED]),
                            efforts=state.efforts, known=np.empty(0) if m.counts[mem.HELD] else m.known)
    if (unfit or later) and m.counts[mem.SEEN] >= UNTAUGHT:
        fresh = fresh._replace(white=m.noise[:, [mem.WHITE, mem.LEVEL]])
    if m.counts[mem.HELD]:
        grasped = CaptureEvent(state.last_ns, EventKind.CAPTURE)
        fresh = fresh._replace(early=((state.cursor, grasped),))
    return fresh


def _begin_later(config: IdentifierParameters, state: StructuredState, y: Array, skipped: int) -> StructuredState:
    """Begin the horizon here, with the motion from measurements y (m,) and what was known of the arm at the event.

    The object is a point at first, as at the event. skipped: number of samples since the event. A horizon that begins
    later costs little: 0.1 s after its begin the payload's deviation is that of one which began with the event.
    """
    model, m = state.running.model, mem.copy(state.running.memory)
    m.x[:], m.S[:] = m.x0, m.S0
    _hold_from_here(config, model, m, y, skipped)
    return state._replace(memory=m, horizon=state.here)


def _hold_from_here(config: IdentifierParameters, model: Model, m: mem.FilterState, y: Array, skipped: int) -> None:
    """Begin a horizon with an unknown object, a point at first, and the motion of measurements y (m,)."""
    opened = _unknown_body(config, model, m.x, m.S, 1)
    _start_motion(config, model, m, y, np.hstack([m.S, opened]))
    m.counts[mem.REFITS], m.counts[mem.SKIPPED] = 0, skipped
    m.noise[:, TAKEN_FOR_NOISE] = m.noise[:, [mem.AT_EVENT]]
    _set_arrival_cost(model, m)


def _slide(state: StructuredState) -> StructuredState:
    """Let the horizon of an arm at rest begin where the arm was when it slid before.

    So it has always begun before the motion that tells of the payload, and the fit reads all of that. What the samples
    seem to tell of an object until then is forgotten: it is a fit to noise.
    """
    model, memory, begin = state.running.model, state.running.memory, state.running.horizon
    m = mem.copy(memory)
    if state.next is not None and state.next.horizon.row > begin.row:  # else it has just come to rest
        begin = state.next.horizon
        m.x0[:], m.S0[:], m.ringing[1] = state.next.x, state.next.S, state.next.ringing
    if m.counts[mem.HELD]:
        body, prior = slice(model.payload, model.payload + model.body), np.zeros_like(m.S)
        prior[body], m.x[body], m.S[body] = memory.S0[body], memory.x0[body], 0.0
        m.S[:] = structured_model.widen(m.S, prior)
        m.counts[mem.USED] = int(m.S.any(axis=1).sum())
    m.swing[:] = 0.0
    m.counts[mem.IN_BATCH], m.counts[mem.RESTS] = 0, mem.RESTING
    return state._replace(memory=m, horizon=begin, next=Arrival(
        state.here, m.x.copy(), structured_model.triangular(m.S), m.noise.copy(), m.ringing[0].copy()))


def _begin_to_move(state: StructuredState) -> StructuredState:
    """Open the horizon of an arm that was at rest; the filter goes on as it is until the fit replaces its state."""
    model, _, memory, _, horizon = state.running
    m = mem.copy(memory)
    x, S, ringing = m.x.copy(), m.S.copy(), m.ringing[0].copy()
    m.x[:], m.S[:], m.ringing[0] = m.x0, m.S0, m.ringing[1]
    _set_arrival_cost(model, m)
    m.x[:], m.S[:], m.ringing[0] = x, S, ringing
    m.counts[[mem.STORED, mem.SINCE_EVENT]] = state.cursor - horizon.row
    if state.next is not None:
        m.noise[:, TAKEN_FOR_NOISE] = state.next.noise[:, TAKEN_FOR_NOISE]
    return state._replace(memory=m, next=None)


def is_off(state: StructuredState) -> bool:
    """Whether an empty arm whose horizon has closed fits the samples and yet seems to hold something."""
    model, sensors, m, *_ = state.running
    if m.counts[mem.STORED] < mem.HORIZON or abs(excess_bias(model.motion, m)) <= MOST_BIAS:
        return False
    return innovation_power(sensors, m)[0] < POWER_LIMIT


def measurements(model: Model, rows: Rows) -> Array:
    """Return the outputs that are measurements and the angles that are not among them, (N, m)."""
    return np.hstack([rows.y[:, list(model.kept)], rows.angles[:, list(model.extra)]])
