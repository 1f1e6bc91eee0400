"""Compiled kernel of the prediction-error refinement: residuals and their derivatives along a stretch."""

from __future__ import annotations

import math

import numpy as np
from numba import njit

from flexmanip_ros.types import Array


@njit(cache=True, nogil=True)
def innovation(u: Array, y: Array, C: Array, D: Array, x: Array, e: Array) -> None:
    """Fill e (m,) = y - C x - D u."""
    for o in range(e.size):
        total = y[o]
        for i in range(x.size):
            total -= C[o, i] * x[i]
        for i in range(u.size):
            total -= D[o, i] * u[i]
        e[o] = total


@njit(cache=True, nogil=True)
def following(u: Array, A: Array, B: Array, K: Array, x: Array, e: Array, after: Array) -> None:
    """Fill after (n,) = A x + B u + K e."""
    for i in range(x.size):
        total = 0.0
        for j in range(x.size):
            total += A[i, j] * x[j]
        for j in range(u.size):
            total += B[i, j] * u[j]
        for j in range(e.size):
            total += K[i, j] * e[j]
        after[i] = total


@njit(cache=True, nogil=True)
def linearize(
    U: Array, Y: Array, A: Array, B: Array, C: Array, D: Array, K: Array, x: Array, whiten: Array,
    free_system: int, free_gain: int, free_output: int, free_direct: int,
    N: Array, g: Array, moments: Array, X: Array,
) -> None:
    """Run the predictor x+ = A x + B u + K e, e = y - C x - D u over (L, r), (L, m), and its derivatives.

    Parameters in order: A, B row-major if free_system, K if free_gain, C if free_output, D if free_direct,
    then x at the start. whiten: (m, m), whiten' whiten = inverse innovation covariance. On return x is the
    state after the last sample, N (d, d) += J' J (upper triangle) and g (d,) += J' e with J the derivatives
    of the whitened predictions; moments (m, m) += e e' and X (n, d) = dx/dparameters, started at [0 I] by
    the caller.
    """
    n, r, m = A.shape[0], B.shape[1], C.shape[0]
    d = N.shape[0]
    at_b = n * n
    at_k = at_b + n * r if free_system else 0
    at_c = at_k + (n * m if free_gain else 0)
    at_d = at_c + (m * n if free_output else 0)
    closed = A - K @ C
    J = np.empty((m, d))
    Jw = np.empty((m, d))
    ew = np.empty(m)
    e = np.empty(m)
    after = np.empty(n)
    moved = np.empty((n, d))
    for k in range(U.shape[0]):
        innovation(U[k], Y[k], C, D, x, e)
        for o in range(m):
            for j in range(d):
                J[o, j] = 0.0
            for i in range(n):
                c = C[o, i]
                if c != 0.0:
                    for j in range(d):
                        J[o, j] += c * X[i, j]
            if free_output:
                for i in range(n):
                    J[o, at_c + o * n + i] += x[i]
            if free_direct:
                for i in range(r):
                    J[o, at_d + o * r + i] += U[k, i]
        for o in range(m):
            ew[o] = 0.0
            for j in range(d):
                Jw[o, j] = 0.0
            for i in range(m):
                w = whiten[o, i]
                if w != 0.0:
                    ew[o] += w * e[i]
                    for j in range(d):
                        Jw[o, j] += w * J[i, j]
            for i in range(m):
                moments[o, i] += e[o] * e[i]
        for o in range(m):
            for i in range(d):
                a = Jw[o, i]
                g[i] += a * ew[o]
                if a != 0.0:
                    for j in range(i, d):
                        N[i, j] += a * Jw[o, j]
        for i in range(n):
            for j in range(d):
                moved[i, j] = 0.0
            for q in range(n):
                a = closed[i, q]
                for j in range(d):
                    moved[i, j] += a * X[q, j]
            if free_system:
                for j in range(n):
                    moved[i, i * n + j] += x[j]
                for j in range(r):
                    moved[i, at_b + i * r + j] += U[k, j]
            if free_gain:
                for j in range(m):
                    moved[i, at_k + i * m + j] += e[j]
            for o in range(m):
                gain = K[i, o]
                if free_output:
                    for j in range(n):
                        moved[i, at_c + o * n + j] -= gain * x[j]
                if free_direct:
                    for j in range(r):
                        moved[i, at_d + o * r + j] -= gain * U[k, j]
        following(U[k], A, B, K, x, e, after)
        for i in range(n):
            x[i] = after[i]
            for j in range(d):
                X[i, j] = moved[i, j]


@njit(cache=True, nogil=True)
def residual_moments(
    U: Array, Y: Array, A: Array, B: Array, C: Array, D: Array, K: Array, x: Array, moments: Array,
) -> None:
    """Run the predictor only: moments (m, m) += e e', x (n,) becomes the state after the last sample."""
    n, m = A.shape[0], C.shape[0]
    e = np.empty(m)
    after = np.empty(n)
    for k in range(U.shape[0]):
        innovation(U[k], Y[k], C, D, x, e)
        following(U[k], A, B, K, x, e, after)
        for i in range(n):
            x[i] = after[i]
        for o in range(m):
            for i in range(m):
                moments[o, i] += e[o] * e[i]


@njit(cache=True, nogil=True)
def condition(H: Array, root: Array, gradient: Array, step: Array) -> None:
    """Update in square-root form: root (k, k) <- root L^-T with L L' = I + H, step = (I + H)^-1 gradient.

    H: (k, k) symmetric, overwritten with L (lower); gradient, step: (k,). A library's routine would start
    threads for this.
    """
    k = H.shape[0]
    for i in range(k):
        H[i, i] += 1.0
        for j in range(i + 1):
            total = H[i, j]
            for q in range(j):
                total -= H[i, q] * H[j, q]
            if i == j:
                H[i, i] = math.sqrt(max(total, 1.0))  # I + H is never below I
            else:
                H[i, j] = total / H[j, j]
    for i in range(k):
        total = gradient[i]
        for q in range(i):
            total -= H[i, q] * step[q]
        step[i] = total / H[i, i]
    for i in range(k - 1, -1, -1):
        total = step[i]
        for q in range(i + 1, k):
            total -= H[q, i] * step[q]
        step[i] = total / H[i, i]
    for row in range(root.shape[0]):
        for i in range(k):
            total = root[row, i]
            for q in range(i):
                total -= H[i, q] * root[row, q]
            root[row, i] = total / H[i, i]
