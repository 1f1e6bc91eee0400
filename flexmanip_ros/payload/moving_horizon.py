"""Compiled loop of the structured estimator: a Kalman filter, and moving-horizon estimation since the last event.

An extended Kalman filter linearizes each sample once. The first samples after an event are linearized at a poor guess
of the payload, and that error would remain. Moving-horizon estimation mends it: a Gauss-Newton iteration reads the
samples since the event again (at most ``HORIZON``), ``ROWS`` for each new sample. When it has caught up with the
filter, its minimum replaces the filter's state, and the next iteration is linearized there. The arrival cost is the
state at the event, with mean x0 and covariance S0 S0'.

The fit knows no process noise. Where torques have some, that of Coulomb friction or of the reported efforts, a
linearized Kalman filter with it runs about the trajectory of each iteration. Near the minimum, and where it explains
the samples, its state replaces that of the filter.
"""

import numpy as np

from flexmanip_ros.arm.equations_of_motion import STICTION_RATE, solve
from flexmanip_ros.numerics.compiled import inner, separate, separate_kernel
from flexmanip_ros.numerics.square_root import absorb_noise, dot, least_distance
from flexmanip_ros.payload import filter_state as mem
from flexmanip_ros.payload.gauss_newton import (
    AT_REST,
    BY_CHANCE,
    FITS,
    LINEAR,
    MOST_BIAS,
    TELLS,
    UNFIT,
    agrees,
    begin_iteration,
    close_horizon,
    enough_samples,
    finish_iteration,
    first_samples,
    has_torque_noise,
    holds_still,
    noise_damping,
    phase_std,
    reject_step,
    takes_tip_inertia_as_given,
)
from flexmanip_ros.payload.measurement_update import (
    BATCH,
    MeasurementModel,
    judge_moves,
    learn_noise,
    measure,
    misfit,
    note_change,
    note_swing,
    observe,
    omitted_variance,
    white_variance,
)
from flexmanip_ros.payload.process_model import (
    INERTIA,
    ProcessModel,
    body_size,
    gather_bounds,
    keep_inertia,
    predict,
)
from flexmanip_ros.types import Array

FIRST_ITERATION = 8
"""Samples after an event before the first Gauss-Newton iteration: fewer tell less than the prior."""
ROWS, ROWS_TIME = 8, 1e-3
"""Rows that are read again for each new sample, at a sample time up to this [s]. Slower samples leave more processor
time, in proportion to their sample time, and a fit must not take longer with them."""
CLOSING = 16_384
"""Rows that are read again at most when the horizon closes: a fit of an empty arm takes up to ten times all of them."""
LATEST = 2
"""Times ``enough_samples`` after which the horizon closes although the fit has not come to rest: by then those have
that ever will."""
LONGEST_SLIDE = 1024
"""Largest number of samples by which the horizon of an arm at rest slides: it must hold some slides."""
WORK = 4
"""Largest mean number of integration steps for each row that is read again, over that of an arm without friction: a
joint that sticks takes three, wrong parameters may take hundreds."""
GROWTH = 4
"""One over the share by which the horizon must grow before a converged fit is repeated: a quarter; less hardly moves
it."""
TOLD = 0.1
"""Share by which the variance of the payload falls when samples tell of it. Noise is linearized as a vibration, and
seems to tell 3 % within a second of rest; a step of the torques tells 10 % within 15 to 75 ms."""
LOST = 1e12
"""Cost for each measurement beyond which a trajectory is given up: a million standard deviations of the noise. The best
encoders tell a million positions apart, so no arm is further from any estimate of it."""
TRIALS = 10
"""Iterations over the same samples after which a fit is given up: those that converge take three to nine."""
STARTS = 2
"""Fits from the event on that are given up as soon as they converge without fitting: of a point, then of a body."""
MOST_REFITS = 4
"""Largest number of times that the fit of an empty arm, or of one never seen empty, is begun again: with the parameters
of another arm none ever fits."""
RETRY = 30.0
"""Time after which an empty arm is fitted again whose fits all failed [s]. Two fits of an arm with a wrong mass take
some 16 s of processor time at 1 kHz: with 4 s in place of 30, a minute of its samples took 92 s."""
STRAY = 3.0
"""Innovation power over white noise, of every sensor, at which the filter is begun again."""
SLACK = 1.0
"""Increase of the cost up to which a step is accepted: one is a change of the estimate by one standard deviation."""
CHANCE = 3.0
"""Standard deviations by which the filter may estimate a nonnegative parameter below zero: noise hardly explains
more."""
MEDIAN = 0.6745
"""Median size of a Gaussian variable, in standard deviations."""
HALVINGS = 20
"""Steps of the bisection: the error is a millionth of the largest fourth difference."""
NEGLIGIBLE = 1e-4
"""White part of an effort over its largest size, below which it is neglected. 0.03 cost 0.75 % of the mass (measured),
so this costs less than 1e-4 of it."""
MEASURED_SHARE, MODELLED_SHARE = 0.5, 0.7
"""Standard deviations, in a sample, of the share of Coulomb friction that acts on a joint at rest: by measured rates of
the joints, and by those of the model. Simulated at 16 kHz with rates at 40 dB: 0.3 to 0.4 from sample to sample, and
1.3 times that at the frequencies of the modes."""
WAVES = 2.0
"""Rate over ``STICTION_RATE`` by which the rate of a joint departs within a sample from the line between its ends."""


