"""Compiled loop of the structured estimator: a Kalman filter, and moving-horizon estimation since the last event.

An extended Kalman filter linearizes each sample once. The first samples after an event are linearized at a poor guess
of the payload, and that error would remain. Moving-horizon estimation mends it: a Gauss-Newton iteration reads the
samples since the event again (at most ``HORIZON``), ``ROWS`` for each new sample. When it has caught up with the
filter, its minimum replaces the filter's state, and the next iteration is linearized there. The arrival cost is the
state at the event, with mean x0 and covariance S0 S0'.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from flexmanip_ros.arm.equations_of_motion import solve
from flexmanip_ros.numerics.compiled import inner, merged
from flexmanip_ros.numerics.square_root import absorb_noise, backward, dot, factor_information, forward, least_distance
from flexmanip_ros.payload.filter_state import (
    AGAIN,
    BEFORE,
    COST,
    COST_BEFORE,
    DOUBT,
    EFFECTIVE,
    ENOUGH,
    FIT,
    HELD,
    HORIZON,
    IN_A_ROW,
    ITERATED,
    ITERATING,
    LAMBDA,
    LEARNED,
    MEASURED,
    NOW,
    POWER,
    REFITS,
    REJECTED,
    SANDWICH,
    SHIFT,
    SINCE_EVENT,
    SINCE_NOISE,
    SLOW,
    STORED,
    TRIED,
    USED,
    WHITE,
)
from flexmanip_ros.payload.measurement_update import (
    BATCH,
    judge_moves,
    learn_noise,
    measure,
    misfit,
    observe,
    white_variance,
)
from flexmanip_ros.payload.process_model import (
    INERTIA,
    MODE,
    STEP_ANGLE,
    STIFFNESS,
    gather_bounds,
    keep_inertia,
    predict,
)
from flexmanip_ros.types import Array

if TYPE_CHECKING:
    from flexmanip_ros.payload.filter_state import FilterState
    from flexmanip_ros.payload.measurement_update import MeasurementModel
    from flexmanip_ros.payload.process_model import ProcessModel

FIRST_ITERATION = 8
"""Samples after an event before the first Gauss-Newton iteration: fewer tell less than the prior."""


ROWS = 8
"""Rows that are read again for each new sample."""
CLOSING = 16_384
"""Rows that are read again at most when the horizon closes: a fit of an empty arm takes up to ten times all of them."""
LATEST = 1024
"""Samples after which the horizon closes although the fit has not come to rest: by then those have that ever will."""
LINEAR = 0.25
"""Standard deviation of a mode's phase [rad] up to which the motion is linear in the phase: its sine is, to 1 %.
Beyond, the filter that goes on from the fit underestimates its covariance, and may lock on to a phase that is off by 2
pi."""
WORK = 4
"""Largest mean number of integration steps for each row that is read again, over that of an arm without friction: a
joint that sticks takes three, wrong parameters may take hundreds."""
GROWTH = 4
"""One over the share by which the horizon must grow before a converged fit is repeated: a quarter; less hardly moves
it."""
AT_REST = 0.5
"""A fit has converged when its last step moved the payload by less than this share of its standard deviation."""
CONVERGED = 0.02
"""Decrease of the cost for each sample below which a step counts as converged, and the horizon may grow."""
FITS = 1.5
"""Cost over that of white noise up to which a step counts as converged, too."""
LOST = 1e4
"""Cost for each measurement beyond which a trajectory is given up: it says nothing of the arm."""
TRUSTED = 2.0
"""Standard deviations by which a step of the moving-horizon estimation moves the filter's state at most."""
TELLS = 50
"""Samples after which the cost tells whether a fit is one: that of white noise then varies by 0.1 of itself."""
UNFIT = 2.0
"""Cost over that of white noise beyond which a fit is rejected."""
TRIALS = 10
"""Iterations over the same samples after which a fit is given up: those that converge take three to nine."""
STARTS = 2
"""Fits from the event on that are given up as soon as they converge without fitting: of a point, then of a body."""
MOST_REFITS = 4
"""Largest number of times that a fit is begun again after an event: with the parameters of another arm none ever
fits."""
STRAY, STRAY_EVERY = 3.0, 500
"""Innovation power over white noise, of every sensor, at which the filter is begun again; samples between two
checks."""
SLACK = 1.0
"""Increase of the cost up to which a step is accepted: one is a change of the estimate by one standard deviation."""
LEVENBERG = 1.0
"""Damping with which a rejected step is taken again after a capture: that of the arrival cost. The cost of what is held
has a narrow valley that bends, and damping in proportion to the information hardly lets a step go along it."""
MARQUARDT = 1e-3
"""The same for an empty arm, in proportion to the information, as its priors are rough."""
VERY_STRONG = 5.0
"""Logarithm of a Bayes factor that is very strong evidence (Kass and Raftery 1995)."""
FADING, FADED = 8.0, 1e-3
"""Factor by which a rejected step raises the damping and an accepted one lowers it (Marquardt 1963); share of the first
damping below which it is set to zero, where it hardly shortens a step. Were it zero after the first accepted step,
every second step of a fit in a valley that bends would be rejected."""
CHANCE = 3.0
"""Standard deviations by which the filter may estimate a nonnegative parameter below zero: noise hardly explains
more."""
REJECTIONS = 8
"""Number of times that a step that raises the cost is shortened."""


