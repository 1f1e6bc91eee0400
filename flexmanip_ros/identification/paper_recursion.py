"""Compiled kernel of the paper's recursion: three recursive least-squares estimators in series."""

import math

import numpy as np

from flexmanip_ros.identification.factor import (
    FILLED,
    GROWTH,
    OPEN,
    PRIOR,
    USED,
    WEIGHT,
    WEIGHT2,
    accept,
    judge,
    memory,
    push,
    remember,
)
from flexmanip_ros.numerics.compiled import library
from flexmanip_ros.types import Array

LIMIT = 1e30
"""Largest covariance of a coefficient, in units of its prior one; at this limit nothing is forgotten."""


@library
def potter(S: Array, theta: Array, phi: Array, target: Array, f: Array, beta: float, error: Array) -> float:
    """One square-root least-squares step (eqs. 31-32, 40-42), covariance S S' (d, d), theta (k, d).

    error: (k,) receives the prior error. Returns the conversion factor beta / (beta + phi' P phi).
    """
    d = phi.shape[0]
    k = target.shape[0]
    for j in range(d):
        f[j] = 0.0
    for i in range(d):
        value = phi[i]
        if value != 0.0:
            for j in range(d):
                f[j] += value * S[i, j]
    a = beta
    for j in range(d):
        a += f[j] * f[j]
    for o in range(k):
        total = 0.0
        for j in range(d):
            total += theta[o, j] * phi[j]
        error[o] = target[o] - total
    kappa = 1.0 / (a + math.sqrt(a * beta))
    back = 1.0 / math.sqrt(beta)
    for i in range(d):
        v = 0.0
        for j in range(d):
            v += S[i, j] * f[j]
        step = kappa * v
        for j in range(d):
            S[i, j] = (S[i, j] - step * f[j]) * back
        gain = v / a
        for o in range(k):
            theta[o, i] += error[o] * gain
    return beta / a


@library
def least_squares(
    S: Array, theta: Array, prior: Array, peaks: Array, phi: Array, target: Array, unit: Array, f: Array,
    error: Array, alpha: float, beta: float, weight: float,
) -> float:
    """Renew the prior, which holds for regressors of unit peak, where a peak grew; then do one step of ``potter``."""
    d = phi.shape[0]
    for i in range(d):
        size = abs(phi[i])
        if size > GROWTH * peaks[i]:
            old = peaks[i]
            peaks[i] = size
            if old == 0.0:
                S[i, i] = 1.0 / (math.sqrt(alpha) * size)
            else:
                unit[i] = math.sqrt(weight * alpha * (size * size - old * old))
                potter(S, theta, unit, prior[:, i] * unit[i], f, 1.0, error)
                unit[i] = 0.0
    top = 0.0
    for i in range(d):
        top = max(top, abs(S[i, i]) * peaks[i])
    if top * top * alpha > LIMIT:
        beta = 1.0
    return potter(S, theta, phi, target, f, beta, error)


@library
def select(W: Array, h: Array, x: Array) -> None:
    """Form x = W h (eq. 35)."""
    for i in range(W.shape[0]):
        x[i] = 0.0
        for j in range(h.shape[0]):
            x[i] += W[i, j] * h[j]


@library
def track(W: Array, P: Array, h: Array, x: Array, beta: float) -> None:
    """Projection approximation subspace tracking of h (q,): W (n, q), P (n, n), x = W h on return."""
    n = W.shape[0]
    select(W, h, x)
    g = P @ x
    a = beta
    for i in range(n):
        a += x[i] * g[i]
    for i in range(n):
        for j in range(n):
            P[i, j] = (P[i, j] - g[i] * g[j] / a) / beta
    for j in range(h.shape[0]):
        left = h[j]
        for i in range(n):
            left -= W[i, j] * x[i]
        for i in range(n):
            W[i, j] += g[i] * left / a
    select(W, h, x)


@library
def observe(xi: Array, z: Array, h: Array, f: int, r: int, m: int, weighted: int) -> None:
    """Compute h = (observability x controllability) z (eqs. 33-35), f blocks of m, without forming the matrix."""
    width = r + m
    past = z.shape[0]
    for block in range(f):
        shift = block * width
        for o in range(m):
            total = 0.0
            for j in range(past - shift):
                total += xi[o, j] * z[j + shift]
            if weighted:  # future outputs are replaced by their predictions
                for b in range(block):
                    at = past - (block - b) * width + r
                    for i in range(m):
                        total += xi[o, at + i] * h[b * m + i]
            h[block * m + o] = total


