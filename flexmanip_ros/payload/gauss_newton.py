"""Compiled steps of the Gauss-Newton iteration over the moving horizon (``moving_horizon``).

An iteration has summed the normal equations I + N and the gradient g over the samples since the event, for the state xi
at the event in units of its arrival cost. Its step is damped (Levenberg and Marquardt) and kept within the bounds of
the parameters. Where it has read all samples, the filter goes on from its minimum, and a fit that has converged closes
the horizon. Kernels of their own, as each runs once an iteration, not once a sample.
"""

import numpy as np

from flexmanip_ros.numerics.compiled import inner, separate
from flexmanip_ros.numerics.square_root import absorb_noise, backward, dot, factor_information, forward, least_distance
from flexmanip_ros.payload import filter_state as mem
from flexmanip_ros.payload.measurement_update import (
    BATCH,
    BLOCK_MEMORY,
    OVERLAP,
    MeasurementModel,
    most_white,
    vibrates,
    white_variance,
)
from flexmanip_ros.payload.process_model import (
    COULOMB,
    INERTIA,
    MODE,
    STEP_ANGLE,
    STIFFNESS,
    TIP_INERTIA,
    ProcessModel,
    body_size,
    gather_bounds,
    keep_inertia,
    tip_inertia,
)
from flexmanip_ros.types import Array

LINEAR = 0.25
"""Standard deviation of a mode's phase [rad] up to which the motion is linear in the phase: its sine is, to 1 %.
Beyond, the filter that goes on from the fit underestimates its covariance, and may lock on to a phase that is off by 2
pi."""
AT_REST = 0.5
"""A fit has converged when its last step moved the payload by less than this share of its standard deviation."""
CONVERGED = 0.02
"""Decrease of the cost for each sample below which a step counts as converged, and the horizon may grow."""
FITS = 1.5
"""Cost over that of the noise assumed up to which a short step counts as converged, too: the next one reads more."""
LEAST_BLOCKS = 24
"""Least number of blocks, tenths of the slowest period, in a horizon. With fewer, friction and delays are so unsure
that a filter linearized once goes astray from them: at 2 kHz 512 samples are 1.4 periods, and one of 20 random arms was
lost."""
TRUSTED = 2.0
"""Standard deviations by which a step of the moving-horizon estimation moves the filter's state at most."""
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
TELLS = 50
"""Samples after which the cost tells whether a fit is one: that of white noise then varies by 0.1 of itself."""
UNFIT = 2.0
"""Power of the residuals over the noise assumed beyond which a fit is rejected."""
BY_CHANCE = 5.0
"""Deviations of chance by which the residuals of a fit exceed the noise where the model is not the simplest one."""
MOST_BIAS = 4.0
"""Standard deviations, with the error of its inertia among them, that an empty arm may seem to hold. Beyond them the
arm is not the one that was described or learned, and what it catches is estimated wrong. Chance exceeds them 1 time in
16 000. In 26 looks, as many as five seconds of the default arm have, that is 1 in 600. With 3 (1 in 370) six more of
120 random arms were INCONSISTENT; five of them knew the payload."""
VAGUE = 0.01
"""Share of the information of an object's prior that counts in the test of its first samples. An object of 500 kg is 11
prior deviations from the mean: with this share it seems to disagree by about one more."""
REJECTIONS = 8
"""Number of times that a step that raises the cost is shortened."""
FRICTION = 3.0
"""Standard deviations of a Coulomb friction above zero from which on there is one: chance hardly explains more."""


@inner
def has_torque_noise(motion: ProcessModel, m: mem.FilterState) -> bool:
    """Whether torques have process noise: that of the reported efforts, or of Coulomb friction beyond chance."""
    first, found = m.x.size - motion.kind.size, False
    for i in range(m.effort_noise.size):
        found |= m.effort_noise[i] > 0.0 and m.counts[mem.EFFORTS] != mem.EXACT
    for c in range(motion.kind.size):
        if motion.kind[c] == COULOMB:
            found |= m.x[first + c] > FRICTION * np.sqrt(dot(m.S[first + c], m.S[first + c]))
    return found