@inner
def begin_iteration(m: FilterState) -> None:
    """Start a Gauss-Newton iteration at the event, linearized at the estimate of the last one."""
    nx = m.x.size
    m.score[COST] = 0.0
    for i in range(nx):
        m.g[i] = 0.0
        m.batch[i] = 0.0
        m.xr[i] = m.x0[i] + dot(m.S0[i], m.xi)
        m.score[COST] += m.xi[i] * m.xi[i]
        for c in range(nx):
            m.Sr[i, c] = m.S0[i, c]
            m.N[i, c] = 0.0
            m.B[i, c] = 0.0
    for i in range(m.noise.shape[0]):
        m.noise[i, FIT] = 0.0
    m.counts[ITERATED] = 0
    m.counts[MEASURED] = 0
    m.counts[ITERATING] = 1


@merged
def iterate_sample(motion: ProcessModel, sensors: MeasurementModel, m: FilterState, table: Array) -> int:
    """Take one sample since the event into the iteration: N += f f' / r, g += f e / r.

    table: (N, 1 + 3 L + m), the rows before the event that a late torque needs, then the first sample after it. The
    cost is the sum of e^2 / r. Return the number of integration steps; 0: this trajectory is given up, the step was too
    long.
    """
    k = m.counts[ITERATED] + sensors.reach - 1
    sample = table[k]
    n, nx, used = sensors.H.shape[1], m.x.size, m.counts[USED]
    first, f = 1 + 3 * motion.effort.size, sensors.f[:used]
    rows = table[k + 1 - sensors.reach:k + 1]
    steps = predict(motion, m.xr, m.Sr, used, rows, sensors.period, sample[0])
    if steps == 0:
        return 0
    measured = sample[first] == sample[first]
    if measured:
        m.counts[MEASURED] += 1
    for i in range(m.noise.shape[0] if measured else 0):
        r = m.noise[i, EFFECTIVE]
        e = sample[first + i] - observe(sensors, i, n, m.xr, m.Sr, f, motion.k[0])
        weight = 1.0 / r
        m.score[COST] += e * e * weight
        m.noise[i, FIT] += e * e
        for a in range(used):
            scaled = weight * f[a]
            m.g[a] += scaled * e
            for b in range(a + 1):
                m.N[a, b] += scaled * f[b]
    m.counts[ITERATED] += 1
    if measured and m.counts[HELD] == 0 and m.counts[MEASURED] % (BATCH * sensors.block) == 0:
        for a in range(used):
            m.batch[a] = m.g[a] - m.batch[a]
        for a in range(used):
            for b in range(a + 1):
                m.B[a, b] += m.batch[a] * m.batch[b]
        for a in range(used):
            m.batch[a] = m.g[a]
    if not m.score[COST] < LOST * (nx + m.noise.shape[0] * m.counts[ITERATED]):
        return 0
    # the cost only grows: a step may be rejected before its last sample
    if m.counts[ITERATED] <= m.counts[BEFORE] and m.score[COST] > m.score[COST_BEFORE] + SLACK:
        return 0
    return int(steps)


