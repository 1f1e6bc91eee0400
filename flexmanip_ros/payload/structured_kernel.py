"""Compiled loop of the structured estimator: filter every sample, refit behind it all since the last event.

The filter alone would linearise the first samples after an event at a poor guess and never take that
back. So the samples since the event are kept (``HORIZON``), and a Gauss-Newton pass over them runs three
samples for each new one; when it catches up, its result replaces the filter's state, and the next pass
starts there.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, NamedTuple

import numpy as np
from numpy.typing import NDArray

from flexmanip_ros.payload.memory import (
    BATCHES,
    BLOCK_POWER,
    BLOCK_SUM,
    BLOCKS,
    DRIFT,
    EFFECTIVE,
    FLOOR,
    HELD,
    HORIZON,
    IN_BATCH,
    IN_BLOCK,
    MOVE,
    NOW,
    PASSED,
    PASSING,
    POWER,
    SEEN,
    SINCE_EVENT,
    SINCE_NOISE,
    SLOW,
    STORED,
    VARIANCE,
    WEIGHT,
    WHITE,
)
from flexmanip_ros.payload.motion_kernel import PARAMETERS, predict
from flexmanip_ros.payload.square_root_kernel import (
    absorb_measurement,
    absorb_noise,
    backward,
    factor_information,
    forward,
    project,
)
from flexmanip_ros.plant.compiled import kernel
from flexmanip_ros.types import Array

if TYPE_CHECKING:
    from flexmanip_ros.payload.memory import Memory
    from flexmanip_ros.payload.motion_kernel import Motion

OUTLIER = 4.0
"""Innovations beyond this many standard deviations count less (Huber)."""
BLOCK_MEMORY = 120
"""Blocks over which the noise of a sensor is averaged."""
BATCH_MEMORY = 20
"""Batches over which the moves of the payload are averaged."""
NOISE_EVERY = 50
"""Samples between additions of process noise."""
FIRST_PASS = 8
"""Samples after an event before the first refit."""


class Sensors(NamedTuple):
    """How the signals follow from the state."""

    H: Array
    """(m, n) of q or qd."""
    rate: NDArray[np.bool_]
    """(m,) whether H reads qd."""
    feed: Array
    """(m, 2) direct effect of the torque."""
    block: int
    """Samples in a block: a tenth of the slowest vibration."""
    diffusion: Array
    """(nx,) standard deviation that each state gains in the square root of a second."""
    deviation: Array
    """(nx,) scratch."""
    f: Array
    """(nx,) scratch."""
    W: Array
    """(nx, 2 nx) scratch."""


@kernel
def measure(motion: Motion, sensors: Sensors, m: Memory, effort: Array, y: Array) -> None:
    """Update the filter with one sample and gather what its innovations say of noise and payload."""
    payload = m.x.size - PARAMETERS
    x, S, f = m.x, m.S, sensors.f
    n = motion.q.size
    for i in range(y.size):
        r = m.noise[i, EFFECTIVE]
        predicted = project(x, S, sensors.H[i], n if sensors.rate[i] else 0, f)
        e = y[i] - predicted - sensors.feed[i, 0] * effort[0] - sensors.feed[i, 1] * effort[1]
        spread = 0.0
        for c in range(f.size):
            spread += f[c] * f[c]
        variance = spread + r
        square = e * e / variance
        m.innovation[i, 0], m.innovation[i, 1] = e, variance
        m.power[i] += (min(square, 25.0) - m.power[i]) / min(m.counts[SINCE_EVENT] + 100, 1000)
        residual = min(max(e / np.sqrt(variance), -5.0), 5.0) * np.sqrt(r)
        m.noise[i, BLOCK_SUM] += residual
        m.noise[i, BLOCK_POWER] += residual * residual
        if square > OUTLIER * OUTLIER:
            r += e * e / (OUTLIER * OUTLIER) - variance
            variance = spread + r
        gain = 0.0
        for c in range(f.size):
            gain += S[payload, c] * f[c]
        gain /= variance
        m.score[MOVE] += gain * e
        m.score[VARIANCE] += gain * gain * variance
        m.noise[i, WEIGHT] += gain * gain * variance
        absorb_measurement(x, S, f, e, r, variance)
        white_noise(m, i, y[i])
    m.counts[SEEN] = min(m.counts[SEEN] + 1, 2000)


@kernel
def white_noise(m: Memory, i: int, y: float) -> None:
    """Variance of sensor i's white noise, from fourth differences, in which slow motion has no part."""
    recent = m.recent[i]
    if m.counts[SEEN] >= 4:
        difference = y - 4.0 * recent[0] + 6.0 * recent[1] - 4.0 * recent[2] + recent[3]
        square = difference * difference / 70.0
        if m.counts[SEEN] > 50:
            square = min(square, 16.0 * m.noise[i, WHITE] + 1e-300)
        m.noise[i, WHITE] += (square - m.noise[i, WHITE]) / (m.counts[SEEN] - 3)
    for p in range(3, 0, -1):
        recent[p] = recent[p - 1]
    recent[0] = y


