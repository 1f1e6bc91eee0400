"""Recursive factor of the moments of [z; u; y], compiled: intake of a sample, forgetting, one Givens update."""

from __future__ import annotations

import math

import numpy as np
from numba import njit
from numpy.typing import NDArray

from flexmanip_ros.types import Array

WEIGHT, WEIGHT2, PRIOR, ENERGY, LATELY, POWER, GAMMA, OPEN = 0, 1, 2, 3, 4, 5, 6, 7
"""Sum of weights, sum of squared weights, weight left of the prior, variation of the signals as
remembered and lately (unit: squared peaks), innovation power, last conversion factor, how far the last
sample counted (0: not)."""
SCALARS = 8
FILLED, USED, SEEN, REJECTED, ODD = 0, 1, 2, 3, 4
"""Samples in a row without a gap, regressions since the restart, samples since reset, samples refused, and
samples in a row that stand out."""
COUNTS = 5

CONSTANT, EXCITATION, INNOVATION = 0, 1, 2
"""Modes of forgetting, see ``memory``."""

STILL, LIVELY = 0.005, 0.05
"""Relative variation of the signals below which nothing is learnt or forgotten, above which forgetting is
full."""
LARGEST = 1e100
"""Numbers are brought to about 1 by the first value of their channel; beyond this the sample is refused."""
OUTLIER, PATIENCE, SETTLED = 20.0, 2, 50
"""A value this many times the largest of its channel so far is a sensor's mistake and refused, unless more
than so many come in a row; looked for from that many regressions on."""
POWER_RATE = 0.02
"""Share of a sample in the innovation power, a mean over the latest ones."""
EXPECTED, SURPRISE = 1.5, 3.0
"""Innovation power below which the model fits, above which the plant is taken to have changed."""


@njit(cache=True)
def accept(u: Array, y: Array, new: Array, scale: Array, mean: Array, counts: Array) -> bool:
    """Scale one sample into ``new`` (r + m,); a number that cannot be breaks the window instead.

    The scale of a channel is the power of two next to its first value that is not zero: exact, so
    nothing of it is seen outside, and squares neither overflow nor vanish inside.
    """
    r = u.shape[0]
    counts[SEEN] += 1
    odd = False
    for i in range(new.shape[0]):
        value = u[i] if i < r else y[i - r]
        if not math.isfinite(value):
            counts[FILLED] = 0
            counts[REJECTED] += 1
            return False
        if scale[i] == 0.0 and value != 0.0:
            exponent = math.frexp(value)[1]
            scale[i] = math.ldexp(1.0, -max(min(exponent, 1000), -1000))
        new[i] = value * scale[i]
        if abs(new[i]) > LARGEST:
            counts[FILLED] = 0
            counts[REJECTED] += 1
            return False
        odd = odd or (mean[1, i] > 0.0 and abs(new[i]) > OUTLIER * mean[1, i])
    counts[ODD] = counts[ODD] + 1 if odd and counts[USED] >= SETTLED else 0
    if 0 < counts[ODD] <= PATIENCE:
        counts[FILLED] = 0
        counts[REJECTED] += 1
        return False
    return True


@njit(cache=True)
def push(z: Array, new: Array) -> None:
    """Move the past window z (p (r + m),) on by one sample (r + m,)."""
    width = new.shape[0]
    past = z.shape[0]
    for i in range(past - width):
        z[i] = z[i + width]
    for i in range(width):
        z[past - width + i] = new[i]


@njit(cache=True)
def remember(new: Array, mean: Array, scalars: Array, counts: Array, p: int) -> None:
    """Follow the variation of the signals: mean (2, r + m) holds slow means and running peaks.

    The means start at the first sample: a signal that stands still has no variation, whatever its level.
    """
    if counts[SEEN] - counts[REJECTED] == 1:
        for i in range(new.shape[0]):  # a slice would compile for seconds
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