@inner
def finish_iteration(motion: ProcessModel, sensors: MeasurementModel, m: FilterState) -> bool:
    """Accept the iteration and take the next step. Where it has read all samples, the filter goes on from there."""
    nx = m.x.size
    for i in range(nx):
        m.accepted[i] = m.xi[i]
        m.gradient[i] = m.g[i] - m.xi[i]
        for c in range(i + 1):
            m.normal[i, c] = m.N[i, c]
    fits = m.score[COST] < FITS * (nx + m.noise.shape[0] * m.counts[MEASURED])
    enough = CONVERGED * m.counts[ITERATED]
    # two steps may undo each other for ever where the valley bends
    still = (m.counts[BEFORE] == m.counts[ITERATED] and m.score[LAMBDA] <= first_damping(m)
             and m.score[COST_BEFORE] - m.score[COST] < enough)
    m.counts[BEFORE] = m.counts[ITERATED]
    m.score[COST_BEFORE] = m.score[COST]
    m.score[LAMBDA] = m.score[LAMBDA] / FADING if m.score[LAMBDA] > FADED * first_damping(m) else 0.0
    m.counts[REJECTED] = 0
    m.counts[ITERATING] = 0
    if not damped_step(motion, sensors, m):
        return False
    gained = dot(m.g, m.gradient)
    m.counts[AGAIN] = 0 if fits or still or gained < enough else 1
    m.counts[TRIED] = m.counts[TRIED] + 1 if m.counts[AGAIN] else 0
    if m.counts[ITERATED] == m.counts[STORED]:
        if not factor_information(m.N):
            return False
        for i in range(m.noise.shape[0]):
            m.noise[i, POWER] = m.noise[i, FIT] / max(m.counts[MEASURED], 1)
            m.noise[i, SLOW] = m.noise[i, POWER]
        # the step was not seen to lower the cost yet: the filter takes no more of it than it can tell
        part = min(1.0, TRUSTED / np.sqrt(max(gained, 1e-300)))
        payload = 2 * sensors.H.shape[1]
        shift = dot(m.Sr[payload], m.g)
        for i in range(nx):
            m.x[i] = m.xr[i] + part * dot(m.Sr[i], m.g)
            forward(m.N, m.Sr[i])
            for c in range(nx):
                m.S[i, c] = m.Sr[i, c]
        if m.counts[HELD] == 0:
            m.score[SANDWICH] = sandwich(sensors, m)
        else:
            widen_by_empty_arm(sensors, m)
        variance = dot(m.S[payload], m.S[payload])
        m.score[SHIFT] = abs(shift) / np.sqrt(max(variance, 1e-300))
        m.score[DOUBT] = np.sqrt(variance + shift * shift) / max(m.x[payload], 1e-300)
        if (m.counts[ITERATED] >= ENOUGH and gained < 0.5 * nx and m.score[SHIFT] < AT_REST
                and phase_std(motion, m, sensors.period * m.counts[ITERATED]) < LINEAR):
            close_horizon(motion, sensors, m)
    return True


@inner
def sandwich(sensors: MeasurementModel, m: FilterState) -> float:
    """Return the factor, at least 1, by which the variances of a fit are too small; m.N: factor of I + N.

    The variance by batch means (sandwich of Huber and White): where the residuals are no white noise, the gradient is
    a sum of parts b of batches that are nearly independent, so the variance of xi by them is W B W, W = (I + N)^-1,
    B = sum b b'. The fit says W N W instead. The factor is the mean over payload and arm parameters of the ratio.
    """
    nx, row = m.x.size, sensors.f
    length = BATCH * sensors.block
    whole = m.counts[MEASURED] // length
    if whole == 0:
        return 1.0
    total, known = 0.0, 0
    for i in range(2 * sensors.H.shape[1], nx):
        for c in range(nx):
            row[c] = m.S0[i, c]
        forward(m.N, row)
        backward(m.N, row)
        said = dot(row, m.S0[i]) - dot(row, row)
        found = 0.0
        for a in range(nx):
            for b in range(a):
                found += 2.0 * row[a] * m.B[a, b] * row[b]
            found += row[a] * m.B[a, a] * row[a]
        if said > 0.0:
            total += found / said
            known += 1
    factor: float = total / max(known, 1) * m.counts[MEASURED] / (whole * length)
    return max(1.0, factor)