@inner
def choose_rates(motion: ProcessModel, sensors: MeasurementModel, m: mem.FilterState, ringing: Array) -> None:
    """Take, of each joint, the measured rate or the model's for the Coulomb friction: the one with the smaller error.

    The measured rate has its white noise; the model's lacks the vibration of the omitted modes (3, L), ``note_change``.
    A noisy rate is a torque that never acted. Where little else moves the arm, it biases the mass that a fit
    finds (errors in variables): 10 kg were found for 16 kg.
    """
    for i in range(motion.modelled.size):
        motion.modelled[i] = omitted_variance(sensors.waves, i, ringing) < m.rate_noise[i]


@inner
def gather_torque_noise(motion: ProcessModel, m: mem.FilterState, variance: Array, noisy: bool) -> None:
    """Add to variance (L,) that of each torque over a sample [N^2 m^2]; ``predict`` was just called.

    noisy: whether reported efforts have noise. The share of Coulomb friction has d^2 / cosh^2(rate /
    (WAVES STICTION_RATE)): a joint that slides has the whole friction, one near rest has waves of the links' bending in
    its rate.
    """
    for i in range(variance.size):
        rate, std = motion.rate[i], MEASURED_SHARE
        if np.isnan(rate):
            rate, std = motion.work.net[1, i], MODELLED_SHARE
        friction = motion.coulomb[i] * std / np.cosh(rate / (WAVES * STICTION_RATE))
        variance[i] += friction * friction + (m.effort_noise[i] if noisy else 0.0)