@kernel
def learn_noise(sensors: Sensors, m: Memory) -> None:
    """At the end of a block: the variance of each sensor, and its slow part when that is not white."""
    m.counts[IN_BLOCK] += 1
    if m.counts[IN_BLOCK] < sensors.block:
        return
    m.counts[IN_BLOCK] = 0
    m.counts[BLOCKS] = min(m.counts[BLOCKS] + 1, BLOCK_MEMORY)
    blocks = m.counts[BLOCKS]
    doubt = 3.0 * np.sqrt(2.0 / blocks)
    for i in range(m.noise.shape[0]):
        row = m.noise[i]
        row[POWER] += (row[BLOCK_POWER] / sensors.block - row[POWER]) / blocks
        row[SLOW] += (row[BLOCK_SUM] * row[BLOCK_SUM] / sensors.block - row[SLOW]) / blocks
        row[BLOCK_SUM] = 0.0
        row[BLOCK_POWER] = 0.0
        # white noise has SLOW = POWER; a slow part that is no chance makes samples worth less
        # trust comes back slowly: the first guess, or a shock, may have been right
        row[EFFECTIVE] = max(row[POWER], row[SLOW] - doubt * row[POWER], row[FLOOR], 0.7 * row[EFFECTIVE])


@kernel
def judge_payload(sensors: Sensors, m: Memory) -> None:
    """At the end of a batch: see whether the payload moved farther than its variance allows."""
    m.counts[IN_BATCH] += 1
    if m.counts[IN_BATCH] < 8 * sensors.block:
        return
    m.counts[IN_BATCH] = 0
    if m.score[VARIANCE] > 0.0:
        m.counts[BATCHES] = min(m.counts[BATCHES] + 1, BATCH_MEMORY)
        square = m.score[MOVE] * m.score[MOVE] / m.score[VARIANCE]
        m.score[DRIFT] += (square - m.score[DRIFT]) / m.counts[BATCHES]
    m.score[MOVE] = 0.0
    m.score[VARIANCE] = 0.0


@kernel
def begin_pass(m: Memory) -> None:
    """Start a refit at the event, from the best trajectory known."""
    nx = m.x.size
    for i in range(nx):
        m.xr[i] = m.x0[i]
        m.g[i] = 0.0
        for c in range(nx):
            m.xr[i] += m.S0[i, c] * m.xi[c]
            m.Sr[i, c] = m.S0[i, c]
            m.N[i, c] = 0.0
    m.counts[PASSED] = 0
    m.counts[PASSING] = 1


@kernel
def pass_sample(motion: Motion, sensors: Sensors, m: Memory) -> bool:
    """Take one kept sample into the refit; False when numbers left the finite range."""
    sample = m.samples[m.counts[PASSED]]
    n, nx = motion.q.size, m.x.size
    effort, f = sample[1:3], sensors.f
    if not predict(motion, m.xr, m.Sr, effort, sample[0], m.counts[HELD] != 0):
        return False
    for i in range(m.noise.shape[0]):
        r = m.noise[i, EFFECTIVE]
        predicted = project(m.xr, m.Sr, sensors.H[i], n if sensors.rate[i] else 0, f)
        e = sample[3 + i] - predicted - sensors.feed[i, 0] * effort[0] - sensors.feed[i, 1] * effort[1]
        weight = 1.0 / r
        if e * e * weight > OUTLIER * OUTLIER:
            weight = OUTLIER / (abs(e) * np.sqrt(r))
        for a in range(nx):
            scaled = weight * f[a]
            m.g[a] += scaled * e
            for b in range(a + 1):
                m.N[a, b] += scaled * f[b]
    m.counts[PASSED] += 1
    return True


@kernel
def finish_pass(m: Memory) -> bool:
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
    m.counts[PASSING] = 0
    return True


@kernel
def refit(motion: Motion, sensors: Sensors, m: Memory, duration: float, effort: Array, y: Array) -> bool:
    """Keep a sample and let the refit behind the filter take up to three."""
    stored = m.counts[STORED]
    if stored >= HORIZON:
        return True
    m.samples[stored, 0] = duration
    m.samples[stored, 1] = effort[0]
    m.samples[stored, 2] = effort[1]
    for i in range(y.size):
        m.samples[stored, 3 + i] = y[i]
    m.counts[STORED] = stored + 1
    if m.counts[PASSING] == 0:
        if stored + 1 < FIRST_PASS or 3 * (stored + 1) > 2 * HORIZON:
            return True
        begin_pass(m)
    for _ in range(3):
        if m.counts[PASSED] < m.counts[STORED] and not pass_sample(motion, sensors, m):
            return False
    if m.counts[PASSED] == m.counts[STORED]:
        m.counts[IN_BATCH] = 0
        m.score[MOVE] = 0.0
        m.score[VARIANCE] = 0.0
        return finish_pass(m)
    return True


@kernel
def diffuse(sensors: Sensors, m: Memory, duration: float) -> None:
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


@kernel
def take(motion: Motion, sensors: Sensors, m: Memory, duration: float, effort: Array, y: Array) -> bool:
    """Take one sample, ``duration`` after the one before; False when numbers left the finite range."""
    if not predict(motion, m.x, m.S, effort, duration, m.counts[HELD] != 0):
        return False
    measure(motion, sensors, m, effort, y)
    if not abs(m.x[m.x.size - PARAMETERS]) < 1e9:
        return False
    m.counts[SINCE_EVENT] += 1
    learn_noise(sensors, m)
    if not refit(motion, sensors, m, duration, effort, y):
        return False
    judge_payload(sensors, m)
    diffuse(sensors, m, duration)
    return True


@kernel
def advance(
    motion: Motion, sensors: Sensors, m: Memory, durations: Array, efforts: Array, Y: Array,
) -> int:
    """Take samples: durations (N,) since the one before, efforts (N, 2) held meanwhile, Y (N, m).

    Returns how many were taken; fewer than N when numbers left the finite range.
    """
    for k in range(Y.shape[0]):
        if not take(motion, sensors, m, durations[k], efforts[k], Y[k]):
            return k
    taken: int = Y.shape[0]
    return taken