@inner
def begin_iteration(motion: ProcessModel, m: mem.FilterState) -> None:
    """Start a Gauss-Newton iteration at the event, linearized at the estimate of the last one."""
    nx, used = m.x.size, m.counts[mem.USED]
    m.score[mem.COST] = 0.0
    m.score[mem.LOG_DETERMINANT] = 0.0
    m.counts[mem.LINEARIZED] = has_torque_noise(motion, m)
    m.torque_noise[1], m.noise[:, mem.FIT] = 0.0, 0.0
    m.g[:], m.batch[:], m.N[:], m.B[:] = 0.0, 0.0, 0.0, 0.0
    for i in range(motion.effort.size):
        for part in range(3):
            m.ringing[2, part, i] = m.ringing[1, part, i]
    for i in range(nx):
        departure = dot(m.S0[i], m.xi)
        m.xr[i] = m.x0[i] + departure
        m.score[mem.COST] += m.xi[i] * m.xi[i]
        for c in range(used):
            m.Sr[i, c] = m.S0[i, c]
            m.Sr[i, used + c] = m.S0[i, c]
        m.Sr[i, 2 * used] = -departure
    expect_noise(m)
    m.counts[mem.ITERATED] = 0
    m.counts[mem.MEASURED] = 0
    m.counts[mem.ITERATING] = 1


@inner
def expect_noise(m: mem.FilterState) -> None:
    """Assume of each sensor the most that its white noise may vary, until its innovations have shown their variance.

    An iteration over the same samples keeps the variances, as costs are compared. Before ``TELLS`` samples the first
    guess is no worse than the estimate. A cost with larger variances is less, so the last one is raised with them.
    """
    if m.counts[mem.BLOCKS] > 0 or m.counts[mem.AGAIN] == 1 or m.counts[mem.REJECTED] > 0 or m.counts[mem.SEEN] < TELLS:
        return
    grown = 1.0
    for i in range(m.noise.shape[0]):
        most = most_white(m.noise[i], m.counts[mem.SEEN])
        grown = max(grown, m.noise[i, mem.EFFECTIVE] / most)
        m.noise[i, mem.EFFECTIVE] = most
    m.score[mem.COST_BEFORE] *= grown


@inner
def judge_residuals(m: mem.FilterState) -> None:
    """Compare the power of the residuals of an iteration with the noise assumed, and with white noise.

    MISFIT is their ratio to the noise that the fit assumes. EXCESS compares with the sensors' white noise, or with what
    the innovations were before the event, in deviations of chance. The mean of N squares varies by sqrt(2 / N), and so
    does the estimate of the white noise, see ``OVERLAP``.
    """
    count, sensors, total = max(m.counts[mem.MEASURED], 1), m.noise.shape[0], 0.0
    m.score[mem.MISFIT] = 0.0
    for i in range(sensors):
        variance = white_variance(m.noise[i], mem.LEVEL)
        if m.counts[mem.BLOCKS] > 0:
            variance = max(variance, m.noise[i, mem.EFFECTIVE])
        total += m.noise[i, mem.FIT] / variance
        m.score[mem.MISFIT] += m.noise[i, mem.FIT] / (m.noise[i, mem.EFFECTIVE] * sensors * count)
    chance = np.sqrt((2.0 / count + 2.0 * OVERLAP / max(m.counts[mem.SEEN], 1)) / sensors)
    m.score[mem.EXCESS] = (total / (sensors * count) - 1.0) / chance