@inner
def iterate_sample(motion: ProcessModel, sensors: MeasurementModel, m: mem.FilterState, table: Array) -> int:
    """Take one sample since the event into the iteration: N += f f' / r, g += f e / r.

    table: (N, 1 + 3 L + m), the rows before the event that a late torque needs, then the first sample after it. The
    cost is the sum of e^2 / r. Return the number of integration steps; 0: this trajectory is given up, the step was too
    long.
    """
    k = m.counts[mem.ITERATED] + sensors.reach - 1
    sample = table[k]
    n, nx, used, linearized = sensors.H.shape[1], m.x.size, m.counts[mem.USED], m.counts[mem.LINEARIZED] == 1
    columns = 2 * used + 1 if linearized else used
    first, f = 1 + 3 * motion.effort.size, sensors.wide[:columns]
    rows = table[k + 1 - sensors.reach:k + 1]
    note_change(sensors, m.ringing[2], sample[1:1 + motion.effort.size])
    choose_rates(motion, sensors, m, m.ringing[2])
    steps = predict(motion, m.xr, m.Sr, columns, rows, sensors.period, sample[0])
    if steps == 0:
        return 0
    measured = sample[first] == sample[first]
    if measured:
        m.counts[mem.MEASURED] += 1
    for i in range(m.noise.shape[0] if measured else 0):
        own = m.noise[i, mem.EFFECTIVE]
        r = own + omitted_variance(sensors.omitted, i, m.ringing[2])
        e = sample[first + i] - observe(sensors, i, n, m.xr, m.Sr, f, motion.k[0])
        weight = 1.0 / r
        m.score[mem.COST] += e * e * weight
        for a in range(used):
            scaled = weight * f[a]
            m.g[a] += scaled * e
            for b in range(a + 1):
                m.N[a, b] += scaled * f[b]
        m.noise[i, mem.FIT] += (update_linearized(m, f, e, r) if linearized else e * e) * own / r
    m.counts[mem.ITERATED] += 1
    if linearized:
        gather_torque_noise(motion, m, m.torque_noise[1], m.counts[mem.EFFORTS] in (mem.NOISY, mem.CONFIRMED))
        if m.counts[mem.ITERATED] % sensors.kicks_every == 0:
            diffuse_linearized(motion, sensors, m)
    if measured and m.counts[mem.HELD] == 0 and m.counts[mem.MEASURED] % (BATCH * sensors.block) == 0:
        for a in range(used):
            for b in range(a + 1):
                m.B[a, b] += (m.g[a] - m.batch[a]) * (m.g[b] - m.batch[b])
        for a in range(used):
            m.batch[a] = m.g[a]
    for part in range(mem.PARTS):
        for a in range(used if m.counts[mem.ITERATED] == first_samples(part) else 0):
            m.early_gradient[part, a] = m.g[a]
            for b in range(a + 1):
                m.early_normal[part, a, b] = m.N[a, b]
    if not m.score[mem.COST] < LOST * (nx + m.noise.shape[0] * m.counts[mem.ITERATED]):
        return 0
    # the cost only grows: a step may be rejected before its last sample
    if m.counts[mem.ITERATED] <= m.counts[mem.BEFORE] and m.score[mem.COST] > m.score[mem.COST_BEFORE] + SLACK:
        return 0
    return int(steps)


@inner
def update_linearized(m: mem.FilterState, f: Array, e: float, r: float) -> float:
    """Update the linearized filter with a measurement (Potter); return the squared innovation, scaled to variance r.

    Its state is the departure from the trajectory of the iteration. f: (2 USED + 1,) m.Sr' h, h the derivative of the
    measurement by the state; e: departure of the measurement from the trajectory; r: its variance.
    """
    used = m.counts[mem.USED]
    own = f[used:2 * used]
    e -= f[2 * used]
    variance = dot(own, own) + r
    gamma = 1.0 / (1.0 + np.sqrt(r / variance))
    for i in range(m.x.size):
        gain = dot(own, m.Sr[i, used:2 * used]) / variance
        m.Sr[i, 2 * used] += gain * e
        gain *= gamma
        for c in range(used):
            m.Sr[i, used + c] -= gain * own[c]
    m.score[mem.LOG_DETERMINANT] += np.log(variance / r)
    return float(e * e / variance * r)


@inner
def diffuse_linearized(motion: ProcessModel, sensors: MeasurementModel, m: mem.FilterState) -> None:
    """Add the process noise of the torques over the last samples to the linearized filter."""
    nx, used, root = m.x.size, m.counts[mem.USED], sensors.L
    for i in range(nx):
        for c in range(nx):
            root[i, c] = m.Sr[i, used + c] if c < used else 0.0
    add_torque_noise(motion, sensors, m.torque_noise[1])
    absorb_noise(root, sensors.kicks, sensors.W_kicks)
    for i in range(nx):
        for c in range(used):
            m.Sr[i, used + c] = root[i, c]


@inner
def add_torque_noise(motion: ProcessModel, sensors: MeasurementModel, variance: Array) -> None:
    """Fill sensors.kicks by the noise of the torques, see ``gather_torque_noise``; clear its sum.

    ``predict`` was just called.
    """
    n, column = motion.arm.stiffness.size, motion.k[9]
    for i in range(motion.effort.size):
        for r in range(n):
            column[r] = motion.work.B[r, i]
        solve(motion.work.M, column)
        gained = sensors.period * np.sqrt(variance[i])
        variance[i] = 0.0
        for r in range(n):
            sensors.kicks[n + r, i] = gained * column[r]