@inner
def widen_by_empty_arm(sensors: MeasurementModel, m: FilterState) -> None:
    """Add to the covariance of a fit with an object what its prior lacks: the variances of the empty arm's fit.

    If these are too small by the factor g, the prior of xi has the covariance g I, and xi the variance W + (g - 1) W W,
    W = (I + N)^-1. The estimate stays, as the fit weighs the prior by what the empty arm's fit said.
    """
    nx = m.x.size
    root = np.sqrt(max(m.score[SANDWICH] - 1.0, 0.0))
    if root == 0.0:
        return
    for i in range(nx):
        for c in range(sensors.noise.shape[1]):
            sensors.noise[i, c] = 0.0
        for c in range(nx):
            sensors.f[c] = m.S[i, c]
        backward(m.N, sensors.f)
        for c in range(nx):
            sensors.noise[i, c] = root * sensors.f[c]
    absorb_noise(m.S, sensors.noise, sensors.W)


@inner
def evidence_against_delays(motion: ProcessModel, sensors: MeasurementModel, m: FilterState) -> float:
    """Return the logarithm of the Bayes factor of signals that are as late as given, over that of unknown delays.

    It is the density of the given delays after the samples over that before (Savage and Dickey). 0: all are known.
    """
    L, departure, first = sensors.L, sensors.f, m.x.size - motion.kind.size
    for i in range(m.x.size):
        departure[i] = 0.0
        for c in range(i + 1):
            L[i, c] = 0.0
    for a in range(motion.kind.size):
        if motion.kind[a] > MODE and dot(m.S[first + a], m.S[first + a]) > 0.0:
            departure[a] = (m.x[first + a] - motion.given[a]) / motion.prior[a]
            L[a, a] = -1.0  # ``factor_information`` adds one
            for b in range(a + 1):
                if motion.kind[b] > MODE:
                    scale = motion.prior[a] * motion.prior[b]
                    L[a, b] += m.score[SANDWICH] * dot(m.S[first + a], m.S[first + b]) / max(scale, 1e-300)
    if not factor_information(L):
        return 0.0
    forward(L, departure)
    ratio: float = -0.5 * dot(departure, departure)
    for a in range(m.x.size):
        ratio -= np.log(L[a, a])
    return ratio


@inner
def condition(x: Array, S: Array, row: int, value: float, f: Array) -> None:
    """Condition a state on the value of one of its entries; f: scratch."""
    for c in range(f.size):
        f[c] = S[row, c]
    variance, e = dot(f, f), value - x[row]
    for i in range(x.size if variance > 0.0 else 0):
        gain = dot(S[i], f) / variance
        x[i] += gain * e
        for c in range(f.size):
            S[i, c] -= gain * f[c]
    x[row] = value
    for c in range(f.size):
        S[row, c] = 0.0


@inner
def close_horizon(motion: ProcessModel, sensors: MeasurementModel, m: FilterState) -> None:
    """Close the horizon; where an empty arm shows no late signal, fit its samples again with the given delays.

    What the shape functions lack looks like a delay of some 0.1 ms. A delay that is learned and not there shifts the
    mass that is caught later, by 0.5 % for 0.1 ms.
    """
    again = (m.counts[HELD] == 0 and m.counts[STORED] < HORIZON
             and evidence_against_delays(motion, sensors, m) > VERY_STRONG)
    if not again:
        m.counts[STORED] = HORIZON
        return
    first = m.x.size - motion.kind.size
    for c in range(motion.kind.size):
        if motion.kind[c] > MODE:
            condition(m.x, m.S, first + c, motion.given[c], sensors.f)
            condition(m.x0, m.S0, first + c, motion.given[c], sensors.f)
    for counter in (ITERATED, ITERATING, BEFORE, REJECTED, AGAIN, TRIED):
        m.counts[counter] = 0
    m.score[LAMBDA] = 0.0