@separate
def finish_iteration(motion: ProcessModel, sensors: MeasurementModel, m: mem.FilterState) -> bool:
    """Accept the iteration and take the next step. Where it has read all samples, the filter goes on from there."""
    nx = m.x.size
    for i in range(nx):
        m.accepted[i] = m.xi[i]
        m.gradient[i] = m.g[i] - m.xi[i]
        for c in range(i + 1):
            m.normal[i, c] = m.N[i, c]
    enough = CONVERGED * m.counts[mem.ITERATED]
    # two steps may undo each other for ever where the valley bends
    still = m.counts[mem.BEFORE] == m.counts[mem.ITERATED] and m.score[mem.COST_BEFORE] - m.score[mem.COST] < enough
    free = m.score[mem.LAMBDA] <= first_damping(m)  # a strongly damped step gains little wherever it is taken
    m.counts[mem.BEFORE] = m.counts[mem.ITERATED]
    m.score[mem.COST_BEFORE] = m.score[mem.COST]
    # by the trajectory: a linearized filter explains residuals of one that is far from the minimum
    fits = cost_ratio(m) < FITS
    rejected = are_efforts_noisy(m)
    if not rejected:
        judge_residuals(m)
    m.score[mem.LAMBDA] = m.score[mem.LAMBDA] / FADING if m.score[mem.LAMBDA] > FADED * first_damping(m) else 0.0
    m.score[mem.LAMBDA] = max(m.score[mem.LAMBDA], noise_damping(m))
    m.counts[mem.REJECTED] = 0
    m.counts[mem.ITERATING] = 0
    if not damped_step(motion, sensors, m):
        return False
    gained = dot(m.g, m.gradient)
    # The step promises to lower the cost by this; noise alone by as much as there are unknowns (mean of chi-squared). A
    # fit that lags behind reads more first.
    fits &= gained < nx or m.counts[mem.ITERATED] < m.counts[mem.STORED]
    # the simplest model is given up by chance, so not before it has converged
    fits &= m.counts[mem.REFITS] > 0 or m.score[mem.EXCESS] < BY_CHANCE
    m.counts[mem.AGAIN] = 0 if fits or (free and (still or gained < enough)) else 1
    if fits and m.counts[mem.HELD] == 1:  # the next iteration reads more: its cost is another
        m.score[mem.LAMBDA] = 0.0
    m.counts[mem.TRIED] = m.counts[mem.TRIED] + 1 if m.counts[mem.AGAIN] else 0
    m.score[mem.DISAGREES] = disagreement(motion, sensors, m)
    if rejected:  # the filter has gone on with noisy efforts
        m.counts[mem.AGAIN] = 0
        close_horizon(motion, sensors, m)
    elif m.counts[mem.ITERATED] == m.counts[mem.STORED]:
        if not factor_information(m.N):
            return False
        for i in range(m.noise.shape[0]):
            m.noise[i, mem.POWER] = m.noise[i, mem.FIT] / max(m.counts[mem.MEASURED], 1)
            m.noise[i, mem.SLOW] = m.noise[i, mem.POWER]
        # the step was not seen to lower the cost yet: the filter takes no more of it than it can tell
        part = min(1.0, TRUSTED / np.sqrt(max(gained, 1e-300)))
        payload, used = 2 * sensors.H.shape[1], m.counts[mem.USED]
        shift = dot(m.Sr[payload, :used], m.g[:used])
        for i in range(nx):
            m.x[i] = m.xr[i] + part * dot(m.Sr[i, :used], m.g[:used])
            forward(m.N, m.Sr[i, :used])
            for c in range(nx):
                m.S[i, c] = m.Sr[i, c] if c < used else 0.0
        # its linearization holds near the minimum, and where its innovations are those of the noise
        if m.counts[mem.LINEARIZED] == 1 and (part == 1.0 or m.score[mem.MISFIT] < FITS):
            for i in range(nx):
                m.x[i] = m.xr[i] + m.Sr[i, 2 * used]
                for c in range(used):
                    m.S[i, c] = m.Sr[i, used + c]
        if m.counts[mem.HELD] == 0:
            m.score[mem.SANDWICH] = sandwich(sensors, m)
        else:
            widen_by_empty_arm(sensors, m)
        variance = dot(m.S[payload], m.S[payload])
        m.score[mem.SHIFT] = abs(shift) / np.sqrt(max(variance, 1e-300))
        m.score[mem.DOUBT] = np.sqrt(variance + shift * shift) / max(m.x[payload], 1e-300)
        told = agrees(m) and not holds_still(sensors, m)
        if (told and m.counts[mem.ITERATED] >= enough_samples(sensors) and gained < 0.5 * nx
                and m.score[mem.SHIFT] < AT_REST
                and phase_std(motion, m, sensors.period * m.counts[mem.ITERATED]) < LINEAR):
            close_horizon(motion, sensors, m)
    return True