@inner
def kick(motion: ProcessModel, sensors: MeasurementModel, m: mem.FilterState) -> None:
    """Add the process noise of the torques since it was last added to the filter; ``predict`` was just called."""
    add_torque_noise(motion, sensors, m.torque_noise[0])
    absorb_noise(m.S, sensors.kicks, sensors.W_kicks)


@inner
def find_effort_noise(sensors: MeasurementModel, m: mem.FilterState, table: Array) -> None:
    """Estimate the variance of the white part of each reported effort since the event, by its fourth differences.

    Slow torques have no part in these. Steps of a torque do not move the median of their sizes, which is ``MEDIAN``
    deviations of Gaussian noise. It is found by bisection.
    """
    first, end = sensors.reach + 3, sensors.reach - 1 + m.counts[mem.STORED]
    for column in range(1, 1 + m.effort_noise.size):
        low, high, peak = 0.0, 0.0, 0.0
        for k in range(first, end):
            peak = max(peak, abs(table[k, column]))
            high = max(high, abs(fourth_difference(table, k, column)))
        for _ in range(HALVINGS):
            middle, below = 0.5 * (low + high), 0
            for k in range(first, end):
                below += abs(fourth_difference(table, k, column)) <= middle
            if 2 * below >= end - first:
                high = middle
            else:
                low = middle
        deviation = high / (MEDIAN * np.sqrt(70.0))
        m.effort_noise[column - 1] = deviation * deviation if deviation > NEGLIGIBLE * peak else 0.0


@inner
def fourth_difference(table: Array, k: int, column: int) -> float:
    """Return the fourth difference of a column at row k; that of white noise has 70 times the variance."""
    value: float = (table[k, column] - 4.0 * table[k - 1, column] + 6.0 * table[k - 2, column]
                    - 4.0 * table[k - 3, column] + table[k - 4, column])
    return value


@inner
def at_rest(sensors: MeasurementModel, m: mem.FilterState) -> bool:
    """Whether the last iteration over all samples so far hardly moved the payload."""
    return bool(m.counts[mem.BEFORE] >= enough_samples(sensors) and m.score[mem.SHIFT] < AT_REST
                and m.counts[mem.AGAIN] == 0)


@inner
def tells(motion: ProcessModel, sensors: MeasurementModel, m: mem.FilterState) -> bool:
    """Whether the samples since the event tell of the payload; of an empty arm: whether its variance fell by ``TOLD``.

    The prior of an empty arm is so narrow that noise seems to tell little, that of an unknown object is not.
    """
    mass = m.x.size - motion.kind.size
    if m.counts[mem.HELD] == 1:
        return not holds_still(sensors, m)
    return bool(dot(m.S[mass], m.S[mass]) < (1.0 - TOLD) * dot(m.S0[mass], m.S0[mass]))


@inner
def slide_length(sensors: MeasurementModel) -> int:
    """Return the number of samples by which the horizon of an arm at rest slides: most of the slowest period."""
    return int(min(BATCH * sensors.block, LONGEST_SLIDE))


@inner
def rests(motion: ProcessModel, sensors: MeasurementModel, m: mem.FilterState, last: bool) -> bool:
    """Whether the samples since the event fit, and tell nothing of a payload that is not known.

    Then the horizon slides until one does. Asked after two slides, when their number is a power of two, and of an arm
    that holds something at the last sample of its horizon.
    Not of an empty arm of which nothing is learned: its samples need no fit that begins with its motion.
    """
    count, mass, held = m.counts[mem.STORED], m.x.size - motion.kind.size, m.counts[mem.HELD] == 1
    due = count >= 2 * slide_length(sensors) and count & (count - 1) == 0
    if not (due or (last and held)) or (motion.kind[-1] <= INERTIA and not held):
        return False
    known = dot(m.S0[mass], m.S0[mass]) < (1.0 - TOLD) * motion.prior[0] * motion.prior[0]
    unfit = m.counts[mem.AGAIN] == 1 or (m.counts[mem.BEFORE] > 0 and m.score[mem.EXCESS] > BY_CHANCE)
    if known or unfit or m.counts[mem.SINCE_EVENT] > count or tells(motion, sensors, m):
        return False
    m.counts[mem.RESTS] = mem.RESTING
    m.counts[mem.STORED] = mem.HORIZON
    m.counts[mem.IN_BATCH] = slide_length(sensors)
    return True