@library
def advance_paper(
    U: Array, Y: Array, S1: Array, xi: Array, prior1: Array, peaks1: Array,
    S2: Array, theta_x: Array, peaks2: Array, S3: Array, theta_y: Array, peaks3: Array, W: Array, P: Array,
    last: Array, z: Array, scale: Array, mean: Array, variance: Array, scalars: Array, counts: Array,
    p: int, future: int, feedthrough: int, weighted: int, tracked: int, alpha: Array, beta: Array, mode: int,
) -> None:
    """Run N samples of steps (a)-(d) of paper section 3.1; every array but U, Y is state, overwritten.

    last: (n + r + m + 1,) holds [x; u; e] of the previous sample, and 1 if there was one, else 0.
    """
    r = U.shape[1]
    m = Y.shape[1]
    n = theta_y.shape[1] - (r if feedthrough else 0)
    width = r + m
    past = p * width
    d1 = past + r if feedthrough else past
    d3 = n + r if feedthrough else n
    new = np.empty(width)
    phi1, unit1, f1 = np.empty(d1), np.zeros(d1), np.empty(d1)
    phi3, unit3, f3 = np.empty(d3), np.zeros(d3), np.empty(d3)
    unit2, f2 = np.zeros(n + width), np.empty(n + width)
    h, x, e1, e2, e3 = np.empty(future * m), np.empty(n), np.empty(m), np.empty(n), np.empty(m)
    prior2 = np.zeros((n, n + width))
    prior3 = np.zeros((m, d3))
    for i in range(n):
        prior2[i, i] = 1.0
    for k in range(U.shape[0]):
        follows = last[n + width] != 0.0
        last[n + width] = 0.0
        if not accept(U[k], Y[k], new, scale, mean, counts):
            continue
        remember(new, mean, scalars, counts, p)
        is_full = counts[FILLED] >= p
        b = memory(scalars, counts, beta[0], mode) if is_full else 1.0
        if is_full and scalars[OPEN] != 0.0:
            share = (1.0 - b) / (1.0 - beta[0]) if beta[0] < 1.0 else 1.0
            for i in range(past):
                phi1[i] = z[i]
            if feedthrough:
                for i in range(r):
                    phi1[past + i] = new[i]
            y = new[r:]
            scalars[PRIOR] *= b
            weight = scalars[PRIOR]
            converted = math.sqrt(
                least_squares(S1, xi, prior1, peaks1, phi1, y, unit1, f1, e1, alpha[0], b, weight))
            scalars[WEIGHT] = b * scalars[WEIGHT] + 1.0
            scalars[WEIGHT2] = b * b * scalars[WEIGHT2] + 1.0
            for i in range(m):
                e1[i] *= converted
            judge(e1, variance, scalars, counts, d1)
            observe(xi, z, h, future, r, m, weighted)
            if tracked:
                for i in range(h.shape[0]):  # tracking depends on the scale: scale to unit peak
                    peak = mean[1, r + i % m]
                    h[i] = h[i] / peak if peak > 0.0 else 0.0
            if tracked and counts[USED] > 2 * d1:  # before that the parameters have not converged
                track(W, P, h, x, 1.0 - (1.0 - beta[0]) * share)
            else:
                select(W, h, x)
            if follows:
                least_squares(S2, theta_x, prior2, peaks2, last[:n + width], x, unit2, f2, e2, alpha[1],
                              1.0 - (1.0 - beta[1]) * share, weight)
            for i in range(n):
                phi3[i] = x[i]
            if feedthrough:
                for i in range(r):
                    phi3[n + i] = new[i]
            least_squares(S3, theta_y, prior3, peaks3, phi3, y, unit3, f3, e3, alpha[2],
                          1.0 - (1.0 - beta[2]) * share, weight)
            for i in range(n):
                last[i] = x[i]
            for i in range(r):
                last[n + i] = new[i]
            for i in range(m):
                left = y[i]
                for j in range(d3):
                    left -= theta_y[i, j] * phi3[j]
                last[n + r + i] = left
            last[n + width] = 1.0
            counts[USED] += 1
        push(z, new)
        counts[FILLED] += 1
