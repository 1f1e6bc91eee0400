"""Compiled kernel of the default estimator: one triangular factor of the moments of [z; u; y].

z stacks the last p samples of [u; y], oldest first (paper eqs. 24-30). The whole predictor-based
subspace model is a function of these moments, see ``moments.py``; what runs at every sample is one
sweep of Givens rotations, so the information matrix is symmetric positive definite by construction.
"""

from __future__ import annotations

import math

import numpy as np
from numba import njit
from numpy.typing import NDArray

from flexmanip_ros.identification.memory_kernel import (
    COUNTS,
    FILLED,
    GAMMA,
    OPEN,
    PRIOR,
    SCALARS,
    USED,
    WEIGHT,
    WEIGHT2,
    accept,
    judge,
    memory,
    push,
    remember,
)
from flexmanip_ros.types import Array

Kinds = NDArray[np.int8]

__all__ = ['COUNTS', 'SCALARS', 'advance_factor', 'rotate']

LEARNT, REFUSED, QUIET = 0, 1, 2
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
    p: int, feedthrough: int, alpha: float, beta: float, mode: int, fate: Kinds,
) -> None:
    """Run N samples. U: (N, r), Y: (N, m) in outside units; every other array is state, overwritten.

    fate: (N,) is written: LEARNT, REFUSED or QUIET.
    """
    r = U.shape[1]
    m = Y.shape[1]
    width = r + m
    past = p * width
    q = past + width
    regressors = past + r if feedthrough else past
    new = np.empty(width)
    for k in range(U.shape[0]):
        fate[k] = LEARNT
        if not accept(U[k], Y[k], new, scale, mean, counts):
            fate[k] = REFUSED
            continue
        remember(new, mean, scalars, counts, p)
        if counts[FILLED] >= p:
            b = memory(scalars, counts, beta, mode)
            if scalars[OPEN] == 0.0:
                fate[k] = QUIET
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