@inner
def iterate(motion: ProcessModel, sensors: MeasurementModel, m: mem.FilterState, table: Array) -> bool:
    """Let the Gauss-Newton iteration take a few samples (``ROWS``); when the horizon closes, until it converges."""
    stored = m.counts[mem.STORED]
    if stored >= mem.HORIZON:
        return True
    m.counts[mem.STORED] = stored + 1
    if stored + 1 < FIRST_ITERATION:
        return True
    converged, last = at_rest(sensors, m), stored + 1 == mem.HORIZON
    if stored + 1 >= LATEST * enough_samples(sensors):
        last |= not converged or phase_std(motion, m, sensors.period * m.counts[mem.STORED]) < LINEAR
    if rests(motion, sensors, m, last):
        return True
    if last and converged:  # the filter goes on from there
        close_horizon(motion, sensors, m)
        return True
    rows = CLOSING if last else int(ROWS * max(sensors.period / ROWS_TIME, 1.0))
    work = WORK * rows * max(sensors.period / motion.substeps, 1.0)
    for _ in range(rows):
        if m.counts[mem.STORED] == mem.HORIZON > stored + 1:  # it has closed
            return True
        if work <= 0.0:
            break
        if m.counts[mem.ITERATING] == 0:
            before = m.counts[mem.BEFORE]
            if last:
                # until the step is within one standard deviation (Newton decrement): the filter goes on from here. A
                # trajectory without noise of the torques misses samples that have it: a joint sticks a sample more or
                # less. So neither its step nor its cost settles. There the linearized filter goes on from it, once that
                # explains the samples and the payload is at rest. The iteration that takes a white part of the efforts
                # for true (COMPARED) is always due.
                short = dot(m.g, m.gradient) < 1.0 and m.score[mem.LAMBDA] <= noise_damping(m)
                explained = m.counts[mem.LINEARIZED] == 1 and m.score[mem.MISFIT] < FITS
                enough = explained and m.score[mem.SHIFT] < AT_REST
                asked = m.counts[mem.EFFORTS] == mem.COMPARED or m.counts[mem.AGAIN] == 1
                due = before < m.counts[mem.STORED] or asked or not (short or enough)
            else:
                more = max(before // GROWTH, 1) if m.score[mem.SHIFT] < AT_REST else 1
                due = m.counts[mem.AGAIN] == 1 or m.counts[mem.STORED] >= before + more
            if not due:
                break
            if m.counts[mem.EFFORTS] == mem.NOISY and m.counts[mem.STORED] >= TELLS:
                find_effort_noise(sensors, m, table)
            begin_iteration(motion, m)
        until = m.counts[mem.BEFORE]
        if m.counts[mem.AGAIN] == 0:
            # a fit that is begun again reads all samples at once: a few fit many bodies, and lead to a wrong minimum
            grown = m.counts[mem.STORED] if last or until == 0 else until + until // 2 + FIRST_ITERATION
            until = min(m.counts[mem.STORED], grown)
        steps = iterate_sample(motion, sensors, m, table)
        work -= steps
        if steps == 0:
            if m.counts[mem.BEFORE] == 0 or not reject_step(motion, sensors, m):
                return False
        elif m.counts[mem.ITERATED] >= until and (not finish_iteration(motion, sensors, m) or misfits(motion, m)):
            return False
    if last:
        if m.counts[mem.HELD] == 1 and m.score[mem.SHIFT] >= AT_REST:  # linearized before it converged: too sure
            wider = np.sqrt(1.0 + m.score[mem.SHIFT] * m.score[mem.SHIFT])
            for i in range(m.x.size):
                for c in range(m.x.size):
                    m.S[i, c] *= wider
        if fails(m):
            m.counts[mem.STORED] = mem.HORIZON
            return False
        close_horizon(motion, sensors, m)
    return True


@inner
def misfits(motion: ProcessModel, m: mem.FilterState) -> bool:
    """Whether another start is due: the residuals are far more than the noise, or the fit came to no end in ``TRIALS``.

    Those of the simplest model of an arm, or of a point, need only exceed chance.
    """
    most = MOST_REFITS - 1
    if m.counts[mem.HELD] == 1:
        most = STARTS if body_size(motion) > 1 else 0
    early = m.counts[mem.TRIED] < TRIALS if m.counts[mem.AGAIN] == 1 else m.counts[mem.ITERATED] < TELLS
    failed = bool(m.counts[mem.AGAIN] == 1 or m.score[mem.MISFIT] > UNFIT
                  or (m.counts[mem.REFITS] == 0 and m.score[mem.EXCESS] > BY_CHANCE))
    if early or not failed:
        return not agrees(m) and begins_later(m)
    if m.counts[mem.REFITS] >= most:
        return m.score[mem.MISFIT] > UNFIT and begins_later(m)
    give_up(motion, m)
    return True


@inner
def give_up(motion: ProcessModel, m: mem.FilterState) -> None:
    """Let another fit begin: after that of the simplest arm one with an unknown rotary inertia of the tip mass."""
    if m.counts[mem.REFITS] == 0 and takes_tip_inertia_as_given(motion, m):
        m.counts[mem.WITH_TIP] = 1
    else:
        m.counts[mem.REFITS] += 1


@inner
def begins_later(m: mem.FilterState) -> bool:
    """Whether the horizon of an arm that caught something may begin anew with the next sample; count the ones before.

    It is to where no fit from the event explains the samples, or where the first ones disagree with those that
    followed, as they do where the object is taken over some time, or later than was announced. Each horizon spans at
    least as many samples as came between the event and it. So an arm of which no sample fits begins anew at times that
    double.
    """
    learned = m.counts[mem.HELD] == 1 and m.counts[mem.LEARNED] == 1
    if not learned or m.counts[mem.SINCE_EVENT] < m.counts[mem.SKIPPED]:
        return False
    m.counts[mem.SKIPPED] += m.counts[mem.SINCE_EVENT]
    return True


@inner
def fails(m: mem.FilterState) -> bool:
    """Whether the fit failed at the end of the horizon: it costs far more than white noise, or lacks some samples."""
    failed = bool(m.score[mem.MISFIT] > UNFIT or m.counts[mem.BEFORE] < m.counts[mem.STORED])
    if not failed or begins_later(m):
        return failed
    if m.counts[mem.REFITS] >= MOST_REFITS or (m.counts[mem.HELD] == 1 and m.counts[mem.LEARNED] == 1):
        return False
    m.counts[mem.REFITS] += 1
    return True


@inner
def excess_bias(motion: ProcessModel, m: mem.FilterState) -> float:
    """Return the mass that an empty arm seems to hold, in deviations by its moves and the error of its inertia."""
    mass = m.x.size - motion.kind.size
    variance = dot(m.S[mass], m.S[mass])
    if m.counts[mem.MOVED] > 0:
        variance *= max(m.score[mem.MOVES], 1.0)
    return float(m.x[mass] / np.sqrt(max(variance + motion.considered * motion.considered, 1e-300)))


@separate
def strays(motion: ProcessModel, sensors: MeasurementModel, m: mem.FilterState) -> bool:
    """Whether the filter has diverged after a fit: the sensors show far more than their white noise.

    While the arm holds something, every sensor must show it, as a fit that is begun again costs time. Of an empty arm
    the mean must, weighted by what each sensor tells of the payload, or the arm seems to hold something. One whose
    fits all failed is fitted again after ``RETRY``, then at times that double: something may have touched it.
    """
    if m.counts[mem.STORED] < mem.HORIZON or m.counts[mem.SINCE_EVENT] % (BATCH * sensors.block) != 0:
        return False
    least = STRAY
    for i in range(m.noise.shape[0]):
        least = min(least, m.noise[i, mem.POWER] / white_variance(m.noise[i], mem.WHITE))
    left = least >= STRAY
    if m.counts[mem.HELD] == 0:
        left = misfit(m.noise, sensors.rate, mem.WHITE) >= UNFIT
        if not left and abs(excess_bias(motion, m)) > MOST_BIAS:
            left = True  # it fits with a mass that is none: what this fit has learned is wrong
            if m.counts[mem.EXPLAINS] == 1:
                m.known[:] = 0.0
    if m.counts[mem.HELD] == 1:
        return bool(left) and begins_later(m)
    if not left and m.counts[mem.RESTS] != mem.RESTING:
        note_known(m)
        m.counts[mem.EXPLAINS] = 1
    if left and m.counts[mem.REFITS] < MOST_REFITS:
        give_up(motion, m)
    elif left and m.counts[mem.SINCE_EVENT] >= max(m.counts[mem.SKIPPED], RETRY / sensors.period):
        m.counts[mem.SKIPPED] += m.counts[mem.SINCE_EVENT]
    else:
        return False
    return True


@inner
def note_known(m: mem.FilterState) -> None:
    """Keep the state of an empty arm that explains the samples, and the one kept before.

    A look may come just after something was caught that nobody announced: so the one before is what was known.
    """
    nx = m.x.size
    for i in range(nx):
        for c in range(nx):
            m.known[1, i, c] = m.known[0, i, c]
            m.known[0, i, c] = m.S[i, c]
        m.known[1, i, nx] = m.known[0, i, nx]
        m.known[0, i, nx] = m.x[i]


@separate_kernel
def keep_possible(motion: ProcessModel, m: mem.FilterState, chance: float) -> None:
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


@separate
def diffuse(motion: ProcessModel, sensors: MeasurementModel, m: mem.FilterState, duration: float) -> None:
    """Add the process noise since it was last added, which keeps the memory finite once the horizon has closed.

    That of the torques is here that of a friction within chance. ``predict`` was just called.
    """
    m.score[mem.NOW] += duration
    if m.counts[mem.STORED] < mem.HORIZON or m.counts[mem.SINCE_NOISE] < sensors.noise_every:
        return
    root = np.sqrt(m.score[mem.NOW])
    sensors.noise[:] = 0.0
    for i in range(m.x.size):
        if dot(m.S[i], m.S[i]) > 0.0:  # what is taken as known stays
            sensors.noise[i, i] = sensors.diffusion[i] * root
        m.moved[i, 1] += sensors.noise[i, i] * sensors.noise[i, i]
    absorb_noise(m.S, sensors.noise, sensors.W)
    kick(motion, sensors, m)
    m.counts[mem.SINCE_NOISE] = 0
    m.score[mem.NOW] = 0.0


@inner
def take(motion: ProcessModel, sensors: MeasurementModel, m: mem.FilterState, table: Array, k: int) -> bool:
    """Take the sample in row k of the table; False: numbers left the finite range, or a fit failed.

    table: (N, 1 + 3 L + m), see ``capture_detection_kernel.advance``.
    """
    duration, y = table[k, 0], table[k, 1 + 3 * motion.effort.size:]
    rows = table[k + 1 - sensors.reach:k + 1]
    note_change(sensors, m.ringing[0], table[k, 1:1 + motion.effort.size])
    choose_rates(motion, sensors, m, m.ringing[0])
    if not predict(motion, m.x, m.S, m.counts[mem.USED], rows, sensors.period, duration):
        return False
    came = y[0] == y[0]
    if came:
        note_swing(m, y)
        measure(sensors, m, y, motion.k[0], motion.opened)
        if not abs(m.x[2 * sensors.H.shape[1]]) < 1e9:
            return False
        m.counts[mem.SINCE_EVENT] += 1
        learn_noise(sensors, m)
    else:
        m.counts[mem.IN_A_ROW] = 0
        m.innovation[:, 0] = 0.0
    m.counts[mem.SINCE_NOISE] += 1
    gather_torque_noise(motion, m, m.torque_noise[0], m.counts[mem.EFFORTS] != mem.EXACT)
    # before that an empty arm's friction may be anything
    told = m.counts[mem.HELD] == 1 or m.counts[mem.STORED] >= TELLS
    if told and m.counts[mem.SINCE_NOISE] % sensors.kicks_every == 0 and has_torque_noise(motion, m):
        kick(motion, sensors, m)
    if not iterate(motion, sensors, m, table):
        return False
    keep_possible(motion, m, CHANCE)
    if came:
        if strays(motion, sensors, m):
            return False
        judge_moves(sensors, m)
    diffuse(motion, sensors, m, duration)
    return True
