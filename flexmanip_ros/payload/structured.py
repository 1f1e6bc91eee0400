"""Payload from the arm's own equations of motion, in any configuration, moving or not.

A filter and a refit behind it (``structured_kernel``). States are never written to. See docs/payload.md.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np

from flexmanip_ros.numerics.compiled import Prepared
from flexmanip_ros.parameters import IdentifierParameters
from flexmanip_ros.payload import filter_state as mem
from flexmanip_ros.payload import residual_modes
from flexmanip_ros.payload import structured_start as start
from flexmanip_ros.payload.interval import inexact, judge
from flexmanip_ros.payload.measurement_update import Sensors
from flexmanip_ros.payload.moving_horizon import advance as run_kernel
from flexmanip_ros.payload.process_model import PARAMETERS, predict
from flexmanip_ros.payload.structured_model import Model, build, sensors
from flexmanip_ros.payload.tail_kernel import believed, push, ring
from flexmanip_ros.types import Array, CaptureEvent, EventKind, Payload, Sample

FIRST_LOOK = 24
"""Samples looked at before the filter starts: they tell its noise."""
LONGEST_S = 10.0
"""An event this long after the last sample finds a motion nobody knows; the next sample starts anew."""
run = Prepared(run_kernel, 2)


class StructuredState(NamedTuple):
    """Everything remembered; constant in size."""

    model: Model | None
    """None when the configured signals cannot give a payload."""
    sensors: Sensors | None = None
    memory: mem.Memory | None = None
    waiting: tuple[Sample | CaptureEvent, ...] = ()
    """What came before the filter started."""
    last_ns: int = 0
    effort: Array | None = None
    """(2,) torque held since then."""
    released: float = 0.0
    """Payload let go at the last release [kg]."""
    restarts: int = 0
    """How often numbers left the finite range."""


def init(config: IdentifierParameters) -> StructuredState:
    """Start with an empty arm of which nothing is measured."""
    return StructuredState(build(config))


def step(config: IdentifierParameters, state: StructuredState, sample: Sample) -> StructuredState:
    """Take one sample."""
    return advance(config, state, (sample,))


def advance(
    config: IdentifierParameters, state: StructuredState, samples: Sequence[Sample],
) -> StructuredState:
    """Take samples in the order of their stamps; the same bits as one by one."""
    if state.model is None or not samples:
        return state
    if state.memory is None:
        needed = FIRST_LOOK - sum(isinstance(item, Sample) for item in state.waiting)
        state = state._replace(waiting=(*state.waiting, *samples[:needed]))
        if len(samples) < needed:
            return state
        state, samples = _begin(config, state), samples[needed:]
    begin = 0
    for stop in [i for i, sample in enumerate(samples) if sample.gap and i > 0] + [len(samples)]:
        part = samples[begin:stop]
        if state.memory is None:
            state = advance(config, state, part)  # it restarted meanwhile
        else:
            if part and part[0].gap:
                state = _resume(config, state, part[0])
            state = _run(config, state, part)
        begin = stop
    return state


def event(config: IdentifierParameters, state: StructuredState, event: CaptureEvent) -> StructuredState:
    """The arm took or let go of something before the next sample."""
    if state.model is None:
        return state
    if state.memory is None:
        return state._replace(waiting=(*state.waiting, event))
    m = mem.copy(state.memory)
    assert state.effort is not None
    assert state.sensors is not None
    ahead, held = max(event.stamp_ns - state.last_ns, 0), bool(m.counts[mem.HELD])
    predict(state.model.motion, m.x, m.S, state.effort, min(ahead * 1e-9, LONGEST_S), held)
    if ahead > 0:
        push(state.model.motion, state.sensors.tail, m.x, m.torque, state.effort, believed(m.score))
        ring(state.sensors.tail, m, ahead * 1e-9, state.effort)
        m.torque[:] = state.effort
    released = _change(config, state.model, m, event.kind)
    return state._replace(memory=m, last_ns=state.last_ns + ahead, released=released)


def estimate(config: IdentifierParameters, state: StructuredState) -> Payload:
    """Return the payload with its interval; never a NaN."""
    return judge(config, state.model, state.sensors, state.memory, state.restarts)


def _change(config: IdentifierParameters, model: Model, m: mem.Memory, kind: EventKind) -> float:
    """Reopen what an event changes: the rates, and what is held. Returns the payload let go [kg]."""
    payload = m.x.size - PARAMETERS
    held = bool(m.counts[mem.HELD])
    before = float(model.motion.scale * np.exp(min(m.x[payload], 12.0))) if held else 0.0
    columns = start.jump(config, model, m)
    opened = np.zeros((m.x.size, 2))
    if kind is EventKind.CAPTURE:
        if not held:
            _forget_payload(config, model, m)  # the arm was empty: what it seemed to hold were its errors
        opened[payload, 0] = start.PAYLOAD_STD
        opened[-1, 1] = start.PAYLOAD_STD if config.payload.rotary_inertia else 0.0
        m.counts[mem.HELD] = 1
    else:
        _forget_payload(config, model, m)
        opened[payload, 0] = start.EMPTY_STD * model.motion.scale + 0.3 * before
        m.counts[mem.HELD] = 0
    m.S[:] = start.widen(m.S, np.hstack([columns, opened]))
    start.shake(model, m)
    _anchor(m)
    return before


def _forget_payload(config: IdentifierParameters, model: Model, m: mem.Memory) -> None:
    """Condition an empty arm on holding exactly nothing; drop what is known of a payload that is let go."""
    payload = m.x.size - PARAMETERS
    if not m.counts[mem.HELD]:
        f = m.S[payload].copy()
        square = float(f @ f)
        if square > 0.0:
            if m.counts[mem.SINCE_EVENT] > mem.HORIZON:
                m.score[mem.SEEMED] = m.x[payload] / np.sqrt(square)
                m.score[mem.BEYOND] = m.x[payload] / np.hypot(np.sqrt(square), inexact(config, model, m, 0.0))
            gain = m.S @ f / square
            m.x[:] -= gain * m.x[payload]
            m.S[:] -= np.outer(gain, f)
    for gone in (payload, m.x.size - 1):
        m.x[gone] = 0.0
        m.S[gone] = 0.0


def _anchor(m: mem.Memory) -> None:
    """Begin a new horizon of refits here."""
    m.x0[:], m.S0[:] = m.x, m.S
    m.xi[:] = 0.0
    m.torque0[:] = m.torque
    for counter in (mem.STORED, mem.PASSED, mem.PASSING, mem.SINCE_EVENT, mem.SINCE_NOISE, mem.IN_BATCH,
                    mem.BATCHES):
        m.counts[counter] = 0
    m.counts[mem.BLOCKS] = min(m.counts[mem.BLOCKS], 40)
    m.score[:mem.SEEMED] = 0.0
    m.score[mem.DRIFT] = 1.0
    m.noise[:, mem.WEIGHT] = 0.0
    m.power[:] = 1.0


def _begin(config: IdentifierParameters, state: StructuredState) -> StructuredState:
    """Start the filter with what waited."""
    model = state.model
    assert model is not None
    items = state.waiting
    samples = [item for item in items if isinstance(item, Sample)]
    Y = measurements(model, samples)
    steps = np.diff([sample.stamp_ns for sample in samples]) * 1e-9
    dt = float(np.median(steps))
    size = 2 * model.motion.q.size + model.motion.G.shape[1]
    m = mem.memory(size, len(model.roles), 2 * residual_modes.MODES)
    m.noise[:] = start.noise(model, Y)
    start.first(config, model, m, Y[0])
    start.freeze(config, model, np.mean([sample.angles for sample in samples], axis=0))
    m.torque[:] = samples[0].u
    _anchor(m)
    seen = sensors(config, model, dt, start.diffusion(config, model, m), m.x[:2])
    m.score[mem.ODDS] = 0.0 if seen.tail.push.any() else residual_modes.UNBENT_ODDS
    state = state._replace(
        memory=m, sensors=seen, waiting=(), last_ns=samples[0].stamp_ns, effort=samples[0].u.copy())
    for item in items:
        state = event(config, state, item) if isinstance(item, CaptureEvent) else step(config, state, item)
    return state


def _resume(config: IdentifierParameters, state: StructuredState, sample: Sample) -> StructuredState:
    """After a gap: start at the sample's measurements."""
    assert state.model is not None
    fresh = reopen(config, state, measurements(state.model, [sample])[0])
    assert fresh.memory is not None
    fresh.memory.torque[:] = fresh.memory.torque0[:] = sample.u
    return fresh._replace(last_ns=sample.stamp_ns, effort=sample.u.copy())