@inner
def first_samples(part: int) -> int:
    """Return the number of samples in a beginning of the horizon that is kept apart: 16, 64, 256, 1024."""
    return 16 << 2 * part


@separate
def disagreement(motion: ProcessModel, sensors: MeasurementModel, m: mem.FilterState) -> float:
    """Return by how many standard deviations the payload moves where the first samples of a capture do not count.

    Specification test of Hausman (1978): an estimate from all samples and one from the later ones alone differ by
    chance alone if all come from one model. After an event they do not where the object is taken over some time. The
    later samples may come from another state, off by delta in units of the arrival cost. With the sums N, g of all
    samples, N2, g2 of the later ones at the minimum, and V = N2 - N2 (I + N)^-1 N2: delta = (I + V)^-1 g2, with the
    covariance W - W W, W = (I + V)^-1, over the power of the residuals. The largest of all beginnings that at least as
    many samples followed. The prior of the object counts for ``VAGUE``, or one that is heavier than expected would
    disagree. 0: the fit has not converged, or torques have process noise, of which N knows nothing.
    """
    largest = 0.0
    if m.counts[mem.HELD] == 0 or m.counts[mem.AGAIN] == 1 or m.counts[mem.LINEARIZED] == 1:
        return largest
    nx, mass, L, later = m.x.size, m.x.size - motion.kind.size, sensors.L, sensors.noise
    body = body_size(motion)
    step, gradient, row = sensors.wide[:nx], sensors.wide[nx:2 * nx], sensors.f
    for part in range(mem.PARTS):
        if m.counts[mem.ITERATED] < 2 * first_samples(part):
            break
        for i in range(nx):
            step[i] = m.gradient[i]
            for c in range(i + 1):
                L[i, c] = m.normal[i, c]
                later[i, c] = m.normal[i, c] - m.early_normal[part, i, c]
                later[c, i] = later[i, c]
        for i in range(mass, mass + body):
            own = nx - 1
            while own > 0 and m.S0[i, own] == 0.0:
                own -= 1
            if m.S0[i, own] != 0.0:
                L[own, own] -= 1.0 - VAGUE
                step[own] += (1.0 - VAGUE) * m.accepted[own]
        if not factor_information(L):
            return largest
        forward(L, step)
        backward(L, step)
        for i in range(nx):
            gradient[i] = m.gradient[i] + m.accepted[i] - m.early_gradient[part, i] - dot(later[i], step)
        for i in range(nx):
            forward(L, later[i])
        for i in range(nx):
            for c in range(i + 1):
                L[i, c] = m.normal[i, c] - m.early_normal[part, i, c] - dot(later[i], later[c])
            row[i] = m.S0[mass, i]
        if not factor_information(L):
            return largest
        forward(L, row)
        variance = dot(row, row)
        backward(L, row)
        variance = max(variance - dot(row, row), 1e-300) * max(m.score[mem.MISFIT], 1.0)
        largest = max(largest, abs(dot(row, gradient)) / np.sqrt(variance))
    return float(largest)


@inner
def agrees(m: mem.FilterState) -> bool:
    """Whether the first samples after the event agree with those that followed, see ``disagreement``."""
    return bool(m.score[mem.DISAGREES] <= MOST_BIAS)


