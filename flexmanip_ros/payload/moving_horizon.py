"""Compiled loop of the structured estimator: a Kalman filter, and moving-horizon estimation since the last event.

An extended Kalman filter linearizes each sample once. The first samples after an event are linearized at a poor guess
of the payload, and that error would remain. Moving-horizon estimation mends it: a Gauss-Newton iteration reads the
samples since the event again (at most ``HORIZON``), three for each new sample. When it has caught up with the filter,
its minimum replaces the filter's state, and the next iteration is linearized there. The arrival cost is the state at
the event, with mean x0 and covariance S0 S0'.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from flexmanip_ros.numerics.compiled import inlined, kernel, merged
from flexmanip_ros.numerics.square_root import absorb_noise, backward, factor_information, forward, project
from flexmanip_ros.payload.filter_state import (
    EFFECTIVE,
    HELD,
    HORIZON,
    IN_BATCH,
    ITERATED,
    ITERATING,
    MOVE,
    NOW,
    SINCE_EVENT,
    SINCE_NOISE,
    STORED,
    VARIANCE,
)
from flexmanip_ros.payload.measurement_update import OUTLIER, judge_payload, learn_noise, measure
from flexmanip_ros.payload.process_model import PARAMETERS, predict
from flexmanip_ros.payload.residual_modes import (
    excite_residual,
    propagate_residual,
    residual_amplitude,
    residual_output,
    residual_probability,
)
from flexmanip_ros.types import Array

if TYPE_CHECKING:
    from flexmanip_ros.payload.filter_state import FilterState
    from flexmanip_ros.payload.measurement_update import MeasurementModel
    from flexmanip_ros.payload.process_model import ProcessModel

NOISE_EVERY = 50
"""Samples between additions of process noise."""
FIRST_ITERATION = 8
"""Samples after an event before the first Gauss-Newton iteration: fewer tell less than the prior."""


@merged
def begin_iteration(m: FilterState) -> None:
    """Start a Gauss-Newton iteration at the event, from the trajectory of the last one."""
    nx = m.x.size
    for i in range(nx):
        m.xr[i] = m.x0[i]
        m.g[i] = 0.0
        for c in range(nx):
            m.xr[i] += m.S0[i, c] * m.xi[c]
            m.Sr[i, c] = m.S0[i, c]
            m.N[i, c] = 0.0
    m.counts[ITERATED] = 0
    m.counts[ITERATING] = 1


@merged
def iterate_sample(motion: ProcessModel, sensors: MeasurementModel, m: FilterState, table: Array) -> bool:
    """Take one sample since the event into the iteration: N += f f' / r, g += f e / r. False when not finite.

    table: (N, 3 + m), its first row is the first sample after the event.
    """
    passed = m.counts[ITERATED]
    sample = table[passed]
    n, nx = motion.q.size, m.x.size
    effort, f = sample[1:3], sensors.f
    if not predict(motion, m.xr, m.Sr, effort, sample[0], m.counts[HELD] != 0):
        return False
    if sample[0] > 0.0:
        before = m.torque0 if passed == 0 else table[passed - 1, 1:3]
        excite_residual(motion, sensors.residual, m.xr, before, effort, residual_probability(m.score))
    for i in range(m.noise.shape[0]):
        r = m.noise[i, EFFECTIVE]
        predicted = project(m.xr, m.Sr, sensors.H[i], n if sensors.rate[i] else 0, f)
        measured = sample[3 + i] - m.corrections[passed, i]
        e = measured - predicted - sensors.feed[i, 0] * effort[0] - sensors.feed[i, 1] * effort[1]
        weight = 1.0 / r
        if e * e * weight > OUTLIER * OUTLIER:
            weight = OUTLIER / (abs(e) * np.sqrt(r))
        for a in range(nx):
            scaled = weight * f[a]
            m.g[a] += scaled * e
            for b in range(a + 1):
                m.N[a, b] += scaled * f[b]
    m.counts[ITERATED] += 1
    return True


@merged
def finish_iteration(m: FilterState) -> bool:
    """Step to the minimum, and hand state and spread at the last sample to the filter."""
    nx = m.x.size
    payload = nx - PARAMETERS
    if not factor_information(m.N):
        return False
    for i in range(nx):
        m.g[i] -= m.xi[i]
    forward(m.N, m.g)
    backward(m.N, m.g)
    move = 0.0
    for c in range(nx):
        move += m.S0[payload, c] * m.g[c]
    # a step in the logarithm of the payload is not trusted beyond the range of its linearisation
    limit = 1.0 if m.counts[HELD] != 0 else 1e300
    shorten = min(1.0, limit / max(abs(move), 1e-300))
    for c in range(nx):
        m.xi[c] += shorten * m.g[c]
    for i in range(nx):
        value = m.xr[i]
        for c in range(nx):
            value += m.Sr[i, c] * shorten * m.g[c]
        m.x[i] = value
        forward(m.N, m.Sr[i])
        for c in range(nx):
            m.S[i, c] = m.Sr[i, c]
    m.counts[ITERATING] = 0
    return True


@merged
def iterate(motion: ProcessModel, sensors: MeasurementModel, m: FilterState, table: Array) -> bool:
    """Store the correction of the newest sample, and let the Gauss-Newton iteration take up to three samples."""
    stored = m.counts[STORED]
    if stored >= HORIZON:
        return True
    share = residual_amplitude(m.score)
    for i in range(m.corrections.shape[1]):
        m.corrections[stored, i] = share * residual_output(sensors.residual, m, i)
    m.counts[STORED] = stored + 1
    if m.counts[ITERATING] == 0:
        if stored + 1 < FIRST_ITERATION or 3 * (stored + 1) > 2 * HORIZON:
            return True
        begin_iteration(m)
    for _ in range(3):
        if m.counts[ITERATED] < m.counts[STORED] and not iterate_sample(motion, sensors, m, table):
            return False
    if m.counts[ITERATED] == m.counts[STORED]:
        m.counts[IN_BATCH] = 0
        m.score[MOVE] = 0.0
        m.score[VARIANCE] = 0.0
        return finish_iteration(m)
    return True


@inlined
def diffuse(sensors: MeasurementModel, m: FilterState, duration: float) -> None:
    """Add the process noise of a while, so that the memory stays finite."""
    m.score[NOW] += duration
    m.counts[SINCE_NOISE] += 1
    if m.counts[SINCE_NOISE] < NOISE_EVERY or m.counts[STORED] < HORIZON:
        return
    root = np.sqrt(m.score[NOW])
    for i in range(m.x.size):
        sensors.deviation[i] = sensors.diffusion[i] * root
    absorb_noise(m.S, sensors.deviation, sensors.W)
    m.counts[SINCE_NOISE] = 0
    m.score[NOW] = 0.0


@merged
def take(motion: ProcessModel, sensors: MeasurementModel, m: FilterState, table: Array, k: int) -> bool:
    """Take the sample in row k of the table; False when numbers left the finite range.

    table: (N, 3 + m), see ``advance``.
    """
    duration, effort, y = table[k, 0], table[k, 1:3], table[k, 3:]
    if not predict(motion, m.x, m.S, effort, duration, m.counts[HELD] != 0):
        return False
    if duration > 0.0:
        excite_residual(motion, sensors.residual, m.x, m.torque, effort, residual_probability(m.score))
        propagate_residual(sensors.residual, m, duration, effort)
        m.torque[0], m.torque[1] = effort[0], effort[1]
    measure(motion, sensors, m, effort, y)
    if not abs(m.x[m.x.size - PARAMETERS]) < 1e9:
        return False
    m.counts[SINCE_EVENT] += 1
    learn_noise(sensors, m)
    if not iterate(motion, sensors, m, table):
        return False
    judge_payload(sensors, m)
    diffuse(sensors, m, duration)
    return True


@kernel
def advance(motion: ProcessModel, sensors: MeasurementModel, m: FilterState, table: Array, first: int) -> int:
    """Take the samples in the rows of the table from ``first`` on.

    table: (N, 3 + m) duration since the sample before, torques held meanwhile, measurements. While the horizon
    is open (fewer than ``HORIZON`` samples since the event), the table begins with the first sample after it.
    Returns the row after the last one taken; less than N when numbers left the finite range.
    """
    for k in range(first, table.shape[0]):
        if not take(motion, sensors, m, table, k):
            return k
    taken: int = table.shape[0]
    return taken