def reopen(
    config: IdentifierParameters, state: StructuredState, y: Array | None = None,
) -> StructuredState:
    """Keep what is known of arm, payload and noise, look at the motion anew, from measurements y (m,)."""
    assert state.model is not None
    assert state.memory is not None
    m = mem.copy(state.memory)
    n = state.model.motion.q.size
    parameters, spread = m.x[2 * n:].copy(), m.S[2 * n:].copy()
    start.first(config, state.model, m, m.recent[:, 0] if y is None else y)
    m.tail[:] = 0.0
    m.x[2 * n:] = parameters
    m.S[2 * n:] = 0.0
    m.S[2 * n:, 2 * n:] = np.linalg.qr(spread.T)[1].T
    _anchor(m)
    return state._replace(memory=m)


def _run(config: IdentifierParameters, state: StructuredState, samples: Sequence[Sample]) -> StructuredState:
    """Take samples without a gap among them."""
    assert state.model is not None
    assert state.memory is not None
    assert state.sensors is not None
    assert state.effort is not None
    if not samples:
        return state
    m = mem.copy(state.memory, refit=False)
    table = _table(state.model, state.last_ns, state.effort, samples)
    taken = run(state.model.motion, state.sensors, m, table)
    if taken < len(samples):
        return _restart(config, state, samples[taken:])
    return state._replace(memory=m, last_ns=samples[-1].stamp_ns, effort=samples[-1].u)