@inner
def holds_still(sensors: MeasurementModel, m: mem.FilterState) -> bool:
    """Whether the arm holds something and has not vibrated since the event, so that no sample tells of its mass."""
    return bool(m.counts[mem.HELD] == 1 and not vibrates(sensors, m))


@inner
def are_efforts_noisy(m: mem.FilterState) -> bool:
    """Compare efforts that act on the arm as reported with noisy ones; True: the noisy ones fit better.

    The likelihood is that of the innovations of the linearized filter, at the greatest over a factor of all variances:
    -2 log p = sum of log(variance / r) + N log(mean of innovation^2 r / variance) of each sensor.
    """
    if m.counts[mem.LINEARIZED] == 0:
        return False
    count = max(m.counts[mem.MEASURED], 1)
    value = m.score[mem.LOG_DETERMINANT]
    for i in range(m.noise.shape[0]):
        value += count * np.log(max(m.noise[i, mem.FIT], 1e-300) / count)
    compared = m.counts[mem.EFFORTS] == mem.COMPARED
    if compared:
        m.counts[mem.EFFORTS] = mem.EXACT if value < m.score[mem.LIKELIHOOD] else mem.CONFIRMED
        m.score[mem.SHIFT] = AT_REST  # the next iteration is due
    m.score[mem.LIKELIHOOD] = value
    return bool(compared and m.counts[mem.EFFORTS] == mem.CONFIRMED)


@inner
def sandwich(sensors: MeasurementModel, m: mem.FilterState) -> float:
    """Return the factor, at least 1, by which the variances of a fit are too small; m.N: factor of I + N.

    The variance by batch means (sandwich of Huber and White): where the residuals are no white noise, the gradient is
    a sum of parts b of batches that are nearly independent, so the variance of xi by them is W B W, W = (I + N)^-1,
    B = sum b b'. The fit says W N W instead, and where the friction has process noise, m.S more by what that adds. The
    factor is the mean over payload and arm parameters of the ratio.
    """
    nx, row = m.x.size, sensors.f
    length = BATCH * sensors.block
    whole = m.counts[mem.MEASURED] // length
    if whole == 0:
        return 1.0
    total, known = 0.0, 0
    for i in range(2 * sensors.H.shape[1], nx):
        for c in range(nx):
            row[c] = m.S0[i, c]
        forward(m.N, row)
        more = dot(m.S[i], m.S[i]) - dot(row, row) if m.counts[mem.LINEARIZED] == 1 else 0.0
        backward(m.N, row)
        said = dot(row, m.S0[i]) - dot(row, row) + more
        found = 0.0
        for a in range(nx):
            for b in range(a):
                found += 2.0 * row[a] * m.B[a, b] * row[b]
            found += row[a] * m.B[a, a] * row[a]
        if said > 0.0:
            total += found / said
            known += 1
    factor: float = total / max(known, 1) * m.counts[mem.MEASURED] / (whole * length)
    return max(1.0, factor)


@inner
def widen_by_empty_arm(sensors: MeasurementModel, m: mem.FilterState) -> None:
    """Add to the covariance of a fit with an object what its prior lacks: the variances of the empty arm's fit.

    If these are too small by the factor g, the prior of xi has the covariance g I, and xi the variance W + (g - 1) W W,
    W = (I + N)^-1. The estimate stays, as the fit weighs the prior by what the empty arm's fit said. m.N: factor L of
    I + N; m.Sr: the derivative of the present state by xi, times the inverse of L'.
    """
    nx = m.x.size
    root = np.sqrt(max(m.score[mem.SANDWICH] - 1.0, 0.0))
    if root == 0.0:
        return
    for i in range(nx):
        for c in range(nx):
            sensors.f[c] = m.Sr[i, c] if c < m.counts[mem.USED] else 0.0
        backward(m.N, sensors.f)
        for c in range(nx):
            sensors.noise[i, c] = root * sensors.f[c]
    absorb_noise(m.S, sensors.noise, sensors.W)