@inner
def phase_std(motion: ProcessModel, m: FilterState, duration: float) -> float:
    """Standard deviation [rad] of the angle by which the fastest mode turns in a time [s], as far as stiffness tells.

    The angle is w T, with w^2 in proportion to the stiffness, so its deviation is w T / 2 times that of the stiffness's
    logarithm, given the mass: changes of both that leave the frequency as it is do not count. A damped mode forgets its
    phase after an angle of one over the damping ratio.
    """
    first, links, k = m.x.size - motion.kind.size, motion.arm.length.size, motion.arm.kappa
    square, ratio = 0.0, np.inf
    for c in range(motion.kind.size):
        if motion.kind[c] == STIFFNESS or motion.kind[c] == MODE:
            told = dot(m.S[first + c], m.S[first]) ** 2 / max(dot(m.S[first], m.S[first]), 1e-300)
            square = max(square, dot(m.S[first + c], m.S[first + c]) - told)
    for i in range(links):
        ratio = min(ratio, motion.arm.damping[links + i * k] / motion.damping[links + i * k])
    angle = min(STEP_ANGLE / motion.substeps * duration, 1.0 / max(ratio, 1e-9))
    deviation: float = 0.5 * angle * np.sqrt(square)
    return deviation


@inner
def at_rest(m: FilterState) -> bool:
    """Whether the last iteration over all samples so far hardly moved the payload."""
    return bool(m.counts[BEFORE] >= ENOUGH and m.score[SHIFT] < AT_REST and m.counts[AGAIN] == 0)


@inner
def first_damping(m: FilterState) -> float:
    """Return the damping after the first rejected step."""
    return LEVENBERG if m.counts[HELD] == 1 else MARQUARDT


@inner
def damped_step(motion: ProcessModel, sensors: MeasurementModel, m: FilterState) -> bool:
    """Set xi to the accepted one plus a step of Levenberg and Marquardt, m.g, within the bounds of p.

    Where the step would leave the bounds it ends at the least quadratic cost within them (``least_distance`` in the
    metric of that cost). The inertia is moved by itself afterwards, as its bound is curved.
    """
    nx = m.xi.size
    L, p = sensors.L, motion.p
    for i in range(nx):
        m.g[i] = m.gradient[i]
        for c in range(i + 1):
            L[i, c] = m.normal[i, c]
        L[i, i] += m.score[LAMBDA] * (1.0 if m.counts[HELD] == 1 else 1.0 + L[i, i])
    if not factor_information(L):
        return False
    forward(L, m.g)
    backward(L, m.g)
    for i in range(nx):
        m.xi[i] = m.accepted[i] + m.g[i]
    first = nx - p.size
    for c in range(p.size):
        p[c] = m.x0[first + c] + dot(m.S0[first + c], m.xi)
    count = gather_bounds(motion, p, m.S0, 0.0)
    for i in range(count):
        forward(L, motion.bounds.rows[i])
    if count > 0 and least_distance(motion.bounds, count):
        backward(L, motion.bounds.shortest)
        for i in range(nx):
            m.xi[i] += motion.bounds.shortest[i]
            m.g[i] += motion.bounds.shortest[i]
        for c in range(p.size):
            p[c] = m.x0[first + c] + dot(m.S0[first + c], m.xi)
    lacks, own = keep_inertia(motion, p), m.counts[USED] - 1
    while lacks > 0.0 and own >= 0 and m.S0[first + INERTIA, own] == 0.0:  # its own column is the last in its row
        own -= 1
    if lacks > 0.0 and own >= 0:
        m.xi[own] += lacks / m.S0[first + INERTIA, own]
        m.g[own] += lacks / m.S0[first + INERTIA, own]
    return True


@inner
def reject_step(motion: ProcessModel, sensors: MeasurementModel, m: FilterState) -> bool:
    """Take a shorter step from the accepted xi, nearer to the gradient, and begin the iteration again."""
    m.counts[REJECTED] += 1
    m.score[LAMBDA] = FADING * m.score[LAMBDA] if m.score[LAMBDA] > 0.0 else first_damping(m)
    if m.counts[REJECTED] > REJECTIONS:  # a valley that bends: go on from here
        m.score[COST_BEFORE] = 1e300
    if not damped_step(motion, sensors, m):
        return False
    begin_iteration(m)
    return True