def _table(model: Model, before: int, effort: Array, samples: Sequence[Sample]) -> Array:
    """Return what the kernel takes, (N, 3 + m), after a sample at ``before`` [ns] with that effort (2,)."""
    rows, held = [], effort.tolist()
    for sample in samples:
        rows.append([max(sample.stamp_ns - before, 0) * 1e-9, *held, *_measured(model, sample)])
        before, held = sample.stamp_ns, sample.u.tolist()
    return np.array(rows, dtype=np.float64)


def _restart(
    config: IdentifierParameters, state: StructuredState, samples: Sequence[Sample],
) -> StructuredState:
    """Numbers left the finite range: begin again, still knowing whether something is held."""
    assert state.memory is not None
    fresh = init(config)._replace(restarts=state.restarts + 1)
    if state.memory.counts[mem.HELD]:
        fresh = fresh._replace(waiting=(CaptureEvent(samples[0].stamp_ns, EventKind.CAPTURE),))
    return advance(config, fresh, samples[1:])


def measurements(model: Model, samples: Sequence[Sample]) -> Array:
    """Return outputs and the angles that are not among them, (N, m)."""
    rows = [_measured(model, sample) for sample in samples]
    return np.array(rows, dtype=np.float64).reshape(len(samples), len(model.roles))


def _measured(model: Model, sample: Sample) -> list[float]:
    angles = sample.angles.tolist() if model.extra else []
    return [*sample.y.tolist(), *(angles[i] for i in model.extra)]