@inner
def takes_tip_inertia_as_given(motion: ProcessModel, m: mem.FilterState) -> bool:
    """Whether the fit of an empty arm takes the rotary inertia of the tip mass as given, and might estimate it."""
    own = tip_inertia(motion)
    row = m.x.size - motion.kind.size + own
    return bool(m.counts[mem.HELD] == 0 and own >= 0 and motion.prior[own] > 0.0 and not m.S0[row].any())


@inner
def open_tip_inertia(motion: ProcessModel, m: mem.FilterState) -> None:
    """Let the fit estimate the rotary inertia of the tip mass too, by another iteration from where it has converged.

    The phases of the fastest modes depend on it: a fit that estimates it with all else from the first samples on has
    more false minima.
    """
    own, used = tip_inertia(motion), m.counts[mem.USED]
    m.S0[m.x.size - motion.kind.size + own, used] = motion.prior[own]
    m.xi[used], m.accepted[used] = 0.0, 0.0
    m.counts[mem.USED] += 1
    m.counts[mem.ITERATING], m.counts[mem.TRIED], m.counts[mem.AGAIN] = 0, 0, 1
    m.score[mem.SHIFT] = AT_REST  # the next iteration is due


@inner
def is_late(kind: int) -> bool:
    """Whether a parameter of this kind makes a signal late."""
    return MODE < kind < TIP_INERTIA


@inner
def evidence_against_delays(motion: ProcessModel, sensors: MeasurementModel, m: mem.FilterState) -> float:
    """Return the logarithm of the Bayes factor of signals that are as late as given, over that of unknown delays.

    It is the density of the given delays after the samples over that before (Savage and Dickey). 0: all are known.
    """
    L, departure, first = sensors.L, sensors.f, m.x.size - motion.kind.size
    L[:], departure[:] = 0.0, 0.0
    for a in range(motion.kind.size):
        if is_late(motion.kind[a]) and dot(m.S[first + a], m.S[first + a]) > 0.0:
            departure[a] = (m.x[first + a] - motion.given[a]) / motion.prior[a]
            L[a, a] = -1.0  # ``factor_information`` adds one
            for b in range(a + 1):
                if is_late(motion.kind[b]):
                    scale = motion.prior[a] * motion.prior[b]
                    L[a, b] += m.score[mem.SANDWICH] * dot(m.S[first + a], m.S[first + b]) / max(scale, 1e-300)
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
    S[row] = 0.0