@njit(cache=True)
def memory(scalars: Array, counts: Array, beta: float, mode: int) -> float:
    """Return the forgetting factor of this sample.

    Old information is let go only as far as new information comes in: with signals that vary less
    than half a percent of what is remembered (silence, saturation, a constant torque) nothing is forgotten,
    and nothing learnt: a sensor at its stop says something false about the dynamics.
    Mode INNOVATION forgets only while the innovations are larger than the model expects.
    """
    b = beta
    if mode == INNOVATION:
        surprise = (scalars[POWER] - EXPECTED) / (SURPRISE - EXPECTED)
        b = 1.0 - (1.0 - beta) * min(max(surprise, 0.0), 1.0)
    quiet = STILL
    lively = LIVELY
    if mode == CONSTANT:  # as the paper has it; only what would end in 0/0 is kept out
        quiet = 1e-12
        lively = 1e-11
    if scalars[ENERGY] > 0.0:  # noqa: SIM108
        ratio = scalars[LATELY] / scalars[ENERGY]
    else:  # the first sample: signals that have stood still since the start say nothing
        ratio = 1.0 if scalars[LATELY] > 0.0 else 0.0
    open_ = min(max((ratio - quiet) / (lively - quiet), 0.0), 1.0)
    rate = max(1.0 - b, 1.0 / (counts[USED] + 1.0)) * open_
    scalars[ENERGY] += rate * (scalars[LATELY] - scalars[ENERGY])
    b = 1.0 - (1.0 - b) * open_
    scalars[OPEN] = open_
    return float(b)


@njit(cache=True)
def judge(residual: Array, variance: Array, scalars: Array, counts: Array, b: float, parameters: int) -> None:
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

__all__ = ['COUNTS', 'SCALARS', 'advance_factor', 'rotate']

LEARNT_ROW, REJECTED_ROW, QUIET_ROW = 0, 1, 2
"""What became of a sample. One that only fills the past window counts as learnt."""

GROWTH = 1.25
"""A regressor that exceeds its peak by this factor re-states the prior of its coefficient."""


@njit(cache=True)
def rotate(R: Array, row: Array, start: int, stop: int, root: float) -> float:
    """Fold ``row`` into columns start..stop-1 of the upper triangle R, scaled by ``root`` first.

    R: (q, q), row: (q,) is overwritten with what is left of it. Returns the product of the cosines:
    for a least-squares column block, residual = prior error x product = posterior error / product.
    """
    q = R.shape[1]
    product = 1.0
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
        product *= c
    return product


@njit(cache=True)
def state_prior(
    R: Array, row: Array, scratch: Array, peaks: Array, prior: Array, regressors: int, m: int,
    alpha: float, weight: float,
) -> None:
    """Keep the prior worth alpha on signals of unit peak: add what is missing where a peak grew.

    Least squares does not feel the scale of its regressors except through the prior, so following
    the peaks this way is the internal scaling to unit peak, without a look ahead.
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


@njit(cache=True)
def advance_factor(
    U: Array, Y: Array, R: Array, z: Array, row: Array, scratch: Array, peaks: Array, prior: Array,
    scale: Array, mean: Array, variance: Array, scalars: Array, counts: Array,
    p: int, feedthrough: int, alpha: float, beta: float, mode: int, missing: NDArray[np.int64], outcome: Outcomes,
) -> None:
    """Run N samples. U: (N, r), Y: (N, m) in outside units; every other array is state, overwritten.

    missing: (N,) not 0: the sample never came, and no window holds it. outcome: (N,) is written: LEARNT_ROW,
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
        if counts[FILLED] >= p:
            b = memory(scalars, counts, beta, mode)
            if scalars[OPEN] == 0.0:
                outcome[k] = QUIET_ROW
                push(z, new)
                counts[FILLED] += 1
                continue
            for i in range(past):
                row[i] = z[i]
            for i in range(width):
                row[past + i] = new[i]
            scalars[PRIOR] *= b
            state_prior(R, row, scratch, peaks, prior, regressors, m, alpha, scalars[PRIOR])
            root = math.sqrt(b)
            scalars[GAMMA] = rotate(R, row, 0, regressors, root)
            scalars[WEIGHT] = b * scalars[WEIGHT] + 1.0
            scalars[WEIGHT2] = b * b * scalars[WEIGHT2] + 1.0
            judge(row[q - m:], variance, scalars, counts, b, regressors)
            rotate(R, row, regressors, q, root)
            counts[USED] += 1
        push(z, new)
        counts[FILLED] += 1
