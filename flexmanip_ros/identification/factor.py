"""Recursive factor of the moments of [z; u; y], compiled: intake of a sample, forgetting, one Givens update."""

import math

import numpy as np
from numpy.typing import NDArray

from flexmanip_ros.numerics.compiled import library
from flexmanip_ros.types import Array

WEIGHT, WEIGHT2, PRIOR, ENERGY, LATELY, POWER, OPEN = 0, 1, 2, 3, 4, 5, 6
"""Indices into ``scalars``: sum of the weights, sum of the squared weights, remaining weight of the prior, remembered
and recent variation of the signals (unit: squared peaks), innovation power, and share with which the last sample
counted (0: not at all)."""
SCALARS = 7
FILLED, USED, SEEN, REJECTED, ODD = 0, 1, 2, 3, 4
"""Indices into ``counts``: samples in a row without a gap, regressions since the restart, samples since the reset,
samples rejected, and outliers in a row."""
COUNTS = 5

CONSTANT, EXCITATION, INNOVATION = 0, 1, 2
"""Modes of forgetting, see ``memory``."""

STILL, LIVELY = 0.005, 0.05
"""Ratio of recent to remembered variation below which no sample is learnt or forgotten, and above which forgetting is
full."""
LARGEST = 1e100
"""Largest scaled value; a sample beyond it is rejected. The scale brings the first value of a channel to about 1."""
OUTLIER, PATIENCE, SETTLED = 20.0, 2, 50
"""Multiple of its channel's largest value so far above which a value is an outlier; largest number of outliers in a row
that are rejected; and number of regressions from which on outliers are looked for."""
POWER_RATE = 0.02
"""Weight of a sample in the innovation power, which is an exponential average."""
EXPECTED, SURPRISE = 1.5, 3.0
"""Innovation power up to which the model fits, and from which on the plant counts as changed."""


@library
def accept(u: Array, y: Array, new: Array, scale: Array, mean: Array, counts: Array) -> bool:
    """Scale one sample into ``new`` (r + m,); return False and empty the window where a number is rejected.

    The scale of a channel brings its first non-zero value to about 1. It is a power of two, so scaling is exact and
    does not change the results, and squares neither overflow nor underflow.
    """
    r = u.shape[0]
    counts[SEEN] += 1
    rejected, odd = False, False
    for i in range(new.shape[0]):
        value = u[i] if i < r else y[i - r]
        if scale[i] == 0.0 and value != 0.0 and math.isfinite(value):
            exponent = math.frexp(value)[1]
            scale[i] = math.ldexp(1.0, -max(min(exponent, 1000), -1000))
        new[i] = value * scale[i]
        rejected = not abs(new[i]) <= LARGEST  # also where the value is not finite
        if rejected:
            break
        odd = odd or (mean[1, i] > 0.0 and abs(new[i]) > OUTLIER * mean[1, i])
    if not rejected:
        counts[ODD] = counts[ODD] + 1 if odd and counts[USED] >= SETTLED else 0
        rejected = 0 < counts[ODD] <= PATIENCE
    if rejected:
        counts[FILLED] = 0
        counts[REJECTED] += 1
    return not rejected


@library
def push(z: Array, new: Array) -> None:
    """Shift the past window z (p (r + m),) by one sample (r + m,)."""
    width = new.shape[0]
    past = z.shape[0]
    for i in range(past - width):
        z[i] = z[i + width]
    for i in range(width):
        z[past - width + i] = new[i]


@library
def remember(new: Array, mean: Array, scalars: Array, counts: Array, p: int) -> None:
    """Update the recent variation of the signals; mean (2, r + m) holds slow means and running peaks.

    The means start at the first sample, so a constant signal has no variation at any level.
    """
    if counts[SEEN] - counts[REJECTED] == 1:
        for i in range(new.shape[0]):  # a slice would take seconds to compile
            mean[0, i] = new[i]
    rate = 1.0 / (20.0 * p)
    energy = 0.0
    for i in range(new.shape[0]):
        size = abs(new[i])
        if size > mean[1, i]:
            mean[1, i] = size
        if mean[1, i] > 0.0:
            deviation = (new[i] - mean[0, i]) / mean[1, i]
            energy += deviation * deviation
        mean[0, i] += rate * (new[i] - mean[0, i])
    scalars[LATELY] += (energy - scalars[LATELY]) / p


@library
def memory(scalars: Array, counts: Array, beta: float, mode: int) -> float:
    """Return the forgetting factor of this sample.

    Old information is forgotten only as fast as new information comes in. While the variation of the signals is below
    half a percent of the remembered one (silence, saturation, a constant torque), no sample is forgotten and none is
    learnt: a sensor at its stop gives false information about the dynamics. Mode INNOVATION forgets only while the
    innovations are larger than the model expects.
    """
    b = beta
    if mode == INNOVATION:
        surprise = (scalars[POWER] - EXPECTED) / (SURPRISE - EXPECTED)
        b = 1.0 - (1.0 - beta) * min(max(surprise, 0.0), 1.0)
    quiet = STILL
    lively = LIVELY
    if mode == CONSTANT:  # the paper's; the tiny limits only prevent 0/0
        quiet = 1e-12
        lively = 1e-11
    if scalars[ENERGY] > 0.0:  # noqa: SIM108
        ratio = scalars[LATELY] / scalars[ENERGY]
    else:  # no variation is remembered yet: signals constant since the start carry no information
        ratio = 1.0 if scalars[LATELY] > 0.0 else 0.0
    open_ = min(max((ratio - quiet) / (lively - quiet), 0.0), 1.0)
    rate = max(1.0 - b, 1.0 / (counts[USED] + 1.0)) * open_
    scalars[ENERGY] += rate * (scalars[LATELY] - scalars[ENERGY])
    b = 1.0 - (1.0 - b) * open_
    scalars[OPEN] = open_
    return float(b)