@separate
def close_horizon(motion: ProcessModel, sensors: MeasurementModel, m: mem.FilterState) -> None:
    """Close the horizon; where an empty arm shows no late signal, fit its samples again with the given delays.

    Where its efforts have a white part, that was taken for noise. Another iteration takes it for true.

    What the shape functions lack looks like a delay of some 0.1 ms. A delay that is learned and not there shifts the
    mass that is caught later, by 0.5 % for 0.1 ms.
    """
    empty = m.counts[mem.HELD] == 0 and m.counts[mem.STORED] < mem.HORIZON
    again = empty and evidence_against_delays(motion, sensors, m) > VERY_STRONG
    noisy = m.counts[mem.EFFORTS] == mem.NOISY and m.counts[mem.LINEARIZED] == 1 and m.effort_noise.any()
    if empty and not again and m.counts[mem.REFITS] > 0 and takes_tip_inertia_as_given(motion, m):
        open_tip_inertia(motion, m)
        return
    if empty and not again and noisy:
        m.counts[mem.EFFORTS] = mem.COMPARED
        m.counts[mem.ITERATING] = 0
        m.counts[mem.AGAIN] = 1
        return
    if not again:
        m.counts[mem.STORED] = mem.HORIZON
        # the powers of the innovations are those of the fit, and as many blocks have been averaged
        m.counts[mem.BLOCKS] = max(1, min(m.counts[mem.BEFORE] // sensors.block, BLOCK_MEMORY))
        if m.counts[mem.EFFORTS] == mem.COMPARED:  # not to its end
            m.counts[mem.EFFORTS] = mem.NOISY
        # a bias for which the empty arm's fit was begun again is no longer doubted where all that followed fits
        fits = m.score[mem.EXCESS] < BY_CHANCE and abs(m.score[mem.EMPTY_ARM_BIAS]) < MOST_BIAS
        if m.counts[mem.HELD] == 0 or (fits and m.score[mem.EXCESS_BIAS] < np.inf):
            m.score[mem.EXCESS_BIAS] = 0.0
        return
    first = m.x.size - motion.kind.size
    for c in range(motion.kind.size):
        if is_late(motion.kind[c]):
            condition(m.x, m.S, first + c, motion.given[c], sensors.f)
            condition(m.x0, m.S0, first + c, motion.given[c], sensors.f)
    for counter in (mem.ITERATED, mem.ITERATING, mem.BEFORE, mem.REJECTED, mem.AGAIN, mem.TRIED):
        m.counts[counter] = 0
    m.score[mem.LAMBDA] = 0.0


@inner
def phase_std(motion: ProcessModel, m: mem.FilterState, duration: float) -> float:
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
def cost_ratio(m: mem.FilterState) -> float:
    """Return the cost of the last accepted iteration over that of the noise assumed."""
    ratio: float = m.score[mem.COST_BEFORE] / (m.x.size + m.noise.shape[0] * m.counts[mem.MEASURED])
    return ratio


@inner
def noise_damping(m: mem.FilterState) -> float:
    """Return the damping of a fit after a capture whose residuals exceed the noise assumed; 0: they do not.

    With s times the noise, which explains the residuals, the cost's second derivative is that of s I + N.
    """
    ratio = cost_ratio(m)
    return ratio - 1.0 if m.counts[mem.HELD] == 1 and ratio >= FITS else 0.0


@inner
def enough_samples(sensors: MeasurementModel) -> int:
    """Return the number of samples after which a fit that has converged closes the horizon.

    At most half of the largest horizon, as twice as many samples close it unless it has converged (``LATEST``).
    """
    return int(min(max(mem.ENOUGH, LEAST_BLOCKS * sensors.block), mem.HORIZON // 2))


@inner
def first_damping(m: mem.FilterState) -> float:
    """Return the damping after the first rejected step."""
    return LEVENBERG if m.counts[mem.HELD] == 1 else MARQUARDT


@inner
def damped_step(motion: ProcessModel, sensors: MeasurementModel, m: mem.FilterState) -> bool:
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
        L[i, i] += m.score[mem.LAMBDA] * (1.0 if m.counts[mem.HELD] == 1 else 1.0 + L[i, i])
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
    lacks, own = keep_inertia(motion, p), m.counts[mem.USED] - 1
    while lacks > 0.0 and own >= 0 and m.S0[first + INERTIA, own] == 0.0:  # its own column is the last in its row
        own -= 1
    if lacks > 0.0 and own >= 0:
        m.xi[own] += lacks / m.S0[first + INERTIA, own]
        m.g[own] += lacks / m.S0[first + INERTIA, own]
    return True


@separate
def reject_step(motion: ProcessModel, sensors: MeasurementModel, m: mem.FilterState) -> bool:
    """Take a shorter step from the accepted xi, nearer to the gradient, and begin the iteration again."""
    m.counts[mem.REJECTED] += 1
    m.score[mem.LAMBDA] = FADING * m.score[mem.LAMBDA] if m.score[mem.LAMBDA] > 0.0 else first_damping(m)
    if m.counts[mem.REJECTED] > REJECTIONS:  # a valley that bends: go on from here
        m.score[mem.COST_BEFORE] = 1e300
    if not damped_step(motion, sensors, m):
        return False
    begin_iteration(motion, m)
    return True