@merged
def iterate(motion: ProcessModel, sensors: MeasurementModel, m: FilterState, table: Array) -> bool:
    """Let the Gauss-Newton iteration take ``ROWS`` samples at most; when the horizon closes, until it converges."""
    stored = m.counts[STORED]
    if stored >= HORIZON:
        return True
    m.counts[STORED] = stored + 1
    if stored + 1 < FIRST_ITERATION:
        return True
    rests, last = at_rest(m), stored + 1 == HORIZON
    if stored + 1 >= LATEST:
        last |= not rests or phase_std(motion, m, sensors.period * m.counts[STORED]) < LINEAR
    if last and rests:  # the filter goes on from there
        close_horizon(motion, sensors, m)
        return True
    rows = CLOSING if last else ROWS
    work = WORK * rows * max(sensors.period / motion.substeps, 1.0)
    for _ in range(rows):
        if m.counts[STORED] == HORIZON > stored + 1:  # it has closed
            return True
        if work <= 0.0:
            break
        if m.counts[ITERATING] == 0:
            before = m.counts[BEFORE]
            if last:
                # until the step is within one standard deviation (Newton decrement): the filter goes on from here
                due = before < m.counts[STORED] or m.score[LAMBDA] > 0.0 or dot(m.g, m.gradient) >= 1.0
            else:
                more = max(before // GROWTH, 1) if m.score[SHIFT] < AT_REST else 1
                due = m.counts[AGAIN] == 1 or m.counts[STORED] >= before + more
            if not due:
                break
            begin_iteration(m)
        until = m.counts[BEFORE]
        if m.counts[AGAIN] == 0:
            until = m.counts[STORED] if last else min(m.counts[STORED], until + until // 2 + FIRST_ITERATION)
        steps = iterate_sample(motion, sensors, m, table)
        work -= steps
        if steps == 0:
            if m.counts[BEFORE] == 0 or not reject_step(motion, sensors, m):
                return False
        elif m.counts[ITERATED] >= until and (not finish_iteration(motion, sensors, m) or misfits(motion, m)):
            return False
    if last:
        if m.counts[HELD] == 1 and m.score[SHIFT] >= AT_REST:  # linearized before it converged: too sure
            wider = np.sqrt(1.0 + m.score[SHIFT] * m.score[SHIFT])
            for i in range(m.x.size):
                for c in range(m.x.size):
                    m.S[i, c] *= wider
        if fails(m):
            m.counts[STORED] = HORIZON
            return False
        close_horizon(motion, sensors, m)
    return True


@inner
def misfits(motion: ProcessModel, m: FilterState) -> bool:
    """Whether another start is due: the fit costs far more than white noise, or came to no end in ``TRIALS``."""
    most = MOST_REFITS - 1
    if m.counts[HELD] == 1:
        most = STARTS if motion.kind.size > INERTIA and motion.kind[INERTIA] == INERTIA else 0
    early = m.counts[TRIED] < TRIALS if m.counts[AGAIN] == 1 else m.counts[ITERATED] < TELLS
    if m.counts[REFITS] >= most or early:
        return False
    expected = m.xi.size + m.noise.shape[0] * m.counts[MEASURED]
    failed = bool(m.counts[AGAIN] == 1 or m.score[COST_BEFORE] > UNFIT * expected)
    m.counts[REFITS] += failed
    return failed


@inner
def fails(m: FilterState) -> bool:
    """Whether the fit failed at the end of the horizon: it costs far more than white noise, or lacks some samples."""
    if m.counts[REFITS] >= MOST_REFITS:
        return False
    expected = m.xi.size + m.noise.shape[0] * m.counts[BEFORE]
    failed = bool(m.score[COST_BEFORE] > UNFIT * expected or m.counts[BEFORE] < m.counts[STORED])
    m.counts[REFITS] += failed
    return failed


@inner
def strays(sensors: MeasurementModel, m: FilterState) -> bool:
    """Whether the filter has diverged after a fit: the sensors show far more than their white noise.

    While the arm holds something, every sensor must show it, as a fit that is begun again costs time. Of an empty arm
    the mean must, weighted by what each sensor tells of the payload.
    """
    if m.counts[REFITS] >= MOST_REFITS or (m.counts[HELD] == 1 and m.counts[LEARNED] == 0):
        return False
    if m.counts[STORED] < HORIZON or m.counts[SINCE_EVENT] % STRAY_EVERY != 0:
        return False
    least = STRAY
    for i in range(m.noise.shape[0]):
        least = min(least, m.noise[i, POWER] / white_variance(m.noise[i], WHITE))
    left = bool(least >= STRAY if m.counts[HELD] == 1 else misfit(m.noise, sensors.rate, WHITE) >= UNFIT)
    m.counts[REFITS] += left
    return left


@inner
def keep_possible(motion: ProcessModel, m: FilterState, chance: float) -> None:
    """Move the state to the most likely one within the bounds of p (constrained filter of Simon and Chia, 2002).

    All states move with an entry of p that is put back: otherwise each step across a bound would leave a bias in those
    that are correlated with it. A damping, a friction or a delay may be ``chance`` standard deviations below zero: for
    an arm without them noise puts half of the estimates there, and an estimate that may not go there is biased.
    """
    first = m.x.size - motion.kind.size
    count = gather_bounds(motion, m.x[first:], m.S, chance)
    if count > 0 and least_distance(motion.bounds, count):
        for i in range(m.x.size):
            m.x[i] += dot(m.S[i], motion.bounds.shortest)
    keep_inertia(motion, m.x[first:])


MEASURED_SHARE, MODELLED_SHARE = 0.1, 0.3
"""Standard deviations, in a sample, of the error of the share of Coulomb friction that acts: by measured rates of the
joints, and by those of the model. Simulated arms at 40 dB and 1 kHz have 0.07 to 0.13, and 0.12 to 0.32."""


@inner
def diffuse(motion: ProcessModel, sensors: MeasurementModel, m: FilterState, duration: float) -> None:
    """Add the process noise of the samples since it was last added.

    It keeps the memory finite. And it stands for the error of the Coulomb friction in each sample (``MEASURED_SHARE``).
    ``predict`` was just called.
    """
    m.score[NOW] += duration
    m.counts[SINCE_NOISE] += 1
    if m.counts[SINCE_NOISE] < sensors.noise_every or m.counts[STORED] < HORIZON:
        return
    root, nx, n, column = np.sqrt(m.score[NOW]), m.x.size, motion.arm.stiffness.size, motion.k[9]
    for i in range(nx):
        known = True
        for c in range(m.counts[USED]):
            known &= m.S[i, c] == 0.0
        for c in range(sensors.noise.shape[1]):
            sensors.noise[i, c] = 0.0
        sensors.noise[i, i] = 0.0 if known else sensors.diffusion[i] * root
        m.moved[i, 1] += sensors.noise[i, i] * sensors.noise[i, i]
    for i in range(motion.effort.size):
        for r in range(n):
            column[r] = motion.work.B[r, i]
        solve(motion.work.M, column)
        share = MODELLED_SHARE if np.isnan(motion.share[i]) else MEASURED_SHARE
        gained = share * motion.coulomb[i] * root * np.sqrt(sensors.period)
        for r in range(n):
            sensors.noise[n + r, nx + i] = gained * column[r]
    absorb_noise(m.S, sensors.noise, sensors.W)
    m.counts[SINCE_NOISE] = 0
    m.score[NOW] = 0.0


@merged
def take(motion: ProcessModel, sensors: MeasurementModel, m: FilterState, table: Array, k: int) -> bool:
    """Take the sample in row k of the table; False when numbers left the finite range.

    table: (N, 1 + 3 L + m), see ``capture_detection_kernel.advance``.
    """
    duration, y = table[k, 0], table[k, 1 + 3 * motion.effort.size:]
    rows = table[k + 1 - sensors.reach:k + 1]
    if not predict(motion, m.x, m.S, m.counts[USED], rows, sensors.period, duration):
        return False
    came = y[0] == y[0]
    if came:
        measure(sensors, m, y, motion.k[0], motion.opened)
        keep_possible(motion, m, CHANCE)
        if not abs(m.x[2 * sensors.H.shape[1]]) < 1e9:
            return False
        m.counts[SINCE_EVENT] += 1
        learn_noise(sensors, m)
    else:
        m.counts[IN_A_ROW] = 0
        for i in range(y.size):
            m.innovation[i, 0] = 0.0
    if not iterate(motion, sensors, m, table):
        return False
    if came:
        if strays(sensors, m):
            return False
        judge_moves(sensors, m)
    diffuse(motion, sensors, m, duration)
    return True