@library
def judge(residual: Array, variance: Array, scalars: Array, counts: Array, parameters: int) -> None:
    """Update the innovation variance (m,) and power from one recursive residual (m,)."""
    m = residual.shape[0]
    rate = 1.0 / scalars[WEIGHT]
    power = 0.0
    for i in range(m):
        square = residual[i] * residual[i]
        power += square / variance[i] if variance[i] > 0.0 else 1.0
        variance[i] += rate * (square - variance[i])
    if counts[USED] > parameters:
        scalars[POWER] += POWER_RATE * (min(power / m, 1e6) - scalars[POWER])


Outcomes = NDArray[np.int8]

LEARNT_ROW, REJECTED_ROW, QUIET_ROW = 0, 1, 2
"""Outcome of a sample. A sample that only fills the past window counts as learnt."""

GROWTH = 1.25
"""Factor by which a regressor must exceed its peak before the prior of its coefficient is renewed."""


@library
def rotate(R: Array, row: Array, start: int, stop: int, root: float) -> None:
    """Fold ``row`` into columns start..stop-1 of the upper triangle R, scaled by ``root`` first.

    R: (q, q), row: (q,) is overwritten with what is left of it.
    """
    q = R.shape[1]
    for i in range(start, stop):
        b = row[i]
        if b == 0.0:
            if root != 1.0:
                for j in range(i, q):
                    R[i, j] *= root
            continue
        a = root * R[i, i]
        h = math.sqrt(a * a + b * b)
        if h == 0.0:
            continue
        c = a / h
        s = b / h
        cr = c * root
        sr = s * root
        R[i, i] = h
        for j in range(i + 1, q):
            t = R[i, j]
            v = row[j]
            R[i, j] = cr * t + s * v
            row[j] = c * v - sr * t
        row[i] = 0.0


@library
def state_prior(
    R: Array, row: Array, scratch: Array, peaks: Array, prior: Array, regressors: int, m: int,
    alpha: float, weight: float,
) -> None:
    """Keep the prior worth alpha on signals of unit peak: add the missing part to R where a peak grew.

    The scale of the regressors changes a least-squares solution through the prior alone. So this is equivalent to
    scaling the signals to unit peak, without knowing the peaks in advance.
    """
    q = R.shape[1]
    for i in range(regressors):
        size = abs(row[i])
        if size > GROWTH * peaks[i]:
            old = peaks[i]
            peaks[i] = size
            share = 1.0 if old == 0.0 else weight
            c = math.sqrt(share * alpha * (size * size - old * old))
            for j in range(q):
                scratch[j] = 0.0
            scratch[i] = c
            for j in range(m):
                scratch[q - m + j] = c * prior[j, i]
            rotate(R, scratch, i, q, 1.0)


@library
def advance_factor(
    U: Array, Y: Array, R: Array, z: Array, row: Array, scratch: Array, peaks: Array, prior: Array,
    scale: Array, mean: Array, variance: Array, scalars: Array, counts: Array,
    p: int, feedthrough: int, alpha: float, beta: float, mode: int, missing: NDArray[np.int64], outcome: Outcomes,
) -> None:
    """Run N samples. U: (N, r), Y: (N, m) in JointState units; every other array is state, overwritten.

    missing: (N,) not 0: the sample never came and empties the past window. outcome: (N,) is filled with LEARNT_ROW,
    REJECTED_ROW or QUIET_ROW.
    """
    r = U.shape[1]
    m = Y.shape[1]
    width = r + m
    past = p * width
    q = past + width
    regressors = past + r if feedthrough else past
    new = np.empty(width)
    for k in range(U.shape[0]):
        outcome[k] = LEARNT_ROW
        if missing[k] > 0:
            counts[FILLED] = 0
            continue
        if not accept(U[k], Y[k], new, scale, mean, counts):
            outcome[k] = REJECTED_ROW
            continue
        remember(new, mean, scalars, counts, p)
        is_full = counts[FILLED] >= p
        b = memory(scalars, counts, beta, mode) if is_full else 1.0
        if is_full and scalars[OPEN] == 0.0:
            outcome[k] = QUIET_ROW
        elif is_full:
            for i in range(past):
                row[i] = z[i]
            for i in range(width):
                row[past + i] = new[i]
            scalars[PRIOR] *= b
            state_prior(R, row, scratch, peaks, prior, regressors, m, alpha, scalars[PRIOR])
            root = math.sqrt(b)
            rotate(R, row, 0, regressors, root)
            scalars[WEIGHT] = b * scalars[WEIGHT] + 1.0
            scalars[WEIGHT2] = b * b * scalars[WEIGHT2] + 1.0
            judge(row[q - m:], variance, scalars, counts, regressors)
            rotate(R, row, regressors, q, root)
            counts[USED] += 1
        push(z, new)
        counts[FILLED] += 1
